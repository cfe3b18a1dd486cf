"""Potential-field steering of a team that keeps around what it tracks (AJLATT-C: Su 2022, eq. 3.2-3.6).

Every robot is drawn to the target, moves along with it, and is pushed off its neighbours and the target: hard below
`apart_m`, gently drawn together between that and the radio range. The thesis prints the push in a form that is
infinite at `closest_m`; here it is radial and capped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap

Array = NDArray[np.float64]

STEEPEST_M = 0.1
"""Distances from `closest_m` below this push no harder."""


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

    def commands(self, poses: Array, targets: Array, target_velocities: Array, weights: Array) -> Array:
        """Commands (n, 2) of speed [m/s] and yaw rate [rad/s] for robots at `poses` (n, 3): x, y, heading.

        targets (n, 2) and target_velocities (n, 2) are what each robot believes of the target, weights (n,) how much
        that counts among neighbours (eq. 3.3: the inverse trace of the belief's covariance).
        """
        places = poses[:, :2]
        between = places[:, None, :] - places[None, :, :]
        heard = np.linalg.norm(between, axis=-1) < self.radio_range_m
        share = weights * heard
        share = share / share.sum(axis=1, keepdims=True)
        from_targets = places[:, None, :] - targets[None, :, :]
        others = ~np.eye(len(poses), dtype=bool)
        pushed = np.sum(self.push(between) * (heard & others)[..., None], axis=1)
        pushed = pushed + np.sum(self.push(from_targets) * heard[..., None], axis=1)
        drawn = np.einsum("ij,ijk->ik", share, target_velocities[None] - self.attraction * from_targets)
        u = drawn - self.repulsion * pushed
        turn = -self.heading_gain * wrap(poses[:, 2] - np.arctan2(u[:, 1], u[:, 0]))
        speed = np.minimum(np.linalg.norm(u, axis=1), self.max_speed_mps)
        return np.stack([speed, np.clip(turn, -self.max_turn_radps, self.max_turn_radps)], axis=1)
