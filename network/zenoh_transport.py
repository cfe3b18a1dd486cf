"""Packets over Zenoh, peer to peer.

Keys are `cofix/v1/<fleet>/<robot>/<channel>` and `.../pair/<peer>`; a robot writes only under its own name.
Four properties of Zenoh decide the shape of this module:

- A dead TCP link occupies a receive thread for ten seconds: there are more threads than robots to lose.
- Receive threads are shared by all links: the callback only copies and enqueues, and wakes the loop once.
- A session dials only robots of lower id: mutual dialling can leave a link half dead for good.
- A session that was lost, whatever took it, is not mended by itself: it is watched, and opened again.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

import zenoh

from network.messages import MAX_MESSAGE_BYTES, SCHEMA, Channel, Packet
from network.transport import OnPacket, TransportError
from network.wire_fields import valid_id

_LOG = logging.getLogger(__name__)
_PREFIX = f"cofix/v{SCHEMA}"
_MIN_RX_WORKERS = 8
_WATCH_S = 1.0
_PROBE_EVERY = 5
_MIN_PATIENCE_S, _MAX_PATIENCE_S = 5.0, 60.0


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


def link_pair(host: str, port: int) -> tuple[str, str]:
    """The two links of a peer: a stream for directed messages, datagrams for periodic state.

    The stream comes first: what a session declares goes over the first link, and is never repeated if lost.
    """
    return f"tcp/{host}:{port}?rel=1", f"udp/{host}:{port}?rel=0"


def key_of(fleet: str, packet: Packet) -> str:
    """The key a packet is put under."""
    key = f"{_PREFIX}/{fleet}/{packet.source}/{packet.channel}"
    return key if packet.destination is None else f"{key}/{packet.destination}"


def packet_of(key: str, payload: bytes) -> Packet | None:
    """The packet put under `key`, None if the key is not one of a robot's channels."""
    parts = key.split("/")
    if len(parts) not in (5, 6) or "/".join(parts[:2]) != _PREFIX:
        return None
    return Packet(parts[3], parts[4], parts[5] if len(parts) == 6 else None, payload)


