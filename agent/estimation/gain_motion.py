"""A unicycle that estimates the gains of its own odometry.

State: x, y, heading, g_along, g_turn. True motion = gain x reported motion, the report having been multiplied by the
calibrated gains of the configuration already: both states are 1 for an odometry that is calibrated well, and wander.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.heading_moments import moved_in_its_frame
from agent.estimation.motion import PLANAR_SQUARE, UNICYCLE_GAINS, RobotMotion, StateLayout
from agent.estimation.unscented import Propagated, Transform

Array = NDArray[np.float64]

ALONG, TURN = 3, 4
"""Where the gains of forward motion and of turning sit in the state."""


def scaled(states: Array, increment: Array) -> Array:
    """Planar increment (3,) as states (..., 5) see it: (..., 3).

    An increment that turns by a is a chord at half that angle from the first heading (constant body velocity), so a
    turn that is longer by a factor turns the chord too.
    """
    along, turn = states[..., ALONG], states[..., TURN]
    half = 0.5 * (turn - 1.0) * increment[2]
    cos, sin = np.cos(half), np.sin(half)
    return np.stack(
        [
            along * (cos * increment[0] - sin * increment[1]),
            along * (sin * increment[0] + cos * increment[1]),
            turn * increment[2],
        ],
        axis=-1,
    )


def reported(states: Array, increment: Array) -> Array:
    """The increment (..., 3) that states (..., 5) see as `increment` (3,): the inverse of `scaled`."""
    along, turn = states[..., ALONG], states[..., TURN]
    half = -0.5 * (turn - 1.0) * increment[2] / turn
    cos, sin = np.cos(half), np.sin(half)
    return np.stack(
        [
            (cos * increment[0] - sin * increment[1]) / along,
            (sin * increment[0] + cos * increment[1]) / along,
            increment[2] / turn,
        ],
        axis=-1,
    )


@dataclass(frozen=True, slots=True)
class GainMotion(RobotMotion):
    """Motion by an odometry whose gains are states; each walks at random by `walk` / sqrt(s).

    The noise of an increment is that of the scaled motion, in the body frame at its beginning.
    """

    layout: StateLayout = UNICYCLE_GAINS
    walk: float = 0.003

    def advance(
        self,
        mean: Array,
        cov: Array,
        delta: Array,
        delta_cov: Array,
        dt_s: float,
        transform: Transform,
    ) -> Propagated:
        increment = delta[[0, 1, 3]]
        noise = delta_cov[PLANAR_SQUARE]
        walked = np.zeros((5, 5))
        walked[ALONG, ALONG] = walked[TURN, TURN] = self.walk**2 * dt_s
        if transform == "jacobian":
            moved, F, G = _linearized(mean, increment)
            return Propagated(moved, F @ cov @ F.T + G @ noise @ G.T + walked, F)
        heading = UNICYCLE_GAINS.angles[0]
        found = moved_in_its_frame(mean, cov, increment, noise, heading, (ALONG, TURN), self.persistent_rad2)
        return Propagated(found.mean, found.cov + walked, found.F)


def _linearized(mean: Array, increment: Array) -> tuple[Array, Array, Array]:
    """Moved mean (5,), F (5, 5) and G (5, 3), the image of the increment's noise."""
    seen = scaled(mean, increment)
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    turned = np.array([[cos, -sin], [sin, cos]])
    shift = turned @ seen[:2]
    reported = turned @ scaled(np.array([0.0, 0.0, 0.0, 1.0, mean[TURN]]), increment)[:2]
    moved = mean.copy()
    moved[:2] += shift
    moved[2] = wrap(moved[2] + seen[2])
    F, G = np.eye(5), np.zeros((5, 3))
    normal = np.array([-shift[1], shift[0]])
    F[:2, 2] = normal
    F[:2, ALONG] = reported
    F[:2, TURN] = 0.5 * increment[2] * normal
    F[2, TURN] = increment[2]
    G[:2, :2] = turned
    G[2, 2] = 1.0
    return moved, F, G
