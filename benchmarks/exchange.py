"""A pair exchange of two agents over Zenoh, beside bare messages of the same sizes there and back."""

from __future__ import annotations

import asyncio
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import zenoh

from agent.node import Node, Outgoing
from agent.sensor_input import encode
from benchmarks.fleet import scenario
from network.messages import Channel, Packet
from network.transport import free_port
from network.zenoh_session import ZenohSettings, link_pair
from network.zenoh_transport import ZenohTransport
from sim.agents import agent_config
from sim.scenario import Scenario
from sim.world import Output, SimulatedWorld

PATIENCE_S = 10.0


@dataclass(frozen=True, slots=True)
class Exchange:
    """Medians [s] from a range measurement to its use by the robot that measured, and of a bare round trip."""

    pair_s: float
    bare_s: float
    bytes_sent: tuple[int, int]


class Robot:
    """A whole agent on a Zenoh session of its own, without timers of its own."""

    def __init__(self, name: str, node: Node, settings: ZenohSettings, began_ns: int) -> None:
        self.name, self.node, self._began_ns = name, node, began_ns
        self.transport = ZenohTransport(settings, self._on_packet)
        self.sizes: list[int] = []
        self.on_change: Callable[[], None] = lambda: None

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._began_ns

    def measure(self, item: Output, t_ns: int, t0_ns: int | None = None) -> None:
        """Hand in a sensor's datum as taken at `t_ns`."""
        datum = encode(t_ns, item.kind, item.z, item.R, of=item.of, sensor=item.sensor, t0_ns=t0_ns)
        self._carry_out(self.node.on_sensor(self.now_ns(), datum))

    def tick(self) -> None:
        if self.node.next_deadline_ns() <= self.now_ns():
            self._carry_out(self.node.on_tick(self.now_ns()))

    def applied(self) -> int:
        """Contacts that this robot began and has used."""
        return self.node.agent.counters["pair.applied_initiator"]

    def _on_packet(self, packet: Packet) -> None:
        self._carry_out(self.node.on_packet(self.now_ns(), packet))
        self.on_change()

    def _carry_out(self, out: Outgoing) -> None:
        for packet in out.packets:
            if packet.channel == Channel.PAIR:
                self.sizes.append(len(packet.payload))
            self.transport.send(packet)


class Bare:
    """Two Zenoh sessions; the second answers each message with bytes of a given size, on its receive thread."""

    def __init__(self, request: int, reply: int) -> None:
        listen, self._request, answer = f"tcp/127.0.0.1:{free_port()}", bytes(request), bytes(reply)
        self._loop, self._back = asyncio.get_running_loop(), asyncio.Event()
        self._asked: Any = zenoh.open(_plain(listen=[listen]))
        self._asking: Any = zenoh.open(_plain(connect=[listen]))
        publisher = self._asked.declare_publisher("back")
        self._publisher = self._asking.declare_publisher("there")

        def answered(_: Any) -> None:
            publisher.put(answer)

        self._subscribers = [
            self._asked.declare_subscriber("there", zenoh.handlers.Callback(answered, indirect=False)),
            self._asking.declare_subscriber("back", zenoh.handlers.Callback(self._arrived, indirect=False)),
        ]

    def _arrived(self, _: Any) -> None:
        self._loop.call_soon_threadsafe(self._back.set)

    async def ready(self) -> None:
        """Wait until either hears the other."""
        async with asyncio.timeout(PATIENCE_S):
            while not self._back.is_set():
                self._publisher.put(self._request)
                await asyncio.sleep(0.1)
        await asyncio.sleep(0.2)

    async def round_trip(self) -> float:
        """Seconds from a message to its answer in the event loop."""
        self._back.clear()
        begin = time.perf_counter()
        self._publisher.put(self._request)
        await asyncio.wait_for(self._back.wait(), PATIENCE_S)
        return time.perf_counter() - begin

    def close(self) -> None:
        self._asking.close()
        self._asked.close()


def _plain(**endpoints: list[str]) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    for name in ("listen", "connect"):
        config.insert_json5(f"{name}/endpoints", json.dumps(endpoints.get(name, [])))
    return config


async def _until(what: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not what():
            await asyncio.sleep(0.001)


async def _measured(rounds: int) -> Exchange:
    made = Scenario.model_validate(scenario(2, 10.0, 0.0, 10.0))
    world = SimulatedWorld(made, 1)
    began_ns, port = time.monotonic_ns(), free_port()
    places = {"r00": link_pair("127.0.0.1", port), "r01": link_pair("127.0.0.1", free_port(exclude={port}))}
    robots: dict[str, Robot] = {}
    for number, part in enumerate(made.robots):
        config = agent_config(made, world, part)
        node = Node(
            config.settings(0),
            config.network.settings(config.lateness),
            boot_id=number + 1,
            incarnation=1,
            software="benchmark",
            sensors=config.sensor_configs(),
        )
        own = ZenohSettings("benchmark", part.id, number + 1, places[part.id], tuple(places.items()))
        robots[part.id] = Robot(part.id, node, own, began_ns)
    for robot in robots.values():
        await robot.transport.start()
    one, two = robots["r00"], robots["r01"]
    bare: Bare | None = None
    pair_s, bare_s = [], []
    try:

        def linked() -> bool:
            for robot in (one, two):
                robot.tick()
            return all(any(peer.up for peer in robot.node.endpoint.peers()) for robot in (one, two))

        await _until(linked)
        used = asyncio.Event()
        before = 0
        one.on_change = lambda: used.set() if one.applied() > before else None
        t_ns = 0
        for k in range(1, rounds + 1):
            here_ns = one.now_ns()
            outputs = [item for item in world.outputs(1 + k % world.steps) if item.kind in ("odometry", "range")]
            for robot in (one, two):
                robot.tick()
                odometry = next(item for item in outputs if item.robot == robot.name and item.kind == "odometry")
                robot.measure(odometry, here_ns, t_ns)
            t_ns = here_ns
            datum = next(item for item in outputs if item.robot == "r00" and item.kind == "range")
            before = one.applied()
            used.clear()
            begin = time.perf_counter()
            one.measure(datum, here_ns)
            await asyncio.wait_for(used.wait(), PATIENCE_S)
            pair_s.append(time.perf_counter() - begin)
            if bare is None:
                bare = Bare(one.sizes[-1], two.sizes[-1])
                await bare.ready()
            bare_s.append(await bare.round_trip())
    finally:
        for robot in robots.values():
            await robot.transport.close()
        if bare is not None:
            bare.close()
    warm = rounds // 5
    sizes = (one.sizes[-1], two.sizes[-1])
    return Exchange(statistics.median(pair_s[warm:]), statistics.median(bare_s[warm:]), sizes)


def exchange(rounds: int = 500) -> Exchange:
    """Pair exchanges and bare round trips in turns, in one process. Raises `TimeoutError` if one never ends."""
    return asyncio.run(_measured(rounds))
