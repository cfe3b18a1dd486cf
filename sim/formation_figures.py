"""How well robots that encircle a target keep their formation: figures of true places."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from agent.planning.encircle import slots_of
from sim.fault_plan import trial_faults
from sim.scenario import Scenario
from sim.world import World

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

KEPT_WITHIN = 0.25
"""The formation is kept while nobody is further from its slot than this share of the radius."""


def formation_figures(
    places: Array, targets: Array, up: Mask, inside: Mask, radius_m: float
) -> dict[str, float | None]:
    """Figures of places (K, n, 3), robots in order of ids, around targets at (K, 3); None of what is not there.

    Slots are those of robots that are `up` (K, n), on the ring that is nearest to where they truly are.

    formation_error  mean distance to the slot, as a share of the radius, at the instants `inside` (K,)
    formation_kept_share  share of these at which nobody is further off than `KEPT_WITHIN`
    bearing_angle_error_rad  mean over pairs of how far the angle between bearings to the target is from a right one
    target_min_distance_m  the smallest of any robot that is up, at any instant
    """
    known: Mask = np.asarray(np.isfinite(places).all(axis=(1, 2)))
    off: list[float] = []
    angles: list[float] = []
    kept: list[bool] = []
    for k in np.flatnonzero(inside & known & up.any(axis=1)):
        here, target = places[k, up[k]], targets[k]
        away = np.linalg.norm(here - slots_of(here, target, radius_m), axis=1) / radius_m
        off.extend(away.tolist())
        kept.append(bool((away <= KEPT_WITHIN).all()))
        rays = target - here
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        pairs = itertools.combinations(rays, 2)
        angles.extend(abs(float(np.arcsin(np.clip(one @ other, -1.0, 1.0)))) for one, other in pairs)
    gaps = np.linalg.norm(places - targets[:, None], axis=-1)[known[:, None] & up]
    return {
        "formation_error": float(np.mean(off)) if off else None,
        "formation_kept_share": float(np.mean(kept)) if kept else None,
        "bearing_angle_error_rad": float(np.mean(angles)) if angles else None,
        "target_min_distance_m": float(gaps.min()) if gaps.size else None,
    }


def trial_formation(scenario: Scenario, world: World, inside: Mask) -> dict[str, float | None]:
    """The figures of a trial at instants 0, 1, ... (len(inside)) around its first target; empty if nobody encircles.

    Of robots with another radius than the first one's nothing is said.
    """
    parts = {robot.id: scenario.planning_of(robot) for robot in scenario.robots}
    ringed = sorted(name for name, part in parts.items() if part.kind == "encircle")
    if not ringed or not scenario.targets:
        return {}
    radius_m = parts[ringed[0]].radius_m
    ringed = [name for name in ringed if parts[name].radius_m == radius_m]
    count, t_ns = len(inside), np.arange(len(inside)) * world.step_ns
    places = np.array([[world.place(name, k) for name in ringed] for k in range(count)])
    targets = np.array([world.place(scenario.targets[0].id, k) for k in range(count)])
    up = np.ones((count, len(ringed)), dtype=bool)
    for fault in trial_faults(scenario, world.seed).values():
        if fault.level == "process":
            begin, end = fault.span_ns()
            for name in fault.names():
                if name in ringed:
                    up[(t_ns >= begin) & (t_ns < end), ringed.index(name)] = False
    return formation_figures(places, targets, up, inside, radius_m)
