"""Robots that trust what they are told of their pose (kind `fixed`)."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Broadcast, Send
from agent.events import Fix, Observation, Odometry, Tick
from agent.saved_state import StateError
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings

FIXED = LocalizationSettings(kind="fixed")
START = np.array([1.0, 2.0, 0.5])


def robot(lateness: str = "compensate") -> Agent:
    return Agent(
        AgentSettings(
            "r1",
            0,
            START,
            np.diag([0.04, 0.04, 0.01]),
            localization=FIXED,
            lateness=LatenessSettings(kind=lateness),  # type: ignore[arg-type]
        )
    )


def drive(agent: Agent, k: int, dx: float = 0.0) -> None:
    cov = np.diag([0.01, 0.01, 0.0, 0.001]) * (dx != 0.0)
    agent.handle(Odometry(k * NS, (k - 1) * NS, k * NS, np.array([dx, 0.0, 0.0, 0.0]), cov))


def pose(t_s: float, at_s: float, z: list[float], sigma: float = 0.3) -> Fix:
    return Fix(round(t_s * NS), round(at_s * NS), "pose", np.array(z), np.diag([sigma**2] * 2 + [0.02]), "autopilot")


def test_who_stands_still_is_where_it_was_set_up() -> None:
    agent = robot()
    for k in range(1, 11):
        drive(agent, k)
    estimate = agent.estimate()
    assert estimate is not None and estimate.t_ns == 10 * NS
    assert np.array_equal(estimate.mean, START)
    assert estimate.cov == pytest.approx(np.diag([0.04, 0.04, 0.01]))


def test_the_newest_fix_is_believed_as_it_is_and_not_averaged() -> None:
    agent = robot()
    for k in range(1, 6):
        drive(agent, k, 1.0)
        agent.handle(pose(k, k, [10.0 + k, -3.0, 0.25]))
    agent.handle(Tick(5 * NS + 1))
    estimate = agent.estimate()
    assert estimate is not None
    assert estimate.mean == pytest.approx([15.0, -3.0, 0.25])
    assert estimate.cov == pytest.approx(np.diag([0.09, 0.09, 0.02]))
    drive(agent, 6, 1.0)
    moved = agent.estimate()
    assert moved is not None
    assert moved.mean == pytest.approx([15.0 + np.cos(0.25), -3.0 + np.sin(0.25), 0.25], abs=0.02)
    assert np.trace(moved.cov) > np.trace(estimate.cov), "odometry adds its noise"


def test_a_fix_of_the_place_alone_leaves_the_heading() -> None:
    agent = robot()
    drive(agent, 1)
    agent.handle(Fix(NS, NS, "position", np.array([4.0, 5.0]), 0.25 * np.eye(2), "gps"))
    agent.handle(Tick(NS + 1))
    estimate = agent.estimate()
    assert estimate is not None
    assert estimate.mean == pytest.approx([4.0, 5.0, 0.5])
    assert estimate.cov == pytest.approx(np.diag([0.25, 0.25, 0.01]))


def test_a_late_fix_counts_at_its_own_instant() -> None:
    agent, never = robot(), robot("discard")
    for each in (agent, never):
        for k in range(1, 4):
            drive(each, k, 1.0)
        each.handle(pose(3.0, 1.0, [0.0, 0.0, 0.0]))
        each.handle(Tick(3 * NS + 1))
    late, dropped = agent.estimate(), never.estimate()
    assert late is not None and dropped is not None
    assert late.mean == pytest.approx([2.0, 0.0, 0.0], abs=0.6), "two metres on from where it was at 1 s"
    assert agent.counters["late.compensated"] == 1
    assert never.counters["late.dropped"] == 1 and dropped.mean[0] > 3.0


def test_it_tells_nobody_anything_and_uses_no_peer() -> None:
    agent, effects = robot(), []
    for k in range(1, 6):
        drive(agent, k, 1.0)
        seen = Observation(k * NS, k * NS, "range", "r2", np.array([3.0]), np.eye(1), "uwb")
        effects += agent.handle(seen)
        effects += agent.handle(Tick(k * NS + 1))
    assert not [effect for effect in effects if isinstance(effect, Send | Broadcast)]
    assert agent.counters["fixed.unused"] == 5


def test_a_later_life_begins_where_the_earlier_one_was() -> None:
    agent = robot()
    drive(agent, 1, 1.0)
    agent.handle(pose(1.0, 1.0, [7.0, 8.0, 0.1]))
    agent.handle(Tick(NS + 1))
    state = agent.saved()
    assert state is not None
    again = Agent(agent.settings, state).estimate()
    assert again is not None and again.mean == pytest.approx([7.0, 8.0, 0.1])
    with pytest.raises(StateError):
        Agent(agent.settings, state[:-1])
