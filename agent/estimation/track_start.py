"""The start of a target's track from one sighting by a robot that is not sure of its own pose.

A measurement of two numbers and, in space, an altitude that is known somehow determine where the target is: x, y =
f(own pose, altitude, z). The error of that place is G e_own + B e_rest + measurement noise, so the track is correlated
with the robot and with everything the robot is correlated with; `e_rest` is the error of what a sighting does not tell
(altitude, heading, velocities), of which a prior has to be stated. Mean and covariance of f are those of the unscented
transform over pose, altitude and measurement; G and B are its statistical linearization, and what that leaves over is
noise as well.

A bearing alone, or a range alone, leaves one number open. With a limit to how far off a subject can be the track can
start all the same, as vague as that is: along the line of sight, or anywhere on a circle. Robots that do so have the
true place of the subject in common as an error, hence the open number counts as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import square_root, symmetrize
from agent.estimation.mounting import rotation
from agent.estimation.observation import MIN_DEPTH_M, RelativeModel
from agent.estimation.unscented import DEFAULT, UnscentedParameters, sigma_points, weights

Array = NDArray[np.float64]

DETERMINING = ("range_bearing", "vector", "bearing3", "pixel")
"""Kinds of measurement that tell a place, those in space with a known altitude."""

MAX_HEADING_RAD = 0.5
"""A robot that is less sure of its heading (1 sigma) can't say where it sees something: the place is a ring."""

MAX_NONLINEAR = 0.3
"""Share of a place's variance that may be beyond linear: a view at a grazing angle has no useful Gaussian."""

