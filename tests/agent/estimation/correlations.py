"""Beliefs whose errors are correlated at random, for properties that hold whatever the correlation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def random_covariance(rng: np.random.Generator, n: int, scale: float = 1.0) -> Array:
    """Axes of very different length."""
    root = rng.normal(size=(n, n)) * rng.uniform(0.1, 2.0, size=(n, 1))
    return np.asarray(scale * (root @ root.T + 1e-2 * np.eye(n)))


def random_joint(rng: np.random.Generator, covs: list[Array]) -> Array:
    """A joint covariance of errors with these marginals; one in three times all stem from as few causes as can be."""
    causes = max(len(cov) for cov in covs)
    if rng.uniform() > 1.0 / 3.0:
        causes += int(rng.integers(0, 2 * causes + 1))
    rows = []
    for cov in covs:
        mix, _ = np.linalg.qr(rng.normal(size=(causes, len(cov))))
        rows.append(np.linalg.cholesky(cov) @ mix.T)
    stacked = np.vstack(rows)
    return np.asarray(stacked @ stacked.T)


def least_gap(claimed: Array, truth: Array) -> float:
    """Smallest eigenvalue of what is claimed less what is true, as a share of the largest true one."""
    return float(np.linalg.eigvalsh(claimed - truth).min() / np.abs(truth).max())
