"""How much each of several estimates counts whose correlation is unknown: covariance intersection of many.

P^-1 = w_0 P_0^-1 + sum w_l S_l with weights >= 0 that sum to 1 bounds the true covariance whatever the correlation
(Su 2022, eq. 2.4). S_l is the information of a correction, H^T R^-1 H, which may have any rank and is never inverted;
nor is the prior P_0, which may know some direction exactly. Rules of the weights:

trace       the least trace, by w_l <- w_l sqrt(tr(P S_l P)), normalised; each iteration lowers it
logdet      the least determinant, by w_l <- w_l tr(S_l P)
info        w_l ~ tr(S_l): eq. 2.5 with 1 / tr(S_l) for the trace of a covariance that does not exist
pinv_guard  w_l ~ 1 / tr(S_l^+): eq. 2.5 with pseudo-inverses

All but `info` keep the prior where the fused covariance costs more. Su 2022 weighs in two stages, corrections first and
what they make next to the prior (eq. 2.10, 2.11); that makes no difference to the rules that minimise.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import square_root, symmetrize

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rule = Literal["trace", "logdet", "info", "pinv_guard"]

ITERATIONS = 25
"""The trace is within two percent of the least one then, mostly within a thousandth."""

RANK = 1e-9
"""Eigenvalues of a product below this share of its largest one are rounding, not information."""

LEAST = 1e-300
"""A size that is divided by instead of zero."""


def weighed(
    prior: Array, informations: Array, used: Mask, rule: Rule, staged: bool = True
) -> tuple[Array, Array]:
    """Intersection of a prior (..., n, n) with informations (..., m, n, n), of which `used` (..., m) are there.

    `staged`: informations are weighed among themselves first. What is not `used` may be any numbers. Returns (cov
    (..., n, n), weights (..., 1 + m)), that of the prior first. Raises `numpy.linalg.LinAlgError` for a prior that is
    indefinite.
    """
    lead = np.broadcast_shapes(prior.shape[:-2], informations.shape[:-3], used.shape[:-1])
    used = np.broadcast_to(used & (_trace(informations) > 0.0), (*lead, used.shape[-1]))
    root = square_root(prior)
    # In the prior's own metric it is the identity: P = L (w_0 I + sum w_l A_l)^-1 L^T with A = L^T S L.
    whitened = root.swapaxes(-1, -2)[..., None, :, :] @ informations @ root[..., None, :, :]
    whitened = np.where(used[..., None, None], whitened, 0.0)
    if rule == "trace" or rule == "logdet":
        weights = _least_where_used(root, whitened, used, rule)
    else:
        weights = _by_size(prior, np.where(used[..., None, None], informations, 0.0), used, rule, staged)
    inverse = np.asarray(np.linalg.inv(_sum(weights, whitened)))
    cov = symmetrize(root @ inverse @ root.swapaxes(-1, -2))
    kept = np.asarray(~used.any(axis=-1))
    if rule == "logdet":
        kept = kept | ~(np.linalg.slogdet(inverse)[1] < 0.0)
    elif rule != "info":
        kept = kept | ~(_trace(cov) < _trace(prior))
    weights = np.where(kept[..., None], np.arange(weights.shape[-1]) == 0, weights)
    return np.where(kept[..., None, None], prior, cov), weights


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=-2, axis2=-1))


def _sum(weights: Array, whitened: Array) -> Array:
    """w_0 I + sum w_l A_l (..., n, n)."""
    m, n = whitened.shape[-3], whitened.shape[-1]
    flat = whitened.reshape(*whitened.shape[:-3], m, n * n)
    found = (weights[..., None, 1:] @ flat).reshape(*weights.shape[:-1], n, n)
    return np.asarray(found + weights[..., :1, None] * np.eye(n))


def _least_where_used(root: Array, whitened: Array, used: Mask, rule: Rule) -> Array:
    """`_least`, without its iterations where there is nothing to weigh, as for most candidates of a planner."""
    if used.ndim == 1:
        return _least(root, whitened, used, rule) if used.any() else np.eye(1, 1 + len(used))[0]
    some = used.any(axis=-1)
    weights = np.zeros((*used.shape[:-1], 1 + used.shape[-1]))
    weights[..., 0] = 1.0
    if some.any():
        root = np.broadcast_to(root, (*some.shape, *root.shape[-2:]))
        weights[some] = _least(root[some], whitened[some], used[some], rule)
    return weights


def _least(root: Array, whitened: Array, used: Mask, rule: Rule) -> Array:
    """Weights (..., 1 + m) of the least trace or determinant."""
    lead, (m, n) = whitened.shape[:-3], whitened.shape[-3:-1]
    metric = root.swapaxes(-1, -2) @ root
    # The prior is the identity, one of the informations: two products with all of them do for sums and slopes.
    flat = np.empty((*lead, m + 1, n * n))
    flat[..., 0, :] = np.eye(n).ravel()
    flat[..., 1:, :] = whitened.reshape(*lead, m, n * n)
    weights = np.ones((*lead, 1, m + 1))
    weights[..., 0, 1:] = used
    weights /= weights.sum(axis=-1, keepdims=True)
    for _ in range(ITERATIONS):
        inverse = np.asarray(np.linalg.inv((weights @ flat).reshape(*lead, n, n)))
        if rule == "trace":
            inverse = inverse @ metric @ inverse
        # A prior without any error has no slope at all.
        slope = np.maximum(inverse.reshape(*lead, 1, n * n) @ flat.swapaxes(-1, -2), LEAST)
        weights = weights * (np.sqrt(slope) if rule == "trace" else slope)
        weights /= weights.sum(axis=-1, keepdims=True)
    return np.asarray(weights[..., 0, :])


def _by_size(prior: Array, informations: Array, used: Mask, rule: Rule, staged: bool) -> Array:
    """Weights (..., 1 + m) by the traces of what is weighed (Su 2022, eq. 2.5)."""
    size, sureness = _trace(prior), (_trace if rule == "info" else _pseudo_sureness)
    of_prior = 1.0 / np.maximum(size, LEAST)
    if rule == "info":
        # A prior without any error has no inverse, and is as sure as can be.
        inverse = np.asarray(np.linalg.pinv(prior, hermitian=True))
        of_prior = np.where(size > 0.0, _trace(inverse), of_prior)
    own = np.broadcast_to(of_prior, used.shape[:-1])[..., None]
    each = sureness(informations)
    if not staged:
        return _shares(np.concatenate([own, each], axis=-1))
    eta = _shares(each)
    together = np.sum(eta[..., None, None] * informations, axis=-3)
    zeta = _shares(np.concatenate([own, sureness(together)[..., None]], axis=-1))
    return np.concatenate([zeta[..., :1], zeta[..., 1:] * eta], axis=-1)


def _pseudo_sureness(informations: Array) -> Array:
    """1 / tr(S^+) (...) of informations S (..., n, n); 0 of those that tell nothing."""
    traces = _trace(np.asarray(np.linalg.pinv(informations, rcond=RANK, hermitian=True)))
    return np.asarray(np.where(traces > 0.0, 1.0 / np.maximum(traces, LEAST), 0.0))


def _shares(sureness: Array) -> Array:
    """Weights (..., m) in proportion to what is at least zero; zeros if all are."""
    largest = sureness.max(axis=-1, keepdims=True, initial=0.0)
    scaled = sureness / np.maximum(largest, LEAST)
    return np.asarray(scaled / np.maximum(scaled.sum(axis=-1, keepdims=True), LEAST))
