"""Link faults at the receiver, around a real transport: the same fates as in virtual time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial

from network.links import LinkModel
from network.messages import Packet
from network.transport import OnPacket
from network.wire import peek_header

CallLater = Callable[[int, Callable[[], None]], object]
"""Schedules a call after so many nanoseconds of fleet time."""


def _as_stamped(source: str, t_send_ns: int) -> int:
    return t_send_ns


class LinkInjector:
    """Stands between a transport and its receiver `deliver`, and asks the link model about every packet.

    `sent_at` makes fleet time of a sender's stamp.
    A packet is delayed until its send stamp plus the drawn delay, so the transport's own latency counts in.
    """

    def __init__(
        self,
        robot: str,
        links: LinkModel,
        now_ns: Callable[[], int],
        call_later: CallLater,
        deliver: OnPacket,
        sent_at: Callable[[str, int], int] = _as_stamped,
    ) -> None:
        self._robot, self._links, self._now_ns, self._sent_at = robot, links, now_ns, sent_at
        self._call_later, self._deliver = call_later, deliver
        self.counters: Counter[str] = Counter()

    def on_packet(self, packet: Packet) -> None:
        """To be given to the transport as its receive callback."""
        header = peek_header(packet.payload)
        if header is None:
            # Rubbish has no fate of its own; the endpoint counts it.
            self._deliver(packet)
            return
        sent_ns = self._sent_at(packet.source, header.t_send_ns)
        arrivals = self._links.carry(packet, header, self._robot, sent_ns)
        self.counters["lost" if not arrivals else "delivered"] += 1
        for delay, arriving in arrivals:
            # Nobody sends in the future: a stamp that says so must not hold a packet for longer than its delay.
            wait = min(delay, sent_ns + delay - self._now_ns())
            if delay == 0 or wait <= 0:
                self._deliver(arriving)
            else:
                self._call_later(wait, partial(self._deliver, arriving))
