"""The local socket by which drivers hand in what sensors say, for the robot's own user alone."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError

NAME = "sensors.sock"
MAX_PATH = 100


class SensorSocket(asyncio.DatagramProtocol):
    """`sensors.sock` in the state directory; `on_data` is called on the event loop for every datagram."""

    def __init__(self, state_dir: Path, on_data: Callable[[bytes], None]) -> None:
        self._path, self._on_data = state_dir / NAME, on_data
        self._transport: asyncio.BaseTransport | None = None

    async def open(self) -> None:
        """Raises `ConfigError` if the path is too long, OSError if it cannot be had."""
        if len(os.fsencode(self._path)) > MAX_PATH:
            raise ConfigError(f"state_dir {self._path.parent} is too long for a socket: choose a shorter path")
        self._path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        previous = os.umask(0o177)
        try:
            listener.bind(str(self._path))
        finally:
            os.umask(previous)
        listener.setblocking(False)
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=listener)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._on_data(data)

    def close(self) -> None:
        """Remove it, if it was opened: another process's is left alone."""
        if self._transport is not None:
            self._transport.close()
            self._path.unlink(missing_ok=True)
