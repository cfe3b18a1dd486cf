"""The pair protocol: one request, one reply, no commit, no lock.

Rules
-----
1. The robot that owns a measurement of a peer at instant k initiates. It opens an identity line for the
   contact's epoch (k, initiator, counter), and sends its snapshot at k with the measurement.
2. The responder takes its own snapshot at k from its history, answers with it, and updates itself.
3. The initiator updates itself when the answer comes. Until then it repeats the same request after each time-out,
   as long as the responder can still have the instant in its history; then the transaction is forgotten. The line
   stays, because the responder may have updated itself.
4. Either update concerns the own belief only. The cross-covariance after a contact is the same whether one or
   both applied it, so a lost, late, repeated or reordered message can never make the factors inconsistent.
5. One contact of a pair is pending at a time. If both measure at once the lower id's contact wins: the higher gives
   its own up (and keeps its line) when the lower's request comes, and the lower answers BUSY to any request that was
   composed without knowing of its own latest one, for as long as the higher may still receive that. Otherwise each
   could use the other's snapshot from before its update, and the factors would miss what the two updates share.
6. A contact at or before the last applied one is superseded; a repeated request of the last one is answered
   with the same reply and not applied again; an instant that has left the history is answered TOO_OLD.
7. An answer other than OK proves that the responder did not apply the contact: its line is dropped.
8. A robot that is started again with its factors, which are those of its last message at least, has the same
   incarnation: what was pending is void on both sides, as if it had been lost, and nothing else changes. It no longer
   has the replies it gave, so a repeated request of the last contact applied is left without an answer.
9. A contact that the responder does not use because it is inconsistent (`agent.health`) is answered INCONSISTENT: by
   that the initiator knows that nobody has used it, and drops its line. No contact up to it is used later, whatever
   is repeated, and after a start as well. An initiator that does not use an answer for that reason keeps its line: the
   responder has used the contact, and the next one finds it as the peer's base, as if the answer had been lost.
10. If the correlation can't be recovered from the two snapshots (a line was forgotten, a side has lost its factors)
   both sides see that alike. Neither uses the measurement; each doubles its own covariance, once in a while at most,
   and the pair begins anew uncorrelated: blk(2 P_a, 2 P_b) bounds the joint covariance whatever the correlation.

Theory: with the innovation nu = H_i e_i + H_j e_j + v and the optimal gain, e_i+ is uncorrelated with nu, hence
E[e_i+ e_j^T] = E[e_i e_j+^T] = E[e_i+ e_j+^T]. A line Psi maps a robot's error at k to its error now, so
Cov(e_now, nu) = Psi C, and a contact can be applied late and one-sided, exactly for linear models.

This module decides; it does not estimate. `agent.core` carries the decisions out.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from agent.saved_state import SavedExchange
from network.messages import NEVER, Epoch, JointSnapshot, Measurement, PairReply, PairRequest, ReplyStatus, Snapshot


class Step(Enum):
    """What is to be done about something that happened to a pair."""

    OPEN = "open"
    SKIP_PENDING = "skip_pending"
    SKIP_THINNED = "skip_thinned"
    SKIP_STALE = "skip_stale"
    APPLY = "apply"
    APPLY_ABANDON_OWN = "apply_abandon_own"
    REPEAT_REPLY = "repeat_reply"
    ANSWER_BUSY = "answer_busy"
    ANSWER_INCONSISTENT = "answer_inconsistent"
    ANSWER_SUPERSEDED = "answer_superseded"
    DROP_LINE = "drop_line"
    IGNORE = "ignore"


@dataclass(frozen=True, slots=True, eq=False)
class Pending:
    """An own request on its way: what was sent, when to repeat it, and when to give up."""

    request: PairRequest
    deadline_ns: int
    give_up_ns: int

    @property
    def epoch(self) -> Epoch:
        return self.request.epoch


# (own request pending, own id lower, composed without knowing of the own latest request while that may still arrive)
# -> what a fresh request of the peer leads to
REQUEST_TABLE: dict[tuple[bool, bool, bool], Step] = {
    (False, False, False): Step.APPLY,
    (False, False, True): Step.APPLY,
    (False, True, False): Step.APPLY,
    (False, True, True): Step.ANSWER_BUSY,
    (True, False, False): Step.APPLY_ABANDON_OWN,
    (True, False, True): Step.APPLY_ABANDON_OWN,
    (True, True, False): Step.APPLY_ABANDON_OWN,
    (True, True, True): Step.ANSWER_BUSY,
}

# (it answers the pending request, its status is OK, its epoch is later than the base) -> what a reply leads to
REPLY_TABLE: dict[tuple[bool, bool, bool], Step] = {
    (True, True, True): Step.APPLY,
    (True, True, False): Step.IGNORE,
    (True, False, True): Step.DROP_LINE,
    (True, False, False): Step.DROP_LINE,
    (False, True, True): Step.IGNORE,
    (False, True, False): Step.IGNORE,
    (False, False, True): Step.DROP_LINE,
    (False, False, False): Step.DROP_LINE,
}


class PairExchange:
    """State of the protocol with one peer: the pending request and the last reply given."""

    def __init__(self, robot: str, peer: str, interval_ns: int, timeout_ns: int, horizon_ns: int) -> None:
        self._robot, self._peer = robot, peer
        self._interval_ns, self._timeout_ns, self._horizon_ns = interval_ns, timeout_ns, horizon_ns
        self._counter = 0
        self._last_reply: PairReply | None = None
        # The own latest request, and until when the peer may receive it.
        self._opened, self._until_ns = NEVER, 0
        # The latest contact of the peer that was inconsistent.
        self._refused = NEVER
        self.pending: Pending | None = None

    @property
    def is_low(self) -> bool:
        """Whether the own id sorts before the peer's."""
        return self._robot < self._peer

    def measured(self, t_ns: int, base: Epoch) -> Step:
        """A relative measurement of the peer at `t_ns`, the pair's last applied contact being `base`."""
        if self.pending is not None:
            return Step.SKIP_PENDING
        if base.met and t_ns <= base.t_meas_ns:
            return Step.SKIP_STALE
        if base.met and t_ns - base.t_meas_ns < self._interval_ns:
            return Step.SKIP_THINNED
        return Step.OPEN

    def open(
        self, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], snapshot: Snapshot | JointSnapshot
    ) -> PairRequest:
        """Open a contact; the caller keeps an identity line for the request's epoch and sends the request."""
        self._counter += 1
        request = PairRequest(Epoch(t_ns, self._robot, self._counter), measurements, snapshot)
        self.pending = Pending(request, now_ns + self._timeout_ns, t_ns + self._horizon_ns)
        self._opened, self._until_ns = request.epoch, self.pending.give_up_ns
        return request

    def requested(self, request: PairRequest, base: Epoch) -> Step:
        """The peer opened a contact; `base` is the last one applied here."""
        epoch = request.epoch
        if self._last_reply is not None and self._last_reply.epoch == epoch:
            return Step.REPEAT_REPLY
        if base.met and epoch == base:
            # Applied before a restart, and the answer is gone. A refusal would say that it was not applied.
            return Step.IGNORE
        if base.met and epoch <= base:
            return Step.ANSWER_SUPERSEDED
        if epoch <= self._refused:
            return Step.ANSWER_INCONSISTENT
        step = REQUEST_TABLE[self.pending is not None, self.is_low, self._crossed(request)]
        if step is Step.APPLY_ABANDON_OWN:
            self.pending = None
        return step

    def _crossed(self, request: PairRequest) -> bool:
        """Whether the peer may have composed the request before it received the own latest one.

        It can't have received that later than `give_up_ns`, so what was measured after that has not crossed it.
        """
        own = self._opened
        if not own.met or request.epoch.t_meas_ns > self._until_ns:
            return False
        told = request.snapshot
        return told.base < own and all(line.epoch != own for line in told.lines)

    def answered(self, reply: PairReply) -> PairReply:
        """Remember the reply given, for a repeated request."""
        self._last_reply = reply
        if reply.status is ReplyStatus.INCONSISTENT:
            self._refused = max(self._refused, reply.epoch)
        return reply

    @property
    def last_reply(self) -> PairReply | None:
        return self._last_reply

    def replied(self, reply: PairReply, base: Epoch) -> tuple[Step, Pending | None]:
        """The peer answered; returns the step and the request that is settled by it, if any."""
        pending = self.pending
        matches = pending is not None and pending.epoch == reply.epoch
        ok = reply.status is ReplyStatus.OK and reply.snapshot is not None
        step = REPLY_TABLE[matches, ok, reply.epoch > base]
        if matches:
            self.pending = None
        return step, pending if matches else None

    def expired(self, now_ns: int) -> PairRequest | None:
        """The pending request if it is due to be repeated now; it is forgotten when it is too old for that."""
        pending = self.pending
        if pending is None or now_ns < pending.deadline_ns:
            return None
        if now_ns >= pending.give_up_ns:
            self.pending = None
            return None
        deadline = min(now_ns + self._timeout_ns, pending.give_up_ns)
        self.pending = Pending(pending.request, deadline, pending.give_up_ns)
        return pending.request

    def restarted(self) -> None:
        """The peer began a new life: nothing of the old one will be answered."""
        self.pending = self._last_reply = None
        self._opened, self._until_ns = NEVER, 0
        self._refused = NEVER

    def resumed(self) -> None:
        """The peer was started again and has kept its factors: it may not know what is pending. The line stays."""
        self.pending = None

    def saved(self) -> SavedExchange:
        """What the own next life must remember."""
        return SavedExchange(self._counter, self._opened, self._until_ns, self._refused)

    def restore(self, saved: SavedExchange) -> None:
        """Go on after an earlier life of the own robot."""
        self._counter, self._opened, self._until_ns = saved.counter, saved.opened, saved.until_ns
        self._refused = saved.refused
