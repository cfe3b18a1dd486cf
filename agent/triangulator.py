"""Tracks of targets by bearings that robots tell each other once per round (`agent.estimation.bearing_filters`).

At each round a robot tells where it has seen each target from, and in which direction, and where it expects the target
to be; when its neighbours have told the same, it makes one step of its filter. What comes late is used once: with
filters of true covariance in the round it is of, from which on the steps are made again; with published ones in the
next round, at its own age. A track is made known only once bearings of several robots have crossed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.effects import TrackEstimate
from agent.estimation.bearing_filters import build
from agent.estimation.direction import Directed
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.motion import TargetMotion
from agent.estimation.sights import Sight, Told, observable, refusal
from agent.estimation.triangulation import BearingFilter, TrackState
from agent.peer_tables import remember
from agent.plausible import FARTHEST
from agent.rounds import Told as Heard
from agent.settings import AgentSettings, TargetSettings
from agent.tracks import track_ended
from network.bearing_messages import Bearing, BearingReport, Prediction
from network.messages import MAX_MESSAGE_BYTES
from network.wire import size_bound

Array = NDArray[np.float64]

PRECISE = ("kcf_plus", "icf_plus")
"""Kinds that keep a covariance, know how the target's noise is stated, and can begin with a prior."""

RECENT_S = 0.5
"""A target hardly moves meanwhile, so that bearings of a moment ago cross those of now where it is."""

REPEATED = 20
"""Rounds that can be made again; what is older is used in the oldest of them, at its age. Bearings used at their ages
err together, in one round and the next, by what the target has accelerated since: noise of each cannot say that."""

UNCROSSED_NS = 5_000_000_000
"""A track is no longer made known when bearings have not crossed for so long: along the ray nothing is known then."""


def density(motion: TargetMotion) -> float:
    """Of the white acceleration [m^2/s^3] that a target is taken to have: the largest of its axes."""
    return max(motion.noise_sigma) ** 2 * motion.noise_step_s


@dataclass(slots=True, eq=False)
class _Round:
    """A step to `t_ns` from the state `before`, of `before_ns`, with sights by their instants and what was told."""

    t_ns: int
    before_ns: int
    before: TrackState
    told: list[Told]
    sights: list[tuple[int, Sight]] = field(default_factory=list)

    def seen(self) -> list[Sight]:
        return [replace(sight, age_s=max(self.t_ns - at_ns, 0) * 1e-9) for at_ns, sight in self.sights]


@dataclass(slots=True, eq=False)
class _Track:
    """State at `t_ns`; when something was last learnt, and when bearings last crossed; the last rounds."""

    t_ns: int
    state: TrackState
    learnt_ns: int
    crossed_ns: int | None = None
    rounds: list[_Round] = field(default_factory=list)

    def step(self, t_ns: int, kind: BearingFilter, sights: list[Sight], told: list[Told], kept: int) -> TrackState:
        """State at `t_ns`, with sights of ages then: of the last `kept` rounds, those since the oldest sight anew."""
        self.rounds = [*self.rounds[len(self.rounds) - kept + 1 :], _Round(t_ns, self.t_ns, self.state, told)]
        first = len(self.rounds) - 1
        for sight in sights:
            at_ns = t_ns - round(float(sight.age_s) * 1e9)
            of = next(index for index, item in enumerate(self.rounds) if item.t_ns >= at_ns)
            self.rounds[of].sights.append((at_ns, sight))
            first = min(first, of)
        state = self.rounds[first].before
        for item in self.rounds[first:]:
            item.before = state
            # Neighbours knew less then: their means would mislead, their covariances weaken what is known of it now.
            told = item.told if item is self.rounds[-1] else []
            state = kind.step(state, (item.t_ns - item.before_ns) * 1e-9, item.seen(), told)
        return state


def _only(report: BearingReport, targets: list[str]) -> BearingReport:
    bearings = tuple(item for item in report.bearings if item.target in targets)
    return BearingReport(bearings, tuple(item for item in report.predictions if item.target in targets))


