"""What a peer can send: genuine messages, changed in every way that a decoder may fall for.

Changes of bytes and of values are those of the forger (`network.forgery`, `network.faults`); those of framing and of
headers are made here.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import msgpack

from network.faults import Parcel, corrupted
from network.forgery import HOSTILE, hostile
from network.messages import MAX_MESSAGE_BYTES

STAMPS = (0, 1, 2**31, 2**53, 2**62, 2**63 - 1, 2**64 - 1, -1)

LENGTHS = (
    *(bytes([mark]) + b"\xff\xff" for mark in (0xC5, 0xC8, 0xCD, 0xDA, 0xDC, 0xDE)),
    *(bytes([mark]) + b"\xff\xff\xff\xff" for mark in (0xC6, 0xC9, 0xDB, 0xDD, 0xDF)),
    *(bytes([mark]) for mark in (0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, 0xC0, 0xC1, 0xC4, 0xC7, 0xD4, 0xD8)),
)
"""Marks of msgpack that promise more, less or other things than follow."""


def words(rng: Random) -> tuple[int, int, int, int]:
    return rng.getrandbits(64), rng.getrandbits(64), rng.getrandbits(64), rng.getrandbits(64)


def bits_flipped(rng: Random, payload: bytes, other: bytes) -> bytes:
    changed = bytearray(payload)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def bytes_changed(rng: Random, payload: bytes, other: bytes) -> bytes:
    return corrupted(payload, 0, Parcel("", "", "", 0, rng.getrandbits(63), 0))


def truncated(rng: Random, payload: bytes, other: bytes) -> bytes:
    return payload[: rng.randrange(len(payload))]


def lengthened(rng: Random, payload: bytes, other: bytes) -> bytes:
    return payload + rng.randbytes(rng.choice((1, 8, 64, MAX_MESSAGE_BYTES)))


def spliced(rng: Random, payload: bytes, other: bytes) -> bytes:
    """The head of one message and the tail of another, cut anywhere."""
    return payload[: rng.randrange(len(payload))] + other[rng.randrange(len(other)) :]


def lengths_lied(rng: Random, payload: bytes, other: bytes) -> bytes:
    lie, place = rng.choice(LENGTHS), rng.randrange(len(payload))
    return payload[:place] + lie + payload[place + len(lie) * rng.randrange(2) :]


def nested(rng: Random, payload: bytes, other: bytes) -> bytes:
    """The message, or something within it, at the bottom of many arrays."""
    mark = rng.choice((b"\x91", b"\x92\xc0", b"\x81\xa0", b"\xdc\x00\x01"))
    depth = rng.randrange(1, MAX_MESSAGE_BYTES // len(mark))
    place = rng.choice((0, rng.randrange(len(payload))))
    return (payload[:place] + mark * depth + payload[place:])[:MAX_MESSAGE_BYTES]


def values_extreme(rng: Random, payload: bytes, other: bytes) -> bytes:
    return hostile(payload, words(rng))


def _leaf(rng: Random, message: Any) -> tuple[list[Any], int] | None:
    """Where any value of a message is, at any depth."""
    here = message
    while isinstance(here, list) and here:
        index = rng.randrange(len(here))
        if not isinstance(here[index], list) or not here[index] or rng.random() < 0.1:
            return here, index
        here = here[index]
    return None


def types_wrong(rng: Random, payload: bytes, other: bytes) -> bytes:
    """One value replaced by one of another type, by a part of another message, twice, or not at all."""
    message, foreign = msgpack.unpackb(payload, use_list=True), msgpack.unpackb(other, use_list=True)
    found, part = _leaf(rng, message), _leaf(rng, foreign)
    if found is None or part is None:
        return payload
    here, index = found
    match rng.randrange(5):
        case 0:
            here[index] = part[0][part[1]]
        case 1:
            here.insert(index, here[index])
        case 2:
            del here[index]
        case 3:
            here[index] = rng.choice((*HOSTILE, "", b"", "r1", [], {}, [[]], 0, 0.0, 1, msgpack.ExtType(5, b"x")))
        case _:
            here[index] = rng.choice((str, lambda value: [value], lambda value: {"": value}))(here[index])
    return packed(message, payload)


def header_lied(rng: Random, payload: bytes, other: bytes) -> bytes:
    """A field of the header that is not what it should be: foreign, of another life, of another time, or repeated."""
    message: Any = msgpack.unpackb(payload, use_list=True)
    head = message[0] if isinstance(message, list) and message else None
    if not isinstance(head, list) or len(head) != 7:
        return payload
    index = rng.randrange(len(head))
    if index == 1:
        head[1] = rng.choice(("r1", "r2", "r3", "stranger", "R1", "", "r" * 25, "../r1", "r1\x00"))
    else:
        shift = rng.choice((1, -1)) * 10 ** rng.randrange(20)
        head[index] = rng.choice((rng.choice(STAMPS), head[index] + shift, rng.getrandbits(63)))
    return packed(message, payload)


def packed(message: Any, otherwise: bytes) -> bytes:
    """The message as bytes; what no msgpack can hold leaves it as it was."""
    try:
        return bytes(msgpack.packb(message))
    except (OverflowError, ValueError, TypeError):
        return otherwise


def unchanged(rng: Random, payload: bytes, other: bytes) -> bytes:
    return payload


MUTATIONS: dict[str, Callable[[Random, bytes, bytes], bytes]] = {
    "bits flipped": bits_flipped,
    "bytes changed": bytes_changed,
    "truncated": truncated,
    "lengthened": lengthened,
    "spliced": spliced,
    "lengths lied": lengths_lied,
    "nested": nested,
    "values extreme": values_extreme,
    "types wrong": types_wrong,
    "header lied": header_lied,
    "unchanged": unchanged,
}
_ALL = tuple(MUTATIONS.values())


def mutated(rng: Random, payload: bytes, other: bytes) -> bytes:
    """A message changed in one way, now and then in two."""
    changed = rng.choice(_ALL)(rng, payload, other)
    if rng.random() < 0.1 and changed:
        changed = rng.choice((bits_flipped, bytes_changed, truncated, lengths_lied))(rng, changed, other)
    return changed


def renewed(payload: bytes, *, seq: int, t_ns: int, life: tuple[int, int] | None = None) -> bytes:
    """A genuine message as its robot could send it at `t_ns`, in a `life` (boot id, incarnation), by another number."""
    message: Any = msgpack.unpackb(payload, use_list=True)
    head = message[0]
    head[4:7] = seq, t_ns, t_ns
    if life is not None:
        head[2:4] = life
    return bytes(msgpack.packb(message))
