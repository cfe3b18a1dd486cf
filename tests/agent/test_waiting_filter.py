"""Robots that do not know where they are: they wait, say for what, and start from fixes or from a peer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Alarm, Effect, Persist, Publish, Send
from agent.estimation.gaussian import wrap
from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion
from agent.events import Event, Fix, Observation, Odometry, Received, Tick
from agent.recording import pack
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from agent.start import A_HEADING, A_PLACE
from network.messages import (
    Header,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
    SplitReply,
    SplitRequest,
    StartRequest,
)

Array = NDArray[np.float64]

FORMS = ("split_joint", "safe", "published")
R = np.diag([0.01, 0.0004])
NOISE = np.diag([1e-4, 1e-4, 0.0, 1e-5])
TRUTH = {"r1": np.array([1.0, 2.0, 0.5]), "r2": np.array([6.0, 4.0, -1.0]), "r3": np.array([3.0, 9.0, 2.0])}
TARGET = TargetSettings("t1", TargetMotion(CONSTANT_VELOCITY), np.array([2.0, 2.0, 0.1, 0.0]), np.eye(4))


def settings(robot: str, source: str = "survey", form: str = "split_joint", **changes: object) -> AgentSettings:
    survey = source == "survey"
    found = AgentSettings(
        robot,
        0,
        TRUTH[robot] if survey else np.zeros(3),
        np.diag([0.09, 0.09, 0.0025]) if survey else np.zeros((3, 3)),
        localization=LocalizationSettings(form=form, pair_interval_ns=0),  # type: ignore[arg-type]
        lateness=LatenessSettings(horizon_ns=20 * NS),
        source=source,  # type: ignore[arg-type]
    )
    return replace(found, **changes)  # type: ignore[arg-type]


class Team:
    """Agents whose messages arrive at once."""

    def __init__(self, *agents: Agent) -> None:
        self.agents = {agent.settings.robot: agent for agent in agents}
        self.sent: list[tuple[str, Send]] = []
        self.alarms: list[Alarm] = []
        self._seq = 0

    def handle(self, robot: str, event: Event) -> list[Effect]:
        effects = self.agents[robot].handle(event)
        self.alarms += [item for item in effects if isinstance(item, Alarm)]
        for item in effects:
            if isinstance(item, Send):
                self.sent.append((robot, item))
                self.deliver(robot, item, event.t_ns)
        return effects

    def deliver(self, robot: str, item: Send, t_ns: int) -> None:
        self._seq += 1
        message = Message(Header(robot, 1, 1, self._seq, item.t_meas_ns, t_ns), item.body)
        if item.peer in self.agents:
            self.handle(item.peer, Received(t_ns, message))

    def bodies(self, kind: type) -> list[Send]:
        return [item for _, item in self.sent if isinstance(item.body, kind)]


def still(t_ns: int) -> Odometry:
    return Odometry(t_ns, t_ns - NS, t_ns, np.zeros(4), NOISE)


def seen(observer: str, subject: str, t_ns: int, kind: str = "range_bearing") -> Observation:
    apart = TRUTH[subject][:2] - TRUTH[observer][:2]
    z = np.array([np.hypot(*apart), wrap(np.arctan2(apart[1], apart[0]) - TRUTH[observer][2])])
    if kind == "bearing":
        return Observation(t_ns, t_ns, "bearing", subject, z[1:], R[1:, 1:], "camera")
    return Observation(t_ns, t_ns, kind, subject, z, R, "camera")


def compass(robot: str, t_ns: int) -> Fix:
    return Fix(t_ns, t_ns, "heading", TRUTH[robot][2:], np.array([[0.0025]]), "compass")


def error(agent: Agent) -> Array:
    estimate = agent.estimate()
    assert estimate is not None
    found = estimate.mean - TRUTH[agent.settings.robot]
    found[2] = wrap(found[2])
    return found


@pytest.mark.parametrize("form", FORMS)
def test_a_robot_without_a_start_waits_and_says_for_what(form: str) -> None:
    subject = Agent(settings("r2", "fix", form))
    effects = subject.handle(still(NS))
    assert [(item.reason, item.detail) for item in effects if isinstance(item, Alarm)] == [
        ("waiting", f"{A_PLACE}; {A_HEADING}")
    ]
    assert not any(isinstance(item, Publish) for item in effects)
    assert subject.estimate() is None
    status = subject.status()
    assert status["state"] == "waiting" and status["missing"] == [A_PLACE, A_HEADING]
    assert "x_m" not in status
    # Said once.
    assert subject.handle(still(2 * NS)) == []
    effects = subject.handle(compass("r2", 2 * NS))
    assert [item.detail for item in effects if isinstance(item, Alarm)] == [A_PLACE]


@pytest.mark.parametrize("form", FORMS)
def test_the_first_fixes_start_it(form: str) -> None:
    subject = Agent(settings("r2", "fix", form))
    subject.handle(still(NS))
    subject.handle(compass("r2", NS))
    effects = subject.handle(Fix(NS, NS, "position", TRUTH["r2"][:2], 0.04 * np.eye(2), "gps"))
    assert isinstance(effects[0], Publish) and effects[1] == Alarm("started")
    assert [type(effect) for effect in effects[2:]] == [Persist]
    assert np.abs(error(subject)).max() < 1e-6
    assert subject.status()["state"] == "running"
    before = subject.estimate()
    subject.handle(still(2 * NS))
    subject.handle(Fix(2 * NS, 2 * NS, "position", TRUTH["r2"][:2], 0.04 * np.eye(2), "gps"))
    after = subject.estimate()
    assert before is not None and after is not None and after.t_ns == 2 * NS
    assert np.trace(after.cov[:2, :2]) < 0.6 * np.trace(before.cov[:2, :2])


@pytest.mark.parametrize("form", FORMS)
def test_it_starts_beside_a_peer_it_measures(form: str) -> None:
    team = Team(Agent(settings("r1", form=form)), Agent(settings("r2", "peer", form)))
    for robot in ("r1", "r2"):
        team.handle(robot, still(NS))
    team.handle("r2", compass("r2", NS))
    team.handle("r2", seen("r2", "r1", NS))
    assert len(team.bodies(StartRequest)) == 1
    subject = team.agents["r2"]
    assert np.abs(error(subject)).max() < 0.02
    assert subject.settings.shared is not None
    assert np.allclose(subject.settings.shared[:2, :2], 0.09 * np.eye(2), atol=0.01)
    assert subject.counters["start.answered"] == team.agents["r1"].counters["start.answers"] == 1


@pytest.mark.parametrize("form", FORMS)
def test_it_starts_where_a_peer_measures_it_and_from_the_view_it_has_of_the_peer(form: str) -> None:
    team = Team(Agent(settings("r1", form=form)), Agent(settings("r2", "peer", form)))
    for robot in ("r1", "r2"):
        team.handle(robot, still(NS))
    team.handle("r2", seen("r2", "r1", NS, "bearing"))
    assert team.agents["r2"].estimate() is None
    team.handle("r1", seen("r1", "r2", NS))
    assert np.abs(error(team.agents["r2"])).max() < 0.02


def test_a_peer_that_waits_itself_tells_nothing() -> None:
    team = Team(Agent(settings("r1", "fix")), Agent(settings("r2", "peer")))
    team.handle("r2", still(NS))
    team.handle("r2", compass("r2", NS))
    team.handle("r2", seen("r2", "r1", NS))
    team.handle("r1", Tick(4 * NS))
    assert team.agents["r2"].estimate() is None
    assert team.agents["r1"].counters["waiting.asked"] == 1
    assert team.bodies(SplitReply) == []


def test_who_asks_for_an_instant_nobody_remembers_gets_no_belief() -> None:
    for form, answers in (("split_joint", 0), ("safe", 1)):
        peer = Agent(settings("r1", form=form))
        team = Team(peer, Agent(settings("r2", "peer", form)))
        for k in range(1, 40):
            team.handle("r1", still(k * NS))
        for k in range(1, 3):
            team.handle("r2", still(k * NS))
        team.handle("r2", compass("r2", 2 * NS))
        team.handle("r2", seen("r2", "r1", 2 * NS))
        assert len(team.bodies(PairReply)) == answers
        assert team.agents["r2"].estimate() is None
        assert peer.counters["pair.too_old"] == 1


def test_a_contact_told_again_is_not_used_again() -> None:
    """The measurement that gave the start would count twice."""
    team = Team(Agent(settings("r1")), Agent(settings("r2", "peer")))
    for robot in ("r1", "r2"):
        team.handle(robot, still(NS))
    team.handle("r2", compass("r2", NS))
    team.handle("r1", seen("r1", "r2", NS))
    subject = team.agents["r2"]
    before = subject.estimate()
    (request,) = team.bodies(SplitRequest)
    team.deliver("r1", request, NS)
    team.handle("r2", still(2 * NS))
    team.deliver("r1", request, 2 * NS)
    after = subject.estimate()
    assert before is not None and after is not None
    assert np.trace(after.cov) > np.trace(before.cov)
    assert team.bodies(SplitReply) == []
    assert subject.counters["start.told_again"] == 2


@pytest.mark.parametrize("form", ["safe", "published"])
def test_with_factors_no_correlation_is_known_to_anybody_after_a_start_from_a_peer(form: str) -> None:
    """Both ends double what they claim before the pair begins, and only then use their measurements."""
    team = Team(*(Agent(settings(name, "peer" if name == "r2" else "survey", form)) for name in TRUTH))
    for robot in TRUTH:
        team.handle(robot, still(NS))
    team.handle("r2", compass("r2", NS))
    team.handle("r2", seen("r2", "r1", NS))
    for k, other in ((2, "r1"), (3, "r3")):
        for robot in TRUTH:
            team.handle(robot, still(k * NS))
        before = {name: team.agents[name].estimate() for name in ("r2", other)}
        team.handle("r2", seen("r2", other, k * NS))
        for name, old in before.items():
            new = team.agents[name].estimate()
            assert old is not None and new is not None
            np.testing.assert_allclose(new.cov, 2.0 * old.cov)
    for robot in TRUTH:
        team.handle(robot, still(4 * NS))
    team.handle("r2", seen("r2", "r1", 4 * NS))
    assert team.agents["r2"].counters["pair.applied_initiator"] == 1


def test_while_it_waits_a_contact_with_factors_is_put_off() -> None:
    """The peer must not believe that the contact was applied."""
    team = Team(Agent(settings("r1", form="safe")), Agent(settings("r2", "fix", "safe")))
    for robot in ("r1", "r2"):
        team.handle(robot, still(NS))
    team.handle("r1", seen("r1", "r2", NS))
    assert [item.body.status for item in team.bodies(PairReply)] == [ReplyStatus.BUSY]  # type: ignore[attr-defined]
    assert len(team.bodies(PairRequest)) == 1
    assert team.agents["r1"].counters["pair.answer_busy"] == 1
    assert team.agents["r2"].counters["waiting.unused"] == 1


@pytest.mark.parametrize("form", ["split_joint", "safe"])
def test_the_prior_of_a_target_has_drifted_when_a_robot_starts(form: str) -> None:
    subject = Agent(settings("r2", "fix", form, targets=(TARGET,)))
    for k in range(1, 6):
        subject.handle(still(k * NS))
    subject.handle(Fix(5 * NS, 5 * NS, "pose", TRUTH["r2"], 0.04 * np.eye(3), "gps"))
    estimate = subject.estimate()
    assert estimate is not None
    (track,) = estimate.tracks
    assert np.allclose(track.mean, [2.5, 2.0, 0.1, 0.0])
    # A deviation of 1 m, 1 m/s for 5 s, and white acceleration of (0.1 m/s^2)^2 s.
    assert track.cov[0, 0] == pytest.approx(26.0 + 0.01 * 125.0 / 3.0)


def test_an_error_taken_from_a_peer_may_be_correlated_with_a_targets_prior() -> None:
    """The first own sighting inflates both, since nobody knows how."""
    target = replace(TARGET, cov=0.1 * np.eye(4))
    team = Team(
        Agent(settings("r1", targets=(target,))),
        Agent(settings("r2", "peer", targets=(target,))),
    )
    for robot in ("r1", "r2"):
        team.handle(robot, still(NS))
    team.handle("r2", compass("r2", NS))
    team.handle("r2", seen("r2", "r1", NS))
    subject = team.agents["r2"]
    before = subject.estimate()
    assert before is not None and [track.target for track in before.tracks] == ["t1"]
    assert subject.filter.state.tracks == ()  # type: ignore[attr-defined]
    z = np.array([7.0])
    team.handle("r2", Observation(NS, NS, "range", "target:t1", z, np.array([[100.0]]), "camera"))
    after = subject.estimate()
    assert after is not None and subject.filter.state.tracks == ("t1",)  # type: ignore[attr-defined]
    assert np.trace(after.cov) > np.trace(before.cov)


def test_the_whole_story_plays_back_bit_for_bit() -> None:
    events: list[Event] = [still(NS), compass("r2", NS), seen("r2", "r1", NS), still(2 * NS)]
    events.append(Fix(2 * NS, 2 * NS, "pose", TRUTH["r2"], 0.04 * np.eye(3), "gps"))
    first, again = Agent(settings("r2", "fix")), Agent(settings("r2", "fix"))
    for event in events:
        assert [pack(item) for item in first.handle(event)] == [pack(item) for item in again.handle(event)]
