"""One robot that triangulates: what it tells, what it does with what it hears, and what it makes known."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Broadcast
from agent.estimation.motion import CONSTANT_VELOCITY_3D, SpatialMotion, TargetMotion
from agent.events import LinkChange, Observation, Odometry, Received, Tick
from agent.settings import NS, AgentSettings, LocalizationSettings, RoundSettings, TargetSettings, TrackingSettings
from network.bearing_messages import Bearing, BearingReport, Prediction
from network.messages import MAX_MESSAGE_BYTES, Header, Message
from network.wire import size_bound

PERIOD_NS, WAIT_NS = NS // 10, NS // 50
TARGET = np.array([20.0, 0.0, 5.0])
PLACES = {"r1": np.array([0.0, -8.0, 0.0]), "r2": np.array([0.0, 8.0, 0.0])}
SIGMA = 0.01


def robot(kind: str = "icf_plus", names: tuple[str, ...] = ("t1",)) -> Agent:
    motion = TargetMotion(CONSTANT_VELOCITY_3D, noise_sigma=(2.0,) * 3, noise_step_s=0.1)
    return Agent(
        AgentSettings(
            "r1",
            0,
            np.append(PLACES["r1"], 0.0),
            1e-6 * np.eye(4),
            motion=SpatialMotion(),
            targets=tuple(
                TargetSettings(name, motion, None, np.diag([0.0, 0.0, 100.0, 4.0, 4.0, 4.0])) for name in names
            ),
            localization=LocalizationSettings(kind="fixed"),
            tracking=TrackingSettings(kind),  # type: ignore[arg-type]
            round=RoundSettings(PERIOD_NS, 0, WAIT_NS),
        )
    )


def towards(place: np.ndarray) -> np.ndarray:
    away = TARGET - place
    return np.asarray(away / np.linalg.norm(away))


def play(
    agent: Agent, k: int, see: bool = True, ends: bool = True, names: tuple[str, ...] = ("t1",)
) -> list[BearingReport]:
    """Odometry and a sighting at the instant of round k, and then its end; what it tells."""
    t_ns, told = k * PERIOD_NS, []
    events = [Odometry(t_ns, t_ns - PERIOD_NS, t_ns, np.zeros(4), np.zeros((4, 4)))]
    x, y, z = towards(PLACES["r1"])
    if see:
        angles = np.array([np.arctan2(y, x), np.arcsin(z)])
        for name in names:
            events.append(Observation(t_ns, t_ns, "bearing3", f"target:{name}", angles, SIGMA**2 * np.eye(2), "camera"))
    events.append(Tick(t_ns))
    if ends:
        events.append(Tick(t_ns + WAIT_NS))
    for event in events:
        for effect in agent.handle(event):
            if isinstance(effect, Broadcast) and isinstance(effect.body, BearingReport):
                told.append(effect.body)
    return told


def report(agent: Agent, k: int, heard_k: float, *predictions: Prediction, peer: str = "r2") -> None:
    """A peer's bearing of the instant of round k reaches the robot at that of `heard_k`."""
    seen = Bearing("t1", PLACES["r2"], np.zeros((3, 3)), towards(PLACES["r2"]), SIGMA, 0)
    header = Header(peer, 1, 1, k, k * PERIOD_NS, k * PERIOD_NS)
    agent.handle(Received(round(heard_k * PERIOD_NS), Message(header, BearingReport((seen,), predictions))))


def told(k: int) -> Prediction:
    return Prediction("t1", np.append(TARGET, np.zeros(3)), np.eye(6))


def test_it_tells_where_it_sees_the_target_from_and_in_which_direction() -> None:
    agent = robot()
    assert play(agent, 1)[-1].bearings[0].direction == pytest.approx(towards(PLACES["r1"]))
    (second,) = play(agent, 2)
    (seen,), (predicted,) = second.bearings, second.predictions
    assert seen.place == pytest.approx(PLACES["r1"])
    assert seen.sigma_rad == pytest.approx(SIGMA, rel=0.1)
    assert seen.age_ns == 0
    assert predicted.cov is not None


@pytest.mark.parametrize(("kind", "parts"), [("cmkf", (1, 0)), ("cikf", (0, 1)), ("stt", (1, 1)), ("hcmci", (1, 1))])
def test_each_kind_tells_what_its_neighbours_need(kind: str, parts: tuple[int, int]) -> None:
    agent = robot(kind)
    play(agent, 1)
    (found,) = play(agent, 2)
    assert (len(found.bearings), len(found.predictions)) == parts


