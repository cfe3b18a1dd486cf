"""Robots that locate each other relative to their bodies: what they tell, what they wait for, what they make known."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Broadcast, Estimate
from agent.estimation.correspondence import CorrespondenceSettings
from agent.estimation.motion import SpatialMotion
from agent.events import Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.relative_filter import RelativeFilter
from agent.settings import NS, AgentSettings, LocalizationSettings, RelativeSettings, RoundSettings
from network.messages import Body, Header, Message
from network.relative_messages import Height, HypothesesReport, MotionReport, SubjectReport

STEP, WAIT = NS // 20, NS // 5
PEER = np.array([4.0, 3.0, 0.5])
"""Where p1 stands, seen from l1 at the origin; nobody moves."""
VARIANCE = 0.05


def robot(leads: bool = True, known: bool = False, peers: tuple[str, ...] = ("p1",)) -> Agent:
    return Agent(
        AgentSettings(
            "l1",
            0,
            np.array([0.0, 0.0, 100.0, 0.0]),
            1e-6 * np.eye(4),
            motion=SpatialMotion(),
            localization=LocalizationSettings(kind="relative"),
            relative=RelativeSettings(peers, leads, known, CorrespondenceSettings(clutter=0.1)),
            round=RoundSettings(NS, 0, WAIT),
            one_way_sensors=("range",),
        )
    )


def told(agent: Agent, *events: object) -> list[Body]:
    found = []
    for event in events:
        found += [effect.body for effect in agent.handle(event) if isinstance(effect, Broadcast)]  # type: ignore[arg-type]
    return found


def step(agent: Agent, k: int, scan: bool = False, named: str | None = None, ranged: bool = True) -> list[Body]:
    """The own step k, what is sensed at its end, and that all of it is in."""
    t_ns = k * STEP
    cov = VARIANCE * 0.05**2 * np.eye(4)
    events: list[object] = [Odometry(t_ns, t_ns - STEP, t_ns, np.zeros(4), cov)]
    if scan:
        events.append(Fix(t_ns, t_ns, "altitude", np.array([100.0]), 1e-5 * np.eye(1), "altitude"))
        azimuth, elevation = np.arctan2(PEER[1], PEER[0]), np.arctan2(PEER[2], np.hypot(*PEER[:2]))
        z = np.array([azimuth, elevation])
        events.append(Observation(t_ns, t_ns, "bearing3", named, z, 1e-4 * np.eye(2), "camera"))
        if ranged:
            z = np.array([np.linalg.norm(PEER)])
            events.append(Observation(t_ns, t_ns, "range", "p1", z, 1e-4 * np.eye(1), "range"))
    return told(agent, *events, Tick(t_ns))


def moved(agent: Agent, k: int, at_ns: int | None = None, peer: str = "p1", height: bool = True) -> list[Body]:
    """A peer tells of its step k."""
    report = MotionReport(STEP, np.zeros(4), VARIANCE * np.eye(4), Height(100.5, 1e-5) if height else None)
    return hear(agent, report, k * STEP, k * STEP + 1 if at_ns is None else at_ns, peer)


def hear(agent: Agent, body: Body, t_ns: int, at_ns: int, peer: str = "p1") -> list[Body]:
    return told(agent, Received(at_ns, Message(Header(peer, 1, 1, t_ns, t_ns, t_ns), body)))


def relative(agent: Agent) -> RelativeFilter:
    assert isinstance(agent.filter, RelativeFilter)
    return agent.filter


def estimate(agent: Agent) -> Estimate:
    found = agent.estimate()
    assert found is not None
    return found


def played(agent: Agent, steps: int, **how: object) -> list[Body]:
    found = []
    for k in range(1, steps + 1):
        found += step(agent, k, k % 2 == 0, **how)  # type: ignore[arg-type]
        found += moved(agent, k)
    return found


def test_everybody_tells_how_it_moves_and_how_high_it_is() -> None:
    agent = robot(leads=False)
    reports = [step(agent, k, k % 2 == 0, ranged=False) for k in range(1, 5)]
    assert [len(found) for found in reports] == [1, 1, 1, 1]
    first, second = reports[0][0], reports[1][0]
    assert isinstance(first, MotionReport) and isinstance(second, MotionReport)
    assert first.span_ns == STEP and first.height is None
    assert first.cov == pytest.approx(VARIANCE * np.eye(4))
    assert second.height is not None and second.height.altitude_m == pytest.approx(100.0)
    assert agent.counters["observation.no_identity"] == 2, "a robot without a camera takes none"


def test_short_steps_are_told_together() -> None:
    agent, reports = robot(leads=False), []
    for k in range(1, 11):
        t_ns = k * NS // 100
        delta, cov = np.array([0.01, 0.0, 0.0, 0.0]), 1e-6 * np.eye(4)
        reports += told(agent, Odometry(t_ns, t_ns - NS // 100, t_ns, delta, cov), Tick(t_ns))
    spans = [body.span_ns for body in reports if isinstance(body, MotionReport)]
    assert spans == [4 * NS // 100, 4 * NS // 100]
    (first, _) = reports
    assert isinstance(first, MotionReport)
    assert first.velocity == pytest.approx([1.0, 0.0, 0.0, 0.0])
    assert first.cov[2, 2] == pytest.approx(4e-6 / 0.04**2)


def test_a_leader_finds_out_where_a_peer_is() -> None:
    agent = robot()
    played(agent, 60)
    (found,) = estimate(agent).relatives
    assert found.peer == "p1" and found.t_ns == 60 * STEP
    assert found.mean[:3] == pytest.approx(PEER, abs=0.3)
    assert 0.0 < found.weight <= 1.0 and found.tracks >= 1
    status = agent.status()
    assert "of 1 identified" in str(status["form_reason"])
    assert "p1" in status["relatives"]  # type: ignore[operator]


def test_whom_the_camera_names_is_believed_where_names_are_known() -> None:
    agent = robot(known=True)
    played(agent, 40, named="p1")
    (found,) = estimate(agent).relatives
    assert found.mean[:3] == pytest.approx(PEER, abs=0.3)
    step(agent, 42, True)
    assert agent.counters["relative.no_identity"] == 1


def test_a_step_waits_for_who_told_lately_and_no_longer_than_it_may() -> None:
    agent = robot()
    played(agent, 10)
    step(agent, 11)
    leader = relative(agent)._leader
    assert leader is not None and leader.t_ns == 10 * STEP
    assert agent.next_deadline_ns() == 11 * STEP + WAIT
    told(agent, Tick(11 * STEP + WAIT))
    assert leader.t_ns == 11 * STEP and agent.counters["motion.guessed"] == 1
    moved(agent, 11, 11 * STEP + WAIT + 1)
    assert agent.counters["motion.late"] == 1


def test_of_who_is_silent_less_and_less_is_known() -> None:
    agent = robot()
    played(agent, 40)
    before = estimate(agent).relatives[0].cov
    for k in range(41, 81):
        step(agent, k)
    told(agent, Tick(80 * STEP + WAIT))
    after = estimate(agent).relatives[0].cov
    assert np.trace(after) > 10.0 * np.trace(before)
    assert agent.counters["motion.guessed"] >= 39


def test_strangers_are_not_listened_to() -> None:
    agent = robot()
    played(agent, 4)
    moved(agent, 5, peer="x9")
    hear(agent, HypothesesReport(0, 0, 1, ()), 4 * STEP, 4 * STEP + 2, peer="x9")
    assert agent.counters["motion.stranger"] == 1 and agent.counters["hypotheses.stranger"] == 1


def test_what_is_heard_of_the_future_is_not_used() -> None:
    agent = robot()
    moved(agent, 100, STEP)
    assert agent.counters["round.future"] == 1


def test_a_leader_tells_what_it_believes_once_per_round() -> None:
    agent = robot(peers=("l2", "p1"))
    reports = [body for body in played(agent, 65) if isinstance(body, HypothesesReport)]
    # l2 is silent: for the first second each step waits for it.
    assert 3 <= len(reports) <= 4
    (part,) = reports[-1].subjects
    assert part.subject == "p1" and part.weights.sum() <= 1.0 + 1e-9


def test_what_another_leader_told_is_used_once_and_carried_to_the_present() -> None:
    """l2 stands where l1 does: what it says of p1 is so for l1 too."""
    agent = robot(peers=("l2", "p1"))
    covs = np.array([np.diag([1e-4, 1e-4, 1e-4, 1e-3])])
    here = SubjectReport("l1", np.ones(1), np.zeros((1, 4)), covs)
    there = SubjectReport("p1", np.ones(1), np.append(PEER, 0.3)[None], covs)
    for k in range(1, 60):
        step(agent, k)
        moved(agent, k)
        moved(agent, k, peer="l2")
        if k % 20 == 0:
            for _ in range(2):
                hear(agent, HypothesesReport(0, 0, 1, (here, there)), k * STEP, k * STEP + 2, "l2")
    counters = agent.counters
    assert counters["hypotheses.known"] + counters["hypotheses.overtaken"] >= 2, "the second copy is of no use"
    assert 2 <= counters["hypotheses.used"] <= 4
    found = {item.peer: item for item in estimate(agent).relatives}
    assert found["l2"].mean == pytest.approx(np.zeros(4), abs=0.2)
    assert found["p1"].mean == pytest.approx(np.append(PEER, 0.3), abs=0.3)
    # Told at 2 s: noise of motion since is in it.
    assert found["l2"].cov[0, 0] > covs[0, 0, 0] + 0.9 * VARIANCE * 0.05 * 0.5


def test_a_peer_that_begins_anew_is_heard_from_its_first_report_on() -> None:
    agent = robot()
    agent.handle(LinkChange(0, "p1", True, 1, 7))
    played(agent, 20)
    hear(agent, HypothesesReport(0, 0, 1, ()), 20 * STEP, 20 * STEP + 2)
    told(agent, Tick(20 * STEP + WAIT + 1))
    agent.handle(LinkChange(21 * STEP, "p1", True, 2, 8))
    before = agent.counters["hypotheses.overtaken"]
    hear(agent, HypothesesReport(0, 0, 1, ()), 19 * STEP, 21 * STEP + 2)
    assert agent.counters["hypotheses.overtaken"] == before
    assert relative(agent)._leader is not None


def test_what_is_sensed_late_counts_at_its_instant_while_that_waits() -> None:
    agent = robot()
    played(agent, 10)
    step(agent, 11)
    late = Observation(11 * STEP + 5, 11 * STEP, "range", "p1", np.array([5.0]), np.eye(1), "range")
    between = Observation(11 * STEP + 6, 11 * STEP - STEP // 2, "range", "p1", np.array([5.0]), np.eye(1), "range")
    told(agent, late, between, Tick(11 * STEP + 7))
    assert not agent.counters["relative.late"]
    moved(agent, 11, 11 * STEP + 8)
    told(agent, Observation(11 * STEP + 9, 10 * STEP, "range", "p1", np.array([5.0]), np.eye(1), "range"))
    told(agent, Tick(11 * STEP + 10))
    assert agent.counters["relative.late"] == 1


def test_another_life_begins_with_its_pose_and_finds_the_others_anew() -> None:
    agent = robot()
    played(agent, 40)
    state = agent.saved()
    assert state is not None
    again = Agent(agent.settings, state)
    assert again.estimate().mean == pytest.approx(estimate(agent).mean)  # type: ignore[union-attr]
    assert again.estimate().relatives == ()  # type: ignore[union-attr]


def test_a_tilted_camera_on_a_tilted_body_sees_the_same() -> None:
    level, tilted = robot(), robot()
    seen = []
    for agent in (level, tilted):
        leader = relative(agent)._leader
        assert leader is not None
        found: list[np.ndarray] = []
        leader.saw = lambda t_ns, sight, found=found: found.append(sight.direction)  # type: ignore[method-assign,assignment]
        seen.append(found)
    z = np.array([0.4, 0.2])
    relative(level).anonymous(0, Observation(0, 0, "bearing3", None, z, np.eye(2)))
    mount = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    turned = Observation(0, 0, "bearing3", None, z - np.array([0.5, 0.0]), np.eye(2), "", mount)
    relative(tilted).anonymous(0, turned)
    assert seen[0][0] == pytest.approx(seen[1][0])
