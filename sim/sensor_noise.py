"""How noisy simulated sensors and odometry are: covariances as estimators are told of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.estimation.odometry import OdometryNoise
from sim.scenario import RobotPart, SensorPart

Array = NDArray[np.float64]


def control_odometry(robot: RobotPart, step_s: float) -> OdometryNoise:
    """The odometry noise a robot's estimator assumes: stated, or that of its control noise."""
    if robot.odometry is not None:
        return robot.odometry.noise()
    return robot.noise.odometry(step_s, robot.vehicle.flies)


def relative_noise(kind: str, sensor: SensorPart, distance_m: float) -> Array:
    """R (m, m) of a relative measurement at a distance."""
    sigma_m = (sensor.sigma_m or 0.0) + sensor.sigma_m_per_m * distance_m
    sigma_rad, sigma_px = sensor.sigma_rad or 0.0, sensor.sigma_px or 0.0
    diagonal = {
        "range": [sigma_m],
        "bearing": [sigma_rad],
        "bearing3": [sigma_rad, sigma_rad],
        "pixel": [sigma_px, sigma_px],
        "range_bearing": [sigma_m, sigma_rad],
        "vector": [sigma_m, sigma_m],
    }[kind]
    return np.diag(np.square(diagonal))


def absolute_noise(kind: str, sensor: SensorPart, spatial: bool = False) -> Array:
    """R (m, m) of an absolute fix; `spatial` ones have an altitude."""
    m, rad = sensor.sigma_m or 0.0, sensor.sigma_rad or 0.0
    z = m if sensor.sigma_z_m is None else sensor.sigma_z_m
    place = [m, m, z] if spatial else [m, m]
    return np.diag(np.square({"position": place, "pose": [*place, rad], "heading": [rad], "altitude": [z]}[kind]))