class ZenohTransport:
    """One robot's Zenoh session; see `network.transport.Transport`.

    Counters: sent, received, and everything lost: not_open, send_failed, queue_dropped, oversize, foreign_key,
    handler_failed, close_timeout. liveliness_up and liveliness_down count neighbours' tokens.

    A session is lost when it is closed (`lost_closed`), when nobody can dial it any more (`lost_deaf`), or when all
    are silent who were heard before (`lost_silent`; the patience doubles each time, up to a minute, for all may be
    out of reach). It is opened again: `reopened`, `reopen_failed`.
    """

    def __init__(self, settings: ZenohSettings, on_packet: OnPacket) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self._on_packet = on_packet
        self._loop: asyncio.AbstractEventLoop | None = None
        self._session: Any = None
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._watcher: asyncio.Task[None] | None = None
        # Guards what the receive threads share with the loop: the three fields below and their counters.
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes]] = deque()
        self._armed = False
        self._heard: Counter[str] = Counter()

    # --- life ---------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Open the session. Raises TransportError, with the endpoint and the remedy, if that cannot be."""
        if self._session is not None:
            raise TransportError("the transport is open already: close it first")
        await self._open()
        self._watcher = asyncio.create_task(self._watch())

    async def _open(self) -> None:
        settings = self.settings
        workers = max(_MIN_RX_WORKERS, len(settings.connect) + 2)
        os.environ.setdefault("ZENOH_RUNTIME", f"(rx: (worker_threads: {workers}))")
        self._loop = asyncio.get_running_loop()
        opening = asyncio.ensure_future(asyncio.to_thread(zenoh.open, _config(settings)))
        try:
            self._session = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_close_late)
            raise
        except zenoh.ZError as error:
            raise TransportError(_explain(settings, str(error))) from None
        try:
            self._declare()
        except zenoh.ZError as error:
            await self._shut()
            raise TransportError(f"zenoh refused the keys of robot {settings.robot}: {error}") from None

    def _declare(self) -> None:
        settings = self.settings
        fleet = f"{_PREFIX}/{settings.fleet}"
        keys = [f"{fleet}/*/{Channel.HELLO}", f"{fleet}/*/{Channel.BELIEF}"]
        keys.append(f"{fleet}/*/{Channel.PAIR}/{settings.robot}")
        for key in keys:
            handler = zenoh.handlers.Callback(self._on_sample, indirect=False)
            self._declared.append(self._session.declare_subscriber(key, handler, allowed_origin=zenoh.Locality.REMOTE))
        liveliness = self._session.liveliness()
        handler = zenoh.handlers.Callback(self._on_liveliness, indirect=False)
        self._declared.append(liveliness.declare_subscriber(f"{fleet}/*/alive/*", handler, history=True))
        token = f"{fleet}/{settings.robot}/alive/{settings.boot_id}"
        self._declared.append(liveliness.declare_token(token))

    async def close(self) -> None:
        """Close the session; gives up, and counts it, after `close_timeout_s`."""
        watcher, self._watcher = self._watcher, None
        if watcher is not None:
            watcher.cancel()
            await asyncio.gather(watcher, return_exceptions=True)
        await self._shut()

    async def _shut(self) -> None:
        session, self._session = self._session, None
        if session is None:
            return
        self._publishers.clear()
        self._declared.clear()
        # Not a thread of the executor: the interpreter would wait for it if the session never closes.
        closed = asyncio.Event()
        loop = asyncio.get_running_loop()
        thread = threading.Thread(target=_close, args=(session, loop, closed), daemon=True)
        thread.start()
        try:
            await asyncio.wait_for(closed.wait(), self.settings.close_timeout_s)
        except TimeoutError:
            self.counters["close_timeout"] += 1
            _LOG.warning("zenoh session did not close within %s s", self.settings.close_timeout_s)

    # --- watch --------------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        """Look after the session, and open it again when it is lost."""
        least_s = max(_MIN_PATIENCE_S, self.settings.lease_ms * 5e-3)
        patience_s, received, heard_s, turn = least_s, 0, time.monotonic(), 0
        while True:
            await asyncio.sleep(_WATCH_S)
            turn += 1
            if self.counters["received"] != received:
                received, heard_s, patience_s = self.counters["received"], time.monotonic(), least_s
            reason = None
            if self._session is None or self._session.is_closed():
                reason = "closed"
            elif turn % _PROBE_EVERY == 0 and await self._deaf():
                reason = "deaf"
            elif received and time.monotonic() - heard_s > patience_s:
                reason, patience_s = "silent", min(2.0 * patience_s, _MAX_PATIENCE_S)
            if reason is not None:
                await self._again(reason)
                heard_s = time.monotonic()

    async def _again(self, reason: str) -> None:
        self.counters[f"lost_{reason}"] += 1
        _LOG.warning("zenoh session lost (%s): it is opened again", reason)
        await self._shut()
        try:
            await self._open()
        except TransportError as error:
            self.counters["reopen_failed"] += 1
            _LOG.warning("zenoh session not open: %s", error)
        else:
            self.counters["reopened"] += 1

    async def _deaf(self) -> bool:
        """Whether an own stream endpoint refuses connections."""
        for endpoint in self.settings.listen:
            protocol, _, address = endpoint.partition("?")[0].partition("/")
            host, _, port = address.rpartition(":")
            if protocol not in ("tcp", "tls"):
                continue
            try:
                async with asyncio.timeout(_WATCH_S):
                    _, writer = await asyncio.open_connection(host.strip("[]"), int(port))
                writer.close()
            except ConnectionRefusedError:
                return True
            except (OSError, ValueError, TimeoutError):
                continue
        return False

    # --- out ----------------------------------------------------------------------------------------------

    def send(self, packet: Packet) -> None:
        """Put a packet under its key, directed ones on the reliable link. Raises ValueError if not our own."""
        if packet.source != self.settings.robot:
            raise ValueError("a robot sends only under its own name")
        self._put(key_of(self.settings.fleet, packet), packet.payload, packet.destination is not None)

    def publish(self, channel: str, payload: bytes) -> None:
        """Put bytes for people and tools on `estimate` or `status`, best effort."""
        if channel not in (Channel.ESTIMATE, Channel.STATUS):
            raise ValueError("publish is for channels estimate and status; robots' messages go through send")
        self._put(f"{_PREFIX}/{self.settings.fleet}/{self.settings.robot}/{channel}", payload, False)

    def _put(self, key: str, payload: bytes, reliable: bool) -> None:
        if self._session is None:
            self.counters["not_open"] += 1
            return
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
            self.counters["send_failed"] += 1
        else:
            self.counters["sent"] += 1

    # --- in: on Zenoh's receive threads -------------------------------------------------------------------

    def _on_sample(self, sample: Any) -> None:
        size = len(sample.payload)
        item = (str(sample.key_expr), sample.payload.to_bytes()) if size <= MAX_MESSAGE_BYTES else None
        with self._lock:
            if item is None:
                self._heard["oversize"] += 1
            else:
                if len(self._queue) >= self.settings.queue_depth:
                    self._queue.popleft()
                    self._heard["queue_dropped"] += 1
                self._queue.append(item)
            self._wake()

    def _on_liveliness(self, sample: Any) -> None:
        if str(sample.key_expr).split("/")[3] == self.settings.robot:
            return
        up = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._heard["liveliness_up" if up else "liveliness_down"] += 1
            self._wake()

    def _wake(self) -> None:
        """Have the loop drain once per burst; the lock is held."""
        if self._armed or self._loop is None:
            return
        self._armed = True
        try:
            self._loop.call_soon_threadsafe(self._drain)
        except RuntimeError:
            # The loop was closed before the session.
            self._queue.clear()

    # --- in: on the event loop ----------------------------------------------------------------------------

    def _drain(self) -> None:
        with self._lock:
            batch = list(self._queue)
            self._queue.clear()
            self.counters.update(self._heard)
            self._heard.clear()
            self._armed = False
        if self._session is None:
            return
        for key, payload in batch:
            packet = packet_of(key, payload)
            if packet is None:
                self.counters["foreign_key"] += 1
                continue
            self.counters["received"] += 1
            try:
                self._on_packet(packet)
            except Exception:
                self.counters["handler_failed"] += 1
                _LOG.exception("receive callback failed")


