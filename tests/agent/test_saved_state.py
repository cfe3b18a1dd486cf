"""Going on with what was kept: it is the same robot bit for bit, and rubbish is refused."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Effect, Persist
from agent.events import Event, Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.recording import pack
from agent.saved_state import FORMAT, begun_again, decode
from agent.settings import NS, AgentSettings, LocalizationSettings
from agent.state_fields import StateError
from agent.state_file import Found
from agent.state_keeper import start, succeed
from network.messages import Header, Message, SplitRequest
from tests.agent.team_story import DELTA, NOISE, PLACES, TARGET, Team, settings

FACTORS = ("safe", "published", "joint")
FORMS = (*FACTORS, "split_joint", "auto")


class TwinTeam(Team):
    """A team that hears of each other's starts, one of whose robots may have a twin that is given the same events."""

    def __init__(self, form: str) -> None:
        localization = LocalizationSettings(form=form, pair_interval_ns=0)  # type: ignore[arg-type]
        made = {
            name: settings(name, np.array(place), np.diag([0.3, 0.2, 0.02]), TARGET, localization)
            for name, place in PLACES.items()
        }
        super().__init__({name: Agent(one) for name, one in made.items()})
        self.settings = made
        self.twins: dict[str, Agent] = {}
        self.compared = 0
        for name in made:
            for other in made:
                if other != name:
                    self.handle(name, LinkChange(0, other, True, 1, 1))

    def handle(self, robot: str, event: Event) -> None:
        self.now_ns = max(self.now_ns, event.t_ns)
        effects = self.agents[robot].handle(event)
        twin = self.twins.get(robot)
        if twin is not None:
            assert told(twin.handle(event)) == told(effects), f"{robot} at {self.now_ns * 1e-9} s"
            self.compared += 1
        self._post(robot, effects)

    def second(self, rng: np.random.Generator) -> None:
        """Everybody drives, sees the target, somebody a peer, and somebody where it is."""
        now, names = self.now_ns, list(self.agents)
        for name in names:
            self.handle(name, Odometry(now + NS, now, now + NS, DELTA, NOISE))
        now += NS
        for name in names:
            z = np.array([rng.normal(), rng.normal()]) + 2.0
            self.handle(name, Observation(now, now, "vector", "target:t1", z, np.eye(2) * 0.3, "camera"))
        first, second = rng.permutation(names)[:2]
        self.handle(first, Observation(now, now, "vector", second, rng.normal(size=2) + 3.0, np.eye(2) * 9.0, "camera"))
        self.converse()
        self.handle(first, Fix(now, now, "position", rng.normal(size=2), np.eye(2), "gps"))


def told(effects: list[Effect]) -> list[bytes]:
    return [effect.payload if isinstance(effect, Persist) else pack(effect) for effect in effects]


def driven(form: str, seed: int = 4, seconds: int = 6) -> tuple[TwinTeam, np.random.Generator]:
    team, rng = TwinTeam(form), np.random.default_rng(seed)
    for _ in range(seconds):
        team.second(rng)
    return team, rng


def payload_of(agent: Agent) -> bytes:
    found = agent.saved()
    assert found is not None
    return found


@pytest.mark.parametrize("form", FACTORS)
@pytest.mark.parametrize("robot", PLACES)
def test_with_factors_it_does_the_same_for_twenty_seconds_bit_for_bit(form: str, robot: str) -> None:
    team, rng = driven(form)
    payload = payload_of(team.agents[robot])
    # The settings of another start: what they say of the beginning is over.
    base = replace(team.settings[robot], start_ns=team.now_ns + NS, mean=np.ones(3))
    twin = team.twins[robot] = Agent(base, payload)
    # When the next state is due is not kept.
    twin._persistence.due_ns = team.agents[robot]._persistence.due_ns
    twin._persistence.revision = twin.filter.revision
    twin._published, twin._tracks = twin.filter.revision, team.agents[robot]._tracks
    assert twin.saved() == payload
    assert twin.filter.contacts() == team.agents[robot].filter.contacts() != {}
    assert twin.health.saved() == team.agents[robot].health.saved() != {}
    for _ in range(20):
        team.second(rng)
    assert team.compared > 60


