"""The centralized filter: one joint Gaussian over all robots and targets, fed with everything.

It is what a fleet could know at best with these sensors and this transform. Measurements are linearized
statistically over the states they involve only, K = P[:, sub] H^T S^-1 with S = Szz + R.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import congruence, gain, quadratic_form, symmetrize, wrap_components
from agent.estimation.motion import RobotMotion, TargetMotion
from agent.estimation.observation import AbsoluteModel, RelativeModel, absolute_model
from agent.estimation.track_start import start_track, start_vaguely
from agent.estimation.unscented import Propagated, Transform, observe
from agent.estimation.wide_heading import by_angles
from agent.events import LEVEL
from network.messages import NO_MOUNT, Mount

Array = NDArray[np.float64]
Rows = NDArray[np.intp]


class CentralizedFilter:
    """Joint belief of robots {id: (mean (n,), cov (n, n), motion)} and targets {id: (mean, cov, motion)}.

    Targets in `unseen`, {id: (mean, cov, motion)} with nothing known of x and y, join when a sighting tells where they
    are; a bearing or a range alone does so, vaguely, if they are `within_m`.
    """

    def __init__(
        self,
        robots: dict[str, tuple[Array, Array, RobotMotion]],
        targets: dict[str, tuple[Array, Array, TargetMotion]],
        landmarks: dict[str, tuple[float, ...]],
        transform: Transform = "unscented",
        innovation_cap: float = 0.0,
        unseen: dict[str, tuple[Array, Array, TargetMotion]] | None = None,
        within_m: float | None = None,
    ) -> None:
        self._landmarks, self._transform, self._cap = landmarks, transform, innovation_cap
        self._unseen, self._within_m = dict(unseen or {}), within_m
        self._motions = {name: motion for name, (_, _, motion) in targets.items()}
        self._robot_motions = {name: motion for name, (_, _, motion) in robots.items()}
        self._layouts = {name: motion.layout for name, motion in self._robot_motions.items()}
        self._layouts |= {name: motion.layout for name, motion in self._motions.items()}
        self._parts: dict[str, slice] = {}
        starts = [(name, mean, cov, motion.layout) for name, (mean, cov, motion) in robots.items()]
        starts += [(name, mean, cov, motion.layout) for name, (mean, cov, motion) in targets.items()]
        size = sum(len(mean) for _, mean, _, _ in starts)
        self.mean, self.cov = np.zeros(size), np.zeros((size, size))
        angles: list[int] = []
        offset = 0
        for name, mean, cov, layout in starts:
            part = slice(offset, offset + len(mean))
            self._parts[name], self.mean[part], self.cov[part, part] = part, mean, cov
            angles += [offset + index for index in layout.angles]
            offset += len(mean)
        self._angles = tuple(angles)
        self._rows: dict[tuple[str, ...], tuple[Rows, tuple[Rows, ...]]] = {}

    def copy(self) -> CentralizedFilter:
        """A filter of its own with the same belief."""
        other = copy.copy(self)
        other.mean, other.cov = self.mean.copy(), self.cov.copy()
        other._unseen, other._motions = dict(self._unseen), dict(self._motions)
        other._layouts, other._parts, other._rows = dict(self._layouts), dict(self._parts), dict(self._rows)
        return other

    def __contains__(self, name: str) -> bool:
        """Whether there is a belief of a robot or target."""
        return name in self._parts

    def belief(self, name: str) -> tuple[Array, Array]:
        """Marginal mean (n,) and covariance (n, n)."""
        part = self._parts[name]
        return self.mean[part].copy(), self.cov[part, part].copy()

    def cross(self, first: str, second: str) -> Array:
        """Cross-covariance (n_a, n_b)."""
        return np.array(self.cov[self._parts[first], self._parts[second]])

    def odometry(self, robot: str, delta: Array, cov: Array, dt_s: float) -> None:
        """Move a robot by an increment (4,) with covariance (4, 4) over `dt_s` seconds."""
        motion = self._robot_motions[robot]
        self._predict(robot, motion.advance(*self.belief(robot), delta, cov, dt_s, self._transform))

    def drift_targets(self, dt_s: float) -> None:
        """Move all targets by their models."""
        for name, motion in self._motions.items():
            self._predict(name, motion.drift(*self.belief(name), dt_s, self._transform))

    def fix(self, robot: str, kind: str, z: Array, R: Array) -> float | None:
        """Absolute information z (m,), R (m, m): its NIS per degree of freedom; None if the state has none of it."""
        fix = absolute_model(kind, self._layouts[robot], z, R)
        return None if fix is None else self._update((robot,), *fix)

    def observe(
        self,
        robot: str,
        kind: str,
        of: str,
        z: Array,
        R: Array,
        mount: Mount = NO_MOUNT,
        attitude: tuple[float, float] = LEVEL,
    ) -> float:
        """A relative measurement of `r2`, `landmark:L3` or `target:t1`: its NIS per degree of freedom.

        Raises `OutOfViewError` for a pixel of what is out of view; nothing has happened then. A target that is `unseen`
        has no NIS, which is told as 0.
        """
        names: tuple[str, ...] = (robot,)
        layout = self._layouts[robot]
        if of.startswith("landmark:"):
            model = RelativeModel(kind, layout, mount, self._landmarks[of.removeprefix("landmark:")], attitude=attitude)
        else:
            name = of.removeprefix("target:")
            if name in self._unseen:
                subject = self._unseen[name][2].layout
                self._start(name, robot, RelativeModel(kind, layout, mount, subject=subject, attitude=attitude), z, R)
                return 0.0
            names = (robot, name)
            model = RelativeModel(kind, layout, mount, subject=self._layouts[name], attitude=attitude)
        return self._update(names, model, z, R)

    def _start(self, name: str, robot: str, model: RelativeModel, z: Array, R: Array) -> None:
        """Take in a target that a robot sees, if that tells where it is."""
        mean, cov, motion = self._unseen[name]
        start = start_track(model, self.belief(robot), (mean, cov), z, R)
        if start is None and self._within_m is not None:
            start = start_vaguely(model, self.belief(robot), (mean, cov), z, R, self._within_m)
        if start is None:
            return
        del self._unseen[name]
        n, d, own = len(self.mean), len(mean), self._parts[robot]
        self._parts[name], self._motions[name], self._layouts[name] = slice(n, n + d), motion, motion.layout
        self._angles += tuple(n + index for index in motion.layout.angles)
        joint = np.zeros((n + d, n + d))
        joint[:n, :n] = self.cov
        joint[n:, :n] = start.G @ self.cov[own, :]
        joint[:n, n:] = joint[n:, :n].T
        joint[n:, n:] = start.cov(self.cov[own, own])
        self.mean, self.cov = np.concatenate([self.mean, start.mean]), joint

    def _components(self, names: tuple[str, ...]) -> tuple[Rows, tuple[Rows, ...]]:
        """Components of robots and targets, and the index of their covariance; those of a name never change."""
        if names not in self._rows:
            parts = [self._parts[name] for name in names]
            rows = np.concatenate([np.arange(part.start, part.stop) for part in parts])
            self._rows[names] = rows, np.ix_(rows, rows)
        return self._rows[names]

    def _predict(self, name: str, moved: Propagated) -> None:
        part = self._parts[name]
        self.mean[part] = moved.mean
        self.cov[part, :] = moved.F.dot(self.cov[part, :])
        self.cov[:, part] = self.cov[part, :].T
        self.cov[part, part] = moved.cov

    def _update(self, names: tuple[str, ...], model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> float:
        rows, square = self._components(names)
        cov = self.cov[square]
        model, z, R = by_angles(model, z, R, cov)
        predicted = observe(
            model.h,
            model.jacobian,
            self.mean[rows],
            cov,
            model.angles,
            self._transform,
            turning=model.turning,
        )
        innovation = wrap_components(z - predicted.z, model.angles)
        S = predicted.cov + R
        nis = float(quadratic_form(innovation, S)) / len(innovation)
        if 0.0 < self._cap < nis:
            S = S * (nis / self._cap)
        K = gain(self.cov[:, rows].dot(predicted.H.T), S)
        self.mean = wrap_components(self.mean + K.dot(innovation), self._angles)
        self.cov = symmetrize(self.cov - congruence(K, S))
        return nis
