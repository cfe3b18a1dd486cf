"""Pair contacts of one robot: carries out what `agent.pairing` decides, on the robot's state and history."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.belief import Part, RobotState, TargetState
from agent.effects import Effect, Send
from agent.estimation.colocalization import (
    Options,
    contact,
    pair_update,
)
from agent.estimation.gaussian import symmetrize, wrap_components
from agent.estimation.intersection import fuse
from agent.estimation.motion import STATES
from agent.estimation.observation import RELATIVE_ANGLES, OutOfViewError
from agent.events import LinkChange, Received
from agent.history import History
from agent.pair_clock import PairClocks
from agent.pairing import PairExchange, Step
from agent.settings import AgentSettings
from network.messages import (
    MAX_LINES,
    MAX_MEASUREMENTS,
    MAX_MESSAGE_BYTES,
    MAX_TARGETS,
    NEVER,
    Belief,
    Epoch,
    Line,
    Measurement,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
    TargetBelief,
)
from network.wire import size_bound

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


class Pairs:
    """The pair protocol with every peer met, bounded in number by the endpoint."""

    def __init__(
        self,
        settings: AgentSettings,
        options: Options,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
    ) -> None:
        self._count_nis = count_nis
        self._settings, self._options, self._counters = settings, options, counters
        self._exchanges: dict[str, PairExchange] = {}
        self._lives: dict[str, tuple[int, int]] = {}
        self._inflated_ns: dict[str, int] = {}
        self.clocks = PairClocks(settings)
        self._motions = {target.id: target.motion for target in settings.targets}

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

    def snapshot(self, state: RobotState, peer: str) -> Snapshot:
        """The state as it is told to a peer."""
        record = state.pair(peer)
        n = len(state.mean)
        factor = state.stack.block((Part.FACTOR, peer, NEVER))
        line = state.stack.block((Part.BASE_LINE, peer, NEVER))
        lines = []
        for epoch in record.lines[-MAX_LINES:]:
            block = state.stack.block((Part.LINE, peer, epoch))
            assert block is not None
            lines.append(Line(epoch, block))
        targets = tuple(
            TargetBelief(name, Belief(self._motions[name].layout.name, target.mean, target.cov))
            for name, target in list(state.targets.items())[:MAX_TARGETS]
        )
        return Snapshot(
            Belief(self._settings.layout.name, state.mean, state.cov),
            record.base,
            np.zeros((n, 0)) if factor is None else factor,
            np.eye(n) if line is None else line,
            tuple(lines),
            targets,
            record.known,
        )

    def _fitting(self, snapshot: Snapshot, measurements: tuple[Measurement, ...]) -> Snapshot:
        """The snapshot without what does not fit into one message: targets first, then the oldest lines."""
        longest = Epoch(2**62, "r" * 24, 2**53)
        while (snapshot.targets or snapshot.lines) and (
            size_bound(PairRequest(longest, measurements, snapshot)) > MAX_MESSAGE_BYTES
        ):
            self._counters["pair.shortened"] += 1
            if snapshot.targets:
                snapshot = replace(snapshot, targets=snapshot.targets[:-1])
            else:
                snapshot = replace(snapshot, lines=snapshot.lines[1:])
        return snapshot

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
        request = exchange.open(t_ns, now_ns, told, self._fitting(self.snapshot(then, peer), told))
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
        if epoch.initiator != peer or not self._fits(request.snapshot) or not _known_kinds(request):
            self._counters["pair.malformed"] += 1
            return state
        exchange = self.exchange(peer)
        step = exchange.requested(request, state.pair(peer).base)
        self._counters[f"pair.request_{step.value}"] += 1
        if step is Step.REPEAT_REPLY and exchange.last_reply is not None:
            effects.append(Send(peer, epoch.t_meas_ns, exchange.last_reply))
            return state
        refusal = {Step.ANSWER_BUSY: ReplyStatus.BUSY, Step.ANSWER_SUPERSEDED: ReplyStatus.SUPERSEDED}.get(step)
        if refusal is not None:
            effects.append(Send(peer, epoch.t_meas_ns, PairReply(epoch, refusal)))
            return state
        then = history.cut(t_ns)
        if then is None:
            self._counters["pair.too_old"] += 1
            effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.TOO_OLD))))
            return state
        own = self._fitting(self.snapshot(then, peer), ())
        effects.append(Send(peer, epoch.t_meas_ns, exchange.answered(PairReply(epoch, ReplyStatus.OK, own))))
        state = history.opened(then.t_ns, peer, epoch)
        return self._apply(peer, epoch, request.snapshot, own, request.measurements, False, t_ns, state, history)

    def reply(self, peer: str, reply: PairReply, state: RobotState, history: History) -> RobotState:
        """The peer answered a contact."""
        step, pending = self.exchange(peer).replied(reply, state.pair(peer).base)
        self._counters[f"pair.reply_{step.value}"] += 1
        if step is Step.DROP_LINE:
            self._counters[f"pair.answer_{reply.status.name.lower()}"] += 1
            state = state.without_line(peer, reply.epoch)
            history.updated(state)
            return state
        if step is not Step.APPLY or pending is None or reply.snapshot is None:
            return state
        if not self._fits(reply.snapshot):
            self._counters["pair.malformed"] += 1
            return state
        sent = pending.request
        return self._apply(
            peer,
            sent.epoch,
            sent.snapshot,
            reply.snapshot,
            sent.measurements,
            True,
            sent.epoch.t_meas_ns,
            state,
            history,
        )

    def link_changed(self, event: LinkChange, state: RobotState, history: History) -> RobotState:
        """A peer appeared, fell silent or began a new life; a new life restarts the pair.

        Joint covariance <= blk(2 P_a, 2 P_b) whatever the correlation, so both sides double their own and start
        from P_ab = 0. A peer that restarts again within `restart_interval_ns` is not allowed to inflate us
        once more: its correlation is taken for unknown instead.
        """
        life = (event.incarnation, event.boot_id)
        before = self._lives.get(event.peer)
        self._lives[event.peer] = life
        if before is None or before == life:
            return state
        self.exchange(event.peer).restarted()
        if not state.pair(event.peer).base.met and not state.pair(event.peer).lines:
            return state
        state = self._restarted_pair(event.peer, event.t_ns, state)
        history.updated(state)
        return state

    def _restarted_pair(self, peer: str, now_ns: int, state: RobotState) -> RobotState:
        """Begin the pair anew: own covariance doubled, correlation zero.

        No peer may inflate us again within `restart_interval_ns`; its correlation counts as unknown until then.
        """
        last = self._inflated_ns.get(peer)
        if last is not None and now_ns - last < self._settings.localization.restart_interval_ns:
            self._counters["pair.restart_refused"] += 1
            return state.forgotten(peer, known=False)
        self._inflated_ns[peer] = now_ns
        self._counters["pair.restarts"] += 1
        return replace(state.forgotten(peer, known=True), cov=2.0 * state.cov)

    # -- estimation -----------------------------------------------------------------------------------------

    def _fits(self, told: Snapshot) -> bool:
        """Whether a peer's snapshot is of a robot and of the sizes that the pair's algebra needs."""
        layout = STATES.get(told.belief.model)
        if layout is None or layout.heading is None:
            return False
        square = (layout.dim, layout.dim)
        return (
            told.belief.cov.shape == square
            and (not told.base.met or told.factor.shape == (layout.dim, self._settings.layout.dim))
            and told.line.shape == square
            and all(line.matrix.shape == square for line in told.lines)
        )

    def _apply(
        self,
        peer: str,
        epoch: Epoch,
        initiator: Snapshot,
        responder: Snapshot,
        measurements: tuple[Measurement, ...],
        own_initiated: bool,
        t_ns: int,
        state: RobotState,
        history: History,
    ) -> RobotState:
        localization = self._settings.localization
        correlated = localization.correlation == "factors"
        other = responder if own_initiated else initiator
        own_is_low = self._settings.robot < peer
        try:
            found = contact(
                initiator,
                responder,
                own_is_low == own_initiated,
                measurements,
                correlated,
                self._options,
            )
        except OutOfViewError:
            self._counters["pair.out_of_view"] += 1
            return state
        except np.linalg.LinAlgError:
            self._counters["pair.indefinite"] += 1
            return state
        key = (Part.LINE, peer, epoch)
        then = history.first_with(key)
        psi = None if then is None else then.stack.block(key)
        if then is None or psi is None:
            self._counters["pair.line_lost"] += 1
            return state
        if found.cross is None:
            self._counters["pair.fallback"] += 1
            state = self._restarted_pair(peer, state.t_ns, state)
            history.updated(state)
            return state
        C_own = found.C_i if own_initiated else found.C_j
        update = pair_update(then.mean, then.cov, self._settings.layout, psi, C_own, found)
        after = found.cross_after if own_initiated else found.cross_after.T
        base = (peer, epoch, after if correlated else np.zeros_like(after))
        corrected = None if update is None else history.corrected(then.t_ns, update, base)
        if update is None or corrected is None:
            self._counters["update.not_positive_definite"] += 1
            return state
        state = self._fuse_targets(other, t_ns, corrected, correlated)
        history.updated(state)
        self._count_nis("pair_" + "+".join(item.kind for item in measurements), update.nis)
        self._counters["pair.applied_initiator" if own_initiated else "pair.applied_responder"] += 1
        return state

    def _fuse_targets(self, other: Snapshot, t_ns: int, state: RobotState, correlated: bool) -> RobotState:
        """Intersect the peer's target beliefs, predicted to the state's instant, with the own ones."""
        localization = self._settings.localization
        targets = dict(state.targets)
        for told in other.targets:
            own = targets.get(told.target)
            motion = self._motions.get(told.target)
            if own is None or motion is None or told.belief.model != motion.layout.name:
                self._counters["target.unknown"] += 1
                continue
            mean, cov = told.belief.mean, told.belief.cov
            if state.t_ns > t_ns:
                drifted = motion.drift(mean, cov, (state.t_ns - t_ns) * 1e-9, localization.transform)
                mean, cov = drifted.mean, drifted.cov
            angles = motion.layout.angles
            if correlated:
                mean, cov, _ = fuse(own.mean, own.cov, mean, cov, angles, localization.fusion_weight)
            else:
                gain = own.cov @ np.linalg.inv(own.cov + cov)
                mean = wrap_components(own.mean + gain @ wrap_components(mean - own.mean, angles), angles)
                cov = symmetrize(own.cov - gain @ own.cov)
            targets[told.target] = TargetState(mean, cov, state.t_ns)
        return replace(state, targets=targets) if targets else state


def _known_kinds(request: PairRequest) -> bool:
    return all(item.kind in RELATIVE_ANGLES for item in request.measurements)
