"""Packets over Zenoh, peer to peer.

Keys are `cofix/v1/<fleet>/<robot>/<channel>` and `.../pair/<peer>`; a robot writes only under its own name.
Five properties of Zenoh decide the shape of this module:

- A dead TCP link occupies a receive thread for ten seconds: there are more threads than robots to lose.
- Receive threads are shared by all links: the callback only copies and enqueues, and wakes the loop once.
- A session dials only robots of lower id: mutual dialling can leave a link half dead for good.
- A session that was lost, whatever took it, is not mended by itself: it is watched, and opened again.
- A link can be half dead all the same, and a session cannot redial one peer: such a peer gets a session of its own,
  which dials it alone. Packets that then come twice are told apart by who receives them.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable
from functools import partial
from typing import Any

import zenoh

from network.messages import MAX_MESSAGE_BYTES, Channel, Packet
from network.redial import PeerWatch
from network.transport import OnPacket, TransportError
from network.zenoh_session import PREFIX, ZenohSession, ZenohSettings

_LOG = logging.getLogger(__name__)
_WATCH_S = 1.0
_STOOD_STILL_S = 3.0 * _WATCH_S
_PROBE_EVERY = 5
_REDIAL_S = 3.0
_MIN_PATIENCE_S, _MAX_PATIENCE_S = 10.0, 60.0


def key_of(fleet: str, packet: Packet) -> str:
    """The key a packet is put under."""
    key = f"{PREFIX}/{fleet}/{packet.source}/{packet.channel}"
    return key if packet.destination is None else f"{key}/{packet.destination}"


def packet_of(key: str, payload: bytes) -> Packet | None:
    """The packet put under `key`, None if the key is not one of a robot's channels."""
    parts = key.split("/")
    if len(parts) not in (5, 6) or "/".join(parts[:2]) != PREFIX:
        return None
    return Packet(parts[3], parts[4], parts[5] if len(parts) == 6 else None, payload)


