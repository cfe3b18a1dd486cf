"""The fleet clock of a process: system time on a robot, scaled monotonic time in a simulated run.

The one place below the launcher that reads a clock; the core never sees it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

from agent.clock_faults import FaultyClock


@dataclass(frozen=True, slots=True)
class FleetClock:
    """t = t0 + speed x (wall - wall0).

    `monotonic0_ns` None: the system clock (nanoseconds since the Unix epoch), the only choice with a real
    autopilot. Otherwise `CLOCK_MONOTONIC`, which all processes of one computer share.
    """

    t0_ns: int = 0
    monotonic0_ns: int | None = None
    speed: float = 1.0
    faulty: FaultyClock | None = None

    def now_ns(self) -> int:
        """What this process takes the time to be."""
        true_ns = self.true_ns()
        return true_ns if self.faulty is None else self.faulty.local_ns(true_ns)

    def true_ns(self) -> int:
        """Fleet time; another one than `now_ns` only where a clock fault is injected."""
        if self.monotonic0_ns is None:
            return time.time_ns()
        return self.t0_ns + int((time.monotonic_ns() - self.monotonic0_ns) * self.speed)

    def wall_s(self, fleet_ns: int) -> float:
        """Seconds of wall time that `fleet_ns` of fleet time last."""
        return fleet_ns / self.speed * 1e-9
