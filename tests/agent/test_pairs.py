"""What a peer may tell: rubbish is counted, never fatal, and never changes the estimate; restarts are limited."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.core import Agent
from agent.estimation.motion import UNICYCLE, TargetMotion
from agent.events import LinkChange, Received
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from network.messages import (
    MAX_MESSAGE_BYTES,
    Belief,
    Epoch,
    Header,
    Line,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
)
from network.wire import encode
from tests.agent.courier import FIRST, SECOND, Pair

STARTS = {
    FIRST: (np.array([0.0, 0.0, 0.3]), np.diag([0.3, 0.2, 0.01])),
    SECOND: (np.array([6.0, 2.0, -1.0]), np.diag([0.4, 0.5, 0.02])),
}
NOISE = np.diag([0.02, 0.01, 0.0, 0.001])


def met_pair(until_s: int = 2) -> Pair:
    """Two robots that had one contact at 1 s, and drove on until `until_s`."""
    pair = Pair(STARTS)
    for name in STARTS:
        pair.odometry(name, 0, NS, np.array([0.3, 0.0, 0.0, 0.1]), NOISE)
    pair.converse(pair.measure(FIRST, NS, "range", np.array([6.1]), np.array([[0.01]])))
    for k in range(1, until_s):
        for name in STARTS:
            pair.odometry(name, k * NS, (k + 1) * NS, np.array([0.3, 0.0, 0.0, 0.1]), NOISE)
    return pair


def told(body: PairRequest | PairReply, seq: int = 9) -> Received:
    return Received(2 * NS, Message(Header(SECOND, 1, 1, seq, NS, 2 * NS), body))


BASES = [Epoch(), Epoch(NS, FIRST, 1), Epoch(NS, SECOND, 4), Epoch(2 * NS, SECOND, 1)]
SHAPES = [(3, 0), (3, 3), (3, 4), (4, 4), (1, 1)]
MODELS = [("unicycle", 3), ("constant_velocity", 4), ("damped_velocity", 4)]


@st.composite
def snapshots(draw: st.DrawFn) -> Snapshot:
    """Well-formed values in shapes and sizes that need not fit together."""
    name, n = draw(st.sampled_from(MODELS))
    scale = draw(st.sampled_from([1e-9, 1.0, 1e8]))
    shape, line = draw(st.sampled_from(SHAPES)), draw(st.sampled_from(SHAPES))
    lines = tuple(
        Line(epoch, np.full(draw(st.sampled_from(SHAPES)), scale)) for epoch in draw(st.lists(st.sampled_from(BASES)))
    )
    mean = np.full(n, draw(st.sampled_from([0.0, 6.0, 1e8])))
    return Snapshot(
        Belief(name, mean, np.eye(n) * scale),
        draw(st.sampled_from(BASES)),
        np.full(shape, scale),
        np.full(line, scale),
        lines,
        (),
        draw(st.booleans()),
    )


@settings(max_examples=300, deadline=None)
@given(snapshots(), st.sampled_from(["range", "bearing", "range_bearing", "smell"]), st.sampled_from(BASES[1:]))
def test_no_snapshot_stops_the_agent(snapshot: Snapshot, kind: str, epoch: Epoch) -> None:
    pair = met_pair()
    subject = pair.agents[FIRST]
    z = np.array([5.0, 0.1])[: 2 if kind == "range_bearing" else 1]
    subject.handle(told(PairRequest(epoch, (Measurement(kind, z, np.eye(len(z)) * 0.01),), snapshot)))
    subject.handle(told(PairReply(epoch, ReplyStatus.OK, snapshot), 10))
    np.linalg.cholesky(subject.filter.state.cov)
    assert np.all(np.isfinite(subject.filter.state.mean))


@pytest.mark.parametrize("shape", [(3, 0), (3, 4), (1, 1)])
def test_a_factor_of_the_wrong_size_is_counted_and_changes_nothing(shape: tuple[int, int]) -> None:
    pair = met_pair()
    subject, peer = pair.agents[FIRST], pair.agents[SECOND]
    wrong = replace(peer.filter.snapshot(FIRST), factor=np.ones(shape))
    before = subject.filter.state
    item = Measurement("bearing", np.array([0.2]), np.array([[0.01]]))
    subject.handle(told(PairRequest(Epoch(2 * NS, SECOND, 1), (item,), wrong)))
    assert subject.counters["pair.malformed"] == 1
    assert subject.filter.state is before


def test_an_unknown_correlation_doubles_the_covariance_once_and_the_pair_goes_on() -> None:
    """One side has lost its factors: neither uses that contact, both double their own, the next one works."""
    pair = met_pair(until_s=1)
    lost = pair.agents[SECOND].settings
    pair.agents[SECOND] = Agent(replace(lost, start_ns=NS, mean=pair.agents[SECOND].filter.state.mean))
    for name in STARTS:
        pair.odometry(name, NS, 2 * NS, np.array([0.3, 0.0, 0.0, 0.1]), NOISE)
    before = {name: agent.filter.state.cov for name, agent in pair.agents.items()}
    pair.converse(pair.measure(FIRST, 2 * NS, "range", np.array([6.1]), np.array([[0.01]])))
    for name, agent in pair.agents.items():
        assert agent.counters["pair.fallback"] == 1
        assert np.array_equal(agent.filter.state.cov, 2.0 * before[name])
        assert not agent.filter.state.pair(SECOND if name == FIRST else FIRST).base.met
    for name in STARTS:
        pair.odometry(name, 2 * NS, 3 * NS, np.array([0.3, 0.0, 0.0, 0.1]), NOISE)
    pair.converse(pair.measure(FIRST, 3 * NS, "range", np.array([6.1]), np.array([[0.01]])))
    assert pair.agents[FIRST].counters["pair.applied_initiator"] == 2
    assert pair.cross() is not None


def test_a_peer_that_keeps_restarting_cannot_inflate_us_without_limit() -> None:
    pair = met_pair(until_s=1)
    base = pair.agents[FIRST].settings
    limited = replace(base, localization=LocalizationSettings(form="safe", restart_interval_ns=60 * NS))
    pair.agents[FIRST] = Agent(limited)
    subject = pair.agents[FIRST]
    pair.odometry(FIRST, 0, NS, np.array([0.3, 0.0, 0.0, 0.1]), NOISE)
    for life in range(1, 12):
        subject.handle(LinkChange(NS, SECOND, True, life, life))
        epoch = Epoch(NS, SECOND, life)
        item = Measurement("bearing", np.array([-2.0]), np.array([[0.01]]))
        peer = pair.agents[SECOND].filter.snapshot(FIRST)
        fresh = replace(peer, base=Epoch(), factor=np.zeros((3, 0)), line=np.eye(3), lines=())
        subject.handle(told(PairRequest(epoch, (item,), fresh), life))
    assert subject.counters["pair.restarts"] == 1
    assert subject.counters["pair.restart_refused"] >= 1
    planar = NOISE[np.ix_((0, 1, 3), (0, 1, 3))]
    assert np.trace(subject.filter.state.cov) <= 2.0 * np.trace(STARTS[FIRST][1] + planar) + 0.1


def test_a_clock_that_is_off_is_mapped_and_its_doubt_widens_the_noise() -> None:
    """The peer's clock is 0.4 s ahead, known to 0.1 s, in a fleet whose clocks agree to 1 s only."""
    lateness = LatenessSettings(clock_sigma_ns=NS, horizon_ns=60 * NS)
    agents = {
        name: Agent(
            AgentSettings(
                robot=name,
                start_ns=0,
                mean=mean,
                cov=cov,
                localization=LocalizationSettings(form="safe", pair_interval_ns=0),
                lateness=lateness,
            )
        )
        for name, (mean, cov) in STARTS.items()
    }
    pair = Pair(STARTS)
    pair.agents = agents
    for name in STARTS:
        pair.odometry(name, 0, 2 * NS, np.array([0.6, 0.0, 0.0, 0.0]), NOISE)
    (letter,) = pair.measure(SECOND, NS, "bearing", np.array([-2.0]), np.array([[0.01]]))
    # Nothing is known of r1's clock yet: the prior of one second widens the bearing's noise.
    assert letter.body.measurements[0].R[0, 0] > 0.01
    header = Header(SECOND, 1, 1, 0, letter.t_meas_ns, 2 * NS)
    received = Received(2 * NS, Message(header, letter.body), offset_ns=400_000_000, offset_sigma_ns=100_000_000)
    (answer,) = [effect for effect in agents[FIRST].handle(received) if hasattr(effect, "body")]
    snapshot = answer.body.snapshot
    # The instant on r1's clock: 1 s - 0.4 s x 1 / 1.01 (the share of the measured offset).
    at_s = 1.0 - 0.4 / 1.01
    assert snapshot.belief.mean[0] == pytest.approx(0.3 * np.cos(0.3) * at_s, abs=1e-3)


def test_many_targets_do_not_silence_a_pair() -> None:
    """Eight targets do not fit into one message: those that do are told, and the contact goes on."""
    pair = met_pair(until_s=1)
    motion = TargetMotion(UNICYCLE)
    targets = tuple(
        TargetSettings(f"a-target-with-a-long-id{k}", motion, np.array([k, 0.0, 0.0]), np.eye(3)) for k in range(8)
    )
    agents = {}
    for name, agent in pair.agents.items():
        many = replace(agent.settings, targets=targets, track=True, mean=agent.filter.state.mean, start_ns=NS)
        agents[name] = Agent(many)
    pair.agents = agents
    (letter,) = pair.measure(FIRST, NS, "range", np.array([6.1]), np.array([[0.01]]))
    header = Header(FIRST, 2**53, 2**53, 2**53, letter.t_meas_ns, 2**62)
    assert 1 <= len(letter.body.snapshot.targets) < 8
    assert len(encode(header, letter.body)) <= MAX_MESSAGE_BYTES
    pair.converse([letter])
    assert pair.agents[FIRST].counters["pair.applied_initiator"] == 1
