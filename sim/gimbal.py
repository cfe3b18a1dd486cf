"""Cameras that point themselves: the field of view is about where the camera saw its target last.

The image alone controls the gimbal (STT 2023, section 7), so it follows detections, false ones too, and what its robot
believes does not matter: a camera and its detector need nothing from the estimator, and a wrong belief cannot turn the
camera off what it sees. Who sees nothing for a while looks around.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.settings import NS
from sim.directions import vector

Array = NDArray[np.float64]

FOLLOW_SHARE = 0.4
"""Of the way to a detection the axis goes so much per image: one that is false does not lose the target."""

LOST_NS = NS
"""After so long without a detection it looks around."""

SCAN_RADPS, SCAN_DOWN_RAD = 1.5, math.pi / 6.0
"""It looks around at this rate, counter-clockwise, so far below the horizon."""


class Gimbal:
    """The optical axis of one camera over the ground, whatever its vehicle does; `fov_rad` is the width of its cone."""

    def __init__(self, fov_rad: float, heading_rad: float) -> None:
        """It begins with looking around, forward first."""
        self._cos_half, self._start_rad = math.cos(min(0.5 * fov_rad, math.pi)), heading_rad
        self._begin()

    def _begin(self) -> None:
        self._azimuth = self._start_rad
        self._axis = vector(np.array([self._azimuth, -SCAN_DOWN_RAD]))
        self._t_ns, self._seen_ns = 0, -LOST_NS

    @property
    def axis(self) -> Array:
        """Unit vector (3,) in ENU."""
        return self._axis

    def turn(self, t_ns: int) -> None:
        """An image is taken at `t_ns`. Of an instant that is not after the last one, the run begins again."""
        if t_ns <= self._t_ns:
            self._begin()
        if t_ns - self._seen_ns > LOST_NS:
            self._azimuth += SCAN_RADPS * (t_ns - self._t_ns) / NS
            self._axis = vector(np.array([self._azimuth, -SCAN_DOWN_RAD]))
        self._t_ns = t_ns

    def sees(self, toward: Array) -> bool:
        """Whether what is in the direction (3,) in ENU, of any length, is in the image."""
        return float(self._axis @ toward) >= self._cos_half * float(np.linalg.norm(toward))

    def saw(self, toward: Array) -> None:
        """Something was detected in the direction (3,) in ENU of length 1, or imagined."""
        moved = self._axis + FOLLOW_SHARE * (toward - self._axis)
        self._axis = moved / max(float(np.linalg.norm(moved)), 1e-9)
        self._azimuth = math.atan2(self._axis[1], self._axis[0])
        self._seen_ns = self._t_ns

    def anywhere(self, uniforms: Array) -> Array:
        """A direction (3,) in ENU drawn evenly over the image, by `uniforms` (2,) in [0, 1)."""
        along = 1.0 - float(uniforms[0]) * (1.0 - self._cos_half)
        angle, across = 2.0 * math.pi * float(uniforms[1]), math.sqrt(max(0.0, 1.0 - along * along))
        first = np.cross(self._axis, [0.0, 0.0, 1.0] if abs(self._axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(self._axis, first)
        return np.asarray(along * self._axis + across * (math.cos(angle) * first + math.sin(angle) * second))


def level_turned(heading_rad: float, forward: Array) -> Array:
    """A direction (3,) forward, left, up of a level robot, in ENU."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([cos * forward[0] - sin * forward[1], sin * forward[0] + cos * forward[1], forward[2]])
