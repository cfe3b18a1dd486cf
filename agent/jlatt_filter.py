"""Joint localization and target tracking by rounds of covariance intersection (JLATT: Su 2022, chapter 2).

A robot keeps its own belief and one of each target. Once per round it tells its neighbours both, and where its own
sensors place the targets; with what it hears it corrects first itself, then the targets. Nothing is known of how
errors are correlated, and nothing is assumed: no factors, no pairs, and any subset of neighbours will do.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark, refusal
from agent.course import Course, Moment
from agent.effects import Broadcast, Effect, Estimate, TrackEstimate
from agent.estimation.colocalization import Options, absolute_update
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.split_joint import Split
from agent.events import LinkChange, Observation, Received
from agent.health import Health
from agent.joint_tracks import JointState
from agent.pair_clock import PairClocks
from agent.round_fusion import Detected, RoundFusion, Seen
from agent.round_tracks import RoundTracks
from agent.rounds import Neighbours, RoundClock, Told
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings
from network.messages import (
    Belief,
    Body,
    Channel,
    Correction,
    Epoch,
    Measurement,
    PairRequest,
    RoundReport,
    RoundStage,
    SplitRequest,
    StartRequest,
)

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


@dataclass(slots=True)
class _Open:
    """A round that is under way: its instant, and where the own sensors place the targets."""

    t_ns: int
    corrections: dict[str, Correction] = field(default_factory=dict)


class JlattFilter:
    """The kind `jlatt`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        saved: SavedSplit | None = None,
        *,
        health: Health | None = None,
    ) -> None:
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        lateness, localization = settings.lateness, settings.localization
        first = Moment(settings.start_ns, settings.mean, settings.cov)
        if saved is not None:
            first = Moment(saved.state.t_ns, saved.state.mean, saved.state.cov)
        self._own = Course(first, settings.layout.angles, lateness.horizon_ns, lateness.tolerance_ns)
        self._tracks = RoundTracks(settings, counters, None if saved is None else saved.state)
        self._options = Options(localization.transform, localization.parameters, localization.innovation_cap)
        self._clock = RoundClock(settings.round, first.t_ns)
        self._clocks = PairClocks(settings)
        self._neighbours = Neighbours(settings.round)
        self._fusion = RoundFusion(settings, counters, count_nis, health or Health(settings.health, counters))
        if saved is not None:
            self._fusion.used_until_ns = first.t_ns
        self._seen: dict[str, Seen] = {}
        self._detected: dict[str, Detected] = {}
        self._velocity, self._yaw_rate = np.zeros(3), 0.0
        self._open: _Open | None = None
        self._closed_ns = first.t_ns - settings.round.period_ns
        self._revision = object()
        self._told_of: tuple[object, Estimate] = None, Estimate(0, "", settings.mean, settings.cov)

    @property
    def t_ns(self) -> int:
        return self._own.newest.t_ns

    @property
    def revision(self) -> object:
        return self._revision

    @property
    def complete_ns(self) -> int:
        """Instant of the newest round that has ended."""
        return self._closed_ns

    def estimate(self) -> Estimate:
        if self._told_of[0] is not self._revision:
            own = self._own.newest
            tracks = tuple(
                TrackEstimate(name, self._tracks.model(name), now.mean, now.cov, learnt_ns)
                for name, now, learnt_ns in self._tracks.newest()
            )
            found = Estimate(own.t_ns, self._settings.layout.name, own.mean, own.cov, tracks)
            self._told_of = self._revision, found
        return self._told_of[1]

    def contacts(self) -> dict[str, Epoch]:
        """There are no contacts of pairs."""
        return {}

    def form(self) -> tuple[str, str]:
        heard = [told.peer for told in self._neighbours.newest(RoundStage.PRIOR, self.t_ns)]
        return "jlatt", f"configured; rounds with {', '.join(heard) if heard else 'nobody'}"

    def saved(self) -> SavedSplit:
        own = self._own.newest
        unknown = Split(np.zeros_like(own.cov), own.cov)
        return SavedSplit(JointState(own.t_ns, own.mean, unknown, (), (), self._tracks.saved()))

    def mark(self) -> FilterMark | None:
        """Neighbours have been told: nothing is taken back. What comes late is used at its own instant."""
        return None

    def rewind(self, mark: FilterMark) -> None:
        raise RuntimeError("there is no mark of this filter")

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        now = self._own.newest
        dt_s = (t_ns - now.t_ns) * 1e-9
        transform = self._settings.localization.transform
        self._own.advance(t_ns, self._settings.motion.advance(now.mean, now.cov, delta, cov, dt_s, transform))
        self._tracks.advance(t_ns)
        self._velocity, self._yaw_rate = delta[:3] / dt_s, float(delta[3]) / dt_s
        self._revision = object()

    def _then(self, t_ns: int) -> Moment | None:
        """The own belief at the instant of a datum; None, and counted, if it comes too late."""
        lateness = self._settings.lateness
        late = t_ns < self.t_ns - lateness.tolerance_ns
        then = None if late and lateness.kind == "discard" else self._own.at(t_ns)
        if then is None:
            self._counters["late.dropped"] += 1
        elif late:
            self._counters["late.compensated"] += 1
        return then

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        then = self._then(t_ns)
        if then is None:
            return
        update = absolute_update(then.mean, then.cov, self._settings.layout, model, z, R, self._options)
        if update is None or not self._own.correct(then, update.mean, update.cov):
            self._counters["update.not_positive_definite"] += 1
            return
        self._counters[f"used.{kind}"] += 1
        self._count_nis(kind, update.nis)
        self._revision = object()

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        if target not in self._tracks:
            self._counters["observation.unknown_target"] += 1
            return
        then = self._then(t_ns)
        if then is None:
            return
        seen = Seen.of(event, t_ns, self._settings.layout, self._tracks.layout(target))
        started = self._tracks.at(target, t_ns) is None and self._tracks.start_seen(
            target, seen.model, then, seen.z, seen.R
        )
        if target in self._seen:
            self._counters["round.superseded"] += 1
        self._seen[target] = replace(seen, fresh=False) if started else seen
        if started:
            self._revision = object()

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        if self._then(t_ns) is None:
            return
        if peer in self._detected:
            self._counters["round.superseded"] += 1
        wide = tuple(self._clocks.widened(peer, item) for item in measurements)
        self._detected[peer] = Detected(peer, t_ns, wide)

    # -- rounds ---------------------------------------------------------------------------------------------

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        if self._open is not None:
            return
        due_ns = self._clock.due(until_ns)
        if due_ns is None:
            return
        # What is past, nobody waits for any more; of what odometry has not reached yet, nothing can be told.
        self._counters["round.skipped"] += self._clock.leave_out(due_ns)
        if self.t_ns >= due_ns - self._settings.lateness.tolerance_ns:
            self._clock.open(due_ns)
            self._begin(due_ns, effects)

    def _begin(self, t_ns: int, effects: list[Effect]) -> None:
        then = self._own.at(t_ns)
        if then is None or then.t_ns < t_ns - self._settings.round.period_ns // 2:
            # Odometry has leapt over it.
            self._counters["round.skipped"] += 1
            return
        self._open = _Open(t_ns)
        for target, seen in sorted(self._seen.items()):
            at = self._own.at(seen.t_ns)
            track = self._tracks.at(target, seen.t_ns)
            if at is None or track is None:
                continue
            found = self._fusion.correction(target, seen, at, track, then.t_ns)
            if found is not None:
                self._open.corrections[target] = found
        report = RoundReport(
            RoundStage.PRIOR,
            Belief(self._settings.layout.name, then.mean, then.cov),
            self._velocity,
            self._yaw_rate,
            self._tracks.told(then.t_ns),
            tuple(self._open.corrections.values()),
        )
        effects.append(Broadcast(Channel.BELIEF, then.t_ns, report))

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        if self._open is None:
            return
        t_ns = self._open.t_ns
        if now_ns >= t_ns + self._settings.round.wait_ns or self._neighbours.all_told(RoundStage.PRIOR, t_ns):
            done, self._open = self._open, None
            self._close(done)

    def _close(self, done: _Open) -> None:
        """Correct the own belief, then the targets, with what has been told by now (Su 2022, eq. 2.8-2.15)."""
        told = self._fusion.usable(self._neighbours.newest(RoundStage.PRIOR, done.t_ns), done.t_ns)
        self._fusion.correct_robot(self._own, self._tracks, self._detected, self._seen, told)
        self._fusion.correct_targets(self._tracks, done.t_ns, done.corrections, self._seen, told)
        self._seen, self._detected = {}, {}
        self._closed_ns = done.t_ns
        self._counters["round.closed"] += 1
        self._revision = object()

    def deadline_ns(self) -> int:
        """An instant that odometry has not reached is no deadline: the odometry will come, or another round."""
        if self._open is not None:
            return self._open.t_ns + self._settings.round.wait_ns
        lateness, next_ns = self._settings.lateness, self._clock.next_ns
        reached = self.t_ns >= next_ns - lateness.tolerance_ns
        return next_ns + lateness.settle_ns if reached else FAR_FUTURE_NS

    # -- peers ----------------------------------------------------------------------------------------------

    def heard(self, event: Received, effects: list[Effect]) -> None:
        header, body = event.message.header, event.message.body
        if not isinstance(body, RoundReport):
            self._counters["received.unused"] += 1
            return
        if body.stage is not RoundStage.PRIOR:
            # That is for plans.
            return
        t_ns = header.t_meas_ns - self._clocks.offset_ns(event)
        if t_ns > event.t_ns + self._settings.round.period_ns:
            self._counters["round.future"] += 1
        elif not self._neighbours.hear(Told(header.source, t_ns, body)):
            self._counters["round.overtaken"] += 1

    def link_changed(self, event: LinkChange) -> None:
        if self._neighbours.link_changed(event):
            self._fusion.forget(event.peer)

    # -- what only pairs do ---------------------------------------------------------------------------------

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._counters["pair.other_form"] += 1
        if isinstance(event.message.body, PairRequest):
            effects.append(refusal(event.message.header.source, event.message.body.epoch))

    def replied(self, peer: str, body: Body) -> None:
        self._counters["pair.other_form"] += 1
