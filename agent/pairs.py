"""Pair contacts of one robot: carries out what `agent.pairing` decides, on the robot's state and history."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.belief import Part, RobotState
from agent.effects import Effect, Send
from agent.estimation.colocalization import Contact, pair_update
from agent.estimation.observation import RELATIVE_ANGLES, OutOfViewError
from agent.events import LinkChange, Received
from agent.factor_model import AnySnapshot, FactorModel
from agent.health import Health
from agent.history import History
from agent.pair_clock import PairClocks
from agent.pairing import PairExchange, Step
from agent.peer_tables import has_room, remember
from agent.saved_state import SavedFactors
from agent.settings import AgentSettings
from network.messages import MAX_MEASUREMENTS, Epoch, Measurement, PairReply, PairRequest, ReplyStatus, StartRequest

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62

MAX_INFLATIONS = 4
"""Peers that may have the own covariance doubled within one `restart_interval_ns`."""

REFUSALS = {
    Step.ANSWER_BUSY: ReplyStatus.BUSY,
    Step.ANSWER_SUPERSEDED: ReplyStatus.SUPERSEDED,
    Step.ANSWER_INCONSISTENT: ReplyStatus.INCONSISTENT,
}


class Pairs:
    """The pair protocol with the peers met first; beyond `MAX_PEERS` there is no room for another pair."""

    def __init__(
        self,
        settings: AgentSettings,
        model: FactorModel,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        health: Health,
    ) -> None:
        self._count_nis, self._health = count_nis, health
        self._settings, self._model, self._counters = settings, model, counters
        self._exchanges: dict[str, PairExchange] = {}
        self._lives: dict[str, tuple[int, int]] = {}
        self._inflated_ns: dict[str, int] = {}
        self.clocks = PairClocks(settings)

    def exchange(self, peer: str) -> PairExchange:
        if peer not in self._exchanges:
            localization = self._settings.localization
            self._exchanges[peer] = PairExchange(
                self._settings.robot,
                peer,
                localization.pair_interval_ns,
                localization.pair_timeout_ns,
                self._settings.lateness.horizon_ns,
            )
        return self._exchanges[peer]

    def _room(self, peer: str) -> bool:
        """Whether there is a pair with a peer, or room for one."""
        found = has_room(self._exchanges, peer)
        self._counters["pair.too_many_peers"] += not found
        return found

    def saved(self, state: RobotState) -> SavedFactors:
        """The newest state with what the next life of this robot must remember."""
        exchanges = {peer: exchange.saved() for peer, exchange in self._exchanges.items()}
        return SavedFactors(state, exchanges, dict(self._lives), dict(self._inflated_ns))

    def restore(self, saved: SavedFactors) -> None:
        """Remember what an earlier life has saved. Its requests are not waited for; their lines stay."""
        for peer, kept in saved.exchanges.items():
            self.exchange(peer).restore(kept)
        self._lives.update(saved.lives)
        self._inflated_ns.update(saved.inflated_ns)

    def deadline_ns(self) -> int:
        """When the first pending request times out."""
        return min((e.pending.deadline_ns for e in self._exchanges.values() if e.pending), default=FAR_FUTURE_NS)

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        """Repeat requests that have waited long enough, and forget those that are too old."""
        for peer, exchange in self._exchanges.items():
            waiting = exchange.pending is not None
            request = exchange.expired(now_ns)
            if request is not None:
                self._counters["pair.repeated"] += 1
                effects.append(Send(peer, request.epoch.t_meas_ns, request))
            elif waiting and exchange.pending is None:
                self._counters["pair.timed_out"] += 1

    # -- what happens to a pair -----------------------------------------------------------------------------

    def measured(
        self,
        peer: str,
        t_ns: int,
        now_ns: int,
        measurements: tuple[Measurement, ...],
        state: RobotState,
        history: History,
    ) -> tuple[RobotState, PairRequest | None]:
        """A peer was measured at `t_ns`; returns the state and the request to send, if a contact is opened."""
        if not self._room(peer):
            return state, None
        exchange = self.exchange(peer)
        step = exchange.measured(t_ns, state.pair(peer).base)
        if step is not Step.OPEN:
            self._counters[f"pair.{step.value}"] += 1
            return state, None
        then = history.cut(t_ns)
        if then is None:
            self._counters["pair.too_old_own"] += 1
            return state, None
        told = tuple(self.clocks.widened(peer, item) for item in measurements[:MAX_MEASUREMENTS])
        full = self._model.snapshot(then, peer)
        snapshot = self._model.fitting(full, peer, told, None)
        while snapshot is None and len(told) > 1:
            self._counters["pair.measurement_left_out"] += 1
            told = told[:-1]
            snapshot = self._model.fitting(full, peer, told, None)
        if snapshot is None:
            self._counters["pair.too_large"] += 1
            return state, None
        request = exchange.open(t_ns, now_ns, told, snapshot)
        self._counters["pair.started"] += 1
        return history.opened(then.t_ns, peer, request.epoch), request

    def request(
        self, event: Received, t_ns: int, state: RobotState, history: History, effects: list[Effect]
    ) -> RobotState:
        """The peer opened a contact whose instant is `t_ns` on the own clock."""
        peer = event.message.header.source
        request = event.message.body
        assert isinstance(request, PairRequest)
        epoch = request.epoch
        if epoch.initiator != peer or not self._model.usable(request.snapshot) or not _known_kinds(request):
            self._counters["pair.malformed"] += 1
            return state
        if not self._room(peer):
            return state
        exchange = self.exchange(peer)
        step = exchange.requested(request, state.pair(peer).base)
        self._counters[f"pair.request_{step.value}"] += 1
        if step is Step.IGNORE:
            return state
        if step is Step.REPEAT_REPLY and exchange.last_reply is not None:
            effects.append(Send(peer, epoch.t_meas_ns, exchange.last_reply))
            return state
        refusal = REFUSALS.get(step)
        if refusal is not None:
            effects.append(Send(peer, epoch.t_meas_ns, PairReply(epoch, refusal)))
            return state
        then = history.cut(t_ns)
        if then is None:
            self._counters["pair.too_old"] += 1
            effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.TOO_OLD))))
            return state
        own = self._model.fitting(self._model.snapshot(then, peer), peer, (), request.snapshot)
        if own is None:
            self._counters["pair.too_large"] += 1
            effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.BUSY))))
            return state
        found = self._evaluated(peer, request.snapshot, own, request.measurements, False)
        if found is not None and found.cross is not None and not self._health.usable(peer, t_ns, found.nis, False):
            effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.INCONSISTENT))))
            return state
        effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.OK, own))))
        state = history.opened(then.t_ns, peer, epoch)
        if found is None:
            return state
        return self._apply(peer, epoch, request.snapshot, found, request.measurements, False, t_ns, state, history)

    def asked(
        self, event: Received, request: StartRequest, t_ns: int, history: History, effects: list[Effect]
    ) -> None:
        """A peer that does not know where it is has measured this robot and asks for its belief; nothing is kept of it.

        Whatever comes of that, the peer takes its correlation with everybody for unknown.
        """
        peer, then = event.message.header.source, history.cut(t_ns)
        if then is None:
            self._counters["pair.too_old"] += 1
            effects.append(Send(peer, request.epoch.t_meas_ns, PairReply(request.epoch, ReplyStatus.TOO_OLD)))
            return
        told = self._model.fitting(self._model.snapshot(then, peer), peer, (), None)
        if told is not None:
            self._counters["start.answers"] += 1
            effects.append(Send(peer, request.epoch.t_meas_ns, PairReply(request.epoch, ReplyStatus.OK, told)))

    def reply(self, peer: str, reply: PairReply, state: RobotState, history: History) -> RobotState:
        """The peer answered a contact."""
        if peer not in self._exchanges:
            # Nobody has asked, neither now nor in an earlier life.
            self._counters["pair.reply_ignore"] += 1
            return state
        step, pending = self.exchange(peer).replied(reply, state.pair(peer).base)
        if pending is not None:
            self._health.answered(peer, reply.status is ReplyStatus.INCONSISTENT)
        self._counters[f"pair.reply_{step.value}"] += 1
        if step is Step.DROP_LINE:
            self._counters[f"pair.answer_{reply.status.name.lower()}"] += 1
            state = state.without_line(peer, reply.epoch)
            history.updated(state)
            return state
        if step is not Step.APPLY or pending is None or reply.snapshot is None:
            return state
        if not self._model.usable(reply.snapshot):
            self._counters["pair.malformed"] += 1
            return state
        sent = pending.request
        epoch, t_ns = sent.epoch, sent.epoch.t_meas_ns
        found = self._evaluated(peer, sent.snapshot, reply.snapshot, sent.measurements, True)
        if found is None:
            return state
        if found.cross is not None and not self._health.usable(peer, t_ns, found.nis, True):
            return state
        return self._apply(peer, epoch, reply.snapshot, found, sent.measurements, True, t_ns, state, history)

    def link_changed(self, event: LinkChange, state: RobotState, history: History) -> RobotState:
        """A peer appeared, fell silent or was started again.

        With the same incarnation it has kept its factors: only what is pending is void. A new incarnation is a new
        life, which restarts the pair.
        Joint covariance <= blk(2 P_a, 2 P_b) whatever the correlation, so both sides double their own and start
        from P_ab = 0. A peer that restarts again within `restart_interval_ns` is not allowed to inflate us
        once more: its correlation is taken for unknown instead.
        """
        life = (event.incarnation, event.boot_id)
        before = self._lives.get(event.peer)
        remember(self._lives, event.peer, life, self._exchanges)
        if before is None or before == life:
            return state
        exchange = self._exchanges.get(event.peer)
        if before[0] == event.incarnation:
            self._counters["pair.resumed"] += 1
            if exchange is not None:
                exchange.resumed()
            return state
        if exchange is not None:
            exchange.restarted()
        if not state.pair(event.peer).base.met and not state.pair(event.peer).lines:
            return state
        state = self._restarted_pair(event.peer, event.t_ns, state)
        history.updated(state)
        return state

    def _restarted_pair(self, peer: str, now_ns: int, state: RobotState) -> RobotState:
        """Begin the pair anew: own covariance doubled, correlation zero.

        No peer may inflate us again within `restart_interval_ns`, and no more than `MAX_INFLATIONS` of all of them:
        their correlation counts as unknown until then.
        """
        if self._settings.unsafe.trust_restarts:
            self._counters["pair.restarts"] += 1
            return state.forgotten(peer, known=True)
        interval_ns = self._settings.localization.restart_interval_ns
        lately = [name for name, t_ns in self._inflated_ns.items() if now_ns - t_ns < interval_ns]
        if peer in lately or len(lately) >= MAX_INFLATIONS:
            self._counters["pair.restart_refused"] += 1
            return state.forgotten(peer, known=False)
        self._inflated_ns[peer] = now_ns
        self._counters["pair.restarts"] += 1
        return replace(state.forgotten(peer, known=True), cov=2.0 * state.cov)

    # -- estimation -----------------------------------------------------------------------------------------

    def _evaluated(
        self,
        peer: str,
        initiator: AnySnapshot,
        responder: AnySnapshot,
        measurements: tuple[Measurement, ...],
        own_initiated: bool,
    ) -> Contact | None:
        """What the two snapshots make of a contact, nothing used of it yet; None, counted, if that is nothing."""
        own_is_low = self._settings.robot < peer
        try:
            return self._model.contact(initiator, responder, own_is_low == own_initiated, measurements)
        except OutOfViewError:
            self._counters["pair.out_of_view"] += 1
        except np.linalg.LinAlgError:
            self._counters["pair.indefinite"] += 1
        return None

    def _apply(
        self,
        peer: str,
        epoch: Epoch,
        other: AnySnapshot,
        found: Contact,
        measurements: tuple[Measurement, ...],
        own_initiated: bool,
        t_ns: int,
        state: RobotState,
        history: History,
    ) -> RobotState:
        localization = self._settings.localization
        correlated = localization.correlation == "factors"
        key = (Part.LINE, peer, epoch)
        then = history.first_with(key)
        line = None if then is None else then.stack.block(key)
        if then is None or line is None:
            self._counters["pair.line_lost"] += 1
            return state
        if found.cross is None:
            self._counters["pair.fallback"] += 1
            state = self._restarted_pair(peer, state.t_ns, state)
            history.updated(state)
            return state
        C_own = found.C_i if own_initiated else found.C_j
        psi = line[:, : len(line)]
        update = pair_update(then.mean, then.cov, self._model.layout, psi, C_own, found)
        after = found.cross_after if own_initiated else found.cross_after.T
        base = (peer, epoch, after if correlated else np.zeros_like(after))
        corrected = None if update is None else history.corrected(then.t_ns, update, base)
        if update is None or corrected is None:
            self._counters["update.not_positive_definite"] += 1
            return state
        state = self._model.fused(other, t_ns, corrected)
        history.updated(state)
        self._count_nis("pair_" + "+".join(item.kind for item in measurements), update.nis)
        self._counters["pair.applied_initiator" if own_initiated else "pair.applied_responder"] += 1
        return state


def _known_kinds(request: PairRequest) -> bool:
    return all(item.kind in RELATIVE_ANGLES for item in request.measurements)
