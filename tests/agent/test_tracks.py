"""Tracks come with a sighting or with what a peer tells, and go when nothing is known of their target any more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Alarm, Effect, Send
from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion
from agent.events import Event, Observation, Odometry, Received
from agent.joint_tracks import JointTracks
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings, TrackEnd
from network.messages import Belief, Header, Message, SplitSnapshot, TargetBelief

Array = NDArray[np.float64]

FORMS = ("split_joint", "safe", "published")
PLACES = {"r1": np.array([0.0, 0.0, 0.0]), "r2": np.array([4.0, -3.0, 1.0])}
MOTION = TargetMotion(CONSTANT_VELOCITY, noise_sigma=(0.1, 0.1))
UNSEEN = TargetSettings("t1", MOTION, None, np.diag([0.0, 0.0, 0.04, 0.04]))
R = np.diag([0.04, 0.0009])
Z = np.array([5.0, 0.3])
NOISE = np.diag([1e-4, 1e-4, 0.0, 1e-5])


def agent(robot: str = "r1", form: str = "split_joint", **changes: object) -> Agent:
    found = AgentSettings(
        robot,
        0,
        PLACES[robot],
        np.diag([0.09, 0.09, 0.0004]),
        targets=(UNSEEN,),
        localization=LocalizationSettings(form=form, pair_interval_ns=0),  # type: ignore[arg-type]
        lateness=LatenessSettings(horizon_ns=10 * NS),
    )
    return Agent(replace(found, **changes))  # type: ignore[arg-type]


def still(t_ns: int) -> Odometry:
    return Odometry(t_ns, t_ns - NS, t_ns, np.zeros(4), NOISE)


def sighting(t_ns: int, target: str = "t1", z: Array = Z, now_ns: int | None = None) -> Observation:
    now = t_ns if now_ns is None else now_ns
    if len(z) == 1:
        return Observation(now, t_ns, "range", f"target:{target}", z, R[:1, :1], "uwb")
    return Observation(now, t_ns, "range_bearing", f"target:{target}", z, R, "camera")


def tracks(subject: Agent) -> dict[str, tuple[Array, Array]]:
    estimate = subject.estimate()
    assert estimate is not None
    return {track.target: (track.mean, track.cov) for track in estimate.tracks}


def fed(subject: Agent, *events: Event) -> list[Effect]:
    return [effect for event in events for effect in subject.handle(event)]


@pytest.mark.parametrize("form", FORMS)
def test_a_target_nobody_has_seen_has_no_track_until_it_is_seen(form: str) -> None:
    subject = agent(form=form)
    fed(subject, still(NS))
    assert tracks(subject) == {}
    assert subject.status()["tracks"] == {}
    fed(subject, sighting(NS))
    (mean, cov) = tracks(subject)["t1"]
    assert np.abs(mean - [5.0 * np.cos(0.3), 5.0 * np.sin(0.3), 0.0, 0.0]).max() < 0.02
    # The sighting, the own place and heading, and the velocity that is not seen.
    assert 0.12 < cov[0, 0] < 0.15
    assert np.allclose(cov[2:, 2:], 0.04 * np.eye(2))
    assert subject.counters["track.started"] == 1
    status = subject.status()["tracks"]["t1"]  # type: ignore[index]
    assert status["age_s"] == 0.0
    fed(subject, still(2 * NS), still(3 * NS))
    assert subject.status()["tracks"]["t1"]["age_s"] == 2.0  # type: ignore[index]


@pytest.mark.parametrize("form", FORMS)
def test_a_range_alone_starts_a_track_only_within_a_stated_distance(form: str) -> None:
    without, within = agent(form=form), agent(form=form, track_within_m=8.0)
    for subject in (without, within):
        fed(subject, still(NS), sighting(NS, z=Z[:1]))
    assert tracks(without) == {}
    assert without.counters["track.undetermined"] == 1
    _, cov = tracks(within)["t1"]
    assert cov[0, 0] == pytest.approx(12.5 + 0.09, abs=0.1)
    # What tells the place makes a good track of it.
    fed(within, still(2 * NS), sighting(2 * NS))
    assert tracks(within)["t1"][1][0, 0] < 0.3


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("end", [TrackEnd(after_ns=3 * NS), TrackEnd(above_m=0.85)], ids=["unseen", "unsure"])
def test_a_track_ends_once_nothing_is_known_of_its_target_and_it_is_said(form: str, end: TrackEnd) -> None:
    subject = agent(form=form, track_end=end)
    effects = fed(subject, still(NS), sighting(NS), still(2 * NS), still(3 * NS), still(4 * NS))
    assert set(tracks(subject)) == {"t1"}
    assert not any(isinstance(item, Alarm) for item in effects)
    effects = fed(subject, still(5 * NS))
    assert tracks(subject) == {}
    assert [item for item in effects if isinstance(item, Alarm)] == [Alarm("track_ended", "t1")]
    assert subject.counters["track.ended"] == 1
    # Seen again, it begins anew, as sure as at first.
    fed(subject, sighting(5 * NS))
    assert 0.12 < tracks(subject)["t1"][1][0, 0] < 0.15
    assert subject.counters["track.started"] == 2


@pytest.mark.parametrize("form", FORMS)
def test_several_targets_come_and_go_on_their_own(form: str) -> None:
    other = replace(UNSEEN, id="t2")
    subject = agent(form=form, targets=(UNSEEN, other), track_end=TrackEnd(after_ns=2 * NS))
    fed(subject, still(NS), sighting(NS, "t2"), still(2 * NS), sighting(2 * NS), sighting(2 * NS, "t3"))
    assert set(tracks(subject)) == {"t1", "t2"}
    assert subject.counters["observation.unknown_target"] == 1
    fed(subject, still(3 * NS), still(4 * NS))
    assert set(tracks(subject)) == {"t1"}
    assert np.abs(tracks(subject)["t1"][0][:2] - [4.78, 1.48]).max() < 0.05


@pytest.mark.parametrize("form", FORMS)
def test_a_sighting_that_comes_late_starts_the_track_where_it_would_be_by_now(form: str) -> None:
    timely, late = agent(form=form), agent(form=form)
    fed(timely, still(NS), sighting(NS), still(2 * NS), still(3 * NS))
    fed(late, still(NS), still(2 * NS), still(3 * NS), sighting(NS, now_ns=3 * NS))
    for one, other in zip(tracks(timely)["t1"], tracks(late)["t1"]):
        np.testing.assert_allclose(one, other, atol=1e-9)


class Pair:
    """Two agents whose messages arrive at once."""

    def __init__(self, form: str, **changes: object) -> None:
        self.agents = {name: agent(name, form, **changes) for name in PLACES}
        self._seq = 0

    def handle(self, robot: str, event: Event) -> None:
        for item in self.agents[robot].handle(event):
            if isinstance(item, Send):
                self._seq += 1
                message = Message(Header(robot, 1, 1, self._seq, item.t_meas_ns, event.t_ns), item.body)
                self.handle(item.peer, Received(event.t_ns, message))

    def still(self, k: int) -> None:
        for robot in self.agents:
            self.handle(robot, still(k * NS))

    def meet(self, k: int) -> None:
        self.handle("r1", Observation(k * NS, k * NS, "range", "r2", np.array([5.0]), np.array([[0.01]]), "uwb"))


@pytest.mark.parametrize("form", FORMS)
def test_a_peer_hands_on_what_it_has_seen_and_how_long_ago(form: str) -> None:
    pair = Pair(form, track_end=TrackEnd(after_ns=4 * NS))
    pair.still(1)
    pair.handle("r1", sighting(NS))
    for k in (2, 3):
        pair.still(k)
    before = pair.agents["r2"].estimate()
    pair.meet(3)
    mine, theirs = tracks(pair.agents["r1"])["t1"], tracks(pair.agents["r2"])["t1"]
    assert before is not None and before.tracks == ()
    assert np.abs(theirs[0] - mine[0]).max() < 0.3
    assert pair.agents["r2"].counters["track.started"] == 1
    status = pair.agents["r2"].status()["tracks"]["t1"]  # type: ignore[index]
    assert status["age_s"] == 2.0
    # To tell and hear it again and again makes it no younger.
    for k in (4, 5):
        pair.still(k)
        pair.meet(k)
    assert all("t1" in tracks(subject) for subject in pair.agents.values())
    pair.still(6)
    pair.meet(6)
    assert all(tracks(subject) == {} for subject in pair.agents.values())


@pytest.mark.parametrize("form", FORMS)
def test_what_is_told_of_a_target_leaves_the_own_pose_alone(form: str) -> None:
    """The told track's error is correlated with the own one in ways nobody knows."""
    told, alone = Pair(form), Pair(form)
    for pair in (told, alone):
        pair.still(1)
    told.handle("r1", sighting(NS))
    for pair in (told, alone):
        pair.meet(1)
    one, other = (pair.agents["r2"].estimate() for pair in (told, alone))
    assert one is not None and other is not None
    if form == "split_joint":
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-3)
        assert np.trace(one.cov) > 0.99 * np.trace(other.cov)
    assert len(one.tracks) == 1
    if form == "split_joint":
        # An own sighting makes it a part of the joint belief, inflated first.
        told.handle("r2", sighting(NS, z=np.array([6.0, 0.0])))
        state = told.agents["r2"].filter.state  # type: ignore[attr-defined]
        assert state.tracks == ("t1",) and not state.relayed


