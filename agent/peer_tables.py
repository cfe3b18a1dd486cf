"""Tables by peer that cannot grow without end: whoever is on the air may take ever new names."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import TypeVar

from network.peers import MAX_PEERS

Value = TypeVar("Value")


def remember(table: dict[str, Value], peer: str, value: Value, keep: Container[str] = ()) -> None:
    """Put what is newest of a peer; beyond `MAX_PEERS` the peer not in `keep` that was put longest ago is forgotten."""
    table.pop(peer, None)
    table[peer] = value
    if len(table) > MAX_PEERS:
        oldest = next((name for name in table if name not in keep), None)
        if oldest is not None:
            del table[oldest]


def has_room(table: Mapping[str, object], peer: str) -> bool:
    """Whether a pair with a peer is known, or may be begun."""
    return len(table) < MAX_PEERS or peer in table
