"""True motion that depends on nobody: constant controls with noise, courses, and what is pushed at random."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.config_parts import start_size
from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, SPATIAL, UNICYCLE_GAINS, StateLayout, velocity_step
from agent.settings import nanoseconds
from sim.course import driven_along, followed
from sim.noise import normal_rows
from sim.scenario import RobotPart, Scenario, TargetPart

Array = NDArray[np.float64]


def driven(scenario: Scenario, mover: RobotPart | TargetPart, start: Array, seed: int, steps: int) -> Array:
    """True states (steps + 1, n). Raises `ConfigError` for a start of another size."""
    layout = LAYOUTS[mover.model]
    size = start_size(layout)
    if len(start) != size:
        raise ConfigError(f"{scenario.name}: {mover.id}.start.pose needs {size} numbers for '{mover.model}'")
    if layout.heading is None:
        assert isinstance(mover, TargetPart)
        if mover.course is not None:
            return followed(mover.course, layout, start, nanoseconds(scenario.step_s), steps, seed, mover.id)
        return _drifted(scenario, mover, layout, start, seed, steps)
    if isinstance(mover, RobotPart) and mover.course is not None:
        return driven_along(mover.course, start, mover.control.speed_mps, nanoseconds(scenario.step_s), steps)[0]
    dt = scenario.step_s
    noise = normal_rows(seed, steps, 2, mover.id, "control")
    track = np.zeros((steps + 1, layout.dim))
    track[0] = [*start, *[1.0] * (layout.dim - size)]
    control = np.array([mover.control.speed_mps, mover.control.yaw_rate_radps])
    moves = dt * (control + np.array(mover.noise.deviations(mover.control.speed_mps)) * noise)
    heading = np.cumsum(np.append(track[0, layout.heading], moves[:, 1]))
    along = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1) * moves[:, :1]
    track[:, :2] = np.cumsum(np.concatenate([track[:1, :2], along]), axis=0)
    track[:, layout.heading] = wrap(heading)
    if layout is SPATIAL:
        up = normal_rows(seed, steps, 1, mover.id, "altitude")[:, 0]
        if mover.model == "quadrotor":
            track[1:, 2] = mover.control.altitude_m + mover.noise.altitude_m * up
        else:
            track[1:, 2] = start[2] + dt * np.cumsum(mover.control.climb_mps + mover.noise.climb_mps * up)
    if layout is UNICYCLE_GAINS:
        assert isinstance(mover, RobotPart)
        walk = mover.gain_walk_per_sqrt_s * np.sqrt(dt)
        draws = normal_rows(seed, steps, 2, mover.id, "gains")
        track[1:, 3:] += walk * np.cumsum(draws, axis=0) + 1.0
    return track


def _drifted(
    scenario: Scenario, target: TargetPart, layout: StateLayout, start: Array, seed: int, steps: int
) -> Array:
    """True states (steps + 1, n) of a target that is pushed at random."""
    dt, axes = scenario.step_s, len(layout.position)
    F, Q = velocity_step(layout, dt, target.damping_s)
    order = layout.dim // axes
    sigma = target.noise.jerk_mps3 if order == 3 else target.noise.acceleration_mps2
    root = np.linalg.cholesky(Q[::axes, ::axes]) * sigma * np.sqrt(dt)
    names = ("control", "acceleration", "jerk")[:order]
    draws = np.stack([normal_rows(seed, steps, axes, target.id, name) for name in names], axis=1)
    track = np.zeros((steps + 1, layout.dim))
    track[0] = start
    for k in range(steps):
        track[k + 1] = F @ track[k] + (root @ draws[k]).ravel()
    return track
