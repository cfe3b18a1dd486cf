"""A team whose robots all keep the joint belief: equal data make equal beliefs, in any order, however often heard."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Broadcast, Effect, Estimate, Publish
from agent.estimation.centralized import CentralizedFilter
from agent.estimation.motion import CONSTANT_VELOCITY, PLANAR_MOTION, TargetMotion, compose
from agent.events import Event, Fix, Observation, Odometry, Received, Tick
from agent.replica_filter import ReplicaFilter
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings, TeamMember
from agent.team_history import MAX_INSTANTS, MAX_WAITING
from network.messages import (
    Channel,
    Epoch,
    Header,
    Message,
    PairReply,
    RawMeasurement,
    Reckoning,
    ReplyStatus,
    TeamReport,
)
from network.wire import decode, encode
from tests.sizes import sized

Array = NDArray[np.float64]

NAMES = ("r1", "r2", "r3")
STARTS = {"r1": [0.0, 0.0, 0.3], "r2": [5.0, 3.0, -1.0], "r3": [-2.0, 6.0, 2.0]}
COVS = {"r1": np.diag([0.2, 0.3, 0.01]), "r2": np.diag([0.4, 0.2, 0.02]), "r3": np.diag([0.3, 0.5, 0.02])}
MOTION = TargetMotion(CONSTANT_VELOCITY, noise_sigma=(0.2, 0.2))
TARGET = np.array([2.0, 2.0, 0.3, -0.2]), np.diag([0.5, 0.4, 0.05, 0.05])
NOISE = np.diag([0.01, 0.004, 0.0, 0.002])
R = np.diag([0.05, 0.01])
LANDMARKS = {"gate": (3.0, -4.0)}
STEPS = 6
HORIZON_NS = 60 * NS


def settings_of(name: str, **change: object) -> AgentSettings:
    made = AgentSettings(
        name,
        0,
        np.array(STARTS[name]),
        COVS[name],
        targets=(TargetSettings("t1", MOTION, *TARGET),),
        landmarks=LANDMARKS,
        localization=LocalizationSettings(kind="replica", innovation_cap=0.0),
        lateness=LatenessSettings(horizon_ns=HORIZON_NS),
        team=tuple(
            TeamMember(other, PLANAR_MOTION, np.array(STARTS[other]), COVS[other]) for other in NAMES if other != name
        ),
    )
    return replace(made, **change)  # type: ignore[arg-type]


class Team:
    """Agents with a world: what they say is kept, and handed over when a test says so."""

    def __init__(self, names: tuple[str, ...] = NAMES, seed: int = 1, **change: object) -> None:
        self.agents = {name: Agent(settings_of(name, **change)) for name in names}
        self.said: list[Message] = []
        self.events: dict[str, list[Event]] = {name: [] for name in names}
        self.rng = np.random.default_rng(seed)
        self.truth = {name: np.array(start) for name, start in STARTS.items()}
        self.lives = dict.fromkeys(NAMES, (1, 11))
        self._seq: Counter[str] = Counter()

    def handle(self, name: str, event: Event) -> list[Effect]:
        effects = self.agents[name].handle(event)
        if not isinstance(event, Received):
            self.events[name].append(event)
        for effect in effects:
            if isinstance(effect, Broadcast):
                assert effect.channel == Channel.BELIEF
                self._seq[name] += 1
                incarnation, boot_id = self.lives[name]
                header = Header(name, boot_id, incarnation, self._seq[name], effect.t_meas_ns, event.t_ns)
                self.said.append(decode(encode(header, effect.body), name))
        return effects

    def hear(self, name: str, message: Message, t_ns: int) -> None:
        if message.header.source != name:
            self.handle(name, Received(t_ns, message))

    def step(self, k: int, silent: tuple[str, ...] = ()) -> None:
        """All move, see each other and the target, and tell; nobody hears it yet."""
        t_ns = k * NS
        deltas = {name: self.rng.normal([0.5, 0.0, 0.0, 0.2], [0.1, 0.0, 0.0, 0.05]) for name in NAMES}
        for name in NAMES:
            self.truth[name] = compose(self.truth[name], deltas[name][[0, 1, 3]])
        for name in self.agents:
            if name in silent:
                continue
            self.handle(name, Odometry(t_ns, t_ns - NS, t_ns, deltas[name], NOISE))
            if name == "r1":
                z = self.truth[name][:2] + self.rng.normal(0.0, 0.3, 2)
                self.handle(name, Fix(t_ns, t_ns, "position", z, np.eye(2) * 0.09, "gps"))
            self.see(name, "landmark:gate", t_ns, np.array(LANDMARKS["gate"]))
            self.see(name, "target:t1", t_ns, TARGET[0][:2] + TARGET[0][2:] * k)
            self.see(name, NAMES[(NAMES.index(name) + 1) % 3], t_ns)
        for name in self.agents:
            if name not in silent:
                self.handle(name, Tick(t_ns))

    def see(self, name: str, of: str, t_ns: int, place: Array | None = None) -> None:
        gap = (self.truth[of][:2] if place is None else place) - self.truth[name][:2]
        z = np.array([np.hypot(*gap), np.arctan2(gap[1], gap[0]) - self.truth[name][2]])
        z += np.sqrt(np.diagonal(R)) * self.rng.standard_normal(2)
        z[1] = (z[1] + np.pi) % (2.0 * np.pi) - np.pi
        self.handle(name, Observation(t_ns, t_ns, "range_bearing", of, z, R, "eye"))

    def exchange(self, t_ns: int) -> None:
        """All that was said is heard by everybody, in order."""
        for message in self.said:
            for name in self.agents:
                self.hear(name, message, t_ns)
        self.said.clear()


def equal(a: Estimate, b: Estimate) -> bool:
    """Bit for bit."""
    tracks = zip(a.tracks, b.tracks, strict=True)
    return (
        a.t_ns == b.t_ns
        and np.array_equal(a.mean, b.mean)
        and np.array_equal(a.cov, b.cov)
        and all(np.array_equal(one.mean, two.mean) and np.array_equal(one.cov, two.cov) for one, two in tracks)
    )


def played(steps: int = STEPS) -> Team:
    """A team that has moved for a while without a word heard."""
    team = Team()
    for k in range(1, steps + 1):
        team.step(k)
    return team


# --- the belief -------------------------------------------------------------------------------------------


def test_with_all_data_it_is_the_centralized_filter() -> None:
    team = Team()
    joint = CentralizedFilter(
        {name: (np.array(STARTS[name]), COVS[name], PLANAR_MOTION) for name in NAMES},
        {"t1": (*TARGET, MOTION)},
        LANDMARKS,
    )
    for k in range(1, 2 * STEPS):
        team.step(k)
        team.exchange(k * NS)
        waiting = {n: e for n in NAMES for e in team.events[n] if isinstance(e, Odometry) and e.t_ns == k * NS}
        drifted = False
        seen = [(n, e) for n in NAMES for e in team.events[n] if isinstance(e, Fix | Observation) and e.t_ns == k * NS]

        def phase(item: tuple[str, Fix | Observation]) -> tuple[int, str]:
            of = item[1].of or "" if isinstance(item[1], Observation) else ""
            return (0 if not of or "landmark" in of else 1 if "target" in of else 2), item[0]

        for name, event in sorted(seen, key=phase):
            of = event.of or "" if isinstance(event, Observation) else ""
            for involved in (name, of):
                if involved in waiting:
                    moved = waiting.pop(involved)
                    joint.odometry(involved, moved.delta, moved.cov, 1.0)
            if "target" in of and not drifted:
                joint.drift_targets(1.0)
                drifted = True
            if isinstance(event, Fix):
                joint.fix(name, event.kind, event.z, event.R)
            else:
                assert event.of is not None
                joint.observe(name, event.kind, event.of, event.z, event.R)
        for name, agent in team.agents.items():
            estimate = agent.estimate()
            mean, cov = joint.belief(name)
            np.testing.assert_allclose(estimate.mean, mean, atol=1e-11)
            np.testing.assert_allclose(estimate.cov, cov, atol=1e-12)
            mean, cov = joint.belief("t1")
            np.testing.assert_allclose(estimate.tracks[0].mean, mean, atol=1e-11)
            np.testing.assert_allclose(estimate.tracks[0].cov, cov, atol=1e-12)


def test_with_all_data_all_replicas_are_one() -> None:
    team = played()
    team.exchange(STEPS * NS)
    tracks = [agent.estimate().tracks[0] for agent in team.agents.values()]
    for other in tracks[1:]:
        np.testing.assert_allclose(other.mean, tracks[0].mean, atol=1e-12)
        np.testing.assert_allclose(other.cov, tracks[0].cov, atol=1e-12)


def heard_in_order(team: Team, name: str) -> Estimate:
    """The estimate of a robot that has heard all that was said, message by message."""
    fresh = Agent(settings_of(name))
    for event in team.events[name]:
        fresh.handle(event)
    for message in team.said:
        if message.header.source != name:
            fresh.handle(Received(STEPS * NS, message))
    return fresh.estimate()


PLAYED = played()
IN_ORDER = heard_in_order(PLAYED, "r2")


@settings(max_examples=sized(20, 60), deadline=None)
@given(st.data())
def test_the_order_of_messages_and_their_repetition_do_not_matter(data: st.DataObject) -> None:
    """Own events come in their order, messages between them or after them, some of them several times."""
    agent = Agent(settings_of("r2"))
    messages = [message for message in PLAYED.said if message.header.source != "r2"]
    messages += data.draw(st.lists(st.sampled_from(messages), max_size=10))
    messages = data.draw(st.permutations(messages))
    own = list(PLAYED.events["r2"])
    slots = sorted(data.draw(st.lists(st.integers(0, len(own)), min_size=len(messages), max_size=len(messages))))
    asked = data.draw(st.sets(st.integers(0, len(own))))
    for index in range(len(own) + 1):
        for slot, message in zip(slots, messages):
            if slot == index:
                agent.handle(Received(agent.now_ns, message))
        if index in asked:
            agent.estimate()
        if index < len(own):
            agent.handle(own[index])
    assert equal(agent.estimate(), IN_ORDER)
    # Nothing is used twice: 4 kinds of data of r1, 3 of the others, in each step.
    filter_ = agent.filter
    assert isinstance(filter_, ReplicaFilter)
    assert sum(len(instant.data) for instant in filter_._history._instants) == 10 * STEPS


@settings(max_examples=sized(13, 40), deadline=None)
@given(st.lists(st.booleans(), min_size=2 * STEPS, max_size=2 * STEPS))
def test_single_losses_change_nothing(drawn: list[bool]) -> None:
    """Of each robot no two messages in a row are lost, and the last one arrives."""
    agent = Agent(settings_of("r2"))
    for event in PLAYED.events["r2"]:
        agent.handle(event)
    for source in ("r1", "r3"):
        spoken = [message for message in PLAYED.said if message.header.source == source]
        lost = False
        for message, bad in zip(spoken, drawn[: STEPS] if source == "r1" else drawn[STEPS:], strict=True):
            lost = bad and not lost and message is not spoken[-1]
            if not lost:
                agent.handle(Received(STEPS * NS, message))
    assert equal(agent.estimate(), IN_ORDER)


def test_what_is_heard_late_is_used_at_its_instant() -> None:
    """Messages of a robot that come five seconds late make the same belief in the end."""
    punctual, late = Team(seed=4), Team(seed=4)
    for k in range(1, STEPS + 6):
        for team in (punctual, late):
            team.step(k)
        punctual.exchange(k * NS)
        held = [message for message in late.said if message.header.t_meas_ns > (k - 5) * NS]
        late.said = [message for message in late.said if message not in held]
        late.exchange(k * NS)
        late.said = held
    late.exchange((STEPS + 5) * NS)
    for name in NAMES:
        assert equal(late.agents[name].estimate(), punctual.agents[name].estimate())


def test_an_estimate_is_published_when_peers_were_heard() -> None:
    team = played()
    before = team.agents["r2"].estimate()
    message = next(item for item in reversed(team.said) if item.header.source == "r1")
    heard = team.handle("r2", Received(STEPS * NS, message))
    assert not any(isinstance(effect, Publish) for effect in heard)
    assert team.agents["r2"].next_deadline_ns() == STEPS * NS
    (published,) = [item for item in team.handle("r2", Tick(STEPS * NS)) if isinstance(item, Publish)]
    assert published.estimate.t_ns == before.t_ns
    assert np.trace(published.estimate.cov) < np.trace(before.cov)


def test_an_instant_of_a_peer_that_is_ahead_waits_for_the_own_odometry() -> None:
    team = Team()
    team.step(1)
    team.exchange(NS)
    team.step(2, silent=("r2",))
    team.exchange(2 * NS)
    before = team.agents["r2"].estimate()
    assert before.t_ns == NS
    team.handle("r2", Odometry(2 * NS, NS, 2 * NS, np.zeros(4), NOISE))
    after = team.agents["r2"].estimate()
    assert after.t_ns == 2 * NS
    # The others have seen the target at 2 s; at 1 s that was not known.
    assert np.trace(after.tracks[0].cov) < np.trace(before.tracks[0].cov)


def test_a_measurement_waits_for_the_odometry_of_whom_it_is_of() -> None:
    team = Team()
    team.step(1)
    r2 = team.agents["r2"]
    assert r2.counters["pair.started"] == 1
    r2.estimate()
    assert r2.counters["pair.applied_initiator"] == 0
    team.exchange(NS)
    r2.estimate()
    assert (r2.counters["pair.applied_initiator"], r2.counters["pair.applied_responder"]) == (1, 1)
    assert r2.filter.contacts() == {"r3": Epoch(NS, "r2", 2), "r1": Epoch(NS, "r1", 3)}


def test_a_peer_that_was_silent_is_where_its_odometry_says() -> None:
    """r3 is not heard for 30 s; its next word brings it back without a measurement of it."""
    team = Team(lateness=LatenessSettings(horizon_ns=5 * NS))
    team.step(1)
    team.exchange(NS)
    for k in range(2, 31):
        team.step(k)
        team.said = [message for message in team.said if message.header.source != "r3"]
        team.exchange(k * NS)
    r2 = team.agents["r2"]
    assert r2.counters["replica.uncovered"] > 20
    assert r2.status()["form_reason"] == "configured; silent: r3"
    team.step(31)
    team.exchange(31 * NS)
    filter_ = r2.filter
    assert isinstance(filter_, ReplicaFilter)
    mean, cov = filter_._history.belief().filter.belief("r3")
    error = mean - team.truth["r3"]
    error[2] = (error[2] + np.pi) % (2.0 * np.pi) - np.pi
    assert error @ np.linalg.solve(cov, error) < 16.3  # 99.9 % of chi-square with 3 degrees of freedom
    assert r2.status()["form_reason"] == "configured; everybody is heard"


# --- lives ------------------------------------------------------------------------------------------------


def test_a_peer_that_restarts_is_coasted_over_the_gap() -> None:
    team = Team()
    for k in range(1, 4):
        team.step(k)
        team.exchange(k * NS)
    for k in range(4, 8):
        team.step(k, silent=("r2", "r3"))
        team.exchange(k * NS)
    filter_ = team.agents["r1"].filter
    assert isinstance(filter_, ReplicaFilter)
    before = filter_._history.belief().filter.belief("r3")[1]
    # Its first words come before anything is measured of it again.
    report = TeamReport(7 * NS, (Reckoning(7 * NS, 7 * NS, 8 * NS, np.zeros(4), 1e-6 * np.eye(4)),))
    message = Message(Header("r3", 99, 2, 1, 8 * NS, 8 * NS), report)
    team.hear("r1", message, 8 * NS)
    team.handle("r1", Odometry(8 * NS, 7 * NS, 8 * NS, np.zeros(4), NOISE))
    after = filter_._history.belief().filter.belief("r3")[1]
    # From 3 to 7 s at 0.5 m/s and 0.5 rad/s.
    growth = np.diagonal(after - before)
    np.testing.assert_allclose(growth[2], 4.0, rtol=0.01)
    assert np.all(growth[:2] > 3.9)


def test_a_team_is_placed_where_each_of_its_lives_began() -> None:
    """r3 starts 20 s after r1: until then nobody knows of it, and its start is where its own belief says."""
    late = Agent(replace(settings_of("r3"), start_ns=20 * NS))
    team = Team()
    r1 = team.agents["r1"]
    for k in range(1, 22):
        team.handle("r1", Odometry(k * NS, (k - 1) * NS, k * NS, np.zeros(4), NOISE))
    report = TeamReport(20 * NS, (Reckoning(20 * NS, 20 * NS, 21 * NS, np.zeros(4), np.zeros((4, 4))),))
    team.hear("r1", Message(Header("r3", 11, 1, 1, 21 * NS, 21 * NS), report), 21 * NS)
    filter_ = r1.filter
    assert isinstance(filter_, ReplicaFilter)
    mean, cov = filter_._history.belief().filter.belief("r3")
    np.testing.assert_allclose(mean, late.estimate().mean)
    np.testing.assert_allclose(cov, late.estimate().cov)


# --- what is not used -------------------------------------------------------------------------------------


def told_by(source: str, *items: RawMeasurement) -> Message:
    return decode(encode(Header(source, 11, 1, 1, NS, NS), TeamReport(0, (), items)), source)


def measured(of: str | None, kind: str = "range", t_ns: int = NS, size: int = 1) -> RawMeasurement:
    return RawMeasurement(t_ns, 0, of, kind, np.full(size, 2.0), np.eye(size))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (told_by("r9", measured("r1")), "replica.not_in_team"),
        (told_by("r1", measured("r9")), "replica.unknown_robot"),
        (told_by("r1", measured("target:t9")), "replica.unknown_target"),
        (told_by("r1", measured("landmark:door")), "replica.unknown_landmark"),
        (Message(Header("r1", 11, 1, 1, NS, NS), PairReply(Epoch(1, "r2", 1), ReplyStatus.BUSY)), "pair.other_form"),
    ],
)
def test_what_a_robot_cannot_use_is_counted(message: Message, reason: str) -> None:
    agent = Agent(settings_of("r2"))
    agent.handle(Odometry(NS, 0, NS, np.zeros(4), NOISE))
    before = agent.estimate()
    agent.handle(Received(NS, message))
    assert agent.counters[reason] == 1
    assert equal(agent.estimate(), before)


def test_an_altitude_of_a_planar_robot_and_contradictions_do_no_harm() -> None:
    agent = Agent(settings_of("r2", lateness=LatenessSettings(horizon_ns=2 * NS)))
    agent.handle(Odometry(NS, 0, NS, np.zeros(4), NOISE))
    tiny = RawMeasurement(NS, 1, "r2", "range_bearing", np.array([9e8, 3.0]), np.eye(2) * 1e-9)
    moved = Reckoning(0, 0, NS, np.full(4, 1e8), np.zeros((4, 4)))
    report = TeamReport(0, (moved,), (measured(None, "altitude"), tiny))
    agent.handle(Received(NS, decode(encode(Header("r1", 11, 1, 1, NS, NS), report), "r1")))
    for k in range(2, 6):
        agent.handle(Odometry(k * NS, (k - 1) * NS, k * NS, np.zeros(4), NOISE))
    assert np.all(np.isfinite(agent.estimate().mean))
    assert np.linalg.eigvalsh(agent.estimate().cov)[0] > 0.0
    assert agent.counters["replica.failed"] >= 1


def test_what_is_older_than_the_horizon_is_counted() -> None:
    team = Team(lateness=LatenessSettings(horizon_ns=3 * NS))
    for k in range(1, 8):
        team.step(k)
    r2 = team.agents["r2"]
    team.handle("r2", Received(7 * NS, told_by("r1", measured("target:t1", t_ns=NS))))
    assert r2.counters["replica.too_late"] == 1
    team.handle("r2", Fix(7 * NS, 3 * NS, "position", np.zeros(2), np.eye(2), "gps"))
    assert r2.counters["late.dropped"] == 1
    team.handle("r2", Fix(7 * NS, 5 * NS, "position", np.zeros(2), np.eye(2), "gps"))
    assert r2.counters["late.compensated"] == 1


def test_late_own_data_are_dropped_if_so_configured() -> None:
    team = Team(lateness=LatenessSettings(kind="discard", horizon_ns=30 * NS))
    for k in range(1, 5):
        team.step(k)
    team.handle("r2", Fix(4 * NS, 3 * NS, "position", np.zeros(2), np.eye(2), "gps"))
    assert team.agents["r2"].counters["late.dropped"] == 1


def many(k: int, t_ns: int) -> tuple[RawMeasurement, ...]:
    return tuple(RawMeasurement(t_ns, 16 * k + i, "target:t1", "range", np.ones(1), np.eye(1)) for i in range(16))


def test_memory_is_bounded_and_who_tells_too_much_crowds_out_nobody_else() -> None:
    agent = Agent(settings_of("r2"))
    agent.handle(Odometry(NS, 0, NS, np.zeros(4), NOISE))
    for k in range(150):
        agent.handle(Received(NS, told_by("r1", *many(k, NS))))
    assert agent.counters["replica.overflow"] == 150 * 16 - MAX_WAITING
    agent.handle(Received(NS, told_by("r3", *many(0, NS))))
    agent.handle(Fix(NS, NS, "position", np.zeros(2), np.eye(2), "gps"))
    agent.handle(Tick(NS))
    assert agent.counters["replica.overflow"] == 150 * 16 - MAX_WAITING
    assert agent.counters["late.dropped"] == 0


def test_with_too_many_instants_the_horizon_is_cut_and_time_goes_on() -> None:
    agent = Agent(settings_of("r2"))
    filter_ = agent.filter
    assert isinstance(filter_, ReplicaFilter)
    step_ns = HORIZON_NS // (3 * MAX_INSTANTS)
    for k in range(1, 2 * MAX_INSTANTS):
        filter_.advance(k * step_ns, np.zeros(4), NOISE * 1e-3)
        assert len(filter_._history._instants) <= MAX_INSTANTS
    assert agent.counters["replica.horizon_cut"] >= 2
    assert filter_.t_ns == (2 * MAX_INSTANTS - 1) * step_ns
    assert np.isfinite(agent.estimate().mean).all()


def test_what_has_left_the_horizon_is_nothing_new_by_another_clock_offset() -> None:
    """r1's clock seems 10 ms off when a measurement is told again, which would bring it back into the horizon."""
    horizon_ns = 3 * NS
    team = Team(lateness=LatenessSettings(horizon_ns=horizon_ns, clock_sigma_ns=NS))
    r2 = team.agents["r2"]
    item = measured("target:t1")
    r2.handle(Odometry(NS, 0, NS, np.zeros(4), NOISE))
    message = Message(
        Header("r1", 11, 1, 1, NS, NS),
        TeamReport(0, (Reckoning(0, 0, NS, np.zeros(4), np.eye(4) * 1e-4),), (item,)),
    )
    r2.handle(Received(NS, message, 0, 1))
    for k in range(2, 5):
        r2.handle(Odometry(k * NS, (k - 1) * NS, k * NS, np.zeros(4), NOISE))
    assert r2.counters["replica.used"] == 1
    before = r2.estimate()
    again = Message(Header("r1", 11, 1, 2, NS, NS), TeamReport(0, (), (item,)))
    r2.handle(Received(4 * NS, again, -10_000_000, 1))
    assert equal(r2.estimate(), before)
    assert r2.counters["replica.too_late"] == 0
    for k in range(5, 9):
        r2.handle(Odometry(k * NS, (k - 1) * NS, k * NS, np.zeros(4), NOISE))
    assert not filter_names(r2)


