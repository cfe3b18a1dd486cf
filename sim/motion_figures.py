"""Where robots were in relation to each other and to targets: figures of their true places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.settings import NS
from sim.formation_figures import trial_formation
from sim.reach import Reach
from sim.scenario import Scenario
from sim.sight import steps_between
from sim.world import World

Array = NDArray[np.float64]
Instants = dict[tuple[str, str], Array]
CHUNK = 500
"""So many instants at once: pairs of a large fleet take room."""


def distances(places: Array) -> Array:
    """Between robots, (K, n, n), of places (K, n, 2 or 3); infinite to oneself."""
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    gaps[:, np.eye(places.shape[1], dtype=bool)] = np.inf
    return np.asarray(gaps)


def connected(near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """In which of the graphs (K, n, n) there is a way from everybody to everybody."""
    n = near.shape[1]
    reached = (near | np.eye(n, dtype=bool)).astype(np.float64)
    for _ in range(max(1, n - 1).bit_length()):
        reached = np.minimum(reached @ reached, 1.0)
    return np.asarray((reached > 0.0).all(axis=(1, 2)))


def entries(below: NDArray[np.bool_]) -> int:
    """How often pairs (K, n, n) come below a distance; one that begins below it counts too. Each pair counts once."""
    before = np.concatenate([np.zeros_like(below[:1]), below[:-1]])
    return int((below & ~before).sum()) // 2


def motion_figures(
    places: Array,
    inside: NDArray[np.bool_],
    step_s: float,
    collision_m: float,
    range_m: float | None,
    heard: NDArray[np.bool_] | None = None,
) -> dict[str, float | None]:
    """Figures of places (K, n, 3) of n robots at instants `step_s` apart; None of what there is nothing of.

    collisions       how often a pair came below `collision_m`, over all instants
    min_distance_m   the smallest of any pair at any instant
    connected_share  share of the instants `inside` (K,) at which the graph of pairs within `range_m` is connected, or
                     that of `heard` (K, n, n), by (source, destination), leads from everybody to everybody
    speed_mps        mean of all robots between the instants `inside`
    """
    count, n = places.shape[:2]
    if not np.isfinite(places).all():
        return {"collisions": None, "min_distance_m": None, "connected_share": None, "speed_mps": None}
    below, whole, least = np.zeros((count, n, n), dtype=bool), np.ones(count, dtype=bool), np.inf
    for start in range(0, count, CHUNK):
        part = slice(start, start + CHUNK)
        gaps = distances(places[part])
        below[part] = gaps < collision_m
        least = min(least, float(gaps.min(initial=np.inf)))
        if heard is not None:
            whole[part] = connected(heard[part])
        elif range_m is not None:
            whole[part] = connected(gaps <= range_m)
    moved = np.linalg.norm(np.diff(places[inside], axis=0), axis=-1)
    return {
        "collisions": float(entries(below)),
        "min_distance_m": least if n > 1 else None,
        "connected_share": float(whole[inside].mean()) if inside.any() else None,
        "speed_mps": float(moved.mean()) / step_s if moved.size else None,
    }


def seen_share(scenario: Scenario, measured: Instants, instants: NDArray[np.bool_]) -> float | None:
    """Mean share of the robots that see a target, over the `instants` (steps + 1,) at which their sensors look for any.

    Of a recording nobody knows when sensors looked: None, as without targets.
    """
    if not scenario.targets or scenario.world.kind != "simulated":
        return None
    shares = []
    for robot in scenario.robots:
        rates = [steps_between(part, scenario.step_s) for part in robot.sensors.values() if "targets" in part.of]
        due = instants[:: min(rates)].copy() if rates else np.zeros(0, dtype=bool)
        due[:1] = False  # Nothing is measured at the start.
        times = [t_s for (name, of), t_s in measured.items() if name == robot.id and of.startswith("target:")]
        if not due.any():
            shares.append(0.0)
            continue
        seen = np.unique(np.round(np.concatenate([*times, np.zeros(0)]) / scenario.step_s).astype(np.int64))
        shares.append(float(instants[seen].sum() / due.sum()))
    return float(np.mean(shares))


def trial_motion(scenario: Scenario, world: World, measured: Instants, played: int) -> dict[str, float | None]:
    """The figures of a trial up to step `played`; shares and speed are over the window, the rest from the start on."""
    places = np.array([[world.place(robot, k) for robot in world.robots] for k in range(played + 1)])
    t_s = np.arange(played + 1) * world.step_ns / NS
    inside = (t_s >= scenario.window_s[0] - 1e-9) & (t_s <= scenario.window_s[1] + 1e-9)
    links, heard = scenario.links.settings(world.seed), None
    if links.nearest is not None or links.rewire is not None:
        reach = Reach(world, links)
        heard = np.array([reach.heard(k) for k in range(played + 1)])
    figures = motion_figures(places, inside, world.step_ns / NS, scenario.collision_m, links.range_m, heard)
    figures["target_seen_share"] = seen_share(scenario, measured, inside)
    return figures | trial_formation(scenario, world, inside)


def over_trials(trials: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Mean over trials of each figure, the smallest distances of all; None of what no trial has."""
    found: dict[str, float | None] = {}
    for name in trials[0]:
        values = [trial[name] for trial in trials if trial[name] is not None]
        least = name.endswith("min_distance_m")
        found[name] = None if not values else min(values) if least else float(np.mean(values))
    return found
