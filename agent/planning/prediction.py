"""State and covariance prediction: what a command will have done to the beliefs of a team (SACP: Su 2022, table 3.2).

One step is predicted with the measurements that it leads to: what the robot will see from where it will be, and what
its neighbours will see where they go by their last commands. From there on beliefs grow without measurements, by t2
steps in one closed form. All candidates c of a choice are evaluated at once.

A sighting is used as the place of what is seen, p = p_i + r (cos, sin)(bearing + heading), which is the same
information as range and bearing; to first order its error has a part of the sensor and one of the pose, J P J^T with
J = [1 0 -dy; 0 1 dx], d = p - p_i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.jlatt import predicted_robot_cov, predicted_target_cov
from agent.planning.situation import Situation
from agent.planning.team_view import Believer
from agent.settings import PlanningSettings, SensingSettings

Array = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)

NEAREST_M = 1e-6
"""Distances below this have no direction."""


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """Robots after one step of commands held for longer: poses (c, 3), covs (c, 3, 3), and where they will be.

    track (c, n, 2)  places after 1 ... n steps [m]
    way, heading (c,)  variances of the odometry of each step [m^2], [rad^2]
    """

    poses: Array
    covs: Array
    track: Array
    way: Array
    heading: Array


def moved(poses: Array, covs: Array, commands: Array, dt_s: float, steps: int, settings: PlanningSettings) -> Moved:
    """Robots at `poses` (c or 1, 3), covs (c or 1, 3, 3), under commands (c, 2), [m/s] and [rad/s] (eq. 2.6, 4.3)."""
    way, turn = dt_s * commands[:, 0], dt_s * commands[:, 1]
    headings = poses[:, 2:] + turn[:, None] * np.arange(steps)
    moves = way[:, None, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    track = poses[:, None, :2] + np.cumsum(moves, axis=1)
    F = np.zeros((len(commands), 3, 3))
    F[:, [0, 1, 2], [0, 1, 2]] = 1.0
    F[:, 0, 2], F[:, 1, 2] = -moves[:, 0, 1], moves[:, 0, 0]
    way_noise, heading_noise = (settings.speed_share * way) ** 2, (settings.heading_rad_per_m * way) ** 2
    new = F @ covs @ F.swapaxes(-1, -2)
    along = np.stack([np.cos(headings[:, 0]), np.sin(headings[:, 0])], axis=-1)
    new[:, :2, :2] += way_noise[:, None, None] * along[:, :, None] * along[:, None, :]
    new[:, 2, 2] += heading_noise
    ends = np.concatenate([track[:, 0], poses[:, 2:] + turn[:, None]], axis=1)
    return Moved(ends, new, track, way_noise, heading_noise)


def grown_trace(cov: Array, track: Array, way: Array, heading: Array) -> Array:
    """tr P (c,) of poses with `cov` (c, 3, 3) at track[:, 0] after the other t steps of `track` (c, t + 1, 2).

    Each step adds the noise of its odometry with variances `way` [m^2] and `heading` [rad^2] (c,). Heading errors turn
    all of the way that is left: Phi = I + [0 0 -Dy; 0 0 Dx; 0 0 0] from one step to the last, D the way between them.
    """
    left = track[:, -1:] - track
    D, steps = left[:, 0], track.shape[1] - 1
    turned = 2.0 * (D[:, 0] * cov[:, 1, 2] - D[:, 1] * cov[:, 0, 2]) + np.sum(D**2, axis=1) * cov[:, 2, 2]
    noise = steps * (way + heading) + heading * np.sum(left[:, 1:] ** 2, axis=(1, 2))
    return np.asarray(np.trace(cov, axis1=1, axis2=2) + turned + noise)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """What robots at c poses see of m places: seen (c, m), bearings (c, m) [rad], jacobian J (c, m, 2, 3) of the place
    in the pose, and covariance of the place by the sensor (c, m, 2, 2) [m^2]."""

    seen: NDArray[np.bool_]
    bearings: Array
    jacobian: Array
    sensor: Array

    def pose_part(self, covs: Array) -> Array:
        """Covariance (c, m, 2, 2) of the places that stems from poses with covs (c, 3, 3)."""
        return np.asarray(self.jacobian @ covs[:, None] @ self.jacobian.swapaxes(-1, -2))


def sightings(poses: Array, places: Array, sensing: SensingSettings) -> Sightings:
    """From `poses` (c, 3) of `places` (c or 1, m, 2), with a hard field of view at the estimates."""
    d = places - poses[:, None, :2]
    r = np.maximum(np.hypot(d[..., 0], d[..., 1]), NEAREST_M)
    bearings = wrap(np.arctan2(d[..., 1], d[..., 0]) - poses[:, None, 2])
    seen = (r >= sensing.min_range_m) & (r <= sensing.max_range_m) & (np.abs(bearings) <= 0.5 * sensing.fov_rad)
    jacobian = np.zeros((*r.shape, 2, 3))
    jacobian[..., 0, 0] = jacobian[..., 1, 1] = 1.0
    jacobian[..., 0, 2], jacobian[..., 1, 2] = -d[..., 1], d[..., 0]
    along = d / r[..., None]
    across = jacobian[..., 2] / r[..., None]
    far, wide = (sensing.sigma_m + sensing.sigma_m_per_m * r) ** 2, (sensing.sigma_rad * r) ** 2
    sensor = far[..., None, None] * along[..., :, None] * along[..., None, :]
    sensor += wide[..., None, None] * across[..., :, None] * across[..., None, :]
    return Sightings(seen, bearings, jacobian, sensor)


@dataclass(frozen=True, slots=True, eq=False)
class TargetForecast:
    """A target as far as no command of the robot matters.

    place (2,), place_cov (2, 2)  at k, by the robot's belief
    track (t1 + 1, 2)  where it is at k ... k + t1
    prior (n, n)  covariance at k of what all believe of it together
    sensor, pose (m, 2, 2), seen (m,)  what the m others that believe something of it will see of it
    unseen (n, n)  covariance at k if the robot does not see it
    growth (n, n), noise  tr P(k + t2) = <growth, P(k)> + noise
    """

    place: Array
    place_cov: Array
    track: Array
    prior: Array
    sensor: Array
    pose: Array
    seen: NDArray[np.bool_]
    unseen: Array
    growth: Array
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """Of c commands: tr P_i (c,) and sum of tr P_T (c,) at k + t2, track (c, t1 + 1, 2) at k ... k + t1, and how far
    off the robot's nose the nearest target is at k (c,) [rad], 0 without any."""

    own: Array
    targets: Array
    track: Array
    off_nose: Array


