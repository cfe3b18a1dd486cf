"""How a sensor sits on its robot: lever arm and turn of a mount, and what roll and pitch of the body make of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from agent.events import LEVEL
from network.messages import Mount

Array = NDArray[np.float64]


def planar_mount(x: float, y: float, yaw: float) -> Mount:
    """A sensor that is turned about the vertical only."""
    return (x, y, 0.0, 0.0, 0.0, yaw)


def mount_of(values: list[float]) -> Mount:
    """A mount stated as x, y, yaw or as x, y, z, roll, pitch, yaw."""
    if len(values) == 3:
        return planar_mount(values[0], values[1], values[2])
    x, y, z, roll, pitch, yaw = values
    return (x, y, z, roll, pitch, yaw)


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """(3, 3) Rz(yaw) Ry(pitch) Rx(roll): from the turned FLU axes to those they were turned from.

    A positive roll lowers the right side, a positive pitch the nose.
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def levelled(mount: Mount, attitude: tuple[float, float]) -> Mount:
    """The mount (x, y, z, roll, pitch, yaw) on a level body that is equal to `mount` on one with roll and pitch."""
    if attitude == LEVEL:
        return mount
    tilt = rotation(*attitude, 0.0)
    turn = tilt @ rotation(*mount[3:])
    x, y, z = (tilt @ np.array(mount[:3])).tolist()
    level = math.hypot(turn[0, 0], turn[1, 0])
    pitch = math.atan2(-turn[2, 0], level)
    if level > 1e-6:
        return (x, y, z, math.atan2(turn[2, 1], turn[2, 2]), pitch, math.atan2(turn[1, 0], turn[0, 0]))
    # Straight down or up, roll and yaw are one angle.
    return (x, y, z, 0.0, pitch, math.atan2(-turn[0, 1], turn[1, 1]))


def in_body(direction: Array, mount: Mount, attitude: tuple[float, float]) -> Array:
    """Azimuth and elevation (2,) of a sensor, as seen along the axes of the level body; the lever arm is left out."""
    _, _, _, *turns = mount
    if not any(turns) and attitude == LEVEL:
        return direction
    (cos_az, cos_el), (sin_az, sin_el) = np.cos(direction), np.sin(direction)
    ray = np.array([cos_el * cos_az, cos_el * sin_az, sin_el])
    x, y, up = rotation(*attitude, 0.0) @ rotation(*turns) @ ray
    return np.array([np.arctan2(y, x), np.arctan2(up, np.hypot(x, y))])


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A sensor on a levelled body: turn (d, d) into its axes, lever arm (d,) in them.

    `moved` is False if that is the body's own frame, `apart` is True if there is a lever arm.
    """

    turn: Array
    lever: Array
    moved: bool
    apart: bool


@lru_cache(maxsize=256)
def placed(mount: Mount, attitude: tuple[float, float], dims: int) -> Placed:
    """The sensor of a mount on a body with roll and pitch [rad], in the plane (`dims` 2) or in space (3)."""
    if dims == 2:
        turn = rotation(0.0, 0.0, mount[5])[:2, :2].T
    else:
        turn = rotation(*mount[3:]).T
    lever = turn @ np.array(mount[:dims])
    if dims == 3 and attitude != LEVEL:
        turn = turn @ rotation(*attitude, 0.0).T
    apart = bool(np.any(lever))
    turn.flags.writeable = lever.flags.writeable = False
    return Placed(turn, lever, apart or not np.array_equal(turn, np.eye(dims)), apart)
