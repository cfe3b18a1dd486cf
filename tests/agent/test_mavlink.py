"""The link's shell on real sockets and a pseudo-terminal of this computer."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import time
import tty
from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.autopilot import AutopilotReader, Output
from agent.autopilot_settings import AutopilotSettings
from agent.events import Fix, Odometry
from agent.fleet_clock import FleetClock
from agent.mavlink import MavlinkLink, SerialLine
from agent.mavlink_endpoint import MavlinkError, parse_endpoint
from network.transport import free_port
from sim.autopilot import StandIn, StandInServer, StandInSettings

S = 1_000_000_000
PATIENCE_S = 20.0
DELTA = np.array([0.1, 0.02, 0.0, 0.05])
ORIGIN = (47.397742, 8.545594, 488.0)


def run_clock(speed: float = 1.0) -> FleetClock:
    return FleetClock(5 * S, time.monotonic_ns(), speed)


def vehicle(clock: FleetClock, system_id: int = 1) -> StandIn:
    sends = ("odometry", "global_position", "attitude")
    return StandIn(StandInSettings(system_id, sends=sends, origin=ORIGIN, boot_ns=clock.now_ns() - 9 * S))


def reader() -> AutopilotReader:
    return AutopilotReader(
        AutopilotSettings(origin=ORIGIN, fixes=("position", "heading"), fix_interval_ns=0, message_interval_ns=S // 50)
    )


async def until(condition: Callable[[], bool], again: Callable[[], None] = lambda: None) -> None:
    """Repeat `again` until the condition holds; fails after a long time only."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            again()
            await asyncio.sleep(0.01)


class Drive:
    """Moves a stand-in by the same increment again and again."""

    def __init__(self, stand_in: StandIn, clock: FleetClock, push: Callable[[int], None]) -> None:
        self._stand_in, self._clock, self._push = stand_in, clock, push

    def __call__(self) -> None:
        now = self._clock.now_ns()
        self._stand_in.set_odometry(now, DELTA)
        self._stand_in.set_fix(now, 3.0, 4.0, 0.0, 1.0)
        self._push(now)


def check(events: list[Output], hearing: AutopilotReader, boot_ns: int) -> None:
    """Increments as driven, each beginning where the one before ended; the boot clock known to its own bound."""
    odometry = [event for event in events if isinstance(event, Odometry)]
    assert any(np.allclose(event.delta, DELTA, atol=1e-4) for event in odometry)
    assert all(a.t_meas_ns == b.t0_ns for a, b in pairwise(odometry))
    fix = next(event for event in events if isinstance(event, Fix))
    assert fix.kind == "pose"
    np.testing.assert_allclose(fix.z, [3.0, 4.0, 1.0], atol=0.02)
    timesync = hearing.status()["timesync"]
    assert abs(timesync["offset_ns"] - boot_ns) <= timesync["rtt_ns"] / 2 + 1


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_increments_and_fixes_over_udp(speed: float) -> None:
    async def scene() -> None:
        clock, port, events, hearing = run_clock(speed), free_port(), [], reader()
        link = MavlinkLink(f"udpin:127.0.0.1:{port}", hearing, clock, events.append)
        server = StandInServer(vehicle(clock), f"udpout:127.0.0.1:{port}", clock)
        drive = Drive(server.stand_in, clock, server.push)
        await link.start()
        assert not link.connected
        await server.start()
        try:
            await until(lambda: len(events) > 20 and any(isinstance(event, Fix) for event in events), drive)
            assert link.connected
            check(events, hearing, server.stand_in.settings.boot_ns)
        finally:
            await server.close()
            await link.close()

    asyncio.run(scene())


def test_a_vehicle_that_listens_is_called() -> None:
    """udpout: the companion speaks first, and the vehicle answers to where that came from."""

    async def scene() -> None:
        clock, port, events, hearing = run_clock(), free_port(), [], reader()
        stand_in = vehicle(clock)
        loop = asyncio.get_running_loop()

        class Listening(asyncio.DatagramProtocol):
            transport: asyncio.DatagramTransport
            peer: tuple[str, int] | None = None

            def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
                self.peer = addr
                self.send(stand_in.receive(clock.now_ns(), data))

            def send(self, frames: list[bytes]) -> None:
                for frame in frames:
                    if self.peer is not None:
                        self.transport.sendto(frame, self.peer)

        transport, protocol = await loop.create_datagram_endpoint(Listening, local_addr=("127.0.0.1", port))
        protocol.transport = transport
        link = MavlinkLink(f"udpout:127.0.0.1:{port}", hearing, clock, events.append)
        drive = Drive(stand_in, clock, lambda t: protocol.send(stand_in.outgoing(t) + stand_in.push(t)))
        await link.start()
        try:
            await until(lambda: len(events) > 10 and any(isinstance(event, Fix) for event in events), drive)
            check(events, hearing, stand_in.settings.boot_ns)
        finally:
            await link.close()
            transport.close()

    asyncio.run(scene())


def test_once_the_vehicle_is_known_other_senders_are_ignored() -> None:
    async def scene() -> None:
        clock, port, events = run_clock(), free_port(), []
        hearing = reader()
        link = MavlinkLink(f"udpin:127.0.0.1:{port}", hearing, clock, events.append)
        server = StandInServer(vehicle(clock), f"udpout:127.0.0.1:{port}", clock)
        stranger = StandInServer(vehicle(clock), f"udpout:127.0.0.1:{port}", clock)
        await link.start()
        await server.start()
        drive = Drive(server.stand_in, clock, server.push)
        try:
            await until(lambda: len(events) > 3, drive)
            await stranger.start()
            await until(lambda: hearing.counters["link.other_address"] > 0, drive)
            # It never hears an answer either, although it bears the same system id.
            seen = len(events)
            await until(lambda: len(events) > seen + 10, drive)
            assert stranger.stand_in.counters["heartbeat"] == 0
            assert server.stand_in.counters["heartbeat"] > 0
        finally:
            await stranger.close()
            await server.close()
            await link.close()

    asyncio.run(scene())


