"""A team that works by rounds, in a world of its own and without a network: everything told is heard at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Broadcast, Steer
from agent.estimation.gaussian import wrap
from agent.estimation.motion import UNICYCLE, TargetMotion, compose
from agent.events import Event, LinkChange, Observation, Odometry, Received, Tick
from agent.settings import (
    AgentSettings,
    LatenessSettings,
    LocalizationSettings,
    PlanningSettings,
    RoundSettings,
    TargetSettings,
)
from network.messages import Header, Message, RoundStage

Array = NDArray[np.float64]

NS = 1_000_000_000
SPEED_SHARE, TURN_PER_M = 0.5**0.5 * 0.01, 8**0.5 * 0.01
TARGET_SPEED = 0.25
SIGMA_START = np.array([0.1, 0.1, 0.01])
SIGMA_TARGET = np.array([5.0, 5.0, 1.0])

JLATT = LocalizationSettings(kind="jlatt", weights="trace", transform="jacobian")
POTENTIAL = PlanningSettings(kind="potential", form="published")
ROUND = RoundSettings()
LATENESS = LatenessSettings(horizon_ns=10 * NS)

Carry = Callable[[int, str, str, RoundStage, int], int | None]
"""Rounds of delay of what the first robot tells the second in a round, or None: lost."""


def at_once(k: int, source: str, destination: str, stage: RoundStage, index: int) -> int | None:
    return 0


@dataclass
class Team:
    """Robots of Su 2022, chapter 4, and the errors they make: arrays (steps, robots, ...)."""

    seed: int
    localization: LocalizationSettings = JLATT
    planning: PlanningSettings = POTENTIAL
    round: RoundSettings = ROUND
    lateness: LatenessSettings = LATENESS
    robots: int = 6
    carry: Carry = at_once
    agents: dict[str, Agent] = field(default_factory=dict)
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))
    history: list[Array] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    nees: list[Array] = field(default_factory=list)
    target_errors: list[Array] = field(default_factory=list)
    target_nees: list[Array] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        rng = self.rng
        grid = np.array([(x, y) for x in (-6.0, 2.0) for y in (-3.0, 5.0, 13.0)])[: self.robots]
        turned = rng.uniform(-np.pi / 3, np.pi / 3, len(grid))
        self.poses = np.column_stack([grid + rng.uniform(-0.5, 0.5, grid.shape), turned])
        self.target = np.array([10.0, 5.0, 0.0])
        self.names = [f"r{k + 1}" for k in range(len(grid))]
        told = self.target + SIGMA_TARGET * rng.normal(size=3)
        motion = TargetMotion(UNICYCLE, (TARGET_SPEED, 0.0), (0.5**0.5 * 0.03 * 0.25, 8**0.5 * 0.03 * 0.25))
        prior = TargetSettings("t1", motion, told, np.diag(SIGMA_TARGET**2))
        for name, pose in zip(self.names, self.poses):
            self.agents[name] = Agent(
                AgentSettings(
                    name,
                    0,
                    pose + SIGMA_START * rng.normal(size=3),
                    np.diag(SIGMA_START**2),
                    targets=(prior,),
                    localization=self.localization,
                    planning=self.planning,
                    round=self.round,
                    lateness=self.lateness,
                )
            )
        self.commands = dict.fromkeys(self.names, (0.0, 0.0))
        self.seq = 0
        self.waiting: list[tuple[int, str, Received]] = []
        for name in self.names:
            for peer in self.names:
                if peer != name:
                    self.hand(0, name, LinkChange(0, peer, True, 1, 1))

    def hand(self, k: int, name: str, event: Event) -> None:
        """Give a robot an event, and carry out what follows."""
        for effect in self.agents[name].handle(event):
            if isinstance(effect, Steer):
                self.commands[name] = effect.velocity_mps[0], effect.yaw_rate_radps
            elif isinstance(effect, Broadcast):
                self._broadcast(k, name, event.t_ns, effect)

    def _broadcast(self, k: int, name: str, t_ns: int, effect: Broadcast) -> None:
        self.seq += 1
        message = Message(Header(name, 1, 1, self.seq, effect.t_meas_ns, t_ns), effect.body)
        for peer in self.names:
            if peer == name:
                continue
            stage = effect.body.stage
            delay = self.carry(k, name, peer, stage, self.seq)
            if delay == 0:
                self.hand(k, peer, Received(t_ns, message))
            elif delay is not None:
                self.waiting.append((k + delay, peer, Received(t_ns, message)))

    def run(self, steps: int) -> Team:
        for k in range(1, steps + 1):
            self.step(k)
        return self

    def step(self, k: int) -> None:
        rng, t_ns = self.rng, k * NS
        increments = np.zeros((len(self.names), 4))
        for index, name in enumerate(self.names):
            v, w = self.commands[name]
            increments[index] = [v, 0.0, 0.0, w]
            noisy = np.array([v * (1.0 + SPEED_SHARE * rng.normal()), 0.0, w + TURN_PER_M * v * rng.normal()])
            self.poses[index] = compose(self.poses[index], noisy)
        self.poses[:, 2] = wrap(self.poses[:, 2])
        v, w = TARGET_SPEED + 0.0053 * rng.normal(), 0.0212 * rng.normal()
        self.target = compose(self.target, np.array([v, 0.0, w]))
        for item in [item for item in self.waiting if item[0] <= k]:
            self.waiting.remove(item)
            self.hand(k, item[1], replace(item[2], t_ns=t_ns))
        for index, name in enumerate(self.names):
            v = increments[index][0]
            cov = np.diag([(SPEED_SHARE * v) ** 2, 0.0, 0.0, (TURN_PER_M * v) ** 2])
            self.hand(k, name, Odometry(t_ns, t_ns - NS, t_ns, increments[index], cov))
        self.seen.append(0)
        for index, name in enumerate(self.names):
            self._look(k, index, name)
        for name in self.names:
            self.hand(k, name, Tick(t_ns))
        for name in self.names:
            self.hand(k, name, Tick(t_ns + 2 * self.round.wait_ns + 1))
        self._judge()

    def _look(self, k: int, index: int, name: str) -> None:
        rng, pose = self.rng, self.poses[index]
        for of, place in [*zip(self.names, self.poses), ("target:t1", self.target)]:
            if of == name:
                continue
            d = place[:2] - pose[:2]
            r, bearing = float(np.hypot(*d)), float(wrap(np.arctan2(d[1], d[0]) - pose[2]))
            if not 2.0 <= r <= 15.0 or abs(bearing) > np.pi / 6.0:
                continue
            self.seen[-1] += of == "target:t1"
            sigma = np.array([0.03 * r, np.pi / 180.0])
            z = np.array([r, bearing]) + sigma * rng.normal(size=2)
            sigma[0] = 0.03 * z[0]
            self.hand(k, name, Observation(k * NS, k * NS, "range_bearing", of, z, np.diag(sigma**2), "camera"))

    def _judge(self) -> None:
        own, own_nees, seen, seen_nees = [], [], [], []
        for pose, agent in zip(self.poses, self.agents.values()):
            estimate = agent.estimate()
            assert estimate is not None
            e = estimate.mean - pose
            e[2] = wrap(e[2])
            own.append(e)
            own_nees.append(e @ np.linalg.solve(estimate.cov, e) / 3.0)
            track = estimate.tracks[0]
            e = track.mean - self.target
            e[2] = wrap(e[2])
            seen.append(e)
            seen_nees.append(e @ np.linalg.solve(track.cov, e) / 3.0)
        self.history.append(self.poses.copy())
        self.errors.append(np.array(own))
        self.nees.append(np.array(own_nees))
        self.target_errors.append(np.array(seen))
        self.target_nees.append(np.array(seen_nees))

    def rmse(self) -> tuple[float, float]:
        """Of the target's and the robots' places over time [m]."""
        of_target, own = (np.array(e)[..., :2] for e in (self.target_errors, self.errors))
        return float(np.sqrt(np.mean(np.sum(of_target**2, -1)))), float(np.sqrt(np.mean(np.sum(own**2, -1))))
