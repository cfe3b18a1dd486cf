"""Own data that come late, put back in their right place: what a bounded rewind of the filter needs.

The log holds the own data within the horizon in one order that does not depend on their arrival, the odometry beside
it, and a mark of the filter at each instant it has left. Data that come late lead back to the last mark before them;
from there everything is used again in order, once, however many of them there are.

Nothing that peers were told can be taken back. A contact therefore ends what can be done again: the first mark is that
after the last contact. Earlier data go to the filter there, as late ones, and what was used since is used again.

Bounds: `MAX_LOGGED` data, `MAX_MARKS` marks and the increments of a track, all of them within the horizon, which is cut
short beyond that. A rewind uses up an allowance by what it does again, and waits while there is none; so late data, of
whatever number, cost `STEPS_PER_S` uses a second at most in the long run.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter
from dataclasses import dataclass

from agent.cooperative_filter import FilterMark
from agent.events import Odometry
from agent.settings import NS
from agent.timeline import MAX_INCREMENTS, Gap, Item, ItemKey, OdometryTrack, Phase, item_key

MAX_LOGGED = 4096
MAX_MARKS = 2048
STEPS_PER_S = 1000
"""Data and instants used again per second, in the long run; an agent's own rate is a tenth of it."""

MAX_ALLOWANCE = 4096


@dataclass(slots=True, eq=False)
class Record:
    """An own datum.

    used      the number of its last use, of all uses; None: it is to be used, for the first time or again
    waiting   it is in the timeline
    counted   it was used before, and stands in the figures
    late      it came after its place in the order
    """

    key: ItemKey
    item: Item
    used: int | None = None
    waiting: bool = True
    counted: bool = False
    late: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """The filter at `t_ns` after so many uses, and the gap of the odometry there."""

    t_ns: int
    uses: int
    filter: FilterMark
    gap_ns: Gap


