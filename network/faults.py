"""Faults of links: what a schedule does to a packet, as a function of the link, the instant and the packet's identity.

Nobody draws in an order: each draw is a keyed hash of the fault's name and the packet, and spells of a bursty link are
a renewal process keyed by the fault's name and the link. So the virtual engine and the receivers of real processes give
equal packets equal fates. A rate cap alone depends on what was sent before.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from struct import pack, unpack

FOREVER_NS = 2**62
MAX_SPELLS = 100_000


@dataclass(frozen=True, slots=True)
class Links:
    """Which directed links: from any of `sources` to any of `destinations` (None: everybody).

    With `both_ways` the opposite ones too. `groups`: instead, all links between robots of different groups; who is in
    none is a group of its own.
    """

    sources: frozenset[str] | None = None
    destinations: frozenset[str] | None = None
    both_ways: bool = True
    groups: tuple[frozenset[str], ...] = ()

    def contain(self, source: str, destination: str) -> bool:
        """Whether the link from `source` to `destination` is one of them."""
        if self.groups:
            return self._group(source) != self._group(destination)
        return self._one_way(source, destination) or (self.both_ways and self._one_way(destination, source))

    def _one_way(self, source: str, destination: str) -> bool:
        return (self.sources is None or source in self.sources) and (
            self.destinations is None or destination in self.destinations
        )

    def _group(self, robot: str) -> int | str:
        return next((index for index, group in enumerate(self.groups) if robot in group), robot)


ALL_LINKS = Links()


@dataclass(frozen=True, slots=True)
class LinkFault:
    """Something that is wrong with `links` from `begin_ns` until `end_ns`; `name` keys its draws.

    cut              nothing gets through (partition, isolation)
    clog             nothing gets through before `end_ns`, then everything at once
    loss             probability that a packet is lost
    burst_loss       probability that it is lost while the link is bad, as it is for spells of mean `bad_ns` between
                     spells of mean `good_ns`, both exponential (Gilbert-Elliott)
    delay_ns, delay_tail_ns   additional delay, and the mean of an exponential one on top
    duplicate        probability that it arrives twice, the second time up to `again_ns` later (evenly drawn)
    corrupt          probability that bytes of it are changed
    bytes_per_s      rate that the link can carry; what waits for more than `queue_ns` is lost
    """

    name: str
    begin_ns: int = 0
    end_ns: int = FOREVER_NS
    links: Links = ALL_LINKS
    cut: bool = False
    clog: bool = False
    loss: float = 0.0
    burst_loss: float = 0.0
    good_ns: int = 0
    bad_ns: int = 0
    delay_ns: int = 0
    delay_tail_ns: int = 0
    duplicate: float = 0.0
    again_ns: int = 0
    corrupt: float = 0.0
    bytes_per_s: float | None = None
    queue_ns: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.begin_ns <= self.end_ns:
            raise ValueError(f"{self.name}: 0 <= begin_ns <= end_ns must hold")
        for name in ("loss", "burst_loss", "duplicate", "corrupt"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{self.name}: {name} must lie within 0 and 1")
        for name in ("good_ns", "bad_ns", "delay_ns", "delay_tail_ns", "again_ns", "queue_ns"):
            if getattr(self, name) < 0:
                raise ValueError(f"{self.name}: {name} must not be negative")
        if self.burst_loss > 0.0 and not (self.good_ns > 0 and self.bad_ns > 0):
            raise ValueError(f"{self.name}: burst_loss needs good_ns and bad_ns above 0")
        if self.bytes_per_s is not None and not 0.0 < self.bytes_per_s < math.inf:
            raise ValueError(f"{self.name}: bytes_per_s must be above 0 and finite, or None")


@dataclass(frozen=True, slots=True)
class Parcel:
    """What of a packet its fate depends on: who sent it to whom, which one it is, when, and its size in bytes."""

    source: str
    destination: str
    channel: str
    incarnation: int
    seq: int
    t_send_ns: int
    size: int = 0


@dataclass(frozen=True, slots=True)
class Effect:
    """What faults do to a packet: `cause` names the fault that loses it, `copies_ns` are delays of further copies."""

    cause: str | None = None
    delay_ns: int = 0
    copies_ns: tuple[int, ...] = ()
    corrupted: bool = False


UNHARMED = Effect()


def uniforms(seed: int, name: str, parcel: Parcel) -> tuple[float, float, float, float]:
    """Four numbers in [0, 1) that belong to a packet under a name, or under none."""
    digest = blake2b(digest_size=32, key=pack("<Q", seed))
    for text in (*((name,) if name else ()), parcel.source, parcel.destination, parcel.channel):
        encoded = text.encode()
        digest.update(pack("<I", len(encoded)) + encoded)
    digest.update(pack("<QQ", parcel.incarnation, parcel.seq))
    a, b, c, d = (word * 2.0**-64 for word in unpack("<4Q", digest.digest()))
    return a, b, c, d


def exponential_ns(mean_ns: float, uniform: float) -> int:
    """An exponentially distributed time, from a number in [0, 1]."""
    return round(-mean_ns * math.log1p(-min(uniform, 1.0 - 2.0**-53)))


class Spells:
    """When a link is bad: good and bad spells in turns since `begin_ns`, a function of seed, name and link alone."""

    def __init__(self, seed: int, fault: LinkFault, source: str, destination: str) -> None:
        self._key = (seed, fault.name, source, destination)
        self._means = (fault.good_ns, fault.bad_ns)
        self._ends = [fault.begin_ns]

    def bad(self, t_ns: int) -> bool:
        """Whether the link is bad at `t_ns`, at or after the fault's begin."""
        while self._ends[-1] <= t_ns and len(self._ends) < MAX_SPELLS:
            index = len(self._ends) - 1
            seed, name, source, destination = self._key
            uniform = uniforms(seed, name, Parcel(source, destination, "spell", 0, index, 0))[0]
            self._ends.append(self._ends[-1] + 1 + exponential_ns(self._means[index % 2], uniform))
        # Spell k, between ends k and k + 1, is bad if k is odd.
        return bisect_right(self._ends, t_ns) % 2 == 0