class ZenohTransport:
    """One robot's Zenoh sessions; see `network.transport.Transport`.

    Counters: sent, received, and everything lost: not_open, send_failed, queue_dropped, oversize, foreign_key,
    handler_failed, close_timeout. liveliness_up and liveliness_down count neighbours' tokens.

    The session is lost when it is closed (`lost_closed`), when nobody can dial it any more (`lost_deaf`), or when all
    are silent who were heard before (`lost_silent`; the patience doubles each time, up to a minute, for all may be
    out of reach). It is opened again: `reopened`, `reopen_failed`.

    A peer that answers at its address and is not heard is dialled by a session of its own (`redialled`,
    `redial_failed`), until the main one brings its packets again (`redial_ended`).
    """

    def __init__(self, settings: ZenohSettings, on_packet: OnPacket) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self._on_packet = on_packet
        self._loop: asyncio.AbstractEventLoop | None = None
        self._session: ZenohSession | None = None
        self._own: dict[str, ZenohSession] = {}
        self._peers = PeerWatch(settings.robot, (), 0.0, 0.0)
        self._watcher: asyncio.Task[None] | None = None
        self._closing: set[asyncio.Task[None]] = set()
        # Guards what the receive threads share with the loop: the three fields below and their counters.
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes, bool]] = deque()
        self._armed = False
        self._heard: Counter[str] = Counter()

    # --- life ---------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Open the session. Raises TransportError, with the endpoint and the remedy, if that cannot be."""
        if self._session is not None:
            raise TransportError("the transport is open already: close it first")
        settings = self.settings
        await self._open()
        patience_s = max(_REDIAL_S, settings.lease_ms * 3e-3)
        self._peers = PeerWatch(settings.robot, settings.peers(), patience_s, time.monotonic())
        self._watcher = asyncio.create_task(self._watch())

    async def _open(self) -> None:
        self._loop = asyncio.get_running_loop()
        session = ZenohSession(self.settings, self.settings.listen, self.settings.dialled())
        await session.open(partial(self._on_sample, main=True), self._on_liveliness)
        self._session = session

    async def close(self) -> None:
        """Close all sessions; gives up, and counts it, after `close_timeout_s`."""
        watcher, self._watcher = self._watcher, None
        if watcher is not None:
            watcher.cancel()
            await asyncio.gather(watcher, return_exceptions=True)
        for peer in list(self._own):
            self._hang_up(peer)
        await self._shut()
        await asyncio.gather(*self._closing)

    async def _shut(self) -> None:
        session, self._session = self._session, None
        if session is not None:
            await self._end(session)

    async def _end(self, session: ZenohSession) -> None:
        if not await session.close():
            self.counters["close_timeout"] += 1

    # --- watch --------------------------------------------------------------------------------------------

    async def _watch(self) -> None:
        """Look after the sessions, and open again what is lost."""
        least_s = max(_MIN_PATIENCE_S, self.settings.lease_ms * 1e-2)
        patience_s, received, turn = least_s, 0, 0
        heard_s = looked_s = time.monotonic()
        while True:
            await asyncio.sleep(_WATCH_S)
            turn += 1
            now_s = time.monotonic()
            if self.counters["received"] != received:
                received, heard_s, patience_s = self.counters["received"], now_s, least_s
            if now_s - looked_s > _STOOD_STILL_S:
                # This process itself stood still: nobody is silent because of that.
                heard_s = now_s
                self._peers.wait_anew(now_s)
            reason = None
            if self._session is None or self._session.is_closed():
                reason = "closed"
            elif turn % _PROBE_EVERY == 0 and await self._deaf():
                reason = "deaf"
            elif received and now_s - heard_s > patience_s:
                reason, patience_s = "silent", min(2.0 * patience_s, _MAX_PATIENCE_S)
            if reason is not None:
                await self._again(reason)
                heard_s = time.monotonic()
                self._peers.wait_anew(heard_s)
            await self._look_after_peers()
            looked_s = time.monotonic()

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
        return False in [await _answers(endpoint) for endpoint in self.settings.listen]

    async def _look_after_peers(self) -> None:
        for peer in self._peers.spare():
            self.counters["redial_ended"] += 1
            self._hang_up(peer)
        overdue = self._peers.overdue(time.monotonic())
        for peer, there in zip(overdue, await asyncio.gather(*map(self._reachable, overdue)), strict=True):
            if there:
                await self._redial(peer)
            else:
                self._peers.unreachable(peer, time.monotonic())

    async def _reachable(self, peer: str) -> bool:
        answers = [await _answers(endpoint) for endpoint in self.settings.peers()[peer]]
        return True in answers

    async def _redial(self, peer: str) -> None:
        _LOG.warning("%s answers at its address and is not heard: it is dialled anew", peer)
        self._hang_up(peer)
        self._peers.dialled(peer, time.monotonic())
        session = ZenohSession(self.settings, (), self.settings.peers()[peer])
        try:
            await session.open(partial(self._on_sample, main=False))
        except TransportError as error:
            self.counters["redial_failed"] += 1
            _LOG.warning("%s", error)
        else:
            self.counters["redialled"] += 1
            self._own[peer] = session

    def _hang_up(self, peer: str) -> None:
        """End a peer's own session, if there is one; nobody waits for it, as a dead link closes slowly."""
        session = self._own.pop(peer, None)
        if session is not None:
            closing = asyncio.create_task(self._end(session))
            self._closing.add(closing)
            closing.add_done_callback(self._closing.discard)

    # --- out ----------------------------------------------------------------------------------------------

    def send(self, packet: Packet) -> None:
        """Put a packet under its key, directed ones on the reliable link. Raises ValueError if not our own."""
        if packet.source != self.settings.robot:
            raise ValueError("a robot sends only under its own name")
        to = packet.destination
        own = self._own.values() if to is None else [self._own[to]] if to in self._own else []
        self._put(key_of(self.settings.fleet, packet), packet.payload, to is not None, own)

    def publish(self, channel: str, payload: bytes) -> None:
        """Put bytes for people and tools on `estimate` or `status`, best effort."""
        if channel not in (Channel.ESTIMATE, Channel.STATUS):
            raise ValueError("publish is for channels estimate and status; robots' messages go through send")
        self._put(f"{PREFIX}/{self.settings.fleet}/{self.settings.robot}/{channel}", payload, False)

    def _put(self, key: str, payload: bytes, reliable: bool, own: Iterable[ZenohSession] = ()) -> None:
        sessions = [*([] if self._session is None else [self._session]), *own]
        taken = [session.put(key, payload, reliable) for session in sessions]
        if not sessions:
            self.counters["not_open"] += 1
        elif any(taken):
            self.counters["sent"] += 1
        else:
            self.counters["send_failed"] += 1

    # --- in: on Zenoh's receive threads -------------------------------------------------------------------

    def _on_sample(self, sample: Any, main: bool) -> None:
        size = len(sample.payload)
        item = (str(sample.key_expr), sample.payload.to_bytes(), main) if size <= MAX_MESSAGE_BYTES else None
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
        if self._session is None and not self._own:
            return
        now_s = time.monotonic()
        for key, payload, main in batch:
            packet = packet_of(key, payload)
            if packet is None:
                self.counters["foreign_key"] += 1
                continue
            self.counters["received"] += 1
            self._peers.heard(packet.source, now_s, main)
            try:
                self._on_packet(packet)
            except Exception:
                self.counters["handler_failed"] += 1
                _LOG.exception("receive callback failed")


async def _answers(endpoint: str) -> bool | None:
    """Whether a stream endpoint accepts connections; None if it is none, or nothing comes back."""
    protocol, _, address = endpoint.partition("?")[0].partition("/")
    host, _, port = address.rpartition(":")
    if protocol not in ("tcp", "tls"):
        return None
    try:
        async with asyncio.timeout(_WATCH_S):
            _, writer = await asyncio.open_connection(host.strip("[]"), int(port))
    except ConnectionRefusedError:
        return False
    except (OSError, ValueError, TimeoutError):
        return None
    writer.close()
    return True
