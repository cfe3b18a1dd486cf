"""Cooperative localization by split covariance intersection on the joint state of a robot and its targets.

No correlation factors are kept: noise the robot has told nobody of is independent of all others' errors, everything
else may be correlated in any way. The claimed covariance holds at any density of contacts, loss, delay and order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark, refusal
from agent.effects import Effect, Estimate, Send, TrackEstimate
from agent.estimation.motion import STATES
from agent.estimation.observation import (
    RELATIVE_ANGLES,
    AbsoluteModel,
    OutOfViewError,
    RelativeModel,
    relative_model,
)
from agent.events import LinkChange, Observation, Received
from agent.health import Health
from agent.joint_history import JointHistory, Learnt
from agent.joint_layout import Met
from agent.joint_state import JointModel, Used
from agent.joint_tracks import JointState
from agent.pair_clock import PairClocks
from agent.peer_tables import has_room, remember
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings
from agent.split_exchange import SplitExchange
from agent.tracks import CONTRADICTIONS
from network.messages import (
    MAX_MEASUREMENTS,
    Body,
    Epoch,
    Measurement,
    PairRequest,
    SplitReply,
    SplitRequest,
    SplitSnapshot,
    StartRequest,
)

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


class SplitFilter:
    """The form `split_joint`; see `agent.cooperative_filter` for what each method is given."""

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
        """`saved`: what to begin with, instead of what the settings say."""
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        self._health = health or Health(settings.health, counters)
        self._model = JointModel(settings)
        first = self._model.tracks.initial() if saved is None else saved.state
        self._before = saved
        self.history = JointHistory(self._model, settings.lateness, first, counters)
        self._motions = {target.id: target.motion for target in settings.targets}
        self._clocks = PairClocks(settings)
        self._exchanges: dict[str, SplitExchange] = {}
        self._waiting: dict[str, SplitExchange] = {}
        self._lives: dict[str, tuple[int, int]] = {}
        self._contacts: dict[str, Epoch] = {} if saved is None else dict(saved.contacts)
        self._asked: dict[str, tuple[int, int]] = {} if saved is None else dict(saved.asked)
        self._told_of: tuple[JointState | None, Estimate] = None, Estimate(0, "", settings.mean, settings.cov)

    @property
    def state(self) -> JointState:
        return self.history.newest

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
        self.history.advance(t_ns, delta, cov)
        self._count_tracks(before)

    def _count_tracks(self, before: JointState) -> None:
        """Tracks that have appeared or gone since the newest state was `before`."""
        if self.state.tracks != before.tracks or self.state.relayed.keys() != before.relayed.keys():
            now, then = {*self.state.tracks, *self.state.relayed}, {*before.tracks, *before.relayed}
            self._counters["track.started"] += len(now - then)
            self._counters["track.ended"] += len(then - now)

    def estimate(self) -> Estimate:
        state, n = self.state, self._settings.layout.dim
        if self._told_of[0] is state:
            return self._told_of[1]
        cov = state.cov
        tracks = tuple(
            TrackEstimate(name, self._motions[name].layout.name, state.mean[block], cov[block, block], learnt_ns)
            for name, block, learnt_ns in zip(state.tracks, self._model.tracks.blocks(state), state.learnt_ns)
        ) + tuple(
            TrackEstimate(name, self._motions[name].layout.name, track.mean, track.cov, track.learnt_ns)
            for name, track in state.relayed.items()
        )
        found = Estimate(state.t_ns, self._settings.layout.name, state.mean[:n], cov[:n, :n], tracks)
        self._told_of = state, found
        return found

    def contacts(self) -> dict[str, Epoch]:
        return dict(self._contacts)

    def saved(self) -> SavedSplit:
        return SavedSplit(_shared(self.state), dict(self._contacts), asked=dict(self._asked))

    def form(self) -> tuple[str, str]:
        return "split_joint", "configured"

    def mark(self) -> FilterMark:
        return FilterMark(self, self.history.mark())

    def rewind(self, mark: FilterMark) -> None:
        self.history.rewind(cast("tuple[JointState, int]", mark.kept))

    # -- own information ------------------------------------------------------------------------------------

    def _at(self, t_ns: int) -> JointState | None:
        """The state own data of `t_ns` are used in; None if they come too late."""
        late = t_ns < self.t_ns - self._settings.lateness.tolerance_ns
        if not late:
            return self.state
        return None if self._settings.lateness.kind == "discard" else self.history.at(t_ns)

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        then = self._at(t_ns)
        if then is None:
            self._counters["late.dropped"] += 1
            return
        late = then is not self.state
        used = self._learn(then, lambda state: self._model.absolute(state, model, z, R))
        if used is None:
            return
        if late:
            self._counters["late.compensated"] += 1
        self._counters[f"used.{kind}"] += 1
        if used.nis is not None:
            self._count_nis(kind, used.nis)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        then = self._at(t_ns)
        if then is None:
            self._counters["late.target_dropped"] += 1
            return
        if target not in self._model.tracks.rules:
            self._counters["observation.unknown_target"] += 1
            return
        late = then is not self.state
        model = relative_model(event, self._settings.layout, self._motions[target].layout)
        used = self._learn(then, lambda state: self._model.sighting(state, target, model, event.z, event.R))
        if used is None:
            return
        if used.state is then and used.nis is None:
            # Kept all the same: a sighting that comes late may have started the track before.
            self._counters["track.undetermined"] += 1
            return
        if then.doubted.get(target, 0) >= CONTRADICTIONS:
            self._counters["track.contradicted"] += 1
        if late:
            self._counters["late.target_compensated"] += 1
        self._counters["used.sighting"] += 1
        if used.nis is not None:
            self._count_nis(f"target_{event.kind}", used.nis)

    def _learn(self, then: JointState, use: Callable[[JointState], Used], again: Learnt | None = None) -> Used | None:
        """Use information at the instant of `then`; `again`: how it is used if earlier information turns up later."""
        try:
            used = use(then)
        except OutOfViewError:
            raise
        except np.linalg.LinAlgError:
            self._counters["update.not_positive_definite"] += 1
            return None
        before = self.state
        self.history.learn(used.state, again or (lambda state: use(state).state))
        self._count_tracks(before)
        return used

    # -- peers ----------------------------------------------------------------------------------------------

    def _exchange(self, peer: str) -> SplitExchange:
        if peer not in self._exchanges:
            timeout_ns = self._settings.localization.pair_timeout_ns
            self._exchanges[peer] = SplitExchange(self._settings.robot, timeout_ns, self._settings.lateness.horizon_ns)
        return self._exchanges[peer]

    def _room(self, peer: str) -> bool:
        """Whether there is a pair with a peer, or room for one."""
        found = has_room(self._exchanges, peer)
        self._counters["pair.too_many_peers"] += not found
        return found

    def _told(self, then: JointState, measurements: tuple[Measurement, ...]) -> SplitSnapshot:
        """The belief as it is sent, with as many tracks as fit; its private noise is shared from now on."""
        snapshot, left_out = self._model.fitting(then, measurements)
        self._counters["pair.shortened"] += left_out
        if snapshot.private is not None:
            self.history.learn(_shared(then), _shared)
        return snapshot

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        if not self._room(peer):
            return
        exchange = self._exchange(peer)
        last = self._contacts.get(peer)
        if exchange.full:
            self._counters["pair.skip_pending"] += 1
            return
        if last is not None and abs(t_ns - last.t_meas_ns) < self._settings.localization.pair_interval_ns:
            self._counters["pair.skip_thinned"] += 1
            return
        then = self.history.at(t_ns)
        if then is None:
            self._counters["pair.too_old_own"] += 1
            return
        told = tuple(self._clocks.widened(peer, item) for item in measurements[:MAX_MEASUREMENTS])
        request = exchange.open(t_ns, now_ns, told, self._told(then, told))
        self._waiting[peer] = exchange
        self._counters["pair.started"] += 1
        effects.append(Send(peer, t_ns, request))

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        peer, request = event.message.header.source, event.message.body
        if isinstance(request, StartRequest):
            then = self.history.at(t_ns)
            self._counters["start.answers" if then is not None else "pair.too_old"] += 1
            if then is not None:
                effects.append(Send(peer, request.epoch.t_meas_ns, SplitReply(request.epoch, self._told(then, ()))))
            return
        if not isinstance(request, SplitRequest):
            self._counters["pair.other_form"] += 1
            if isinstance(request, PairRequest):
                effects.append(refusal(peer, request.epoch))
            return
        if not _usable(request.snapshot) or any(item.kind not in RELATIVE_ANGLES for item in request.measurements):
            self._counters["pair.malformed"] += 1
            return
        if not self._room(peer):
            return
        exchange, epoch = self._exchange(peer), request.epoch
        if exchange.known(epoch) and not self._settings.unsafe.accept_duplicates:
            self._counters["pair.request_repeat_reply"] += 1
            reply = exchange.reply_to(epoch)
            if reply is not None:
                effects.append(Send(peer, epoch.t_meas_ns, reply))
            return
        then = None if self._used_before(epoch, t_ns) else self.history.at(t_ns)
        if then is None:
            self._counters["pair.too_old"] += 1
            exchange.answered(epoch, None)
            return
        reply = SplitReply(epoch, self._told(then, ()))
        exchange.answered(epoch, reply)
        last_ns, number = self._asked.get(peer, (epoch.t_meas_ns, epoch.counter))
        asked = max(epoch.t_meas_ns, last_ns), max(epoch.counter, number)
        remember(self._asked, peer, asked, self._exchanges)
        effects.append(Send(peer, epoch.t_meas_ns, reply))
        self._apply(peer, epoch, t_ns, request.snapshot, request.measurements, own_initiated=False)

    def _used_before(self, epoch: Epoch, t_ns: int) -> bool:
        """Whether a request, of the instant `t_ns` of the own clock, may be in the belief that this life began with.

        Its instant alone does not tell: how far the clocks are apart is found out anew in each life.
        """
        before = self._before
        if before is None:
            return False
        last_ns, number = before.asked.get(epoch.initiator, (-1, -1))
        if epoch.t_meas_ns <= last_ns and epoch.counter <= number:
            return True
        return before.until_ns is not None and t_ns <= before.until_ns + self._settings.lateness.tolerance_ns

    def replied(self, peer: str, body: Body) -> None:
        if not isinstance(body, SplitReply):
            self._counters["pair.other_form"] += 1
            return
        exchange = self._exchanges.get(peer)
        request = None if exchange is None else exchange.replied(body.epoch)
        if request is None:
            self._counters["pair.reply_ignore"] += 1
            return
        if not _usable(body.snapshot):
            self._counters["pair.malformed"] += 1
            return
        epoch = request.epoch
        self._apply(peer, epoch, epoch.t_meas_ns, body.snapshot, request.measurements, own_initiated=True)

    def _apply(
        self,
        peer: str,
        epoch: Epoch,
        t_ns: int,
        told: SplitSnapshot,
        measurements: tuple[Measurement, ...],
        own_initiated: bool,
    ) -> None:
        then = self.history.at(t_ns)
        if then is None:
            self._counters["pair.too_old_own"] += 1
            return

        def met(state: JointState) -> Met:
            return self._model.met(state, told, measurements, own_initiated)

        def use(state: JointState, found: Met, trusted: bool) -> Used:
            return self._model.from_peer(state, told, found, own_initiated, trusted)

        try:
            found = met(then)
        except OutOfViewError:
            self._counters["pair.out_of_view"] += 1
            return
        except np.linalg.LinAlgError:
            self._counters["update.not_positive_definite"] += 1
            return
        if not self._health.usable(peer, t_ns, found.nis, own_initiated):
            return
        # What turns up later may have gone through third robots: the peer's private noise is not independent then.
        used = self._learn(then, lambda s: use(s, found, True), lambda s: use(s, met(s), False).state)
        if used is None:
            return
        self._counters["target.gated"] += len(found.gated) + len(self._model.tracks.contradicted(then, told))
        self._contacts[peer] = epoch
        if used.nis is not None:
            self._count_nis("pair_" + "+".join(item.kind for item in measurements), used.nis)
        self._counters["pair.applied_initiator" if own_initiated else "pair.applied_responder"] += 1

    def heard(self, event: Received, effects: list[Effect]) -> None:
        self._counters["received.unused"] += 1

    def link_changed(self, event: LinkChange) -> None:
        life = (event.incarnation, event.boot_id)
        before = self._lives.get(event.peer)
        remember(self._lives, event.peer, life, self._exchanges)
        if before is not None and before != life:
            if event.peer in self._exchanges:
                self._exchanges[event.peer].restarted()
            self._counters["pair.restarts"] += 1

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        """Nothing is told to everybody."""

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        for peer, exchange in list(self._waiting.items()):
            if not exchange.waiting:
                del self._waiting[peer]
                continue
            repeat, gone = exchange.expired(now_ns)
            for request in repeat:
                self._counters["pair.repeated"] += 1
                effects.append(Send(peer, request.epoch.t_meas_ns, request))
            if gone:
                self._counters["pair.timed_out"] += gone

    def deadline_ns(self) -> int:
        if not self._waiting:
            return FAR_FUTURE_NS
        waiting = [exchange.deadline_ns() for exchange in self._waiting.values() if exchange.waiting]
        return min(waiting, default=FAR_FUTURE_NS)


def _shared(state: JointState) -> JointState:
    return state.with_belief(state.mean, state.split.told(), state.t_ns)


def _usable(told: SplitSnapshot) -> bool:
    """Whether a snapshot is of a robot."""
    layout = STATES.get(told.model)
    return layout is not None and layout.heading is not None
