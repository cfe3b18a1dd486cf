"""Rounds: when they open and end, and what neighbours have told.

At each whole multiple of the period since the start of the run every robot tells its neighbours what it believes. A
round ends when all have told who told lately, or `wait_ns` after its instant; who comes later than that counts in the
next one, with what it told carried there (`agent.estimation.jlatt`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from agent.events import LinkChange
from agent.peer_tables import Lives, remember
from agent.settings import RoundSettings
from network.messages import RoundReport, RoundStage

Report = TypeVar("Report")

PRESENT_ROUNDS = 2
"""Who was silent for so many rounds is not waited for."""

OLDEST_ROUNDS = 8
"""What is older is not used any more: nobody knows how its sender has moved since."""


@dataclass(frozen=True, slots=True, eq=False)
class Told(Generic[Report]):
    """A report and the instant it is of, on the own clock."""

    peer: str
    t_ns: int
    report: Report


class Reports(Generic[Report]):
    """The newest report of each peer."""

    def __init__(self, settings: RoundSettings, oldest_ns: int | None = None) -> None:
        """`oldest_ns`: how old a report may be to be of use; None: `OLDEST_ROUNDS`."""
        self._settings = settings
        self._oldest_ns = OLDEST_ROUNDS * settings.period_ns if oldest_ns is None else oldest_ns
        self._lives = Lives()
        self._told: dict[str, Told[Report]] = {}

    def hear(self, told: Told[Report]) -> bool:
        """Keep a report; False if a newer one is known."""
        last = self._told.get(told.peer)
        if last is not None and last.t_ns >= told.t_ns:
            return False
        remember(self._told, told.peer, told)
        return True

    def link_changed(self, event: LinkChange) -> bool:
        """Forget what a former life of a peer has told; whether there was one."""
        begun = self._lives.begun(event)
        if begun is not None:
            self._told.pop(event.peer, None)
        return begun is not None

    def newest(self, t_ns: int) -> list[Told[Report]]:
        """What is not too old at `t_ns`, in ascending order of peers."""
        oldest = t_ns - self._oldest_ns
        return [told for _, told in sorted(self._told.items()) if told.t_ns >= oldest]

    def all_told(self, t_ns: int) -> bool:
        """Whether everybody who told lately has told of the round at `t_ns`; nobody else is waited for."""
        near = t_ns - self._settings.period_ns // 2
        lately = t_ns - PRESENT_ROUNDS * self._settings.period_ns
        stamps = [told.t_ns for told in self._told.values() if told.t_ns >= lately]
        return bool(stamps) and all(stamp >= near for stamp in stamps)


class Neighbours:
    """The newest report of each peer and stage."""

    def __init__(self, settings: RoundSettings) -> None:
        self._stages: dict[RoundStage, Reports[RoundReport]] = {stage: Reports(settings) for stage in RoundStage}

    def hear(self, told: Told[RoundReport]) -> bool:
        """Keep a report; False if a newer one is known."""
        return self._stages[told.report.stage].hear(told)

    def link_changed(self, event: LinkChange) -> bool:
        """Forget what a former life of a peer has told; whether there was one."""
        changed = [reports.link_changed(event) for reports in self._stages.values()]
        return any(changed)

    def newest(self, stage: RoundStage, t_ns: int) -> list[Told[RoundReport]]:
        """What is not too old at `t_ns`, in ascending order of peers."""
        return self._stages[stage].newest(t_ns)

    def all_told(self, stage: RoundStage, t_ns: int) -> bool:
        """Whether everybody who told lately has told of the round at `t_ns`; nobody else is waited for."""
        return self._stages[stage].all_told(t_ns)


class RoundClock:
    """Instants of rounds. One at a time is open."""

    def __init__(self, settings: RoundSettings, start_ns: int) -> None:
        self._settings = settings
        self.next_ns = self._after(start_ns - 1)

    def _after(self, t_ns: int) -> int:
        """The first instant of a round later than `t_ns`."""
        period, anchor = self._settings.period_ns, self._settings.anchor_ns
        return anchor + ((t_ns - anchor) // period + 1) * period

    def due(self, t_ns: int) -> int | None:
        """The newest round not later than `t_ns`, if it has not been opened."""
        newest = self._after(t_ns) - self._settings.period_ns
        return newest if newest >= self.next_ns else None

    def leave_out(self, t_ns: int) -> int:
        """Rounds before the one at `t_ns`, which is due, are over; how many there are."""
        skipped = (t_ns - self.next_ns) // self._settings.period_ns
        self.next_ns = t_ns
        return skipped

    def open(self, t_ns: int) -> int:
        """Open the round at `t_ns`, which is due; how many have been left out before it."""
        skipped = self.leave_out(t_ns)
        self.next_ns += self._settings.period_ns
        return skipped