@pytest.mark.parametrize("form", ["split_joint", "auto"])
def test_without_factors_the_belief_is_the_same_and_all_of_it_is_shared(form: str) -> None:
    team, rng = driven(form)
    for robot, agent in team.agents.items():
        twin = Agent(team.settings[robot], payload_of(agent))
        before, now = agent.estimate(), twin.estimate()
        assert before is not None and now is not None and now.t_ns == before.t_ns
        np.testing.assert_array_equal(now.mean, before.mean)
        np.testing.assert_array_equal(now.cov, before.cov)
        for mine, track in zip(now.tracks, before.tracks, strict=True):
            assert mine.target == track.target
            np.testing.assert_array_equal(mine.cov, track.cov)
        state = getattr(twin.filter, "active", twin.filter).state
        assert not state.split.private.any()
        assert twin.status()["form"] == "split_joint"
        if form == "auto":
            assert twin.status()["form_reason"] == "started from saved state"
        # From then on it does the same as itself, saved and begun with once more.
        team.agents[robot] = twin
        team.twins[robot] = Agent(team.settings[robot], payload_of(twin))
    for _ in range(20):
        team.second(rng)
    assert team.compared > 180


@pytest.mark.parametrize("apart_ns", [0, -5 * NS // 1000, 5 * NS // 1000])
def test_what_a_peer_asked_before_is_not_used_again_without_factors(apart_ns: int) -> None:
    """Its private noise of then is in the belief that was kept, however far apart the clocks are taken to be now."""
    team, _ = driven("split_joint")
    now = team.now_ns
    team.handle("r1", Observation(now, now, "vector", "r2", np.array([4.0, 2.0]), np.eye(2) * 0.2, "camera"))
    ((_, request),) = team.letters
    team.converse()
    own = team.settings["r2"]
    unsure = replace(own, lateness=replace(own.lateness, clock_sigma_ns=NS // 100))
    twin = Agent(unsure, payload_of(team.agents["r2"]))
    twin.handle(Odometry(now + NS, now, now + NS, DELTA, NOISE))
    twin.handle(Tick(now + NS))
    before = twin.filter.revision
    again = Message(Header("r1", 1, 1, 99, now, now), request.body)
    twin.handle(Received(now + NS, again, offset_ns=apart_ns, offset_sigma_ns=1000))
    assert twin.filter.revision is before and twin.counters["pair.too_old"] == 1
    assert not twin.counters["pair.applied_responder"]
    # A later one is, whatever its number.
    z = np.array([4.0, 2.0])
    for name in ("r1", "r2"):
        team.handle(name, Odometry(now + NS, now, now + NS, DELTA, NOISE))
    team.handle("r1", Observation(now + NS, now + NS, "vector", "r2", z, np.eye(2) * 0.2, "camera"))
    ((_, later),) = team.letters
    assert isinstance(later.body, SplitRequest)
    anew = replace(later.body, epoch=replace(later.body.epoch, counter=1))
    twin.handle(Received(now + NS, Message(Header("r1", 1, 1, 100, now, now), anew)))
    assert twin.counters["pair.applied_responder"] == 1


def test_a_robot_that_waits_for_its_start_keeps_nothing() -> None:
    waiting = Agent(replace(settings("r1", np.zeros(3), np.eye(3), TARGET), source="fix"))
    assert waiting.saved() is None
    effects = waiting.handle(LinkChange(5 * NS, "r2", True, 1, 1))
    assert not [effect for effect in effects if isinstance(effect, Persist)]


def test_a_state_is_kept_once_a_second_at_most() -> None:
    agent = Agent(settings("r1", np.zeros(3), np.eye(3), TARGET))
    kept = []
    for k in range(40):
        event = Odometry((k + 1) * NS // 10, k * NS // 10, (k + 1) * NS // 10, DELTA, NOISE)
        kept += [agent.now_ns for effect in agent.handle(event) if isinstance(effect, Persist)]
    assert len(kept) == 4 and min(np.diff(kept)) >= NS


# -- rubbish --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_rubbish_is_refused_with_a_reason_or_is_a_state(form: str) -> None:
    """Cut anywhere, and with bytes changed: never another exception, and what is taken can be worked with."""
    team, _ = driven(form, seconds=3)
    base, payload = team.settings["r2"], payload_of(team.agents["r2"])
    for length in range(0, len(payload), 7):
        with pytest.raises(StateError):
            decode(payload[:length], base)
    rng = random.Random(5)
    refused = 0
    for _ in range(1500):
        bad = bytearray(payload)
        for _ in range(rng.choice((1, 1, 3))):
            bad[rng.randrange(len(bad))] = rng.randrange(256)
        try:
            agent = Agent(base, bytes(bad))
        except StateError:
            refused += 1
            continue
        agent.handle(Odometry(agent.now_ns + NS, agent.now_ns, agent.now_ns + NS, DELTA, NOISE))
    assert refused > 100


def changed(payload: bytes, index: int, value: Any) -> bytes:
    raw = list(msgpack.unpackb(payload))
    raw[index] = value
    packed: bytes = msgpack.packb(raw)
    return packed


@pytest.mark.parametrize(
    ("index", "value", "reason"),
    [
        (0, FORMAT + 1, "other_version"),
        (0, "1", "malformed"),
        (1, "r9", "other_robot"),
        (2, "published", "other_form"),
        (3, "spatial", "other_model"),
        (5, True, "wrong_type"),
        (5, -5, "inconsistent"),
        (5, 2**64 - 1, "out_of_range"),
        (6, np.full(3, np.nan).tobytes(), "non_finite"),
        (6, np.zeros(4).tobytes(), "malformed"),
        (7, (-np.eye(3)).tobytes(), "not_positive_definite"),
        (7, np.triu(np.full((3, 3), 0.1) + np.eye(3)).tobytes(), "not_positive_definite"),
        (8, [], "malformed"),
    ],
)
def test_each_part_is_checked(index: int, value: Any, reason: str) -> None:
    team, _ = driven("safe", seconds=2)
    with pytest.raises(StateError) as refused:
        decode(changed(payload_of(team.agents["r1"]), index, value), team.settings["r1"])
    assert refused.value.reason == reason


def test_records_and_blocks_of_factors_must_agree() -> None:
    team, _ = driven("safe")
    payload = payload_of(team.agents["r1"])
    raw = msgpack.unpackb(payload)
    raw[8][2] = raw[8][2][1:]
    with pytest.raises(StateError) as refused:
        decode(msgpack.packb(raw), team.settings["r1"])
    assert refused.value.reason == "inconsistent"


# -- how a start begins ---------------------------------------------------------------------------------------


def found(form: str = "safe") -> tuple[Found, AgentSettings, int]:
    team, _ = driven(form)
    agent = team.agents["r1"]
    return Found(7, payload_of(agent)), team.settings["r1"], agent.filter.t_ns


def test_a_usable_state_goes_on_in_the_same_life() -> None:
    file, base, t_ns = found()
    begin, reason = start(file, base, t_ns + 5 * NS, 600 * NS, None, 10**18)
    assert (begin.incarnation, begin.state, reason) == (7, file.state, None)
    assert begin.settings is base


@pytest.mark.parametrize(
    ("after_s", "run_s", "reason"), [(601, None, "too_old"), (-1, None, "from_future"), (5, 7, "earlier_run")]
)
def test_a_state_of_another_time_is_refused_and_a_new_life_begins(
    after_s: int, run_s: int | None, reason: str
) -> None:
    file, base, t_ns = found()
    run_ns = None if run_s is None else run_s * NS
    begin, why = start(file, base, t_ns + after_s * NS, 600 * NS, run_ns, 10**18)
    assert (begin.incarnation, begin.state, why) == (8, None, reason)


def test_a_new_life_of_the_field_begins_with_its_survey_and_one_of_a_run_with_what_peers_may_know() -> None:
    _, base, t_ns = found()
    fresh, _ = start(Found(), base, t_ns, 600 * NS, None, 10**18)
    assert (fresh.incarnation, fresh.again, fresh.settings) == (10**9, False, base)
    on_time, _ = start(Found(), base, base.start_ns, 600 * NS, base.start_ns, 10**18, first=1)
    assert (on_time.incarnation, on_time.again) == (1, False)
    late, _ = start(Found(), base, base.start_ns + 100 * NS, 600 * NS, base.start_ns, 10**18, first=1)
    assert late.again and late.incarnation > 1
    np.testing.assert_array_equal(late.settings.cov, 2.0 * base.cov)
    assert late.settings.start_ns == base.start_ns, "it coasts from the survey's instant"


def test_a_late_start_of_a_run_does_not_pretend_to_be_at_its_start_still() -> None:
    _, base, _ = found()
    agent = Agent(begun_again(base))
    before = agent.estimate()
    agent.handle(Odometry(101 * NS, 100 * NS, 101 * NS, DELTA, NOISE))
    now = agent.estimate()
    assert before is not None and now is not None and now.t_ns == 101 * NS
    assert now.cov[0, 0] > (base.coast.speed_mps * 100.0) ** 2 > 100.0 * before.cov[0, 0]


@pytest.mark.parametrize("form", ["split_joint", "auto"])
def test_without_factors_a_survey_that_peers_may_know_of_is_shared(form: str) -> None:
    base = settings("r1", np.zeros(3), np.eye(3), TARGET, LocalizationSettings(form=form))  # type: ignore[arg-type]
    agent = Agent(begun_again(base))
    state = getattr(agent.filter, "active", agent.filter).state
    assert not state.split.private.any()
    assert agent.status()["form"] == "split_joint"


@pytest.mark.parametrize("form", FORMS)
def test_a_life_that_follows_in_the_same_process_keeps_no_correlation(form: str) -> None:
    """Factors: twice the covariance, and no pair; without: all of it shared; form `joint`: the survey."""
    team, rng = driven(form)
    agent = team.agents["r1"]
    before, begin = agent.estimate(), succeed(team.settings["r1"], agent.saved(), 9)
    assert before is not None and begin.incarnation == 9
    after = Agent(begin.settings, begin.state)
    now = after.estimate()
    assert now is not None
    if form == "joint":
        assert begin.state is None and begin.again
        np.testing.assert_array_equal(now.cov, 2.0 * team.settings["r1"].cov)
    elif form in FACTORS:
        assert after.filter.contacts() == {}
        assert agent.filter.contacts() != {}
        np.testing.assert_array_equal(now.mean, before.mean)
        np.testing.assert_allclose(now.cov, 2.0 * before.cov)
    else:
        assert not getattr(after.filter, "active", after.filter).state.split.private.any()
        np.testing.assert_array_equal(now.cov, before.cov)
    # Its peers see the new life, and all go on.
    team.agents["r1"] = after
    for other in team.agents:
        if other != "r1":
            team.handle("r1", LinkChange(team.now_ns, other, True, 1, 1))
            team.handle(other, LinkChange(team.now_ns, "r1", True, 9, 2))
    for _ in range(6):
        team.second(rng)
    assert any(after.filter.contacts().values())


def test_who_has_no_state_follows_with_its_first_start() -> None:
    own = found()[1]
    begin = succeed(own, None, 5)
    assert (begin.state, begin.again, begin.incarnation) == (None, True, 5)
    np.testing.assert_array_equal(begin.settings.cov, begun_again(own).cov)


def test_states_are_of_a_size_that_a_small_disk_takes() -> None:
    team, _ = driven("joint", seconds=20)
    sizes = {name: len(payload_of(agent)) for name, agent in team.agents.items()}
    assert max(sizes.values()) < 64_000, json.dumps(sizes)
