"""The pair protocol's decisions: every row of its tables, repetition, giving up, crossing."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.pairing import REPLY_TABLE, REQUEST_TABLE, PairExchange, Step
from agent.settings import NS
from network.messages import (
    NEVER,
    Belief,
    Epoch,
    Line,
    Measurement,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
)

LOW, HIGH = "r1", "r2"
TIMEOUT_NS, HORIZON_NS = 2 * NS, 10 * NS
MEASURED = (Measurement("range", np.array([4.0]), np.array([[0.01]])),)


def snapshot(base: Epoch = NEVER, lines: tuple[Epoch, ...] = ()) -> Snapshot:
    eye = np.eye(3)
    return Snapshot(
        Belief("unicycle", np.zeros(3), eye), base, np.zeros((3, 0)), eye, tuple(Line(epoch, eye) for epoch in lines)
    )


def exchange(robot: str, interval_ns: int = 0) -> PairExchange:
    peer = HIGH if robot == LOW else LOW
    return PairExchange(robot, peer, interval_ns, TIMEOUT_NS, HORIZON_NS)


def opened(pair: PairExchange, t_ns: int) -> PairRequest:
    return pair.open(t_ns, t_ns, MEASURED, snapshot())


def request(initiator: str, t_ns: int, counter: int = 1, known: tuple[Epoch, ...] = ()) -> PairRequest:
    return PairRequest(Epoch(t_ns, initiator, counter), MEASURED, snapshot(lines=known))


def test_the_tables_are_complete() -> None:
    assert sorted(REQUEST_TABLE) == sorted(product((False, True), repeat=3))
    assert sorted(REPLY_TABLE) == sorted(product((False, True), repeat=3))


@pytest.mark.parametrize(("pending", "is_low", "crossed"), list(product((False, True), repeat=3)))
def test_what_a_fresh_request_leads_to(pending: bool, is_low: bool, crossed: bool) -> None:
    pair = exchange(LOW if is_low else HIGH)
    peer = HIGH if is_low else LOW
    if not pending and crossed:
        # The own request was sent and has been answered, but the peer's was composed before it heard of it.
        own = opened(pair, NS)
        pair.replied(PairReply(own.epoch, ReplyStatus.OK, snapshot()), NEVER)
        found = pair.requested(request(peer, 2 * NS), NEVER)
    elif pending:
        own = opened(pair, NS)
        found = pair.requested(request(peer, 2 * NS, known=() if crossed else (own.epoch,)), NEVER)
    else:
        found = pair.requested(request(peer, 2 * NS), NEVER)
    assert found is REQUEST_TABLE[pending, is_low, crossed]
    busy = is_low and crossed
    assert (found is Step.ANSWER_BUSY) == busy
    assert (pair.pending is not None) == (pending and busy)


def test_what_was_measured_after_giving_up_has_not_crossed() -> None:
    pair = exchange(LOW)
    own = opened(pair, NS)
    assert pair.requested(request(HIGH, own.epoch.t_meas_ns + HORIZON_NS), NEVER) is Step.ANSWER_BUSY
    later = request(HIGH, own.epoch.t_meas_ns + HORIZON_NS + 1, 2)
    assert pair.requested(later, NEVER) is Step.APPLY_ABANDON_OWN


@pytest.mark.parametrize(("matches", "ok", "later"), list(product((False, True), repeat=3)))
def test_what_a_reply_leads_to(matches: bool, ok: bool, later: bool) -> None:
    pair = exchange(LOW)
    own = opened(pair, 5 * NS)
    epoch = own.epoch if matches else Epoch(5 * NS, LOW, 99)
    base = NEVER if later else Epoch(6 * NS, HIGH, 1)
    reply = PairReply(epoch, ReplyStatus.OK if ok else ReplyStatus.TOO_OLD, snapshot() if ok else None)
    step, settled = pair.replied(reply, base)
    assert step is REPLY_TABLE[matches, ok, later]
    assert (settled is not None) == matches
    assert (pair.pending is None) == matches
    assert (step is Step.APPLY) == (matches and ok and later)


def test_a_repeated_request_gets_the_same_reply_and_is_not_applied_again() -> None:
    pair = exchange(HIGH)
    asked = request(LOW, NS)
    assert pair.requested(asked, NEVER) is Step.APPLY
    reply = pair.answered(PairReply(asked.epoch, ReplyStatus.OK, snapshot()))
    assert pair.requested(asked, asked.epoch) is Step.REPEAT_REPLY
    assert pair.requested(asked, NEVER) is Step.REPEAT_REPLY
    assert pair.last_reply is reply
    assert pair.requested(request(LOW, NS // 2), asked.epoch) is Step.ANSWER_SUPERSEDED


def test_nothing_up_to_a_contact_refused_as_inconsistent_is_applied_later() -> None:
    pair = exchange(HIGH)
    for k in (2, 3):
        asked = request(LOW, k * NS)
        assert pair.requested(asked, NEVER) is Step.APPLY
        pair.answered(PairReply(asked.epoch, ReplyStatus.INCONSISTENT))
    again = exchange(HIGH)
    again.restore(pair.saved())
    for one in (pair, again):
        for t_ns in (NS, 2 * NS):
            assert one.requested(request(LOW, t_ns), NEVER) is Step.ANSWER_INCONSISTENT
        assert one.requested(request(LOW, 4 * NS), NEVER) is Step.APPLY


def test_an_unanswered_request_is_repeated_until_it_is_too_old() -> None:
    pair = exchange(LOW)
    own = opened(pair, NS)
    repeats, now = 0, NS
    while pair.pending is not None and now < 100 * NS:
        now += NS // 2
        again = pair.expired(now)
        if again is not None:
            assert again is own
            repeats += 1
    assert repeats == 4
    assert now == NS + HORIZON_NS
    assert pair.measured(now, NEVER) is Step.OPEN


def test_measurements_are_thinned_and_wait_for_the_pending_contact() -> None:
    pair = exchange(LOW, interval_ns=3 * NS)
    base = Epoch(10 * NS, LOW, 1)
    assert pair.measured(10 * NS, base) is Step.SKIP_STALE
    assert pair.measured(12 * NS, base) is Step.SKIP_THINNED
    assert pair.measured(13 * NS, base) is Step.OPEN
    opened(pair, 13 * NS)
    assert pair.measured(20 * NS, base) is Step.SKIP_PENDING
    pair.restarted()
    assert pair.pending is None
    assert pair.measured(20 * NS, base) is Step.OPEN


HAPPENINGS = st.sampled_from(["measure", "request", "ok", "busy", "tick"])


@given(st.lists(st.tuples(HAPPENINGS, st.integers(0, 3)), max_size=40))
def test_one_contact_is_pending_and_epochs_ascend(happenings: list[tuple[str, int]]) -> None:
    pair = exchange(LOW)
    now, epochs, counter = NS, [], 0
    for what, wait in happenings:
        now += wait * NS // 2
        if what == "measure" and pair.measured(now, NEVER) is Step.OPEN:
            epochs.append(opened(pair, now).epoch)
        elif what == "request":
            counter += 1
            pair.requested(request(HIGH, now, counter), NEVER)
        elif what in ("ok", "busy") and epochs:
            status = ReplyStatus.OK if what == "ok" else ReplyStatus.BUSY
            pair.replied(PairReply(epochs[-1], status, snapshot() if what == "ok" else None), NEVER)
        else:
            pair.expired(now)
        assert pair.pending is None or pair.pending.epoch == epochs[-1]
    assert len(set(epochs)) == len(epochs)
    assert epochs == sorted(epochs)
