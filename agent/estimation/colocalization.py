"""Cooperative localization with correlation factors, as pure functions (Lyu, Pan, Lv 2019; Luft et al. 2018).

Each function updates one robot only. Returned `left` matrices map the prior error to the posterior one and
must multiply every correlation of that robot: skipping it anywhere makes the fleet overconfident.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import (
    clip_canonical_correlations,
    congruence,
    gain,
    identity,
    is_positive_definite,
    quadratic_form,
    symmetrize,
    wrap_components,
)
from agent.estimation.intersection import Weight, best_inflated_update
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.observation import AbsoluteModel, RelativeModel, relative_model
from agent.estimation.unscented import Predicted, Transform, UnscentedParameters, observe
from agent.estimation.wide_heading import by_angles
from network.messages import NEVER, Measurement, Snapshot

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Options:
    """How an update is made: the transform, its parameters, and the innovation cap (0: none)."""

    transform: Transform
    parameters: UnscentedParameters
    innovation_cap: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Posterior mean (n,), cov (n, n), left factor (n, n) and the NIS per degree of freedom."""

    mean: Array
    cov: Array
    left: Array
    nis: float


def _innovation(predicted: Predicted, z: Array, angles: tuple[int, ...]) -> Array:
    return wrap_components(z - predicted.z, angles)


def _capped(innovation: Array, S: Array, cap: float) -> tuple[Array, float]:
    """S inflated until the NIS per degree of freedom is at most `cap`; and the NIS before that."""
    nis = float(quadratic_form(innovation, S)) / len(innovation)
    return (S * (nis / cap) if 0.0 < cap < nis else S), nis


def absolute_update(
    mean: Array,
    cov: Array,
    layout: StateLayout,
    model: AbsoluteModel | RelativeModel,
    z: Array,
    R: Array,
    options: Options,
) -> Update | None:
    """Use absolute information, or a known landmark (UT-CLAT 3.2.1).

    (mean, cov) is the belief at the instant of the measurement. None when the posterior would not be positive
    definite.
    """
    model, z, R = by_angles(model, z, R, cov)
    predicted = observe(
        model.h, model.jacobian, mean, cov, model.angles, options.transform, options.parameters, model.turning
    )
    innovation = _innovation(predicted, z, model.angles)
    S, nis = _capped(innovation, predicted.cov + R, options.innovation_cap)
    return applied(mean, cov, layout, gain(predicted.cross, S), S, innovation, nis, predicted.H)


def applied(
    mean: Array,
    cov: Array,
    layout: StateLayout,
    K: Array,
    S: Array,
    innovation: Array,
    nis: float,
    H: Array | None = None,
) -> Update | None:
    """x += K nu, P -= K S K^T; None when that is not positive definite.

    `H` spares a solution where K S = P H^T: P+ P^-1 = 1 - K H then.
    """
    posterior = symmetrize(cov - congruence(K, S))
    if not is_positive_definite(posterior):
        return None
    left = gain(posterior, cov) if H is None else identity(len(cov)) - K @ H
    return Update(wrap_components(mean + K @ innovation, layout.angles), posterior, left, nis)