def test_increments_over_a_serial_line() -> None:
    async def scene() -> None:
        clock, events = run_clock(), []
        master, slave = pty.openpty()
        tty.setraw(master)
        os.set_blocking(master, False)
        stand_in, loop = vehicle(clock), asyncio.get_running_loop()

        def write(frames: list[bytes]) -> None:
            for frame in frames:
                os.write(master, frame)

        def readable() -> None:
            write(stand_in.receive(clock.now_ns(), os.read(master, 4096)))

        loop.add_reader(master, readable)
        hearing = reader()
        link = MavlinkLink(f"serial:{os.ttyname(slave)}:921600", hearing, clock, events.append)
        drive = Drive(stand_in, clock, lambda t: write(stand_in.outgoing(t) + stand_in.push(t)))
        await link.start()
        try:
            await until(lambda: link.connected)
            await until(lambda: len(events) > 20 and any(isinstance(event, Fix) for event in events), drive)
            check(events, hearing, stand_in.settings.boot_ns)
            # The plug is pulled.
            loop.remove_reader(master)
            os.close(slave)
            os.close(master)
            await until(lambda: hearing.counters["link.open_failed"] > 0)
            assert hearing.counters["link.lost"] == 1 and not link.connected
        finally:
            await link.close()

    asyncio.run(scene())


def test_a_serial_line_that_does_not_keep_up_loses_whole_frames_only() -> None:
    async def scene() -> None:
        master, slave = pty.openpty()
        tty.setraw(master)
        os.set_blocking(master, False)
        counters: Counter[str] = Counter()
        line = SerialLine(
            parse_endpoint(f"serial:{os.ttyname(slave)}:57600"), lambda data: True, lambda: None, counters
        )
        await line.start()
        try:
            await until(lambda: line.connected)
            for k in range(1000):
                line.send(k.to_bytes(4, "big") * 64)
            kept = 1000 - counters["link.send_dropped"]
            assert 100 < kept < 1000
            got = bytearray()

            def read() -> None:
                with contextlib.suppress(BlockingIOError):
                    got.extend(os.read(master, 65536))

            await until(lambda: len(got) >= kept * 256, read)
            assert got == b"".join(k.to_bytes(4, "big") * 64 for k in range(kept))
        finally:
            await line.close()
            os.close(slave)
            os.close(master)

    asyncio.run(scene())


def test_a_tcp_link_comes_back_after_its_server() -> None:
    async def scene() -> None:
        clock, port, hearing = run_clock(), free_port(), reader()
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(dialect.MAVLink(None, 1, 1))
        heard = bytearray()

        async def serve(stream: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            # A broken frame first: the next connection must not choke on its rest.
            writer.write(beat + beat[:7])
            heard.extend(await stream.read(4096))
            writer.close()

        link = MavlinkLink(f"tcp:127.0.0.1:{port}", hearing, clock, lambda event: None)
        await link.start()
        await until(lambda: hearing.counters["link.open_failed"] > 0)
        server = await asyncio.start_server(serve, "127.0.0.1", port)
        try:
            await until(lambda: hearing.messages >= 2)
            assert hearing.counters["link.lost"] >= 1
            assert heard[0] == 0xFD
            assert hearing.counters["mavlink.bad_data"] == 0
        finally:
            await link.close()
            server.close()
            await server.wait_closed()

    asyncio.run(scene())


@pytest.mark.parametrize(
    "text", ["", "udp:127.0.0.1:14550", "udpin:127.0.0.1", "udpin::14550", "tcp:host:port", "serial:57600", "tcp:h:-1"]
)
def test_a_wrong_endpoint_names_itself_and_the_valid_forms(text: str) -> None:
    with pytest.raises(ValueError, match="udpin:HOST:PORT") as caught:
        MavlinkLink(text, reader(), run_clock(), lambda event: None)
    assert f"'{text}'" in str(caught.value)


def test_impossible_ports_and_baud_rates_are_named() -> None:
    with pytest.raises(ValueError, match="the port must be from 1 to 65535"):
        parse_endpoint("udpin:127.0.0.1:70000")
    with pytest.raises(ValueError, match="12345 is not a baud rate"):
        parse_endpoint("serial:/dev/ttyAMA0:12345")
    parsed = parse_endpoint("serial:/dev/serial/by-id/usb-x:1:57600")
    assert (parsed.kind, parsed.place, parsed.number) == ("serial", "/dev/serial/by-id/usb-x:1", 57600)


def failing(endpoint: str) -> str:
    async def scene() -> None:
        link = MavlinkLink(endpoint, reader(), run_clock(), lambda event: None)
        try:
            await link.start()
        finally:
            await link.close()

    with pytest.raises(MavlinkError) as caught:
        asyncio.run(scene())
    return str(caught.value)


def test_an_occupied_port_is_told_in_one_line() -> None:
    async def scene() -> str:
        port = free_port()
        first = MavlinkLink(f"udpin:127.0.0.1:{port}", reader(), run_clock(), lambda event: None)
        await first.start()
        try:
            return await asyncio.to_thread(failing, f"udpin:127.0.0.1:{port}")
        finally:
            await first.close()

    message = asyncio.run(scene())
    assert "already in use" in message and "\n" not in message


def test_a_foreign_address_is_told() -> None:
    assert "not an address of this computer" in failing("udpin:192.0.2.1:14550")
