"""Covariance intersection: fusion of estimates whose correlation is unknown (Julier & Uhlmann 1997)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, symmetrize, wrap_components

Array = NDArray[np.float64]
Weight = Literal["trace", "logdet", "fast"]

GRID = np.linspace(0.02, 0.98, 49)
"""Candidate weights of an intersection; the objective is flat, a finer grid changes nothing measurable."""
GRID.flags.writeable = False


def cost(cov: Array, weight: Weight) -> Array:
    """What an intersection minimises, for covariances (..., n, n)."""
    if weight == "logdet":
        return np.asarray(np.linalg.slogdet(cov)[1])
    return np.asarray(np.trace(cov, axis1=-2, axis2=-1))


def fuse(
    mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array, angles: tuple[int, ...], weight: Weight
) -> tuple[Array, Array, float]:
    """Intersection of (n,), (n, n) beliefs: P^-1 = w P_a^-1 + (1-w) P_b^-1 (UT-CLAT eq. 29).

    `fast` takes w from the traces (Niehsen 2002); `trace` and `logdet` search a grid including both ends,
    so the result is never worse than the better belief; among equal weights the one nearest 1/2 is taken.
    Returns (mean, cov, w).
    """
    info_a, info_b = np.linalg.inv(cov_a), np.linalg.inv(cov_b)
    if weight == "fast":
        trace_a, trace_b = float(np.trace(cov_a)), float(np.trace(cov_b))
        best = trace_b / (trace_a + trace_b)
    else:
        grid = np.concatenate([[0.0], GRID, [1.0]])
        candidates = grid[:, None, None] * info_a + (1.0 - grid[:, None, None]) * info_b
        costs = cost(np.linalg.inv(candidates), weight)
        # Equal covariances leave the weight free: rounding must not choose, and either side must choose alike.
        equal = np.isclose(costs, costs.min(), rtol=1e-9, atol=1e-9 if weight == "logdet" else 0.0)
        best = float(grid[equal][np.argmin(np.abs(grid[equal] - 0.5))])
    cov = symmetrize(np.linalg.inv(best * info_a + (1.0 - best) * info_b))
    difference = wrap_components(mean_b - mean_a, angles)
    mean = mean_a + cov @ ((1.0 - best) * info_b @ difference)
    return wrap_components(mean, angles), cov, best


def best_inflated_update(
    cov: Array,
    H_own: Array,
    own_term: Array,
    other_term: Array,
    noise: Array,
    weight: Weight,
) -> tuple[Array, Array, Array, float] | None:
    """Update own belief with a measurement that involves another belief of unknown correlation.

    For w on a grid the prior is cov / w and the other's share of the innovation `other_term` / (1 - w):
    S(w) = H P H^T / w + other_term / (1 - w) + noise (UT-CLAT eq. 16 with one weight per belief).
    cov (n, n), H_own (m, n), own_term = H P H^T (m, m), other_term (m, m), noise (m, m) including residuals.
    Returns (gain (n, m), cov_new, left (n, n), w), or None when no weight beats leaving the belief alone.
    """
    cross = cov @ H_own.T
    w = GRID[:, None, None]
    S = own_term / w + other_term / (1.0 - w) + noise
    gains = gain(np.broadcast_to(cross, (len(GRID), *cross.shape)), S) / w
    covs = cov / w - gains @ S @ gains.swapaxes(-1, -2)
    costs = cost(covs, weight)
    index = int(np.argmin(costs))
    if not costs[index] < cost(cov, weight):
        return None
    best = float(GRID[index])
    updated = symmetrize(covs[index])
    left = gain(updated, cov / best)
    return gains[index], updated, left, best
