"""The past of one robot over a bounded horizon: its state at an instant, and how that error moved since.

An entry is made whenever the state's instant advances, and holds the last state at that instant. Since the
own error obeys e_now = Psi e_k + (noise since k), Psi is the product of left factors after k: of each
entry's prediction F and of all updates applied while it was the newest.

Own data that come late, and contacts that are completed late, are used at the instant they belong to, and all later
states follow: with the gain K at k every later error becomes e_l - Psi_kl K nu. Any number of them may overlap, since
each finds the past as the ones before have left it. (A gain applied to the newest state alone, Psi K, is exact for one
measurement under way and unstable for many: each of them corrects the same error of the past again.)
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.belief import BlockKey, CorrelationStack, Part, RobotState, Transition
from agent.estimation.colocalization import Update
from agent.estimation.gaussian import gain, is_positive_definite, symmetrize, wrap_components
from agent.estimation.motion import split_increment
from agent.factor_model import FactorModel
from agent.settings import AgentSettings
from network.messages import Epoch

Array = NDArray[np.float64]

MAX_ENTRIES = 4096


@dataclass(slots=True, eq=False)
class Entry:
    """A state, the increment (4,) with covariance (4, 4) and the step that led to it, left factors of updates since."""

    state: RobotState
    delta: Array
    delta_cov: Array
    step: Transition
    after: Array


@dataclass(frozen=True, slots=True, eq=False)
class HistoryMark:
    """State and left factor of an entry when it was the newest."""

    state: RobotState
    after: Array


class History:
    """Ring of entries over `settings.lateness.horizon_ns`."""

    def __init__(self, settings: AgentSettings, model: FactorModel, state: RobotState) -> None:
        self._settings, self._model = settings, model
        self._stamps: list[int] = [state.t_ns]
        identity = np.eye(len(state.mean))
        self._entries = [Entry(state, np.zeros(4), np.zeros((4, 4)), Transition(identity), identity)]

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def oldest_ns(self) -> int:
        return self._stamps[0]

    def advance(self, state: RobotState, t_ns: int, delta: Array, delta_cov: Array) -> RobotState:
        """Move the newest state, `state`, to the later instant `t_ns` by an odometry increment; returns it."""
        state, step = self._model.moved(state, t_ns, delta, delta_cov)
        self._entries.append(Entry(state, delta, delta_cov, step, np.eye(len(state.mean))))
        self._stamps.append(state.t_ns)
        self._trim()
        return state

    def _trim(self) -> None:
        oldest = self._stamps[-1] - self._settings.lateness.horizon_ns
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

    def mark(self) -> HistoryMark:
        """The newest entry as it is."""
        entry = self._entries[-1]
        return HistoryMark(entry.state, entry.after)

    def rewind(self, mark: HistoryMark) -> RobotState:
        """Forget what came after a mark, before whose instant nothing was changed since; returns the newest state."""
        index = bisect_left(self._stamps, mark.state.t_ns)
        del self._entries[index + 1 :], self._stamps[index + 1 :]
        entry = self._entries[index]
        entry.state, entry.after = mark.state, mark.after
        return mark.state

    def cut(self, t_ns: int) -> RobotState | None:
        """The state at a past instant `t_ns`, as an entry of its own from now on; None outside the ring.

        Between two entries the increment that led to the later one is cut at `t_ns`.
        """
        tolerance = self._settings.lateness.tolerance_ns
        index = bisect_right(self._stamps, t_ns + tolerance) - 1
        if index < 0 or t_ns > self._stamps[-1] + tolerance:
            return None
        entry = self._entries[index]
        if t_ns - self._stamps[index] <= tolerance or index + 1 == len(self._entries):
            return entry.state
        following = self._entries[index + 1]
        share = (t_ns - self._stamps[index]) / (self._stamps[index + 1] - self._stamps[index])
        first, first_cov, second, second_cov = split_increment(following.delta, following.delta_cov, share)
        state, step = self._model.moved(entry.state, t_ns, first, first_cov)
        _, rest = self._model.moved(state, self._stamps[index + 1], second, second_cov)
        following.delta, following.delta_cov, following.step = second, second_cov, rest
        self._entries.insert(index + 1, Entry(state, first, first_cov, step, np.eye(len(state.mean))))
        self._stamps.insert(index + 1, t_ns)
        self._trim()
        return state

    def opened(self, t_ns: int, peer: str, epoch: Epoch) -> RobotState:
        """Open a contact's identity line at `t_ns`, an entry's instant, in all states since; returns the newest."""
        first = bisect_left(self._stamps, t_ns)
        n = len(self._entries[first].state.mean)
        line = np.eye(n, n + self._model.noise_columns)
        for index, entry in enumerate(self._entries[first:]):
            if index:
                line = entry.after @ entry.step.of_line(line)
            entry.state = entry.state.with_line(peer, epoch, line, self._settings.localization.max_lines)
        return self._entries[-1].state

    def first_with(self, key: BlockKey) -> RobotState | None:
        """The earliest of the newest states that have a block of correlation; None if the newest has none."""
        found = None
        for entry in reversed(self._entries):
            if key not in entry.state.stack.blocks:
                break
            found = entry.state
        return found

    def corrected(
        self, t_ns: int, update: Update, base: tuple[str, Epoch, Array] | None = None
    ) -> RobotState | None:
        """Use late information: `update` of the state at `t_ns`, which is an entry's instant (see `cut`).

        That state and all later ones are corrected, P_l -= Psi (P_k - P_k+) Psi^T, as are the correlations, and the
        newest is returned. This is the in-order result of a linear model if no other update lies in between; otherwise
        the gains in between are no longer the best ones, and the covariances are those of the errors with these gains.
        A contact that is applied besides becomes its pair's `base`: (peer, epoch, P_ij after it); its line is what was
        kept for it so far, without the update. None, and no change, if a covariance would not stay positive definite.
        """
        first = bisect_left(self._stamps, t_ns)
        before = self._entries[first].state
        shift = wrap_components(update.mean - before.mean, self._model.layout.angles)
        lost = before.cov - update.cov
        states = [_based(before, before.updated(update.mean, update.cov, update.left), base)]
        later = self._entries[first + 1 :]
        correction = _StackCorrection(before, update.left) if later else None
        psi = np.eye(len(before.mean))
        for entry in later:
            psi = entry.after @ (entry.step.F @ psi)
            state = entry.state
            mean = wrap_components(state.mean + psi @ shift, self._model.layout.angles)
            cov = symmetrize(state.cov - psi @ lost @ psi.T)
            if not is_positive_definite(cov):
                return None
            assert correction is not None
            corrected = replace(state, mean=mean, cov=cov, stack=correction.stack(state, psi))
            states.append(_based(state, corrected, base))
        for entry, state in zip(self._entries[first:], states):
            entry.state = state
        self._entries[first].after = update.left @ self._entries[first].after
        return states[-1]


def _based(before: RobotState, after: RobotState, base: tuple[str, Epoch, Array] | None) -> RobotState:
    """The state `after` a contact with the contact as its pair's base, its line from `before`."""
    if base is None:
        return after
    peer, epoch, cross = base
    line = before.stack.block((Part.LINE, peer, epoch))
    assert line is not None
    return after.with_base(peer, epoch, line[:, : len(cross)] @ cross, line)


