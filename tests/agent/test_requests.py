"""Asking for messages: one at a time, again while they do not come as asked, seldom when refused."""

from __future__ import annotations

from collections import Counter

from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.requests import MessageRequests, Wanted

S = 1_000_000_000
MS = 1_000_000
ACCEPTED, DENIED = dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_DENIED
IN_PROGRESS, LATER = dialect.MAV_RESULT_IN_PROGRESS, dialect.MAV_RESULT_TEMPORARILY_REJECTED


def requests(*names: str) -> tuple[MessageRequests, Counter[str]]:
    counters: Counter[str] = Counter()
    return MessageRequests([Wanted(name, k, 100 * MS) for k, name in enumerate(names)], counters), counters


def asked(subject: MessageRequests, now_ns: int) -> str | None:
    wanted = subject.due(now_ns)
    return None if wanted is None else wanted.name


def test_the_next_is_asked_for_when_the_one_before_was_answered() -> None:
    subject, counters = requests("A", "B")
    assert asked(subject, 0) == "A"
    assert asked(subject, 100 * MS) is None and subject.next_deadline_ns() == 500 * MS
    subject.answered(150 * MS, IN_PROGRESS)
    assert asked(subject, 160 * MS) is None
    subject.answered(200 * MS, ACCEPTED)
    assert asked(subject, 210 * MS) == "B"
    assert not counters


def test_an_unanswered_request_does_not_block_the_others() -> None:
    subject, counters = requests("A", "B")
    assert [asked(subject, 0), asked(subject, 500 * MS)] == ["A", "B"]
    assert counters == {"mavlink.request_unanswered": 1}


def test_a_message_that_comes_too_seldom_is_asked_for_again() -> None:
    """Another program on the link may have set the rate lower."""
    for interval_ns, again in ((100 * MS, False), (180 * MS, False), (500 * MS, True)):
        subject, _ = requests("A")
        asked(subject, 0)
        subject.answered(0, ACCEPTED)
        seen = []
        for k in range(1, 40):
            subject.arrived(k * interval_ns, 0, "A")
            seen.append(asked(subject, k * interval_ns))
        assert ("A" in seen) == again


def test_a_refusal_is_tried_again_after_half_a_minute_and_a_deferral_soon() -> None:
    for result, next_s in ((DENIED, 30), (LATER, 3)):
        subject, counters = requests("A")
        asked(subject, 0)
        subject.answered(0, result)
        assert asked(subject, next_s * S - 1) is None
        assert asked(subject, next_s * S) == "A"
        assert counters["mavlink.request_refused"] == (result == DENIED)


def test_after_a_reboot_everything_is_asked_for_anew() -> None:
    subject, _ = requests("A")
    asked(subject, 0)
    subject.answered(0, DENIED)
    subject.restart()
    assert asked(subject, 1) == "A"
    assert subject.reasons(1) == ["A does not arrive although it was asked for"]


def test_foreign_names_cannot_fill_the_memory_and_wanted_ones_are_always_watched() -> None:
    subject, _ = requests("A")
    for k in range(1000):
        subject.arrived(k, 5000 + k, f"X{k}")
    subject.arrived(1000, 0, "A")
    rates = subject.rates(1000)
    assert len(rates) == 65 and rates["A"] == {"count": 1, "age_s": 0.0, "rate_hz": None}


def test_an_unexpected_answer_is_ignored() -> None:
    subject, counters = requests("A")
    subject.answered(0, DENIED)
    assert asked(subject, 0) == "A" and not counters
