"""Real Zenoh sessions on loopback: what arrives where, and that starting and stopping is orderly."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
import zenoh

from network import redial as redial_module
from network import zenoh_transport as transport_module
from network.messages import MAX_MESSAGE_BYTES, Channel, Packet
from network.transport import Transport, TransportError, free_port
from network.zenoh_session import ZenohSettings, link_pair
from network.zenoh_transport import ZenohTransport, key_of, packet_of

DEADLINE_S = 15.0


def settings_of(robots: list[str]) -> dict[str, ZenohSettings]:
    """A full mesh on loopback, two links per peer."""
    ports: list[int] = []
    for _ in robots:
        ports.append(free_port(exclude=ports))
    links = {robot: link_pair("127.0.0.1", port) for robot, port in zip(robots, ports, strict=True)}
    everybody = tuple(sorted(links.items()))
    return {
        robot: ZenohSettings(fleet="test", robot=robot, boot_id=7, listen=links[robot], connect=everybody)
        for robot in robots
    }


class Fleet:
    """Open transports and what each has heard."""

    def __init__(self, settings: dict[str, ZenohSettings]) -> None:
        self.heard: dict[str, list[Packet]] = {robot: [] for robot in settings}
        self.ends = {robot: ZenohTransport(own, self.heard[robot].append) for robot, own in settings.items()}

    async def until(self, condition: Callable[[], bool], again: Callable[[], Any] = lambda: None) -> None:
        """Wait for a condition, doing `again` meanwhile: early puts may go to nobody."""
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, "nothing happened in time"
            again()
            await asyncio.sleep(0.05)

    async def connected(self) -> None:
        others = len(self.ends) - 1
        await self.until(lambda: all(end.counters["liveliness_up"] >= others for end in self.ends.values()))

    def payloads(self, robot: str) -> set[bytes]:
        return {packet.payload for packet in self.heard[robot]}


@asynccontextmanager
async def fleet_of(*robots: str) -> AsyncIterator[Fleet]:
    fleet = Fleet(settings_of(list(robots)))
    try:
        for end in fleet.ends.values():
            await end.start()
        yield fleet
    finally:
        for end in fleet.ends.values():
            await end.close()


def test_broadcasts_reach_the_others_and_directed_packets_one() -> None:
    async def scene() -> None:
        async with fleet_of("r1", "r2", "r3") as fleet:
            await fleet.connected()
            sender: Transport = fleet.ends["r2"]
            hello = Packet("r2", Channel.HELLO, None, b"hello")
            belief = Packet("r2", Channel.BELIEF, None, b"belief")
            pair = Packet("r2", Channel.PAIR, "r1", b"pair" * 290)

            def speak() -> None:
                for packet in (hello, belief, pair):
                    sender.send(packet)

            await fleet.until(lambda: len(fleet.payloads("r1")) == 3 and len(fleet.payloads("r3")) == 2, speak)
            assert {packet.channel for packet in fleet.heard["r3"]} == {Channel.HELLO, Channel.BELIEF}
            assert all(packet in (hello, belief, pair) for packet in fleet.heard["r1"])
            assert fleet.heard["r2"] == []

    asyncio.run(scene())


def test_both_directions_work_though_only_one_side_dials() -> None:
    async def scene() -> None:
        async with fleet_of("r1", "r2") as fleet:
            await fleet.connected()

            def speak() -> None:
                for robot, peer in (("r1", "r2"), ("r2", "r1")):
                    fleet.ends[robot].send(Packet(robot, Channel.PAIR, peer, robot.encode()))

            await fleet.until(lambda: fleet.payloads("r1") == {b"r2"} and fleet.payloads("r2") == {b"r1"}, speak)

    asyncio.run(scene())


def test_a_departure_and_a_return_are_counted_and_heal() -> None:
    async def scene() -> None:
        async with fleet_of("r1", "r2") as fleet:
            await fleet.connected()
            listener = fleet.ends["r1"]
            await fleet.ends["r2"].close()
            await fleet.until(lambda: listener.counters["liveliness_down"] == 1)
            await fleet.ends["r2"].start()
            again = Packet("r2", Channel.HELLO, None, b"again")
            await fleet.until(lambda: b"again" in fleet.payloads("r1"), lambda: fleet.ends["r2"].send(again))
            assert listener.counters["liveliness_up"] == 2

    asyncio.run(scene())


def test_estimates_and_status_are_published_but_robots_do_not_listen_to_them() -> None:
    async def scene() -> None:
        async with fleet_of("r1", "r2") as fleet:
            await fleet.connected()
            own = fleet.ends["r1"].settings
            config = zenoh.Config()
            config.insert_json5("mode", '"client"')
            config.insert_json5("connect/endpoints", f'["{own.listen[1].split("?")[0]}"]')
            config.insert_json5("scouting/multicast/enabled", "false")
            seen: list[str] = []
            tool = await asyncio.to_thread(zenoh.open, config)
            try:
                tool.declare_subscriber(
                    "cofix/v1/test/*/*",
                    zenoh.handlers.Callback(lambda s: seen.append(str(s.key_expr)), indirect=False),
                )

                def speak() -> None:
                    fleet.ends["r1"].publish(Channel.ESTIMATE, b"x" * 3_000)
                    fleet.ends["r1"].publish(Channel.STATUS, b"y")

                await fleet.until(lambda: len(set(seen)) >= 2, speak)
            finally:
                await asyncio.to_thread(tool.close)
            assert set(seen) == {"cofix/v1/test/r1/estimate", "cofix/v1/test/r1/status"}
            assert fleet.heard["r2"] == []
            with pytest.raises(ValueError, match="estimate and status"):
                fleet.ends["r1"].publish(Channel.BELIEF, b"")

    asyncio.run(scene())


def test_an_occupied_port_is_refused_with_the_endpoint_and_the_remedy() -> None:
    async def scene() -> None:
        async with fleet_of("r1") as fleet:
            taken = fleet.ends["r1"].settings.listen
            second = ZenohTransport(
                ZenohSettings(fleet="test", robot="r2", boot_id=1, listen=taken), lambda packet: None
            )
            with pytest.raises(TransportError) as refused:
                await second.start()
            assert str(refused.value).startswith(taken[0] + " is in use: ")
            assert "\n" not in str(refused.value)
            await second.close()

    asyncio.run(scene())


def test_a_listen_address_of_another_computer_is_refused() -> None:
    async def scene() -> None:
        away = ZenohSettings(fleet="test", robot="r1", boot_id=1, listen=("tcp/192.0.2.1:20999",))
        with pytest.raises(TransportError, match="not an address of this computer"):
            await ZenohTransport(away, lambda packet: None).start()

    asyncio.run(scene())


def test_sending_before_the_start_and_after_the_end_is_counted() -> None:
    async def scene() -> None:
        hello = Packet("r1", Channel.HELLO, None, b"")
        async with fleet_of("r1") as fleet:
            end = fleet.ends["r1"]
            with pytest.raises(TransportError, match="open already"):
                await end.start()
            with pytest.raises(ValueError, match="own name"):
                end.send(Packet("r2", Channel.HELLO, None, b""))
        end.send(hello)
        await end.close()
        fresh = ZenohTransport(end.settings, lambda packet: None)
        fresh.send(hello)
        assert end.counters["not_open"] == fresh.counters["not_open"] == 1

    asyncio.run(scene())


def test_a_session_that_was_closed_underneath_is_opened_again() -> None:
    async def scene() -> None:
        async with fleet_of("r1", "r2") as fleet:
            await fleet.connected()
            end = fleet.ends["r1"]
            assert end._session is not None
            await asyncio.to_thread(end._session._session.close)
            await fleet.until(lambda: end.counters["reopened"] == 1)
            assert end.counters["lost_closed"] == 1
            packet = Packet("r2", Channel.HELLO, None, b"again")
            await fleet.until(
                lambda: b"again" in fleet.payloads("r1"), again=lambda: fleet.ends["r2"].send(packet)
            )

    asyncio.run(scene())


class Scripted:
    """A session that carries what it is told to."""

    def __init__(self, settings: Any = None, listen: Any = (), connect: tuple[str, ...] = ()) -> None:
        self.connect, self.puts, self.ended = connect, [], False

    async def open(self, on_sample: Callable[[Any], None], on_liveliness: Any = None) -> None:
        self.bring = on_sample

    def put(self, key: str, payload: bytes, reliable: bool) -> bool:
        self.puts.append(key)
        return True

    async def close(self) -> bool:
        self.ended = True
        return True

    def is_closed(self) -> bool:
        return False


def quickened(patch: pytest.MonkeyPatch) -> None:
    """Time constants of the watch, a tenth to a thirtieth as long."""
    for name, seconds in {"_WATCH_S": 0.05, "_REDIAL_S": 0.1, "_STOOD_STILL_S": 1.0}.items():
        patch.setattr(transport_module, name, seconds)
    patch.setattr(redial_module, "SPARE_S", 0.1)


class FewDialled(ZenohSettings):
    """Of a robot whose session cannot get at r1, as if its link there was half dead."""

    def dialled(self) -> list[str]:
        return [endpoint for endpoint in super().dialled() if endpoint not in dict(self.connect)["r1"]]


def test_a_peer_that_answers_and_is_not_heard_is_dialled_by_a_session_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quickened(monkeypatch)
    packets = [Packet("r2", Channel.HELLO, None, b"to all"), Packet("r2", Channel.PAIR, "r1", b"to r1")]
    back = Packet("r1", Channel.PAIR, "r2", b"back")

    async def scene() -> None:
        settings = settings_of(["r1", "r2", "r3"])
        own = settings["r2"]
        settings["r2"] = FewDialled(own.fleet, own.robot, own.boot_id, own.listen, own.connect, lease_ms=30)
        fleet = Fleet(settings)
        ends = fleet.ends
        # As slow as a link is, the other two find that r2 is silent: it shall be r2 that mends it.
        for robot in ("r1", "r3"):
            monkeypatch.setattr(ends[robot], "_look_after_peers", asyncio.sleep.__get__(0.0))
        try:
            for end in ends.values():
                await end.start()

            def speak() -> None:
                for packet in packets:
                    ends["r2"].send(packet)
                ends["r1"].send(back)

            await fleet.until(lambda: fleet.payloads("r1") == {b"to all", b"to r1"} and fleet.heard["r2"], speak)
            assert ends["r2"].counters["redialled"] >= 1
            assert "to r1" not in fleet.payloads("r3")
        finally:
            for end in ends.values():
                await end.close()

    asyncio.run(scene())


def test_a_peer_s_own_session_ends_when_the_main_one_brings_its_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    quickened(monkeypatch)
    opened: list[Scripted] = []

    def session(*of: Any) -> Scripted:
        opened.append(Scripted(*of))
        return opened[-1]

    monkeypatch.setattr(transport_module, "ZenohSession", session)

    async def scene() -> None:
        there = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0)
        port = there.sockets[0].getsockname()[1]
        connect = (("r1", (f"tcp/127.0.0.1:{port}?rel=1", f"udp/127.0.0.1:{port}?rel=0")), ("r3", ("tcp/127.0.0.1:9",)))
        heard: list[Packet] = []
        end = ZenohTransport(ZenohSettings("f", "r2", 1, (), connect, lease_ms=30), heard.append)
        deadline = time.monotonic() + DEADLINE_S

        async def until(condition: Callable[[], bool]) -> None:
            while not condition():
                assert time.monotonic() < deadline, end.counters
                await asyncio.sleep(0.02)

        await end.start()
        await until(lambda: len(opened) == 2)
        main, own = opened
        assert own.connect == connect[0][1], "r3, which refuses connections, is dialled by nobody"
        own.bring(Sample("cofix/v1/f/r1/hello", b"over its own"))
        end.send(Packet("r2", Channel.HELLO, None, b""))
        end.send(Packet("r2", Channel.PAIR, "r1", b""))
        end.send(Packet("r2", Channel.PAIR, "r3", b""))
        end.publish(Channel.STATUS, b"")
        assert own.puts == ["cofix/v1/f/r2/hello", "cofix/v1/f/r2/pair/r1"]
        assert main.puts == [*own.puts, "cofix/v1/f/r2/pair/r3", "cofix/v1/f/r2/status"]
        assert end.counters["sent"] == 4
        while not own.ended:
            assert time.monotonic() < deadline, end.counters
            main.bring(Sample("cofix/v1/f/r1/hello", b"over the main one"))
            await asyncio.sleep(0.02)
        assert end.counters["redial_ended"] == end.counters["redialled"] == 1
        assert {packet.payload for packet in heard} == {b"over its own", b"over the main one"}
        assert not main.ended
        await end.close()
        there.close()
        assert main.ended

    asyncio.run(scene())


def test_a_session_that_does_not_close_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scene() -> int:
        end = ZenohTransport(ZenohSettings("f", "r1", 1, ()), lambda packet: None)
        end._session = stuck = Scripted()  # type: ignore[assignment]
        monkeypatch.setattr(stuck, "close", asyncio.sleep.__get__(0.0))
        await end.close()
        await end.close()
        return end.counters["close_timeout"]

    assert asyncio.run(scene()) == 1


class Sample:
    """What Zenoh hands to a callback."""

    def __init__(self, key: str, payload: bytes) -> None:
        self.key_expr = key
        self.payload = zenoh.ZBytes(payload)


def test_a_burst_wakes_the_loop_once_and_keeps_the_newest() -> None:
    async def scene() -> None:
        heard: list[bytes] = []
        settings = ZenohSettings(fleet="test", robot="r1", boot_id=1, listen=(), queue_depth=10)
        end = ZenohTransport(settings, lambda packet: heard.append(packet.payload))
        end._session = Scripted()  # type: ignore[assignment]
        wakes: list[Any] = []

        class Loop:
            def call_soon_threadsafe(self, callback: Callable[[], None]) -> None:
                wakes.append(callback)

        end._loop = Loop()  # type: ignore[assignment]
        for k in range(25):
            end._on_sample(Sample("cofix/v1/test/r2/hello", bytes([k])), main=True)
        end._on_sample(Sample("cofix/v1/test/r2/hello", b"\x00" * (MAX_MESSAGE_BYTES + 1)), main=True)
        assert len(wakes) == 1
        wakes[0]()
        assert heard == [bytes([k]) for k in range(15, 25)]
        end._on_sample(Sample("elsewhere", b""), main=True)
        assert len(wakes) == 2
        wakes[1]()
        assert end.counters == {"queue_dropped": 15, "oversize": 1, "received": 10, "foreign_key": 1}

    asyncio.run(scene())


def test_a_failing_receiver_does_not_stop_the_others_packets() -> None:
    async def scene() -> None:
        heard: list[bytes] = []

        def receive(packet: Packet) -> None:
            heard.append(packet.payload)
            if packet.payload == b"bad":
                raise RuntimeError

        end = ZenohTransport(ZenohSettings(fleet="test", robot="r1", boot_id=1, listen=()), receive)
        end._session, end._loop = Scripted(), asyncio.get_running_loop()  # type: ignore[assignment]
        for payload in (b"bad", b"good"):
            end._on_sample(Sample("cofix/v1/test/r2/hello", payload), main=True)
        await asyncio.sleep(0)
        assert heard == [b"bad", b"good"]
        assert end.counters["handler_failed"] == 1

    asyncio.run(scene())


def test_keys_and_packets_translate_both_ways() -> None:
    for packet in (Packet("r1", "hello", None, b"1"), Packet("r1", "pair", "r2", b"2")):
        assert packet_of(key_of("f", packet), packet.payload) == packet
    for key in ("cofix/v2/f/r1/hello", "cofix/v1/f/r1", "other/v1/f/r1/hello", "cofix/v1/f/r1/pair/r2/x"):
        assert packet_of(key, b"") is None
