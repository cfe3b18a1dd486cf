"""Joint localization and target tracking from what neighbours tell once per round (JLATT; Su 2022, chapter 2).

A robot is corrected by the peers and targets it sees (eq. 2.8-2.11), and its belief of a target by the beliefs of its
neighbours and by where the sensors of all place it (eq. 2.12-2.15). Nobody keeps correlations: all that may be
correlated is weighed by covariance intersection (`agent.estimation.weighing`). With the rule `split_ci` only beliefs
are; the noise of a sensor is independent of them:

    P1 = P / w,  K = P1 H^T (H P1 H^T + R + D / (1 - w))^-1,  P+ = (I - K H) P1

for each correction in the order given, where D is the part of the innovation's covariance that stems from another
belief. w is the best on a grid, and a correction is left out if the trace would grow.

Everything is linearized at the prior, so covariances depend on what was measured by R alone: planners predict them with
the kernels that the estimates are made with. Where the thesis averages headings or inverts informations of less than
full rank, increments of the prior are used, which are the same where its formulas exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import inverse, symmetrize, wrap_components
from agent.estimation.observation import RelativeModel
from agent.estimation.track_start import seen_place
from agent.estimation.weighing import Mask, Rule, weighed
from agent.settings import RoundWeights

Array = NDArray[np.float64]

PLACING = ("range_bearing", "vector")
"""Kinds of measurement that tell a place without knowing an altitude well."""

GRID = np.linspace(0.04, 0.96, 12)
"""Candidate weights of a split intersection; the trace is within a few percent of that of a finer grid."""
GRID.flags.writeable = False
BY_OWN, BY_OTHER = 1.0 / GRID, 1.0 / (1.0 - GRID)

RING_RAD = 0.2
"""Deviation of a heading from which on the places where something may be seen are a ring, not a line across."""

FLATTEST = 1e-9
"""A measurement whose Jacobian in x, y has a smaller determinant, relative to its rows, tells no place."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where a target is by the sensors of one robot: place (d,), its error's parts `sensor` and `pose`, both (d, d).

    The parts are independent of each other. `sensor` is new at each instant, `pose` is correlated with beliefs.
    """

    place: Array
    sensor: Array
    pose: Array

    def used(self) -> Placed:
        """The same once its sensor's noise may be in a belief: nothing of it is new any more."""
        return Placed(self.place, np.zeros_like(self.sensor), self.pose + self.sensor)


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A measurement z (m,), R (m, m) of something of belief mean (k,), cov (k, k); (0,), (0, 0) of a landmark.

    `dependent`: whether the other belief may be correlated with the own one.
    """

    model: RelativeModel
    z: Array
    R: Array
    mean: Array
    cov: Array
    dependent: bool = True


def target_correction(
    model: RelativeModel,
    own_mean: Array,
    own_cov: Array,
    believed: Array,
    z: Array,
    R: Array,
    altitude_variance: float = 0.0,
    exact: bool = True,
) -> Placed | None:
    """Where (2,) a target is by one measurement z (m,), R (m, m) of a robot of belief (n,), (n, n) (Su 2022, eq. 2.12).

    believed (k,) is what the robot believes of the target. A target in space is taken to be at the altitude believed,
    whose variance is part of `pose`. `exact`: the measurement is converted to a place, and linearized there; without,
    it is linearized at the place believed, as printed. None if it does not determine the place.
    """
    observer, subject = model.observer, model.subject
    if model.kind not in PLACING or observer.heading is None or model.landmark is not None:
        return None
    joint = np.concatenate([own_mean, believed])
    n, altitude = len(own_mean), subject.altitude
    place = joint[n : n + 2]
    if exact:
        height = np.asarray(0.0 if altitude is None else believed[altitude])
        place[:] = seen_place(model, own_mean, height, z)
        if not np.isfinite(place).all():
            return None
    H = model.jacobian(joint)
    by_place = H[:, n : n + 2]
    if not abs(np.linalg.det(by_place)) > FLATTEST * np.prod(np.linalg.norm(H, axis=1)):
        return None
    G = np.linalg.inv(by_place)
    if not exact:
        place += G @ wrap_components(z - model.h(joint), model.angles)
    pose = H[:, :n] @ own_cov @ H[:, :n].T
    if altitude is not None:
        by_altitude = H[:, n + altitude]
        pose += altitude_variance * np.outer(by_altitude, by_altitude)
    pose = G @ pose @ G.T
    turned = own_cov[observer.heading, observer.heading]
    if turned > RING_RAD**2:
        # The mean square of an arc's second order, d delta^2 / 2, for a normal delta.
        away = place - own_mean[:2]
        pose += 0.75 * turned**2 * np.outer(away, away)
    return Placed(place.copy(), symmetrize(G @ R @ G.T), symmetrize(pose))


def robot_update(
    mean: Array, cov: Array, angles: tuple[int, ...], detections: Sequence[Detection], weights: RoundWeights
) -> tuple[Array, Array]:
    """Own belief (n,), (n, n) after what the robot has seen at its instant (Su 2022, eq. 2.8-2.11).

    `angles` are the wrapped components of the state. A robot that hardly knows its heading gives vectors and pixels as
    angles, see `agent.estimation.wide_heading`. Raises `OutOfViewError` of the models.
    """
    return _corrected(mean, cov, angles, [_linearized(mean, item) for item in detections], weights)


def target_update(
    mean: Array,
    cov: Array,
    angles: tuple[int, ...],
    others: Sequence[tuple[Array, Array]],
    placed: Sequence[Placed],
    weights: RoundWeights,
) -> tuple[Array, Array]:
    """Own belief (n,), (n, n) of a target after those of neighbours and all corrections (Su 2022, eq. 2.13-2.15).

    The state begins with x, y, which is what corrections are used for. Neighbours' means are taken on the own side of
    the half turn. Raises `numpy.linalg.LinAlgError` if a neighbour's covariance is singular.
    """
    if others:
        informations = np.array([inverse(found) for _, found in others])
        away = np.array([wrap_components(found - mean, angles) for found, _ in others])
        cov, shares = _together(cov, informations, weights)
        pulled = np.einsum("j,jab,jb->a", shares[1:], informations, away)
        mean = wrap_components(mean + cov @ pulled, angles)
    H = np.eye(2, len(mean))
    found = [_Linear(H, item.place[:2] - mean[:2], item.sensor[:2, :2], item.pose[:2, :2]) for item in placed]
    return _corrected(mean, cov, angles, found, weights)


def predicted_robot_cov(
    cov: Array, H: Array, noise: Array, other: Array, seen: Mask, weights: RoundWeights
) -> Array:
    """Covariances (c, n, n) of the update of a robot, for c candidates of m detections each.

    cov (c, n, n)        before the update
    H (c, m, k, n)       derivative of what is measured by the own state, of either sign
    noise (c, m, k, k)   of the sensor
    other (c, m, k, k)   what the belief of the other adds to it; (m, k, k) of all candidates alike
    seen (c, m)          which detections there are
    """
    if weights != "split_ci":
        return weighed(cov, _informations(H, noise + other), seen, weights)[0]
    lead = np.broadcast_shapes(cov.shape[:-2], seen.shape[:-1])
    m, k = H.shape[-3:-1]
    cov, other = np.broadcast_to(cov, (*lead, *cov.shape[-2:])), np.broadcast_to(other, (*lead, m, k, k))
    for index in range(m):
        if seen[..., index].any():
            found, _ = _split_step(cov, H[..., index, :, :], noise[..., index, :, :], other[..., index, :, :])
            cov = np.where(seen[..., index, None, None], found, cov)
    return cov


def predicted_target_cov(priors: Array, sensor: Array, pose: Array, seen: Mask, weights: RoundWeights) -> Array:
    """Covariances (c, n, n) of the update of a target, for c candidates of m corrections each.

    priors (..., j, n, n) of the own belief and then the others'; sensor, pose (c, m, 2, 2) parts of the corrections;
    seen (c, m). The state begins with x, y.
    """
    cov = priors[..., 0, :, :]
    if priors.shape[-3] > 1:
        cov, _ = _together(cov, np.asarray(np.linalg.inv(priors[..., 1:, :, :])), weights)
    H = np.broadcast_to(np.eye(2, cov.shape[-1]), (*sensor.shape[:-1], cov.shape[-1]))
    return predicted_robot_cov(cov, H, sensor, pose, seen, weights)


@dataclass(slots=True, eq=False)
class _Linear:
    """A correction e = H x + sensor's noise + error of others: H (m, n), e (m,), noise and other (m, m)."""

    H: Array
    e: Array
    noise: Array
    other: Array


