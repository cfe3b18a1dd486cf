"""The joint belief of a team over a bounded horizon, made again from the raw data whenever something is heard late.

Instants are those at which something was measured, and those of the own odometry. What was measured at an instant is
used in a fixed order, each robot being moved there by its own odometry; after that all are brought as far as they are
known to have moved up to the instant. What cannot be used because a robot's odometry has not been heard is left out,
until it is. Only the data and not their order of arrival determine the belief, as long as they come within the horizon.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from agent.estimation.centralized import CentralizedFilter
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.observation import OutOfViewError
from agent.settings import NS, AgentSettings
from agent.team_track import Life, Node, Place, Track
from agent.timeline import Phase
from network.messages import RawMeasurement, Reckoning

Array = NDArray[np.float64]

OWN: Life = (0, 0)
"""The own life, as far as the own chain is concerned."""

MAX_WAITING = 2048
"""Measurements of one robot within the horizon: whoever tells more crowds nobody else out."""

MAX_INSTANTS = 4096
"""With more of them the horizon is cut short: each holds a joint belief."""

OFFSET_JITTER_NS = 2 * NS
"""What has left the horizon is known for longer by this: by another clock offset it would seem new."""


class Fate(Enum):
    """What became of a measurement when the belief was last made."""

    WAITS = "uncovered"
    USED = "used"
    OUT_OF_VIEW = "out_of_view"
    FAILED = "failed"


@dataclass(slots=True, eq=False)
class Datum:
    """A measurement by `source` at `t_ns` of the keeper's clock, and what became of it."""

    t_ns: int
    source: str
    life: Life
    item: RawMeasurement
    fate: Fate = Fate.WAITS
    nis: float = 0.0
    applied: bool = False

    @property
    def name(self) -> tuple[str, Life, int, int]:
        """What tells it from all others, however often it is heard."""
        return self.source, self.life, self.item.t_ns, self.item.index

    @property
    def peer(self) -> str | None:
        """The robot that was measured."""
        return self.item.of if self.item.of is not None and ":" not in self.item.of else None

    @property
    def rank(self) -> tuple[Phase, str, str, str, bytes, int]:
        """Order among the data of one instant, whichever came first."""
        of = self.item.of or ""
        phase = Phase.PAIR
        if self.item.of is None or of.startswith("landmark:"):
            phase = Phase.PRIVATE
        elif of.startswith("target:"):
            phase = Phase.TARGET
        return phase, self.source, of, self.item.kind, self.item.z.tobytes(), self.item.index


@dataclass(slots=True, eq=False)
class Belief:
    """The joint filter, how far each robot in it has been moved, and its targets; only its maker changes it."""

    filter: CentralizedFilter
    places: dict[str, Place]
    targets_ns: int

    def copy(self) -> Belief:
        return Belief(self.filter.copy(), dict(self.places), self.targets_ns)


@dataclass(slots=True, eq=False)
class Instant:
    """Data of one instant, whether the own odometry has one there, and the belief after it, if that is made."""

    t_ns: int
    own: bool = False
    data: list[Datum] = field(default_factory=list)
    after: Belief | None = None


