"""Robots that keep no factors: what they claim covers their true errors, whatever happens to their messages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Effect, Send
from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion, compose
from agent.events import Event, Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from agent.split_filter import SplitFilter
from network.messages import MAX_MESSAGE_BYTES, Header, Message, PairReply, ReplyStatus, SplitReply, SplitRequest
from network.wire import encode

Array = NDArray[np.float64]

TINY = 1e-12
LOCALIZATION = LocalizationSettings(
    form="split_joint", transform="jacobian", pair_interval_ns=0, pair_timeout_ns=100 * NS
)
NOISE = np.diag([0.02, 0.03, 0.0, 0.0])
R = np.diag([0.05, 0.04])
PLACES = {"r1": (0.0, 0.0, 0.3), "r2": (5.0, 3.0, -1.0), "r3": (-2.0, 6.0, 2.0)}
COVS = {"r1": np.diag([0.2, 0.3, TINY]), "r2": np.diag([0.4, 0.2, TINY]), "r3": np.diag([0.3, 0.5, TINY])}
TARGET_COV = np.diag([0.5, 0.4, 0.05, 0.05])
TARGET = np.array([2.0, 2.0, 0.3, -0.2])
MOTION = TargetMotion(CONSTANT_VELOCITY, noise_sigma=(0.2, 0.2))
DELTA = np.array([0.3, 0.1, 0.0, 0.0])
STEPS = 6


def settings(name: str, mean: Array, cov: Array, target: Array | None) -> AgentSettings:
    targets = () if target is None else (TargetSettings("t1", MOTION, target, TARGET_COV),)
    lateness = LatenessSettings(horizon_ns=60 * NS)
    return AgentSettings(name, 0, mean, cov, targets=targets, localization=LOCALIZATION, lateness=lateness)


class Team:
    """Agents whose letters wait until the test hands them over."""

    def __init__(self, agents: dict[str, Agent]) -> None:
        self.agents = agents
        self.letters: list[tuple[str, Send]] = []
        self.now_ns = 0
        self._seq = 0

    def handle(self, robot: str, event: Event) -> None:
        self.now_ns = max(self.now_ns, event.t_ns)
        self._post(robot, self.agents[robot].handle(event))

    def _post(self, robot: str, effects: list[Effect]) -> None:
        self.letters += [(robot, item) for item in effects if isinstance(item, Send)]

    def deliver(self, letter: tuple[str, Send]) -> None:
        source, item = letter
        self._seq += 1
        header = Header(source, 1, 1, self._seq, item.t_meas_ns, self.now_ns)
        self.handle(item.peer, Received(self.now_ns, Message(header, item.body)))

    def converse(self) -> None:
        """Everything that is under way arrives now, and what follows from it."""
        while self.letters:
            self.deliver(self.letters.pop(0))

    def filter(self, robot: str) -> SplitFilter:
        found = self.agents[robot].filter
        assert isinstance(found, SplitFilter)
        return found


def story(noise: dict[tuple[str, ...], Array], seed: int) -> Team:
    """Three robots and a target over some seconds; contacts, losses, delays and their order are drawn from `seed`.

    All estimates start at the truth and nothing is noisy but what `noise` names. Headings are known, so that every
    error is a linear function of the noises.
    """
    rng = np.random.default_rng(seed)
    true_target = TARGET + noise.get(("target",), np.zeros(4))
    team = Team(
        {
            name: Agent(settings(name, np.array(place) + noise.get(("start", name), np.zeros(3)), COVS[name], TARGET))
            for name, place in PLACES.items()
        }
    )
    truth = {name: np.array(place) for name, place in PLACES.items()}
    late: list[tuple[str, Fix]] = []

    def seen(observer: str, place: Array, label: str) -> Array:
        heading = truth[observer][2]
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        return np.asarray(turn @ (place[:2] - truth[observer][:2]) + noise.get(("z", label), np.zeros(2)))

    for k in range(1, STEPS + 1):
        now = k * NS
        F = np.eye(4)
        F[0, 2] = F[1, 3] = 1.0
        true_target = F @ true_target + noise.get(("drive", str(k)), np.zeros(4))
        for name in PLACES:
            truth[name] = compose(truth[name], DELTA[[0, 1, 3]])
            # What the odometry says differs from what happened.
            delta = DELTA + noise.get(("odometry", name, str(k)), np.zeros(4))
            team.handle(name, Odometry(now, now - NS, now, delta, NOISE))
        for index in range(rng.integers(1, 5)):
            first, second = rng.choice(list(PLACES), 2, replace=False)
            label = f"{k}:{index}"
            match rng.integers(0, 4):
                case 0:
                    z = seen(first, true_target, label)
                    team.handle(first, Observation(now, now, "vector", "target:t1", z, R, "camera"))
                case 1:
                    z = truth[first][:2] + noise.get(("z", label), np.zeros(2))
                    fix = Fix(now, now, "position", z, R, "gps")
                    if rng.random() < 0.5:
                        late.append((first, fix))
                    else:
                        team.handle(first, fix)
                case _:
                    z = seen(first, truth[second], label)
                    team.handle(first, Observation(now, now, "vector", second, z, R, "camera"))
        waiting, team.letters = team.letters, []
        kept = []
        while waiting:
            letter = waiting.pop(int(rng.integers(len(waiting))))
            fate = rng.choice(["now", "now", "late", "lost", "twice"])
            if fate == "late":
                kept.append(letter)
            elif fate != "lost":
                for _ in range(2 if fate == "twice" else 1):
                    team.deliver(letter)
                waiting += team.letters
                team.letters = []
        team.letters = kept
        if late and rng.random() < 0.5:
            name, fix = late.pop(0)
            team.handle(name, replace(fix, t_ns=now))
    team.converse()
    return team


def estimates(team: Team) -> dict[str, Array]:
    return {name: team.filter(name).state.mean for name in PLACES}


def sources() -> list[tuple[tuple[str, ...], Array]]:
    """Every independent noise of `story`, as what it adds and where: the columns of its square root."""
    found: list[tuple[tuple[str, ...], Array]] = []

    def add(name: tuple[str, ...], cov: Array) -> None:
        found.extend((name, column) for column in np.linalg.cholesky(cov + 1e-30 * np.eye(len(cov))).T)

    for name in PLACES:
        add(("start", name), COVS[name])
        for k in range(1, STEPS + 1):
            add(("odometry", name, str(k)), NOISE)
    add(("target",), TARGET_COV)
    Q = MOTION.drift(TARGET, np.zeros((4, 4)), 1.0, "jacobian").cov
    for k in range(1, STEPS + 1):
        add(("drive", str(k)), Q)
    return found


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_claimed_covariance_covers_the_true_one_in_any_interleaving(seed: int) -> None:
    """The estimates' response to every unit noise gives the true joint covariance of each robot and the target."""
    still = story({}, seed)
    rest = estimates(still)
    # Errors of the target: its true state is what the noise moves, by its own dynamics.
    errors: dict[str, list[Array]] = {name: [] for name in PLACES}
    noises = sources()
    noises += [
        (("z", f"{k}:{index}"), column)
        for k in range(1, STEPS + 1)
        for index in range(4)
        for column in np.linalg.cholesky(R).T
    ]
    F = np.eye(4)
    F[0, 2] = F[1, 3] = 1.0
    for name, column in noises:
        moved = estimates(story({name: column}, seed))
        true = np.zeros(7)
        if name == ("target",):
            true[3:] = np.linalg.matrix_power(F, STEPS) @ column
        elif name[0] == "drive":
            true[3:] = np.linalg.matrix_power(F, STEPS - int(name[1])) @ column
        for robot in PLACES:
            errors[robot].append(moved[robot] - rest[robot] - true)
    applied = 0
    for robot in PLACES:
        counters = still.agents[robot].counters
        applied += counters["pair.applied_initiator"] + counters["pair.applied_responder"]
        columns = np.stack(errors[robot], axis=1)
        claimed = still.filter(robot).state.cov
        keep = [0, 1, 3, 4, 5, 6]
        slack = (claimed - columns @ columns.T)[np.ix_(keep, keep)]
        assert np.linalg.eigvalsh(slack)[0] > -1e-9, f"{robot} is overconfident (seed {seed})"
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
