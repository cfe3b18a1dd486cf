"""Where robots begin: on circles at phases drawn until all of them can meet, or at poses drawn until they are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from sim.noise import generator
from sim.scenario import RobotPart, Scenario, TargetPart

Array = NDArray[np.float64]


def draw_phases(scenario: Scenario, seed: int) -> dict[str, float]:
    """Phases of all robots on circles, redrawn until the contact graph over a lap is connected.

    Raises `ConfigError` when no draw within `max_draws` passes.
    """
    circling = [robot for robot in scenario.robots if robot.start.circle is not None]
    placement = scenario.world.placement
    if not circling or placement is None or placement.contact_range_m is None or placement.reaches is None:
        return {}
    rng = generator(seed, "world", "placement")
    for _ in range(placement.max_draws):
        phases = dict(zip((r.id for r in circling), rng.uniform(-np.pi, np.pi, len(circling)).tolist()))
        if _connected(circling, phases, placement.contact_range_m, placement.reaches):
            return phases
    raise ConfigError(
        f"{scenario.name}: no placement in {placement.max_draws} draws connects all robots with "
        f"'{placement.reaches}'; enlarge world.placement.contact_range_m or move the circles"
    )


def _connected(robots: list[RobotPart], phases: dict[str, float], contact_range_m: float, root: str) -> bool:
    turn = np.linspace(0.0, 2.0 * np.pi, 169)
    paths = {}
    for robot in robots:
        circle = robot.start.circle
        assert circle is not None
        angle = phases[robot.id] + turn
        paths[robot.id] = np.array(circle.center_m) + circle.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reached, frontier = [root], [root]
    while frontier:
        here = frontier.pop()
        for other, path in paths.items():
            gap = np.min(np.linalg.norm(paths[here] - path, axis=1))
            if other not in reached and gap <= contact_range_m:
                reached.append(other)
                frontier.append(other)
    return len(reached) == len(paths)


def draw_spread(scenario: Scenario, seed: int) -> dict[str, Array]:
    """Start poses of all robots that have one, each off by an even draw of its spread; apart, if the placement says so.

    Raises `ConfigError` when no draw within `max_draws` is apart.
    """
    placement = scenario.world.placement
    apart_m = None if placement is None else placement.apart_m
    draws = 1 if placement is None or apart_m is None else placement.max_draws
    for draw in range(draws):
        # The first draw is named as it is without a placement.
        names = ("place",) if draw == 0 else ("place", str(draw))
        poses = {robot.id: spread_pose(robot, seed, names) for robot in scenario.robots if robot.start.pose is not None}
        if apart_m is None or _least(poses) >= apart_m:
            return poses
    raise ConfigError(
        f"{scenario.name}: no placement in {draws} draws has all robots {apart_m:g} m apart; lower "
        "world.placement.apart_m, or enlarge robots.*.start.spread"
    )


def spread_pose(robot: RobotPart | TargetPart, seed: int, names: tuple[str, ...]) -> Array:
    """A start pose that is off by an even draw of its spread, named by the robot and `names`."""
    pose, spread = np.array(robot.start.pose), np.array(robot.start.spread)
    if len(spread):
        pose[: len(spread)] += spread * generator(seed, robot.id, *names).uniform(-1.0, 1.0, len(spread))
    return pose


def _least(poses: dict[str, Array]) -> float:
    """The smallest distance of two of them, seen from above."""
    there = np.array([pose[:2] for pose in poses.values()]).reshape(-1, 2)
    gaps = np.linalg.norm(there[:, None] - there, axis=-1)
    return float(gaps[np.triu_indices(len(there), 1)].min(initial=np.inf))
