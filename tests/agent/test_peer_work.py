"""What a peer may ask for is bounded by the work that it makes, and refills with time."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core import Agent
from agent.events import Odometry, Received
from agent.peer_work import EACH, MOST, PER_S, PeerWork
from agent.settings import NS
from network.messages import Epoch, Header, Measurement, Message, SplitRequest, SplitSnapshot
from network.peers import MAX_PEERS
from tests.agent.team_story import settings


@pytest.mark.parametrize(("rate_hz", "late_s"), [(50, 0.05), (100, 0.0), (10, 1.5)])
def test_who_measures_often_or_late_is_always_answered(rate_hz: int, late_s: float) -> None:
    work = PeerWork()
    for k in range(60 * rate_hz):
        now_ns = k * NS // rate_hz
        assert work.allowed("r2", now_ns, now_ns - int(late_s * NS))


def test_what_a_clogged_link_delivers_at_once_is_answered() -> None:
    work = PeerWork()
    # Five seconds of contacts, ten times a second, and again five seconds later.
    assert all(work.allowed("r2", 10 * NS, 10 * NS - k * NS // 10) for k in range(50))
    assert all(work.allowed("r2", 15 * NS, 15 * NS - k * NS // 10) for k in range(50))


def test_beyond_its_allowance_a_peer_is_refused_and_others_are_not() -> None:
    work = PeerWork()
    taken = sum(work.allowed("r2", 10 * NS, 5 * NS) for _ in range(1000))
    assert taken == int(MOST / (5.0 + EACH))
    assert work.allowed("r3", 10 * NS, 5 * NS)
    taken = sum(work.allowed("r2", 10 * NS + k * NS // 100, 5 * NS + k * NS // 100) for k in range(1, 1001))
    assert taken == pytest.approx(10.0 * PER_S / (5.0 + EACH), abs=1.5), "it refills with time"


def test_ever_new_names_fill_no_table() -> None:
    work = PeerWork()
    for k in range(1000):
        work.allowed(f"x{k}", NS, NS)
    assert len(work._left) == MAX_PEERS


def test_a_flood_of_requests_for_the_past_has_little_of_it_done_again() -> None:
    agent = Agent(settings("r1", np.zeros(3), np.diag([1.0, 1.0, 0.01]), None))
    for second in range(1, 6):
        agent.handle(Odometry(second * NS, (second - 1) * NS, second * NS, np.zeros(4), np.eye(4) * 1e-4))
    seen = (Measurement("range", np.array([5.0]), np.eye(1) * 0.01),)
    told = SplitSnapshot("unicycle", (), np.array([5.0, 0.0, 0.0]), np.diag([1.0, 1.0, 0.01]))
    for k in range(300):
        body = SplitRequest(Epoch(NS // 100 + k, "r2", k + 1), seen, told)
        agent.handle(Received(5 * NS, Message(Header("r2", 1, 1, k, 5 * NS, 5 * NS), body)))
    answered = int(MOST / (5.0 - 0.01 + EACH))
    assert agent.counters["pair.applied_responder"] == answered
    assert agent.counters["pair.too_much_asked"] == 300 - answered
