"""Clock offsets from four stamps: the error bound holds on any link, and a clock that was set is noticed."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network.clock import DRIFT_PPM, KEPT_EXCHANGES, MAX_SPAN_NS, PeerClock

MS = 10**6
S = 10**9


def exchange(start_ns: int, offset_ns: int, there_ns: int, hold_ns: int, back_ns: int) -> tuple[int, ...]:
    """Stamps of an exchange with a peer whose clock is `offset_ns` ahead of ours."""
    received = start_ns + there_ns
    replied = received + hold_ns
    return start_ns, received + offset_ns, replied + offset_ns, replied + back_ns


def test_a_symmetric_exchange_gives_the_offset_exactly() -> None:
    clock = PeerClock()
    assert clock.offset_ns is None
    assert clock.sigma_ns is None
    assert clock.at(5) is None
    assert clock.add(*exchange(10 * S, 250 * MS, 3 * MS, 0, 3 * MS))
    assert clock.offset_ns == 250 * MS
    # Half the round trip is 3 ms, spread evenly; 6 ms of drift come on top.
    assert clock.sigma_ns == pytest.approx((3 * MS + 6 * MS * DRIFT_PPM * 1e-6) / 3**0.5, abs=1)


delays = st.integers(0, 200 * MS)
trips = st.lists(st.tuples(delays, st.integers(0, 900 * MS), delays), min_size=1, max_size=30)


@settings(max_examples=200)
@given(st.integers(-5 * S, 5 * S), trips)
def test_the_true_offset_lies_within_the_bound_on_any_link(offset_ns: int, links: list[tuple[int, ...]]) -> None:
    clock = PeerClock()
    start_ns = 100 * S
    for there_ns, hold_ns, back_ns in links:
        assert clock.add(*exchange(start_ns, offset_ns, there_ns, hold_ns, back_ns))
        start_ns += S
        known = clock.at(start_ns)
        assert known is not None
        assert abs(known[0] - offset_ns) <= known[1] * 3**0.5 + 1
    assert clock.steps == 0


def test_the_shortest_round_trip_is_believed() -> None:
    clock = PeerClock()
    clock.add(*exchange(10 * S, 0, 1 * MS, 0, 1 * MS))
    clock.add(*exchange(11 * S, 0, 90 * MS, 0, 10 * MS))
    assert clock.offset_ns == 0


def test_uncertainty_grows_with_age() -> None:
    clock = PeerClock()
    clock.add(*exchange(10 * S, 0, 1 * MS, 0, 1 * MS))
    fresh, later = clock.at(10 * S), clock.at(110 * S)
    assert fresh is not None and later is not None
    assert later[1] - fresh[1] == pytest.approx(100 * S * DRIFT_PPM * 1e-6 / 3**0.5, abs=2)


def test_old_exchanges_are_dropped() -> None:
    clock = PeerClock()
    clock.add(*exchange(10 * S, 0, 0, 0, 0))
    for k in range(KEPT_EXCHANGES):
        clock.add(*exchange((11 + k) * S, 0, 40 * MS, 0, 40 * MS))
    assert clock.sigma_ns is not None
    assert clock.sigma_ns > 20 * MS


def test_a_clock_that_was_set_replaces_all_that_was_known() -> None:
    clock = PeerClock()
    for k in range(5):
        clock.add(*exchange((10 + k) * S, 0, 2 * MS, 0, 2 * MS))
    clock.add(*exchange(20 * S, 500 * MS, 30 * MS, 0, 30 * MS))
    assert clock.offset_ns == 500 * MS
    assert clock.steps == 1


@pytest.mark.parametrize(
    "stamps",
    [
        (10, 20, 20, 9),
        (10, 20, 25, 12),
        (10, 30, 20, 40),
        (-1, 0, 0, 5),
        (0, -5, 5, 20),
        (0, 0, 0, MAX_SPAN_NS + 1),
    ],
    ids=["back before sent", "held longer than gone", "sent before heard", "t1 < 0", "t2 < 0", "endless"],
)
def test_stamps_that_are_no_exchange_are_refused(stamps: tuple[int, int, int, int]) -> None:
    clock = PeerClock()
    assert not clock.add(*stamps)
    assert clock.offset_ns is None
