"""Requests and replies without factors: any order, loss and repetition leaves at most one use of each contact."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.settings import NS
from agent.split_exchange import MAX_ANSWERED, MAX_PENDING, SplitExchange
from network.messages import Epoch, Measurement, SplitReply, SplitSnapshot

SNAPSHOT = SplitSnapshot("unicycle", (), np.zeros(3), np.eye(3))
RANGE = (Measurement("range", np.array([1.0]), np.eye(1)),)


def exchange() -> SplitExchange:
    return SplitExchange("r1", timeout_ns=NS, horizon_ns=5 * NS)


def test_requests_that_wait_are_bounded() -> None:
    subject = exchange()
    for k in range(MAX_PENDING):
        assert not subject.full
        subject.open(k, k, RANGE, SNAPSHOT)
    assert subject.full


def test_replies_that_are_kept_are_bounded() -> None:
    subject = exchange()
    epochs = [Epoch(k, "r2", k) for k in range(1, MAX_ANSWERED + 10)]
    for epoch in epochs:
        subject.answered(epoch, SplitReply(epoch, SNAPSHOT))
    assert not subject.known(epochs[0])
    assert all(subject.known(epoch) for epoch in epochs[-MAX_ANSWERED:])


events = st.lists(st.tuples(st.sampled_from(["open", "request", "reply", "tick", "restart"]), st.integers(0, 5)))


@settings(max_examples=150, deadline=None)
@given(events)
def test_every_contact_is_settled_once(story: list[tuple[str, int]]) -> None:
    """A model beside the exchange: which own requests are open, and which of the peer's have been dealt with."""
    subject, now, waiting, dealt = exchange(), 0, {}, set()
    every: list[Epoch] = []
    for what, index in story:
        now += NS // 2
        if what == "open" and not subject.full:
            request = subject.open(now, now, RANGE, SNAPSHOT)
            assert request.epoch not in every
            every.append(request.epoch)
            waiting[request.epoch] = now + 5 * NS
        elif what == "request":
            epoch = Epoch(index + 1, "r2", index)
            assert subject.known(epoch) == (epoch in dealt)
            if not subject.known(epoch):
                subject.answered(epoch, SplitReply(epoch, SNAPSHOT))
                dealt.add(epoch)
        elif what == "reply" and every:
            epoch = every[index % len(every)]
            settled = subject.replied(epoch)
            assert (settled is not None) == (epoch in waiting)
            waiting.pop(epoch, None)
        elif what == "tick":
            repeat, gone = subject.expired(now)
            assert {request.epoch for request in repeat} <= set(waiting)
            old = [epoch for epoch, end in waiting.items() if now >= end]
            assert gone == len(old)
            for epoch in old:
                del waiting[epoch]
        elif what == "restart":
            subject.restarted()
            waiting, dealt = {}, set()
        assert subject.waiting == len(waiting)
        if waiting:
            assert subject.deadline_ns() <= max(waiting.values())
