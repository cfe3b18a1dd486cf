"""Odometry increments from what an autopilot reports: differences of poses, or integrated velocity.

An increment is (dx, dy, dz, dyaw) in the levelled body frame at its beginning (forward, left, up, counter-clockwise),
so it does not depend on where the autopilot's local frame lies or how it is turned. Increments are chained: each
begins exactly at the fleet instant at which the one before ended, whatever the clock offset did in between.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.frames import level_body, wrap

Array = NDArray[np.float64]

MAX_WAITING = 32


@dataclass(frozen=True, slots=True)
class OdometryLimits:
    """Beyond these an increment is not believed and the chain begins anew."""

    max_speed_mps: float = 30.0
    max_yaw_rate_radps: float = 20.0
    max_gap_ns: int = 10_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Increment:
    """Motion `delta` (4,) over the fleet interval [t0_ns, t1_ns]."""

    t0_ns: int
    t1_ns: int
    delta: Array


@dataclass(frozen=True, slots=True, eq=False)
class Stamped:
    """A vector (3,) and a heading [rad] at an instant of the boot clock and of the fleet clock."""

    boot_ns: int
    fleet_ns: int
    vector: Array
    heading: float


class _Chain:
    """The end of the last increment, and the checks that both sources share."""

    def __init__(self, limits: OdometryLimits, counters: Counter[str]) -> None:
        self._limits, self._counters = limits, counters
        self._last: Stamped | None = None

    def restart(self) -> None:
        """The next datum begins a new chain."""
        self._last = None

    def _usable(self, last: Stamped, new: Stamped) -> bool:
        """False for a datum that adds nothing now; a long gap begins a new chain."""
        if new.boot_ns <= last.boot_ns:
            self._counters["mavlink.out_of_order"] += 1
            return False
        if new.fleet_ns <= last.fleet_ns:
            # The offset was corrected backwards: the motion goes into the next increment.
            self._counters["mavlink.stamp_held"] += 1
            return False
        if new.boot_ns - last.boot_ns > self._limits.max_gap_ns:
            self._counters["mavlink.odometry_gap"] += 1
            self._last = new
            return False
        return True

    def _checked(self, last: Stamped, new: Stamped, delta: Array) -> Increment | None:
        self._last = new
        seconds = (new.boot_ns - last.boot_ns) * 1e-9
        fast = float(np.linalg.norm(delta[:3])) > self._limits.max_speed_mps * seconds
        if fast or abs(float(delta[3])) > self._limits.max_yaw_rate_radps * seconds:
            self._counters["mavlink.odometry_jump"] += 1
            return None
        return Increment(last.fleet_ns, new.fleet_ns, delta)


class PoseOdometry(_Chain):
    """Differences of poses in a local frame of the autopilot."""

    def __init__(self, limits: OdometryLimits, counters: Counter[str]) -> None:
        super().__init__(limits, counters)
        self._reset_counter = 0

    def pose(self, pose: Stamped, reset_counter: int) -> Increment | None:
        """Take a pose (`vector` a position, ENU axes); a changed reset counter begins a new chain."""
        last = self._last
        if last is None:
            self._last, self._reset_counter = pose, reset_counter
            return None
        if not self._usable(last, pose):
            return None
        if reset_counter != self._reset_counter:
            self._counters["mavlink.odometry_reset"] += 1
            self._last, self._reset_counter = pose, reset_counter
            return None
        moved = level_body(pose.vector - last.vector, last.heading)
        return self._checked(last, pose, np.append(moved, wrap(pose.heading - last.heading)))


class VelocityOdometry(_Chain):
    """Velocity integrated by the trapezoidal rule, turned into the body by the attitude's heading.

    A velocity waits until attitudes on both sides of its instant are known; headings are interpolated.
    """

    def __init__(self, limits: OdometryLimits, counters: Counter[str]) -> None:
        super().__init__(limits, counters)
        self._headings: deque[tuple[int, float]] = deque(maxlen=MAX_WAITING)
        self._waiting: deque[tuple[int, int, Array]] = deque()

    def restart(self) -> None:
        super().restart()
        self._headings.clear()
        self._waiting.clear()

    def attitude(self, boot_ns: int, heading: float) -> list[Increment]:
        """Take a heading; returns the increments it completes."""
        if self._headings and boot_ns <= self._headings[-1][0]:
            self._counters["mavlink.out_of_order"] += 1
            return []
        self._headings.append((boot_ns, heading))
        return self._complete()

    def velocity(self, boot_ns: int, fleet_ns: int, velocity: Array) -> list[Increment]:
        """Take a velocity (3,) [m/s, ENU axes]; returns the increments it completes."""
        if self._waiting and boot_ns <= self._waiting[-1][0]:
            self._counters["mavlink.out_of_order"] += 1
            return []
        if len(self._waiting) >= MAX_WAITING:
            self._counters["mavlink.no_attitude"] += 1
            self._waiting.popleft()
        self._waiting.append((boot_ns, fleet_ns, velocity))
        return self._complete()

    def _complete(self) -> list[Increment]:
        increments = []
        while self._waiting and self._headings and self._headings[-1][0] >= self._waiting[0][0]:
            boot_ns, fleet_ns, velocity = self._waiting.popleft()
            heading = self._heading_at(boot_ns)
            if heading is None:
                self._counters["mavlink.no_attitude"] += 1
                continue
            increment = self._step(Stamped(boot_ns, fleet_ns, velocity, heading))
            if increment is not None:
                increments.append(increment)
        return increments

    def _heading_at(self, boot_ns: int) -> float | None:
        after = None
        for t_ns, heading in reversed(self._headings):
            if t_ns == boot_ns:
                return heading
            if t_ns < boot_ns:
                if after is None or after[0] - t_ns > self._limits.max_gap_ns:
                    return None
                share = (boot_ns - t_ns) / (after[0] - t_ns)
                return wrap(heading + share * wrap(after[1] - heading))
            after = (t_ns, heading)
        return None

    def _step(self, new: Stamped) -> Increment | None:
        last = self._last
        if last is None:
            self._last = new
            return None
        if not self._usable(last, new):
            return None
        seconds = (new.boot_ns - last.boot_ns) * 1e-9
        moved = level_body(0.5 * seconds * (last.vector + new.vector), last.heading)
        delta = np.append(moved, wrap(new.heading - last.heading))
        return self._checked(last, new, delta) if math.isfinite(float(delta.sum())) else None
