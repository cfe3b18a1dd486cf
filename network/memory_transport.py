"""A transport inside one event loop, for tests: packets reach everybody on the hub they are meant for."""

from __future__ import annotations

import asyncio
from collections import Counter

from network.messages import Packet
from network.transport import OnPacket, TransportError


class MemoryHub:
    """What the transports of one fleet are plugged into; delivers in order of robot ids, losing nothing."""

    def __init__(self) -> None:
        self._plugged: dict[str, MemoryTransport] = {}

    def plug(self, transport: MemoryTransport) -> None:
        if transport.robot in self._plugged:
            raise TransportError(f"robot {transport.robot} is on the hub already: give each its own id")
        self._plugged[transport.robot] = transport

    def unplug(self, transport: MemoryTransport) -> None:
        if self._plugged.get(transport.robot) is transport:
            del self._plugged[transport.robot]

    def carry(self, packet: Packet) -> None:
        for robot in sorted(self._plugged):
            if robot != packet.source and packet.destination in (None, robot):
                self._plugged[robot].hear(packet)


class MemoryTransport:
    """One robot's plug; see `network.transport.Transport`."""

    def __init__(self, hub: MemoryHub, robot: str, on_packet: OnPacket) -> None:
        self.robot = robot
        self.counters: Counter[str] = Counter()
        self._hub = hub
        self._on_packet = on_packet
        self._loop: asyncio.AbstractEventLoop | None = None

    async def start(self) -> None:
        self._hub.plug(self)
        self._loop = asyncio.get_running_loop()

    def send(self, packet: Packet) -> None:
        if packet.source != self.robot:
            raise ValueError("a robot sends only under its own name")
        if self._loop is None:
            self.counters["not_open"] += 1
            return
        self.counters["sent"] += 1
        self._hub.carry(packet)

    def hear(self, packet: Packet) -> None:
        """Called by the hub; the packet is handed on in a later turn of the loop."""
        if self._loop is not None:
            self._loop.call_soon(self._hand_on, packet)

    def _hand_on(self, packet: Packet) -> None:
        if self._loop is None:
            self.counters["after_close"] += 1
            return
        self.counters["received"] += 1
        self._on_packet(packet)

    async def close(self) -> None:
        self._hub.unplug(self)
        self._loop = None
