"""Robots that keep no factors: what they claim covers their true errors, whatever happens to their messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Send
from agent.events import Fix, LinkChange, Observation, Odometry, Tick
from agent.settings import NS, LatenessSettings, LocalizationSettings, TargetSettings
from network.messages import MAX_MESSAGE_BYTES, Header, PairReply, ReplyStatus, SplitReply, SplitRequest
from network.wire import encode
from tests.agent.team_story import (
    DELTA,
    LOCALIZATION,
    MOTION,
    NOISE,
    PLACES,
    TARGET,
    TARGET_COV,
    R,
    Team,
    settings,
    unclaimed,
)
from tests.sizes import sized

Array = NDArray[np.float64]


@pytest.mark.parametrize("seed", range(1, sized(2, 4) + 1))
def test_the_claimed_covariance_covers_the_true_one_in_any_interleaving(seed: int) -> None:
    team, slack = unclaimed(seed)
    applied = 0
    for robot in PLACES:
        counters = team.agents[robot].counters
        applied += counters["pair.applied_initiator"] + counters["pair.applied_responder"]
        assert slack[robot] > -1e-9, f"{robot} is overconfident (seed {seed})"
    assert applied >= 4


def pair(cov: float = 0.5) -> Team:
    eye = np.diag([cov, cov, 0.01])
    return Team({name: Agent(settings(name, np.array(PLACES[name]), eye, TARGET)) for name in ("r1", "r2")})


def sees(team: Team, t_ns: int = 0) -> None:
    """r1 sees r2 at `t_ns`, near where both believe to be."""
    z, noise = np.array([0.3]), np.eye(1) * 0.01
    team.handle("r1", Observation(max(team.now_ns, t_ns), t_ns, "bearing", "r2", z, noise, "camera"))


def test_a_contact_helps_both_once_however_often_its_messages_come() -> None:
    team = pair()
    before = team.filter("r2").state.cov
    sees(team)
    request = team.letters[0]
    for _ in range(3):
        team.deliver(request)
    replies = team.letters[1:]
    assert len(replies) == 3
    for reply in replies:
        team.deliver(reply)
    assert team.agents["r1"].counters["pair.applied_initiator"] == 1
    assert team.agents["r1"].counters["pair.reply_ignore"] == 2
    assert team.agents["r2"].counters["pair.applied_responder"] == 1
    assert team.agents["r2"].counters["pair.request_repeat_reply"] == 2
    assert np.trace(team.filter("r2").state.cov) < np.trace(before)


def test_losing_a_message_changes_its_receiver_only() -> None:
    whole, lossy = pair(), pair()
    for team in (whole, lossy):
        sees(team)
        team.deliver(team.letters.pop(0))
    whole.converse()
    lossy.letters.clear()
    assert np.array_equal(whole.filter("r2").state.cov, lossy.filter("r2").state.cov)
    assert np.trace(whole.filter("r1").state.cov) < np.trace(lossy.filter("r1").state.cov)


def test_what_was_told_is_private_no_more() -> None:
    team = pair()
    assert team.filter("r1").state.split.private.any()
    sees(team)
    first = team.letters[0][1].body
    assert isinstance(first, SplitRequest)
    assert first.snapshot.private is not None
    assert not team.filter("r1").state.split.private.any()
    sees(team)
    second = team.letters[1][1].body
    assert isinstance(second, SplitRequest)
    assert second.snapshot.private is None


def test_a_request_is_repeated_until_it_is_answered_or_too_old() -> None:
    quick = replace(LOCALIZATION, pair_timeout_ns=NS)
    agent = Agent(
        replace(
            settings("r1", np.array(PLACES["r1"]), np.eye(3), None),
            localization=quick,
            lateness=LatenessSettings(horizon_ns=5 * NS),
        )
    )
    team = Team({"r1": agent})
    sees(team)
    for second in range(1, 10):
        team.handle("r1", Tick(second * NS))
    assert len({item.body.epoch for _, item in team.letters}) == 1  # type: ignore[union-attr]
    assert len(team.letters) == 5
    assert agent.counters["pair.repeated"] == 4
    assert agent.counters["pair.timed_out"] == 1
    assert team.filter("r1").deadline_ns() > 10**6 * NS


def test_a_new_life_of_a_peer_ends_what_was_under_way() -> None:
    team = pair()
    sees(team)
    for life in (1, 2):
        team.handle("r1", LinkChange(0, "r2", True, life, life))
    team.converse()
    assert team.agents["r1"].counters["pair.restarts"] == 1
    assert team.agents["r1"].counters["pair.applied_initiator"] == 0
    assert team.agents["r2"].counters["pair.applied_responder"] == 1


def test_other_forms_are_refused_and_counted() -> None:
    team = pair()
    sees(team)
    ((_, item),) = team.letters
    assert isinstance(item.body, SplitRequest)
    reply = PairReply(item.body.epoch, ReplyStatus.BUSY)
    team.deliver(("r2", Send("r1", 0, reply)))
    assert team.agents["r1"].counters["pair.other_form"] == 1
    base = settings("r3", np.array(PLACES["r3"]), np.eye(3), None)
    plain = Agent(replace(base, localization=LocalizationSettings(form="safe")))
    stranger = Team({"r3": plain})
    stranger.deliver(("r1", Send("r3", 0, item.body)))
    stranger.deliver(("r1", Send("r3", 0, SplitReply(item.body.epoch, item.body.snapshot))))
    assert plain.counters["pair.other_form"] == 2


def test_an_instant_out_of_the_history_is_not_answered() -> None:
    team = pair()
    for name in ("r1", "r2"):
        step = Odometry(100 * NS, 0, 100 * NS, np.zeros(4), np.eye(4) * 1e-6)
        team.handle(name, step)
    sees(team, t_ns=0)
    assert team.agents["r1"].counters["pair.too_old_own"] == 1


@pytest.mark.parametrize("tracks", [0, 1, 3, 8])
def test_every_message_fits(tracks: int) -> None:
    """As many targets travel as fit into a message; the rest is counted."""
    targets = tuple(TargetSettings(f"target-{i}", MOTION, TARGET, TARGET_COV) for i in range(tracks))
    base = settings("r1", np.array(PLACES["r1"]), np.eye(3), None)
    agent = Agent(replace(base, targets=targets))
    team = Team({"r1": agent})
    sees(team)
    ((_, item),) = team.letters
    assert isinstance(item.body, SplitRequest)
    assert len(encode(Header("r1", 1, 1, 1, 0, 0), item.body)) <= MAX_MESSAGE_BYTES
    assert len(item.body.snapshot.targets) + agent.counters["pair.shortened"] == tracks
    assert len(item.body.snapshot.targets) >= min(tracks, 1)


def test_late_own_data_give_what_they_would_have_given_in_time() -> None:
    def run(late: bool) -> Array:
        team = pair()
        fix = Fix(NS, NS, "position", np.array([0.5, 0.2]), R, "gps")
        for second in (1, 2, 3):
            step = Odometry(second * NS, (second - 1) * NS, second * NS, DELTA, NOISE)
            team.handle("r1", step)
            if second == 1 and not late:
                team.handle("r1", fix)
            if second == 2:
                sighting = Observation(2 * NS, 2 * NS, "vector", "target:t1", np.array([1.0, 2.0]), R)
                team.handle("r1", sighting)
        if late:
            team.handle("r1", replace(fix, t_ns=3 * NS))
        state = team.filter("r1").state
        return np.concatenate([state.mean, state.cov.ravel()])

    assert np.abs(run(True) - run(False)).max() < 1e-12
