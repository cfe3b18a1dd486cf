"""A robot of kind `clat` whose camera does not tell whom it sees: what waits, what opens contacts, and with whom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Effect, Named, Send
from agent.estimation.correspondence import CorrespondenceSettings
from agent.estimation.motion import SpatialMotion
from agent.events import ClockJudged, Fix, Observation, Odometry, Received, Tick
from agent.naming_filter import MAX_HELD, NamingFilter
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, RelativeSettings, RoundSettings
from network.messages import Header, Measurement, Message, SplitRequest
from network.relative_messages import Height, MotionReport

STEP, WAIT = NS // 10, NS // 5
SPEED = 1.0
FALSE = np.array([-2.0, 0.1])
SIGMA = 0.02


def place(k: int) -> np.ndarray:
    """Where r2 is after step k, seen from r3, which stays at the origin; r2 heads for the right."""
    return np.array([6.0, 4.0 - SPEED * k * STEP / NS, 0.5])


def direction(k: int) -> np.ndarray:
    x, y, up = place(k)
    return np.array([np.arctan2(y, x), np.arctan2(up, np.hypot(x, y))])


def robot(leads: bool = True, two_way: bool = False, **changes: object) -> Agent:
    settings = AgentSettings(
        "r3",
        0,
        np.array([0.0, 0.0, 100.0, 0.0]),
        np.diag([1.0, 1.0, 0.01, 0.01]),
        motion=SpatialMotion(),
        localization=LocalizationSettings(form="split_joint", pair_interval_ns=0, pair_timeout_ns=NS // 4),
        relative=RelativeSettings(("r2",), leads, False, CorrespondenceSettings(clutter=0.2)),
        round=RoundSettings(NS, 0, WAIT),
        one_way_sensors=() if two_way else ("range",),
        # Nobody answers: requests are given up before there are too many.
        lateness=LatenessSettings(horizon_ns=NS // 2),
    )
    return Agent(replace(settings, **changes))  # type: ignore[arg-type]


def naming(agent: Agent) -> NamingFilter:
    assert isinstance(agent.filter, NamingFilter)
    return agent.filter


def step(agent: Agent, k: int, told: bool = True, of: str | None = None, ranged: bool = True) -> list[Effect]:
    """Step k: odometry, a scan with r2 and a false bearing, a range, and what r2 tells of its motion."""
    t_ns = k * STEP
    found: list[Effect] = []
    found += agent.handle(Odometry(t_ns, t_ns - STEP, t_ns, np.zeros(4), 1e-6 * np.eye(4)))
    found += agent.handle(Fix(t_ns, t_ns, "altitude", np.array([100.0]), 1e-4 * np.eye(1), "altitude"))
    for z in (direction(k), FALSE):
        found += agent.handle(Observation(t_ns, t_ns, "bearing3", of, z, SIGMA**2 * np.eye(2), "camera"))
    if ranged:
        z = np.array([np.linalg.norm(place(k))])
        found += agent.handle(Observation(t_ns, t_ns, "range", "r2", z, 1e-2 * np.eye(1), "range"))
    found += agent.handle(Tick(t_ns))
    if told:
        found += moved(agent, k, t_ns + 1)
    return found


def moved(agent: Agent, k: int, at_ns: int) -> list[Effect]:
    """r2 tells of its step k."""
    report = MotionReport(STEP, np.array([SPEED, 0.0, 0.0, 0.0]), 1e-4 * np.eye(4), Height(100.5, 1e-4))
    header = Header("r2", 1, 1, k * STEP, k * STEP, k * STEP)
    return agent.handle(Received(at_ns, Message(header, report)))


def asked(effects: list[Effect], k: int = 41) -> list[tuple[str, ...]]:
    """Kinds of measurements of each contact that was opened for step k; nobody answers, so others are repeated."""
    return [
        tuple(sorted(item.kind for item in effect.body.measurements))
        for effect in effects
        if isinstance(effect, Send) and isinstance(effect.body, SplitRequest) and effect.t_meas_ns == k * STEP
    ]


def ready(**how: object) -> Agent:
    """A robot that has seen r2 for four seconds."""
    agent = robot(**how)  # type: ignore[arg-type]
    for k in range(1, 41):
        step(agent, k)
    return agent


def test_before_r2_is_identified_only_ranges_are_used() -> None:
    agent = robot()
    assert asked(step(agent, 1), 1) == [("range",)]
    assert not agent.counters["naming.named"]


def test_a_bearing_that_has_a_name_joins_the_range_of_its_instant() -> None:
    agent = ready()
    effects = step(agent, 41)
    assert asked(effects) == [("bearing3", "range")]
    (named,) = [effect for effect in effects if isinstance(effect, Named)]
    assert named.peer == "r2" and named.sensor == "camera" and named.t_meas_ns == 41 * STEP
    assert named.z == pytest.approx(direction(41)), "the false one has none"


def test_without_a_range_the_bearing_opens_a_contact_alone() -> None:
    agent = ready()
    assert asked(step(agent, 41, ranged=False)) == [("bearing3",)]


def test_what_comes_when_r2_has_told_is_of_its_own_instant() -> None:
    """Ranges wait for how the peer moved, or for `round.wait_s`; contacts are of the instant of the scan."""
    agent = ready()
    assert asked(step(agent, 41, told=False)) == []
    assert naming(agent).sizes() == {"ranges": (1, MAX_HELD)}
    assert asked(moved(agent, 41, 41 * STEP + NS // 20)) == [("bearing3", "range")]
    agent = ready()
    assert asked(step(agent, 41, told=False)) == []
    deadline_ns = agent.next_deadline_ns()
    assert deadline_ns <= 41 * STEP + WAIT
    assert asked(agent.handle(Tick(41 * STEP + WAIT))) == [("bearing3", "range")]


def test_a_two_way_range_of_the_lower_id_tells_robots_apart_only() -> None:
    agent = ready(two_way=True)
    assert asked(step(agent, 41)) == [("bearing3",)]
    assert agent.counters["pair.not_owner"] == 41


def test_a_peer_whose_clock_is_off_gets_no_contact() -> None:
    agent = ready()
    agent.handle(ClockJudged(40 * STEP + 2, "r2", "steps"))
    effects = step(agent, 41)
    assert asked(effects) == [] and not any(isinstance(effect, Named) for effect in effects)
    assert agent.counters["observation.clock_unusable"] == 2


def test_who_has_no_camera_uses_ranges_at_once_and_tells_how_it_moves() -> None:
    agent = robot(leads=False)
    effects = step(agent, 1, told=False)
    assert asked(effects, 1) == [("range",)]
    assert any(getattr(effect, "body", None).__class__ is MotionReport for effect in effects)
    assert agent.counters["observation.no_identity"] == 2
    assert "no camera" in agent.filter.form()[1]


def test_a_stranger_is_used_at_once() -> None:
    agent = robot(relative=RelativeSettings(("r9",), True, False, CorrespondenceSettings(clutter=0.2)))
    effects: list[Effect] = []
    agent.handle(Odometry(STEP, 0, STEP, np.zeros(4), 1e-6 * np.eye(4)))
    agent.filter.measured("r2", STEP, STEP, (Measurement("range", np.array([7.0]), np.eye(1)),), effects)
    assert asked(effects, 1) == [("range",)]


def test_what_waits_is_bounded() -> None:
    agent = robot()
    found = naming(agent)
    item = Measurement("range", np.array([7.0]), np.eye(1))
    for k in range(MAX_HELD + 10):
        found.measured("r2", 100 * NS + k, 0, (item,), [])
    assert found.sizes() == {"ranges": (MAX_HELD, MAX_HELD)}
    assert agent.counters["naming.overflow"] == 10


def test_a_rewind_tells_nobody_twice() -> None:
    """Late fixes lead back; how the robot moved was told before, and is in the sums."""
    agent = robot(lateness=LatenessSettings(kind="replay"))
    for k in range(1, 6):
        step(agent, k, ranged=False)
    before = naming(agent)._leader
    assert before is not None
    scans = agent.counters["relative.scans"]
    late = Fix(5 * STEP + 5, 2 * STEP, "position", np.array([0.1, 0.1, 100.0]), np.eye(3), "gnss")
    effects = agent.handle(late)
    assert agent.counters["replay.rewinds"] == 1
    effects += step(agent, 6, ranged=False)
    spans = [e.body.span_ns for e in effects if isinstance(getattr(e, "body", None), MotionReport)]
    assert spans == [STEP]
    assert agent.counters["relative.scans"] == scans + 1
    assert agent.counters["late.replayed"] == 1


def test_where_others_are_is_made_known_with_the_own_place() -> None:
    agent = ready()
    estimate = agent.estimate()
    assert estimate is not None
    (found,) = estimate.relatives
    assert found.peer == "r2" and found.mean[:3] == pytest.approx(place(40), abs=0.2)
    form, why = agent.filter.form()
    assert form == "split_joint" and "1 of 1 identified" in why
    assert agent.saved() is not None
