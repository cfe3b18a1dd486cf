"""Potential-field steering of a team that keeps around what it tracks (AJLATT-C: Su 2022, eq. 3.2-3.6).

Every robot is drawn to the target, moves along with it, and is pushed off its neighbours and the target: hard below
`apart_m`, gently drawn together between that and the radio range. The thesis prints the push in a form that is
infinite at `closest_m`; here it is radial and capped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap, wrap_scalar
from agent.planning.situation import Command, Situation
from agent.planning.team_view import Believer, believers, usable

Array = NDArray[np.float64]

STEEPEST_M = 0.1
"""Distances from `closest_m` below this push no harder."""

SLOW_SHARE = 0.2
"""A robot with less than this share of its speed to drive faces the target, or stands still if there is none."""


@dataclass(frozen=True, slots=True)
class PotentialLaw:
    """Gains of the law; `heading_gain` [1/s] turns the robot to where it is to go."""

    attraction: float = 1.0
    repulsion: float = 0.015
    heading_gain: float = 1.0
    closest_m: float = 6.0
    apart_m: float = 10.0
    radio_range_m: float = 30.0
    max_speed_mps: float = 0.5
    max_turn_radps: float = float(np.pi) / 5.0

    def push(self, apart: Array) -> Array:
        """g (..., 2) of vectors (..., 2) [m] from a neighbour to the robot; zero at zero distance.

        It points to the neighbour where robots are too near: the command subtracts it (eq. 3.4).
        """
        d = np.linalg.norm(apart, axis=-1, keepdims=True)
        near = 20.0 * (d - self.apart_m) / np.maximum(d - self.closest_m, STEEPEST_M)
        far = 0.5 * np.sin(np.pi * (d - self.apart_m) / (self.radio_range_m - self.apart_m))
        size = np.where(d < self.apart_m, near, np.where(d < self.radio_range_m, far, 0.0))
        return np.asarray(size * apart / np.maximum(d, 1e-9))

    def pushed(self, places: Array, others: Array, counted: Array) -> Array:
        """Sum (n, 2) of the pushes of robots at `places` (n, 2) from `others` (m, 2) where `counted` (n, m)."""
        return np.asarray(np.sum(self.push(places[:, None, :] - others[None, :, :]) * counted[..., None], axis=1))

    def drawn(self, places: Array, targets: Array, target_velocities: Array, weights: Array) -> Array:
        """Pull (n, 2) of robots at `places` (n, 2) to beliefs of a target (m, 2) that moves with (m, 2) [m/s].

        weights (n, m): how much each belief counts for each robot, normalized here (eq. 3.3).
        """
        share = weights / weights.sum(axis=1, keepdims=True)
        from_targets = places[:, None, :] - targets[None, :, :]
        return np.asarray(np.einsum("ij,ijk->ik", share, target_velocities[None] - self.attraction * from_targets))

    def steered(self, headings: Array, u: Array) -> Array:
        """Commands (n, 2) of robots with `headings` (n,) [rad] that are to move with u (n, 2) [m/s] (eq. 3.6)."""
        turn = -self.heading_gain * wrap(headings - np.arctan2(u[:, 1], u[:, 0]))
        speed = np.minimum(np.linalg.norm(u, axis=1), self.max_speed_mps)
        return np.stack([speed, np.clip(turn, -self.max_turn_radps, self.max_turn_radps)], axis=1)

    def commands(self, poses: Array, targets: Array, target_velocities: Array, weights: Array) -> Array:
        """Commands (n, 2) of speed [m/s] and yaw rate [rad/s] for robots at `poses` (n, 3): x, y, heading.

        targets (n, 2) and target_velocities (n, 2) are what each robot believes of the target, weights (n,) how much
        that counts among neighbours (eq. 3.3: the inverse trace of the belief's covariance).
        """
        places = poses[:, :2]
        heard = np.linalg.norm(places[:, None, :] - places[None, :, :], axis=-1) < self.radio_range_m
        others = ~np.eye(len(poses), dtype=bool)
        pushed = self.pushed(places, places, heard & others) + self.pushed(places, targets, heard)
        u = self.drawn(places, targets, target_velocities, weights * heard) - self.repulsion * pushed
        return self.steered(poses[:, 2], u)


@dataclass(frozen=True, slots=True)
class PotentialPlanner:
    """AJLATT-C on beliefs: every robot steers itself by its own estimates and by what its neighbours tell of theirs.

    As `published` a robot that faces away from where it is to go drives on while it turns, and beliefs count as told.
    `improved`, it drives as far as it faces where it is to go, it faces the target while it has next to nothing to do,
    and beliefs of the target are moved on to the present; robots are taken to be where they were when they told.
    Of several targets the nearest draws a robot, and all push it off. Without any it moves away from neighbours nearer
    than `apart_m`, and stands still apart from that.
    """

    law: PotentialLaw
    improved: bool

    def command(self, situation: Situation) -> Command:
        """Within the law's limits; see `agent.planning.situation.Planner`."""
        situation = usable(situation)
        law, pose = self.law, situation.own.pose
        place = pose[None, :2]
        others = np.array([member.pose[:2] for member in situation.others]).reshape(-1, 2)
        targets = believers(situation, present=self.improved)
        if not targets:
            near = np.linalg.norm(place - others, axis=1) < law.apart_m
            u = -law.repulsion * law.pushed(place, others, near[None])[0]
            return self._turned_to(pose, u, None)
        pulls = [self._pull(place, views) for views in targets.values()]
        toward, drawn = min(pulls, key=lambda pull: float(np.linalg.norm(pull[0])))
        beliefs = np.array([believer.place for views in targets.values() for believer in views])
        pushed = law.pushed(place, np.vstack([others, beliefs]), np.ones((1, len(others) + len(beliefs))))
        return self._turned_to(pose, drawn - law.repulsion * pushed[0], toward)

    def _pull(self, place: Array, views: tuple[Believer, ...]) -> tuple[Array, Array]:
        """Vector (2,) [m] from the robot at `place` (1, 2) to what is believed of a target, and the pull (2,) to it."""
        weights = np.array([[believer.certainty for believer in views]])
        places = np.array([believer.place for believer in views])
        velocities = np.array([believer.velocity for believer in views])
        return weights[0] / weights.sum() @ places - place[0], self.law.drawn(place, places, velocities, weights)[0]

    def _turned_to(self, pose: Array, u: Array, toward: Array | None) -> Command:
        """The command of a robot that is to move with u (2,) [m/s], with a target in the direction `toward` (2,)."""
        speed, turn = self.law.steered(pose[2:], u[None])[0].tolist()
        slow = speed < SLOW_SHARE * self.law.max_speed_mps
        if slow and toward is None:
            return Command(0.0, 0.0)
        if self.improved:
            speed *= max(0.0, math.cos(wrap_scalar(math.atan2(u[1], u[0]) - pose.item(2))))
            if slow and toward is not None:
                turn = self.law.steered(pose[2:], toward[None])[0].item(1)
        return Command(speed, turn)
