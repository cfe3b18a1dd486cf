"""The link model: which packets arrive, how late, how often.

A packet's fate is a keyed hash of (source, destination, channel, incarnation, sequence number): nobody draws
in an order, so the virtual engine and real processes give equal packets equal fates. Only who is in range is
asked of the world, by a table of booleans that carries no position.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

from network.faults import UNHARMED, LinkFaults, Parcel, corrupted, exponential_ns, uniforms
from network.messages import Header, Packet
from network.wire_fields import MAX_INT, WireError, valid_id

MAX_TABLE_ROBOTS = 256
MAX_TABLE_BYTES = 16_384
TABLE_VERSION = 1

Pair = tuple[str, str]
"""(source, destination): the destination hears the source."""


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """How every link behaves.

    range_m       reach; None: everybody hears everybody
    hysteresis_m  an existing link breaks only beyond range_m + hysteresis_m
    nearest       a robot hears so many of those in range, the nearest; None: all
    rewire        a robot hears so many of those in range, drawn anew at every instant; None: all
    loss          probability that a packet is lost
    delay_s       shortest delay; up to `delay_spread_s`, evenly drawn, and an exponential tail of mean `delay_tail_s`
                  come on top
    duplicate     probability that a packet arrives twice
    """

    seed: int
    range_m: float | None = None
    hysteresis_m: float = 0.0
    nearest: int | None = None
    rewire: int | None = None
    loss: float = 0.0
    delay_s: float = 0.0
    delay_tail_s: float = 0.0
    duplicate: float = 0.0
    delay_spread_s: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**64:
            raise ValueError("seed must lie within 0 and 2**64 - 1")
        if self.range_m is not None and not 0.0 <= self.range_m < math.inf:
            raise ValueError("range_m must be finite and not negative, or None")
        for name in ("hysteresis_m", "delay_s", "delay_tail_s", "delay_spread_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative")
        for name in ("loss", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must lie within 0 and 1")
        for name in ("nearest", "rewire"):
            count = getattr(self, name)
            if count is not None and count < 1:
                raise ValueError(f"{name} must be at least 1, or None")

    @property
    def limited(self) -> bool:
        """Whether somebody may be out of hearing, so that the world has to tell who hears whom."""
        return self.range_m is not None or self.nearest is not None or self.rewire is not None


@dataclass(frozen=True, slots=True)
class Fate:
    """What the link does to one packet; `duplicate_delay_ns` None: it arrives once."""

    lost: bool
    delay_ns: int
    duplicate_delay_ns: int | None


def packet_fate(
    settings: LinkSettings, *, source: str, destination: str, channel: str, incarnation: int, seq: int
) -> Fate:
    """The fate of one packet, from nothing but the arguments.

    `destination` is the robot that would receive it, for a broadcast too.
    """
    parcel = Parcel(source, destination, channel, incarnation, seq, 0)
    loss, duplicate, tail, second_tail = uniforms(settings.seed, "", parcel)
    spread, second_spread = 0.0, 0.0
    if settings.delay_spread_s > 0.0:
        spread, second_spread, *_ = uniforms(settings.seed, "spread", parcel)
    return Fate(
        lost=loss < settings.loss,
        delay_ns=_delay_ns(settings, tail, spread),
        duplicate_delay_ns=_delay_ns(settings, second_tail, second_spread) if duplicate < settings.duplicate else None,
    )


def _delay_ns(settings: LinkSettings, tail: float, spread: float) -> int:
    least_ns = round((settings.delay_s + spread * settings.delay_spread_s) * 1e9)
    return least_ns + exponential_ns(settings.delay_tail_s * 1e9, tail)


@dataclass(frozen=True, slots=True)
class FateRecord:
    """One line of the fate log. `duplicate`: the packet arrived more than once; `cause`: the fault that lost it."""

    source: str
    destination: str
    channel: str
    incarnation: int
    seq: int
    t_send_ns: int
    in_range: bool
    lost: bool
    delay_ns: int
    duplicate: bool
    cause: str = ""
    corrupted: bool = False


FATE_COLUMNS = tuple(field.name for field in fields(FateRecord))


def fate_row(record: FateRecord) -> list[Any]:
    """A line of the fate log; columns as in FATE_COLUMNS."""
    return [int(value) if isinstance(value, bool) else value for value in (getattr(record, n) for n in FATE_COLUMNS)]


@dataclass(frozen=True, slots=True)
class Decision:
    """Delays [ns] after which a packet arrives, none if it does not; and whether it is damaged on its way."""

    delays_ns: tuple[int, ...]
    corrupted: bool = False


LinkState = Callable[[str, str, int], bool]
"""(source, destination, t_send_ns) -> whether the destination hears the source."""


class LinkModel:
    """Decides for every packet. `link_state` is asked only when the settings are `limited`.

    `faults` come on top of what is true of all links at all times.
    """

    def __init__(
        self,
        settings: LinkSettings,
        link_state: LinkState,
        log: Callable[[FateRecord], None] | None = None,
        faults: LinkFaults | None = None,
    ) -> None:
        self.settings = settings
        self.faults = faults if faults is not None else LinkFaults(settings.seed)
        self.counters: Counter[str] = Counter()
        self._link_state = link_state
        self._limited = settings.limited
        self._log = log
        drawn = (settings.loss, settings.duplicate, settings.delay_tail_s, settings.delay_spread_s)
        self._only_fate = None if max(drawn) > 0.0 else Fate(False, _delay_ns(settings, 0.0, 0.0), None)

    def carry(self, packet: Packet, header: Header, destination: str, t_send_ns: int) -> list[tuple[int, Packet]]:
        """(delay [ns], packet) of everything that arrives of a packet sent at `t_send_ns` of fleet time."""
        parcel = Parcel(
            packet.source,
            destination,
            packet.channel,
            header.incarnation,
            header.seq,
            t_send_ns,
            len(packet.payload),
        )
        decision = self.decide(parcel)
        if decision.corrupted:
            packet = replace(packet, payload=corrupted(packet.payload, self.settings.seed, parcel))
        return [(delay_ns, packet) for delay_ns in decision.delays_ns]

    def decide(self, parcel: Parcel) -> Decision:
        """What becomes of a packet.

        Counted as `out_of_range`, `lost`, or `delivered` and `duplicated`, `corrupted`; lost by a fault also as
        `fault.<name>`.
        """
        fate = self._only_fate or packet_fate(
            self.settings,
            source=parcel.source,
            destination=parcel.destination,
            channel=parcel.channel,
            incarnation=parcel.incarnation,
            seq=parcel.seq,
        )
        in_range = not self._limited or self._link_state(parcel.source, parcel.destination, parcel.t_send_ns)
        arrives = in_range and not fate.lost
        effect = self.faults.on(parcel) if arrives and self.faults.faults else UNHARMED
        delays_ns: tuple[int, ...] = ()
        if effect.cause is not None:
            arrives = False
            self.counters[f"fault.{effect.cause}"] += 1
        if arrives:
            delays_ns = (fate.delay_ns + effect.delay_ns, *(fate.delay_ns + copy for copy in effect.copies_ns))
            if fate.duplicate_delay_ns is not None:
                delays_ns += (fate.duplicate_delay_ns + effect.delay_ns,)
            self.counters["duplicated"] += len(delays_ns) - 1
            self.counters["corrupted"] += effect.corrupted
        self.counters["delivered" if arrives else "lost" if in_range else "out_of_range"] += 1
        if self._log is not None:
            self._log(
                FateRecord(
                    parcel.source,
                    parcel.destination,
                    parcel.channel,
                    parcel.incarnation,
                    parcel.seq,
                    parcel.t_send_ns,
                    in_range,
                    fate.lost or effect.cause is not None,
                    fate.delay_ns + effect.delay_ns,
                    len(delays_ns) > 1,
                    effect.cause or "",
                    effect.corrupted,
                )
            )
        return Decision(delays_ns, effect.corrupted)


# --- who hears whom ---------------------------------------------------------------------------------------


def hear(
    previous: ArrayLike, distance_m: ArrayLike, range_m: float | None, hysteresis_m: float = 0.0
) -> NDArray[np.bool_]:
    """Who hears whom at these distances, given who did before; of any common shape."""
    before, distance = np.asarray(previous, dtype=bool), np.asarray(distance_m, dtype=float)
    if range_m is None:
        return np.ones(np.broadcast(before, distance).shape, dtype=bool)
    return np.asarray(distance <= np.where(before, range_m + hysteresis_m, range_m))


def lowest(rank: ArrayLike, count: int) -> NDArray[np.bool_]:
    """Who hears whom (n, n), by (source, destination): each destination its `count` sources of lowest `rank` (n, n).

    Nobody hears himself, nor a source of infinite rank. Of equal ones the first is heard.
    """
    values = np.array(rank, dtype=float)
    np.fill_diagonal(values, np.inf)
    place = np.argsort(np.argsort(values, axis=0, kind="stable"), axis=0, kind="stable")
    return np.asarray((place < count) & np.isfinite(values))


class RangeTable:
    """Who hears whom, over time: each publication holds until the next. At most `capacity` are kept."""

    def __init__(self, capacity: int = 512) -> None:
        self.capacity = capacity
        self._times: list[int] = []
        self._pairs: list[frozenset[Pair]] = []

    def publish(self, t_ns: int, pairs: Iterable[Pair]) -> None:
        """From `t_ns` on exactly these (source, destination) are in range; may come in any order of time."""
        index = bisect_right(self._times, t_ns)
        if index and self._times[index - 1] == t_ns:
            self._pairs[index - 1] = frozenset(pairs)
            return
        self._times.insert(index, t_ns)
        self._pairs.insert(index, frozenset(pairs))
        del self._times[: -self.capacity], self._pairs[: -self.capacity]

    def state(self, source: str, destination: str, t_send_ns: int) -> bool:
        """Whether `destination` hears `source`; before the first publication kept, as in it; if none, no."""
        if not self._times:
            return False
        index = max(0, bisect_right(self._times, t_send_ns) - 1)
        return (source, destination) in self._pairs[index]

    def __len__(self) -> int:
        return len(self._times)


def encode_table(t_ns: int, robots: Iterable[str], pairs: Iterable[Pair]) -> bytes:
    """One publication as msgpack `[version, t_ns, ids, bits]`, bits row by row by (source, destination).

    Raises ValueError if a pair names somebody who is not among `robots`, or there are too many.
    """
    ids = sorted(robots)
    if len(ids) > MAX_TABLE_ROBOTS:
        raise ValueError(f"at most {MAX_TABLE_ROBOTS} robots")
    index = {robot: k for k, robot in enumerate(ids)}
    heard = np.zeros((len(ids), len(ids)), dtype=bool)
    for source, destination in pairs:
        if source not in index or destination not in index:
            raise ValueError("pairs name a robot that is not listed")
        heard[index[source], index[destination]] = True
    payload: bytes = msgpack.packb((TABLE_VERSION, t_ns, ids, np.packbits(heard).tobytes()))
    return payload


def decode_table(payload: bytes) -> tuple[int, frozenset[Pair]]:
    """(t_ns, pairs) for `RangeTable.publish`. Raises WireError on anything else than a table."""
    if len(payload) > MAX_TABLE_BYTES:
        raise WireError("oversize")
    try:
        raw: Any = msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, TypeError, msgpack.UnpackException):
        raise WireError("malformed") from None
    if type(raw) is not tuple or len(raw) != 4:
        raise WireError("malformed")
    version, t_ns, ids, bits = raw
    if type(version) is not int or type(t_ns) is not int or type(ids) is not tuple or type(bits) is not bytes:
        raise WireError("wrong_type")
    if version != TABLE_VERSION:
        raise WireError("unknown_version")
    if not 0 <= t_ns <= MAX_INT or len(ids) > MAX_TABLE_ROBOTS:
        raise WireError("out_of_range")
    if not all(type(robot) is str and valid_id(robot) for robot in ids):
        raise WireError("bad_id")
    n = len(ids)
    if len(bits) != (n * n + 7) // 8:
        raise WireError("malformed")
    heard = np.unpackbits(np.frombuffer(bits, dtype=np.uint8), count=n * n).reshape(n, n)
    return t_ns, frozenset((ids[row], ids[column]) for row, column in np.argwhere(heard).tolist())
