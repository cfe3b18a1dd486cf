"""A stranger on the air who sends under a robot's name, for tests: which packets, and when.

damaged    packets of that robot with bytes changed
hostile    packets of that robot with extreme values in them
replayed   packets of that robot as they were, again and again
stranger   well-formed hellos of another life
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from hashlib import blake2b
from struct import pack, unpack
from typing import Any, Literal

import msgpack

from network.faults import FOREVER_NS, Parcel, corrupted
from network.life_messages import Hello
from network.messages import Channel, Header, Packet
from network.wire import encode

Content = Literal["damaged", "hostile", "replayed", "stranger"]

KEPT = 64
"""Packets of the robot that a forger has to work with."""

HOSTILE = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 2**63 - 1, -(2**63), 2**64 - 1, -1, True, None)


@dataclass(frozen=True, slots=True)
class Forgery:
    """From `begin_ns` until `end_ns`, every `period_ns`, a packet under the name `claims` reaches `destinations`.

    `destinations` None: everybody but the robot itself.
    """

    name: str
    begin_ns: int
    end_ns: int
    claims: str
    destinations: frozenset[str] | None
    period_ns: int
    content: Content

    def reaches(self, robot: str) -> bool:
        """Whether its packets come to a robot."""
        return robot != self.claims and (self.destinations is None or robot in self.destinations)


class Forger:
    """Makes the packets of a forgery for one receiver, from what that receiver has seen of the robot."""

    def __init__(self, forgery: Forgery, seed: int, receiver: str) -> None:
        self.forgery = forgery
        self._seed, self._receiver = seed, receiver
        self._seen: deque[Packet] = deque(maxlen=KEPT)

    def seen(self, packet: Packet) -> None:
        """A genuine packet on its way to the receiver."""
        if packet.source == self.forgery.claims:
            self._seen.append(packet)

    def next_ns(self, after_ns: int) -> int | None:
        """Instant of the first packet after `after_ns`; None if there is no more."""
        begin, end, period = self.forgery.begin_ns, self.forgery.end_ns, self.forgery.period_ns
        number = 0 if after_ns < begin else (after_ns - begin) // period + 1
        t_ns = begin + number * period
        return t_ns if t_ns < end <= FOREVER_NS else None

    def packet(self, t_ns: int) -> Packet | None:
        """The packet that arrives at `t_ns`; None while there is nothing to make it from."""
        words = self._words(t_ns)
        if self.forgery.content == "stranger":
            # Another boot id each time, in the same incarnation: who claims a later one can't be told from the robot.
            header = Header(self.forgery.claims, words[0] >> 12, 1, 0, t_ns, t_ns)
            return Packet(self.forgery.claims, Channel.HELLO, None, encode(header, Hello("stranger")))
        if not self._seen:
            return None
        genuine = self._seen[words[0] % len(self._seen)]
        if self.forgery.content == "replayed":
            return genuine
        payload = genuine.payload
        if self.forgery.content == "hostile":
            payload = hostile(payload, words)
        else:
            parcel = Parcel(genuine.source, self._receiver, genuine.channel, 0, words[1] >> 1, t_ns)
            payload = corrupted(payload, self._seed, parcel)
        return Packet(genuine.source, genuine.channel, genuine.destination, payload)

    def _words(self, t_ns: int) -> tuple[int, int, int, int]:
        text = f"{self.forgery.name}/{self._receiver}/{t_ns}".encode()
        a, b, c, d = unpack("<4Q", blake2b(text, digest_size=32, key=pack("<Q", self._seed)).digest())
        return a, b, c, d


def hostile(payload: bytes, words: tuple[int, int, int, int]) -> bytes:
    """One value of a message, at any depth, replaced by an extreme one."""
    try:
        message: Any = msgpack.unpackb(payload, use_list=True)
    except (ValueError, TypeError, msgpack.UnpackException):
        return payload
    here, path = message, words[1]
    while isinstance(here, list) and here:
        index, path = path % len(here), path // len(here)
        if isinstance(here[index], list) and here[index]:
            here = here[index]
            continue
        value = here[index]
        # Arrays travel as bytes: eight of them become one extreme number.
        if isinstance(value, bytes) and len(value) >= 8:
            place = words[2] % (len(value) // 8) * 8
            extreme = pack("<d", (float("nan"), float("inf"), -1e308, 5e-324)[words[3] % 4])
            here[index] = value[:place] + extreme + value[place + 8 :]
        else:
            here[index] = HOSTILE[words[3] % len(HOSTILE)]
        break
    try:
        return bytes(msgpack.packb(message))
    except (OverflowError, ValueError):
        return payload
