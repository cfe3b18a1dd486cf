"""Heights, ranges and bearings of a robot in the body frame of another (De Silva, Mann, Gosine 2015, eq. 6).

    h = z,   az = atan2(y, x),   el = atan2(z, sqrt(x^2 + y^2)),   r = sqrt(x^2 + y^2 + z^2)

The state is x = (x, y, z, th) (..., 4), m and rad. A range is far better known than the place across it, so its second
order counts: with H2 = (I - u u^T) / r it is expected to be r + tr(H2 P) / 2, with tr(H2 P H2 P) / 2 more variance.
All arrays broadcast over leading axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAREST_M = 1e-3
"""Robots are taken to be at least so far apart: at none a range has no direction."""

OVERHEAD = 3.0
"""A robot whose horizontal distance is less than so many of its deviations has no azimuth that can be linearized."""

WIDE_RAD2 = 1.0
"""Variance of a heading from which on the published gate is a circle."""


@dataclass(frozen=True, slots=True, eq=False)
class Scalar:
    """A number as a belief expects it: residual (...), its Jacobian (..., 4), variance of the residual (...), and
    `gate`, the variance that gates and weights use, which is the same but of published wide headings."""

    residual: Array
    H: Array
    variance: Array
    gate: Array


@dataclass(frozen=True, slots=True, eq=False)
class Direction:
    """Azimuth and elevation as a belief expects them: expected (..., 2), H (..., 2, 4), S (..., 2, 2), and `gate`
    (..., 2, 2), the covariance that gates and weights use."""

    expected: Array
    H: Array
    S: Array
    gate: Array


def height(mean: Array, cov: Array, measured: Array, variance: Array) -> Scalar:
    """Height of the peer above the own [m]."""
    H = np.zeros_like(mean)
    H[..., 2] = 1.0
    total = cov[..., 2, 2] + variance
    return Scalar(np.asarray(measured - mean[..., 2]), H, np.asarray(total), np.asarray(total))


def distance(mean: Array, cov: Array, measured: Array, variance: Array, second: bool) -> Scalar:
    """Range [m]. second: with its second order; without, the published gate of wide headings."""
    place = mean[..., :3]
    r = np.maximum(np.sqrt((place * place).sum(axis=-1)), NEAREST_M)
    u = place / r[..., None]
    H = np.zeros_like(mean)
    H[..., :3] = u
    P = cov[..., :3, :3]
    Pu = (P @ u[..., None])[..., 0]
    along = (u * Pu).sum(axis=-1)
    if not second:
        wide = widened(cov)[..., :3, :3]
        gate = (u * (wide @ u[..., None])[..., 0]).sum(axis=-1) + variance
        return Scalar(np.asarray(measured - r), H, np.asarray(along + variance), np.asarray(gate))
    # tr(M P) and tr(M P M P) of M = I - u u^T, without making it.
    across = P[..., 0, 0] + P[..., 1, 1] + P[..., 2, 2] - along
    squares = (P * P).sum(axis=(-2, -1)) - 2.0 * (Pu * Pu).sum(axis=-1) + along**2
    total = along + 0.5 * squares / r**2 + variance
    return Scalar(np.asarray(measured - r - 0.5 * across / r), H, total, total)


def direction(mean: Array, cov: Array, noise: Array, modified: bool) -> Direction:
    """Azimuth and elevation with noise (..., 2, 2) [rad^2]. modified: the published gate of wide headings.

    Nearly overhead nothing is said of the azimuth: its noise there is that of any direction.
    """
    x, y, z = mean[..., 0], mean[..., 1], mean[..., 2]
    flat2 = np.maximum(x * x + y * y, NEAREST_M**2)
    flat = np.sqrt(flat2)
    far2 = flat2 + z * z
    H = np.zeros((*mean.shape[:-1], 2, 4))
    H[..., 0, 0], H[..., 0, 1] = -y / flat2, x / flat2
    slope = -z / (flat * far2)
    H[..., 1, 0], H[..., 1, 1], H[..., 1, 2] = x * slope, y * slope, flat / far2
    expected = np.stack([np.arctan2(y, x), np.arctan2(z, flat)], axis=-1)
    R = np.broadcast_to(noise, (*mean.shape[:-1], 2, 2)).copy()
    radial = (x * x * cov[..., 0, 0] + 2.0 * x * y * cov[..., 0, 1] + y * y * cov[..., 1, 1]) / flat2
    R[..., 0, 0] += np.where(flat2 < OVERHEAD**2 * radial, math.pi**2, 0.0)
    turned = H.swapaxes(-1, -2)
    S = H @ cov @ turned + R
    return Direction(expected, H, S, H @ widened(cov) @ turned + R if modified else S)


def widened(cov: Array) -> Array:
    """Covariances (..., 4, 4) with a circle in x, y where the heading is wide (the modified gate of fig. 3).

    Linearized, a uniform heading spreads a place along one line; lambda_max I holds every direction it may go.
    """
    wide = cov[..., 3, 3] > WIDE_RAD2
    if not wide.any():
        return cov
    mid = 0.5 * (cov[..., 0, 0] + cov[..., 1, 1])
    largest = mid + np.hypot(0.5 * (cov[..., 0, 0] - cov[..., 1, 1]), cov[..., 0, 1])
    found = cov.copy()
    for row, column in ((0, 0), (1, 1)):
        found[..., row, column] = np.where(wide, largest, cov[..., row, column])
    for row, column in ((0, 1), (1, 0)):
        found[..., row, column] = np.where(wide, 0.0, cov[..., row, column])
    return found


def corrected(mean: Array, cov: Array, sight: Scalar) -> tuple[Array, Array]:
    """Belief (..., 4), (..., 4, 4) after a number was measured."""
    PH = (cov @ sight.H[..., None])[..., 0]
    K = PH / sight.variance[..., None]
    new = mean + K * sight.residual[..., None]
    new[..., 3] = wrap(new[..., 3])
    return new, cov - K[..., :, None] * PH[..., None, :]


def turned_to(mean: Array, cov: Array, H: Array, S: Array, residual: Array) -> tuple[Array, Array]:
    """Belief (..., 4), (..., 4, 4) after a direction was measured: Jacobian (..., 2, 4), residual (..., 2)."""
    PH = cov @ H.swapaxes(-1, -2)
    K = PH @ inverse2(S)
    new = mean + (K @ residual[..., None])[..., 0]
    new[..., 3] = wrap(new[..., 3])
    cov = cov - K @ PH.swapaxes(-1, -2)
    return new, np.asarray(0.5 * (cov + cov.swapaxes(-1, -2)))


def residuals(expected: Array, bearings: Array) -> Array:
    """(..., m, 2) of bearings (m, 2) with what is expected (..., 2), azimuths wrapped."""
    found = bearings - expected[..., None, :]
    found[..., 0] = wrap(found[..., 0])
    return np.asarray(found)


def squared(residual: Array, S: Array) -> tuple[Array, Array]:
    """Mahalanobis squares (..., m) of residuals (..., m, 2) with S (..., 2, 2), and densities (..., m) [1/rad^2]."""
    a, b, c = S[..., 0, 0, None], S[..., 0, 1, None], S[..., 1, 1, None]
    det = a * c - b * b
    u, v = residual[..., 0], residual[..., 1]
    d2 = (c * u * u - 2.0 * b * u * v + a * v * v) / det
    return d2, np.exp(-0.5 * d2) / (2.0 * math.pi * np.sqrt(det))


def inverse2(S: Array) -> Array:
    """Inverse of (..., 2, 2)."""
    found = np.empty_like(S)
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    found[..., 0, 0], found[..., 1, 1] = S[..., 1, 1] / det, S[..., 0, 0] / det
    found[..., 0, 1], found[..., 1, 0] = -S[..., 0, 1] / det, -S[..., 1, 0] / det
    return found


def density(residual: Array, variance: Array) -> Array:
    """Of a Gaussian number (...) with variance (...)."""
    return np.asarray(np.exp(-0.5 * residual * residual / variance) / np.sqrt(2.0 * math.pi * variance))
