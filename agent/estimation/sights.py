"""What bearing-only filters are given: directions from known places, and what neighbours tell of their estimates.

The state of a target is x = [p; v] (6,), m and m/s, in a Cartesian frame that all share; it moves at constant velocity.
A direction g from a place s, taken tau seconds ago, says P_g (p - tau v - s) = 0 with P_g = I - g g^T (STT 2023,
eq. 6, 8): z = H x with H = P_g [I, -tau I], z = P_g s. The older form is exact for constant velocity.

All arrays broadcast over leading axes, so that a study plays its trials and robots in one call; `used` masks what a
trial or robot does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EXACT = np.zeros((3, 3))
"""Covariance of a place that is known without error."""
EXACT.flags.writeable = False

LENGTHS = (0.5, 2.0)
"""A direction whose length is outside of these is none; noise that is added to a unit vector stays well inside."""

APART_M = 1.0
"""Distance from which on two places count as two."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """One direction to the target, as measured by one observer.

    place (..., 3)         of the observer when it looked [m]
    direction (..., 3)     towards the target; need not be exactly of unit length
    sigma_rad (...)        deviation of the direction per tangent axis
    place_cov (..., 3, 3)  of the place [m^2]
    age_s (...)            of the direction at the instant of the step
    own                    whether the filter's own robot saw it
    used (...)             False where there is none
    """

    place: Array
    direction: Array
    sigma_rad: Array | float
    place_cov: Array = field(default_factory=lambda: EXACT)
    age_s: Array | float = 0.0
    own: bool = False
    used: Mask | bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What a robot tells of its estimate, for the present instant minus `age_s` (...).

    mean (..., 6); cov (..., 6, 6), or None of filters that tell none; used (...) False where nothing was heard.
    """

    mean: Array
    cov: Array | None = None
    age_s: Array | float = 0.0
    used: Mask | bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """m sights: place, direction (..., m, 3), sigma, age, used (..., m), place_cov (..., m, 3, 3), as of `Sight`."""

    place: Array
    direction: Array
    sigma: Array
    place_cov: Array
    age: Array
    used: Mask

    def count(self) -> Array:
        """How many there are (...)."""
        return np.asarray(self.used.sum(axis=-1), dtype=np.float64)


def refusal(sight: Sight) -> str | None:
    """Why one sight (no leading axes) cannot be used, as a word for a counter; None if it can.

    `out_of_view`: not a number, as models answer for what they cannot see; `no_direction`: length not near one;
    `no_place`; `no_noise`: sigma is not positive, or the place's covariance not finite; `age`: of the future.
    """
    if not np.isfinite(sight.direction).all():
        return "out_of_view"
    if not LENGTHS[0] < float(np.linalg.norm(sight.direction)) < LENGTHS[1]:
        return "no_direction"
    if not np.isfinite(sight.place).all():
        return "no_place"
    if not (np.isfinite(sight.sigma_rad) and sight.sigma_rad > 0.0 and np.isfinite(sight.place_cov).all()):
        return "no_noise"
    return None if np.isfinite(sight.age_s) and sight.age_s >= 0.0 else "age"


def stack_sights(sights: Sequence[Sight], lead: tuple[int, ...]) -> Sights:
    """Sights in arrays with leading axes `lead`. Raises ValueError for a used one that has no direction or place."""
    used = _stacked([item.used for item in sights], lead, ()).astype(bool)
    place = _stacked([item.place for item in sights], lead, (3,))
    direction = _stacked([item.direction for item in sights], lead, (3,))
    sigma = _stacked([item.sigma_rad for item in sights], lead, ())
    place_cov = _stacked([item.place_cov for item in sights], lead, (3, 3))
    age = _stacked([item.age_s for item in sights], lead, ())
    length = np.linalg.norm(direction, axis=-1)
    fit = (length > LENGTHS[0]) & (length < LENGTHS[1]) & np.isfinite(place).all(axis=-1) & (sigma > 0.0)
    if not np.all(fit | ~used):
        raise ValueError("a sight has no direction, place or noise: ask `refusal` before a step and count what it says")
    if not used.all():
        # What is masked may be any numbers, and must not turn sums into NaN.
        place = np.where(used[..., None], place, 0.0)
        direction = np.where(used[..., None], direction, np.array([0.0, 0.0, 1.0]))
        sigma, age = np.where(used, sigma, 1.0), np.where(used, age, 0.0)
        place_cov = np.where(used[..., None, None], place_cov, 0.0)
    return Sights(place, direction, sigma, place_cov, age, used)


