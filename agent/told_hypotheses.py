"""What other leaders have told of where everybody is, until it is used; and how the own hypotheses are told."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from agent.estimation.correspondence import Hypotheses
from agent.peer_tables import remember
from agent.rounds import PRESENT_ROUNDS
from agent.settings import RoundSettings
from network.relative_messages import MAX_HYPOTHESES, SubjectReport
from network.wire_relative import sendable

MAX_KEPT = 4
"""Reports of one leader that wait."""


@dataclass(slots=True, eq=False)
class ToldOnce:
    """What a leader told of one instant: `t_ns` of the own clock, `stamp_ns` of its own."""

    peer: str
    stamp_ns: int
    t_ns: int
    parts: int
    heard: set[int] = field(default_factory=set)
    subjects: dict[str, Hypotheses] = field(default_factory=dict)


class ToldHypotheses:
    """Reports of all leaders. Each is used once, and none that is older than one that was used."""

    def __init__(self, settings: RoundSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._waiting: dict[str, list[ToldOnce]] = {}
        self._used_ns: dict[str, int] = {}
        self._newest_ns: dict[str, int] = {}

    def hear(self, peer: str, stamp_ns: int, t_ns: int, part: int, parts: int, subjects: dict[str, Hypotheses]) -> None:
        """A part of a report, stamped `stamp_ns` by the peer's clock, which is `t_ns` of the own one."""
        if stamp_ns <= self._used_ns.get(peer, -1):
            self._counters["hypotheses.overtaken"] += 1
            return
        waiting = self._waiting.get(peer, [])
        told = next((item for item in waiting if item.stamp_ns == stamp_ns), None)
        if told is None:
            told = ToldOnce(peer, stamp_ns, t_ns, parts)
            waiting = sorted([*waiting, told], key=lambda item: item.stamp_ns)
            self._counters["hypotheses.overflow"] += max(0, len(waiting) - MAX_KEPT)
            waiting = waiting[-MAX_KEPT:]
        if part in told.heard or parts != told.parts:
            self._counters["hypotheses.known"] += 1
            return
        told.heard.add(part)
        told.subjects |= subjects
        remember(self._waiting, peer, waiting)
        remember(self._newest_ns, peer, max(t_ns, self._newest_ns.get(peer, t_ns)))

    def forget(self, peer: str) -> None:
        """A peer has begun anew."""
        self._waiting.pop(peer, None)
        self._used_ns.pop(peer, None)
        self._newest_ns.pop(peer, None)

    def leaders(self, t_ns: int) -> list[str]:
        """Who told lately, at `t_ns`."""
        lately_ns = t_ns - PRESENT_ROUNDS * self._settings.period_ns
        return sorted(peer for peer, newest_ns in self._newest_ns.items() if newest_ns >= lately_ns)

    def complete(self, t_ns: int) -> bool:
        """Whether all who told lately have told all of the round at `t_ns`; nobody else is waited for."""
        near_ns, leaders = t_ns - self._settings.period_ns // 2, self.leaders(t_ns)
        return bool(leaders) and all(
            any(item.t_ns >= near_ns and len(item.heard) == item.parts for item in self._waiting.get(peer, ()))
            for peer in leaders
        )

    def take(self, until_ns: int) -> list[ToldOnce]:
        """The newest report of each leader that is of an instant up to `until_ns`, by leader; it waits no more, and
        older ones are of no use."""
        found = []
        for peer, waiting in sorted(self._waiting.items()):
            due = [item for item in waiting if item.t_ns <= until_ns]
            if due:
                found.append(due[-1])
                remember(self._used_ns, peer, due[-1].stamp_ns)
                self._waiting[peer] = [item for item in waiting if item.stamp_ns > due[-1].stamp_ns]
                self._counters["hypotheses.overtaken"] += len(due) - 1
        return found


def sendable_part(subject: str, told: Hypotheses) -> tuple[SubjectReport | None, int]:
    """What is told of a robot, None if there is nothing; and how many hypotheses single precision cannot hold."""
    rows = range(min(len(told.weights), MAX_HYPOTHESES))
    kept = [row for row in rows if _holds(told, row)]
    if not kept:
        return None, len(rows)
    priors = prior_covs = None
    known: tuple[bool, ...] = ()
    if told.priors is not None and told.prior_covs is not None:
        flags = np.ones(len(told.weights), dtype=bool) if told.prior_known is None else told.prior_known
        known = tuple(bool(flags[row]) for row in kept)
        # Of a hypothesis without a prior something has to stand in its place.
        priors, prior_covs = told.priors[kept].copy(), told.prior_covs[kept].copy()
        priors[~flags[kept]], prior_covs[~flags[kept]] = 0.0, np.eye(4)
    report = SubjectReport(subject, told.weights[kept], told.means[kept], told.covs[kept], priors, prior_covs, known)
    return report, len(rows) - len(kept)


def _holds(told: Hypotheses, row: int) -> bool:
    if not sendable(told.covs[row]):
        return False
    prior = told.prior_covs is not None and (told.prior_known is None or bool(told.prior_known[row]))
    return not prior or told.prior_covs is None or sendable(told.prior_covs[row])
