"""When a node is called: at its deadline, once, and at another time when the clock is set."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

import pytest

from agent.node_timer import MAX_WAIT_S, MIN_WAIT_S, NodeTimer
from agent.settings import NS


class Desk:
    """A timer with a clock that is set by hand, and an event loop that notes what is asked of it."""

    def __init__(self) -> None:
        self.time_ns = 0
        self.waits_s: list[float] = []
        self.calls: list[Callable[[], None]] = []
        self.cancelled = 0
        self.due: list[int] = []
        clock: Any = self
        self.timer = NodeTimer(lambda: clock, self.due.append)

    def now_ns(self) -> int:
        return self.time_ns

    def wall_s(self, fleet_ns: int) -> float:
        return fleet_ns / 2.0 * 1e-9

    def call_later(self, wait_s: float, call: Callable[[], None]) -> Desk:
        self.waits_s.append(wait_s)
        self.calls.append(call)
        return self

    def cancel(self) -> None:
        self.cancelled += 1


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    found = Desk()
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: found)
    return found


def test_it_waits_in_wall_time_and_tells_the_time_it_is(desk: Desk) -> None:
    desk.timer.arm(4 * NS)
    assert desk.waits_s == [2.0]
    desk.time_ns = 4 * NS + 7
    desk.calls[0]()
    assert desk.due == [4 * NS + 7] and desk.timer.lags.max_ns == 7


def test_an_equal_deadline_changes_nothing_and_another_replaces_it(desk: Desk) -> None:
    desk.timer.arm(NS)
    desk.timer.arm(NS)
    assert len(desk.calls) == 1 and not desk.cancelled
    desk.timer.arm(2 * NS)
    assert desk.waits_s == [0.5, 1.0] and desk.cancelled == 1


def test_it_never_spins_and_looks_at_the_clock_now_and_then(desk: Desk) -> None:
    desk.time_ns = 5 * NS
    desk.timer.arm(NS)
    desk.timer.arm(10_000 * NS)
    assert desk.waits_s == [MIN_WAIT_S, MAX_WAIT_S]


def test_a_deadline_in_the_past_is_late_from_when_it_was_set(desk: Desk) -> None:
    desk.time_ns = 5 * NS
    desk.timer.arm(NS)
    desk.time_ns = 5 * NS + 3
    desk.calls[0]()
    assert desk.timer.lags.max_ns == 3


def test_when_the_clock_is_set_an_equal_deadline_is_waited_for_anew(desk: Desk) -> None:
    desk.timer.arm(4 * NS)
    desk.time_ns = 2 * NS
    desk.timer.cancel()
    desk.timer.arm(4 * NS)
    assert desk.waits_s == [2.0, 1.0] and desk.cancelled == 1


def test_what_is_done_before_an_overdue_timer_hides_no_lag(desk: Desk) -> None:
    desk.timer.arm(NS)
    desk.time_ns = 7 * NS
    desk.timer.arm(8 * NS)
    assert desk.timer.lags.max_ns == 6 * NS and desk.cancelled == 1
