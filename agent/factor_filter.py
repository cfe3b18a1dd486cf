"""Cooperative localization with one correlation factor per peer (UT-CLAT: Lyu, Pan, Lv 2019; Luft et al. 2018).

The own belief and each target's belief are kept apart; the correlation between them is covered by covariance
intersection, that between robots by the factors and the pair protocol.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from agent.belief import RobotState, TargetState
from agent.cooperative_filter import FilterMark, refusal
from agent.effects import Effect, Estimate, Send, TrackEstimate
from agent.estimation.colocalization import Options, Update, sighting_update
from agent.estimation.observation import AbsoluteModel, RelativeModel, relative_model
from agent.estimation.track_start import TrackStart
from agent.events import LinkChange, Observation, Received
from agent.factor_model import AnySnapshot, FactorModel, SeparateModel
from agent.health import Health
from agent.history import History, HistoryMark
from agent.pairs import Pairs
from agent.saved_state import SavedFactors
from agent.settings import AgentSettings
from agent.tracks import CONTRADICTIONS, TrackRules
from network.messages import Body, Epoch, Measurement, PairReply, PairRequest, SplitRequest, StartRequest

Array = NDArray[np.float64]


class FactorFilter:
    """The forms `safe` and `published`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = True

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        saved: SavedFactors | None = None,
        *,
        health: Health | None = None,
    ) -> None:
        """`saved`: what to begin with, instead of what the settings say."""
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        self._motions = {t.id: t.motion for t in settings.targets}
        self._rules = TrackRules(settings)
        self.model = self._model()
        self.state = self.model.initial() if saved is None else saved.state
        self.history = History(settings, self.model, self.state)
        self._pairs = Pairs(settings, self.model, counters, count_nis, health or Health(settings.health, counters))
        if saved is not None:
            self._pairs.restore(saved)

    def _model(self) -> FactorModel:
        return SeparateModel(self._settings, self._counters)

    @property
    def t_ns(self) -> int:
        return self.state.t_ns

    @property
    def complete_ns(self) -> int:
        return self.t_ns

    @property
    def revision(self) -> object:
        return self.state

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        before = self.state
        self.state = self.history.advance(before, t_ns, delta, cov)
        self._counters["track.ended"] += len(before.targets) - len(self.state.targets)

    def estimate(self) -> Estimate:
        state = self.state
        tracks = tuple(
            TrackEstimate(name, self._motions[name].layout.name, target.mean, target.cov, target.learnt_ns)
            for name, target in state.targets.items()
        )
        return Estimate(state.t_ns, self._settings.layout.name, state.mean, state.cov, tracks)

    def snapshot(self, peer: str) -> AnySnapshot:
        """The present state as it would be told to a peer."""
        return self.model.snapshot(self.state, peer)

    def contacts(self) -> dict[str, Epoch]:
        return {peer: record.base for peer, record in self.state.pairs.items() if record.base.met}

    def form(self) -> tuple[str, str]:
        return self._settings.localization.form, "configured"

    def saved(self) -> SavedFactors:
        return self._pairs.saved(self.state)

    def mark(self) -> FilterMark:
        return FilterMark(self, (self.history.mark(), self._aside()))

    def rewind(self, mark: FilterMark) -> None:
        kept, aside = cast("tuple[HistoryMark, float]", mark.kept)
        self.state = self.history.rewind(kept)
        self._put_aside(aside)

    def _aside(self) -> float:
        """What own data change besides the state."""
        return 0.0

    def _put_aside(self, aside: float) -> None:
        """Go back to what `_aside` was."""

    # -- own information ------------------------------------------------------------------------------------

    def _late(self, t_ns: int) -> bool:
        return t_ns < self.state.t_ns - self._settings.lateness.tolerance_ns

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        nis = self._use(t_ns, "late.compensated", "late.dropped", lambda then: self.model.absolute(then, model, z, R))
        if nis is not None:
            self._counters[f"used.{kind}"] += 1
            self._count_nis(kind, nis)

    def _use(
        self, t_ns: int, late_used: str, late_lost: str, update_of: Callable[[RobotState], Update | None]
    ) -> float | None:
        """Update the state at `t_ns`, and what followed; returns the NIS per degree of freedom if that was possible."""
        late = self._late(t_ns)
        then: RobotState | None = self.state
        if late:
            then = None if self._settings.lateness.kind == "discard" else self.history.cut(t_ns)
        if then is None:
            self._counters[late_lost] += 1
            return None
        update = update_of(then)
        state: RobotState | None = None
        if update is not None and late:
            state = self.history.corrected(then.t_ns, update)
        elif update is not None:
            state = self.state.updated(update.mean, update.cov, update.left)
            self.history.updated(state, update.left)
        if update is None or state is None:
            self._counters["update.not_positive_definite"] += 1
            return None
        self.state = state
        if late:
            self._counters[late_used] += 1
        return update.nis

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        if target not in self._rules:
            self._counters["observation.unknown_target"] += 1
            return
        then = self._when(t_ns, target)
        if then is None:
            self._counters["late.target_dropped"] += 1
            return
        late = then is not self.state
        localization = self._settings.localization
        layout = self._motions[target].layout
        model = relative_model(event, self._settings.layout, layout)
        belief, now = then.targets.get(target), (then.mean, then.cov)
        if belief is None:
            start = self._rules.started(target, model, now, then.t_ns, event.z, event.R)
            if start is None:
                start = self._rules.started_vaguely(target, model, now, then.t_ns, event.z, event.R)
            self._counters["track.started" if start is not None else "track.undetermined"] += 1
        else:
            track_now = belief.mean, belief.cov
            start = self._rules.begun_again(target, model, now, track_now, then.t_ns, event.z, event.R)
            self._counters["track.begun_again"] += start is not None
        if start is not None:
            self._start_track(then, target, start)
        if start is not None or belief is None:
            return
        own, track, nis = sighting_update(
            (then.mean, then.cov, self._settings.layout),
            (belief.mean, belief.cov, layout),
            model,
            event.z,
            event.R,
            localization.sighting_weight,
            localization.correlation == "factors",
            Options(localization.transform, localization.parameters, localization.innovation_cap),
        )
        health = self._settings.health
        if health.enabled and nis > health.gate_nis:
            self._contradicted(then, target, model, event, belief)
            return
        self._count_nis(f"target_{event.kind}", nis)
        self._counters["used.sighting_own"] += own is not None
        self._counters["used.sighting_target"] += track is not None
        state = self.state
        if late:
            self._counters["late.target_compensated"] += 1
            corrected = self.history.corrected(then.t_ns, own) if own is not None else None
            state = corrected if corrected is not None else state
        elif own is not None:
            state = state.updated(own.mean, own.cov, own.left)
        if track is not None:
            found = self._drifted(target, track.mean, track.cov, then.t_ns)
            state = replace(state, targets={**state.targets, target: found})
        if state is not self.state:
            self.state = state
            self.history.updated(state, None if own is None or late else own.left)

    def _contradicted(
        self, then: RobotState, target: str, model: RelativeModel, event: Observation, belief: TargetState
    ) -> None:
        """A sighting and a track, which a peer may have told, cannot both be right: neither is used for the other.

        After some on end the track ends, and begins anew if this one tells the place.
        """
        self._counters["observation.gated"] += 1
        doubted = belief.doubted + 1
        targets = {name: track for name, track in self.state.targets.items() if name != target}
        if doubted < CONTRADICTIONS:
            targets[target] = replace(self.state.targets[target], doubted=doubted)
        self.state = replace(self.state, targets=targets)
        self.history.updated(self.state)
        if doubted >= CONTRADICTIONS:
            self._counters["track.contradicted"] += 1
            start = self._rules.started(target, model, (then.mean, then.cov), then.t_ns, event.z, event.R)
            if start is not None:
                self._start_track(then, target, start)

    def _drifted(self, target: str, mean: Array, cov: Array, t_ns: int) -> TargetState:
        """A track of `t_ns` at the newest instant."""
        dt_s = (self.state.t_ns - t_ns) * 1e-9
        if dt_s > 0.0:
            drifted = self._motions[target].drift(mean, cov, dt_s, self._settings.localization.transform)
            mean, cov = drifted.mean, drifted.cov
        return TargetState(mean, cov, t_ns, t_ns)

    def _start_track(self, then: RobotState, target: str, start: TrackStart) -> None:
        """Keep a track that starts at the instant of `then`.

        Its correlation with the own error is unknown from then on, as that of every track of these forms.
        """
        found = self._drifted(target, start.mean, start.cov(then.cov), then.t_ns)
        self._counters["used.sighting_target"] += 1
        self.state = replace(self.state, targets={**self.state.targets, target: found})
        self.history.updated(self.state)

    def _when(self, t_ns: int, target: str) -> RobotState | None:
        """The state a sighting at `t_ns` is used in. A late one is used where nothing new was learnt since."""
        if not self._late(t_ns):
            return self.state
        then = None if self._settings.lateness.kind == "discard" else self.history.cut(t_ns)
        if then is None:
            return None
        if target not in then.targets or target not in self.state.targets:
            return then if target not in then.targets and target not in self.state.targets else None
        last = self.state.targets[target].updated_ns
        return then if last == then.targets[target].updated_ns and last <= t_ns else None

    # -- peers ----------------------------------------------------------------------------------------------

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        self.state, request = self._pairs.measured(peer, t_ns, now_ns, measurements, self.state, self.history)
        if request is not None:
            effects.append(Send(peer, request.epoch.t_meas_ns, request))

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._pairs.clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        body = event.message.body
        if isinstance(body, StartRequest):
            self._pairs.asked(event, body, t_ns, self.history, effects)
            return
        if not isinstance(body, PairRequest) or not isinstance(body.snapshot, self.model.snapshot_type):
            self._counters["pair.other_form"] += 1
            if isinstance(body, PairRequest):
                effects.append(refusal(event.message.header.source, body.epoch))
            return
        self.state = self._pairs.request(event, t_ns, self.state, self.history, effects)

    def replied(self, peer: str, body: Body) -> None:
        if not isinstance(body, PairReply) or not isinstance(body.snapshot, self.model.snapshot_type | None):
            self._counters["pair.other_form"] += 1
            return
        self.state = self._pairs.reply(peer, body, self.state, self.history)

    def heard(self, event: Received, effects: list[Effect]) -> None:
        self._counters["received.unused"] += 1

    def link_changed(self, event: LinkChange) -> None:
        self.state = self._pairs.link_changed(event, self.state, self.history)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        """Nothing is told to everybody."""

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        self._pairs.expire(now_ns, effects)

    def deadline_ns(self) -> int:
        return self._pairs.deadline_ns()
