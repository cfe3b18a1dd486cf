"""What carries packets between robots. A transport knows bytes and names, never their meaning."""

from __future__ import annotations

import random
import socket
from collections import Counter
from collections.abc import Callable, Collection
from typing import Protocol

from network.messages import Packet

OnPacket = Callable[[Packet], None]
"""Called on the event loop for every packet heard, foreign ones too."""

EPHEMERAL_FLOOR = 32_768
"""Ports from here on are taken by outgoing connections."""


class TransportError(RuntimeError):
    """The transport cannot start; the message is one line that says what to change."""


class Transport(Protocol):
    """Best effort, unordered, unauthenticated unless its settings say otherwise.

    The receive callback is given at construction. `counters` names everything that was dropped.
    """

    counters: Counter[str]

    async def start(self) -> None:
        """Begin to send and receive. Raises TransportError."""

    def send(self, packet: Packet) -> None:
        """Send or drop; never blocks, and never raises because of the network."""

    async def close(self) -> None:
        """Stop; may be called at any time and more than once."""


def free_port(host: str = "127.0.0.1", exclude: Collection[int] = ()) -> int:
    """A port below the ephemeral range that is free for TCP and UDP on `host` and not in `exclude`.

    It is kept for this process until it ends: whoever asks here is given another one, in other processes too.
    """
    draw = random.SystemRandom()
    for _ in range(200):
        port = draw.randrange(20_000, EPHEMERAL_FLOOR)
        if port not in exclude and all(_is_free(host, port, kind) for kind in _KINDS) and _reserve(port):
            return port
    raise TransportError(f"no free port on {host}: stop what occupies ports 20000-{EPHEMERAL_FLOOR - 1}")


_KINDS = (socket.SOCK_STREAM, socket.SOCK_DGRAM)


def _is_free(host: str, port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
        return True


_reserved: list[socket.socket] = []


def _reserve(port: int) -> bool:
    """Keep a port that is used later from others who look for one meanwhile; False if somebody has.

    An abstract name belongs to one socket of a network namespace, and ends with its process.
    """
    held = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        held.bind(f"\0cofix-port-{port}")
    except OSError:
        held.close()
        return False
    _reserved.append(held)
    return True
