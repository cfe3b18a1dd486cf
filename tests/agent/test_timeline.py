"""Own inputs in the order of their instants; odometry cut, joined, and coasted over."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.motion import compose
from agent.events import Fix, Odometry
from agent.settings import NS, CoastSettings
from agent.timeline import MAX_INCREMENTS, MAX_WAITING, Item, OdometryTrack, Phase, Timeline

Array = NDArray[np.float64]

MS = 1_000_000
RATE = np.diag([0.04, 0.02, 0.01, 0.003])
"""Variance of odometry per second."""
COAST = CoastSettings(speed_mps=0.5, yaw_rate_radps=0.2)


def fix(t_ns: int) -> Fix:
    return Fix(t_ns, t_ns, "heading", np.zeros(1), np.eye(1))


def item(t_ns: int, phase: Phase, source: str) -> Item:
    return Item(t_ns, phase, source, fix(t_ns))


def track(tolerance_ns: int = 0) -> OdometryTrack:
    return OdometryTrack(COAST, tolerance_ns, Counter())


def increment(t0_ns: int, t_ns: int, speed: float = 1.0, turn: float = 0.3) -> Odometry:
    """Constant speed along a straight chord and constant turn, with white noise."""
    dt = (t_ns - t0_ns) / NS
    return Odometry(t_ns, t0_ns, t_ns, np.array([speed * dt, 0.0, 0.0, turn * dt]), RATE * dt)


def taken(odometry: OdometryTrack, state_ns: int, until_ns: int) -> list[tuple[int, Array, Array]]:
    """All stretches from `state_ns` until `until_ns` is reached."""
    stretches = []
    while state_ns < until_ns:
        end, delta, cov = odometry.step(state_ns, until_ns)
        assert end > state_ns
        stretches.append((end, delta, cov))
        state_ns = end
    return stretches


def pose(stretches: list[tuple[int, Array, Array]]) -> Array:
    at = np.zeros(3)
    for _, delta, _ in stretches:
        at = compose(at, delta[[0, 1, 3]])
    return at


def variance(stretches: list[tuple[int, Array, Array]]) -> Array:
    return np.asarray(sum((cov for _, _, cov in stretches), np.zeros((4, 4))))


ITEMS = st.tuples(st.integers(0, 3), st.sampled_from(Phase), st.sampled_from(["a", "b"]))


@given(st.lists(ITEMS, max_size=30))
def test_items_come_out_by_instant_phase_source_and_arrival(keys: list[tuple[int, Phase, str]]) -> None:
    line = Timeline()
    items = [item(*key) for key in keys]
    for one in items:
        assert line.push(one)
    assert len(line) == len(items)
    out = []
    while (ahead := line.peek()) is not None:
        out.append(line.pop())
        assert out[-1] is ahead
    # `sorted` is stable: equal keys keep the order of arrival.
    assert all(a is b for a, b in zip(out, sorted(items, key=lambda i: (i.t_ns, i.phase, i.source)), strict=True))


def test_the_heap_is_bounded() -> None:
    line = Timeline()
    assert all(line.push(item(k, Phase.PRIVATE, "a")) for k in range(MAX_WAITING))
    assert not line.push(item(0, Phase.PRIVATE, "a"))
    assert len(line) == MAX_WAITING
    line.pop()
    assert line.push(item(0, Phase.PRIVATE, "a"))


@given(st.sets(st.integers(1, 999), max_size=6), st.floats(-1.0, 1.0))
def test_an_increment_cut_anywhere_is_the_whole(cuts: set[int], turn: float) -> None:
    whole = increment(0, NS, turn=turn)
    odometry = track()
    odometry.add(whole, 0)
    stretches, state = [], 0
    for cut in [*sorted(cuts), 1000]:
        stretches += taken(odometry, state, cut * MS)
        state = cut * MS
    assert len(stretches) == len(cuts) + 1
    assert np.allclose(pose(stretches), whole.delta[[0, 1, 3]], atol=1e-9)
    assert np.allclose(variance(stretches), whole.cov, atol=1e-12)


def test_increments_that_follow_each_other_are_used_one_by_one() -> None:
    odometry = track()
    assert odometry.end_ns is None
    for k in range(3):
        odometry.add(increment(k * NS, (k + 1) * NS), 0)
    assert odometry.end_ns == 3 * NS
    assert odometry.next_end_ns(0) == NS
    assert odometry.next_end_ns(NS) == 2 * NS
    assert [end for end, _, _ in taken(odometry, NS, 3 * NS)] == [2 * NS, 3 * NS]
    assert odometry.next_end_ns(3 * NS) is None


def test_overlapping_increments_are_used_once() -> None:
    counters: Counter[str] = Counter()
    odometry = OdometryTrack(COAST, 0, counters)
    odometry.add(increment(0, 2 * NS, turn=0.0), 0)
    odometry.add(increment(NS, 3 * NS, turn=0.0), 0)
    odometry.add(increment(NS, 3 * NS, turn=0.0), 0)
    odometry.add(increment(0, NS, turn=0.0), 0)
    odometry.add(Odometry(0, 4 * NS, 4 * NS, np.zeros(4), RATE), 0)
    assert counters["odometry.out_of_order"] == 3
    stretches = taken(odometry, 0, 3 * NS)
    assert np.allclose(pose(stretches), [3.0, 0.0, 0.0])
    assert np.allclose(variance(stretches), 3.0 * RATE)
    assert counters["odometry.coasted"] == 0


def test_what_lies_before_the_state_is_cut_off() -> None:
    odometry = track()
    odometry.add(increment(0, 2 * NS, turn=0.0), NS)
    (stretch,) = taken(odometry, NS, 2 * NS)
    assert np.allclose(stretch[1], [1.0, 0.0, 0.0, 0.0])
    assert np.allclose(stretch[2], RATE)


def test_a_gap_is_coasted_between_increments() -> None:
    odometry = track()
    odometry.add(increment(0, NS), 0)
    odometry.add(increment(4 * NS, 5 * NS), 0)
    stretches = taken(odometry, 0, 5 * NS)
    assert [end for end, _, _ in stretches] == [NS, 4 * NS, 5 * NS]
    _, delta, cov = stretches[1]
    assert np.array_equal(delta, np.zeros(4))
    # Three seconds at 0.5 m/s and 0.2 rad/s.
    assert np.allclose(np.diagonal(cov), [2.25, 2.25, 2.25, 0.36])


@given(st.sets(st.integers(1, 2999), max_size=8))
def test_a_gap_grows_alike_however_often_it_is_cut(cuts: set[int]) -> None:
    """Measurements during an outage must not make the robot surer of where it has been carried."""
    odometry = track()
    stretches, state = [], 0
    for cut in [*sorted(cuts), 3000]:
        stretches += taken(odometry, state, cut * MS)
        state = cut * MS
    assert np.allclose(np.diagonal(variance(stretches)), [2.25, 2.25, 2.25, 0.36])
    assert all(a[2][0, 0] > 0.0 for a in stretches)


def test_every_gap_begins_anew() -> None:
    odometry = track()
    first = taken(odometry, 0, NS)
    odometry.add(increment(NS, 2 * NS), NS)
    taken(odometry, NS, 2 * NS)
    second = taken(odometry, 2 * NS, 3 * NS)
    assert np.array_equal(variance(first), variance(second))


def test_stamps_within_the_tolerance_leave_no_slivers() -> None:
    odometry = track(tolerance_ns=5 * MS)
    odometry.add(increment(2 * MS, NS - 3 * MS), 0)
    odometry.add(increment(NS, 2 * NS + 4 * MS), 0)
    stretches = taken(odometry, 0, 2 * NS)
    assert [end for end, _, _ in stretches] == [NS - 3 * MS, 2 * NS + 4 * MS]


@settings(max_examples=200)
@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(1, 80)), max_size=12),
    st.lists(st.integers(1, 400), min_size=1, max_size=12, unique=True),
    st.sampled_from([0, 1, 20]),
)
def test_any_increments_lead_forward_to_any_instants(
    increments: list[tuple[int, int]], instants: list[int], tolerance_ms: int
) -> None:
    odometry = track(tolerance_ms * MS)
    for start, length in increments:
        odometry.add(increment(start * MS, (start + length) * MS), 0)
    state = 0
    for instant in sorted(instants):
        stretches = taken(odometry, state, instant * MS)
        ends = [state, *(end for end, _, _ in stretches)]
        assert all(a < b for a, b in pairwise(ends))
        assert ends[-1] <= max(state, (instant + tolerance_ms) * MS)
        for _, _, cov in stretches:
            assert np.all(np.diagonal(cov) > 0.0)
        state = ends[-1]


@pytest.mark.parametrize("extra", [0, 7])
def test_waiting_increments_are_bounded_the_oldest_go_first(extra: int) -> None:
    counters: Counter[str] = Counter()
    odometry = OdometryTrack(COAST, 0, counters)
    for k in range(MAX_INCREMENTS + extra):
        odometry.add(increment(k * MS, (k + 1) * MS), 0)
    assert counters["odometry.overflow"] == extra
    assert odometry.next_end_ns(0) == (extra + 1) * MS