@dataclass(slots=True)
class LinkFaults:
    """The faults of all links; more of them may be added while it is in use."""

    seed: int
    faults: list[LinkFault] = field(default_factory=list)
    _spells: dict[tuple[str, str, str], Spells] = field(default_factory=dict)
    _free_ns: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def add(self, faults: Iterable[LinkFault]) -> None:
        """More faults. Raises `ValueError` if a name is in use: its draws would be the same."""
        for fault in faults:
            if any(known.name == fault.name for known in self.faults):
                raise ValueError(f"there is a fault '{fault.name}' already")
            self.faults.append(fault)

    def end(self, name: str, t_ns: int) -> bool:
        """End a fault at `t_ns`; False if there is none of that name, or it is over by then."""
        for index, fault in enumerate(self.faults):
            if fault.name == name and fault.end_ns > t_ns:
                self.faults[index] = replace(fault, begin_ns=min(fault.begin_ns, t_ns), end_ns=t_ns)
                return True
        return False

    def active(self, t_ns: int) -> list[str]:
        """Names of the faults at an instant."""
        return [fault.name for fault in self.faults if fault.begin_ns <= t_ns < fault.end_ns]

    def on(self, parcel: Parcel) -> Effect:
        """What happens to a packet, by the faults at the instant it is sent."""
        found = UNHARMED
        for fault in self.faults:
            if not fault.begin_ns <= parcel.t_send_ns < fault.end_ns:
                continue
            if not fault.links.contain(parcel.source, parcel.destination):
                continue
            found = self._suffered(fault, parcel, found)
            if found.cause is not None:
                break
        return found

    def _suffered(self, fault: LinkFault, parcel: Parcel, before: Effect) -> Effect:
        if fault.cut:
            return Effect(fault.name)
        lost, late, twice, changed = uniforms(self.seed, fault.name, parcel)
        if lost < fault.loss or (lost < fault.burst_loss and self._bad(fault, parcel)):
            return Effect(fault.name)
        delay_ns = before.delay_ns + fault.delay_ns + exponential_ns(fault.delay_tail_ns, late)
        if fault.clog:
            delay_ns += fault.end_ns - parcel.t_send_ns
        if fault.bytes_per_s is not None:
            waited_ns = self._queued(fault, parcel)
            if waited_ns is None:
                return Effect(fault.name)
            delay_ns += waited_ns
        copies_ns = before.copies_ns
        if twice < fault.duplicate:
            # The number is evenly distributed below `duplicate`.
            copies_ns += (delay_ns + round(fault.again_ns * twice / fault.duplicate),)
        return Effect(None, delay_ns, copies_ns, before.corrupted or changed < fault.corrupt)

    def _bad(self, fault: LinkFault, parcel: Parcel) -> bool:
        key = (fault.name, parcel.source, parcel.destination)
        if key not in self._spells:
            self._spells[key] = Spells(self.seed, fault, parcel.source, parcel.destination)
        return self._spells[key].bad(parcel.t_send_ns)

    def _queued(self, fault: LinkFault, parcel: Parcel) -> int | None:
        """How long a packet waits and travels under a rate cap; None: the queue is full."""
        assert fault.bytes_per_s is not None
        key = (fault.name, parcel.source, parcel.destination)
        begin_ns = max(self._free_ns.get(key, 0), parcel.t_send_ns)
        if begin_ns - parcel.t_send_ns > fault.queue_ns:
            return None
        self._free_ns[key] = begin_ns + round(parcel.size / fault.bytes_per_s * 1e9)
        return self._free_ns[key] - parcel.t_send_ns


def corrupted(payload: bytes, seed: int, parcel: Parcel) -> bytes:
    """A payload with one to four of its bytes changed, the same ones whenever it is asked for."""
    if not payload:
        return payload
    digest = blake2b(digest_size=33, key=pack("<Q", seed))
    digest.update(f"{parcel.source}/{parcel.destination}/{parcel.channel}/{parcel.incarnation}/{parcel.seq}".encode())
    draw, changed = digest.digest(), bytearray(payload)
    for index in range(1 + draw[0] % 4):
        place, value = unpack("<IB", draw[1 + 5 * index : 6 + 5 * index])
        # Never the byte that was there.
        changed[place % len(changed)] = (changed[place % len(changed)] + 1 + value % 255) % 256
    return bytes(changed)
