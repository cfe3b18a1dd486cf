"""Two robots of the form `joint` and a target that both track, for tests of what they claim.

Headings are known, so that every error is a linear function of independent noises: the estimates' response to each of
them gives the true joint covariance, whoever applied which contact, and when.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Effect, Send
from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion, compose
from agent.events import Event, Fix, Observation, Odometry, Received
from agent.joint_factors import resolve
from agent.joint_filter import JointFilter
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from network.messages import Header, JointSnapshot, Message

Array = NDArray[np.float64]

FIRST, SECOND = "r1", "r2"
OTHER = {FIRST: SECOND, SECOND: FIRST}
TINY = 1e-12
LOCALIZATION = LocalizationSettings(form="joint", transform="jacobian", pair_interval_ns=0, pair_timeout_ns=100 * NS)
NOISE = np.diag([0.02, 0.03, 0.0, 0.0])
R = np.diag([0.05, 0.04])
PLACES = {FIRST: (0.0, 0.0, 0.3), SECOND: (5.0, 3.0, -1.0)}
COVS = {FIRST: np.diag([0.2, 0.3, TINY]), SECOND: np.diag([0.4, 0.2, TINY])}
TARGET = np.array([2.0, 2.0, 0.3, -0.2])
TARGET_COV = np.diag([0.5, 0.4, 0.05, 0.05])
DELTA = np.array([0.3, 0.1, 0.0, 0.0])
KNOWN = [0, 1, 3, 4, 5, 6]
"""Components but the heading, which nobody errs in."""

F_TARGET = np.eye(4)
F_TARGET[0, 2] = F_TARGET[1, 3] = 1.0


def motion(drive: float) -> TargetMotion:
    return TargetMotion(CONSTANT_VELOCITY, noise_sigma=(drive, drive))


def settings(name: str, drive: float = 0.0) -> AgentSettings:
    return AgentSettings(
        name,
        0,
        np.array(PLACES[name]),
        COVS[name],
        targets=(TargetSettings("t1", motion(drive), TARGET, TARGET_COV),),
        localization=LOCALIZATION,
        lateness=LatenessSettings(horizon_ns=60 * NS),
    )


@dataclass(frozen=True, slots=True)
class Act:
    """At the end of step `k`, `robot` measures `what`: "peer", "target", or "fix"; a fix may arrive steps later."""

    k: int
    robot: str
    what: str
    arrives: int = 0


Noises = dict[tuple[str, ...], Array]


class Story:
    """Some steps with what is measured at them; the first letters have a fate each, later ones arrive at once."""

    def __init__(
        self, acts: tuple[Act, ...], fates: tuple[str, ...], steps: int, noises: Noises, drive: float = 0.0
    ) -> None:
        self.agents: dict[str, Agent] = {}
        for name in PLACES:
            base = settings(name, drive)
            self.agents[name] = Agent(replace(base, mean=base.mean + noises.get(("start", name), np.zeros(3))))
        self.sent: list[tuple[str, Send]] = []
        self._noises, self._acts, self._fates = noises, acts, list(fates)
        self._late: list[tuple[str, Send]] = []
        self._held: list[tuple[int, str, Fix]] = []
        self._seq, self._now_ns = 0, 0
        self.target = TARGET + noises.get(("target",), np.zeros(4))
        self.truth = {name: np.array(place) for name, place in PLACES.items()}
        for k in range(1, steps + 1):
            self._step(k)

    def _step(self, k: int) -> None:
        self._now_ns = now = k * NS
        self.target = F_TARGET @ self.target + self._noises.get(("drive", str(k)), np.zeros(4))
        for name in PLACES:
            self.truth[name] = compose(self.truth[name], DELTA[[0, 1, 3]])
            delta = DELTA + self._noises.get(("odometry", name, str(k)), np.zeros(4))
            self._travel(self._handle(name, Odometry(now, now - NS, now, delta, NOISE)))
        for _, name, fix in [item for item in self._held if item[0] == k]:
            self._handle(name, replace(fix, t_ns=now))
        # What was held back a step ago arrives after what is new, the newest first.
        held, self._late = self._late[::-1], []
        letters = []
        for act in self._acts:
            if act.k == k:
                letters += self._measure(act, now)
        self._travel(letters)
        for letter in held:
            self._travel(self._deliver(letter))

    def _measure(self, act: Act, now: int) -> list[tuple[str, Send]]:
        own, off = self.truth[act.robot], self._noises.get(("z", str(act.k), act.robot, act.what), np.zeros(2))
        if act.what == "fix":
            fix = Fix(now, now, "position", own[:2] + off, R, "gps")
            if act.arrives:
                self._held.append((act.arrives, act.robot, fix))
                return []
            return self._handle(act.robot, fix)
        place = self.target if act.what == "target" else self.truth[OTHER[act.robot]]
        turn = np.array([[np.cos(own[2]), np.sin(own[2])], [-np.sin(own[2]), np.cos(own[2])]])
        of = "target:t1" if act.what == "target" else OTHER[act.robot]
        z = turn @ (place[:2] - own[:2]) + off
        return self._handle(act.robot, Observation(now, now, "vector", of, z, R, "camera"))

    def _handle(self, robot: str, event: Event) -> list[tuple[str, Send]]:
        effects: list[Effect] = self.agents[robot].handle(event)
        letters = [(robot, item) for item in effects if isinstance(item, Send)]
        self.sent += letters
        return letters

    def _deliver(self, letter: tuple[str, Send]) -> list[tuple[str, Send]]:
        source, item = letter
        self._seq += 1
        header = Header(source, 1, 1, self._seq, item.t_meas_ns, self._now_ns)
        return self._handle(item.peer, Received(self._now_ns, Message(header, item.body)))

    def _travel(self, letters: list[tuple[str, Send]]) -> None:
        """Letters and what follows from them, each with its fate."""
        while letters:
            following: list[tuple[str, Send]] = []
            for letter in letters:
                fate = self._fates.pop(0) if self._fates else "now"
                if fate == "late":
                    self._late.append(letter)
                elif fate != "lost":
                    for _ in range(2 if fate == "twice" else 1):
                        following += self._deliver(letter)
            letters = following

    def filter(self, robot: str) -> JointFilter:
        found = self.agents[robot].filter
        assert isinstance(found, JointFilter)
        return found

    def errors(self) -> Array:
        """Errors (14,) of both robots' joint beliefs."""
        return np.concatenate(
            [self.filter(name).state.mean - np.concatenate([self.truth[name], self.target]) for name in PLACES]
        )

    def claimed(self) -> Array:
        """Joint covariance (14, 14) of both, with the correlation the next contact would recover."""
        low, high = (self.filter(name).snapshot(OTHER[name]) for name in PLACES)
        assert isinstance(low, JointSnapshot) and isinstance(high, JointSnapshot)
        found = resolve(low, high)
        assert found is not None, "the correlation was lost"
        cross, complete = found
        assert complete
        covs = [self.filter(name).state.cov for name in PLACES]
        return np.block([[covs[0], cross], [cross.T, covs[1]]])

    def count(self, name: str) -> int:
        return sum(agent.counters[name] for agent in self.agents.values())


def true_covariance(acts: tuple[Act, ...], fates: tuple[str, ...], steps: int, drive: float = 0.0) -> Array:
    """Covariance (14, 14) of the errors, from the response to every independent noise of a story."""
    rest = Story(acts, fates, steps, {}, drive).errors()
    columns = []

    def add(name: tuple[str, ...], cov: Array) -> None:
        values, vectors = np.linalg.eigh(cov)
        for value, vector in zip(values, vectors.T):
            if value > 1e-9:
                found = Story(acts, fates, steps, {name: np.sqrt(value) * vector}, drive).errors()
                columns.append(found - rest)

    for name in PLACES:
        add(("start", name), COVS[name])
    add(("target",), TARGET_COV)
    Q = motion(drive).drift(TARGET, np.zeros((4, 4)), 1.0, "jacobian").cov
    for k in range(1, steps + 1):
        add(("drive", str(k)), Q)
        for name in PLACES:
            add(("odometry", name, str(k)), NOISE)
    for act in acts:
        add(("z", str(act.k), act.robot, act.what), R)
    E = np.stack(columns, axis=1)
    return np.asarray(E @ E.T)
