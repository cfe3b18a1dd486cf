"""Tables by peer that cannot grow without end: whoever is on the air may take ever new names."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import TypeVar

from agent.events import LinkChange
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


class Lives:
    """The life that each peer was last heard in."""

    def __init__(self) -> None:
        self._lives: dict[str, tuple[int, int]] = {}

    def __len__(self) -> int:
        return len(self._lives)

    def begun(self, event: LinkChange) -> bool | None:
        """Whether a peer has begun a life: True after another one, False as the first one known, None if not."""
        life, before = (event.incarnation, event.boot_id), self._lives.get(event.peer)
        if not event.up or before == life:
            return None
        remember(self._lives, event.peer, life)
        return before is not None


def has_room(table: Mapping[str, object], peer: str) -> bool:
    """Whether a pair with a peer is known, or may be begun."""
    return len(table) < MAX_PEERS or peer in table
