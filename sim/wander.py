"""Targets that fly at random: smooth, within limits of speed and acceleration, and never out of their box.

Every few seconds a goal and a speed are drawn. The velocity at instant k is the one that carried the target from
instant k - 1 to k, as in `sim.course`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import StateLayout
from sim.noise import uniform_rows

Array = NDArray[np.float64]

GOAL_S = 4.0
"""A goal counts for so long."""

SLOWEST_SHARE = 0.3
"""Speeds are drawn evenly between this share of the largest one, and that."""

NEAR_S = 1.0
"""A target slows down as if it were to reach its goal in so long."""


def wandered(
    layout: StateLayout,
    start: Array,
    low: Array,
    high: Array,
    max_speed_mps: float,
    max_acceleration_mps2: float,
    step_s: float,
    steps: int,
    seed: int,
    name: str,
) -> Array:
    """True states (steps + 1, n) of position and velocity, in ENU [m, m/s], from a `start` (n,) at rest in the box.

    low, high (axes,): corners of the box. Draws are named by (seed, name, number of the goal), so that a longer run
    begins as a shorter one. Raises `ValueError` for a start that is not at rest, or not in the box.
    """
    axes = len(layout.position)
    place, velocity = start[:axes].copy(), start[axes:].copy()
    if velocity.any() or (place < low).any() or (place > high).any():
        raise ValueError("a target that wanders starts at rest, within its box")
    # No axis needs more than its share to stop in front of a wall, so that no other one can keep it from that.
    share = max_acceleration_mps2 / math.sqrt(axes)
    change = share * step_s
    goals = uniform_rows(seed, 1 + int(steps * step_s / GOAL_S), axes + 1, name, "course")
    track = np.tile(start, (steps + 1, 1))
    for k in range(1, steps + 1):
        draw = goals[int((k - 1) * step_s / GOAL_S)]
        away = low + draw[:axes] * (high - low) - place
        speed = max_speed_mps * (SLOWEST_SHARE + (1.0 - SLOWEST_SHARE) * draw[axes])
        wanted = away * min(speed / max(float(np.linalg.norm(away)), 1e-9), 1.0 / NEAR_S)
        wanted = np.clip(wanted, -_stoppable(place - low, share, step_s), _stoppable(high - place, share, step_s))
        velocity = velocity + np.clip(wanted - velocity, -change, change)
        velocity *= min(1.0, max_speed_mps / max(float(np.linalg.norm(velocity)), 1e-9))
        place = place + step_s * velocity
        track[k, :axes], track[k, axes:] = place, velocity
    return track


def _stoppable(room: Array, acceleration: float, step_s: float) -> Array:
    """Largest speed (axes,) over the next step from which a stop within `room` (axes,) [m] is possible."""
    change = acceleration * step_s
    return np.asarray(np.sqrt(change**2 + 2.0 * acceleration * np.maximum(room, 0.0)) - change)
