"""Robots and a target without noise: every estimate is the truth, with the covariances that an estimator would have.

A short closed loop for tests of planners. All robots hear each other, `late` rounds after the fact.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.jlatt import predicted_robot_cov, predicted_target_cov
from agent.estimation.motion import UNICYCLE, TargetMotion
from agent.planning.choice import build_planner
from agent.planning.prediction import moved, sightings
from agent.planning.situation import Member, Situation, TargetView
from agent.settings import PlanningSettings

Array = NDArray[np.float64]

TARGET = TargetMotion(UNICYCLE, (0.25, 0.0), (0.0053, 0.0212))
"""The target of Su 2022, section 4.1: 0.25 m/s straight on, deviations 3 % / sqrt 2 and 3 % * 2 sqrt 2 of that."""


def view(mean: Array | list[float], cov: Array | None = None, name: str = "t1") -> TargetView:
    return TargetView(name, TARGET, np.array(mean, dtype=float), np.diag([0.1, 0.1, 0.05]) if cov is None else cov)


def member(
    robot: str,
    pose: Array | list[float],
    *views: TargetView,
    command: tuple[float, float] = (0.0, 0.0),
    age_s: float = 0.0,
) -> Member:
    return Member(robot, np.array(pose, dtype=float), np.diag([0.01, 0.01, 0.001]), *command, views, age_s)


@dataclass
class Field:
    """Robots that steer themselves about a target (None: there is none)."""

    settings: PlanningSettings
    poses: Array
    target: Array | None = None
    late: int = 0
    dt_s: float = 1.0
    members: list[tuple[Member, ...]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.count = len(self.poses)
        self.covs = np.tile(1e-3 * np.eye(3), (self.count, 1, 1))
        self.target_covs = np.tile(np.diag([1.0, 1.0, 0.1]), (self.count, 1, 1))
        self.commands = np.zeros((self.count, 2))
        self.planners = [build_planner(self.settings, f"r{index}") for index in range(self.count)]
        self.track: list[Array] = [self.poses.copy()]
        self.speeds: list[Array] = []
        self.seeing: list[Array] = []

    def _told(self) -> tuple[Member, ...]:
        return tuple(
            Member(
                f"r{i}",
                self.poses[i],
                self.covs[i],
                *self.commands[i].tolist(),
                () if self.target is None else (view(self.target, self.target_covs[i]),),
            )
            for i in range(self.count)
        )

    def step(self) -> None:
        index = len(self.members)
        self.members.append(self._told())
        old = self.members[max(0, index - self.late)]
        age = self.dt_s * min(index, self.late)
        commands = []
        for i, planner in enumerate(self.planners):
            others = tuple(replace(item, age_s=age) for item in old[:i] + old[i + 1 :])
            assert planner is not None
            found = planner.command(Situation(index, self.dt_s, self.members[-1][i], others))
            commands.append([found.speed_mps, found.yaw_rate_radps])
        self.commands = np.array(commands)
        new = moved(self.poses, self.covs, self.commands, self.dt_s, 1, self.settings)
        self.poses = new.poses
        self._correct(new.covs)
        self.track.append(self.poses.copy())
        self.speeds.append(self.commands[:, 0])

    def _correct(self, covs: Array) -> None:
        settings, n = self.settings, self.count
        places, place_covs = self.poses[:, :2], covs[:, :2, :2]
        priors = self.target_covs
        if self.target is not None:
            drifted = [TARGET.drift(self.target, cov, self.dt_s, "jacobian") for cov in self.target_covs]
            self.target, priors = drifted[0].mean, np.array([item.cov for item in drifted])
            places = np.vstack([places, self.target[:2]])
        sight = sightings(self.poses, places[None], settings.sensing)
        seen = sight.seen.copy()
        seen[np.arange(n), np.arange(n)] = False
        self.covs = covs.copy()
        for i in range(n):
            around = np.concatenate([place_covs, priors[None, i, :2, :2]])[: len(places)]
            here = np.s_[i : i + 1]
            self.covs[i] = predicted_robot_cov(
                covs[here], sight.jacobian[here], sight.sensor[here], around, seen[here], settings.weights
            )[0]
        if self.target is not None:
            sensor, pose = sight.sensor[:, n], sight.pose_part(covs)[:, n]
            self.target_covs = np.tile(
                predicted_target_cov(priors, sensor[None], pose[None], seen[None, :, n], settings.weights)[0], (n, 1, 1)
            )
            self.seeing.append(seen[:, n])

    def run(self, steps: int) -> Field:
        for _ in range(steps):
            self.step()
        return self

    def nearest(self, begin: int = 0) -> float:
        """Least distance [m] of any two robots from step `begin` on."""
        places = np.array(self.track)[begin:, :, :2]
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        return float(apart[:, ~np.eye(self.count, dtype=bool)].min())