def sighting_update(
    own: tuple[Array, Array, StateLayout],
    target: tuple[Array, Array, StateLayout],
    model: RelativeModel,
    z: Array,
    R: Array,
    weight: Weight,
    correlated: bool,
    options: Options,
) -> tuple[Update | None, Update | None, float]:
    """Use a sighting of a target for both beliefs, each with a weight of its own (UT-CLAT 3.2.2, eq. 16).

    One shared weight diverges; here each belief takes the weight that is best for itself, computed from the
    prior of the other, and is left alone if none helps (None). `correlated` False is the naive update that
    takes the two beliefs for independent. Returns (own update, target update, NIS per dof).
    """
    (own_mean, own_cov, own_layout), (target_mean, target_cov, target_layout) = own, target
    by_own, z, R = by_angles(model, z, R, own_cov)
    assert isinstance(by_own, RelativeModel)
    model = by_own
    n, m = len(own_mean), len(target_mean)
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[n:, n:] = own_cov, target_cov
    predicted = observe(
        model.h,
        model.jacobian,
        np.concatenate([own_mean, target_mean]),
        joint,
        model.angles,
        options.transform,
        options.parameters,
        model.turning,
    )
    H_own, H_target = predicted.H[:, :n], predicted.H[:, n:]
    own_term, target_term = H_own @ own_cov @ H_own.T, H_target @ target_cov @ H_target.T
    residual = predicted.cov - own_term - target_term
    noise = symmetrize(R + residual)
    innovation = _innovation(predicted, z, model.angles)
    factor = 2.0 if correlated else 1.0
    plain = factor * (own_term + target_term) + noise
    capped, nis = _capped(innovation, plain, options.innovation_cap)
    noise = noise + (capped - plain)
    if not correlated:
        S = own_term + target_term + noise
        return (
            applied(own_mean, own_cov, own_layout, gain(own_cov @ H_own.T, S), S, innovation, nis),
            applied(target_mean, target_cov, target_layout, gain(target_cov @ H_target.T, S), S, innovation, nis),
            nis,
        )
    results: list[Update | None] = []
    for mean, cov, layout, H, term, other in (
        (own_mean, own_cov, own_layout, H_own, own_term, target_term),
        (target_mean, target_cov, target_layout, H_target, target_term, own_term),
    ):
        best = best_inflated_update(cov, H, term, other, noise, weight)
        if best is None:
            results.append(None)
            continue
        K, posterior, left, _ = best
        results.append(Update(wrap_components(mean + K @ innovation, layout.angles), posterior, left, nis))
    return results[0], results[1], nis


def resolve_cross(low: Snapshot, high: Snapshot) -> Array | None:
    """P_ab (n_a, n_b) at a contact from both snapshots, `low` being the robot with the lower id.

    Equal bases: sigma_a Psi_b^T. If one side applied a later contact than the other, the other's line for that
    contact takes the place of its Psi. None: the correlation can't be recovered.
    """
    if not low.known or not high.known:
        return None
    if low.base == high.base:
        if low.base == NEVER:
            return np.zeros((len(low.belief.mean), len(high.belief.mean)))
        return np.asarray(low.factor @ high.line.T)
    if low.base > high.base:
        line = next((line.matrix for line in high.lines if line.epoch == low.base), None)
        return None if line is None else np.asarray(low.factor @ line.T)
    line = next((line.matrix for line in low.lines if line.epoch == high.base), None)
    return None if line is None else np.asarray(line @ high.factor.T)


class StackedModel:
    """Several relative models of one observer and one subject as one measurement function."""

    def __init__(self, models: Sequence[RelativeModel], sizes: Sequence[int]) -> None:
        self._models = models
        angles, turning, row = [], [], 0
        for model, size in zip(models, sizes):
            angles += [row + index for index in model.angles]
            turning += [(row + index, column, slope) for index, column, slope in model.turning]
            row += size
        self.angles = tuple(angles)
        self.turning = tuple(turning)

    def h(self, state: Array) -> Array:
        return np.concatenate([model.h(state) for model in self._models], axis=-1)

    def jacobian(self, state: Array) -> Array:
        return np.concatenate([model.jacobian(state) for model in self._models], axis=-2)


def stacked(
    measurements: Sequence[Measurement], observer: StateLayout, subject: StateLayout, cov: Array
) -> tuple[RelativeModel | StackedModel, Array, Array]:
    """Measurements of one subject by an observer of covariance `cov` as one: model, z (m,), R (m, m).

    Raises `OutOfViewError`.
    """
    models, parts, noises = [], [], []
    for item in measurements:
        model, z, R = by_angles(relative_model(item, observer, subject), item.z, item.R, cov)
        assert isinstance(model, RelativeModel)
        models.append(model)
        parts.append(z)
        noises.append(R)
    if len(models) == 1:
        return models[0], parts[0], noises[0]
    return StackedModel(models, [len(z) for z in parts]), np.concatenate(parts), block_diagonal(noises)