def stack_told(told: Sequence[Told], lead: tuple[int, ...]) -> tuple[Array, Array | None, Array, Mask]:
    """mean (..., m, 6), cov (..., m, 6, 6) if any tells one, age (..., m), used (..., m), with leading axes `lead`.

    Raises ValueError if only some tell a covariance.
    """
    used = _stacked([item.used for item in told], lead, ()).astype(bool)
    mean = np.where(used[..., None], _stacked([item.mean for item in told], lead, (6,)), 0.0)
    age = _stacked([item.age_s for item in told], lead, ())
    covs = [item.cov for item in told if item.cov is not None]
    if not covs:
        return mean, None, age, used
    if len(covs) < len(told):
        raise ValueError("all neighbours must tell a covariance or none: run the same kind of filter on every robot")
    return mean, np.where(used[..., None, None], _stacked(covs, lead, (6, 6)), np.eye(6)), age, used


def projection(direction: Array) -> Array:
    """P_g = I - g g^T (..., 3, 3) of directions g (..., 3) (STT 2023, eq. 6)."""
    return np.asarray(np.eye(3) - direction[..., :, None] * direction[..., None, :])


def crossing(sights: Sights, apart_m: float = APART_M) -> Array:
    """How well directions cross (...): the smallest eigenvalue of the mean of P_g, from 0 (parallel) to 2/3.

    Two rays at an angle a have (1 - |cos a|) / 2. Places closer than `apart_m` count as one, with their mean direction:
    one observer crosses with nobody, however often it looks and however the target moves.
    """
    if sights.used.shape[-1] < 2:
        return np.zeros(sights.used.shape[:-1])
    between = np.linalg.norm(sights.place[..., :, None, :] - sights.place[..., None, :, :], axis=-1)
    near = ((between < apart_m) & sights.used[..., :, None] & sights.used[..., None, :]).astype(np.float64)
    mean = near @ sights.direction
    mean /= np.maximum(np.linalg.norm(mean, axis=-1), np.finfo(float).tiny)[..., None]
    weight = np.where(sights.used, 1.0 / np.maximum(near.sum(axis=-1), 1.0), 0.0)
    weight /= np.maximum(weight.sum(axis=-1), np.finfo(float).tiny)[..., None]
    along = (weight[..., None, None] * (mean[..., :, None] * mean[..., None, :])).sum(axis=-3)
    found: Array = np.where(sights.used.any(axis=-1), 1.0 - np.linalg.eigvalsh(along)[..., -1], 0.0)
    return found


def observable(sights: Sequence[Sight], least: float = 0.002, noises: float = 16.0, apart_m: float = APART_M) -> Mask:
    """Whether recent directions from separated places cross well enough for an estimate to be valid, (...).

    `crossing` must be more than `least`, and more than `noises` times the mean variance of a direction: noise alone
    makes two parallel rays seem to cross, by more than n s^2 with probability exp(-n). Two rays of 0.01 rad must cross
    at 0.09 rad, of 0.06 rad at 0.48 rad. Pass what the last half second brought, which a slow target hardly moves in.
    An estimate of which nothing crosses is a guess along a ray. Raises ValueError as a step does.
    """
    if not sights:
        return np.asarray(False)
    lead = np.broadcast_shapes(*(np.shape(item.place)[:-1] for item in sights))
    return crosses(stack_sights(sights, lead), least, noises, apart_m)


def crosses(sights: Sights, least: float = 0.002, noises: float = 16.0, apart_m: float = APART_M) -> Mask:
    """`observable` of sights in arrays."""
    variance = np.where(sights.used, sights.sigma**2, 0.0).sum(axis=-1) / np.maximum(sights.count(), 1.0)
    return np.asarray(crossing(sights, apart_m) > np.maximum(least, noises * variance))


def normal_equations(sights: Sights, weight: Array, towards: Array) -> tuple[Array, Array]:
    """Information S (..., 6, 6) and S x (..., 6) of places seen: sum of H^T W H, H^T W z with H = [I, -tau I].

    weight (..., m, 3, 3) is W of each sight, which holds its projection; towards (..., m, 3) is z, some place on the
    ray. What is not used counts nothing.
    """
    W = np.where(sights.used[..., None, None], weight, 0.0)
    pull = (W @ towards[..., None])[..., 0]
    back = -sights.age
    S = np.empty((*W.shape[:-3], 6, 6))
    S[..., :3, :3] = W.sum(axis=-3)
    S[..., :3, 3:] = S[..., 3:, :3] = (back[..., None, None] * W).sum(axis=-3)
    S[..., 3:, 3:] = ((back**2)[..., None, None] * W).sum(axis=-3)
    return S, np.concatenate([pull.sum(axis=-2), (back[..., None] * pull).sum(axis=-2)], axis=-1)


def _stacked(values: Sequence[Array | Mask | float], lead: tuple[int, ...], shape: tuple[int, ...]) -> Array:
    """Values that broadcast to (*lead, *shape) as one array (*lead, m, *shape)."""
    if not lead:
        return np.array(values, dtype=np.float64).reshape(len(values), *shape)
    found = np.empty((len(values), *lead, *shape))
    for index, value in enumerate(values):
        found[index] = value
    return np.moveaxis(found, 0, len(lead))
