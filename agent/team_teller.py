"""What a robot tells its team: odometry since an anchor, and each measurement twice.

A report holds measurements of the newest instant and the one before, and odometry of some more. Odometry is summed
since an anchor that is renewed from time to time, and the end of the sum before is in every report: whatever is lost,
the next report tells how far the robot has moved.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from agent.estimation.reckoning import extended
from agent.settings import NS
from network.messages import MAX_MESSAGE_BYTES, MAX_RAW_MEASUREMENTS, RawMeasurement, Reckoning, TeamReport
from network.wire import size_bound

Array = NDArray[np.float64]

ANCHOR_NS = 600 * NS
"""How long odometry is summed. A peer that hears nothing for longer than this does not know what happened meanwhile."""


REPEATS = 2
"""How often odometry of an instant is told again: what a peer measured at an instant nobody has told of is no use."""


class Teller:
    """Own odometry and measurements on their way to the team."""

    def __init__(self, born_ns: int) -> None:
        self._born_ns = self._anchor_ns = self._t_ns = born_ns
        self._total = np.zeros(4), np.zeros((4, 4))
        self._ends: deque[Reckoning] = deque(maxlen=2)
        self._last: deque[Reckoning] = deque(maxlen=REPEATS)
        self._moves: list[Reckoning] = []
        self._fresh: list[RawMeasurement] = []
        self._repeats: list[RawMeasurement] = []
        self._counts: dict[int, int] = {}

    def moved(self, t_ns: int, delta: Array, cov: Array) -> Reckoning:
        """An increment of odometry (4,), (4, 4) up to `t_ns`."""
        self._total = extended(*self._total, delta, cov)
        found = Reckoning(self._anchor_ns, self._t_ns, t_ns, *self._total)
        self._t_ns = t_ns
        self._moves.append(found)
        if t_ns - self._anchor_ns >= ANCHOR_NS:
            self._ends.append(found)
            self._anchor_ns, self._total = t_ns, (np.zeros(4), np.zeros((4, 4)))
        return found

    def index(self, t_ns: int, oldest_ns: int) -> int:
        """The number of a new measurement among those of its instant; instants before `oldest_ns` are over."""
        if len(self._counts) > 2 * MAX_RAW_MEASUREMENTS and min(self._counts) < oldest_ns:
            self._counts = {known: count for known, count in self._counts.items() if known >= oldest_ns}
        index = self._counts.get(t_ns, 0)
        self._counts[t_ns] = index + 1
        return index

    def measured(self, item: RawMeasurement) -> None:
        self._fresh.append(item)

    def due_ns(self) -> int | None:
        """The earliest instant there is something to tell of."""
        first = [self._moves[0].t_ns] if self._moves else []
        return min([*first, *(item.t_ns for item in self._fresh)], default=None)

    def reports(self, until_ns: int) -> list[TeamReport]:
        """What is to be told of instants up to `until_ns`, in order: a report per instant of the odometry."""
        moves = [item for item in self._moves if item.t_ns <= until_ns]
        del self._moves[: len(moves)]
        found = []
        for move in moves:
            found += self._split(move, self._taken(move.t_ns))
        if left := self._taken(until_ns):
            found += self._split(None, left)
        return found

    def _taken(self, until_ns: int) -> list[RawMeasurement]:
        """Measurements up to an instant that were not told yet; they count as told."""
        taken = [item for item in self._fresh if item.t_ns <= until_ns]
        self._fresh = [item for item in self._fresh if item.t_ns > until_ns]
        return taken

    def _split(self, move: Reckoning | None, fresh: list[RawMeasurement]) -> list[TeamReport]:
        """One report, or as many as it takes to fit; the last of them has what is repeated, as far as there is room."""
        recent = [*self._last] if move is None else [*self._last, move]
        ends = [item for item in self._ends if recent and item.t_ns == recent[-1].anchor_ns]
        moves = {item.t_ns: item for item in (*ends, *recent)}
        reckonings = tuple(moves[t_ns] for t_ns in sorted(moves))
        found, rest, repeats = [], list(fresh), list(self._repeats)
        while True:
            part = list(rest)
            while not _fits(report := TeamReport(self._born_ns, reckonings, tuple(part))):
                part.pop()
            rest = rest[len(part) :]
            if not rest:
                break
            found.append(report)
        while not _fits(report := TeamReport(self._born_ns, reckonings, (*part, *repeats))):
            repeats.pop(0)
        self._repeats = fresh
        if move is not None:
            self._last.append(move)
        return [*found, report]


def _fits(report: TeamReport) -> bool:
    return len(report.measurements) <= MAX_RAW_MEASUREMENTS and size_bound(report) <= MAX_MESSAGE_BYTES
