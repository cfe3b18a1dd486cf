"""What is wrong with a robot's clock, as a function of true time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from network.faults import FOREVER_NS


@dataclass(frozen=True, slots=True)
class ClockFault:
    """From `begin_ns` until `end_ns` a clock is ahead by `step_ns`, and gains `rate`, which stays afterwards."""

    begin_ns: int = 0
    end_ns: int = FOREVER_NS
    step_ns: int = 0
    rate: float = 0.0

    def offset_ns(self, t_ns: int) -> int:
        """Clock minus true time at a true instant."""
        if t_ns < self.begin_ns:
            return 0
        gained = round(self.rate * (min(t_ns, self.end_ns) - self.begin_ns))
        return gained + (self.step_ns if t_ns < self.end_ns else 0)


class FaultyClock:
    """A clock with any number of faults; more may be added."""

    def __init__(self, faults: Sequence[ClockFault] = ()) -> None:
        self._faults = list(faults)

    def add(self, fault: ClockFault) -> None:
        self._faults.append(fault)

    def local_ns(self, t_ns: int) -> int:
        """What the clock says at the true instant `t_ns`."""
        if not self._faults:
            return t_ns
        return t_ns + sum(fault.offset_ns(t_ns) for fault in self._faults)

    def true_ns(self, local_ns: int, after_ns: int) -> int:
        """A true instant, not before `after_ns`, at which the clock says `local_ns` unless something happens to it."""
        if not self._faults:
            return max(local_ns, after_ns)
        t_ns = after_ns
        # A drift makes the offset at the instant another one than now, by little: twice is enough for a microsecond.
        for _ in range(3):
            t_ns = max(after_ns, local_ns - (self.local_ns(t_ns) - t_ns))
        return t_ns

    def origin_ns(self, local_ns: int) -> int:
        """The true instant at which the clock said `local_ns`; the later one if it did so twice."""
        t_ns = local_ns
        for _ in range(4 if self._faults else 0):
            t_ns = local_ns - (self.local_ns(t_ns) - t_ns)
        return t_ns

    def changes(self) -> list[int]:
        """True instants at which the clock steps or its rate changes, in order."""
        found = {end for fault in self._faults for end in (fault.begin_ns, fault.end_ns) if end < FOREVER_NS}
        return sorted(found)
