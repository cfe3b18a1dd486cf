"""Picking ports, and the in-process hub."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys

import pytest

from network.memory_transport import MemoryHub, MemoryTransport
from network.messages import Channel, Packet
from network.transport import EPHEMERAL_FLOOR, Transport, TransportError, free_port


def test_a_free_port_is_free_for_both_protocols_and_below_the_ephemeral_range() -> None:
    port = free_port()
    assert 1_024 < port < EPHEMERAL_FLOOR
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
        with socket.socket(socket.AF_INET, kind) as probe:
            probe.bind(("127.0.0.1", port))


def test_a_port_that_somebody_was_given_is_not_given_to_another_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that start at the same time choose their ports before they use them."""
    choose = "from network.transport import free_port; print(free_port(), flush=True); input()"
    other = subprocess.Popen([sys.executable, "-c", choose], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    port = int(other.stdout.readline())
    monkeypatch.setattr("random.SystemRandom.randrange", lambda *_: port)
    with pytest.raises(TransportError, match="no free port"):
        free_port()
    other.communicate("\n")
    assert free_port() == port
    with pytest.raises(TransportError, match="no free port"):
        free_port()


def test_without_a_free_port_the_remedy_is_told() -> None:
    with pytest.raises(TransportError, match="stop what occupies"):
        free_port(exclude=range(EPHEMERAL_FLOOR))


def test_the_hub_delivers_broadcasts_to_the_others_and_directed_packets_to_one() -> None:
    async def scene() -> dict[str, list[Packet]]:
        hub = MemoryHub()
        heard: dict[str, list[Packet]] = {robot: [] for robot in ("r1", "r2", "r3")}
        ends = {robot: MemoryTransport(hub, robot, heard[robot].append) for robot in heard}
        transport: Transport = ends["r1"]
        for end in ends.values():
            await end.start()
        transport.send(Packet("r1", Channel.HELLO, None, b"all"))
        transport.send(Packet("r1", Channel.PAIR, "r2", b"one"))
        assert heard["r2"] == []
        await asyncio.sleep(0)
        ends["r3"].send(Packet("r3", Channel.HELLO, None, b"late"))
        await ends["r2"].close()
        await asyncio.sleep(0)
        assert ends["r2"].counters["after_close"] == 1
        ends["r2"].send(Packet("r2", Channel.HELLO, None, b"lost"))
        assert ends["r2"].counters["not_open"] == 1
        return heard

    heard = asyncio.run(scene())
    assert [packet.payload for packet in heard["r1"]] == [b"late"]
    assert [packet.payload for packet in heard["r2"]] == [b"all", b"one"]
    assert [packet.payload for packet in heard["r3"]] == [b"all"]


def test_the_hub_refuses_wrong_names() -> None:
    async def scene() -> None:
        hub = MemoryHub()
        one = MemoryTransport(hub, "r1", lambda packet: None)
        await one.start()
        with pytest.raises(TransportError, match="its own id"):
            await MemoryTransport(hub, "r1", lambda packet: None).start()
        with pytest.raises(ValueError, match="own name"):
            one.send(Packet("r2", Channel.HELLO, None, b""))
        await one.close()
        await one.close()

    asyncio.run(scene())
