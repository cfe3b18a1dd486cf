"""Odometry over many increments as one, and back: what an increment was, from two sums that start at one anchor.

An increment is dx, dy, dz, dyaw (4,) in the body frame at its beginning, with a covariance (4, 4) of its error there.
Sums are of first order in that error, which makes them invertible: the increment between two sums comes out with
exactly the covariance that went in, however long ago the anchor was.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import symmetrize

Array = NDArray[np.float64]


def _turned(delta: Array, yaw: float) -> Array:
    """An increment (4,) in a frame in which its beginning heads along `yaw`."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy, dz, dyaw = delta.tolist()
    return np.array([cos * dx - sin * dy, sin * dx + cos * dy, dz, dyaw])


def _jacobians(yaw: float, shift: Array) -> tuple[Array, Array]:
    """(F, G) (4, 4): how errors of a sum with heading `yaw`, and of what is added, `shift` in its frame, enter."""
    F, G = np.eye(4), np.eye(4)
    F[0, 3], F[1, 3] = -shift[1], shift[0]
    cos, sin = math.cos(yaw), math.sin(yaw)
    G[0, 0], G[0, 1], G[1, 0], G[1, 1] = cos, -sin, sin, cos
    return F, G


def extended(total: Array, total_cov: Array, delta: Array, cov: Array) -> tuple[Array, Array]:
    """The sum (4,), (4, 4) with one more increment. The heading is not wrapped."""
    yaw = float(total[3])
    shift = _turned(delta, yaw)
    F, G = _jacobians(yaw, shift)
    return total + shift, symmetrize(F @ total_cov @ F.T + G @ cov @ G.T)


def moved_between(first: Array, second: Array) -> Array:
    """Increment (4,) from one sum (4,) to a later one."""
    return _turned(second - first, -float(first[3]))


def increment(first: Array, first_cov: Array, second: Array, second_cov: Array) -> tuple[Array, Array]:
    """The increment (4,), (4, 4) by which the second sum extends the first.

    Its covariance is not positive semi-definite if the sums are not of one odometry.
    """
    F, G = _jacobians(float(first[3]), second - first)
    cov = G.T @ (second_cov - F @ first_cov @ F.T) @ G
    return moved_between(first, second), symmetrize(cov)
