"""Gaussian algebra shared by every estimator. Arrays are float64; kernels broadcast over leading axes.

Single matrices go to LAPACK directly: for a handful of components numpy's own checks take longer than the algebra.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv, dpotrf

Array = NDArray[np.float64]

TWO_PI = 2.0 * math.pi
ABSURD = 2.0
"""Canonical correlation that nothing but a wrong factor leads to; approximations stay within percents of 1."""

LOWEST = -float(np.nextafter(np.pi, 0.0))
"""The smallest wrapped angle: -pi itself is the same direction as pi."""


def wrap(angle: Array) -> Array:
    """Angles [rad] mapped to (-pi, pi]; any shape."""
    # The remainder of a tiny negative number rounds to a whole turn.
    wrapped: Array = np.maximum(np.pi - np.remainder(np.pi - angle, TWO_PI), LOWEST)
    return wrapped


def wrap_scalar(angle: float) -> float:
    """One angle [rad] mapped to (-pi, pi], as `wrap` does."""
    return max(math.pi - (math.pi - angle) % TWO_PI, LOWEST)


def wrap_components(vector: Array, angles: tuple[int, ...]) -> Array:
    """`vector` (..., n) with the components `angles` wrapped; returns the same array, changed in place."""
    if vector.ndim == 1:
        for index in angles:
            vector[index] = wrap_scalar(vector.item(index))
        return vector
    for index in angles:
        vector[..., index] = wrap(vector[..., index])
    return vector


@lru_cache(maxsize=64)
def identity(n: int) -> Array:
    """The identity (n, n), read-only: `numpy.eye` takes as long as a product of small matrices."""
    found = np.eye(n)
    found.flags.writeable = False
    return found


def congruence(A: Array, P: Array) -> Array:
    """A P A^T of one A (m, n) and one P (n, n): for a few components `dot` takes half as long as `@`."""
    found: Array = A.dot(P).dot(A.T)
    return found


def symmetrize(matrix: Array) -> Array:
    """Half the sum of a matrix (..., n, n) and its transpose; one number is symmetric already, and returned itself."""
    if matrix.shape[-1] == 1:
        return matrix
    return 0.5 * (matrix + matrix.swapaxes(-1, -2))


def is_positive_definite(matrix: Array) -> bool:
    """Whether one symmetric matrix (n, n) is finite and has a Cholesky factor."""
    return math.isfinite(matrix.sum()) and dpotrf(matrix, lower=1)[1] == 0


def square_root(cov: Array) -> Array:
    """L (..., n, n) with L L^T = cov for a positive semi-definite `cov` (..., n, n).

    Cholesky where it exists; otherwise (exact zeros on the diagonal, for instance noise-free directions) the
    eigenvector factor. Raises `numpy.linalg.LinAlgError` when `cov` is indefinite beyond rounding: a
    covariance is never repaired silently.
    """
    if cov.ndim == 2:
        root, info = dpotrf(cov, lower=1)
        if info == 0 and math.isfinite(root.sum()):
            return np.asarray(root)
    try:
        return np.asarray(np.linalg.cholesky(cov), dtype=np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        floor = -1e-9 * np.maximum(np.abs(values).max(axis=-1, keepdims=True), 1e-300)
        if not np.all(np.isfinite(values)) or np.any(values < floor):
            raise
        return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None))[..., None, :])


def _solved(matrix: Array, right: Array) -> Array:
    """matrix^-1 right for one matrix (m, m). Raises `numpy.linalg.LinAlgError` if it is singular."""
    if len(matrix) == 1 and (number := matrix.item(0)) != 0.0:
        return np.asarray(right / number)
    _, _, solution, info = dgesv(matrix, right)
    if info != 0:
        raise np.linalg.LinAlgError("Singular matrix")
    return np.asarray(solution)


def inverse(matrix: Array) -> Array:
    """P^-1 of one matrix (n, n). Raises `numpy.linalg.LinAlgError` if it is singular."""
    return _solved(matrix, identity(len(matrix)))


def quadratic_form(vector: Array, cov: Array) -> Array:
    """v^T P^-1 v for v (..., n), P (..., n, n): the NEES of an error or the NIS of an innovation."""
    if vector.ndim == 1:
        return np.asarray(vector.dot(_solved(cov, vector)))
    solved = np.linalg.solve(cov, vector[..., None])
    return np.asarray((vector[..., None, :] @ solved)[..., 0, 0])


def gain(cross: Array, innovation_cov: Array) -> Array:
    """C S^-1 for C (..., n, m) and symmetric S (..., m, m): a Kalman gain, or P+ P^-1, or an inferred Jacobian."""
    if cross.ndim == 2 and innovation_cov.ndim == 2:
        return np.asarray(_solved(innovation_cov, cross.T).T)
    if innovation_cov.shape[-1] == 1 and innovation_cov.all():
        return np.asarray(cross / innovation_cov)
    return np.asarray(np.linalg.solve(innovation_cov, cross.swapaxes(-1, -2)).swapaxes(-1, -2))


def clip_canonical_correlations(cov_a: Array, cross: Array, cov_b: Array, limit: float = 0.999) -> Array:
    """Cross-covariance (n, m) with canonical correlations (singular values of L_a^-1 C L_b^-T) <= `limit`.

    The product rule for third parties (Luft et al. 2018, eq. 28 of UT-CLAT) is an approximation and can leave
    a joint covariance indefinite; this is the nearest admissible one in the canonical basis. Raises
    `numpy.linalg.LinAlgError` if they are beyond `ABSURD`: no approximation makes such an error.
    """
    root_a, root_b = np.linalg.cholesky(cov_a), np.linalg.cholesky(cov_b)
    white = np.linalg.solve(root_a, np.linalg.solve(root_b, cross.T).T)
    left, values, right = np.linalg.svd(white, full_matrices=False)
    if values[0] <= limit:
        return cross
    if not values[0] <= ABSURD:
        raise np.linalg.LinAlgError("canonical correlations are far above 1")
    return np.asarray(root_a @ (left * np.minimum(values, limit)) @ right @ root_b.T)