def _config(settings: ZenohSettings) -> zenoh.Config:
    entries: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": settings.dialled(),
        "connect/retry": {
            "period_init_ms": max(settings.lease_ms // 10, 1),
            "period_max_ms": max(settings.lease_ms // 2, 1),
            "period_increase_factor": 1.5,
        },
        "scouting/delay": 0,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": settings.lease_ms,
        "transport/link/tx/keep_alive": 4,
        "transport/unicast/max_links": 2,
        # A lost handshake datagram is not repeated and would cost the whole default of ten seconds.
        "transport/unicast/open_timeout": settings.lease_ms,
        "transport/unicast/accept_timeout": settings.lease_ms,
        "transport/shared_memory/enabled": False,
    }
    config = zenoh.Config()
    for key, value in entries.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _explain(settings: ZenohSettings, error: str) -> str:
    """One line for the person who has to change something."""
    endpoint = next((entry for entry in settings.listen if entry in error), None)
    if endpoint is None:
        return f"zenoh cannot open robot {settings.robot}: {error.splitlines()[0]}"
    if "in use" in error:
        return f"{endpoint} is in use: stop the other process or choose another port in listen"
    if "Cannot assign" in error:
        return f"{endpoint} is not an address of this computer: correct listen"
    return f"zenoh cannot listen on {endpoint}: correct listen"


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
