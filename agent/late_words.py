"""What a follower does with a measurement of its leader that is complete only when the state has moved on.

`replay` is none of its business: the core leads the filter back then (`agent.replay`). The policies are those of Zhang
& Cao 2019, whose kernels are in `agent.estimation.delayed`, and two that everybody has at hand: `ignore`, which takes
what comes late as if of now, and `discard`. A measurement is dealt with by the policy that was on when it was made.

All of them linearize at the heading that is believed. A follower that has none, as after a while without its odometry,
uses no word by itself: it gathers a few, and begins its pose anew from them (`agent.estimation.pose_from_words`).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.course import Course, Moment
from agent.estimation.delayed import (
    NEAREST_M,
    Corrected,
    InFlight,
    LeaderSight,
    algorithm1,
    anticipated,
    begun,
    compensated,
    corrected,
    equivalent,
)
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.pose_from_words import Way, no_way, pose_from_words
from agent.events import Completed
from agent.settings import LatenessSettings

Array = NDArray[np.float64]

Key = tuple[int, bytes]
Gathered = dict[Key, tuple[Way, LeaderSight | None]]

MAX_FLIGHTS = 256
MAX_GATHERED = 64

LOST_RAD = 0.5
"""Deviation of a heading from which on it is none."""

FOUND_RAD = 0.12
"""Deviation of a heading that a pose may be begun with."""


@dataclass(frozen=True, slots=True, eq=False)
class UnderWay:
    """What a rewind needs: measurements in flight; without a heading, ways since measurements and what they tell."""

    flights: dict[Key, InFlight]
    gathered: Gathered


class LateWords:
    """Measurements in flight, of the follower whose past is `course`."""

    def __init__(self, lateness: LatenessSettings, start_ns: int, course: Course, counters: Counter[str]) -> None:
        self._lateness, self._start_ns, self._course, self._counters = lateness, start_ns, course, counters
        self._flights: dict[Key, InFlight] = {}
        self._gathered: Gathered = {}
        self._fresh: dict[Key, LeaderSight] = {}

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What is kept, and the most there may be of it, by name."""
        return {
            "leader.flights": (len(self._flights), MAX_FLIGHTS),
            "leader.gathered": (len(self._gathered), MAX_GATHERED),
        }

    def policy(self, t_ns: int) -> str:
        """The policy that is on at an instant."""
        return self._lateness.kind_at(t_ns - self._start_ns)

    # -- while the leader's word is on its way ----------------------------------------------------------------

    def under_way(self) -> UnderWay:
        """What a rewind to the present instant needs."""
        return UnderWay(dict(self._flights), dict(self._gathered))

    def restore(self, found: UnderWay) -> None:
        """Return to what was under way."""
        self._flights, self._gathered = dict(found.flights), dict(found.gathered)

    def measured(self, t_ns: int, z: Array, sight: LeaderSight | None) -> None:
        """The leader is measured at the present instant: z (2,). `sight` has no place yet, and the covariance that is
        expected of its word; None: there was no word yet, so that nothing can be expected."""
        if self.policy(t_ns) not in ("compensate", "algorithm1", "equivalent", "ignore"):
            return
        if self._lost():
            self._gather(_key(t_ns, z), None)
            return
        if self.policy(t_ns) == "ignore":
            return
        if len(self._flights) >= MAX_FLIGHTS:
            self._counters["leader.too_many"] += 1
            return
        now, key = self._course.newest, _key(t_ns, z)
        self._flights[key] = begun(now.mean, now.cov)
        if self.policy(t_ns) == "compensate" and sight is not None:
            self._fresh[key] = sight

    def leave(self) -> None:
        """The state is about to leave its instant: the covariance takes what is to come of it (`compensate`)."""
        for key, sight in self._fresh.items():
            now = self._course.newest
            if sight.z[0] < NEAREST_M:
                continue
            expected = anticipated(now.mean, now.cov, sight)
            if self._course.correct(now, now.mean.copy(), expected.cov):
                self.updated(expected.left)
                self._flights[key] = replace(begun(now.mean, now.cov), gain=expected.gain)
                self._counters["leader.anticipated"] += 1
        self._fresh.clear()

    def moved(self, F: Array, delta: Array, noise: Array) -> None:
        """A prediction with left factor F (n, n) by an increment (3,) with covariance (3, 3)."""
        self._gathered = {key: (way.moved(delta, noise), told) for key, (way, told) in self._gathered.items()}
        self._flights = {key: flight.moved(F, delta) for key, flight in self._flights.items()}

    def updated(self, left: Array) -> None:
        """An update of the newest state with left factor (n, n)."""
        self._flights = {key: flight.updated(left) for key, flight in self._flights.items()}

    def forget(self, until_ns: int) -> None:
        """Words about instants up to `until_ns` are of no use any more."""
        gone = [key for key in self._flights if key[0] <= until_ns]
        for key in gone:
            self._counters["leader.shrunk_for_nothing"] += self._flights.pop(key).gain is not None

    # -- when it is there -----------------------------------------------------------------------------------------

    def use(self, item: Completed, sight: LeaderSight, iterations: int) -> Corrected | None:
        """What a completed measurement makes of the newest belief, which is changed by it; None: it is not used."""
        key, now = _key(item.t_meas_ns, sight.z), self._course.newest
        flight, policy = self._flights.pop(key, None), self.policy(item.t_meas_ns)
        self._fresh.pop(key, None)
        late = item.t_meas_ns < now.t_ns - self._lateness.tolerance_ns
        if self._lost() and (flight is None or flight.gain is None) and not (late and policy == "discard"):
            self._begin_anew(key, sight, late)
            return None
        if not late:
            return self._taken(now, corrected(now.mean, now.cov, sight, iterations))
        if flight is not None and flight.gain is not None:
            return self._compensated(now, flight, sight)
        if policy == "discard":
            self._counters["late.dropped"] += 1
            return None
        if policy == "ignore":
            self._counters["late.ignored"] += 1
            return self._taken(now, corrected(now.mean, now.cov, sight))
        if flight is not None and policy in ("algorithm1", "equivalent"):
            update = algorithm1 if policy == "algorithm1" else equivalent
            self._counters[f"late.{policy}"] += 1
            return self._taken(now, update(now.mean, now.cov, flight, sight))
        # The own reading came late as well, or it is of before what can be done again.
        then = self._course.at(item.t_meas_ns)
        if then is None:
            self._counters["late.dropped"] += 1
            return None
        self._counters["late.compensated"] += 1
        return self._taken(then, corrected(then.mean, then.cov, sight, iterations))

    def _lost(self) -> bool:
        """Whether the follower has no heading; once it has one, what was gathered is over."""
        if float(self._course.newest.cov[2, 2]) > LOST_RAD**2:
            return True
        self._gathered.clear()
        return False

    def _gather(self, key: Key, told: LeaderSight | None) -> None:
        way, _ = self._gathered.pop(key, (no_way(), None))
        if len(self._gathered) >= MAX_GATHERED:
            del self._gathered[next(iter(self._gathered))]
        self._gathered[key] = way, told

    def _begin_anew(self, key: Key, sight: LeaderSight, late: bool) -> None:
        """A word for a follower without a heading: with those before it perhaps it tells the pose."""
        if late and key not in self._gathered:
            self._counters["late.dropped"] += 1
            return
        self._gather(key, sight)
        self._counters["leader.gathered"] += 1
        told = [(way, word) for way, word in self._gathered.values() if word is not None]
        now = self._course.newest
        clock = (float(now.mean[3]), float(now.cov[3, 3])) if len(now.mean) > 3 else None
        found = pose_from_words([word for _, word in told], [way for way, _ in told], clock)
        if found is None or not is_positive_definite(found[1]) or found[1][2, 2] > FOUND_RAD**2:
            return
        self._course.begin_anew(*found)
        self._flights.clear()
        self._fresh.clear()
        self._gathered.clear()
        self._counters["leader.begun_anew"] += 1

    def _taken(self, then: Moment, found: Corrected) -> Corrected | None:
        if not self._course.correct(then, found.mean, found.cov):
            self._counters["update.not_positive_definite"] += 1
            return None
        if then.t_ns == self._course.newest.t_ns:
            self.updated(found.left)
        return found

    def _compensated(self, now: Moment, flight: InFlight, sight: LeaderSight) -> Corrected | None:
        """Only the mean changes: the covariance has taken it already."""
        self._counters["late.compensated"] += 1
        mean = compensated(now.mean, flight, sight)
        if not self._course.correct(now, mean, now.cov):
            return None
        expected = corrected(flight.mean, flight.cov, sight)
        return Corrected(mean, now.cov, expected.left, expected.nis, expected.gain)


def _key(t_ns: int, z: Array) -> Key:
    return t_ns, z.tobytes()