FLATTEST = 1e-6
"""A line of sight that changes altitude by less, per metre, meets no altitude."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackStart:
    """A new track: mean (d,), G (d, n) by which the own error enters, and covariances (d, d) of what else does.

    `measured` is the measurement's own noise; `common` the part of the stated prior, and of what is not linear.
    """

    mean: Array
    G: Array
    measured: Array
    common: Array

    def cov(self, own_cov: Array) -> Array:
        """Covariance (d, d) of the track for an own one (n, n)."""
        return symmetrize(self.G @ own_cov @ self.G.T + self.measured + self.common)


def seen_place(model: RelativeModel, own: Array, altitude: Array, z: Array) -> Array:
    """Where (..., 2) a subject of `altitude` (...) is that a robot at `own` (..., n) measures as z (..., 2).

    NaN where no such place exists, or more than one. The altitude of what is planar is 0.
    """
    if model.dims == 2:
        yaw = model.mount[5]
        turn = rotation(0.0, 0.0, yaw)[:2, :2].T
        lever = turn @ np.array(model.mount[:2])
        seen = z if model.kind == "vector" else _polar(z[..., 0], z[..., 1])
        level = np.asarray((seen + lever) @ turn)
    else:
        mounted = rotation(*model.mount[3:]).T
        lever = mounted @ np.array(model.mount[:3])
        turn = mounted @ rotation(*model.attitude, 0.0).T
        up = turn[:, 2]
        own_altitude = own[..., model.observer.altitude] if model.observer.altitude is not None else 0.0
        # What the sensor's vector to the subject amounts to along the vertical.
        climb = altitude - own_altitude - up @ lever
        level = np.asarray((_seen_in_space(model.kind, z, up, climb) + lever) @ turn)[..., :2]
    assert model.observer.heading is not None
    heading = own[..., model.observer.heading]
    cos, sin = np.cos(heading), np.sin(heading)
    place = np.empty_like(level)
    place[..., 0] = own[..., 0] + cos * level[..., 0] - sin * level[..., 1]
    place[..., 1] = own[..., 1] + sin * level[..., 0] + cos * level[..., 1]
    return place


def _polar(distance: Array, azimuth: Array) -> Array:
    return np.asarray(distance[..., None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1))


def _seen_in_space(kind: str, z: Array, up: Array, climb: Array) -> Array:
    """Vector (..., 3) in the sensor's axes with up . s = climb that is measured as z (..., 2)."""
    s = np.full((*z.shape[:-1], 3), np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        if kind == "vector":
            s[..., :2] = z
            s[..., 2] = (climb - z @ up[:2]) / (up[2] if abs(up[2]) > FLATTEST else np.nan)
            return s
        if kind == "range_bearing":
            return _on_sphere(z, up, climb)
        if kind == "bearing3":
            ray = np.concatenate([_polar(np.cos(z[..., 1]), z[..., 0]), np.sin(z[..., 1])[..., None]], axis=-1)
            nearest = 0.0
        else:
            ray = np.concatenate([np.ones((*z.shape[:-1], 1)), -z], axis=-1)
            nearest = MIN_DEPTH_M
        slope = ray @ up
        length = np.where(np.abs(slope) > FLATTEST, climb / slope, np.nan)
        return np.asarray(np.where(length > nearest, length, np.nan)[..., None] * ray)


def _on_sphere(z: Array, up: Array, climb: Array) -> Array:
    """The vector of length z[..., 0] and azimuth z[..., 1] with up . s = climb, if it is the only one."""
    range_m, azimuth = z[..., 0], z[..., 1]
    level = _polar(np.ones_like(azimuth), azimuth)
    a, b = level @ up[:2], np.broadcast_to(up[2], azimuth.shape)
    middle, half = np.arctan2(b, a), np.arccos(climb / (range_m * np.hypot(a, b)))
    first, second = middle - half, middle + half
    # In front of the vertical through the sensor; the other one would be seen at the opposite azimuth.
    ahead_first, ahead_second = np.cos(first) > 0.0, np.cos(second) > 0.0
    elevation = np.where(ahead_first & ~ahead_second, first, np.where(ahead_second & ~ahead_first, second, np.nan))
    flat = (range_m * np.cos(elevation))[..., None] * level
    return np.concatenate([flat, (range_m * np.sin(elevation))[..., None]], axis=-1)


def start_track(
    model: RelativeModel,
    own: tuple[Array, Array],
    rest: tuple[Array, Array],
    z: Array,
    R: Array,
    parameters: UnscentedParameters = DEFAULT,
    known: tuple[bool, bool] = (True, True),
) -> TrackStart | None:
    """The track of a subject that a robot of belief `own`, (n,) and (n, n), measures as z (2,) with noise R (2, 2).

    `rest` is a prior (d,), (d, d) of the subject's state, of which the place x, y is not used. None if the measurement
    does not determine the place, or too vaguely for a Gaussian. What of z is not `known` is a prior: its error counts
    as common. Then R is diagonal.
    """
    observer, subject = model.observer, model.subject
    if model.kind not in DETERMINING or observer.heading is None:
        return None
    own_mean, own_cov = own
    if own_cov[observer.heading, observer.heading] > MAX_HEADING_RAD**2:
        return None
    rest_mean, prior = rest[0].copy(), rest[1].copy()
    prior[:2, :] = prior[:, :2] = 0.0
    n, d, altitude = len(own_mean), len(rest_mean), subject.altitude
    first = n if altitude is None else n + 1
    mean, cov = np.zeros(first + 2), np.zeros((first + 2, first + 2))
    mean[:n], cov[:n, :n] = own_mean, own_cov
    mean[first:], cov[first:, first:] = z, R
    if altitude is not None:
        mean[n], cov[n, n] = rest_mean[altitude], prior[altitude, altitude]
    weight_mean, weight_cov, spread = weights(len(mean), parameters)
    points = sigma_points(mean, square_root(cov), spread)
    heights = np.zeros(len(points)) if altitude is None else points[:, n]
    places = seen_place(model, points[:, :n], heights, points[:, first:])
    if not np.isfinite(places).all():
        return None
    place = weight_mean @ places
    deviation = places - place
    spread_cov = (deviation.T * weight_cov) @ deviation
    linear = (deviation.T * weight_cov) @ (points - mean) @ np.linalg.pinv(cov)
    explained = linear @ cov @ linear.T
    beyond = symmetrize(spread_cov - explained)
    if np.trace(beyond) > MAX_NONLINEAR * np.trace(spread_cov):
        return None
    rest_mean[:2] = place
    G, measured = np.zeros((d, n)), np.zeros((d, d))
    G[:2] = linear[:, :n]
    by_z = linear[:, first:]
    measured[:2, :2] = by_z @ (R * np.outer(known, known)) @ by_z.T
    B = np.eye(d)
    if altitude is not None:
        B[:2, altitude] = linear[:, n]
    common = B @ prior @ B.T
    common[:2, :2] += beyond + by_z @ (R * np.logical_not(np.logical_or.outer(known, known))) @ by_z.T
    return TrackStart(rest_mean, G, symmetrize(measured), symmetrize(common))


def start_vaguely(
    model: RelativeModel,
    own: tuple[Array, Array],
    rest: tuple[Array, Array],
    z: Array,
    R: Array,
    within_m: float,
    parameters: UnscentedParameters = DEFAULT,
) -> TrackStart | None:
    """The track of a subject of which a robot measures but a bearing, or a range, and that is at most `within_m` off.

    Of a bearing, the distance is taken for evenly distributed; of a range, the direction. Arguments as of
    `start_track`; None for other kinds, and for a range beyond `within_m`.
    """
    if model.kind == "bearing":
        # Mean and variance of an even distribution over [0, within_m].
        open_m, variance = 0.5 * within_m, within_m**2 / 12.0
        polar = replace(model, kind="range_bearing")
        z_polar, R_polar = np.array([open_m, z[0]]), np.diag([variance, R[0, 0]])
        return start_track(polar, own, rest, z_polar, R_polar, parameters, known=(False, True))
    if model.kind == "range" and z[0] <= within_m:
        return _on_circle(model, own, rest, float(z[0]), float(R[0, 0]))
    return None


def _on_circle(
    model: RelativeModel, own: tuple[Array, Array], rest: tuple[Array, Array], range_m: float, variance: float
) -> TrackStart:
    """Mean and covariance of a circle about the sensor: half the square of its radius on either axis.

    In space the circle is smaller than the distance; it is not taken to be.
    """
    mean, common = rest[0].copy(), rest[1].copy()
    lever = rotation(*model.attitude, 0.0) @ np.array(model.mount[:3])
    assert model.observer.heading is not None
    cos, sin = np.cos(own[0][model.observer.heading]), np.sin(own[0][model.observer.heading])
    arm = np.array([cos * lever[0] - sin * lever[1], sin * lever[0] + cos * lever[1]])
    mean[:2] = own[0][:2] + arm
    G = np.zeros((len(mean), len(own[0])))
    G[0, 0] = G[1, 1] = 1.0
    G[:2, model.observer.heading] = -arm[1], arm[0]
    common[:2, :] = common[:, :2] = 0.0
    common[0, 0] = common[1, 1] = 0.5 * (range_m**2 + variance)
    return TrackStart(mean, G, np.zeros_like(common), common)
