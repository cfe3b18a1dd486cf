"""Update of one robot from a peer's snapshot when their correlation is only partly known (split covariance
intersection on the joint state of a robot and its targets).

The error covariance of a belief is split as P = private + shared: `private` noise is held by nobody else, `shared`
may be correlated with every other robot's shared error in any way. For any gain K the new shared error is
(I - K H_l) r_l - K H_o r_o, and whatever the correlation of r_l and r_o its covariance is bounded by
X / w + Y / (1 - w) for any w in (0, 1). Gain and bound are decoupled: every candidate gain is charged its own best
bound, which for w = sx / (sx + sy) adds standard deviations. Costs are traces in the metric of the prior's inverse,
since a metric that one unobservable direction dominates would refuse useful updates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import congruence, gain, identity, inverse, symmetrize

Array = NDArray[np.float64]

PAIRS_OF_FACTORS = ((1.0, 1.0), (1.0, 2.0), (1.0, 4.0), (1.0, 16.0))
"""How often the own and the other's shared covariance enter a candidate gain's innovation."""

WIDEST = 1e9
"""Largest ratio of the two shared parts' deviations in a bound; any ratio bounds, an infinite one is no number."""

SMALLEST = 1e-150
"""A deviation that is divided by instead of zero."""


@dataclass(slots=True, eq=False)
class Split:
    """Error covariance P = private + shared, both (n, n) positive semi-definite."""

    private: Array
    shared: Array

    _cov: Array | None = field(default=None, init=False, repr=False)

    @property
    def cov(self) -> Array:
        if self._cov is None:
            self._cov = self.private + self.shared
        return self._cov

    def mapped(self, A: Array, private_noise: Array | None = None, shared_noise: Array | None = None) -> Split:
        """The split after the error was mapped by A (m, n) and independent noise (m, m) was added to either part."""
        private, shared = congruence(A, self.private), congruence(A, self.shared)
        if private_noise is not None:
            private = private + private_noise
        if shared_noise is not None:
            shared = shared + shared_noise
        return Split(symmetrize(private), symmetrize(shared))

    def told(self) -> Split:
        """The split once the belief has been sent: what was private may be held by a peer now."""
        return Split(np.zeros_like(self.private), self.cov)


@dataclass(slots=True, eq=False)
class SplitUpdate:
    """Gain K (n, m) of the innovation and the split after it."""

    K: Array
    split: Split


def update_own(split: Split, H: Array, R: Array) -> SplitUpdate:
    """Use a measurement of the own joint state with private noise: H (m, n), R (m, m) including residuals."""
    P = split.cov
    K = gain(P.dot(H.T), congruence(H, P) + R)
    left = identity(len(P)) - K.dot(H)
    return SplitUpdate(K, split.mapped(left, congruence(K, R)))


def _factors(own: float, other: float) -> Array:
    """Candidates (c, 2) of (f_own, f_other) for shared parts that contribute variances `own`, `other` to nu."""
    s_own, s_other = math.sqrt(max(own, 0.0)), math.sqrt(max(other, 0.0))
    q = s_own / (s_own + s_other) if s_own + s_other > 0.0 else 0.5
    found = list(PAIRS_OF_FACTORS)
    for w in (q, (1.0 + q) / 2.0, 0.8, 0.5, 0.2):
        w = min(max(w, 1e-3), 1.0 - 1e-3)
        found.append((1.0 / w, 1.0 / (1.0 - w)))
    return np.array(found)


def update_own_recurring(split: Split, H: Array, R: Array, recurring: Array) -> SplitUpdate | None:
    """`update_own` where noise of covariance `recurring` (m, m) comes with R, and may be correlated with the own error.

    All of the covariance is shared afterwards. None if the belief is better left alone.
    """
    nobody = Split(np.zeros((0, 0)), np.zeros((0, 0)))
    return update_from_peer(split.told(), nobody, H, np.zeros((len(H), 0)), R, recurring)


def update_from_peer(
    own: Split,
    other: Split,
    H_own: Array,
    H_other: Array,
    R: Array,
    recurring: Array | None = None,
    indifferent: Sequence[int] = (),
) -> SplitUpdate | None:
    """Use an innovation nu = H_own e_own + H_other e_other + v of two beliefs, for the own one only.

    own (n, n), other (k, k), H_own (m, n), H_other (m, k), R (m, m) positive definite. The own private noise up to now
    and the measurement noise are shared afterwards, since the peer may use the same innovation. None if no gain
    lowers the trace of P relative to the prior: the belief is better left alone. `recurring` (m, m): covariance of a
    part of v that comes on top of R and may be correlated with the own error in any way, but not with the other's.
    `indifferent` components may become as unsure as they like: their variances don't count when gains are compared.
    """
    n = len(own.private)
    C_private, C_shared = own.private.dot(H_own.T), own.shared.dot(H_own.T)
    own_private, own_shared = H_own.dot(C_private), symmetrize(H_own.dot(C_shared))
    other_shared = symmetrize(congruence(H_other, other.shared))
    if recurring is not None:
        other_shared = other_shared + recurring
    foreign = congruence(H_other, other.private) + R
    independent = symmetrize(own_private + foreign)
    metric = inverse(own.cov)
    if indifferent:
        counted = np.setdiff1d(np.arange(n), indifferent)
        square = np.ix_(counted, counted)
        metric = np.zeros((n, n))
        metric[square] = inverse(own.cov[square])
    factors = _factors(float(own_shared.trace()), float(other_shared.trace()))
    f_own, f_other = factors[:, 0, None, None], factors[:, 1, None, None]
    # One candidate per leading index; tr(metric K S K^T) = tr(S G) spares the (n, n) matrices of all but the best.
    K = gain(C_private + f_own * C_shared, independent + f_own * own_shared + f_other * other_shared)
    flat = K.reshape(len(K), -1)
    G = (K.swapaxes(-1, -2) @ (metric @ K)).reshape(len(K), -1)
    of_shared, of_private = float((metric * own.shared).sum()), float((metric * own.private).sum())
    X = np.maximum(of_shared - 2.0 * flat.dot(metric.dot(C_shared).ravel()) + G.dot(own_shared.ravel()), 0.0)
    Y = np.maximum(G.dot(other_shared.ravel()), 0.0)
    rest = of_private - 2.0 * flat.dot(metric.dot(C_private).ravel()) + G.dot(independent.ravel())
    # (sx + sy)^2 is the least of X / w + Y / (1 - w).
    cost = (np.sqrt(X) + np.sqrt(Y)) ** 2 + rest
    best = int(cost.argmin())
    if not cost[best] < n - len(indifferent):
        return None
    ratio = math.sqrt(Y[best] / max(float(X[best]), SMALLEST))
    ratio = min(max(ratio, 1.0 / WIDEST), WIDEST)
    K = K[best]
    left = identity(n) - K.dot(H_own)
    after = congruence(left, own.shared * (1.0 + ratio) + own.private)
    after += congruence(K, other_shared * (1.0 + 1.0 / ratio) + foreign)
    return SplitUpdate(K, Split(np.zeros((n, n)), symmetrize(after)))
