"""Spatial-temporal triangulation (STT 2023) and the distributed filters it was compared with, as published.

All take a direction as a pseudo-linear measurement z = P_g s = P_g p + noise whose noise is said to be the same at any
range, R = r1 I with r1 = scale * sigma^2: `scale` is what the published simulations were tuned to. Their sigma is the
deviation of a rotation about an axis g x u, u random of unit length, which is not normalised: sqrt(3) times the
deviation per tangent axis, so here r1 = 3 scale sigma_rad^2.

stt     least squares with forgetting over directions and neighbours' predictions (eq. 10-20)
cmkf    Kalman filter of own and neighbours' directions
cikf    Kalman filter of own directions; means and covariances averaged with neighbours' afterwards
hcmci   means and covariances averaged first, then a Kalman filter of own and neighbours' directions
tkf     Kalman filter of the point where own and neighbours' directions cross
ckf     centralized: Kalman filter of all directions, which somebody must collect

None of their matrices is the covariance of its error. Process noise is per 0.1 s and scaled to the step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from agent.estimation.sights import Sight, Sights, Told, normal_equations, projection, stack_sights, stack_told

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

AXIS_SHARE = 3.0
"""(published sigma / sigma per tangent axis)^2."""

STEP_S = 0.1
"""Step that published process noise is per."""

FLATTEST = 1e-6
"""Smallest eigenvalue of sum P_g from which on directions are taken to cross."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """What a filter keeps: mean (..., 6), matrix (..., 6, 6), which is the information of `stt`, others' covariance."""

    mean: Array
    matrix: Array


class BearingFilter(Protocol):
    """A filter of one target on one robot. Leading axes are trials, robots, or none.

    tells_sights        whether neighbours need this robot's directions
    tells_mean, tells_cov   whether they need its mean, its covariance
    """

    tells_sights: ClassVar[bool]
    tells_mean: ClassVar[bool]
    tells_cov: ClassVar[bool]

    def start(self, place: Array) -> TrackState:
        """State before any direction; place (..., 3) is the robot's own [m]."""
        ...

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        """What neighbours are told at the instant dt [s] after `state`; `cikf` uses the own ones of `sights` for it."""
        ...

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        """State dt [s] later, after own and heard sights and what neighbours told. Raises ValueError, see `sights`."""
        ...

    def belief(self, state: TrackState) -> tuple[Array, Array]:
        """mean (..., 6) and cov (..., 6, 6) as the filter claims it."""
        ...


def numbers_told(kind: BearingFilter) -> int:
    """How many numbers a robot broadcasts per step: place and direction 6, mean 6, packed covariance 21."""
    return 6 * kind.tells_sights + 6 * kind.tells_mean + 21 * kind.tells_cov


def transition(dt: Array | float) -> Array:
    """A (..., 6, 6) of constant velocity over dt (...) [s]."""
    dt = np.asarray(dt, dtype=np.float64)
    A = np.zeros((*dt.shape, 6, 6))
    A[..., range(6), range(6)] = 1.0
    A[..., range(3), range(3, 6)] = dt[..., None]
    return A


def moved(mean: Array, dt: Array | float) -> Array:
    """Means (..., 6) dt (...) [s] later."""
    place = mean[..., :3] + np.asarray(dt)[..., None] * mean[..., 3:]
    return np.concatenate([place, np.broadcast_to(mean[..., 3:], place.shape)], axis=-1)


def fading(dt: float, gamma1: float, gamma2: float) -> float:
    """f of a step of dt [s]: gamma2 / ((1 + gamma1) ||A||), the largest singular value of the transition (eq. 12)."""
    return gamma2 / ((1.0 + gamma1) * (0.5 * dt + math.sqrt(1.0 + 0.25 * dt * dt)))


def pseudo_linear(sights: Sights, scale: float) -> tuple[Array, Array]:
    """sum H^T R^-1 H (..., 6, 6) and sum H^T R^-1 z (..., 6) of sights, R = 3 scale sigma^2 I (STT 2023, eq. 8).

    P^T P and not P: directions need not be of unit length.
    """
    P = projection(sights.direction)
    weight = P @ P / (AXIS_SHARE * scale * sights.sigma**2)[..., None, None]
    return normal_equations(sights, weight, sights.place)


def _at_place(place: Array, matrix: Array) -> TrackState:
    place = np.asarray(place, dtype=np.float64)
    mean = np.concatenate([place, np.zeros_like(place)], axis=-1)
    return TrackState(mean, np.broadcast_to(matrix, (*mean.shape, 6)).copy())


