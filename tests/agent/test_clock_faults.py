"""A faulty clock: steps, drifts, and when it will say what."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.clock_faults import ClockFault, FaultyClock

S = 1_000_000_000


def test_a_sound_clock_tells_the_time() -> None:
    clock = FaultyClock()
    assert clock.local_ns(5 * S) == 5 * S and clock.changes() == []
    assert clock.true_ns(7 * S, 5 * S) == 7 * S and clock.true_ns(3 * S, 5 * S) == 5 * S


def test_a_step_goes_away_at_its_end() -> None:
    clock = FaultyClock([ClockFault(2 * S, 4 * S, step_ns=S)])
    assert [clock.local_ns(t * S) for t in (1, 2, 3, 4)] == [S, 3 * S, 4 * S, 4 * S]
    assert clock.changes() == [2 * S, 4 * S]


def test_what_a_drift_has_gained_stays() -> None:
    clock = FaultyClock([ClockFault(0, 100 * S, rate=50e-6)])
    assert clock.local_ns(10 * S) - 10 * S == 500_000
    assert clock.local_ns(200 * S) - 200 * S == 5_000_000


def test_faults_add_up_and_may_be_added() -> None:
    clock = FaultyClock([ClockFault(step_ns=S)])
    clock.add(ClockFault(step_ns=-3 * S))
    assert clock.local_ns(10 * S) == 8 * S


@given(
    step_ns=st.integers(-10 * S, 10 * S),
    ppm=st.floats(-500.0, 500.0),
    after_ns=st.integers(0, 100 * S),
    ahead_ns=st.integers(0, 5 * S),
)
def test_when_the_clock_will_say_what(step_ns: int, ppm: float, after_ns: int, ahead_ns: int) -> None:
    clock = FaultyClock([ClockFault(step_ns=step_ns), ClockFault(rate=ppm * 1e-6)])
    due_ns = clock.local_ns(after_ns) + ahead_ns
    t_ns = clock.true_ns(due_ns, after_ns)
    assert t_ns >= after_ns
    assert clock.local_ns(t_ns) == pytest.approx(due_ns, abs=2)
