"""One Zenoh session of a robot, peer to peer: how it is configured, opened, written to and closed."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh

from network.messages import SCHEMA, Channel
from network.transport import TransportError
from network.wire_fields import valid_id

_LOG = logging.getLogger(__name__)
PREFIX = f"cofix/v{SCHEMA}"
_MIN_RX_WORKERS = 8

OnSample = Callable[[Any], None]
"""Called on one of Zenoh's receive threads."""


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """One robot's place in the fleet. Endpoints are Zenoh locators, see `link_pair`.

    connect      (peer id, its endpoints); only peers whose id sorts below `robot` are dialled
    boot_id      part of the liveliness key, so that a restart within the lease is seen
    lease_ms     a neighbour unheard for so long is gone (wall time); links that are opened are waited for as long
    queue_depth  packets waiting for the event loop; beyond it the oldest is dropped and counted
    """

    fleet: str
    robot: str
    boot_id: int
    listen: tuple[str, ...]
    connect: tuple[tuple[str, tuple[str, ...]], ...] = ()
    lease_ms: int = 1_000
    queue_depth: int = 1_024
    close_timeout_s: float = 12.0

    def __post_init__(self) -> None:
        for name in ("fleet", "robot"):
            if not valid_id(getattr(self, name)):
                raise ValueError(f"{name} must match [a-z0-9-]{{1,24}}")
        for name in ("lease_ms", "queue_depth", "close_timeout_s"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive")

    def dialled(self) -> list[str]:
        """Endpoints this robot dials."""
        return [endpoint for peer, endpoints in self.connect if peer < self.robot for endpoint in endpoints]

    def peers(self) -> dict[str, tuple[str, ...]]:
        """Endpoints of every other robot."""
        return {peer: endpoints for peer, endpoints in self.connect if peer != self.robot}


def link_pair(host: str, port: int) -> tuple[str, str]:
    """The two links of a peer: a stream for directed messages, datagrams for periodic state.

    The stream comes first: what a session declares goes over the first link, and is never repeated if lost.
    """
    return f"tcp/{host}:{port}?rel=1", f"udp/{host}:{port}?rel=0"


class ZenohSession:
    """A session that listens at `listen`, dials `connect` while it lives, and hears what is meant for the robot."""

    def __init__(self, settings: ZenohSettings, listen: Sequence[str], connect: Sequence[str]) -> None:
        self._settings, self._listen, self._connect = settings, list(listen), list(connect)
        self._session: Any = None
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []

    async def open(self, on_sample: OnSample, on_liveliness: OnSample | None = None) -> None:
        """Open it and declare its keys; with `on_liveliness` it tells of itself, and is told of others.

        Raises TransportError, with the endpoint and the remedy, if that cannot be.
        """
        settings = self._settings
        workers = max(_MIN_RX_WORKERS, len(settings.connect) + 2)
        os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {workers}))")
        config = _config(self._listen, self._connect, settings.lease_ms)
        opening = asyncio.ensure_future(asyncio.to_thread(zenoh.open, config))
        try:
            self._session = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_late)
            raise
        except zenoh.ZError as error:
            raise TransportError(self._explain(str(error))) from None
        try:
            self._declare(on_sample, on_liveliness)
        except zenoh.ZError as error:
            await self.close()
            raise TransportError(f"zenoh refused the keys of robot {settings.robot}: {error}") from None

    def _declare(self, on_sample: OnSample, on_liveliness: OnSample | None) -> None:
        settings = self._settings
        fleet = f"{PREFIX}/{settings.fleet}"
        keys = [f"{fleet}/*/{Channel.HELLO}", f"{fleet}/*/{Channel.BELIEF}"]
        keys.append(f"{fleet}/*/{Channel.PAIR}/{settings.robot}")
        for key in keys:
            handler = zenoh.handlers.Callback(on_sample, indirect=False)
            self._declared.append(self._session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE))
        if on_liveliness is None:
            return
        liveliness = self._session.liveliness()
        handler = zenoh.handlers.Callback(on_liveliness, indirect=False)
        self._declared.append(liveliness.declare_subscriber(f"{fleet}/*/alive/*", handler, history=True))
        token = f"{fleet}/{settings.robot}/alive/{settings.boot_id}"
        self._declared.append(liveliness.declare_token(token))

    def _explain(self, error: str) -> str:
        """One line for the person who has to change something."""
        endpoint = next((entry for entry in self._listen if entry in error), None)
        if endpoint is None:
            return f"zenoh cannot open robot {self._settings.robot}: {error.splitlines()[0]}"
        if "in use" in error:
            return f"{endpoint} is in use: stop the other process or choose another port in listen"
        if "Cannot assign" in error:
            return f"{endpoint} is not an address of this computer: correct listen"
        return f"zenoh cannot listen on {endpoint}: correct listen"

    def is_closed(self) -> bool:
        """Whether somebody, or Zenoh itself, has closed it."""
        return self._session is None or bool(self._session.is_closed())

    def put(self, key: str, payload: bytes, reliable: bool) -> bool:
        """Put under a key, on the reliable link or the other one; whether Zenoh took it. Never blocks."""
        try:
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._session.declare_publisher(
                    key,
                    reliability=zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
                    congestion_control=zenoh.CongestionControl.DROP,
                    allowed_destination=zenoh.Locality.REMOTE,
                )
                self._publishers[key] = publisher
            publisher.put(payload)
        except zenoh.ZError:
            return False
        return True

    async def close(self) -> bool:
        """Close it; False if it was given up after `close_timeout_s`."""
        session, self._session = self._session, None
        if session is None:
            return True
        self._publishers.clear()
        self._declared.clear()
        # Not a thread of the executor: the interpreter would wait for it if the session never closes.
        closed = asyncio.Event()
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=_close, args=(session, loop, closed), daemon=True)
        thread.start()
        try:
            await asyncio.wait_for(closed.wait(), self._settings.close_timeout_s)
        except TimeoutError:
            _LOG.warning("zenoh session did not close within %s s", self._settings.close_timeout_s)
            return False
        return True


def _config(listen: list[str], connect: list[str], lease_ms: int) -> zenoh.Config:
    entries: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "connect/retry": {
            "period_init_ms": max(lease_ms // 10, 1),
            "period_max_ms": max(lease_ms // 2, 1),
            "period_increase_factor": 1.5,
        },
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": lease_ms,
        "transport/link/tx/keep_alive": 4,
        "transport/unicast/max_links": 2,
        # A lost handshake datagram is not repeated and would cost the whole default of ten seconds.
        "transport/unicast/open_timeout": lease_ms,
        "transport/unicast/accept_timeout": lease_ms,
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for key, value in entries.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _close(session: Any, loop: asyncio.AbstractEventLoop, closed: asyncio.Event) -> None:
    try:
        session.close()
    except zenoh.ZError as error:
        _LOG.warning("zenoh session closed with an error: %s", error)
    try:
        loop.call_soon_threadsafe(closed.set)
    except RuntimeError:
        _LOG.debug("zenoh session closed after its event loop")


def _close_late(opening: asyncio.Future[Any]) -> None:
    """Close a session that opened after nobody waited for it any more."""
    if not opening.cancelled() and opening.exception() is None:
        threading.Thread(target=opening.result().close, daemon=True).start()
