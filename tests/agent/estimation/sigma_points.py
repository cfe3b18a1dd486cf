"""A textbook unscented prediction, as a reference for predictions in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, square_root, symmetrize, wrap_components
from agent.estimation.unscented import DEFAULT, Propagated, UnscentedParameters, weights

Array = NDArray[np.float64]


def propagate(
    function: Callable[[Array, Array], Array],
    mean: Array,
    cov: Array,
    noise_root: Array,
    angles: tuple[int, ...],
    parameters: UnscentedParameters = DEFAULT,
) -> Propagated:
    """Push y = [x; w] through `function(x, w)` (broadcasts over points).

    mean (..., n), cov (..., n, n), noise_root (..., q, r) a square root of the noise covariance,
    `angles` the wrapped components of x. F = sum W_c (X' - x')(X - x)^T P^-1 over the state columns.
    """
    n, q = mean.shape[-1], noise_root.shape[-1]
    weight_mean, weight_cov, spread = weights(n + q, parameters)
    lead = mean.shape[:-1]
    states = np.empty((*lead, 2 * (n + q) + 1, n))
    states[...] = mean[..., None, :]
    noises = np.zeros((*lead, 2 * (n + q) + 1, noise_root.shape[-2]))
    columns = spread * square_root(cov).swapaxes(-1, -2)
    states[..., 1 : n + 1, :] += columns
    states[..., n + q + 1 : 2 * n + q + 1, :] -= columns
    noise_columns = spread * noise_root.swapaxes(-1, -2)
    noises[..., n + 1 : n + q + 1, :] = noise_columns
    noises[..., 2 * n + q + 1 :, :] = -noise_columns
    image = function(states, noises)
    centre = image[..., :1, :]
    deviation = wrap_components(image - centre, angles)
    shift = weight_mean @ deviation
    deviation -= shift[..., None, :]
    weighted = deviation.swapaxes(-1, -2) * weight_cov
    cross = weighted @ (states - mean[..., None, :])
    left = gain(cross, cov)
    new_mean = wrap_components(centre[..., 0, :] + shift, angles)
    return Propagated(new_mean, symmetrize(weighted @ deviation), left)
