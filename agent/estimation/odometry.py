"""Noise of an odometry increment, from rates a person can calibrate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """Random-walk rates of an odometry: each variance is (rate_s^2 x seconds + rate_m^2 x metres + ...).

    `along_share` and `heading_rad_per_m` are of an error that stays the same within an increment: (share x metres)^2,
    (rad_per_m x metres)^2; so they depend on how long increments are. What stands still has none of it.
    `scale_along` and `scale_turn` are calibrated gains: true motion = scale x reported motion. `lag_s` is how much
    later than its stamps the motion happens, where a command is reported.
    """

    along_m_per_sqrt_s: float = 0.02
    along_m_per_sqrt_m: float = 0.0
    across_m_per_sqrt_s: float = 0.0
    vertical_m_per_sqrt_s: float = 0.02
    heading_rad_per_sqrt_s: float = 0.005
    heading_rad_per_sqrt_rad: float = 0.0
    scale_along: float = 1.0
    scale_turn: float = 1.0
    lag_s: float = 0.0
    along_share: float = 0.0
    heading_rad_per_m: float = 0.0

    def calibrated(self, delta: Array) -> Array:
        """The increment (dx, dy, dz, dyaw) with the calibrated gains applied."""
        return np.asarray(delta * np.array([self.scale_along, self.scale_along, 1.0, self.scale_turn]))

    def covariance(self, delta: Array, dt_s: float) -> Array:
        """(4, 4) covariance of the calibrated increment (dx, dy, dz, dyaw), shape (4,), over `dt_s`."""
        dt = max(dt_s, 0.0)
        distance = math.hypot(float(delta[0]), float(delta[1]))
        along = self.along_m_per_sqrt_s**2 * dt + self.along_m_per_sqrt_m**2 * distance
        along += (self.along_share * distance) ** 2
        across = self.across_m_per_sqrt_s**2 * dt
        vertical = self.vertical_m_per_sqrt_s**2 * dt
        turn = self.heading_rad_per_sqrt_s**2 * dt + self.heading_rad_per_sqrt_rad**2 * abs(float(delta[3]))
        turn += (self.heading_rad_per_m * distance) ** 2
        return np.diag([along, across, vertical, turn])
