"""A follower localizes by range and bearing of its leader, whose word about where it was comes late.

The filter is the EKF of Zhang & Cao, "Delayed cooperative localization with communication delays" (Information 2019),
with what is misprinted there put right. s is the instant of a measurement, k > s that at which the leader's word on it
arrives. The state is x, y, heading of the follower, and perhaps tau [s], by which the leader's clock is ahead without
anybody knowing.

What the paper has in its state, the leader's place l(s), is a delivered constant: it enters by its covariance Pl, as
R + Cl Pl Cl^T, which is the paper's update with l(s) marginalized, as long as its error is a new one in each word. What
lasts is allowed for by a larger Pl (`agent.leader_words`). Arrays broadcast over leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, quadratic_form, symmetrize, wrap
from agent.estimation.motion import compose

Array = NDArray[np.float64]

NEAREST_M = 0.1
"""At less than this from the leader a bearing has no Jacobian worth the name."""

ON_BODY = (0.0, 0.0, 0.0)
"""A sensor at the body's origin that looks forward: x, y [m], yaw [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class LeaderSight:
    """Range and bearing z (..., 2) of the leader, with R (..., 2, 2), and its word about where it was at that instant.

    place, place_cov  (..., 2), (..., 2, 2) as told
    velocity          (..., 2) [m/s], ENU; by a clock that is ahead by tau the place was that at another time
    arm               the sensor on the body: x, y [m], yaw [rad]
    """

    z: Array
    R: Array
    place: Array
    place_cov: Array
    velocity: Array
    arm: tuple[float, float, float] = ON_BODY


@dataclass(slots=True, eq=False)
class Corrected:
    """Mean (..., n) and covariance (..., n, n) after an update, its left factor (..., n, n), its NIS per degree of
    freedom, and the gain (..., n, 2)."""

    mean: Array
    cov: Array
    left: Array
    nis: Array
    gain: Array


