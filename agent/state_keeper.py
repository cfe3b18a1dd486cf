"""What a start does with the state file, and when a running robot writes it.

If the state that a message of a contact relies on cannot be written (a full disk), the file is put aside, which needs
no space, and the message goes out: a start that finds no state begins a new life, its peers begin anew with it, and
that is sound. If not even that is possible (a disk that is read-only by now), a later start would begin with a state
that knows less than its peers: then the messages of contacts are held back, as if they had been lost. Own data and
contacts are used all the same, and nothing stops. Forms without factors rely on nothing; their file stays as it is.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections import Counter
from dataclasses import dataclass

from agent.effects import Alarm, Persist
from agent.saved_state import begun_again, decode, given_up
from agent.settings import NS, AgentSettings
from agent.state_fields import StateError
from agent.state_file import Found, StateFile, next_incarnation

log = logging.getLogger("cofix.agent")


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """How a robot begins: its settings, its incarnation, and the state it goes on with, if there is one.

    `again`: it has lived before, and its settings are those of `agent.saved_state.begun_again`.
    """

    settings: AgentSettings
    incarnation: int
    state: bytes | None = None
    again: bool = False


def start(
    found: Found,
    settings: AgentSettings,
    now_ns: int,
    max_age_ns: int,
    run_ns: int | None,
    wall_ns: int,
    first: int | None = None,
) -> tuple[Start, str | None]:
    """How to begin with what was found, and why its state is not used, if it is not.

    now_ns    fleet time; run_ns: when the run began, if the fleet's clock is that of a run
    wall_ns   time of day, for the number of a life that nothing is known of before, unless that is `first`
    """
    reason = None
    if found.incarnation is not None and found.state is not None:
        try:
            decode(found.state, settings).check_age(now_ns, max_age_ns, run_ns)
            return Start(settings, found.incarnation, found.state), None
        except StateError as error:
            reason = error.reason
    # The survey of a run is of its start: who begins later has lived before, or has stood where nobody knows.
    late = run_ns is not None and now_ns - run_ns > max(settings.lateness.horizon_ns, NS)
    lived = run_ns is not None and (found.incarnation is not None or found.refused is not None)
    again = late or lived
    lost = again or found.incarnation is not None or found.refused is not None
    given = first is not None and found.incarnation is None and (first > 1 or not lost)
    incarnation = first if given and first is not None else next_incarnation(found.incarnation, wall_ns)
    return Start(begun_again(settings) if again else settings, incarnation, None, again), reason


def succeed(settings: AgentSettings, state: bytes | None, incarnation: int) -> Start:
    """How a process goes on whose life its peers hold to be over: in a new one, correlations given up.

    `settings` are those of its first start, `state` what it knows now.
    """
    kept = None if state is None else given_up(settings, state)
    return Start(begun_again(settings) if kept is None else settings, incarnation, kept, kept is None)


class StateKeeper:
    """Writes the states of one life. Writes that nothing waits for are done beside the event loop, one at a time."""

    def __init__(self, file: StateFile, incarnation: int, counters: Counter[str]) -> None:
        self._file, self._incarnation, self._counters = file, incarnation, counters
        self._lock = threading.Lock()
        self._number = self._written = 0
        self._waiting: tuple[int, bytes] | None = None
        self._task: asyncio.Task[None] | None = None
        self._failure: str | None = None

    def keep(self, persist: Persist) -> bool:
        """Write a state; False if packets that go with it must not be sent."""
        self._number += 1
        if persist.ahead:
            return self._write(self._number, persist.payload) or self._file.refuse()
        self._waiting = self._number, persist.payload
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._write_waiting())
        return True

    async def _write_waiting(self) -> None:
        while self._waiting is not None:
            (number, payload), self._waiting = self._waiting, None
            await asyncio.to_thread(self._write, number, payload)

    def begin(self, begin: Start, unused: str | None, refused: str | None) -> None:
        """Write down that this life has begun; `unused`: why a state was not used, `refused`: why a file was not."""
        if unused is not None:
            self._file.refuse()
        reason = unused or refused
        if reason is not None:
            self._counters[f"state.refused_{reason}"] += 1
            log.warning("the saved state is not used: %s; it is kept as state.bad", reason)
        if begin.state is not None:
            self._counters["state.used"] += 1
        elif not self._write(0, None):
            log.warning("the state file cannot be written: the next start will not know of this one")

    def succeed(self, begin: Start) -> None:
        """Another life begins in the same process: no state of the one before is written from now on."""
        self._number += 1
        with self._lock:
            # Of states of the life before that still wait, none is written under the new number.
            self._incarnation, self._written = begin.incarnation, self._number
        if not self._write(self._number, begin.state):
            self._file.refuse()

    def _write(self, number: int, payload: bytes | None) -> bool:
        with self._lock:
            if number < self._written:
                return True
            # Whatever becomes of it: no older state is written after it.
            self._written = number
            try:
                self._file.write(self._incarnation, payload)
            except OSError as error:
                self._failure = error.strerror or type(error).__name__
                self._counters["state.write_failed"] += 1
                return False
            self._failure = None
            self._counters["state.written"] += 1
            return True

    def alarms(self) -> list[Alarm]:
        """What a person should know, as long as it is so."""
        return [] if self._failure is None else [Alarm("state.write_failed", self._failure)]

    async def close(self, state: bytes | None) -> None:
        """Write the last state down at a clean end."""
        if self._task is not None:
            await self._task
        if state is not None:
            self._number += 1
            self._write(self._number, state)