def _updated(mean: Array, cov: Array, S: Array, y: Array) -> TrackState:
    """Correction of a prior by normal equations S, y: P = (P-^-1 + S)^-1, x = x- + P (y - S x-)."""
    cov = np.asarray(np.linalg.inv(np.linalg.inv(cov) + S))
    return TrackState(mean + _times(cov, y - _times(S, mean)), cov)


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _mean_of(values: Array, used: Mask, own: Array | None = None) -> Array:
    """Mean (..., n) of the used ones of (..., m, n) and `own` (..., n), which is there always."""
    total = (used[..., None] * values).sum(axis=-2)
    count = used.sum(axis=-1)[..., None].astype(np.float64)
    if own is not None:
        total, count = total + own, count + 1.0
    return np.asarray(total / np.maximum(count, 1.0))


@dataclass(frozen=True, slots=True)
class Triangulation:
    """STT (eq. 13-20): information Y = f A^-T Y A^-1 + c sum H^T R^-1 H + I, of directions weighed by c and consensus.

    memory_s   forgetting as exp(-dt / memory_s) instead of `fading`, so that it does not depend on the rate
    """

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = True
    tells_cov: ClassVar[bool] = False

    scale: float = 10.0
    c: float = 2.0
    gamma1: float = 6.25
    gamma2: float = 6.0
    memory_s: float | None = None

    def start(self, place: Array) -> TrackState:
        return _at_place(place, np.eye(6))

    def forgetting(self, dt: float) -> float:
        """f of a step of dt [s]."""
        return fading(dt, self.gamma1, self.gamma2) if self.memory_s is None else math.exp(-dt / self.memory_s)

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        return Told(moved(state.mean, dt))

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        lead = state.mean.shape[:-1]
        mean, back = moved(state.mean, dt), transition(-dt)
        S, y = pseudo_linear(stack_sights(sights, lead), self.scale)
        others, _, age, used = stack_told(told, lead)
        consensus = _mean_of(moved(others, age), used, mean) - mean
        Y = self.forgetting(dt) * back.T @ state.matrix @ back + self.c * S + np.eye(6)
        e = self.c * (y - _times(S, mean)) + consensus
        return TrackState(mean + np.asarray(np.linalg.solve(Y, e[..., None]))[..., 0], Y)

    def belief(self, state: TrackState) -> tuple[Array, Array]:
        return state.mean, np.asarray(np.linalg.inv(state.matrix))


@dataclass(frozen=True, slots=True)
class _Kalman:
    """What the published Kalman filters share: x = [place; 0], P = I at first, Q = diag(qp I, qv I) per 0.1 s."""

    scale: float
    qp: float
    qv: float

    def start(self, place: Array) -> TrackState:
        return _at_place(place, np.eye(6))

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        return Told(moved(state.mean, dt))

    def belief(self, state: TrackState) -> tuple[Array, Array]:
        return state.mean, state.matrix

    def _prior(self, state: TrackState, dt: float, times: Array | float = 1.0) -> TrackState:
        """State dt later, with `times` (...) the process noise."""
        A = transition(dt)
        Q = np.diag([self.qp] * 3 + [self.qv] * 3) * (dt / STEP_S)
        noise = np.asarray(times, dtype=np.float64)[..., None, None] * Q
        return TrackState(moved(state.mean, dt), A @ state.matrix @ A.T + noise)


@dataclass(frozen=True, slots=True)
class MeasurementSharing(_Kalman):
    """CMKF: directions of the robot and its neighbours; estimates are not exchanged."""

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = False
    tells_cov: ClassVar[bool] = False

    scale: float = 26.5483
    qp: float = 0.1325
    qv: float = 0.2390

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        prior = self._prior(state, dt)
        S, y = pseudo_linear(stack_sights(sights, state.mean.shape[:-1]), self.scale)
        return _updated(prior.mean, prior.matrix, S, y)


@dataclass(frozen=True, slots=True)
class EstimateAveraging(_Kalman):
    """CIKF: own directions only, then `own` of the own posterior and the rest of the mean of neighbours'.

    Neighbours are told the posterior of own directions at their instant, before it is averaged.
    """

    tells_sights: ClassVar[bool] = False
    tells_mean: ClassVar[bool] = True
    tells_cov: ClassVar[bool] = True

    scale: float = 23.1375
    qp: float = 0.8987
    qv: float = 0.2988
    own: float = 0.25

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        posterior = self._alone(state, dt, sights)
        return Told(posterior.mean, posterior.matrix)

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        return _averaged(self._alone(state, dt, sights), told, self.own, own_again=False)

    def _alone(self, state: TrackState, dt: float, sights: Sequence[Sight]) -> TrackState:
        prior = self._prior(state, dt)
        own = [item for item in sights if item.own]
        S, y = pseudo_linear(stack_sights(own, state.mean.shape[:-1]), self.scale)
        return _updated(prior.mean, prior.matrix, S, y)


