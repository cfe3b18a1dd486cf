"""Three robots that believe of themselves and a target in one, for tests of what they claim in any interleaving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.auto_filter import AutoFilter
from agent.belief import RobotState
from agent.core import Agent
from agent.effects import Effect, Send
from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion, compose
from agent.events import Event, Fix, Observation, Odometry, Received
from agent.joint_filter import JointFilter
from agent.joint_state import JointState
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from agent.split_filter import SplitFilter
from network.messages import Header, Message

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

Noises = dict[tuple[str, ...], Array]


def settings(
    name: str, mean: Array, cov: Array, target: Array | None, localization: LocalizationSettings = LOCALIZATION
) -> AgentSettings:
    targets = () if target is None else (TargetSettings("t1", MOTION, target, TARGET_COV),)
    lateness = LatenessSettings(horizon_ns=60 * NS)
    return AgentSettings(name, 0, mean, cov, targets=targets, localization=localization, lateness=lateness)


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

    def state(self, robot: str) -> JointState | RobotState:
        """The belief of robot and target in one, whatever form is on."""
        found = self.agents[robot].filter
        if isinstance(found, AutoFilter):
            found = found.active
        assert isinstance(found, SplitFilter | JointFilter)
        return found.state

    def filter(self, robot: str) -> SplitFilter:
        found = self.agents[robot].filter
        assert isinstance(found, SplitFilter)
        return found


def story(noise: Noises, seed: int, localization: LocalizationSettings = LOCALIZATION) -> Team:
    """Three robots and a target over some seconds; contacts, losses, delays and their order are drawn from `seed`.

    All estimates start at the truth and nothing is noisy but what `noise` names. Headings are known, so that every
    error is a linear function of the noises.
    """
    rng = np.random.default_rng(seed)
    true_target = TARGET + noise.get(("target",), np.zeros(4))
    team = Team(
        {
            name: Agent(
                settings(
                    name, np.array(place) + noise.get(("start", name), np.zeros(3)), COVS[name], TARGET, localization
                )
            )
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
    return {name: team.state(name).mean for name in PLACES}


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


def unclaimed(seed: int, localization: LocalizationSettings = LOCALIZATION) -> tuple[Team, dict[str, float]]:
    """A story, and by robot the smallest eigenvalue of what it claims beyond the true covariance of its joint error.

    The estimates' response to every unit noise gives the true joint covariance of each robot and the target.
    """
    still = story({}, seed, localization)
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
        moved = estimates(story({name: column}, seed, localization))
        true = np.zeros(7)
        if name == ("target",):
            true[3:] = np.linalg.matrix_power(F, STEPS) @ column
        elif name[0] == "drive":
            true[3:] = np.linalg.matrix_power(F, STEPS - int(name[1])) @ column
        for robot in PLACES:
            errors[robot].append(moved[robot] - rest[robot] - true)
    found = {}
    keep = [0, 1, 3, 4, 5, 6]
    for robot in PLACES:
        columns = np.stack(errors[robot], axis=1)
        slack = (still.state(robot).cov - columns @ columns.T)[np.ix_(keep, keep)]
        found[robot] = float(np.linalg.eigvalsh(slack)[0])
    return still, found
