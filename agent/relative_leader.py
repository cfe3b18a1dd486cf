"""A robot with a camera finds out where all others are, relative to its own body: what it does with time.

Its own steps wait until all peers that were heard lately have told how they moved meanwhile, or for `round.wait_s`.
Then the sums of hypotheses (`agent.estimation.correspondence`) are moved, and corrected by what was sensed at the
step's end. At each round it tells the others what it believes, and when they have told too, uses that: carried to the
present by the motions it has recorded, and once.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.effects import Broadcast, Effect, RelativeEstimate
from agent.estimation.correspondence import BodyMotion, Correspondence, Hypotheses, Scan, carry
from agent.estimation.motion import split_increment
from agent.events import Observation
from agent.peer_motion import LEAST_VARIANCE, PeerMotion, Stretch
from agent.rounds import RoundClock
from agent.settings import NS, AgentSettings
from agent.told_hypotheses import ToldHypotheses, sendable_part
from network.messages import Channel
from network.wire_relative import parted

Array = NDArray[np.float64]

PATIENCE_NS = NS
"""A peer that has told nothing of its motion for so long is not waited for."""

SILENT_NS = 3 * NS
"""Of a peer that has told nothing of its motion for so long nobody says where it is: hypotheses that are moved by
guesses alone fit whatever is measured."""

FRESH_NS = NS // 5
"""An altitude that is older than that is not compared with another one."""

MAX_PENDING = 1024
MAX_ALTITUDES = 64
NO_BEARINGS = np.empty((0, 2))


@dataclass(frozen=True, slots=True, eq=False)
class Altitude:
    """Measured at `t_ns` of the own clock [m, m^2]."""

    t_ns: int
    value: float
    variance: float


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A bearing: azimuth and elevation (2,) of the own body [rad], with R (2, 2); of whom, None: nobody knows; and the
    observation it was made of, of one that may be given a name."""

    direction: Array
    R: Array
    of: str | None
    observation: Observation | None = None


@dataclass(slots=True, eq=False)
class _Step:
    """The own motion from t0_ns to t_ns, and what was sensed then."""

    t0_ns: int
    t_ns: int
    delta: Array
    cov: Array
    bearings: list[Sight] = field(default_factory=list)
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def motion(self) -> BodyMotion:
        return body_motion(self.t_ns - self.t0_ns, self.delta, self.cov)


@dataclass(frozen=True, slots=True, eq=False)
class _Past:
    """How everybody moved over one step, the robot itself as well."""

    t0_ns: int
    t_ns: int
    motions: Mapping[str, BodyMotion]


def body_motion(span_ns: int, delta: Array, cov: Array) -> BodyMotion:
    """An odometry increment (4,), (4, 4) as a mean velocity."""
    dt_s = span_ns * 1e-9
    return BodyMotion(delta / dt_s, cov / dt_s**2 + LEAST_VARIANCE * np.eye(4))