class _StackCorrection:
    """What late information at k does to the correlations: X_l -= Psi_kl B X_k, B = 1 - P_k+ P_k^-1 = K H.

    A block that is younger than k, first found at p, is taken back by the smoother: X_k = P_k Psi_kp^T P_p^-1 X_p.
    """

    def __init__(self, before: RobotState, left: Array) -> None:
        self._cov = before.cov
        self._B = np.eye(len(left)) - left
        self._sources: dict[tuple[Part, str, Epoch], Array] = {}
        self._last: tuple[RobotState, Array] | None = None
        self.stack(before, np.eye(len(left)))

    def stack(self, state: RobotState, psi: Array) -> CorrelationStack:
        """The stack of a `state`, not corrected yet, that the error at k is mapped to by `psi`."""
        if not state.stack.blocks:
            return state.stack
        if self._last is None or (
            self._last[0].stack.blocks is not state.stack.blocks or self._last[0].pairs is not state.pairs
        ):
            back = self._B @ gain(self._cov @ psi.T, state.cov)
            parts = []
            for (part, peer, epoch), (a, b) in state.stack.blocks.items():
                # A factor and its line stand for the pair's base contact, whichever that is.
                name = (part, peer, epoch if part is Part.LINE else state.pair(peer).base)
                if name not in self._sources:
                    self._sources[name] = back @ state.stack.matrix[:, a:b]
                parts.append(self._sources[name])
            self._last = (state, np.concatenate(parts, axis=1))
        return CorrelationStack(state.stack.matrix - psi @ self._last[1], state.stack.blocks)