class Triangulator:
    """The tracks of one robot whose `tracking.kind` is that of a bearing filter."""

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._targets = {target.id: target for target in settings.tracked}
        kind = settings.tracking.kind
        self._filters: dict[str, BearingFilter] = {}
        if kind != "own":
            self._filters = {name: build(kind, self._options(target)) for name, target in self._targets.items()}
        self._tracks: dict[str, _Track] = {}
        self._seen: dict[str, tuple[int, Directed]] = {}
        self._used: dict[str, int] = {}
        self._turns = sorted(self._targets)

    def _options(self, target: TargetSettings) -> dict[str, float]:
        """What the settings say to a filter of the kind."""
        tracking = self._settings.tracking
        if tracking.kind == "stt" and tracking.memory_s is not None:
            return {"memory_s": tracking.memory_s}
        if tracking.kind not in PRECISE:
            return {}
        return {"q": density(target.motion)}

    def __contains__(self, target: str) -> bool:
        return target in self._targets

    def forget(self, peer: str) -> None:
        """A peer has begun anew."""
        self._used.pop(peer, None)

    def saw(self, t_ns: int, target: str, found: Directed) -> None:
        """An own sighting. Of several since the last round the newest counts."""
        before = self._seen.get(target)
        if before is not None:
            self._counters["round.superseded"] += 1
            if before[0] > t_ns:
                return
        self._seen[target] = t_ns, found

    def report(self, t_ns: int, place: Array) -> BearingReport:
        """What neighbours are told at the round of `t_ns`, not before the last one, by a robot at `place` (3,)."""
        bearings, predictions = [], []
        for target in sorted(self._targets):
            kind, seen, track = self._filters[target], self._seen.get(target), self._tracks.get(target)
            if track is None and seen is not None and seen[0] <= t_ns:
                track = self._begin(target, t_ns, place)
            if seen is not None and kind.tells_sights and seen[0] <= t_ns:
                at_ns, it = seen
                bearings.append(Bearing(target, it.place, it.place_cov, it.direction, it.sigma_rad, t_ns - at_ns))
            if track is not None and kind.tells_mean:
                told = kind.predicted(track.state, (t_ns - track.t_ns) * 1e-9, self._own(target, t_ns))
                predictions.append(Prediction(target, told.mean, told.cov if kind.tells_cov else None))
        return self._fitting(BearingReport(tuple(bearings), tuple(predictions)))

    def _fitting(self, report: BearingReport) -> BearingReport:
        """What fits into one message. Targets that are told go to the end of the queue: all are told in turn."""
        known = {item.target for item in report.bearings} | {item.target for item in report.predictions}
        chosen: list[str] = []
        for target in (name for name in self._turns if name in known):
            if size_bound(_only(report, [*chosen, target])) <= MAX_MESSAGE_BYTES:
                chosen.append(target)
            else:
                self._counters["round.left_out"] += 1
        self._turns = [*(name for name in self._turns if name not in chosen), *chosen]
        return _only(report, chosen)

    def _own(self, target: str, t_ns: int) -> list[Sight]:
        seen = self._seen.get(target)
        if seen is None or seen[0] > t_ns:
            return []
        at_ns, it = seen
        return [Sight(it.place, it.direction, it.sigma_rad, it.place_cov, (t_ns - at_ns) * 1e-9, own=True)]

    def step(self, t_ns: int, place: Array, heard: list[Heard[BearingReport]]) -> None:
        """End the round at `t_ns` of a robot at `place` (3,) with what has been heard."""
        new = [item for item in heard if self._used.get(item.peer, -1) < item.t_ns]
        for target in sorted(self._targets):
            try:
                self._step(target, t_ns, place, new)
            except (np.linalg.LinAlgError, ValueError):
                # Of numbers that are too far apart for arithmetic, or neighbours with filters of another kind.
                self._counters["update.failed"] += 1
                if target in self._tracks:
                    self._tracks[target].rounds = []
        for item in new:
            remember(self._used, item.peer, item.t_ns)
        self._seen = {target: seen for target, seen in self._seen.items() if seen[0] > t_ns}
        self._counters["round.closed"] += 1

    def _step(self, target: str, t_ns: int, place: Array, heard: list[Heard[BearingReport]]) -> None:
        sights = [*self._own(target, t_ns), *self._sights(target, t_ns, heard)]
        told = list(self._told(target, t_ns, heard))
        track = self._tracks.get(target)
        if track is None:
            if not sights and not told:
                return
            track = self._begin(target, t_ns, place)
        if sights:
            learnt_ns = t_ns - round(min(float(item.age_s) for item in sights) * 1e9)
            track.learnt_ns = max(track.learnt_ns, learnt_ns)
        kept = REPEATED if self._settings.tracking.kind in PRECISE else 1
        state = track.step(t_ns, self._filters[target], sights, told, kept)
        if not self._sane(state):
            del self._tracks[target]
            self._counters["track.diverged"] += 1
            return
        track.state, track.t_ns = state, t_ns
        self._counters["round.used_bearings"] += len(sights)
        for item in reversed(track.rounds):
            if track.crossed_ns is not None and item.t_ns <= track.crossed_ns:
                break
            if self._crossing(item.seen()):
                track.crossed_ns = item.t_ns
                break

    def _begin(self, target: str, t_ns: int, place: Array) -> _Track:
        track = self._tracks[target] = self._begun(target, t_ns, place)
        self._counters["track.started"] += 1
        return track

    def _begun(self, target: str, t_ns: int, place: Array) -> _Track:
        """The track before the round at `t_ns`: of a prior, if there is one, or, as published, at the own place."""
        settings, start_ns = self._targets[target], self._settings.start_ns
        if settings.mean is not None and self._settings.tracking.kind in PRECISE and t_ns > start_ns:
            return _Track(start_ns, TrackState(settings.mean, settings.cov), start_ns, start_ns)
        before_ns = t_ns - self._settings.round.period_ns
        return _Track(before_ns, self._filters[target].start(place), before_ns)

    def _crossing(self, sights: list[Sight]) -> bool:
        """Whether bearings of about a round's instant tell a place."""
        parallax = self._settings.tracking.parallax_rad
        if parallax == 0.0:
            return True
        recent = sorted((it for it in sights if float(it.age_s) <= RECENT_S), key=lambda it: float(it.sigma_rad))
        least = 0.5 * (1.0 - math.cos(parallax))
        # Who hardly knows its heading takes nothing from the others.
        return any(bool(observable(recent[:count], least)) for count in range(len(recent), 1, -1))

    @staticmethod
    def _sane(state: TrackState) -> bool:
        return bool(np.abs(state.mean).max() <= FARTHEST) and is_positive_definite(state.matrix)

    def _sights(self, target: str, t_ns: int, heard: list[Heard[BearingReport]]) -> Iterator[Sight]:
        for item in heard:
            for found in item.report.bearings:
                if found.target != target:
                    continue
                age_s = (t_ns - item.t_ns + found.age_ns) * 1e-9
                sight = Sight(found.place, found.direction, found.sigma_rad, found.place_cov, max(age_s, 0.0))
                why = refusal(sight)
                if why is not None:
                    self._counters[f"bearing.{why}"] += 1
                elif age_s * 1e9 > self._settings.lateness.horizon_ns:
                    self._counters["bearing.too_old"] += 1
                else:
                    yield sight

    def _told(self, target: str, t_ns: int, heard: list[Heard[BearingReport]]) -> Iterator[Told]:
        kind = self._filters[target]
        for item in heard:
            for found in item.report.predictions:
                if found.target != target or not kind.tells_mean:
                    continue
                if kind.tells_cov != (found.cov is not None):
                    self._counters["round.other_kind"] += 1
                    continue
                yield Told(found.mean, found.cov, max(t_ns - item.t_ns, 0) * 1e-9)

    # -- what is known --------------------------------------------------------------------------------------

    def tracks(self, t_ns: int) -> tuple[TrackEstimate, ...]:
        """Tracks that are valid, moved to `t_ns`; those that are over by then end."""
        found = []
        for target, track in sorted(self._tracks.items()):
            settings = self._targets[target]
            mean, cov = self._filters[target].belief(track.state)
            if t_ns > track.t_ns:
                moved = settings.motion.drift(mean, cov, (t_ns - track.t_ns) * 1e-9, "jacobian")
                mean, cov = moved.mean, moved.cov
            layout = settings.motion.layout
            if track_ended(self._settings.track_end, layout, cov, track.learnt_ns, t_ns):
                del self._tracks[target]
                self._counters["track.ended"] += 1
            elif track.crossed_ns is not None and t_ns - track.crossed_ns <= UNCROSSED_NS:
                found.append(TrackEstimate(target, layout.name, mean, cov, track.learnt_ns))
        return tuple(found)

    def uncrossed(self) -> list[str]:
        """Targets of which a track is kept that is not made known."""
        known = UNCROSSED_NS
        return [
            target
            for target, track in sorted(self._tracks.items())
            if track.crossed_ns is None or track.t_ns - track.crossed_ns > known
        ]
