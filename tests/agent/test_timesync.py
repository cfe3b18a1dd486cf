"""The boot clock in fleet time: bounds, reboots, steps and stragglers."""

from __future__ import annotations

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from agent.timesync import TimeSync, TimeSyncSettings

S = 1_000_000_000
MS = 1_000_000
BOOT = 1_700_000_000 * S
DELAYS = st.tuples(st.integers(0, 200 * MS), st.integers(0, 200 * MS))


def exchange(sync: TimeSync, now_ns: int, out_ns: int = 0, back_ns: int = 0, boot_ns: int = BOOT) -> None:
    ts1 = sync.request(now_ns)
    sync.answer(now_ns + out_ns + back_ns, now_ns + out_ns - boot_ns, ts1)


@given(st.lists(DELAYS, min_size=1, max_size=100))
def test_the_offset_is_right_within_half_the_best_round_trip(delays: list[tuple[int, int]]) -> None:
    sync, now = TimeSync(TimeSyncSettings(), Counter()), BOOT + 60 * S
    for out_ns, back_ns in delays:
        exchange(sync, now, out_ns, back_ns)
        now += S
        assert sync.best is not None
        assert abs(sync.best.offset_ns - BOOT) <= (sync.best.rtt_ns + 1) // 2
    assert sync.best is not None and sync.best.rtt_ns == min(sum(pair) for pair in delays[-64:])
    assert sync.epoch == 0


def test_a_drifting_clock_is_followed() -> None:
    """50 ppm: over an hour 0.18 s, of which the window of a minute leaves 4 ms."""
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    for k in range(3600):
        now = BOOT + 60 * S + k * S
        exchange(sync, now, MS, MS, BOOT + k * 50_000)
    assert sync.best is not None
    assert abs(sync.best.offset_ns - (BOOT + 3599 * 50_000)) < 4 * MS
    assert not counters


def test_a_message_from_after_a_reboot_ends_the_epoch_before_any_answer_does() -> None:
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    now = BOOT + 60 * S
    exchange(sync, now)
    assert sync.stamp(now, 60 * S) == now
    assert sync.stamp(now + S, 300 * MS) is None
    assert (counters["mavlink.reboot"], sync.epoch, sync.best) == (1, 1, None)
    assert sync.stamp(now + S, 400 * MS) is None and counters["mavlink.no_timesync"] == 1
    exchange(sync, now + 2 * S, boot_ns=now + S - 300 * MS)
    assert sync.stamp(now + 2 * S, 1300 * MS) == now + 2 * S


def test_answers_of_the_life_before_a_reboot_are_forgotten() -> None:
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    now = BOOT + 60 * S
    exchange(sync, now)
    ts1 = sync.request(now + S)
    sync.stamp(now + S, 1)
    sync.answer(now + S + MS, 61 * S, ts1)
    assert sync.best is None and counters["mavlink.timesync_unmatched"] == 1


def test_messages_a_little_out_of_order_are_no_reboot() -> None:
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    now = BOOT + 60 * S
    exchange(sync, now)
    assert sync.stamp(now, 60 * S) == now
    assert sync.stamp(now, 60 * S - 900 * MS) == now - 900 * MS
    assert not counters


def test_impossible_stamps_are_refused_and_leave_no_trace() -> None:
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    now = BOOT + 60 * S
    exchange(sync, now)
    assert sync.stamp(now, 62 * S) is None
    assert sync.stamp(now, 2**62) is None
    assert sync.stamp(now, 60 * S) == now
    assert sync.stamp(now + 11 * S, 60 * S) is None
    assert counters == {"mavlink.stamp_future": 2, "mavlink.stamp_old": 1}


def test_a_single_strange_answer_changes_nothing_and_five_change_the_epoch() -> None:
    sync = TimeSync(TimeSyncSettings(), counters := Counter())
    now = BOOT + 60 * S
    exchange(sync, now)
    for k in range(1, 5):
        exchange(sync, now + k * S, boot_ns=BOOT + S // 2)
        exchange(sync, now + k * S + MS)
    assert sync.best is not None and sync.best.offset_ns == BOOT and sync.epoch == 0
    for k in range(5, 10):
        exchange(sync, now + k * S, boot_ns=BOOT - 2 * S)
    assert sync.best.offset_ns == BOOT - 2 * S and sync.epoch == 1
    assert counters == {"mavlink.timesync_disagrees": 9, "mavlink.clock_step": 1}


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1)), max_size=50))
def test_no_answer_can_hurt(answers: list[tuple[int, int]]) -> None:
    sync, now = TimeSync(TimeSyncSettings(), Counter()), BOOT
    for tc1, ts1 in answers:
        sync.answer(now, tc1, ts1)
        sync.answer(now, tc1, sync.request(now))
        now += MS
        stamp = sync.stamp(now, abs(tc1))
        assert stamp is None or now - 10 * S <= stamp <= now + S


def test_milliseconds_since_boot_are_unwrapped_by_the_known_offset() -> None:
    sync = TimeSync(TimeSyncSettings(), Counter())
    assert sync.boot_ms(BOOT, 5000) == 5 * S
    uptime = 2**32 * MS + 5 * S
    exchange(sync, BOOT + uptime)
    assert sync.boot_ms(BOOT + uptime, 5000) == uptime
    assert sync.boot_ms(BOOT + uptime, 2**32 - 1000) == 2**32 * MS - S
