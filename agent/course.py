"""The past of one Gaussian belief over a bounded horizon: what it was at each instant, and how its error moved since.

An entry is made whenever the instant advances. Information that comes late is used at the instant it belongs to, and
all later beliefs follow: with e_l = Psi e_k + (noise since k) they are shifted by Psi (m_k+ - m_k), and their
covariance changes by Psi (P_k+ - P_k) Psi^T. That is exact for a linear model while nothing else is learnt in between.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, identity, is_positive_definite, symmetrize, wrap_components
from agent.estimation.unscented import Propagated

Array = NDArray[np.float64]

MAX_ENTRIES = 4096


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """A belief, mean (n,) and cov (n, n), at an instant."""

    t_ns: int
    mean: Array
    cov: Array


@dataclass(slots=True, eq=False)
class _Entry:
    """A belief, the left factor of the motion that led to it, and that of updates at its instant since."""

    moment: Moment
    F: Array
    after: Array


@dataclass(frozen=True, slots=True, eq=False)
class CourseMark:
    """A newest belief, the left factor of the motion that led to it, and that of updates at its instant."""

    moment: Moment
    F: Array
    after: Array


class Course:
    """A ring of beliefs; `angles` are the components that wrap."""

    def __init__(self, first: Moment, angles: tuple[int, ...], horizon_ns: int, tolerance_ns: int) -> None:
        self._angles, self._horizon_ns, self._tolerance_ns = angles, horizon_ns, tolerance_ns
        unit = identity(len(first.mean))
        self._entries = [_Entry(first, unit, unit)]
        self._stamps = [first.t_ns]

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def newest(self) -> Moment:
        return self._entries[-1].moment

    def advance(self, t_ns: int, moved: Propagated) -> None:
        """The newest belief, moved to the later instant `t_ns`."""
        self._entries.append(_Entry(Moment(t_ns, moved.mean, moved.cov), moved.F, identity(len(moved.mean))))
        self._stamps.append(t_ns)
        oldest, surplus = t_ns - self._horizon_ns, 0
        while surplus < len(self._stamps) - 1 and (
            self._stamps[surplus + 1] <= oldest or len(self._stamps) - surplus > MAX_ENTRIES
        ):
            surplus += 1
        if surplus:
            del self._entries[:surplus], self._stamps[:surplus]

    def mark(self) -> CourseMark:
        """The newest belief as it is."""
        entry = self._entries[-1]
        return CourseMark(entry.moment, entry.F, entry.after)

    def rewind(self, mark: CourseMark) -> None:
        """Forget what came after a mark, before whose instant nothing was changed since."""
        index = bisect_left(self._stamps, mark.moment.t_ns)
        del self._entries[index + 1 :], self._stamps[index + 1 :]
        self._entries[index] = _Entry(mark.moment, mark.F, mark.after)

    def next_after(self, t_ns: int) -> Moment | None:
        """The belief of the oldest instant that is later than `t_ns`; None if there is none."""
        index = bisect_right(self._stamps, t_ns)
        return self._entries[index].moment if index < len(self._entries) else None

    def at(self, t_ns: int) -> Moment | None:
        """The belief of the newest instant that is not later than `t_ns`; None if that has been forgotten."""
        index = bisect_right(self._stamps, t_ns + self._tolerance_ns) - 1
        return None if index < 0 else self._entries[index].moment

    def begin_anew(self, mean: Array, cov: Array) -> None:
        """The newest belief is mean (n,), cov (n, n) by other information, and nothing before it tells more."""
        unit = identity(len(mean))
        self._entries[-1] = _Entry(Moment(self.newest.t_ns, mean, cov), np.zeros_like(unit), unit)

    def correct(self, before: Moment, mean: Array, cov: Array) -> bool:
        """Have mean (n,), cov (n, n) take the place of `before`, and all later beliefs follow.

        False, and no change, if `before` is none of the ring's, or a covariance would not stay positive definite.
        """
        first = bisect_left(self._stamps, before.t_ns)
        if first == len(self._stamps) or self._entries[first].moment is not before:
            return False
        shift = wrap_components(mean - before.mean, self._angles)
        gained = cov - before.cov
        changed = [Moment(before.t_ns, mean, cov)]
        psi = identity(len(mean))
        for entry in self._entries[first + 1 :]:
            psi = entry.after @ (entry.F @ psi)
            then = entry.moment
            later = symmetrize(then.cov + psi @ gained @ psi.T)
            changed.append(Moment(then.t_ns, wrap_components(then.mean + psi @ shift, self._angles), later))
        if not all(is_positive_definite(moment.cov) for moment in changed):
            return False
        for entry, moment in zip(self._entries[first:], changed):
            entry.moment = moment
        entry = self._entries[first]
        entry.after = gain(cov, before.cov) @ entry.after
        return True
