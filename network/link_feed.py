"""The world's table of who can hear whom, sent to the link model of each process over a session of its own.

Only pairs are told, never positions, and no core has a handle to this session.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterable
from typing import Any

import zenoh

from network.links import Pair, decode_table, encode_table
from network.transport import TransportError
from network.wire_fields import WireError

KEY = "cofix/world/links"


def _config(**endpoints: list[str]) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    for key, values in endpoints.items():
        config.insert_json5(f"{key}/endpoints", json.dumps(values))
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled", "transport/shared_memory/enabled"):
        config.insert_json5(key, "false")
    config.insert_json5("scouting/delay", "0")
    config.insert_json5("connect/retry", '{"period_init_ms": 100, "period_max_ms": 500}')
    return config


class LinkFeed:
    """One end of the feed: the world listens and publishes, a receiver connects and is told."""

    def __init__(self) -> None:
        self._session: Any = None
        self._keep: Any = None

    async def serve(self, endpoint: str) -> None:
        """Listen for receivers. Raises TransportError if the endpoint can't be had."""
        await self._open(_config(listen=[endpoint]), endpoint)
        self._keep = self._session.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.DROP)

    def publish(self, t_ns: int, robots: Iterable[str], pairs: Iterable[Pair]) -> None:
        """From `t_ns` on exactly these pairs are in range."""
        self._keep.put(encode_table(t_ns, robots, pairs))

    async def follow(self, endpoint: str, told: Callable[[int, Iterable[Pair]], None]) -> None:
        """Connect to the world; `told` is called on the event loop for every table."""
        loop = asyncio.get_running_loop()
        await self._open(_config(connect=[endpoint]), endpoint)

        def on_sample(sample: Any) -> None:
            try:
                t_ns, pairs = decode_table(sample.payload.to_bytes())
                loop.call_soon_threadsafe(told, t_ns, pairs)
            except (WireError, RuntimeError):
                return

        handler = zenoh.handlers.Callback(on_sample, indirect=False)
        self._keep = self._session.declare_subscriber(KEY, handler)

    async def _open(self, config: zenoh.Config, endpoint: str) -> None:
        try:
            self._session = await asyncio.to_thread(zenoh.open, config)
        except zenoh.ZError:
            raise TransportError(f"{endpoint} cannot be opened: is the port taken? choose another") from None

    async def close(self) -> None:
        session, self._session, self._keep = self._session, None, None
        if session is not None:
            await asyncio.wait_for(asyncio.to_thread(session.close), 12.0)
