"""Bearing-only consensus filters that know what their sensors do: noise that grows with range, and a true covariance.

Against the published ones (`agent.estimation.triangulation`):

1. A direction of noise sigma places the target to r sigma across the ray at range r, and the observer's own place is
   uncertain: N = (r sigma)^2 I + P Cov(s) P across it. r^2 is the square of the predicted range and of its spread.
2. Where the predicted direction h is near the measured one g, the residual is that of the tangent plane,
   r P_h g / (h^T g), with H = P_h [I, -tau I]. The pseudo-linear one multiplies noise by noise, and is biased towards
   the observers; but it converges from anywhere, and is taken elsewhere.
3. The covariance is that of a target with white acceleration of density q, which forgetting only imitates.
4. Directions far off the prediction, on the scale of its own spread, count less, but never nothing: a robot that has
   lost the target can find it again. Where directions cross and all are far off, the prediction is what is doubted,
   and they are weighed again by how near they pass to where they come to. If a share q of them is off even then, that
   place is taken to be wrong with probability q^2, and the covariance is that of a mixture with the prior.
5. Late directions are used at their own instant, q tau^3 / 3 less sure; late predictions are moved with their noise.
6. The first direction starts the estimate on its ray, not at the observer, where no direction is predicted. Directions
   that cross are linearized anew where they come to; those of one ray are not, that would invent a range.

kcf_plus       neighbours tell means; consensus moves the mean and claims no information (12 numbers)
icf_plus       neighbours tell means and covariances, whose equal-weight intersection is the prior (33 numbers)
central_plus   all directions in one place, no consensus: the bound
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import symmetrize
from agent.estimation.sights import Sight, Sights, Told, crosses, normal_equations, projection, stack_sights, stack_told
from agent.estimation.triangulation import (
    BearingFilter,
    Collected,
    CrossingPoint,
    EstimateAveraging,
    HybridConsensus,
    MeasurementSharing,
    TrackState,
    Triangulation,
    moved,
    transition,
)

Array = NDArray[np.float64]
Kind = Literal["stt", "cmkf", "cikf", "hcmci", "tkf", "ckf", "kcf_plus", "icf_plus", "central_plus"]

TANGENT_RAD = 0.5
"""Angle between predicted and measured directions below which a residual is that of the tangent plane."""

ROUNDS = 3
"""How often directions that cross are linearized; more change nothing."""

CROSSING = 4.0
"""How far, in variances of a direction, directions must cross to be linearized anew."""

DOUBTED, LOOSENED = 0.1, 4.0
"""The covariance of a prediction grows LOOSENED times where no direction counts more than DOUBTED."""

OFF = 0.25
"""What a direction counts that is off: `gate` deviations."""

LATENESS_S = 0.2
"""Age of a prediction told at which it counts exp(-1)."""


def acceleration_noise(dt: Array | float, q: float) -> Array:
    """Q (..., 6, 6) of white acceleration of density q [m^2/s^3] over dt (...) [s]."""
    dt = np.asarray(dt, dtype=np.float64)
    Q = np.zeros((*dt.shape, 6, 6))
    Q[..., range(3), range(3)] = (q * dt**3 / 3.0)[..., None]
    Q[..., range(3), range(3, 6)] = Q[..., range(3, 6), range(3)] = (q * dt**2 / 2.0)[..., None]
    Q[..., range(3, 6), range(3, 6)] = (q * dt)[..., None]
    return Q


@dataclass(frozen=True, slots=True)
class _Covariance:
    """What the filters of true covariance share.

    q                  density of the target's white acceleration [m^2/s^3]
    start_m, start_mps deviation of place and velocity before any direction
    ranges_m           least and largest range that noise is taken at
    gate, floor        angle, in deviations, at which a direction counts a quarter; what it counts at least
    """

    q: float = 5.0
    start_m: float = 30.0
    start_mps: float = 5.0
    ranges_m: tuple[float, float] = (5.0, 100.0)
    gate: float = 3.0
    floor: float = 0.01

    def start(self, place: Array) -> TrackState:
        place = np.asarray(place, dtype=np.float64)
        cov = np.diag([self.start_m**2] * 3 + [self.start_mps**2] * 3)
        mean = np.concatenate([place, np.zeros_like(place)], axis=-1)
        return TrackState(mean, np.broadcast_to(cov, (*mean.shape, 6)).copy())

    def belief(self, state: TrackState) -> tuple[Array, Array]:
        return state.mean, state.matrix

    def _aged(self, mean: Array, cov: Array, dt: Array | float) -> TrackState:
        A = transition(dt)
        return TrackState(moved(mean, dt), A @ cov @ A.swapaxes(-1, -2) + acceleration_noise(dt, self.q))

    def _seen(self, prior: TrackState, sights: Sights) -> TrackState:
        """A prior corrected by directions."""
        prior = self._begun(prior, sights)
        S, y, counts = _information(prior, prior, sights, self)
        again = crosses(sights, noises=CROSSING)
        doubted = counts.max(axis=-1, initial=0.0) < DOUBTED
        lost = again & doubted & (_position_variance(prior.matrix) < 3.0 * self.start_m**2)
        if lost.any():
            prior = TrackState(prior.mean, np.where(lost[..., None, None], LOOSENED * prior.matrix, prior.matrix))
            S, y, _ = _information(prior, prior, sights, self)
        known = np.asarray(np.linalg.inv(prior.matrix))
        state = _corrected(prior, known, S, y)
        for _ in range(ROUNDS - 1 if again.any() else 0):
            S, y, counts = _information(prior, state, sights, self)
            new = _corrected(prior, known, S, y)
            mean = np.where(again[..., None], new.mean, state.mean)
            state = TrackState(mean, np.where(again[..., None, None], new.matrix, state.matrix))
        # Those that are off may be the true ones, and where the others come to be wrong: a mixture with the prior then.
        wrong = np.where(again, (sights.used & (counts < OFF)).sum(axis=-1) / np.maximum(sights.count(), 1.0), 0.0)
        return TrackState(state.mean, state.matrix + (wrong**2)[..., None, None] * prior.matrix)

    def _begun(self, prior: TrackState, sights: Sights) -> TrackState:
        """The prior; where nothing at all is known of the place, moved onto the first ray."""
        least = np.linalg.eigvalsh(prior.matrix[..., :3, :3])[..., 0]
        begins = (least > (0.5 * self.start_m) ** 2) & sights.used.any(axis=-1)
        if not begins.any():
            return prior
        first = np.argmax(sights.used, axis=-1)[..., None, None]
        ahead = np.take_along_axis(sights.place + self.start_m * sights.direction, first, axis=-2)[..., 0, :]
        place = np.where(begins[..., None], ahead, prior.mean[..., :3])
        return TrackState(np.concatenate([place, prior.mean[..., 3:]], axis=-1), prior.matrix)


def _position_variance(cov: Array) -> Array:
    return np.asarray(np.trace(cov[..., :3, :3], axis1=-2, axis2=-1))


def _corrected(prior: TrackState, known: Array, S: Array, y: Array) -> TrackState:
    """A prior of information `known` after normal equations S, y."""
    cov = symmetrize(np.asarray(np.linalg.inv(known + S)))
    pull = y - (S @ prior.mean[..., None])[..., 0]
    return TrackState(prior.mean + (cov @ pull[..., None])[..., 0], cov)


def _information(prior: TrackState, at: TrackState, sights: Sights, of: _Covariance) -> tuple[Array, Array, Array]:
    """S (..., 6, 6) and S x (..., 6) of directions, linearized and weighed at `at`; what each counts (..., m).

    The noise is that at the prior's range, wherever it is linearized. What counts is what is near on the scale of the
    spread of `at`: a vague prior lets anything pass, and where directions cross they tell which of them is false.
    """
    there = moved(at.mean[..., None, :], -sights.age)[..., :3] - sights.place
    away = np.linalg.norm(there, axis=-1)
    g = sights.direction / np.linalg.norm(sights.direction, axis=-1)[..., None]
    # An observer that takes the target to be where itself is predicts no direction.
    h = np.where(away[..., None] > 0.0, there / np.maximum(away, np.finfo(float).tiny)[..., None], g)
    r = np.clip(np.sqrt(away**2 + _position_variance(prior.matrix)[..., None]), *of.ranges_m)
    cosine = np.sum(h * g, axis=-1)
    angle = np.arctan2(np.linalg.norm(np.cross(h, g), axis=-1), cosine)
    tangent = angle < TANGENT_RAD
    P = projection(np.where(tangent[..., None], h, g))
    spread = np.trace(P @ at.matrix[..., None, :3, :3], axis1=-2, axis2=-1) / 2.0
    off = angle / (of.gate * np.sqrt(sights.sigma**2 + spread / r**2))
    counts = np.maximum((1.0 + off**2) ** -2, of.floor)
    across = (r * sights.sigma) ** 2 + of.q * sights.age**3 / 3.0
    N = across[..., None, None] * np.eye(3) + P @ sights.place_cov @ P
    W = counts[..., None, None] * (P @ np.linalg.inv(N) @ P)
    # Where the ray meets the tangent plane of the prediction, or (pseudo-linear) any place of the ray.
    meets = away / np.where(tangent, cosine, 1.0)
    towards = np.where(tangent[..., None], sights.place + meets[..., None] * g, sights.place)
    S, y = normal_equations(sights, W, towards)
    return S, y, np.where(sights.used, counts, 0.0)


@dataclass(frozen=True, slots=True)
class MeanConsensus(_Covariance):
    """`kcf_plus`: the prior moves by `pull` towards the mean of itself and what is told; what is late counts less."""

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = True
    tells_cov: ClassVar[bool] = False

    pull: float = 0.5

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        return Told(moved(state.mean, dt))

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        lead = state.mean.shape[:-1]
        prior = self._aged(state.mean, state.matrix, dt)
        others, _, age, used = stack_told(told, lead)
        weight = (used * np.exp(-age / LATENESS_S))[..., None]
        away = weight * (moved(others, age) - prior.mean[..., None, :])
        mean = prior.mean + self.pull * away.sum(axis=-2) / (1.0 + weight.sum(axis=-2))
        return self._seen(TrackState(mean, prior.matrix), stack_sights(sights, lead))


@dataclass(frozen=True, slots=True)
class Intersection(_Covariance):
    """`icf_plus`: the prior is the intersection of own and neighbours' predictions; what is late counts less."""

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = True
    tells_cov: ClassVar[bool] = True

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        prior = self._aged(state.mean, state.matrix, dt)
        return Told(prior.mean, prior.matrix)

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        lead = state.mean.shape[:-1]
        prior = self._aged(state.mean, state.matrix, dt)
        mean, cov, age, used = stack_told(told, lead)
        if cov is not None:
            late = self._aged(mean, cov, age)
            weight = (used * np.exp(-age / LATENESS_S))[..., None]
            total = 1.0 + weight.sum(axis=-2)
            Y = np.asarray(np.linalg.inv(late.matrix))
            away = (Y @ (late.mean - prior.mean[..., None, :])[..., None])[..., 0]
            together = np.linalg.inv(prior.matrix) + (weight[..., None] * Y).sum(axis=-3)
            matrix = symmetrize(np.asarray(np.linalg.inv(together / total[..., None])))
            pull = (weight * away).sum(axis=-2) / total
            prior = TrackState(prior.mean + (matrix @ pull[..., None])[..., 0], matrix)
        return self._seen(prior, stack_sights(sights, lead))


