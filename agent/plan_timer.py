"""How long plans take, and whether one took too long; the clock is the caller's."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from agent.node import Outgoing

KEPT = 1000


class PlanTimer:
    """Times the calls of a node that end in a `Steer`: those in which a plan was made."""

    def __init__(self, overrun_ns: int, clock_ns: Callable[[], int]) -> None:
        """`overrun_ns`: a plan that takes longer took too long. Times are of `clock_ns`, whatever that is."""
        self._overrun_ns, self._clock_ns = overrun_ns, clock_ns
        self._took_us: deque[int] = deque(maxlen=KEPT)
        self.overruns = 0

    def timed(self, call: Callable[[], Outgoing]) -> tuple[Outgoing, bool]:
        """What the call gives, and whether it made a plan that took too long."""
        begun_ns = self._clock_ns()
        out = call()
        if out.steer is None:
            return out, False
        took_ns = self._clock_ns() - begun_ns
        self._took_us.append(took_ns // 1000)
        overran = took_ns > self._overrun_ns
        self.overruns += overran
        return out, overran

    def told(self) -> list[int]:
        """How long the last plans took [us]."""
        return list(self._took_us)