class Leader:
    """What one robot knows of all others. Instants are of the own clock."""

    def __init__(self, settings: AgentSettings, start_ns: int, counters: Counter[str]) -> None:
        relative, lateness = settings.relative, settings.lateness
        self._settings, self._counters = settings, counters
        self._robot, self._peers = settings.robot, relative.peers
        self._form = relative.correspondence.form
        self._tolerance_ns, self._wait_ns = lateness.tolerance_ns, settings.round.wait_ns
        self.correspondence = Correspondence(relative.correspondence, relative.peers, settings.robot)
        self._start_ns = self.t_ns = start_ns
        self._settled_ns = start_ns
        self._pending: deque[_Step] = deque()
        self._past: deque[_Past] = deque()
        self._motions = {peer: self._motion(start_ns) for peer in relative.peers}
        self._altitudes: dict[str, deque[Altitude]] = {}
        self._compared: dict[str, tuple[int, int]] = {}
        self._clock = RoundClock(settings.round, start_ns)
        self.told = ToldHypotheses(settings.round, counters)
        self._open_ns: int | None = None
        self._closes_ns = 0
        self._fused_ns = 0
        self._named: list[tuple[str, Observation]] = []
        self.revision = object()

    def _motion(self, start_ns: int) -> PeerMotion:
        relative = self._settings.relative
        accelerations = relative.acceleration_mps2, relative.turn_acceleration_radps2
        return PeerMotion(start_ns, self._settings.coast, accelerations, self._tolerance_ns)

    # -- what is sensed and heard ---------------------------------------------------------------------------

    def moved(self, t0_ns: int, t_ns: int, delta: Array, cov: Array) -> None:
        """The robot itself has moved on by an increment (4,), (4, 4)."""
        self._pending.append(_Step(t0_ns, t_ns, delta, cov))

    def _at(self, t_ns: int) -> _Step | None:
        """The step that ends at `t_ns`; one that is under way then is cut. None if it has been processed."""
        for index, step in enumerate(self._pending):
            if abs(step.t_ns - t_ns) <= self._tolerance_ns:
                return step
            if step.t0_ns + self._tolerance_ns < t_ns < step.t_ns:
                share = (t_ns - step.t0_ns) / (step.t_ns - step.t0_ns)
                delta, cov, rest, rest_cov = split_increment(step.delta, step.cov, share)
                first = _Step(step.t0_ns, t_ns, delta, cov)
                step.t0_ns, step.delta, step.cov = t_ns, rest, rest_cov
                self._pending.insert(index, first)
                return first
        self._counters["relative.late"] += 1
        return None

    def saw(self, t_ns: int, sight: Sight) -> None:
        """The camera has seen a robot."""
        step = self._at(t_ns)
        if step is not None:
            step.bearings.append(sight)

    def take_named(self) -> list[tuple[str, Observation]]:
        """Bearings that have turned out to be of whom since this was asked last."""
        found, self._named = self._named, []
        return found

    def ranged(self, t_ns: int, peer: str, distance: float, variance: float) -> None:
        if peer not in self._motions:
            self._counters["relative.stranger"] += 1
            return
        step = self._at(t_ns)
        if step is not None:
            step.ranges[peer] = distance, variance

    def altitude(self, robot: str, found: Altitude) -> None:
        """The altitude of the robot itself, or of a peer."""
        self._altitudes.setdefault(robot, deque(maxlen=MAX_ALTITUDES)).append(found)

    def heard_motion(self, peer: str, stretch: Stretch, altitude: Altitude | None) -> None:
        """How a peer moved; it is one of the peers."""
        if stretch.t_ns <= self.t_ns + self._tolerance_ns:
            self._counters["motion.late"] += 1
        if not self._motions[peer].add(stretch):
            self._counters["motion.known"] += 1
        elif altitude is not None:
            self.altitude(peer, altitude)

    def knows(self, peer: str) -> bool:
        return peer in self._motions

    def reborn(self, peer: str) -> None:
        """A peer has begun anew: what it told before is over, and how it moved meanwhile nobody knows."""
        self.told.forget(peer)
        self._altitudes.pop(peer, None)
        self._compared.pop(peer, None)
        if peer in self._motions:
            end_ns = self._motions[peer].end_ns
            self._motions[peer] = self._motion(self._start_ns if end_ns is None else end_ns)

    # -- time -----------------------------------------------------------------------------------------------

    def settled(self, until_ns: int) -> None:
        """All own data of instants up to `until_ns` are in."""
        self._settled_ns = max(self._settled_ns, until_ns)

    def act(self, now_ns: int, effects: list[Effect]) -> None:
        """Do what is due: steps, and the beginning and end of rounds."""
        while self._pending and self._due(self._pending[0], now_ns):
            self._step(self._pending.popleft())
            self._open(now_ns, effects)
        if self._open_ns is not None and (now_ns >= self._closes_ns or self.told.complete(self._open_ns)):
            self._close()

    def deadline_ns(self, never_ns: int) -> int:
        """When `settled` or `act` has something to do next."""
        deadline = never_ns if self._open_ns is None else self._closes_ns
        if self._pending:
            first_ns = self._pending[0].t_ns
            wait = self._wait_ns if first_ns <= self._settled_ns else self._settings.lateness.settle_ns
            deadline = min(deadline, first_ns + wait)
        return deadline

    def _due(self, step: _Step, now_ns: int) -> bool:
        if len(self._pending) > MAX_PENDING:
            return True
        if step.t_ns > self._settled_ns:
            return False
        return now_ns >= step.t_ns + self._wait_ns or all(
            motion.covers(step.t_ns) or (motion.end_ns or self._start_ns) < step.t_ns - PATIENCE_NS
            for motion in self._motions.values()
        )

    def _step(self, step: _Step) -> None:
        """Move all hypotheses to the end of a step, and use what was sensed then."""
        own, motions = step.motion, {}
        for peer, motion in self._motions.items():
            motions[peer], guessed = motion.over(step.t0_ns, step.t_ns)
            self._counters["motion.guessed"] += guessed
        self._past.append(_Past(step.t0_ns, step.t_ns, {**motions, self._robot: own}))
        oldest_ns = step.t_ns - self._settings.lateness.horizon_ns
        while self._past[0].t_ns < oldest_ns:
            self._past.popleft()
        self.t_ns, self.revision = step.t_ns, object()
        try:
            self.correspondence.advance(own, motions, (step.t_ns - step.t0_ns) * 1e-9)
            if step.bearings or step.ranges:
                self._scan(step, own, motions)
        except np.linalg.LinAlgError:
            self._counters["update.failed"] += 1

    def _scan(self, step: _Step, own: BodyMotion, motions: Mapping[str, BodyMotion]) -> None:
        bearings, cov = NO_BEARINGS, np.eye(2)
        if step.bearings:
            bearings = np.array([sight.direction for sight in step.bearings])
            cov = np.mean([sight.R for sight in step.bearings], axis=0)
        labels = None
        if self._settings.relative.known:
            labels = {sight.of: row for row, sight in enumerate(step.bearings) if sight.of in self._motions}
            self._counters["relative.stranger"] += len(step.bearings) - len(labels)
        heights = self._heights(step, own, motions)
        found = self.correspondence.scan(Scan(bearings, cov, step.ranges, heights), labels)
        for peer, row in found.items():
            observation = step.bearings[row].observation
            if observation is not None:
                self._named.append((peer, observation))
        self._counters["relative.scans"] += 1

    def _heights(
        self, step: _Step, own: BodyMotion, motions: Mapping[str, BodyMotion]
    ) -> dict[str, tuple[float, float]]:
        """Height of each peer above the robot, and its variance, of altitudes that were not compared before."""
        mine = self._altitude_at(self._robot, step, own)
        found = {}
        for peer, motion in motions.items() if mine is not None else ():
            theirs = self._altitude_at(peer, step, motion)
            if mine is None or theirs is None:
                continue
            before = self._compared.get(peer, (-1, -1))
            if mine.t_ns > before[0] and theirs.t_ns > before[1]:
                self._compared[peer] = mine.t_ns, theirs.t_ns
                found[peer] = theirs.value - mine.value, theirs.variance + mine.variance
        return found

    def _altitude_at(self, robot: str, step: _Step, motion: BodyMotion) -> Altitude | None:
        """The newest altitude, carried to the end of a step by the climb; None if it is too old."""
        for known in reversed(self._altitudes.get(robot, ())):
            if known.t_ns > step.t_ns + self._tolerance_ns:
                continue
            age_ns = max(step.t_ns - known.t_ns, 0)
            if age_ns > FRESH_NS:
                break
            if age_ns <= self._tolerance_ns:
                return known
            # White noise of the climb: its variance grows with time, and was stated of the mean over a step.
            age_s, span_s = age_ns * 1e-9, (step.t_ns - step.t0_ns) * 1e-9
            grown = float(motion.cov[2, 2]) * max(span_s, age_s) * age_s
            return Altitude(known.t_ns, known.value + float(motion.velocity[2]) * age_s, known.variance + grown)
        return None

    # -- rounds ---------------------------------------------------------------------------------------------

    def _open(self, now_ns: int, effects: list[Effect]) -> None:
        """Tell what is believed, if a round has begun."""
        due_ns = self._clock.due(self.t_ns + self._tolerance_ns)
        if due_ns is None:
            return
        if self._open_ns is not None:
            self._close()
        self._counters["round.skipped"] += self._clock.open(due_ns)
        self._open_ns, self._closes_ns = due_ns, now_ns + self._wait_ns
        subjects = []
        for peer in self._heard_of():
            part, left_out = sendable_part(peer, self.correspondence.told(peer))
            self._counters["hypotheses.unsendable"] += left_out
            if part is not None:
                subjects.append(part)
        for report in parted(self._fused_ns, subjects):
            effects.append(Broadcast(Channel.BELIEF, self.t_ns, report))

    def _close(self) -> None:
        """Use what the others have told, each once."""
        for item in self.told.take(self.t_ns + self._tolerance_ns):
            carried = self._carried(item.peer, item.t_ns, item.subjects)
            if not carried:
                continue
            try:
                self.correspondence.fuse(item.peer, carried)
                self._counters["hypotheses.used"] += len(carried)
            except np.linalg.LinAlgError:
                self._counters["update.failed"] += 1
        self.correspondence.fused()
        self._fused_ns, self._open_ns = self.t_ns, None
        self._counters["round.closed"] += 1
        self.revision = object()

    def _carried(self, leader: str, t_ns: int, subjects: Mapping[str, Hypotheses]) -> dict[str, Hypotheses]:
        """What a leader told of the instant `t_ns`, moved to the present."""
        if not self._past or self._past[0].t0_ns > t_ns + self._tolerance_ns or not self.knows(leader):
            self._counters["hypotheses.too_old" if self.knows(leader) else "hypotheses.stranger"] += 1
            return {}
        found = {name: item for name, item in subjects.items() if name == self._robot or self.knows(name)}
        self._counters["hypotheses.stranger"] += len(subjects) - len(found)
        for past in self._past:
            begin_ns = max(past.t0_ns, t_ns)
            span_ns = past.t_ns - begin_ns
            if span_ns <= self._tolerance_ns:
                continue
            share = span_ns / (past.t_ns - past.t0_ns)
            motions = {name: _of_part(motion, share) for name, motion in past.motions.items()}
            for name, item in found.items():
                found[name] = carry(item, motions[leader], motions[name], span_ns * 1e-9, self._form)
        return found

    # -- what is known --------------------------------------------------------------------------------------

    def _heard_of(self) -> list[str]:
        """Peers that have told lately how they move."""
        unheard = self.unheard()
        return [peer for peer in self._peers if peer not in unheard]

    def unheard(self) -> list[str]:
        """Peers that are known to be there, and have told nothing of their motion lately, or ever."""
        oldest_ns = self.t_ns - SILENT_NS
        ends = ((peer, motion.end_ns) for peer, motion in self._motions.items())
        return [peer for peer, end_ns in ends if end_ns is None or end_ns < oldest_ns]

    def relatives(self) -> tuple[RelativeEstimate, ...]:
        """The hypothesis that is believed of each peer there is one of."""
        found = []
        for peer in self._heard_of():
            best = self.correspondence.dominant(peer)
            if best is not None:
                found.append(
                    RelativeEstimate(
                        peer,
                        self.t_ns,
                        best.mean,
                        best.cov,
                        best.weight,
                        best.ambiguity,
                        best.tracks,
                        best.confirmed,
                    )
                )
        return tuple(found)


def _of_part(motion: BodyMotion, share: float) -> BodyMotion:
    """A motion over a share of its step: the mean of white noise over less time varies more."""
    return motion if share >= 1.0 else BodyMotion(motion.velocity, motion.cov / share)