class TeamHistory:
    """Raw data of a team within the horizon and the joint belief they make."""

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        applied: Callable[[Datum], None],
        over: Callable[[Datum], None],
    ) -> None:
        """`applied` is told of a measurement when it is used first, `over` when its fate does not change any more."""
        self._settings, self._counters, self._applied, self._over = settings, counters, applied, over
        localization, targets = settings.localization, settings.targets if settings.track else ()
        robots = {member.id: (member.mean, member.cov, member.motion) for member in settings.team}
        robots[settings.robot] = (settings.mean, settings.cov, settings.motion)
        self.robots = tuple(sorted(robots))
        self.targets = tuple(target.id for target in targets)
        joint = CentralizedFilter(
            {name: robots[name] for name in self.robots},
            {target.id: (target.mean, target.cov, target.motion) for target in targets if target.mean is not None},
            settings.landmarks,
            localization.transform,
            localization.innovation_cap,
        )
        self._base = Belief(joint, {}, settings.start_ns)
        self._settled_ns = settings.start_ns - 1
        self._instants: list[Instant] = []
        self._stamps: list[int] = []
        self._made = 0
        self._known: dict[tuple[str, Life, int, int], Datum] = {}
        self._past: deque[Datum] = deque()
        self._waiting: Counter[str] = Counter()
        self.tracks: dict[str, Track] = {}
        self.begin(settings.robot, OWN, settings.start_ns, 0)

    @property
    def t_ns(self) -> int:
        """The newest instant of the own odometry."""
        return self.tracks[self._settings.robot].newest.t_ns

    # -- data -----------------------------------------------------------------------------------------------

    def begin(self, robot: str, life: Life, born_ns: int, offset_ns: int) -> None:
        """A robot's life begins at `born_ns` of its clock, which is ahead by `offset_ns`.

        The belief of its start holds at the beginning of the first life that is heard of.
        """
        track = self.tracks.get(robot)
        if track is None:
            start = Node(born_ns - offset_ns, born_ns - offset_ns)
            coast, tolerance_ns = self._settings.coast, self._settings.lateness.tolerance_ns
            track = self.tracks[robot] = Track(start, coast, tolerance_ns, self._counters)
            self._base.places[robot] = Place(start.t_ns, start)
            self._changed(self._settled_ns)
        self._changed(track.begin(life, born_ns, offset_ns))

    def reckon(self, robot: str, life: Life, reckoning: Reckoning, offset_ns: int) -> None:
        """Odometry of a robot that has begun."""
        self._changed(self.tracks[robot].add(life, reckoning, offset_ns))
        if robot == self._settings.robot:
            self._instant(reckoning.t_ns).own = True
            self._settle(reckoning.t_ns - self._settings.lateness.horizon_ns)
            if len(self._stamps) > MAX_INSTANTS:
                self._counters["replica.horizon_cut"] += 1
                self._settle(min(self._stamps[-MAX_INSTANTS // 2], reckoning.t_ns))

    def measure(self, robot: str, life: Life, item: RawMeasurement, offset_ns: int) -> bool:
        """A measurement by a robot; False if it is too late or there are too many. One that is known is nothing new."""
        datum = Datum(item.t_ns - offset_ns, robot, life, item)
        if datum.name in self._known:
            return True
        if datum.t_ns <= self._settled_ns:
            return False
        if self._waiting[robot] >= MAX_WAITING:
            self._counters["replica.overflow"] += 1
            return False
        self._waiting[robot] += 1
        self._known[datum.name] = datum
        instant = self._instant(datum.t_ns)
        instant.data.append(datum)
        instant.data.sort(key=lambda other: other.rank)
        self._changed(datum.t_ns)
        return True

    def _instant(self, t_ns: int) -> Instant:
        index = bisect_left(self._stamps, t_ns)
        if index == len(self._stamps) or self._stamps[index] != t_ns:
            self._instants.insert(index, Instant(t_ns))
            self._stamps.insert(index, t_ns)
            self._made = min(self._made, index)
        return self._instants[index]

    def _changed(self, from_ns: int | None) -> None:
        """What was made of instants from `from_ns` on does not hold any more."""
        if from_ns is not None:
            self._made = min(self._made, bisect_left(self._stamps, from_ns))

    # -- belief ---------------------------------------------------------------------------------------------

    def belief(self) -> Belief:
        """The belief from everything up to the newest own instant, at which the own state and the targets are.

        It is not to be changed.
        """
        return self._make(bisect_right(self._stamps, self.t_ns + self._settings.lateness.tolerance_ns))

    def _make(self, count: int) -> Belief:
        """The belief after the first `count` instants."""
        belief = self._base if self._made == 0 else self._instants[self._made - 1].after
        if count < self._made:
            belief = self._base if count == 0 else self._instants[count - 1].after
        assert belief is not None
        for instant in self._instants[self._made : count]:
            belief = belief.copy()
            for datum in instant.data:
                self._use(belief, datum)
            self._close(belief, instant)
            instant.after = belief
        self._made = max(self._made, count)
        return belief

    def _use(self, belief: Belief, datum: Datum) -> None:
        t_ns, tolerance = datum.t_ns, self._settings.lateness.tolerance_ns
        item, source, peer = datum.item, datum.source, datum.peer
        involved = [source] if peer is None else [source, peer]
        datum.fate = Fate.WAITS
        if not all(robot in belief.places and self._covers(belief, robot, t_ns) for robot in involved):
            return
        of_target = item.of is not None and item.of.startswith("target:")
        if of_target and t_ns < belief.targets_ns - tolerance:
            return
        for robot in involved:
            self._move(belief, robot, t_ns)
        if of_target:
            _drift(belief, t_ns)
        before = belief.filter.mean, belief.filter.cov
        try:
            nis = (
                belief.filter.fix(source, item.kind, item.z, item.R)
                if item.of is None
                else belief.filter.observe(source, item.kind, item.of, item.z, item.R, item.mount)
            )
            if nis is None or not self._sound(belief, involved):
                raise np.linalg.LinAlgError("covariance is not positive definite")
        except OutOfViewError:
            datum.fate = Fate.OUT_OF_VIEW
            return
        except np.linalg.LinAlgError:
            belief.filter.mean, belief.filter.cov = before
            datum.fate = Fate.FAILED
            return
        datum.fate, datum.nis = Fate.USED, nis
        if not datum.applied:
            datum.applied = True
            self._applied(datum)

    def _sound(self, belief: Belief, involved: list[str]) -> bool:
        """Whether everything is finite, no variance is lost, and the robots concerned have a proper covariance."""
        joint = belief.filter
        proper = all(is_positive_definite(joint.belief(robot)[1]) for robot in (self._settings.robot, *involved))
        return proper and bool(np.isfinite(joint.mean).all()) and bool(joint.cov.diagonal().min() > 0.0)

    def _covers(self, belief: Belief, robot: str, t_ns: int) -> bool:
        place = belief.places[robot]
        late = place.t_ns > t_ns + self._settings.lateness.tolerance_ns
        return not late and self.tracks[robot].covers(place, t_ns)

    def _move(self, belief: Belief, robot: str, t_ns: int) -> None:
        """Bring a robot to an instant that is covered."""
        while belief.places[robot].t_ns < t_ns - self._settings.lateness.tolerance_ns:
            self._step(belief, robot, t_ns)

    def _step(self, belief: Belief, robot: str, until_ns: int) -> None:
        step = self.tracks[robot].step(belief.places[robot], until_ns)
        try:
            belief.filter.odometry(robot, step.delta, step.cov, step.dt_s)
        except np.linalg.LinAlgError:
            self._counters["replica.bad_odometry"] += 1
            belief.filter.odometry(robot, np.zeros(4), self.tracks[robot].coasted(step.dt_s), step.dt_s)
        belief.places[robot] = step.place

    def _close(self, belief: Belief, instant: Instant) -> None:
        """Bring all as far as they are known to have moved up to the instant, and the targets to an own one."""
        for robot in self.robots:
            track = self.tracks.get(robot)
            while track is not None:
                t_ns = track.next_ns(belief.places[robot])
                if t_ns is None or t_ns > instant.t_ns:
                    break
                self._step(belief, robot, t_ns)
        if instant.own:
            _drift(belief, instant.t_ns)

    def _settle(self, until_ns: int) -> None:
        """Instants up to `until_ns` are over: keep only what they have made of the belief."""
        count = bisect_right(self._stamps, until_ns)
        self._settled_ns = max(self._settled_ns, until_ns)
        if count == 0:
            return
        self._base = self._make(count)
        for instant in self._instants[:count]:
            for datum in instant.data:
                self._waiting[datum.source] -= 1
                self._past.append(datum)
                self._over(datum)
        while self._past and self._past[0].t_ns <= self._settled_ns - OFFSET_JITTER_NS:
            del self._known[self._past.popleft().name]
        del self._instants[:count], self._stamps[:count]
        self._made -= count
        for robot, place in self._base.places.items():
            self.tracks[robot].settle(place)


def _drift(belief: Belief, t_ns: int) -> None:
    if t_ns > belief.targets_ns:
        belief.filter.drift_targets((t_ns - belief.targets_ns) * 1e-9)
        belief.targets_ns = t_ns