def moved(mean: Array, cov: Array, delta: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Belief (..., n) and (..., n, n) after an increment (..., 3) of the body with covariance (..., 3, 3), and F.

    Eq. 2 with Phi put right: as printed, eq. 3 has the identity and dt both twice and an eigenvalue of 1 + dt.
    """
    n = mean.shape[-1]
    after = mean.copy()
    after[..., :3] = compose(mean[..., :3], delta)
    shape = np.broadcast_shapes(mean.shape[:-1], delta.shape[:-1])
    F, G = np.zeros((*shape, n, n)), np.zeros((*shape, n, 3))
    F[..., range(n), range(n)] = 1.0
    F[..., 0, 2] = mean[..., 1] - after[..., 1]
    F[..., 1, 2] = after[..., 0] - mean[..., 0]
    cos, sin = np.cos(mean[..., 2]), np.sin(mean[..., 2])
    G[..., 0, 0], G[..., 0, 1], G[..., 1, 0], G[..., 1, 1], G[..., 2, 2] = cos, -sin, sin, cos, 1.0
    after[..., 2] = wrap(after[..., 2])
    return after, symmetrize(F @ cov @ _t(F) + G @ noise @ _t(G)), F


def predicted(state: Array, place: Array, sight: LeaderSight) -> tuple[Array, Array, Array]:
    """h (..., 2) of a state (..., n) and a leader at `place` (..., 2), with Jacobians Cf (..., 2, n), Cl (..., 2, 2).

    h = (|l - q|, atan2(l - q) - heading - yaw), q the sensor's place.
    """
    n = state.shape[-1]
    x, y, yaw = sight.arm
    heading = state[..., 2]
    cos, sin = np.cos(heading), np.sin(heading)
    lever_x, lever_y = cos * x - sin * y, sin * x + cos * y
    ahead = place if n == 3 else place + sight.velocity * state[..., 3:4]
    dx = ahead[..., 0] - state[..., 0] - lever_x
    dy = ahead[..., 1] - state[..., 1] - lever_y
    r2 = dx * dx + dy * dy
    r = np.sqrt(r2)
    h = np.stack([r, wrap(np.arctan2(dy, dx) - heading - yaw)], axis=-1)
    Cl = np.stack([np.stack([dx / r, dy / r], axis=-1), np.stack([-dy / r2, dx / r2], axis=-1)], axis=-2)
    Cf = np.zeros((*h.shape, n))
    Cf[..., :2] = -Cl
    Cf[..., 2] = (Cl @ np.stack([lever_y, -lever_x], axis=-1)[..., None])[..., 0]
    Cf[..., 1, 2] -= 1.0
    if n > 3:
        Cf[..., 3] = (Cl @ sight.velocity[..., None])[..., 0]
    return h, Cf, Cl


def seen_place(state: Array, sight: LeaderSight) -> Array:
    """Where (..., 2) the leader is by a state (..., n) and range and bearing alone."""
    x, y, yaw = sight.arm
    cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
    distance, angle = sight.z[..., 0], state[..., 2] + yaw + sight.z[..., 1]
    return np.stack(
        [
            state[..., 0] + cos * x - sin * y + distance * np.cos(angle),
            state[..., 1] + sin * x + cos * y + distance * np.sin(angle),
        ],
        axis=-1,
    )


def corrected(mean: Array, cov: Array, sight: LeaderSight, iterations: int = 1) -> Corrected:
    """The update at the measurement's own instant, by Gauss-Newton over the follower and the leader's place.

    With one pass it is the EKF. The EKF takes the line of sight from a place that is told with noise, so that its
    Jacobian is correlated with its residual and ranges get a bias; a second pass takes it from what is known by then.
    """
    state, place = mean, sight.place
    first: Array | None = None
    for _ in range(iterations):
        h, Cf, Cl = predicted(state, place, sight)
        off = mean - state
        off[..., 2] = wrap(off[..., 2])
        residual = sight.z - h
        residual[..., 1] = wrap(residual[..., 1])
        residual = residual - _dot(Cf, off) - _dot(Cl, sight.place - place)
        noise = sight.R + Cl @ sight.place_cov @ _t(Cl)
        S = symmetrize(Cf @ cov @ _t(Cf) + noise)
        K = gain(cov @ _t(Cf), S)
        if first is None:
            first = quadratic_form(residual, S)
        state = mean + _dot(K, residual)
        state[..., 2] = wrap(state[..., 2])
        place = sight.place + _dot(gain(sight.place_cov @ _t(Cl), S), residual)
    assert first is not None
    left = _unit(mean) - K @ Cf
    after = symmetrize(left @ cov @ _t(left) + K @ noise @ _t(K))
    return Corrected(state, after, left, 0.5 * first, K)


# -- while the leader's word is on its way ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class InFlight:
    """What is kept of an instant s at which the leader was measured, until its word about it arrives.

    mean, cov  (..., n), (..., n, n) predicted for s, x(s|s-1) and P(s|s-1)
    gain       (..., n, 2) K(s) with which the covariance has taken the measurement at s; None: it has not
    M          (..., n, n) maps what would have been corrected at s to now: Phi (I - K C) ... Phi (eq. 26)
    path       (..., 3) the way since s, in the body's frame at s
    """

    mean: Array
    cov: Array
    gain: Array | None
    M: Array
    path: Array

    def moved(self, F: Array, delta: Array) -> InFlight:
        """After a prediction with left factor F (..., n, n) by an increment (..., 3)."""
        return replace(self, M=F @ self.M, path=compose(self.path, delta))

    def updated(self, left: Array) -> InFlight:
        """After an update by something else, with left factor (..., n, n)."""
        return replace(self, M=left @ self.M)


def begun(mean: Array, cov: Array, gain: Array | None = None) -> InFlight:
    """What is kept of an instant whose belief, before the leader was measured, is mean (..., n), cov (..., n, n)."""
    start = np.zeros((*mean.shape[:-1], 3))
    return InFlight(mean, cov, gain, np.broadcast_to(_unit(mean), cov.shape), start)


def anticipated(mean: Array, cov: Array, sight: LeaderSight) -> Corrected:
    """The update at s as far as it can be told before the leader's word is there; its mean is not to be used.

    "At time t_s C and R can be estimated" (before eq. 26): of the word only its covariance is known, so C is taken
    where range and bearing place the leader.
    """
    return corrected(mean, cov, replace(sight, place=seen_place(mean, sight)))


def innovation(state: Array, sight: LeaderSight) -> Array:
    """z - h (..., 2) of a state at the measurement's instant."""
    residual = sight.z - predicted(state, sight.place, sight)[0]
    residual[..., 1] = wrap(residual[..., 1])
    return np.asarray(residual)


def compensated(mean: Array, flight: InFlight, sight: LeaderSight) -> Array:
    """The mean (..., n) now, with the state estimation error compensated (eq. 26-28): x + M K(s) (z(s) - h(x(s|s-1))).

    The order of M's factors is that of Larsen et al., "Incorporation of time delayed measurements in a discrete-time
    Kalman filter" (CDC 1998), whose eq. 12 this is, after Alexander (1991). It is right if the covariance has taken
    the measurement at s: else K' of eq. 25 is not the K of eq. 26. In a linear system the mean then is that without
    delay once all words are there; until then, and for a word that never comes, the covariance is too small.
    """
    K = flight.gain if flight.gain is not None else corrected(flight.mean, flight.cov, sight).gain
    after = mean + _dot(flight.M @ K, innovation(flight.mean, sight))
    after[..., 2] = wrap(after[..., 2])
    return np.asarray(after)


def equivalent(mean: Array, cov: Array, flight: InFlight, sight: LeaderSight) -> Corrected:
    """The update of the present state by the equivalent measurement (eq. 11-16): the motion is inverted.

    C(k) = Cf(s) Phi(k, s)^-1 with Phi^-1 = [1, -L; 0, 1] and L = sum of dt v (-sin, cos) (eq. 15 has dt^2 and the
    other sign). As published the noise of the motion since s is left out of R, so what it claims is too small.
    """
    back = mean.copy()
    back[..., 2] = wrap(mean[..., 2] - flight.path[..., 2])
    back[..., :2] = 0.0
    back[..., :2] = mean[..., :2] - compose(back[..., :3], flight.path)[..., :2]
    inverse = np.zeros(cov.shape)
    n = mean.shape[-1]
    inverse[..., range(n), range(n)] = 1.0
    inverse[..., 0, 2] = mean[..., 1] - back[..., 1]
    inverse[..., 1, 2] = back[..., 0] - mean[..., 0]
    _, Cf, Cl = predicted(back, sight.place, sight)
    C = Cf @ inverse
    noise = sight.R + Cl @ sight.place_cov @ _t(Cl)
    S = symmetrize(C @ cov @ _t(C) + noise)
    K = gain(cov @ _t(C), S)
    residual = innovation(back, sight)
    after = mean + _dot(K, residual)
    after[..., 2] = wrap(after[..., 2])
    left = _unit(mean) - K @ C
    return Corrected(
        after, symmetrize(left @ cov @ _t(left) + K @ noise @ _t(K)), left, 0.5 * quadratic_form(residual, S), K
    )


def algorithm1(mean: Array, cov: Array, flight: InFlight, sight: LeaderSight) -> Corrected:
    """Algorithm 1 as it is printed: the compensation of steps 2-3, then the update of steps 4-5 by the same Z.

    Z(k) is by definition the delayed Z(s), so the mean takes it twice and the covariance once.
    """
    return equivalent(compensated(mean, flight, sight), cov, flight, sight)


def _unit(mean: Array) -> Array:
    return np.eye(mean.shape[-1])


def _dot(matrix: Array, vector: Array) -> Array:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _t(matrix: Array) -> Array:
    return matrix.swapaxes(-1, -2)
