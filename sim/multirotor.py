"""A vehicle that flies where it is told, in any direction: velocity in three axes and yaw rate, within its limits."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.effects import Steer
from agent.settings import NS
from sim.scenario import VehiclePart

Array = NDArray[np.float64]
Motion = tuple[float, float, float, float]
"""Velocity forward, left, up [m/s] and yaw rate [rad/s]."""

STILL: Motion = (0.0, 0.0, 0.0, 0.0)

PART_NS = NS // 100
"""Motion is summed up in parts of this length at most, within which velocity changes evenly."""


class Multirotor:
    """Carries out the newest command until it expires, and then hovers, as far as its limits let it.

    Velocity changes by `max_acceleration_mps2` in any direction (absent: at once), yaw rate at once. It keeps its
    velocity when it turns: only the command is relative to the nose. It hovers at first.
    """

    def __init__(self, limits: VehiclePart) -> None:
        self._limits = limits
        self._now_ns = 0
        self._wanted = STILL
        self._ahead: list[tuple[int, Motion]] = []
        self._velocity = (0.0, 0.0, 0.0)

    def steer(self, t_ns: int, steer: Steer) -> None:
        """A command that counts from `t_ns` on, `until_ns` being of the same clock; it replaces those before.

        Of one that is late, what is over has not happened.
        """
        begin_ns = max(t_ns, self._now_ns)
        self._ahead = [item for item in self._ahead if item[0] < begin_ns]
        if steer.until_ns > begin_ns:
            self._ahead.append((begin_ns, self._within(steer)))
        self._ahead.append((max(steer.until_ns, begin_ns), STILL))

    def advance(self, t_ns: int) -> Array:
        """Fly until `t_ns`: increment (4,) forward, left, up [m], yaw [rad] in the level frame at its beginning."""
        moved = [0.0, 0.0, 0.0, 0.0]
        while self._now_ns < t_ns:
            while self._ahead and self._ahead[0][0] <= self._now_ns:
                self._wanted = self._ahead.pop(0)[1]
            end_ns = min(t_ns, self._now_ns + PART_NS, *(item[0] for item in self._ahead[:1]))
            self._fly(moved, (end_ns - self._now_ns) / NS)
            self._now_ns = end_ns
        return np.array(moved)

    def _fly(self, moved: list[float], seconds: float) -> None:
        """Add a part to `moved`. Velocities are in the level body frame: they turn the other way as the nose does."""
        ahead, left, up, rate = self._wanted
        cos, sin = math.cos(rate * seconds), math.sin(rate * seconds)
        x, y, z = self._velocity
        # In the frame of the part's end, where the command is held.
        begin = (cos * x + sin * y, cos * y - sin * x, z)
        off = (ahead - begin[0], left - begin[1], up - begin[2])
        pull, size = self._limits.max_acceleration_mps2, math.hypot(*off)
        share = 1.0 if pull is None or size <= pull * seconds else pull * seconds / size
        end = tuple(value + share * more for value, more in zip(begin, off))
        first = begin if pull is not None else end
        mean = [0.5 * (one + other) for one, other in zip(first, end)]
        turned = moved[3] + rate * seconds
        cos, sin = math.cos(turned), math.sin(turned)
        moved[0] += seconds * (cos * mean[0] - sin * mean[1])
        moved[1] += seconds * (sin * mean[0] + cos * mean[1])
        moved[2] += seconds * mean[2]
        moved[3] = turned
        self._velocity = (end[0], end[1], end[2])

    def _within(self, steer: Steer) -> Motion:
        """A command within the limits, in the same direction."""
        limits = self._limits
        ahead, left, up = steer.velocity_mps
        speed = math.hypot(ahead, left)
        share = min(1.0, limits.max_speed_mps / speed) if speed > 0.0 else 1.0
        most = limits.climb_mps
        turn = min(max(steer.yaw_rate_radps, -limits.max_turn_radps), limits.max_turn_radps)
        return share * ahead, share * left, min(max(up, -most), most), turn
