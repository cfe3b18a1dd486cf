"""A leader's words as its followers keep them, and the measurements of the leader that wait for one.

A measurement of the instant s is completed by a word about s. A leader that tells everybody may do so at other
instants: then by the two words around s, if one came right before the other, so that which words complete it does not
depend on the order they arrive in. The place between them is on the straight line; how far off that may be follows from
how the leader's velocity changed.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.events import Completed
from agent.settings import NS, AgentSettings
from network.messages import Measurement

Array = NDArray[np.float64]

MAX_WORDS = 1024
MAX_WAITING = 256


@dataclass(frozen=True, slots=True, eq=False)
class Word:
    """Where a leader was at `t_ns`: place (2,), cov (2, 2), velocity (2,).

    stamp_ns, before_ns  the same instant and that of the word before it, on the leader's own clock
    """

    t_ns: int
    place: Array
    cov: Array
    velocity: Array
    stamp_ns: int = 0
    before_ns: int | None = None


def interpolated(first: Word, second: Word, t_ns: int) -> Word:
    """Where a leader was at `t_ns`, between two words of before and after it.

    The covariance is the mean of both, which bounds that of the mean place however their errors are correlated, and as
    much in each direction as a path that curves by the change of velocity may be off a straight one.
    """
    dt_s = (second.t_ns - first.t_ns) / NS
    share = (t_ns - first.t_ns) / (second.t_ns - first.t_ns)
    off = 0.5 * share * (1.0 - share) * dt_s * float(np.linalg.norm(second.velocity - first.velocity))
    return Word(
        t_ns,
        (1.0 - share) * first.place + share * second.place,
        (1.0 - share) * first.cov + share * second.cov + off**2 * np.eye(2),
        (1.0 - share) * first.velocity + share * second.velocity,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Waiting:
    """Measurements of the leader at one instant, and how long before it the leader was measured last (None: never)."""

    t_ns: int
    measurements: tuple[Measurement, ...]
    since_ns: int | None


class LeaderWords:
    """What waits, and what was told, within the horizon."""

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._words: list[Word] = []
        self._waiting: dict[int, Waiting] = {}
        self._last_ns: int | None = None
        self._since_ns: int | None = None
        self._cov: Array | None = None
        self._asked: dict[int, tuple[Waiting, int]] = {}
        self._count = 0

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What is kept, and the most there may be of it, by name."""
        return {
            "leader.words": (len(self._words), MAX_WORDS),
            "leader.waiting": (len(self._waiting) + len(self._asked), 2 * MAX_WAITING),
        }

    def _measured(self, t_ns: int, measurements: tuple[Measurement, ...]) -> Waiting:
        apart = None if self._last_ns is None else abs(t_ns - self._last_ns)
        self._last_ns = t_ns if self._last_ns is None else max(t_ns, self._last_ns)
        self._since_ns = apart
        return Waiting(t_ns, measurements, apart)

    # -- of a leader that tells everybody -------------------------------------------------------------------

    def measured(self, t_ns: int, measurements: tuple[Measurement, ...]) -> list[Completed]:
        """The leader is measured; what its words have completed by that."""
        if t_ns in self._waiting:
            self._counters["leader.repeated"] += 1
            return []
        waiting = self._measured(t_ns, measurements)
        found = self._complete(waiting)
        if not found:
            self._waiting[t_ns] = waiting
            if len(self._waiting) > MAX_WAITING:
                self._waiting.pop(next(iter(self._waiting)))
                self._counters["leader.unanswered"] += 1
        return found

    def told(self, word: Word) -> list[Completed]:
        """A word to everybody; what it completes. One that is known already is nothing new."""
        index = bisect_left(self._words, word.stamp_ns, key=_stamp)
        if index < len(self._words) and self._words[index].stamp_ns == word.stamp_ns:
            self._counters["leader.known"] += 1
            return []
        insort(self._words, word, key=_stamp)
        if len(self._words) > MAX_WORDS:
            del self._words[0]
        found: list[Completed] = []
        for t_ns in sorted(self._waiting):
            done = self._complete(self._waiting[t_ns])
            if done:
                del self._waiting[t_ns]
                found += done
        return found

    def _complete(self, waiting: Waiting) -> list[Completed]:
        tolerance, t_ns = self._settings.lateness.tolerance_ns, waiting.t_ns
        near = [word for word in self._words if abs(word.t_ns - t_ns) <= tolerance]
        if near:
            word = min(near, key=lambda item: (abs(item.t_ns - t_ns), item.stamp_ns))
            return self._completed(waiting, word, 0)
        index = next((k for k, word in enumerate(self._words) if word.t_ns > t_ns), 0)
        if index == 0:
            return []
        before, after = self._words[index - 1], self._words[index]
        if after.before_ns != before.stamp_ns or not before.t_ns < t_ns < after.t_ns:
            return []
        return self._completed(waiting, interpolated(before, after, t_ns), after.t_ns - before.t_ns)

    def _completed(self, waiting: Waiting, word: Word, gap_ns: int) -> list[Completed]:
        """An error that lasts over several measurements counts in each as so much larger that it adds up to the same:
        a word that is used again because words are rarer than measurements, and what the leader's own filter is off."""
        self._cov = word.cov
        scale = self._scale(waiting.since_ns, gap_ns)
        return [
            Completed(
                waiting.t_ns, item.kind, item.z, item.R, word.place, scale * word.cov, word.velocity, item.mount
            )
            for item in waiting.measurements
        ]

    def _scale(self, since_ns: int | None, gap_ns: int = 0) -> float:
        lasts_ns = max(gap_ns, self._settings.localization.leader_correlation_ns)
        return 1.0 if since_ns is None else max(1.0, lasts_ns / max(since_ns, 1))

    # -- of a leader that is asked --------------------------------------------------------------------------

    def ask(self, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...]) -> int | None:
        """The number of a request for the instant `t_ns`; None while another one waits for its answer."""
        newest = self._asked.get(self._count)
        if newest is not None and now_ns < newest[1]:
            self._counters["leader.skip_pending"] += 1
            return None
        self._counters["leader.given_up"] += newest is not None
        self._count += 1
        timeout_ns = self._settings.localization.pair_timeout_ns
        self._asked[self._count] = self._measured(t_ns, measurements), now_ns + timeout_ns
        if len(self._asked) > MAX_WAITING:
            self._asked.pop(next(iter(self._asked)))
        return self._count

    def answered(self, number: int, word: Word, exact: bool) -> list[Completed]:
        """An answer. It is `exact` if it speaks of the instant of the request, whatever its stamp; else of its own."""
        found = self._asked.pop(number, None)
        if found is None:
            self._counters["leader.unasked"] += 1
            return []
        waiting = found[0]
        ahead_s = 0.0 if exact else (waiting.t_ns - word.t_ns) / NS
        return self._completed(waiting, replace(word, place=word.place + ahead_s * word.velocity), 0)

    # -- time -----------------------------------------------------------------------------------------------

    def forget(self, until_ns: int) -> None:
        """What is of up to `until_ns` comes too late from now on."""
        gone = [t_ns for t_ns in self._waiting if t_ns <= until_ns]
        old = [number for number, (waiting, _) in self._asked.items() if waiting.t_ns <= until_ns]
        for t_ns in gone:
            del self._waiting[t_ns]
        for number in old:
            del self._asked[number]
        self._counters["leader.unanswered"] += len(gone) + len(old)
        while self._words and self._words[0].t_ns <= until_ns:
            del self._words[0]

    def begin_anew(self) -> None:
        """The leader has begun a new life: its words are of another chain, and its clock is another one."""
        self._words.clear()

    def expected_cov(self) -> Array | None:
        """The covariance (2, 2) that the word about the last measurement will count with, by the words before; None:
        there was none yet."""
        return None if self._cov is None else self._scale(self._since_ns) * self._cov


def _stamp(word: Word) -> int:
    return word.stamp_ns