def block_diagonal(blocks: Sequence[Array]) -> Array:
    """Square blocks on the diagonal of a matrix."""
    if len(blocks) == 1:
        return blocks[0]
    size = sum(len(block) for block in blocks)
    found, row = np.zeros((size, size)), 0
    for block in blocks:
        found[row : row + len(block), row : row + len(block)] = block
        row += len(block)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Contact:
    """What both robots of a pair compute alike from the two snapshots of a contact.

    C_i, C_j (n, m): cross-covariance of either error with the innovation; S (m, m); cross: P_ij before the
    contact (None when unknown). i is the initiator, j the responder.
    """

    C_i: Array
    C_j: Array
    S: Array
    innovation: Array
    cross: Array | None
    nis: float

    @property
    def cross_after(self) -> Array:
        """P_ij after the contact: the same whether i, j or both apply it (E[e_i+ e_j^T] = E[e_i e_j+^T])."""
        assert self.cross is not None
        return np.asarray(self.cross - self.C_i @ np.linalg.solve(self.S, self.C_j.T))


def contact(
    initiator: Snapshot,
    responder: Snapshot,
    initiator_is_low: bool,
    measurements: Sequence[Measurement],
    correlated: bool,
    options: Options,
) -> Contact:
    """Innovation and gains of a pair update (UT-CLAT 3.3, eq. 18-25 with priors in S and full gains).

    The beliefs may be of different states. `correlated` False takes P_ij = 0 (the naive baseline). Raises
    `numpy.linalg.LinAlgError` for beliefs that are not positive definite, and if the subject is out of view.
    """
    P_i, P_j = initiator.belief.cov, responder.belief.cov
    n, m = len(P_i), len(P_j)
    cross: Array | None
    if not correlated:
        cross = np.zeros((n, m))
    elif initiator_is_low:
        cross = resolve_cross(initiator, responder)
    else:
        resolved = resolve_cross(responder, initiator)
        cross = None if resolved is None else resolved.T
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[n:, n:] = P_i, P_j
    if cross is not None:
        joint[:n, n:], joint[n:, :n] = cross, cross.T
        if not is_positive_definite(joint):
            cross = clip_canonical_correlations(P_i, cross, P_j)
            joint[:n, n:], joint[n:, :n] = cross, cross.T
    observer, subject = STATES[initiator.belief.model], STATES[responder.belief.model]
    model, z, R = stacked(measurements, observer, subject, initiator.belief.cov)
    mean = np.concatenate([initiator.belief.mean, responder.belief.mean])
    predicted = observe(
        model.h, model.jacobian, mean, joint, model.angles, options.transform, options.parameters, model.turning
    )
    innovation = _innovation(predicted, z, model.angles)
    S, nis = _capped(innovation, predicted.cov + R, options.innovation_cap)
    return Contact(predicted.cross[:n], predicted.cross[n:], S, innovation, cross, nis)


def pair_update(
    mean: Array, cov: Array, layout: StateLayout, psi: Array, C_own: Array, found: Contact
) -> Update | None:
    """One side's delayed update from a contact: x += Psi C S^-1 nu, P -= Psi C S^-1 C^T Psi^T.

    (mean, cov) is the belief now, psi (n, n) its left factor since the contact, C_own (n, m). None when the
    posterior is not positive definite; skipping is safe.

    `left` = P+ P^-1 is the rule for third parties (UT-CLAT eq. 28): exact for psi = I, an approximation otherwise.
    """
    return applied(mean, cov, layout, gain(psi @ C_own, found.S), found.S, found.innovation, found.nis)

