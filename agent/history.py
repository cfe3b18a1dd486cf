"""The past of one robot over a bounded horizon: its state at an instant, and how that error moved since.

An entry is made whenever the state's instant advances, and holds the last state at that instant. Since the
own error obeys e_now = Psi e_k + (noise since k), Psi is the product of left factors after k: of each
entry's prediction F and of all updates applied while it was the newest.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.belief import RobotState, TargetState
from agent.estimation.motion import advance, split_increment
from agent.settings import AgentSettings

Array = NDArray[np.float64]

MAX_ENTRIES = 4096


@dataclass(slots=True, eq=False)
class Entry:
    """A state, the increment (4,) with covariance (4, 4) and left factor F that led to it, updates since."""

    state: RobotState
    delta: Array
    delta_cov: Array
    F: Array
    after: Array


def moved(
    settings: AgentSettings, state: RobotState, t_ns: int, delta: Array, cov: Array
) -> tuple[RobotState, Array]:
    """State and targets predicted to `t_ns` with an odometry increment; returns (state, F (n, n))."""
    localization = settings.localization
    own = advance(state.mean, state.cov, delta, cov, localization.transform, localization.parameters)
    targets = {}
    dt_s = (t_ns - state.t_ns) * 1e-9
    for target in settings.targets:
        belief = state.targets.get(target.id)
        if belief is not None:
            drifted = target.motion.drift(belief.mean, belief.cov, dt_s, localization.transform)
            targets[target.id] = TargetState(drifted.mean, drifted.cov)
    return (
        replace(state, t_ns=t_ns, mean=own.mean, cov=own.cov, stack=state.stack.left(own.F), targets=targets),
        own.F,
    )


class History:
    """Ring of entries over `settings.lateness.horizon_ns`."""

    def __init__(self, settings: AgentSettings, state: RobotState) -> None:
        self._settings = settings
        self._stamps: list[int] = [state.t_ns]
        identity = np.eye(len(state.mean))
        self._entries = [Entry(state, np.zeros(4), np.zeros((4, 4)), identity, identity)]

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def oldest_ns(self) -> int:
        return self._stamps[0]

    def advanced(self, state: RobotState, delta: Array, delta_cov: Array, F: Array) -> None:
        """The newest state has moved to a later instant."""
        self._entries.append(Entry(state, delta, delta_cov, F, np.eye(len(state.mean))))
        self._stamps.append(state.t_ns)
        oldest = state.t_ns - self._settings.lateness.horizon_ns
        surplus = 0
        while surplus < len(self._stamps) - 1 and (
            self._stamps[surplus + 1] <= oldest or len(self._stamps) - surplus > MAX_ENTRIES
        ):
            surplus += 1
        if surplus:
            del self._entries[:surplus], self._stamps[:surplus]

    def updated(self, state: RobotState, left: Array | None = None) -> None:
        """The newest state was changed at its instant by an update with left factor `left` (None: identity)."""
        entry = self._entries[-1]
        entry.state = state
        if left is not None:
            entry.after = left @ entry.after

    def at(self, t_ns: int) -> tuple[RobotState, Array] | None:
        """(state at `t_ns`, Psi (n, n) from then to now); None outside the ring.

        Between two entries the increment that led to the later one is cut at `t_ns`.
        """
        tolerance = self._settings.lateness.tolerance_ns
        index = bisect_right(self._stamps, t_ns + tolerance) - 1
        if index < 0 or t_ns > self._stamps[-1] + tolerance:
            return None
        entry = self._entries[index]
        psi = np.eye(len(entry.state.mean))
        if t_ns - self._stamps[index] <= tolerance or index + 1 == len(self._entries):
            return entry.state, self._since(index + 1, psi)
        following = self._entries[index + 1]
        span = self._stamps[index + 1] - self._stamps[index]
        first, first_cov, second, second_cov = split_increment(
            following.delta, following.delta_cov, (t_ns - self._stamps[index]) / span
        )
        state, _ = moved(self._settings, entry.state, t_ns, first, first_cov)
        localization = self._settings.localization
        rest = advance(state.mean, state.cov, second, second_cov, localization.transform, localization.parameters)
        return state, self._since(index + 2, following.after @ rest.F)

    def _since(self, index: int, psi: Array) -> Array:
        for entry in self._entries[index:]:
            psi = entry.after @ (entry.F @ psi)
        return psi
