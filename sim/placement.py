"""Where robots on circles begin: at phases drawn until all of them can meet."""

from __future__ import annotations

import numpy as np

from agent.config_file import ConfigError
from sim.noise import generator
from sim.scenario import RobotPart, Scenario


def draw_phases(scenario: Scenario, seed: int) -> dict[str, float]:
    """Phases of all robots on circles, redrawn until the contact graph over a lap is connected.

    Raises `ConfigError` when no draw within `max_draws` passes.
    """
    circling = [robot for robot in scenario.robots if robot.start.circle is not None]
    placement = scenario.world.placement
    if not circling or placement is None:
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
