"""Writes a robot's state file from time to time, beside the event loop, and never more than one at a time."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter

from agent.effects import Estimate
from agent.state_file import StateFile

log = logging.getLogger("cofix.agent")


class StateKeeper:
    """Keeps the newest estimate on disk, at most every `interval_ns` of fleet time.

    A disk that is full or gone is counted as `state.write_failed`, said once until it is better, and stops nothing.
    """

    def __init__(self, file: StateFile, interval_ns: int, counters: Counter[str]) -> None:
        self._file, self._interval_ns, self._counters = file, interval_ns, counters
        self._newest: Estimate | None = None
        self._written: Estimate | None = None
        self._task: asyncio.Task[None] | None = None
        self._failing = False

    def published(self, estimate: Estimate) -> None:
        """A new estimate."""
        self._newest = estimate
        if self._task is not None and not self._task.done():
            return
        if self._written is None or estimate.t_ns - self._written.t_ns >= self._interval_ns:
            self._written = estimate
            self._task = asyncio.get_running_loop().create_task(asyncio.to_thread(self._write, estimate))

    async def close(self) -> None:
        """Write the newest estimate down."""
        if self._task is not None:
            await self._task
        if self._newest is not None and self._newest is not self._written:
            self._write(self._newest)

    def _write(self, estimate: Estimate) -> None:
        try:
            self._file.write(estimate)
        except OSError as error:
            self._counters["state.write_failed"] += 1
            if not self._failing:
                log.warning("the state file cannot be written (%s): a restart would begin without it", error.strerror)
            self._failing = True
            return
        self._failing = False
        self._counters["state.written"] += 1
