"""The exchange between robots that keep no correlation factors: one request, one reply, nothing to repair.

Rules
-----
1. The robot that owns a measurement of a peer at instant k sends its belief at k with the measurement. It repeats
   the request until it is answered, as long as the responder can still have the instant in its history.
2. The responder answers with its own belief at k from its history, and updates itself. A repeated request is answered
   with the same reply and not applied again.
3. The initiator updates itself when the answer comes, once.
4. Either update concerns the own belief only, and is right whatever the other side did: what a peer has been told
   counts as correlated in an unknown way from then on (`agent.estimation.split_joint`). So any message may be lost,
   late, repeated or reordered, requests may cross, and a peer may begin a new life at any time.
"""

from __future__ import annotations

from dataclasses import dataclass

from network.messages import Epoch, Measurement, SplitReply, SplitRequest, SplitSnapshot

MAX_PENDING = 8
"""Requests to one peer that may wait for their answers at a time."""

MAX_ANSWERED = 64
"""Replies to one peer that are kept in case a request is repeated."""


@dataclass(slots=True, eq=False)
class Pending:
    """An own request on its way: what was sent, when to repeat it, and when to give up."""

    request: SplitRequest
    deadline_ns: int
    give_up_ns: int


class SplitExchange:
    """Requests and replies between the own robot and one peer."""

    def __init__(self, robot: str, timeout_ns: int, horizon_ns: int) -> None:
        self._robot, self._timeout_ns, self._horizon_ns = robot, timeout_ns, horizon_ns
        self._counter = 0
        self._pending: dict[Epoch, Pending] = {}
        self._answered: dict[Epoch, SplitReply | None] = {}

    @property
    def full(self) -> bool:
        """Whether as many requests wait as may."""
        return len(self._pending) >= MAX_PENDING

    @property
    def waiting(self) -> int:
        """Requests that wait for their answers."""
        return len(self._pending)

    def open(
        self, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], snapshot: SplitSnapshot
    ) -> SplitRequest:
        """The request of a new contact at instant `t_ns`."""
        self._counter += 1
        request = SplitRequest(Epoch(t_ns, self._robot, self._counter), measurements, snapshot)
        self._pending[request.epoch] = Pending(request, now_ns + self._timeout_ns, t_ns + self._horizon_ns)
        return request

    def known(self, epoch: Epoch) -> bool:
        """Whether a peer's request has been dealt with before."""
        return epoch in self._answered

    def reply_to(self, epoch: Epoch) -> SplitReply | None:
        """The reply that was given; None if the request was not answered."""
        return self._answered.get(epoch)

    def answered(self, epoch: Epoch, reply: SplitReply | None) -> None:
        """Remember what became of a peer's request."""
        self._answered[epoch] = reply
        if len(self._answered) > MAX_ANSWERED:
            del self._answered[next(iter(self._answered))]

    def replied(self, epoch: Epoch) -> SplitRequest | None:
        """The own request that a reply settles; None if there is none, or no longer."""
        pending = self._pending.pop(epoch, None)
        return None if pending is None else pending.request

    def expired(self, now_ns: int) -> tuple[list[SplitRequest], int]:
        """Requests to be repeated now, and how many were given up."""
        repeat, gone = [], []
        for epoch, pending in self._pending.items():
            if now_ns < pending.deadline_ns:
                continue
            if now_ns >= pending.give_up_ns:
                gone.append(epoch)
                continue
            pending.deadline_ns = min(now_ns + self._timeout_ns, pending.give_up_ns)
            repeat.append(pending.request)
        for epoch in gone:
            del self._pending[epoch]
        return repeat, len(gone)

    def deadline_ns(self) -> int:
        """When `expired` has something to do next, if a request waits."""
        return min(pending.deadline_ns for pending in self._pending.values())

    def restarted(self) -> None:
        """The peer began a new life: nothing of the old one will be answered, or asked again."""
        self._pending.clear()
        self._answered.clear()