@dataclass(frozen=True, slots=True)
class HybridConsensus(_Kalman):
    """HCMCI-KF: posteriors of the last step averaged (`own` and the mean of all), then all directions, scaled by N + 1.

    Neighbours are told the last posterior moved to the instant, without process noise.
    """

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = True
    tells_cov: ClassVar[bool] = True

    scale: float = 1.9219
    qp: float = 0.0542
    qv: float = 0.0804
    own: float = 0.25

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        prior = self._prior(state, dt, 0.0)
        return Told(prior.mean, prior.matrix)

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        lead = state.mean.shape[:-1]
        size = np.zeros(lead) + 1.0 + sum(np.asarray(item.used, dtype=np.float64) for item in told)
        prior = _averaged(self._prior(state, dt, 0.0), told, self.own, own_again=True)
        noise = self._prior(replace(state, matrix=np.zeros((6, 6))), dt, size).matrix
        S, y = pseudo_linear(stack_sights(sights, lead), self.scale)
        return _updated(prior.mean, prior.matrix + noise, S / size[..., None, None], y / size[..., None])


def _averaged(state: TrackState, told: Sequence[Told], own: float, own_again: bool) -> TrackState:
    """`own` of a state and the rest of the mean of what was told, the state itself among it if `own_again`."""
    mean, cov, age, used = stack_told(told, state.mean.shape[:-1])
    if cov is None:
        return state
    A = transition(age)
    cov, flat = A @ cov @ A.swapaxes(-1, -2), (*state.mean.shape[:-1], 36)
    weight = np.where(used.any(axis=-1), 1.0 - own, 0.0)[..., None]
    shared = _mean_of(moved(mean, age), used, state.mean if own_again else None)
    mine = state.matrix.reshape(flat)
    both = _mean_of(cov.reshape(*used.shape, 36), used, mine if own_again else None)
    matrix = ((1.0 - weight) * mine + weight * both).reshape(state.matrix.shape)
    return TrackState((1.0 - weight) * state.mean + weight * shared, matrix)


@dataclass(frozen=True, slots=True)
class CrossingPoint(_Kalman):
    """TKF: the point p = (sum P_g)^-1 sum P_g s where directions cross, as a measurement of the place with R = r1 I.

    What does not cross is left out. The age of a direction is that of its place along the velocity estimated.
    """

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = False
    tells_cov: ClassVar[bool] = False

    scale: float = 26.5483
    qp: float = 0.1325
    qv: float = 0.2390

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        prior, seen = self._prior(state, dt), stack_sights(sights, state.mean.shape[:-1])
        P = np.where(seen.used[..., None, None], projection(seen.direction), 0.0)
        since = seen.place + seen.age[..., None] * prior.mean[..., None, 3:]
        total, pull = P.sum(axis=-3), (P @ since[..., None])[..., 0].sum(axis=-2)
        crosses = np.linalg.eigvalsh(total)[..., 0] > FLATTEST
        point = _times(np.asarray(np.linalg.inv(np.where(crosses[..., None, None], total, np.eye(3)))), pull)
        r1 = AXIS_SHARE * self.scale * _mean_of(seen.sigma[..., None] ** 2, seen.used)[..., 0]
        S, y = np.zeros_like(prior.matrix), np.zeros_like(prior.mean)
        weight = crosses / np.maximum(r1, np.finfo(float).tiny)
        S[..., range(3), range(3)] = weight[..., None]
        y[..., :3] = weight[..., None] * point
        return _updated(prior.mean, prior.matrix, S, y)


@dataclass(frozen=True, slots=True)
class Collected(_Kalman):
    """CKF: all n directions in one place, as published: S / n, y / n and n Q. It starts at the mean of observers."""

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = False
    tells_cov: ClassVar[bool] = False

    scale: float = 1.354101
    qp: float = 0.000325
    qv: float = 0.000696

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        seen = stack_sights(sights, state.mean.shape[:-1])
        n = np.maximum(seen.count(), 1.0)
        prior = self._prior(state, dt, n)
        S, y = pseudo_linear(seen, self.scale)
        return _updated(prior.mean, prior.matrix, S / n[..., None, None], y / n[..., None])