# -- tracks beside the joint belief --------------------------------------------------------------------------------


def test_what_began_with_a_range_alone_never_moves_the_own_pose() -> None:
    """A Gaussian may settle on a wrong side of the circle, however sure it becomes."""
    seeing, blind = agent(track_within_m=8.0), agent(track_within_m=8.0)
    for k in range(1, 12):
        moved = Odometry(k * NS, (k - 1) * NS, k * NS, np.array([0.4, 0.0, 0.0, 0.2]), NOISE)
        for subject in (seeing, blind):
            fed(subject, moved)
        fed(seeing, sighting(k * NS, z=Z[:1]))
    one, other = seeing.estimate(), blind.estimate()
    assert one is not None and other is not None
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.cov, other.cov)
    assert seeing.filter.state.tracks == () and set(tracks(seeing)) == {"t1"}  # type: ignore[attr-defined]
    # The place told by one sighting makes it a part of the belief.
    fed(seeing, sighting(11 * NS))
    assert seeing.filter.state.tracks == ("t1",)  # type: ignore[attr-defined]


def told(cov: float, age_ns: int, joint: bool, x: float = 5.0) -> SplitSnapshot:
    """A peer that has a track in its joint belief, or beside it."""
    mean, track = np.array([4.0, -3.0, 1.0]), np.array([x, 1.5, 0.0, 0.0])
    if joint:
        both = np.diag([0.1, 0.1, 0.01, cov, cov, 0.04, 0.04])
        targets = (("t1", "constant_velocity"),)
        return SplitSnapshot("unicycle", targets, np.concatenate([mean, track]), both, None, (age_ns,))
    belief = Belief("constant_velocity", track, np.diag([cov, cov, 0.04, 0.04]))
    return SplitSnapshot("unicycle", (), mean, 0.1 * np.eye(3), None, (), (TargetBelief("t1", belief, age_ns),))


