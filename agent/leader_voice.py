"""What a leader tells: where it was at each instant of a round, to everybody, or at the instant a follower asks for."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.course import Course
from agent.effects import Broadcast, Effect
from agent.leader_words import Word, interpolated
from agent.rounds import RoundClock
from agent.settings import AgentSettings
from network.leader_messages import LeaderReport
from network.messages import Channel

Array = NDArray[np.float64]

MAX_VELOCITIES = 4096


class LeaderVoice:
    """The leader's part of the kind `leader`; `course` is its own past."""

    def __init__(self, settings: AgentSettings, course: Course, counters: Counter[str]) -> None:
        self._settings, self._course, self._counters = settings, course, counters
        self._clock = RoundClock(settings.round, course.newest.t_ns)
        self._velocities: deque[tuple[int, Array]] = deque(maxlen=MAX_VELOCITIES)
        self._told_ns: int | None = None

    def moved(self, t_ns: int, velocity: Array) -> None:
        """The velocity (2,) [m/s], ENU, that has led to `t_ns`."""
        while self._velocities and self._velocities[-1][0] >= t_ns:
            # A rewind leads through the same instants again.
            self._velocities.pop()
        self._velocities.append((t_ns, velocity))

    def deadline_ns(self) -> int | None:
        """When the next report is due, as far as odometry goes already."""
        lateness, next_ns = self._settings.lateness, self._clock.next_ns
        reached = self._course.newest.t_ns >= next_ns - lateness.tolerance_ns
        return next_ns + lateness.settle_ns if reached else None

    def tell(self, until_ns: int, effects: list[Effect]) -> None:
        """The report of the newest round that is due, if there is one."""
        due_ns = self._clock.due(until_ns)
        if due_ns is None:
            return
        self._counters["leader.skipped"] += self._clock.leave_out(due_ns)
        if self._course.newest.t_ns < due_ns - self._settings.lateness.tolerance_ns:
            return
        self._clock.open(due_ns)
        word = self.at(due_ns)
        if word is None:
            self._counters["leader.skipped"] += 1
            return
        report = LeaderReport(word.place, word.cov, word.velocity, self._told_ns)
        self._told_ns = due_ns
        self._counters["leader.told"] += 1
        effects.append(Broadcast(Channel.BELIEF, due_ns, report))

    def answer(self, t_ns: int, number: int, clock_sigma_s: float) -> LeaderReport | None:
        """Where the robot was at `t_ns`, which is only known so well; None if that has been forgotten."""
        word = self.at(t_ns)
        if word is None:
            self._counters["leader.too_old"] += 1
            return None
        self._counters["leader.answered"] += 1
        cov = word.cov + clock_sigma_s**2 * np.outer(word.velocity, word.velocity)
        return LeaderReport(word.place, cov, word.velocity, None, number)

    def at(self, t_ns: int) -> Word | None:
        """Where the robot was at an instant; None outside its past."""
        tolerance = self._settings.lateness.tolerance_ns
        before = self._course.at(t_ns)
        if before is None:
            return None
        first = Word(before.t_ns, before.mean[:2], before.cov[:2, :2], self._velocity(before.t_ns))
        if t_ns - before.t_ns <= tolerance:
            return replace(first, t_ns=t_ns)
        after = self._course.next_after(before.t_ns)
        if after is None:
            return None
        second = Word(after.t_ns, after.mean[:2], after.cov[:2, :2], self._velocity(after.t_ns))
        return interpolated(first, second, t_ns)

    def _velocity(self, t_ns: int) -> Array:
        return next((found for at_ns, found in reversed(self._velocities) if at_ns <= t_ns), np.zeros(2))
