"""The targets of a robot that works by rounds: one belief of each, kept over the past."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.course import Course, Moment
from agent.estimation.gaussian import wrap_components
from agent.estimation.motion import StateLayout
from agent.estimation.observation import RelativeModel
from agent.estimation.unscented import Propagated
from agent.joint_tracks import JointState, RelayedTrack
from agent.settings import AgentSettings
from agent.tracks import TrackRules
from network.messages import Belief, TargetBelief

Array = NDArray[np.float64]


FOLLOWED_ROUNDS = 10
"""A target of which something was learnt within so many rounds is followed."""


@dataclass(slots=True)
class _Track:
    """`learnt_ns`: when something was last learnt of the target. `doubted`: contradicting own sightings on end."""

    course: Course
    learnt_ns: int
    doubted: int = 0


class RoundTracks:
    """Tracks by target."""

    def __init__(self, settings: AgentSettings, counters: Counter[str], saved: JointState | None = None) -> None:
        """`saved`: what an earlier life knew, instead of the targets' common prior."""
        self._settings, self._counters = settings, counters
        self._rules = TrackRules(settings)
        self._motions = {target.id: target.motion for target in settings.tracked}
        self._t_ns = settings.start_ns
        self._tracks: dict[str, _Track] = {}
        if saved is not None:
            self._t_ns = saved.t_ns
            for name, item in saved.relayed.items():
                self._tracks[name] = _Track(
                    self._course(name, Moment(saved.t_ns, item.mean, item.cov)), item.learnt_ns
                )
        for target in settings.tracked if saved is None else ():
            if target.mean is not None:
                first = Moment(settings.start_ns, target.mean, target.cov)
                self._tracks[target.id] = _Track(self._course(target.id, first), settings.start_ns)

    def __contains__(self, target: str) -> bool:
        return target in self._motions

    def layout(self, target: str) -> StateLayout:
        return self._motions[target].layout

    def model(self, target: str) -> str:
        return self.layout(target).name

    def _course(self, target: str, first: Moment) -> Course:
        lateness = self._settings.lateness
        return Course(first, self.layout(target).angles, lateness.horizon_ns, lateness.tolerance_ns)

    def advance(self, t_ns: int) -> None:
        """Move all tracks to the later instant `t_ns`; those that are over by then end."""
        for target, track in list(self._tracks.items()):
            track.course.advance(t_ns, self._moved(target, track, t_ns))
            self._end_if_over(target, track)
        self._t_ns = t_ns

    def _moved(self, target: str, track: _Track, t_ns: int) -> Propagated:
        """A belief moved to the later instant `t_ns`.

        Of a target that nobody has seen lately, a heading that is off stays off, and spreads where it may be far more
        than a linearized prediction says; one that is followed is corrected before that shows. The mean of all those
        places lags behind the likeliest one, where robots had better look for it: that stays the mean, and the
        covariance is the second moment about it.
        """
        now, motion = track.course.newest, self._motions[target]
        dt_s, transform = (t_ns - now.t_ns) * 1e-9, self._settings.localization.transform
        ahead = motion.drift(now.mean, now.cov, dt_s, transform)
        if now.t_ns - track.learnt_ns <= FOLLOWED_ROUNDS * self._settings.round.period_ns:
            return ahead
        spread = motion.drift(now.mean, now.cov, dt_s, "unscented")
        away = wrap_components(spread.mean - ahead.mean, motion.layout.angles)
        return Propagated(ahead.mean, spread.cov + np.outer(away, away), spread.F)

    def _end_if_over(self, target: str, track: _Track) -> None:
        now = track.course.newest
        if self._rules.ended(target, now.cov, track.learnt_ns, now.t_ns):
            del self._tracks[target]
            self._counters["track.ended"] += 1

    def newest(self) -> Iterator[tuple[str, Moment, int]]:
        """(target, belief, when something was last learnt of it), in order."""
        for target, track in sorted(self._tracks.items()):
            yield target, track.course.newest, track.learnt_ns

    def saved(self) -> dict[str, RelayedTrack]:
        """What another life needs."""
        return {name: RelayedTrack(now.mean, now.cov, learnt_ns, False) for name, now, learnt_ns in self.newest()}

    def at(self, target: str, t_ns: int) -> Moment | None:
        """The belief of the newest instant up to `t_ns`; None if there was none."""
        track = self._tracks.get(target)
        return None if track is None else track.course.at(t_ns)

    def told(self, t_ns: int) -> tuple[TargetBelief, ...]:
        """What neighbours are told of all targets at `t_ns`."""
        found = []
        for target, track in sorted(self._tracks.items()):
            then = track.course.at(t_ns)
            if then is not None:
                age_ns = max(0, then.t_ns - track.learnt_ns)
                found.append(TargetBelief(target, Belief(self.model(target), then.mean, then.cov), age_ns))
        return tuple(found)

    def start(self, target: str, then: Moment, learnt_ns: int) -> bool:
        """Begin a track with the belief `then`; False if it would be over at once."""
        if self._rules.ended(target, then.cov, learnt_ns, then.t_ns):
            return False
        track = _Track(self._course(target, then), learnt_ns)
        if then.t_ns < self._t_ns:
            dt_s = (self._t_ns - then.t_ns) * 1e-9
            moved = self._motions[target].drift(then.mean, then.cov, dt_s, self._settings.localization.transform)
            track.course.advance(self._t_ns, moved)
        self._tracks[target] = track
        self._counters["track.started"] += 1
        return True

    def start_seen(self, target: str, model: RelativeModel, own: Moment, z: Array, R: Array) -> bool:
        """Begin a track with a sighting at the instant of the own belief `own`, if it tells the place."""
        belief = own.mean, own.cov
        found = self._rules.started(target, model, belief, own.t_ns, z, R)
        if found is None:
            found = self._rules.started_vaguely(target, model, belief, own.t_ns, z, R)
        if found is None:
            self._counters["track.undetermined"] += 1
            return False
        return self.start(target, Moment(own.t_ns, found.mean, found.cov(own.cov)), own.t_ns)

    def correct(self, target: str, before: Moment, mean: Array, cov: Array, learnt_ns: int) -> bool:
        """Have a belief take the place of `before`, with what was learnt at `learnt_ns`."""
        track = self._tracks.get(target)
        if track is None or not track.course.correct(before, mean, cov):
            return False
        track.learnt_ns = max(track.learnt_ns, learnt_ns)
        return True

    def doubt(self, target: str, contradicted: bool) -> int:
        """Count an own sighting that contradicts the track, or one that does not; how many do so on end."""
        track = self._tracks[target]
        track.doubted = track.doubted + 1 if contradicted else 0
        return track.doubted

    def end(self, target: str) -> None:
        """A track is not of its target."""
        del self._tracks[target]
        self._counters["track.contradicted"] += 1
