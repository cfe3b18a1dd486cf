"""Robots that are steered on their true places: the motion does not depend on what any of them estimates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import compose
from agent.planning.potential import PotentialLaw
from sim.noise import normal_rows
from sim.scenario import Scenario, SteeringPart

Array = NDArray[np.float64]


def steered(
    scenario: Scenario, part: SteeringPart, starts: dict[str, Array], target: Array, seed: int, steps: int
) -> tuple[dict[str, Array], dict[str, Array]]:
    """True poses (steps + 1, 3) and commands (steps, 2) of all robots around a target's true states (steps + 1, n).

    Commands (speed, yaw rate) are held over a step and carry the robots' control noise.
    """
    law = PotentialLaw(
        closest_m=part.closest_m,
        apart_m=part.apart_m,
        radio_range_m=part.radio_range_m,
        max_speed_mps=part.max_speed_mps,
        max_turn_radps=part.max_turn_radps,
    )
    dt, n = scenario.step_s, len(scenario.robots)
    sigma = np.array([[robot.noise.speed_mps, robot.noise.yaw_rate_radps] for robot in scenario.robots])
    share = np.array([[robot.noise.speed_share, robot.noise.yaw_rate_per_mps] for robot in scenario.robots])
    noise = np.stack([normal_rows(seed, steps, 2, robot.id, "control") for robot in scenario.robots], axis=1)
    poses, commands = np.empty((steps + 1, n, 3)), np.empty((steps, n, 2))
    poses[0] = np.stack([starts[robot.id] for robot in scenario.robots])
    poses[0, :, 2] = wrap(poses[0, :, 2])
    weights = np.ones(n)
    for k in range(steps):
        place, velocity = target[k, :2], (target[k + 1, :2] - target[k, :2]) / dt
        commands[k] = law.commands(poses[k], np.tile(place, (n, 1)), np.tile(velocity, (n, 1)), weights)
        moves = dt * (commands[k] + np.hypot(sigma, share * commands[k, :, :1]) * noise[k])
        poses[k + 1] = compose(poses[k], np.stack([moves[:, 0], np.zeros(n), moves[:, 1]], axis=1))
        poses[k + 1, :, 2] = wrap(poses[k + 1, :, 2])
    return (
        {robot.id: poses[:, index] for index, robot in enumerate(scenario.robots)},
        {robot.id: commands[:, index] for index, robot in enumerate(scenario.robots)},
    )
