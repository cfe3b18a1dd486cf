"""Parts of files that are about motion: controls, their noise, and what an odometry is off by."""

from __future__ import annotations

import math

from agent.config_file import Finite, NotNegative, Part, Positive
from agent.estimation.odometry import OdometryNoise


class ControlPart(Part):
    """Commanded motion; `altitude_m` is held by the model `quadrotor`, others climb."""

    speed_mps: Finite = 0.0
    yaw_rate_radps: Finite = 0.0
    climb_mps: Finite = 0.0
    altitude_m: Finite = 0.0


class ControlNoisePart(Part):
    """White noise on a control, held over the scenario's step (1 sigma); on a held altitude, of each instant.

    `speed_share` and `yaw_rate_per_mps` are of noise that grows with the speed, on top of the constant one (Su 2022,
    chapter 4): what stands still has none of it.
    """

    speed_mps: NotNegative = 0.0
    yaw_rate_radps: NotNegative = 0.0
    climb_mps: NotNegative = 0.0
    altitude_m: NotNegative = 0.0
    acceleration_mps2: NotNegative = 0.0
    jerk_mps3: NotNegative = 0.0
    speed_share: NotNegative = 0.0
    yaw_rate_per_mps: NotNegative = 0.0

    def deviations(self, speed_mps: float) -> tuple[float, float]:
        """Of speed [m/s] and yaw rate [rad/s], at a speed (1 sigma)."""
        return (
            math.hypot(self.speed_mps, self.speed_share * speed_mps),
            math.hypot(self.yaw_rate_radps, self.yaw_rate_per_mps * speed_mps),
        )

    def odometry(self, step_s: float, sideways: bool = False) -> OdometryNoise:
        """The noise of an odometry that reports what is commanded, once per step.

        `sideways`: of a vehicle that moves to the side as well, and is as unsure there.
        """
        root = math.sqrt(step_s)
        return OdometryNoise(
            along_m_per_sqrt_s=self.speed_mps * root,
            across_m_per_sqrt_s=self.speed_mps * root if sideways else 0.0,
            along_share=self.speed_share,
            vertical_m_per_sqrt_s=self.climb_mps * root,
            heading_rad_per_sqrt_s=self.yaw_rate_radps * root,
            heading_rad_per_m=self.yaw_rate_per_mps,
        )


class OdometryPart(Part):
    """Random-walk rates, shares of the way and calibrated gains of an odometry; see `agent.estimation.odometry`."""

    along_m_per_sqrt_s: NotNegative = 0.02
    along_m_per_sqrt_m: NotNegative = 0.0
    along_share: NotNegative = 0.0
    across_m_per_sqrt_s: NotNegative = 0.0
    vertical_m_per_sqrt_s: NotNegative = 0.02
    heading_rad_per_sqrt_s: NotNegative = 0.005
    heading_rad_per_sqrt_rad: NotNegative = 0.0
    heading_rad_per_m: NotNegative = 0.0
    scale_along: Positive = 1.0
    scale_turn: Positive = 1.0
    lag_s: Finite = 0.0

    def noise(self) -> OdometryNoise:
        return OdometryNoise(**self.model_dump())
