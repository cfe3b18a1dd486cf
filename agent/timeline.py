"""Own inputs in the order of the instants they refer to, and the odometry that connects those instants."""

from __future__ import annotations

import heapq
from collections import Counter, deque
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import split_increment
from agent.events import Completed, Fix, Observation, Odometry, Received
from agent.settings import CoastSettings

Array = NDArray[np.float64]

MAX_WAITING = 512
MAX_INCREMENTS = 4096


class Phase(IntEnum):
    """Order of things that happen at one instant."""

    PREDICT = 0
    PRIVATE = 1
    TARGET = 2
    PAIR = 3
    BROADCAST = 4
    PLAN = 5


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """Something to be processed at instant `t_ns` of the own clock."""

    t_ns: int
    phase: Phase
    source: str
    event: Fix | Observation | Completed | Received


ItemKey = tuple[int, Phase, str, str, str, bytes, bytes]
"""Order of items, and what tells two of them apart, whenever they arrive."""

Gap = tuple[int, int] | None
"""Where a gap of the odometry began, and how far it was coasted over."""


def item_key(item: Item) -> ItemKey:
    """(instant, phase, source, sensor, kind, z, R) of an own datum; what a message tells is not looked at."""
    event = item.event
    if isinstance(event, Received):
        return item.t_ns, item.phase, item.source, "", "", b"", b""
    return item.t_ns, item.phase, item.source, event.sensor, event.kind, event.z.tobytes(), event.R.tobytes()


class Timeline:
    """A bounded heap of items ordered by (instant, phase, source, then what they are or when they arrived)."""

    def __init__(self, by_content: bool = False) -> None:
        self._by_content = by_content
        self._heap: list[tuple[ItemKey, int, Item]] = []
        self._arrivals = 0

    def __len__(self) -> int:
        return len(self._heap)

    def push(self, item: Item, again: bool = False) -> bool:
        """Add an item; False when the heap is full, unless it is one that was in it before and comes `again`."""
        if len(self._heap) >= MAX_WAITING and not again:
            return False
        self._arrivals += 1
        key = item_key(item) if self._by_content else (item.t_ns, item.phase, item.source, "", "", b"", b"")
        heapq.heappush(self._heap, (key, self._arrivals, item))
        return True

    def peek(self) -> Item | None:
        return self._heap[0][2] if self._heap else None

    def pop(self) -> Item:
        return heapq.heappop(self._heap)[2]


class OdometryTrack:
    """Consecutive odometry increments not used yet. Gaps are coasted over, overlaps are cut."""

    def __init__(self, coast: CoastSettings, tolerance_ns: int, counters: Counter[str]) -> None:
        self._coast, self._tolerance_ns, self._counters = coast, tolerance_ns, counters
        self._increments: deque[Odometry] = deque()
        self._gap_ns: Gap = None

    def __len__(self) -> int:
        return len(self._increments)

    @property
    def gap_ns(self) -> Gap:
        return self._gap_ns

    def restore(self, gap_ns: Gap, increments: list[Odometry]) -> None:
        """Go back to a state that all `increments` end later than; they are in order, and what is used of the first is
        cut off again."""
        self._gap_ns = gap_ns
        self._increments = deque(increments[-MAX_INCREMENTS:])

    def put(self, odometry: Odometry) -> None:
        """Take an increment in the order of their ends; it is of what was not used yet."""
        if len(self._increments) >= MAX_INCREMENTS:
            self._counters["odometry.overflow"] += 1
            self._increments.popleft()
        later = []
        while self._increments and self._increments[-1].t_meas_ns > odometry.t_meas_ns:
            later.append(self._increments.pop())
        self._increments.append(odometry)
        self._increments.extend(reversed(later))

    def copy(self) -> OdometryTrack:
        """A track of its own with the same increments."""
        other = OdometryTrack(self._coast, self._tolerance_ns, self._counters)
        other._increments, other._gap_ns = deque(self._increments), self._gap_ns
        return other

    @property
    def end_ns(self) -> int | None:
        """Last instant covered by a waiting increment; None when there is none."""
        return self._increments[-1].t_meas_ns if self._increments else None

    def next_end_ns(self, state_ns: int) -> int | None:
        """End of the first waiting increment that reaches beyond `state_ns`."""
        self._drop_used(state_ns)
        return self._increments[0].t_meas_ns if self._increments else None

    def _drop_used(self, state_ns: int) -> None:
        while self._increments and self._increments[0].t_meas_ns <= state_ns:
            self._increments.popleft()

    def add(self, odometry: Odometry, state_ns: int) -> None:
        """Take an increment; one that ends in the past, or before the previous one, is counted and dropped."""
        last = self._increments[-1].t_meas_ns if self._increments else state_ns
        if odometry.t_meas_ns <= last or odometry.t_meas_ns <= odometry.t0_ns:
            self._counters["odometry.out_of_order"] += 1
            return
        if len(self._increments) >= MAX_INCREMENTS:
            self._counters["odometry.overflow"] += 1
            self._increments.popleft()
        self._increments.append(odometry)

    def step(self, state_ns: int, until_ns: int) -> tuple[int, Array, Array]:
        """The next stretch from `state_ns` towards `until_ns` > state_ns: (its end, delta (4,), cov (4, 4)).

        It ends at the end of an increment, at `until_ns`, or where a gap ends. Without odometry the stretch
        is a coast: zero motion with the covariance of a velocity that is unknown and constant over the whole gap. The
        end always lies beyond `state_ns`.
        """
        tolerance = self._tolerance_ns
        self._drop_used(state_ns)
        if not self._increments or self._increments[0].t0_ns >= until_ns:
            return self._coasted(state_ns, until_ns)
        increment = self._increments[0]
        if increment.t0_ns > state_ns + tolerance:
            return self._coasted(state_ns, increment.t0_ns)
        delta, cov = increment.delta, increment.cov
        start, end = increment.t0_ns, increment.t_meas_ns
        if start < state_ns - tolerance:
            _, _, delta, cov = split_increment(delta, cov, (state_ns - start) / (end - start))
            start = state_ns
        if end <= until_ns + tolerance:
            self._increments.popleft()
            return end, delta, cov
        delta, cov, rest, rest_cov = split_increment(delta, cov, (until_ns - start) / (end - start))
        self._increments[0] = Odometry(increment.t_ns, until_ns, end, rest, rest_cov)
        return until_ns, delta, cov

    def _coasted(self, state_ns: int, until_ns: int) -> tuple[int, Array, Array]:
        self._counters["odometry.coasted"] += 1
        start = self._gap_ns[0] if self._gap_ns is not None and self._gap_ns[1] == state_ns else state_ns
        self._gap_ns = (start, until_ns)
        # The velocity is the same all through a gap: however often it is cut, the variances add up to the same.
        dt2 = ((until_ns - start) * 1e-9) ** 2 - ((state_ns - start) * 1e-9) ** 2
        moved, turned = self._coast.speed_mps**2 * dt2, self._coast.yaw_rate_radps**2 * dt2
        return until_ns, np.zeros(4), np.diag([moved, moved, moved, turned])
