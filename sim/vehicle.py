"""A vehicle in the plane that drives by commands: forward speed and yaw rate within its limits, between instants."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import spherical_jn

from agent.effects import Steer
from agent.estimation.motion import compose
from agent.settings import NS
from sim.scenario import VehiclePart

Array = NDArray[np.float64]


def arc(begin_mps: float, end_mps: float, yaw_rate_radps: float, seconds: float) -> Array:
    """Increment (3,) dx, dy [m], dyaw [rad] in the frame at its beginning; the speed changes evenly.

    The integral of (v + a t) e^(i w t) over T is T e^(i h) (v_mean j0(h) + i a T / 2 j1(h)) with h = w T / 2 and
    spherical Bessel functions j.
    """
    half = 0.5 * yaw_rate_radps * seconds
    mean, change = 0.5 * (begin_mps + end_mps), 0.5 * (end_mps - begin_mps)
    chord = seconds * complex(math.cos(half), math.sin(half))
    chord *= complex(mean * spherical_jn(0, half), change * spherical_jn(1, half))
    return np.array([chord.real, chord.imag, 2.0 * half])


def leg(begin_mps: float, end_mps: float, yaw_rate_radps: float, seconds: float) -> Array:
    """The same of a vehicle that drives straight on and turns at the end."""
    return np.array([0.5 * (begin_mps + end_mps) * seconds, 0.0, yaw_rate_radps * seconds])


class Vehicle:
    """Carries out the newest command until it expires, and then stands still, as far as its limits let it.

    Speed changes by `max_acceleration_mps2` (absent: at once), yaw rate at once. It stands at first.
    """

    def __init__(self, limits: VehiclePart) -> None:
        self._limits = limits
        self._way = arc if limits.turns == "along" else leg
        self._now_ns = 0
        self._wanted = self._within(0.0, 0.0)
        self._ahead: list[tuple[int, tuple[float, float]]] = []
        self.speed_mps = self._wanted[0]

    def steer(self, t_ns: int, steer: Steer) -> None:
        """A command that counts from `t_ns` on, `until_ns` being of the same clock; it replaces those before.

        Of one that is late, what is over has not happened.
        """
        begin_ns = max(t_ns, self._now_ns)
        self._ahead = [item for item in self._ahead if item[0] < begin_ns]
        if steer.until_ns > begin_ns:
            self._ahead.append((begin_ns, self._within(steer.velocity_mps[0], steer.yaw_rate_radps)))
        self._ahead.append((max(steer.until_ns, begin_ns), self._within(0.0, 0.0)))

    def advance(self, t_ns: int) -> Array:
        """Drive until `t_ns`: increment (3,) dx, dy [m], dyaw [rad] in the frame at the instant before."""
        moved = np.zeros(3)
        while self._now_ns < t_ns:
            while self._ahead and self._ahead[0][0] <= self._now_ns:
                self._wanted = self._ahead.pop(0)[1]
            end_ns = min(t_ns, self._ahead[0][0]) if self._ahead else t_ns
            moved = self._driven(moved, (end_ns - self._now_ns) / NS)
            self._now_ns = end_ns
        return moved

    def _driven(self, moved: Array, seconds: float) -> Array:
        """`moved`, and then so long with what is wanted now."""
        speed, yaw_rate = self._wanted
        pull = self._limits.max_acceleration_mps2
        changing = 0.0 if pull is None else min(seconds, abs(speed - self.speed_mps) / pull)
        if pull is not None and changing > 0.0:
            change = math.copysign(pull * changing, speed - self.speed_mps)
            reached = speed if changing < seconds else self.speed_mps + change
            moved = compose(moved, self._way(self.speed_mps, reached, yaw_rate, changing))
            self.speed_mps = reached
        else:
            self.speed_mps = speed
        if changing < seconds:
            moved = compose(moved, self._way(speed, speed, yaw_rate, seconds - changing))
        return moved

    def _within(self, speed_mps: float, yaw_rate_radps: float) -> tuple[float, float]:
        """A command within the limits."""
        limits = self._limits
        speed = min(max(speed_mps, limits.min_speed_mps), limits.max_speed_mps)
        return speed, min(max(yaw_rate_radps, -limits.max_turn_radps), limits.max_turn_radps)
