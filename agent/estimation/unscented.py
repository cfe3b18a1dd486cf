"""Propagation and observation of a Gaussian through a nonlinear function, by three transforms.

`unscented`   the full scaled unscented transform: predicted measurement and innovation covariance keep the
              second-order residual (Lyu, Pan, Lv 2019, section 3, with weights and transposes corrected);
`linearized`  the form as printed there: H inferred from the sigma points, h(x) and H P H^T used after that;
`jacobian`    first-order Taylor expansion (EKF) with analytic Jacobians.

A pose is predicted by exact moments under the first two (`agent.estimation.heading_moments`), by its Jacobian under the
last.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, square_root, symmetrize, wrap, wrap_components

Array = NDArray[np.float64]
Transform = Literal["unscented", "linearized", "jacobian"]

Turning = tuple[tuple[int, int, float], ...]
"""(component of z, component of x, slope): angles of z that follow a heading of x all the way round."""

NARROW_RAD = 1.0
"""Sigma points that turn a heading by less than this are in no danger of being wrapped."""


@dataclass(frozen=True, slots=True)
class UnscentedParameters:
    """Scaling of the sigma points. With (1, 0, 0) all covariance weights are non-negative."""

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0


DEFAULT = UnscentedParameters()


@lru_cache(maxsize=64)
def weights(dim: int, parameters: UnscentedParameters) -> tuple[Array, Array, float]:
    """(mean weights (2n+1,), covariance weights (2n+1,), spread) for dimension n = `dim`."""
    spread2 = parameters.alpha**2 * (dim + parameters.kappa)
    mean = np.full(2 * dim + 1, 0.5 / spread2)
    mean[0] = 1.0 - dim / spread2
    cov = mean.copy()
    cov[0] += 1.0 - parameters.alpha**2 + parameters.beta
    mean.flags.writeable = cov.flags.writeable = False
    return mean, cov, math.sqrt(spread2)


def sigma_points(mean: Array, root: Array, spread: float) -> Array:
    """Points (..., 2n+1, n) for a mean (..., n) and a square root (..., n, n) of the covariance."""
    n = mean.shape[-1]
    points = np.empty((*mean.shape[:-1], 2 * n + 1, n))
    points[...] = mean[..., None, :]
    columns = spread * root.swapaxes(-1, -2)
    points[..., 1 : n + 1, :] += columns
    points[..., n + 1 :, :] -= columns
    return points


# Results of kernels are not frozen: to make a frozen one takes longer than some of what is in it.
@dataclass(slots=True, eq=False)
class Propagated:
    """Predicted mean (..., n), covariance (..., n, n) and F (..., n, n), the left factor of the old error."""

    mean: Array
    cov: Array
    F: Array


@dataclass(slots=True, eq=False)
class Predicted:
    """A predicted measurement: z (..., m), C = Cov(x, z) (..., n, m), Szz (..., m, m) without R, H (..., m, n)."""

    z: Array
    cross: Array
    cov: Array
    H: Array

    @property
    def residual(self) -> Array:
        """Second-order residual Szz - C^T P^-1 C >= 0 of the transform (zero for `jacobian`)."""
        return self.cov - self.H @ self.cross


def observe(
    function: Callable[[Array], Array],
    jacobian: Callable[[Array], Array],
    mean: Array,
    cov: Array,
    angles: tuple[int, ...],
    transform: Transform = "unscented",
    parameters: UnscentedParameters = DEFAULT,
    turning: Turning = (),
) -> Predicted:
    """Predict h(x) for x ~ (mean (..., n), cov (..., n, n)); `angles` are wrapped components of z.

    Sigma points of a heading that is hardly known lie turns apart. What an angle owes to one of `turning` is therefore
    taken off before it is wrapped, and added again: wrapped with it, the angle would seem to know where x is.
    """
    if transform == "jacobian":
        H = jacobian(mean)
        cross = cov @ H.swapaxes(-1, -2)
        return Predicted(function(mean), cross, symmetrize(H @ cross), H)
    weight_mean, weight_cov, spread = weights(mean.shape[-1], parameters)
    points = sigma_points(mean, square_root(cov), spread)
    image = function(points)
    centre, all_angles = image[..., :1, :], angles
    deviation = image - centre
    for row, column, slope in turning:
        if cov[..., column, column].max() * spread**2 > NARROW_RAD**2:
            turned = slope * (points[..., column] - mean[..., None, column])
            deviation[..., row] = wrap(deviation[..., row] - turned) + turned
            angles = tuple(angle for angle in angles if angle != row)
    deviation = wrap_components(deviation, angles)
    shift = weight_mean @ deviation
    deviation -= shift[..., None, :]
    weighted = deviation.swapaxes(-1, -2) * weight_cov
    cross = (weighted @ (points - mean[..., None, :])).swapaxes(-1, -2)
    H = gain(cross.swapaxes(-1, -2), cov)
    if transform == "linearized":
        return Predicted(centre[..., 0, :], cross, symmetrize(H @ cross), H)
    z = wrap_components(centre[..., 0, :] + shift, all_angles)
    return Predicted(z, cross, symmetrize(weighted @ deviation), H)
