"""A robot that tracks targets by bearings of many, and localizes itself by a filter of any kind, which knows no target.

Its own pose is what that filter says, with its covariance: a bearing is as unsure as the pose it is taken from.
"""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import CooperativeFilter, FilterMark
from agent.course import Moment
from agent.effects import Broadcast, Effect, Estimate
from agent.estimation.direction import directed
from agent.estimation.motion import STATES
from agent.estimation.observation import AbsoluteModel, RelativeModel, relative_model
from agent.events import LinkChange, Observation, Received
from agent.pair_clock import PairClocks
from agent.rounds import Reports, RoundClock, Told
from agent.saved_state import Saved
from agent.settings import AgentSettings
from agent.triangulator import Triangulator
from network.bearing_messages import BearingReport
from network.messages import Body, Channel, Epoch, Measurement

Array = NDArray[np.float64]

MAX_PAST = 256
"""Own beliefs that are kept for sightings that come late."""


class TriangulatingFilter:
    """`own` localizes; see `agent.cooperative_filter` for what each method is given."""

    def __init__(self, own: CooperativeFilter, settings: AgentSettings, counters: Counter[str]) -> None:
        self._own, self._settings, self._counters = own, settings, counters
        self._triangulator = Triangulator(settings, counters)
        self._motions = {target.id: target.motion for target in settings.tracked}
        self._clock = RoundClock(settings.round, own.t_ns)
        self._clocks = PairClocks(settings)
        self._reports: Reports[BearingReport] = Reports(settings.round, settings.lateness.horizon_ns)
        self._open_ns: int | None = None
        self._closed_ns = own.t_ns
        self._past: deque[Moment] = deque(maxlen=MAX_PAST)
        self._of_own: object = own.revision
        self._revision = object()
        self._told_of: tuple[object, Estimate | None] = None, None

    @property
    def keeps_factors(self) -> bool:
        return self._own.keeps_factors

    @property
    def t_ns(self) -> int:
        return self._own.t_ns

    @property
    def complete_ns(self) -> int:
        """Plans are made when the round's tracks are in."""
        return min(self._own.complete_ns, self._closed_ns)

    @property
    def revision(self) -> object:
        if self._own.revision is not self._of_own:
            self._of_own, self._revision = self._own.revision, object()
        return self._revision

    def estimate(self) -> Estimate | None:
        own = self._own.estimate()
        if own is None:
            return None
        revision = self.revision
        if self._told_of[0] is not revision:
            tracks = self._triangulator.tracks(own.t_ns)
            self._told_of = revision, Estimate(own.t_ns, own.model, own.mean, own.cov, tracks)
        return self._told_of[1]

    def form(self) -> tuple[str, str]:
        form, why = self._own.form()
        heard = [told.peer for told in self._reports.newest(self.t_ns)]
        rounds = f"rounds with {', '.join(heard) if heard else 'nobody'}"
        single = self._triangulator.uncrossed()
        known = f"; bearings of {', '.join(single)} do not cross" if single else ""
        return f"{form}, {self._settings.tracking.kind}", f"{why}; {rounds}{known}"

    def saved(self) -> Saved | None:
        """Tracks begin anew: a target has moved on while the robot was down."""
        return self._own.saved()

    # -- sightings and rounds -------------------------------------------------------------------------------

    def _belief(self, t_ns: int) -> Moment | None:
        """The own belief of about `t_ns`; None if that has been forgotten."""
        estimate = self._own.estimate()
        tolerance = self._settings.lateness.tolerance_ns
        if estimate is None:
            return None
        if estimate.t_ns <= t_ns + tolerance:
            return Moment(estimate.t_ns, estimate.mean, estimate.cov)
        return next((then for then in reversed(self._past) if then.t_ns <= t_ns + tolerance), None)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        if target not in self._triangulator:
            self._counters["observation.unknown_target"] += 1
            return
        then = self._belief(t_ns)
        if then is None or t_ns < self.t_ns - self._settings.lateness.horizon_ns:
            self._counters["late.dropped"] += 1
            return
        if self._settings.lateness.kind == "discard" and t_ns < self.t_ns - self._settings.lateness.tolerance_ns:
            self._counters["late.dropped"] += 1
            return
        model = relative_model(event, self._settings.layout, self._motions[target].layout)
        found = directed(model, then.mean, then.cov, event.z, event.R)
        if found is None:
            self._counters["observation.no_direction"] += 1
            return
        self._triangulator.saw(t_ns, target, found)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        self._own.settled(until_ns, effects)
        if self._open_ns is not None:
            return
        due_ns = self._clock.due(until_ns)
        if due_ns is None:
            return
        self._counters["round.skipped"] += self._clock.leave_out(due_ns)
        if self.t_ns >= due_ns - self._settings.lateness.tolerance_ns:
            self._clock.open(due_ns)
            self._open_ns = due_ns
            then = self._belief(due_ns)
            if then is not None:
                report = self._triangulator.report(due_ns, self._place(then))
                effects.append(Broadcast(Channel.BELIEF, due_ns, report))

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        self._own.expire(now_ns, effects)
        t_ns = self._open_ns
        if t_ns is not None and (now_ns >= t_ns + self._settings.round.wait_ns or self._reports.all_told(t_ns)):
            self._open_ns = None
            self._close(t_ns)

    def _place(self, own: Moment) -> Array:
        """Where the robot is, (3,)."""
        place, sitting = np.zeros(3), self._settings.layout.position
        place[: len(sitting)] = own.mean[list(sitting)]
        return place

    def _close(self, t_ns: int) -> None:
        then = self._belief(t_ns)
        if then is not None:
            self._triangulator.step(t_ns, self._place(then), self._reports.newest(t_ns))
        self._closed_ns = t_ns
        self._revision = object()

    def deadline_ns(self) -> int:
        deadline = self._own.deadline_ns()
        if self._open_ns is not None:
            return min(deadline, self._open_ns + self._settings.round.wait_ns)
        lateness, next_ns = self._settings.lateness, self._clock.next_ns
        reached = self.t_ns >= next_ns - lateness.tolerance_ns
        return min(deadline, next_ns + lateness.settle_ns) if reached else deadline

    def heard(self, event: Received, effects: list[Effect]) -> None:
        header, body = event.message.header, event.message.body
        if not isinstance(body, BearingReport):
            self._own.heard(event, effects)
            return
        t_ns = header.t_meas_ns - self._clocks.offset_ns(event)
        if t_ns > event.t_ns + self._settings.round.period_ns:
            self._counters["round.future"] += 1
        elif not self._reports.hear(Told(header.source, t_ns, body)):
            self._counters["round.overtaken"] += 1

    def link_changed(self, event: LinkChange) -> None:
        if self._reports.link_changed(event):
            self._triangulator.forget(event.peer)
        self._own.link_changed(event)

    # -- what the own filter does ---------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        self._own.advance(t_ns, delta, cov)
        now = self._own.estimate()
        if now is not None and now.model in STATES:
            self._past.append(Moment(now.t_ns, now.mean, now.cov))

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        self._own.absolute(t_ns, kind, model, z, R, landmark)

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        self._own.measured(peer, t_ns, now_ns, measurements, effects)

    def instant_ns(self, event: Received) -> int:
        return self._own.instant_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._own.requested(event, t_ns, effects)

    def replied(self, peer: str, body: Body) -> None:
        self._own.replied(peer, body)

    def contacts(self) -> dict[str, Epoch]:
        return self._own.contacts()

    def mark(self) -> FilterMark | None:
        return self._own.mark()

    def rewind(self, mark: FilterMark) -> None:
        self._own.rewind(mark)
