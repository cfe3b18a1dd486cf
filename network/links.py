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
from dataclasses import dataclass
from hashlib import blake2b
from struct import pack, unpack
from typing import Any

import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

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
    loss          probability that a packet is lost
    delay_s       shortest delay; an exponential tail of mean `delay_tail_s` comes on top
    duplicate     probability that a packet arrives twice
    """

    seed: int
    range_m: float | None = None
    hysteresis_m: float = 0.0
    loss: float = 0.0
    delay_s: float = 0.0
    delay_tail_s: float = 0.0
    duplicate: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 2**64:
            raise ValueError("seed must lie within 0 and 2**64 - 1")
        if self.range_m is not None and not 0.0 <= self.range_m < math.inf:
            raise ValueError("range_m must be finite and not negative, or None")
        for name in ("hysteresis_m", "delay_s", "delay_tail_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and not negative")
        for name in ("loss", "duplicate"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must lie within 0 and 1")


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
    digest = blake2b(digest_size=32, key=pack("<Q", settings.seed))
    for text in (source, destination, channel):
        encoded = text.encode()
        digest.update(pack("<I", len(encoded)) + encoded)
    digest.update(pack("<QQ", incarnation, seq))
    loss, duplicate, tail, second_tail = (word * 2.0**-64 for word in unpack("<4Q", digest.digest()))
    return Fate(
        lost=loss < settings.loss,
        delay_ns=_delay_ns(settings, tail),
        duplicate_delay_ns=_delay_ns(settings, second_tail) if duplicate < settings.duplicate else None,
    )


def _delay_ns(settings: LinkSettings, uniform: float) -> int:
    tail_s = -settings.delay_tail_s * math.log1p(-min(uniform, 1.0 - 2.0**-53))
    return round((settings.delay_s + tail_s) * 1e9)


@dataclass(frozen=True, slots=True)
class FateRecord:
    """One line of the fate log. `duplicate`: the packet arrived twice."""

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


LinkState = Callable[[str, str, int], bool]
"""(source, destination, t_send_ns) -> whether the destination hears the source."""


class LinkModel:
    """Decides for every packet. `link_state` is asked only when `settings.range_m` is set."""

    def __init__(
        self,
        settings: LinkSettings,
        link_state: LinkState,
        log: Callable[[FateRecord], None] | None = None,
    ) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self._link_state = link_state
        self._log = log

    def decide(
        self, *, source: str, destination: str, channel: str, incarnation: int, seq: int, t_send_ns: int
    ) -> list[int]:
        """Delays [ns] after which the packet arrives: none, one, or two.

        Counted as `out_of_range`, `lost`, or `delivered` and `duplicated`.
        """
        fate = packet_fate(
            self.settings,
            source=source,
            destination=destination,
            channel=channel,
            incarnation=incarnation,
            seq=seq,
        )
        in_range = self.settings.range_m is None or self._link_state(source, destination, t_send_ns)
        arrives = in_range and not fate.lost
        duplicate_ns = fate.duplicate_delay_ns if arrives else None
        self.counters["delivered" if arrives else "lost" if in_range else "out_of_range"] += 1
        if duplicate_ns is not None:
            self.counters["duplicated"] += 1
        if self._log is not None:
            self._log(
                FateRecord(
                    source,
                    destination,
                    channel,
                    incarnation,
                    seq,
                    t_send_ns,
                    in_range,
                    fate.lost,
                    fate.delay_ns,
                    duplicate_ns is not None,
                )
            )
        if not arrives:
            return []
        return [fate.delay_ns] if duplicate_ns is None else [fate.delay_ns, duplicate_ns]


# --- who hears whom ---------------------------------------------------------------------------------------


def hear(
    previous: ArrayLike, distance_m: ArrayLike, range_m: float | None, hysteresis_m: float = 0.0
) -> NDArray[np.bool_]:
    """Who hears whom at these distances, given who did before; of any common shape."""
    before, distance = np.asarray(previous, dtype=bool), np.asarray(distance_m, dtype=float)
    if range_m is None:
        return np.ones(np.broadcast(before, distance).shape, dtype=bool)
    return np.asarray(distance <= np.where(before, range_m + hysteresis_m, range_m))


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