class ReplayLog:
    """What is needed to go back; `agent.core` goes."""

    def __init__(self, horizon_ns: int, tolerance_ns: int, start_ns: int, counters: Counter[str]) -> None:
        self._horizon_ns, self._tolerance_ns, self._counters = horizon_ns, tolerance_ns, counters
        self._records: list[Record] = []
        self._ends: list[tuple[int, int]] = []
        self._increments: list[Odometry] = []
        self._marks: list[Mark] = []
        self._uses = 0
        self._last: ItemKey | None = None
        self._floor_ns = start_ns - horizon_ns - 1
        self._dirty_ns: int | None = None
        self._allowance, self._allowed_ns = float(MAX_ALLOWANCE), start_ns

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What is kept, and the most there may be of it, by name."""
        return {
            "replay.data": (len(self._records), MAX_LOGGED),
            "replay.odometry": (len(self._increments), MAX_INCREMENTS),
            "replay.marks": (len(self._marks), MAX_MARKS),
        }

    # -- data -----------------------------------------------------------------------------------------------

    def take(self, item: Item, state_ns: int) -> bool:
        """A new own datum; whether it belongs into the timeline.

        Otherwise it waits here for a rewind, or it is counted: too old, or known already.
        """
        if item.t_ns <= max(self._floor_ns, state_ns - self._horizon_ns):
            self._counters["late.too_old"] += 1
            return False
        record = Record(item_key(item), item)
        if self._find(record.key) is not None:
            self._counters["input.duplicate"] += 1
            return False
        if len(self._records) >= MAX_LOGGED:
            self._counters["replay.horizon_cut"] += 1
            self._forget(self._records[MAX_LOGGED // 16].item.t_ns)
        if len(self._records) >= MAX_LOGGED or item.t_ns <= self._floor_ns:
            self._counters["input.overflow"] += 1
            return False
        insort(self._records, record, key=_key)
        if item.phase is Phase.PAIR:
            # A measurement of a peer opens a contact, which is not done again; it is only to be told from its copies.
            record.used, record.waiting = 0, False
            return True
        before_another = self._last is not None and record.key < self._last
        if self._marks and (before_another or item.t_ns < state_ns - self._tolerance_ns):
            record.waiting, record.late = False, True
            self.disturbed(item.t_ns)
        return record.waiting

    def drop(self, item: Item) -> None:
        """There is no room for it in the timeline."""
        found = self._find(item_key(item))
        if found is not None:
            self._records.remove(found)

    def _find(self, key: ItemKey) -> Record | None:
        index = bisect_left(self._records, key, key=_key)
        known = index < len(self._records) and self._records[index].key == key
        return self._records[index] if known else None

    def used(self, item: Item, state_ns: int) -> bool:
        """The datum is about to be used by a state at `state_ns`; whether it was before."""
        self._uses += 1
        record = self._find(item_key(item))
        if record is None:
            return False
        before, record.used, record.waiting, record.counted = record.counted, self._uses, False, True
        if record.late and not before and item.t_ns >= state_ns - self._tolerance_ns:
            self._counters["late.replayed"] += 1
        self._last = record.key if self._last is None else max(self._last, record.key)
        return before

    def odometry(self, odometry: Odometry) -> int | None:
        """A new increment; returns since when the motion is another one by it. None, counted, if it is of no use."""
        if odometry.t_meas_ns <= odometry.t0_ns:
            self._counters["odometry.out_of_order"] += 1
            return None
        if odometry.t_meas_ns <= self._floor_ns:
            self._counters["late.odometry_too_old"] += 1
            return None
        end = odometry.t_meas_ns, odometry.t0_ns
        index = bisect_left(self._ends, end)
        known = self._ends[max(index - 1, 0) : index + 1]
        if any(other[0] == end[0] for other in known):
            self._counters["input.duplicate" if end in known else "odometry.out_of_order"] += 1
            return None
        self._ends.insert(index, end)
        self._increments.insert(index, odometry)
        if len(self._ends) > MAX_INCREMENTS:
            self._counters["replay.horizon_cut"] += 1
            self._forget(self._ends[MAX_INCREMENTS // 16][0])
        return odometry.t0_ns if index == 0 else max(odometry.t0_ns, self._ends[index - 1][0])

    def moved_late(self, odometry: Odometry, since_ns: int) -> None:
        """An increment is of a stretch the state has gone through already, from `since_ns` on."""
        if not self._marks or odometry.t_meas_ns <= self._marks[0].t_ns + self._tolerance_ns:
            self._counters["late.odometry_unused"] += 1
            return
        self._counters["late.odometry_replayed"] += 1
        self.disturbed(since_ns)

    def settle(self, state_ns: int) -> None:
        """The state has come to `state_ns`: forget what lies beyond the horizon."""
        oldest = state_ns - self._horizon_ns
        # Now and then is enough, and cheaper.
        if oldest - self._floor_ns > self._horizon_ns // 16:
            self._forget(oldest)

    def _forget(self, until_ns: int) -> None:
        """Take nothing up to an instant any more, and forget what no rewind to a later one needs."""
        self._floor_ns = max(self._floor_ns, until_ns)
        first = bisect_right(self._marks, self._floor_ns, key=_instant) - 1
        del self._marks[: max(first, 0)]
        uses = self._marks[0].uses if self._marks else self._uses
        kept = []
        for record in self._records:
            over = record.item.t_ns <= self._floor_ns and not record.waiting
            if over and record.used is None:
                self._counters["late.too_old"] += 1
            elif not over or (record.used is not None and record.used > uses):
                kept.append(record)
        self._records = kept
        ended_ns = min(self._floor_ns, self._marks[0].t_ns) if self._marks else self._floor_ns
        count = bisect_right(self._ends, ended_ns, key=lambda end: end[0])
        del self._ends[:count], self._increments[:count]

    # -- marks ----------------------------------------------------------------------------------------------

    @property
    def first_ns(self) -> int | None:
        """The earliest instant there is a mark of."""
        return self._marks[0].t_ns if self._marks else None

    def mark(self, t_ns: int, found: FilterMark | None, track: OdometryTrack) -> None:
        """The filter is about to leave an instant, or what was used up to now is not to be used again."""
        if found is None or (self._marks and self._marks[-1].filter.owner is not found.owner):
            # Another filter is on: what the one before knew is gone.
            self._marks.clear()
        if found is None:
            return
        if self._marks and (self._marks[-1].t_ns, self._marks[-1].uses) == (t_ns, self._uses):
            return
        self._marks.append(Mark(t_ns, self._uses, found, track.gap_ns))
        if len(self._marks) > MAX_MARKS:
            self._counters["replay.horizon_cut"] += 1
            del self._marks[: MAX_MARKS // 16]

    def commit(self, t_ns: int, found: FilterMark | None, track: OdometryTrack) -> None:
        """What was used up to now is not to be done again."""
        self._marks.clear()
        self._last = None
        self.mark(t_ns, found, track)

    # -- going back -----------------------------------------------------------------------------------------

    @property
    def dirty(self) -> bool:
        """Whether data wait to be put back in their place."""
        return self._dirty_ns is not None

    def disturbed(self, t_ns: int) -> None:
        """What was made of instants from `t_ns` on does not hold any more."""
        self._dirty_ns = t_ns if self._dirty_ns is None else min(self._dirty_ns, t_ns)

    def due_ns(self, now_ns: int) -> int:
        """When the allowance is positive."""
        self._allow(now_ns)
        return now_ns if self._allowance > 0.0 else self._allowed_ns + int((1.0 - self._allowance) / STEPS_PER_S * NS)

    def _allow(self, now_ns: int) -> None:
        gained = max(now_ns - self._allowed_ns, 0) / NS * STEPS_PER_S
        self._allowance = min(self._allowance + gained, float(MAX_ALLOWANCE))
        self._allowed_ns = max(now_ns, self._allowed_ns)

    def rewound(self, now_ns: int, state_ns: int) -> tuple[Mark, list[Item], list[Odometry]] | None:
        """What to go back to from `state_ns`, and the data and odometry to use after it; None: not now."""
        if self._dirty_ns is None or not self._marks or self.due_ns(now_ns) > now_ns:
            return None
        # With the tolerance, data after a mark's instant may have been used at it.
        before = bisect_left(self._marks, self._dirty_ns - self._tolerance_ns, key=_instant) - 1
        kept_by_filter = bisect_right(self._marks, state_ns - self._horizon_ns, key=_instant) - 1
        index = max(before, kept_by_filter, 0)
        mark = self._marks[index]
        # Data of before the mark are done again only if there is no mark that is early enough.
        start = 0
        if index == before:
            start = bisect_left(self._records, mark.t_ns - self._tolerance_ns, key=lambda record: record.item.t_ns)
        again, self._last = [], None
        for record in self._records[start:]:
            if record.used is not None and record.used <= mark.uses:
                self._last = record.key if record.used and index > 0 else self._last
            elif not record.waiting:
                record.used, record.waiting = None, True
                again.append(record)
        steps = sum(record.counted for record in again) + len(self._marks) - index
        self._allowance -= steps
        self._counters["replay.rewinds"] += 1
        self._counters["replay.steps"] += steps
        del self._marks[index + 1 :]
        self._dirty_ns = None
        first = bisect_right(self._ends, mark.t_ns, key=lambda end: end[0])
        return mark, [record.item for record in again], self._increments[first:]


def _key(record: Record) -> ItemKey:
    return record.key


def _instant(mark: Mark) -> int:
    return mark.t_ns