def test_more_targets_than_a_message_holds_are_told_in_turn() -> None:
    names = tuple(f"target-number-{number}" for number in range(8))
    agent, told_of = robot(names=names), Counter[str]()
    for k in range(1, 17):
        (found,) = play(agent, k, names=names)
        assert size_bound(found) <= MAX_MESSAGE_BYTES
        assert [item.target for item in found.bearings] == sorted(item.target for item in found.bearings)
        assert {item.target for item in found.bearings} == {item.target for item in found.predictions}
        told_of.update(item.target for item in found.bearings)
    left_out = 16 * len(names) - sum(told_of.values())
    assert agent.counters["round.left_out"] == left_out > 0
    assert set(told_of) == set(names)
    assert max(told_of.values()) - min(told_of.values()) <= 1


def test_alone_it_tells_no_place_and_says_why() -> None:
    agent = robot()
    for k in range(1, 30):
        play(agent, k)
    estimate = agent.estimate()
    assert estimate is not None and estimate.tracks == ()
    assert "bearings of t1 do not cross" in str(agent.status()["form_reason"])


def test_with_another_bearing_it_knows_the_place() -> None:
    agent = robot()
    for k in range(1, 20):
        play(agent, k, ends=False)
        report(agent, k, k + 0.1, told(k))
    estimate = agent.estimate()
    assert estimate is not None
    (track,) = estimate.tracks
    assert track.mean[:3] == pytest.approx(TARGET, abs=0.5)
    assert "rounds with r2" in str(agent.status()["form_reason"])


def test_the_round_ends_as_soon_as_all_have_told() -> None:
    agent = robot()
    play(agent, 1, ends=False)
    report(agent, 1, 1.05)
    play(agent, 2, ends=False)
    closed = agent.counters["round.closed"]
    report(agent, 2, 2.05)
    assert agent.counters["round.closed"] == closed + 1


def test_what_comes_late_counts_once_in_the_next_round() -> None:
    agent = robot()
    play(agent, 1)
    report(agent, 1, 1.9)
    play(agent, 2)
    assert agent.counters["round.used_bearings"] == 3
    play(agent, 3)
    assert agent.counters["round.used_bearings"] == 4, "it counts no second time"


def test_a_report_that_is_older_or_of_the_future_is_not_used() -> None:
    agent = robot()
    play(agent, 3)
    report(agent, 3, 3.5)
    report(agent, 2, 3.6)
    assert agent.counters["round.overtaken"] == 1
    report(agent, 30, 3.7)
    assert agent.counters["round.future"] == 1


def test_who_begins_anew_is_heard_from_its_first_report_on() -> None:
    agent = robot()
    agent.handle(LinkChange(0, "r2", True, 1, 7))
    play(agent, 5)
    report(agent, 5, 5.5)
    play(agent, 6)
    used = agent.counters["round.used_bearings"]
    agent.handle(LinkChange(6 * PERIOD_NS, "r2", True, 2, 8))
    report(agent, 4, 6.5)
    play(agent, 7)
    assert agent.counters["round.used_bearings"] == used + 2


def test_a_neighbour_with_a_filter_of_another_kind_is_counted() -> None:
    agent = robot("kcf_plus")
    for k in range(1, 4):
        play(agent, k, ends=False)
        report(agent, k, k + 0.1, told(k))
    assert agent.counters["round.other_kind"] == 3
    assert not agent.counters["update.failed"]


def test_a_neighbour_that_lies_cannot_stop_it() -> None:
    agent = robot()
    for k in range(1, 20):
        play(agent, k, ends=False)
        far = Prediction("t1", np.full(6, 9e5), 1e-9 * np.eye(6))
        report(agent, k, k + 0.1, far)
    assert agent.counters["round.closed"] >= 18


def test_a_track_ends_to_be_told_when_bearings_no_longer_cross() -> None:
    agent = robot()
    for k in range(1, 10):
        play(agent, k, ends=False)
        report(agent, k, k + 0.1, told(k))
    estimate = agent.estimate()
    assert estimate is not None and estimate.tracks
    for k in range(10, 80):
        play(agent, k)
    estimate = agent.estimate()
    assert estimate is not None and not estimate.tracks
