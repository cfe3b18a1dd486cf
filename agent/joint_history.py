"""The past of one robot's joint state over a bounded horizon, replayed when something is learnt late.

An entry is made whenever the instant advances: the increment that led to it and what was learnt at it, as functions of
the state. Late information is used at the instant it belongs to, and all that came after it is done again.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import split_increment
from agent.joint_state import JointModel
from agent.joint_tracks import JointState
from agent.settings import LatenessSettings

Array = NDArray[np.float64]

Learnt = Callable[[JointState], JointState]
"""What some information makes of the state at its instant; may raise `numpy.linalg.LinAlgError`."""

MAX_ENTRIES = 4096


@dataclass(slots=True, eq=False)
class Entry:
    """The state after all that was `learnt` at its instant, and the increment (4,), (4, 4) that led to the instant."""

    state: JointState
    delta: Array
    delta_cov: Array
    learnt: list[Learnt] = field(default_factory=list)


class JointHistory:
    """Ring of entries over the horizon."""

    def __init__(
        self, model: JointModel, lateness: LatenessSettings, state: JointState, counters: Counter[str]
    ) -> None:
        self._model, self._lateness, self._counters = model, lateness, counters
        self._stamps = [state.t_ns]
        self._entries = [Entry(state, np.zeros(4), np.zeros((4, 4)))]

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def newest(self) -> JointState:
        return self._entries[-1].state

    @property
    def oldest_ns(self) -> int:
        return self._stamps[0]

    def advance(self, t_ns: int, delta: Array, delta_cov: Array) -> None:
        """Move the newest state to the later instant `t_ns` by an odometry increment."""
        state = self._model.moved(self.newest, t_ns, delta, delta_cov)
        self._entries.append(Entry(state, delta, delta_cov))
        self._stamps.append(t_ns)
        self._trim()

    def _trim(self) -> None:
        oldest = self._stamps[-1] - self._lateness.horizon_ns
        surplus = 0
        while surplus < len(self._stamps) - 1 and (
            self._stamps[surplus + 1] <= oldest or len(self._stamps) - surplus > MAX_ENTRIES
        ):
            surplus += 1
        if surplus:
            del self._entries[:surplus], self._stamps[:surplus]

    def mark(self) -> tuple[JointState, int]:
        """The newest state, and how much was learnt at its instant."""
        return self.newest, len(self._entries[-1].learnt)

    def rewind(self, mark: tuple[JointState, int]) -> None:
        """Forget what came after a mark, before whose instant nothing was changed since."""
        state, count = mark
        index = bisect_left(self._stamps, state.t_ns)
        del self._entries[index + 1 :], self._stamps[index + 1 :]
        entry = self._entries[index]
        entry.state = state
        del entry.learnt[count:]

    def at(self, t_ns: int) -> JointState | None:
        """The state at `t_ns`, which is an entry's instant from now on; None outside the horizon.

        An instant within the tolerance of an entry's, or after the newest, counts as that.
        """
        tolerance = self._lateness.tolerance_ns
        index = bisect_right(self._stamps, t_ns + tolerance) - 1
        if index < 0 or t_ns < self._stamps[-1] - self._lateness.horizon_ns:
            return None
        entry = self._entries[index]
        if t_ns - self._stamps[index] <= tolerance or index + 1 == len(self._entries):
            return entry.state
        following = self._entries[index + 1]
        share = (t_ns - self._stamps[index]) / (self._stamps[index + 1] - self._stamps[index])
        first, first_cov, second, second_cov = split_increment(following.delta, following.delta_cov, share)
        state = self._model.moved(entry.state, t_ns, first, first_cov)
        following.delta, following.delta_cov = second, second_cov
        self._entries.insert(index + 1, Entry(state, first, first_cov))
        self._stamps.insert(index + 1, t_ns)
        return state

    def learn(self, state: JointState, learnt: Learnt) -> None:
        """At the instant of `state`, an entry's, `learnt` has led to `state`: keep it, and do what came later again."""
        index = bisect_right(self._stamps, state.t_ns) - 1
        entry = self._entries[index]
        entry.state = state
        entry.learnt.append(learnt)
        for following, t_ns in zip(self._entries[index + 1 :], self._stamps[index + 1 :]):
            state = self._model.moved(state, t_ns, following.delta, following.delta_cov)
            for again in following.learnt:
                try:
                    state = again(state)
                except np.linalg.LinAlgError:
                    self._counters["update.failed_again"] += 1
            following.state = state
