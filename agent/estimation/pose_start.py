"""A robot's pose from what a peer that is localized tells, and a measurement between the two.

x, y, heading = f(peer's pose, own altitude, measurement, own heading or own view of the peer). The error is
G e_peer + noise: the own error is correlated with the peer's from then on, and with everything the peer is correlated
with. Mean and covariance are those of the unscented transform, G is its statistical linearization (as for a track's
start, see `agent.estimation.track_start`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import square_root, symmetrize, wrap
from agent.estimation.motion import StateLayout
from agent.estimation.mounting import rotation
from agent.estimation.observation import RelativeModel
from agent.estimation.track_start import MAX_HEADING_RAD, MAX_NONLINEAR, seen_place
from agent.estimation.unscented import DEFAULT, UnscentedParameters, sigma_points, weights

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """A number and its variance."""

    value: float
    variance: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseStart:
    """Pose x, y[, z], heading (d,), covariance (d, d), and the part of it (d, d) that a peer's error has caused."""

    mean: Array
    cov: Array
    shared: Array


def heading_from_view(place: Array, peer: Array, azimuth: Array, model: RelativeModel) -> Array:
    """Heading (...) of a robot at `place` (..., 2) that sees a peer at `peer` (..., 2) under `azimuth` (...).

    In the plane: the lever arm of the sensor counts, its roll and pitch do not. NaN if the peer is nearer than the arm.
    """
    yaw = model.mount[5]
    lever = rotation(0.0, 0.0, yaw)[:2, :2].T @ np.array(model.mount[:2])
    apart = peer - place
    ray = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    along = ray @ lever
    with np.errstate(invalid="ignore"):
        distance = -along + np.sqrt(along**2 - lever @ lever + np.sum(apart**2, axis=-1))
    seen = distance[..., None] * ray + lever
    return np.asarray(np.arctan2(apart[..., 1], apart[..., 0]) - np.arctan2(seen[..., 1], seen[..., 0]) - yaw)


def pose_from_peer(
    model: RelativeModel,
    own_observed: bool,
    layout: StateLayout,
    peer: tuple[Array, Array],
    z: Array,
    R: Array,
    *,
    heading: Known | None = None,
    view: tuple[RelativeModel, Known] | None = None,
    altitude: Known | None = None,
    parameters: UnscentedParameters = DEFAULT,
) -> PoseStart | None:
    """The pose of a robot of `layout` next to a peer of belief `peer`, (n,) and (n, n).

    z (2,) with noise R (2, 2) is what the own sensor measures of the peer (`own_observed`), or the peer's of the own
    robot. Of the own heading either is given: a value, or, if the peer has measured, the model and azimuth of a `view`
    of the peer. `altitude` is the own one, if there is one in `layout`. None if no place follows, or one too vague.
    """
    own, other = (model.observer, model.subject) if own_observed else (model.subject, model.observer)
    turn = heading if heading is not None else view[1] if view is not None and not own_observed else None
    if turn is None or (layout.altitude is None) != (altitude is None):
        return None
    n, lift = len(peer[0]), 0 if altitude is None else 1
    size = n + lift + 3
    mean, cov = np.zeros(size), np.zeros((size, size))
    mean[:n], cov[:n, :n] = peer
    if altitude is not None:
        mean[n], cov[n, n] = altitude.value, altitude.variance
    mean[n + lift : -1], cov[n + lift : -1, n + lift : -1] = z, R
    mean[-1], cov[-1, -1] = turn.value, turn.variance
    weight_mean, weight_cov, spread = weights(size, parameters)
    points = sigma_points(mean, square_root(cov), spread)
    measured = points[:, n + lift : -1]
    height = points[:, n] if lift else np.zeros(len(points))
    if own_observed:
        here = np.zeros((len(points), own.dim))
        here[:, own.heading] = points[:, -1]
        if own.altitude is not None:
            here[:, own.altitude] = height
        level = points[:, other.altitude] if other.altitude is not None else np.zeros(len(points))
        place = points[:, :2] - seen_place(model, here, level, measured)
    else:
        place = seen_place(model, points[:, :n], height, measured)
    turned = points[:, -1] if view is None or heading is not None else heading_from_view(
        place, points[:, :2], points[:, -1], view[0]
    )
    if not (np.isfinite(place).all() and np.isfinite(turned).all()):
        return None
    turned = turned[0] + wrap(turned - turned[0])
    found = np.concatenate([place, height[:, None], turned[:, None]] if lift else [place, turned[:, None]], axis=-1)
    pose = weight_mean @ found
    deviation = found - pose
    pose_cov = (deviation.T * weight_cov) @ deviation
    linear = (deviation.T * weight_cov) @ (points - mean) @ np.linalg.pinv(cov)
    beyond = symmetrize(pose_cov - linear @ cov @ linear.T)
    if np.trace(beyond[:2, :2]) > MAX_NONLINEAR * np.trace(pose_cov[:2, :2]) or pose_cov[-1, -1] > MAX_HEADING_RAD**2:
        return None
    pose[-1] = wrap(pose[-1])
    G = linear[:, :n]
    return PoseStart(pose, symmetrize(pose_cov), symmetrize(G @ peer[1] @ G.T + beyond))