class Prediction:
    """The beliefs of a team in a situation, moved on as far as they do not depend on what the robot chooses.

    `targets` as `team_view.believers` gives them; `situation` has been cleared by `team_view.usable`.
    """

    def __init__(
        self, settings: PlanningSettings, situation: Situation, targets: Mapping[str, tuple[Believer, ...]]
    ) -> None:
        self._settings, self._situation = settings, situation
        others = situation.others
        self.others = moved(
            np.array([member.pose for member in others]).reshape(-1, 3),
            np.array([member.cov for member in others]).reshape(-1, 3, 3),
            np.array([[member.speed_mps, member.yaw_rate_radps] for member in others]).reshape(-1, 2),
            situation.dt_s,
            settings.ahead + 1,
            settings,
        )
        self.targets = [self._forecast(views) for views in targets.values()]
        self._places = np.concatenate([self.others.poses[:, :2], *(target.place[None] for target in self.targets)])
        self._place_covs = np.concatenate(
            [self.others.covs[:, :2, :2], *(target.place_cov[None] for target in self.targets)]
        )

    @cached_property
    def nearest(self) -> int | None:
        """Which of `targets` will be nearest to where the robot is now; None without any."""
        places = [target.place - self._situation.own.pose[:2] for target in self.targets]
        return int(np.argmin(np.linalg.norm(places, axis=1))) if places else None

    def _forecast(self, views: tuple[Believer, ...]) -> TargetForecast:
        settings, dt = self._settings, self._situation.dt_s
        first = views[0] if views[0].member == 0 else max(views, key=lambda believer: believer.certainty)
        views = tuple(item for item in views if item.view.motion.layout is first.view.motion.layout)
        ahead = [item.view.motion.drift(item.view.mean, item.view.cov, dt, "jacobian") for item in views]
        start = ahead[views.index(first)]
        mean, growth, noise = start.mean, np.eye(len(start.mean)), np.zeros_like(start.cov)
        track = [mean[:2]]
        for number in range(max(settings.ahead, settings.horizon)):
            step = first.view.motion.drift(mean, noise, dt, "jacobian")
            mean = step.mean
            if number < settings.horizon:
                noise, growth = step.cov, step.F @ growth
            track.append(mean[:2])
        others = [index for index, item in enumerate(views) if item.member > 0]
        seers = [views[index].member - 1 for index in others]
        places = np.array([ahead[index].mean[:2] for index in others]).reshape(-1, 1, 2)
        sight = sightings(self.others.poses[seers], places, settings.sensing)
        sensor, pose = sight.sensor[:, 0], sight.pose_part(self.others.covs[seers])[:, 0]
        seen, none = sight.seen[:, 0], np.zeros((0, 2, 2))
        covs = np.array([item.cov for item in ahead])
        prior = predicted_target_cov(covs, none, none, np.zeros(0, dtype=bool), settings.weights)
        return TargetForecast(
            start.mean[:2],
            start.cov[:2, :2],
            np.array(track[: settings.ahead + 1]),
            prior,
            sensor,
            pose,
            seen,
            predicted_target_cov(prior[None], sensor, pose, seen, settings.weights),
            growth.T @ growth,
            float(noise.trace()),
        )

    def of(self, commands: Array) -> Predicted:
        """What commands (c, 2), [m/s] and [rad/s], lead to."""
        settings, own = self._settings, self._situation.own
        steps = max(settings.ahead, settings.horizon) + 1
        new = moved(own.pose[None], own.cov[None], commands, self._situation.dt_s, steps, settings)
        sight = sightings(new.poses, self._places[None], settings.sensing)
        covs, some = new.covs.copy(), sight.seen.any(axis=1)
        if some.any():
            H, sensor, seen = sight.jacobian[some], sight.sensor[some], sight.seen[some]
            covs[some] = predicted_robot_cov(covs[some], H, sensor, self._place_covs, seen, settings.weights)
        track = new.track[:, : settings.horizon + 1]
        own_trace = grown_trace(covs, track, new.way, new.heading)
        pose_part = sight.pose_part(new.covs)
        targets, off_nose = np.zeros(len(commands)), np.zeros(len(commands))
        robots = len(self.others.poses)
        for number, target in enumerate(self.targets):
            index = robots + number
            cov, own_seen = np.repeat(target.unseen[None], len(commands), axis=0), sight.seen[:, index]
            if own_seen.any():
                cov[own_seen] = predicted_target_cov(
                    target.prior[None],
                    _after(sight.sensor[own_seen, index], target.sensor),
                    _after(pose_part[own_seen, index], target.pose),
                    _after(own_seen[own_seen], target.seen),
                    settings.weights,
                )
            targets += np.einsum("ij,cij->c", target.growth, cov) + target.noise
            if number == self.nearest:
                off_nose = np.abs(sight.bearings[:, index])
        return Predicted(own_trace, targets, new.track[:, : settings.ahead + 1], off_nose)


def _after(own: NDArray[Scalar], others: NDArray[Scalar]) -> NDArray[Scalar]:
    """(c, 1 + m, ...) of the own (c, ...) and then those of m others (m, ...), the same for all candidates."""
    return np.concatenate([own[:, None], np.broadcast_to(others, (len(own), *others.shape))], axis=1)