def _linearized(mean: Array, item: Detection) -> _Linear:
    joint, n = np.concatenate([mean, item.mean]), len(mean)
    H = item.model.jacobian(joint)
    e = wrap_components(item.z - item.model.h(joint), item.model.angles)
    other = symmetrize(H[:, n:] @ item.cov @ H[:, n:].T)
    if item.dependent:
        return _Linear(H[:, :n], e, item.R, other)
    return _Linear(H[:, :n], e, item.R + other, np.zeros_like(other))


def _corrected(
    mean: Array, cov: Array, angles: tuple[int, ...], corrections: list[_Linear], weights: RoundWeights
) -> tuple[Array, Array]:
    """A belief (n,), (n, n) after corrections that were all linearized at it."""
    moved = np.zeros(len(mean))
    if weights == "split_ci":
        for item in corrections:
            cov, K = _split_step(cov, item.H, item.noise, item.other)
            moved += K @ (item.e - item.H @ moved)
    elif corrections:
        informations = np.array([_informations(item.H, item.noise + item.other) for item in corrections])
        cov, shares = weighed(cov, informations, np.ones(len(corrections), dtype=bool), weights)
        pulled = [item.H.T @ np.linalg.solve(item.noise + item.other, item.e) for item in corrections]
        moved = cov @ (shares[1:] @ np.array(pulled))
    return wrap_components(mean + moved, angles), cov