def test_what_may_be_on_a_wrong_side_is_not_mixed_with_what_is_not() -> None:
    subject = JointTracks(agent().settings)
    empty = subject.initial()
    loose, firm = (subject.heard(empty, told(1.0, 0, joint)) for joint in (False, True))
    assert [state.relayed["t1"].firm for state in (loose, firm)] == [False, True]
    for before in (loose, firm):
        # The firm one counts whichever comes first, unless it is much worse.
        after = subject.heard(before, told(2.0, 0, before is loose, 9.0)).relayed["t1"]
        assert after.firm and after.mean[0] == (9.0 if before is loose else 5.0)
    worse = subject.heard(loose, told(5.0, 0, True, 9.0)).relayed["t1"]
    assert not worse.firm and worse.mean[0] == 5.0
    better = subject.heard(firm, told(0.2, 0, False, 9.0)).relayed["t1"]
    assert not better.firm and better.mean[0] == 9.0
    # Of one kind they are fused.
    both = subject.heard(firm, told(1.0, 0, True, 6.0)).relayed["t1"]
    assert both.firm and 5.0 < both.mean[0] < 6.0


def test_only_a_newer_and_much_better_track_replaces_one_of_the_joint_belief() -> None:
    """What is told of a joint belief is used for the own one; only what is told besides may replace it."""
    subject = agent()
    fed(subject, still(NS), sighting(NS), *(still(k * NS) for k in range(2, 8)))
    state, rules = subject.filter.state, JointTracks(subject.settings)  # type: ignore[attr-defined]
    assert state.cov[3, 3] > 1.0
    assert rules.heard(state, told(0.1, 7 * NS, False)).tracks == ("t1",)
    assert rules.heard(state, told(0.9, 0, False)).tracks == ("t1",)
    assert rules.heard(state, told(0.1, 0, True)).tracks == ("t1",)
    taken = rules.heard(state, told(0.1, 0, False))
    assert taken.tracks == () and taken.relayed["t1"].cov[0, 0] == 0.1
