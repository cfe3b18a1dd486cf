"""Calls when a node is due, by a clock that may be set anew; never a busy loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from agent.fleet_clock import FleetClock
from agent.lateness_figures import LatenessFigures

MIN_WAIT_S = 0.0005
MAX_WAIT_S = 60.0


class NodeTimer:
    """One deadline at a time. `clock` tells the clock that is valid now, `due` is called with its time [ns].

    `lags`: how much later than its deadline each call was.
    """

    def __init__(self, clock: Callable[[], FleetClock], due: Callable[[int], None]) -> None:
        self._clock, self._due = clock, due
        self._handle: asyncio.TimerHandle | None = None
        self._due_ns = self._set_ns = 0
        self.lags = LatenessFigures()

    def arm(self, deadline_ns: int) -> None:
        """Call at `deadline_ns`, and not at the deadline before."""
        clock = self._clock()
        now_ns = clock.now_ns()
        if self._handle is not None:
            if deadline_ns == self._due_ns:
                return
            self._handle.cancel()
            if now_ns > self._set_ns:
                # After a pause what has come in goes before the timer, and may do what that was for.
                self.lags.add(now_ns - self._set_ns)
        wait_s = min(max(clock.wall_s(deadline_ns - now_ns), MIN_WAIT_S), MAX_WAIT_S)
        self._due_ns, self._set_ns = deadline_ns, max(deadline_ns, now_ns)
        self._handle = asyncio.get_running_loop().call_later(wait_s, self._on_timer)

    def cancel(self) -> None:
        """Call no more, until it is armed: with an equal deadline too, for the clock may have been set."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None

    def _on_timer(self) -> None:
        now_ns = self._clock().now_ns()
        self._handle = None
        self.lags.add(now_ns - self._set_ns)
        self._due(now_ns)