def filter_names(agent: Agent) -> list[object]:
    """Names of all measurements that are still known."""
    assert isinstance(agent.filter, ReplicaFilter)
    return list(agent.filter._history._known)


@settings(max_examples=sized(13, 40), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_valid_message_stops_a_robot_or_spoils_its_covariance(seed: int) -> None:
    """Numbers of any size, sums that contradict each other, lives that begin anywhere, in messages that are valid."""
    rng = np.random.default_rng(seed)
    transform = ("unscented", "jacobian", "linearized")[seed % 3]
    agent = Agent(
        settings_of(
            "r2",
            lateness=LatenessSettings(horizon_ns=3 * NS),
            localization=LocalizationSettings(kind="replica", transform=transform),  # type: ignore[arg-type]
        )
    )
    incarnation = 1
    for k in range(1, 13):
        agent.handle(Odometry(k * NS, (k - 1) * NS, k * NS, np.array([0.5, 0.0, 0.0, 0.1]), NOISE))
        for seq in range(3):
            incarnation += rng.random() < 0.05
            header = Header("r3", 11, incarnation, 3 * k + seq, k * NS, k * NS)
            agent.handle(Received(k * NS, decode(encode(header, rubbish(rng, k * NS)), "r3")))
        for of in ("target:t1", "r3"):
            agent.handle(Observation(k * NS, k * NS, "range_bearing", of, np.array([3.0, 0.2]), R, "eye"))
        agent.handle(Tick(k * NS))
        estimate = agent.estimate()
        assert estimate.t_ns == k * NS
        for mean, cov in ((estimate.mean, estimate.cov), (estimate.tracks[0].mean, estimate.tracks[0].cov)):
            assert np.isfinite(mean).all()
            assert np.linalg.eigvalsh(cov)[0] > 0.0
    assert len(filter_names(agent)) < 3 * 12 * 6 + 24


def rubbish(rng: np.random.Generator, t_ns: int) -> TeamReport:
    def values(size: int) -> Array:
        return np.asarray(rng.normal(size=size) * 10.0 ** rng.uniform(-8.0, 8.0))

    def cov(size: int) -> Array:
        root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-4.0, 3.0)
        return np.asarray(root @ root.T + 1e-8 * np.eye(size))

    born_ns = int(rng.choice([0, max(0, t_ns - int(rng.integers(1, 5)) * NS)]))
    stamps = {t_ns - int(rng.integers(0, 4)) * NS - int(rng.integers(0, 2) * rng.integers(0, NS)) for _ in range(3)}
    reckonings = []
    for stamp in sorted(stamp for stamp in stamps if stamp > born_ns):
        anchor_ns = int(rng.integers(born_ns, stamp)) if rng.random() < 0.3 else born_ns
        noise = cov(4) if rng.random() < 0.7 else np.zeros((4, 4))
        reckonings.append(Reckoning(anchor_ns, int(rng.integers(anchor_ns, stamp)), stamp, values(4), noise))
    measurements = []
    sizes = {"range": 1, "bearing": 1, "range_bearing": 2, "bearing3": 2, "vector": 2, "pixel": 2}
    alone = {"position": 3, "pose": 3, "heading": 1, "altitude": 1}
    for index in range(1 + int(rng.integers(0, 5))):
        of = (None, "r1", "r2", "target:t1", "landmark:gate")[int(rng.integers(0, 5))]
        kinds = alone if of is None else sizes
        kind = sorted(kinds)[int(rng.integers(0, len(kinds)))]
        z = values(kinds[kind])
        z[0] = abs(z[0])
        mount = tuple((rng.normal(size=6) * 10.0 ** rng.uniform(-3.0, 6.0)).tolist())
        stamp = max(0, t_ns - int(rng.integers(0, 4)) * NS)
        measurements.append(RawMeasurement(stamp, index, of, kind, z, cov(len(z)), mount))  # type: ignore[arg-type]
    return TeamReport(born_ns, tuple(reckonings), tuple(measurements))


def test_figures_are_counted_once_a_measurement_leaves_the_horizon() -> None:
    team = Team(lateness=LatenessSettings(horizon_ns=3 * NS))
    for k in range(1, 11):
        team.step(k)
        team.exchange(k * NS)
    r1 = team.agents["r1"]
    assert r1.counters["used.position"] == r1.counters["used.pair_range_bearing"] == 7
    assert {kind: entry.count for kind, entry in r1.nis.items()} == dict.fromkeys(
        ("position", "landmark_range_bearing", "target_range_bearing", "pair_range_bearing"), 7
    )
    assert r1.counters["replica.used"] == 7 * 10
    assert r1.status()["form"] == "replica"
