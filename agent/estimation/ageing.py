"""What a neighbour has told of one instant, at another one (Su 2022, eq. 2.6, 2.7; the thesis knows no late messages).

Nobody knows how a peer has moved since it told, but how fast it went: its pose is moved on along the arc of its last
velocity and yaw rate, and its covariance grows with the time. The errors of those velocities are not new at each
instant, so it grows with the square of it from one round on. A target is moved on by its model, and so is the place
where a sensor has seen it. Ages may be negative: the instant is then an earlier one, and nothing becomes surer by that.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import congruence, symmetrize, wrap_components
from agent.estimation.jlatt import Placed
from agent.estimation.motion import StateLayout, TargetMotion
from agent.estimation.unscented import Transform

Array = NDArray[np.float64]

AWAY_M, TURNED_RAD = 0.15, 0.2
"""Standard deviations of what a peer may have done otherwise in one round, in each direction and in heading."""


def pose_at_age(
    layout: StateLayout, mean: Array, cov: Array, velocity: Array, yaw_rate: float, age_s: float, period_s: float
) -> tuple[Array, Array]:
    """A peer's belief (n,), (n, n) `age_s` after its instant, in a team with rounds of `period_s`.

    velocity (3,) [m/s], body FLU, and yaw_rate [rad/s] are the last that are known of it.
    """
    moved, F, away = mean.copy(), np.eye(len(mean)), np.zeros(len(mean))
    away[list(layout.position)] = AWAY_M
    if layout.heading is not None:
        away[layout.heading] = TURNED_RAD
        turn = yaw_rate * age_s
        # An arc is its chord, which heads half the turn further and is a little shorter.
        chord = age_s * float(np.sinc(0.5 * turn / math.pi))
        along = mean[layout.heading] + 0.5 * turn
        cos, sin = chord * math.cos(along), chord * math.sin(along)
        dx, dy = cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1]
        moved[:2] += dx, dy
        moved[layout.heading] += turn
        F[0, layout.heading], F[1, layout.heading] = -dy, dx
    if layout.altitude is not None:
        moved[layout.altitude] += velocity[2] * age_s
    rounds = abs(age_s) / period_s
    grown = congruence(F, cov) + np.diag(away**2) * max(rounds, rounds**2)
    return wrap_components(moved, layout.angles), symmetrize(grown)


def target_at_age(
    motion: TargetMotion, mean: Array, cov: Array, age_s: float, transform: Transform
) -> tuple[Array, Array]:
    """A belief (n,), (n, n) of a target `age_s` after its instant."""
    if age_s == 0.0:
        return mean, cov
    moved = motion.drift(mean, cov, abs(age_s), transform)
    if age_s > 0.0:
        return moved.mean, moved.cov
    # Back in time: as far as it would have gone, and no surer.
    angles = motion.layout.angles
    back = mean - wrap_components(moved.mean - mean, angles)
    return wrap_components(back, angles), moved.cov


def place_at_age(
    motion: TargetMotion, placed: Placed, mean: Array, cov: Array, age_s: float, transform: Transform
) -> Placed:
    """A target's place by a sensor `age_s` after its instant: it goes on as a belief (n,), (n, n) says the target does.

    What that belief does not know of the way may be correlated with the error of the robot's pose in any way.
    """
    if age_s == 0.0:
        return placed
    moved = motion.drift(mean, cov, abs(age_s), transform)
    d = min(len(placed.place), len(motion.layout.position))
    way = math.copysign(1.0, age_s) * (moved.mean[:d] - mean[:d])
    drifted = congruence((moved.F - np.eye(len(mean)))[:d], cov)
    noise = (moved.cov - congruence(moved.F, cov))[:d, :d]
    pose = bounded_sum(placed.pose[:d, :d], drifted) + noise
    return Placed(placed.place[:d] + way, placed.sensor[:d, :d], symmetrize(pose))


def bounded_sum(cov_a: Array, cov_b: Array) -> Array:
    """Covariance (n, n) that bounds that of the sum of two errors, whatever their correlation; of the least trace."""
    a, b = math.sqrt(max(float(cov_a.trace()), 0.0)), math.sqrt(max(float(cov_b.trace()), 0.0))
    if a == 0.0 or b == 0.0:
        return np.asarray(cov_a + cov_b)
    return np.asarray((1.0 + b / a) * cov_a + (1.0 + a / b) * cov_b)
