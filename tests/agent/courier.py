"""Two agents and the exact linear bookkeeping of their errors, for tests of the pair protocol.

The bookkeeping writes each robot's error as coefficients over independent unit noises (initial, odometry,
measurements). With headings known exactly everything is linear, and the claimed covariances and the recovered
cross-covariance must equal what the coefficients give, whoever applied which contact, and when.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Effect, Persist, Send
from agent.estimation.colocalization import resolve_cross
from agent.estimation.gaussian import gain
from agent.estimation.motion import UNICYCLE
from agent.estimation.observation import RelativeModel
from agent.events import LinkChange, Observation, Odometry, Received
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings
from network.messages import Epoch, Header, Message, PairReply, PairRequest

Array = NDArray[np.float64]

FIRST, SECOND = "r1", "r2"
TINY = 1e-10


def settings(robot: str, mean: Array, cov: Array, *, horizon_s: float = 60.0, timeout_s: float = 2.0) -> AgentSettings:
    """Published form with analytic Jacobians: every contact is used."""
    return AgentSettings(
        robot=robot,
        start_ns=0,
        mean=mean,
        cov=cov,
        localization=LocalizationSettings(
            form="published",
            transform="jacobian",
            pair_interval_ns=0,
            pair_timeout_ns=int(timeout_s * NS),
            restart_interval_ns=0,
        ),
        lateness=LatenessSettings(horizon_ns=int(horizon_s * NS)),
        track=False,
    )


def sends(effects: list[Effect]) -> list[Send]:
    return [effect for effect in effects if isinstance(effect, Send)]


@dataclass(frozen=True, slots=True)
class Letter:
    """A message on its way."""

    source: str
    destination: str
    t_meas_ns: int
    body: Any
    life: int = 1


class Pair:
    """Agents `r1` and `r2`; letters are handed over by the test."""

    def __init__(self, starts: dict[str, tuple[Array, Array]], **options: float) -> None:
        self.agents = {name: Agent(settings(name, *start, **options)) for name, start in starts.items()}
        self.now_ns = 0
        self.lives = {FIRST: 1, SECOND: 1}
        self.files: dict[str, bytes] = {}
        """What each robot had kept last."""
        self._seq = 0

    def odometry(self, robot: str, t0_ns: int, t_ns: int, delta: Array, cov: Array) -> list[Letter]:
        self.now_ns = max(self.now_ns, t_ns)
        return self._letters(robot, self.agents[robot].handle(Odometry(self.now_ns, t0_ns, t_ns, delta, cov)))

    def measure(self, robot: str, t_ns: int, kind: str, z: Array, R: Array) -> list[Letter]:
        other = SECOND if robot == FIRST else FIRST
        event = Observation(self.now_ns, t_ns, kind, other, z, R, "sensor")
        return self._letters(robot, self.agents[robot].handle(event))

    def deliver(self, letter: Letter) -> list[Letter]:
        """Hand a letter over; returns what it leads to."""
        self._seq += 1
        life = self.lives[letter.source]
        header = Header(letter.source, life, life, self._seq, letter.t_meas_ns, self.now_ns)
        event = Received(self.now_ns, Message(header, letter.body))
        return self._letters(letter.destination, self.agents[letter.destination].handle(event))

    def converse(self, letters: list[Letter]) -> None:
        """Deliver everything at once, and what follows from it."""
        while letters:
            letters = [more for letter in letters for more in self.deliver(letter)]

    def tell_life(self, about: str, to: str) -> None:
        """What the endpoint reports before the first message of a life."""
        life = self.lives[about]
        self.agents[to].handle(LinkChange(self.now_ns, about, True, life, life))

    def _letters(self, robot: str, effects: list[Effect]) -> list[Letter]:
        for effect in effects:
            if isinstance(effect, Persist):
                self.files[robot] = effect.payload
        return [Letter(robot, item.peer, item.t_meas_ns, item.body, self.lives[robot]) for item in sends(effects)]

    def cross(self) -> Array | None:
        """P_12 as the next contact would recover it."""
        return resolve_cross(self.agents[FIRST].filter.snapshot(SECOND), self.agents[SECOND].filter.snapshot(FIRST))


class Ledger:
    """Errors of both robots as coefficients (3, m) over independent unit noises."""

    def __init__(self, starts: dict[str, tuple[Array, Array]]) -> None:
        self.error = {name: np.zeros((3, 0)) for name in starts}
        self._at: dict[tuple[str, int], Array] = {}
        self._noise: dict[Epoch, tuple[int, Array]] = {}
        for name, (_, cov) in starts.items():
            self._add(name, np.linalg.cholesky(cov))

    def begin_anew(self, robot: str, cov: Array) -> None:
        """The error of `robot` is an independent one from now on."""
        self.error[robot] = np.zeros_like(self.error[robot])
        self._add(robot, np.linalg.cholesky(cov))

    def _columns(self, count: int) -> None:
        for name, rows in self.error.items():
            self.error[name] = np.hstack([rows, np.zeros((3, count))])

    def _add(self, robot: str, root: Array) -> None:
        self._columns(root.shape[1])
        self.error[robot][:, -root.shape[1] :] += root

    def moved(self, robot: str, heading: float, delta: Array, cov: Array) -> None:
        """Odometry, as the Jacobian transform sees it."""
        cos, sin = np.cos(heading), np.sin(heading)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        step = turn[:2, :2] @ delta[:2]
        F = np.array([[1.0, 0.0, -step[1]], [0.0, 1.0, step[0]], [0.0, 0.0, 1.0]])
        self.error[robot] = F @ self.error[robot]
        self._add(robot, turn @ np.diag(np.sqrt(np.diagonal(cov)[[0, 1, 3]])))

    def mark(self, t_ns: int) -> None:
        """Remember both errors at an instant a contact will refer to."""
        for name in self.error:
            self.mark_one(name, t_ns)

    def mark_one(self, robot: str, t_ns: int) -> None:
        """Remember the error of one robot."""
        self._at[robot, t_ns] = self.error[robot].copy()

    def at(self, robot: str, t_ns: int) -> Array:
        """The error at a marked instant, over the noises known now."""
        return self._padded(self._at[robot, t_ns])

    def _padded(self, rows: Array) -> Array:
        return np.hstack([rows, np.zeros((3, self.error[FIRST].shape[1] - rows.shape[1]))])

    def applied(self, robot: str, request: PairRequest, K: Array, H_i: Array, H_j: Array, R: Array) -> None:
        """`robot` used a contact with gain K (3, m): e <- e - K (H_i e_i(k) + H_j e_j(k) + v)."""
        epoch = request.epoch
        if epoch not in self._noise:
            first = self.error[FIRST].shape[1]
            self._columns(len(R))
            self._noise[epoch] = (first, np.linalg.cholesky(R))
        start, root = self._noise[epoch]
        responder = SECOND if epoch.initiator == FIRST else FIRST
        innovation = H_i @ self.at(epoch.initiator, epoch.t_meas_ns)
        innovation = innovation + H_j @ self.at(responder, epoch.t_meas_ns)
        innovation[:, start : start + len(R)] += root
        self.error[robot] = self.error[robot] - K @ innovation

    def cov(self, first: str, second: str) -> Array:
        return np.asarray(self.error[first] @ self.error[second].T)


def gains_of(
    request: PairRequest, reply: PairReply, psi: Array, own_initiated: bool, cross: Array
) -> tuple[Array, ...]:
    """(K, H_i, H_j, R) of a contact from both snapshots, written down independently of the product code."""
    assert reply.snapshot is not None
    (item,) = request.measurements
    i, j = request.snapshot.belief, reply.snapshot.belief
    H = RelativeModel(item.kind, UNICYCLE).jacobian(np.concatenate([i.mean, j.mean]))
    joint = np.block([[i.cov, cross], [cross.T, j.cov]])
    S = H @ joint @ H.T + item.R
    C = joint @ H.T
    own = C[:3] if own_initiated else C[3:]
    return gain(psi @ own, S), H[:, :3], H[:, 3:], item.R