def _together(cov: Array, informations: Array, weights: RoundWeights) -> tuple[Array, Array]:
    """Own covariance (..., n, n) fused with whole beliefs (..., j, n, n), and the weights (..., 1 + j)."""
    rule: Rule = "trace" if weights == "split_ci" else weights
    return weighed(cov, informations, np.ones(informations.shape[:-2], dtype=bool), rule, staged=False)


def _informations(H: Array, noise: Array) -> Array:
    """H^T R^-1 H (..., n, n)."""
    return symmetrize(H.swapaxes(-1, -2) @ np.linalg.solve(noise, H))


def _split_step(cov: Array, H: Array, noise: Array, other: Array) -> tuple[Array, Array]:
    """Covariance (..., n, n) and gain (..., n, m) of one correction; what lowers no trace has no gain.

    cov (..., n, n), H (..., m, n), noise (..., m, m), other (..., m, m); where that is zero, the update is Kalman's.
    """
    cross = cov @ H.swapaxes(-1, -2)
    alone = np.asarray(~other.any(axis=(-2, -1)))[..., None]
    by_own, by_other = np.where(alone, 1.0, BY_OWN), np.where(alone, 1.0, BY_OTHER)
    S = by_own[..., None, None] * (H @ cross)[..., None, :, :] + noise[..., None, :, :]
    S += by_other[..., None, None] * other[..., None, :, :]
    S_inverse = _inverse(S)
    # tr(K S K^T) = tr(S^-1 C^T C) / w^2 spares the (n, n) matrices of all but the best.
    square = cross.swapaxes(-1, -2) @ cross
    before = np.trace(cov, axis1=-2, axis2=-1)
    traces = by_own * before[..., None] - by_own**2 * np.sum(S_inverse * square[..., None, :, :], axis=(-2, -1))
    best = np.argmin(traces, axis=-1)
    w = np.where(alone[..., 0], 1.0, BY_OWN[best])[..., None, None]
    chosen = np.arange(best.size) * len(GRID) + best.ravel()
    K = w * cross @ S_inverse.reshape(-1, *S.shape[-2:])[chosen].reshape(*best.shape, *S.shape[-2:])
    after = symmetrize(w * (cov - K @ cross.swapaxes(-1, -2)))
    used = (traces.min(axis=-1) < before)[..., None, None]
    return np.where(used, after, cov), np.where(used, K, 0.0)


def _inverse(S: Array) -> Array:
    """S^-1 of symmetric positive definite matrices (..., m, m); numpy's is slow for many that are small."""
    if S.shape[-1] != 2:
        return np.asarray(np.linalg.inv(S))
    found = np.empty_like(S)
    found[..., 0, 0], found[..., 1, 1] = S[..., 1, 1], S[..., 0, 0]
    found[..., 0, 1] = found[..., 1, 0] = -S[..., 0, 1]
    found /= (S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] ** 2)[..., None, None]
    return found