@dataclass(frozen=True, slots=True)
class Central(_Covariance):
    """`central_plus`: all directions in one place."""

    tells_sights: ClassVar[bool] = True
    tells_mean: ClassVar[bool] = False
    tells_cov: ClassVar[bool] = False

    def predicted(self, state: TrackState, dt: float, sights: Sequence[Sight] = ()) -> Told:
        return Told(moved(state.mean, dt))

    def step(self, state: TrackState, dt: float, sights: Sequence[Sight], told: Sequence[Told]) -> TrackState:
        lead = state.mean.shape[:-1]
        return self._seen(self._aged(state.mean, state.matrix, dt), stack_sights(sights, lead))


FILTERS: Mapping[str, type[BearingFilter]] = {
    "stt": Triangulation,
    "cmkf": MeasurementSharing,
    "cikf": EstimateAveraging,
    "hcmci": HybridConsensus,
    "tkf": CrossingPoint,
    "ckf": Collected,
    "kcf_plus": MeanConsensus,
    "icf_plus": Intersection,
    "central_plus": Central,
}


def build(kind: Kind, options: Mapping[str, Any] | None = None) -> BearingFilter:
    """The filter of a kind. Raises ValueError naming a kind or an option that does not exist."""
    if kind not in FILTERS:
        raise ValueError(f"{kind!r} is no bearing filter; there are {', '.join(get_args(Kind))}")
    try:
        return FILTERS[kind](**(options or {}))
    except TypeError as error:
        raise ValueError(f"{kind}: {error}") from None
