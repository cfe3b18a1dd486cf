"""The world as a process of a run: truth, sensors, autopilot stand-ins and the table of who hears whom.

Started by the launcher as `python -P -m sim.host PLAN`; it speaks to the agents exactly as the field would: MAVLink
to each autopilot link, datagrams to each sensor socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import json
import os
import signal
import socket
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.clock_faults import FaultyClock
from agent.control import ControlLine
from agent.estimation.motion import LAYOUTS
from agent.fault_parts import AnyFaultPart, AnySensorFaultPart, ClockDriftPart, ClockStepPart, made
from agent.fleet_clock import FleetClock
from agent.sensor_input import encode
from agent.settings import nanoseconds
from network.link_feed import LinkFeed
from sim.agents import autopilot_fix
from sim.autopilot import StandIn, StandInServer
from sim.closed_loop import MotionWriter
from sim.fault_plan import trial_faults
from sim.faulty_world import FaultyWorld
from sim.reach import Reach
from sim.scenario import RobotPart
from sim.scenario_file import load
from sim.trial import open_world
from sim.vehicle_telemetry import VEHICLES, StandInSettings
from sim.world import Output, SimulatedWorld

BOOT_LEAD_NS = 30_000_000_000
FINAL_WALL_S = 0.5
CLONE_NEWNET = 0x40000000


@dataclass(frozen=True, slots=True)
class HostPlan:
    """What the launcher tells the world; stored as JSON."""

    scenario: str
    seed: int
    speed: float
    control_socket: str
    link_endpoint: str
    mavlink_ports: dict[str, int]
    sensor_sockets: dict[str, str]
    motion: str
    """The file for the motion of robots that choose it: nobody else can tell it afterwards."""
    namespaces: dict[str, str] = field(default_factory=dict)
    """Network namespaces of robots that have one of their own: their stand-ins speak there."""

    @staticmethod
    def read(path: Path) -> HostPlan:
        return HostPlan(**json.loads(path.read_text()))


@contextlib.contextmanager
def inside(namespace: str | None) -> Iterator[None]:
    """Sockets that this thread opens within belong to a network namespace. Raises OSError."""
    if namespace is None:
        yield
        return
    here = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    try:
        _enter(os.open(f"/run/netns/{namespace}", os.O_RDONLY))
        try:
            yield
        finally:
            _enter(os.dup(here))
    finally:
        os.close(here)


def _enter(handle: int) -> None:
    try:
        if ctypes.CDLL(None, use_errno=True).setns(handle, CLONE_NEWNET) != 0:
            raise OSError(ctypes.get_errno(), "the network namespace cannot be entered")
    finally:
        os.close(handle)


class WorldHost:
    """Plays a world in fleet time."""

    def __init__(self, plan: HostPlan) -> None:
        self._plan = plan
        self._scenario = load(plan.scenario)
        self._fixes = {robot.id: autopilot_fix(robot) for robot in self._scenario.robots}
        # A silent autopilot goes on moving: it is the stand-in that says nothing.
        world = open_world(self._scenario, plan.seed)
        self._world = FaultyWorld(world, plan.seed, self._fixes, drop_silenced=False)
        self._motion: MotionWriter | None = None
        if isinstance(world, SimulatedWorld) and world.closed_loop:
            self._motion = MotionWriter(Path(plan.motion), world.motion)
            self._motion.add(0)
        self._clocks: dict[str, FaultyClock] = {robot.id: FaultyClock() for robot in self._scenario.robots}
        links = self._scenario.links.settings(plan.seed)
        self._reach = Reach(self._world, links) if links.limited else None
        self._feed = LinkFeed()
        self._parts: dict[str, RobotPart] = {robot.id: robot for robot in self._scenario.robots}
        self._servers: dict[str, StandInServer] = {}
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._undelivered = 0
        self._lag_ns = 0

    async def run(self) -> None:
        control = ControlLine("world")
        await control.connect(self._plan.control_socket)
        await self._feed.serve(self._plan.link_endpoint)
        control.say({"ready": "world"})
        stop = asyncio.ensure_future(control.stopped.wait())
        hear: asyncio.Future[None] | None = None
        try:
            assert control.started is not None
            begin = await control.started
            clock = FleetClock(begin["t0_ns"], begin["monotonic0_ns"], self._plan.speed)
            self._inject(clock.t0_ns)
            await self._start_vehicles(clock)
            hear = asyncio.ensure_future(self._hear(clock.t0_ns, control))
            play = asyncio.ensure_future(self._play(clock, control))
            await asyncio.wait({play, stop}, return_when=asyncio.FIRST_COMPLETED)
            if play.done():
                play.result()
                control.say({"done": {"undelivered": self._undelivered, "lag_max_s": self._lag_ns * 1e-9}})
                await stop
            else:
                play.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await play
        except asyncio.CancelledError:
            pass
        finally:
            stop.cancel()
            if hear is not None:
                hear.cancel()
            for server in self._servers.values():
                await server.close()
            self._socket.close()
            if self._motion is not None:
                self._motion.close()
            await control.close()
            with contextlib.suppress(TimeoutError):
                await self._feed.close()

    def _inject(self, t0_ns: int) -> None:
        """The faults of sensors, autopilots and clocks; the rest is for receivers and the launcher."""
        for name, fault in trial_faults(self._scenario, self._plan.seed).items():
            self._add(name, fault, t0_ns)

    def _add(self, name: str, fault: AnyFaultPart, t0_ns: int) -> None:
        if isinstance(fault, AnySensorFaultPart):
            self._world.add(name, fault)
        elif isinstance(fault, ClockStepPart | ClockDriftPart):
            self._clocks[fault.robot].add(fault.clock(t0_ns))

    async def _hear(self, t0_ns: int, control: ControlLine) -> None:
        """Faults that are added to the run, and ended, while it goes on."""
        while True:
            message = await control.changes.get()
            if "end_fault" in message:
                ended = message["end_fault"]
                self._world.end(ended["id"], nanoseconds(ended["at_s"]))
                continue
            fault = made(**message["fault"])
            assert fault.id is not None
            self._add(fault.id, fault, t0_ns)

    async def _start_vehicles(self, clock: FleetClock) -> None:
        for index, (robot, port) in enumerate(sorted(self._plan.mavlink_ports.items())):
            part = self._parts[robot]
            settings = StandInSettings(
                system_id=index + 1,
                flavour=part.autopilot.flavour,
                sends=tuple(part.autopilot.sends),
                origin=(self._scenario.origin[0], self._scenario.origin[1], self._scenario.origin[2]),
                boot_ns=clock.t0_ns - BOOT_LEAD_NS,
                vehicle_type=VEHICLES[LAYOUTS[part.model].altitude is not None],
                own_fixes=self._fixes[robot] is not None,
                armed=part.autopilot.armed,
                mode=part.autopilot.mode,
            )
            server = StandInServer(StandIn(settings), f"udpout:127.0.0.1:{port}", clock)
            with inside(self._plan.namespaces.get(robot)):
                await server.start()
            self._servers[robot] = server

    async def _play(self, clock: FleetClock, control: ControlLine) -> None:
        world = self._world
        # Told before the start, so that the first packets are judged by it.
        self._publish_reach(0, clock.t0_ns)
        await self._until(clock, clock.t0_ns)
        for robot, server in self._servers.items():
            server.stand_in.set_odometry(clock.t0_ns, np.zeros(4))
            self._place(robot, 0, clock.t0_ns)
            server.push(clock.t0_ns)
        groups: dict[int, list[Output]] = {}
        for k in range(1, world.steps + 1):
            end = k * world.step_ns
            if self._motion is not None:
                # Vehicles are where they have been told to go until now.
                await self._emit_until(k, clock, groups, end - 1)
                await self._until(clock, clock.t0_ns + end)
                self._steer(clock.t0_ns, end)
            for item in world.outputs(k):
                groups.setdefault(item.t_ns + item.late_ns, []).append(item)
            if self._motion is not None:
                self._motion.add(k)
            await self._emit_until(k, clock, groups, end)
            if k % 10 == 0:
                control.say({"status": {"progress": k / world.steps}})
        # The last instant settles and its exchanges end before the agents are stopped.
        await asyncio.sleep(FINAL_WALL_S + clock.wall_s(2 * world.step_ns) / 2)

    async def _emit_until(self, k: int, clock: FleetClock, groups: dict[int, list[Output]], end: int) -> None:
        """What reaches robots until `end`, each datum in its time."""
        for t_ns in sorted(t_ns for t_ns in groups if t_ns <= end):
            items = groups.pop(t_ns)
            await self._until(clock, clock.t0_ns + t_ns)
            if t_ns == k * self._world.step_ns:
                self._publish_reach(k, clock.t0_ns + t_ns)
            self._emit(k, clock.t0_ns, items)

    def _steer(self, t0_ns: int, end: int) -> None:
        """What the autopilots were told until `end`, from the arrival of each command on."""
        for robot in self._scenario.planners():
            for t_ns, steer in self._servers[robot.id].stand_in.control.commands(t0_ns + end):
                self._world.steer(robot.id, t_ns - t0_ns, replace(steer, until_ns=steer.until_ns - t0_ns))

    async def _until(self, clock: FleetClock, t_ns: int) -> None:
        wait_s = clock.wall_s(t_ns - clock.now_ns())
        if wait_s > 0.0:
            await asyncio.sleep(wait_s)
        self._lag_ns = max(self._lag_ns, clock.now_ns() - t_ns)

    def _publish_reach(self, k: int, t_ns: int) -> None:
        if self._reach is not None:
            self._feed.publish(t_ns, self._world.robots, self._reach.at(k))

    def _place(self, robot: str, k: int, t_ns: int) -> None:
        x, y, z = self._world.place(robot, k).tolist()
        layout = LAYOUTS[self._parts[robot].model]
        assert layout.heading is not None
        heading = float(self._world.truth(robot, k)[layout.heading])
        self._servers[robot].stand_in.set_state(t_ns, x, y, z, heading, 0.0, 0.0, 0.0, 0.0)

    def _emit(self, k: int, t0_ns: int, items: list[Output]) -> None:
        """Odometry and fixes by MAVLink, all else to the sensor sockets.

        A late fix goes with the next odometry; one that a newer fix has overtaken does not go at all.
        """
        moved = []
        for item in items:
            stand_in, t_ns = self._servers[item.robot].stand_in, t0_ns + item.t_ns
            if item.kind == "odometry":
                stand_in.set_odometry(t_ns, item.z)
                moved.append((item.robot, t_ns))
            elif item.of is None and item.sensor == self._fixes[item.robot]:
                place, heading = (item.z[:-1], item.z[-1]) if item.kind == "pose" else (item.z, None)
                stand_in.set_fix(t_ns, place[0], place[1], place[2] if len(place) == 3 else 0.0, heading)
            else:
                self._send_sensor(item, t_ns)
        for robot, t_ns in moved:
            self._place(robot, k, t_ns)
            if not self._world.silenced(robot, k * self._world.step_ns):
                self._servers[robot].push(t_ns)

    def _send_sensor(self, item: Output, t_ns: int) -> None:
        stamp_ns = self._clocks[item.robot].local_ns(t_ns)
        payload = encode(stamp_ns, item.kind, item.z, item.R, of=item.of, sensor=item.sensor, attitude=item.attitude)
        try:
            self._socket.sendto(payload, self._plan.sensor_sockets[item.robot])
        except OSError:
            # A dead or overloaded agent loses the datagram, as a driver's would be lost.
            self._undelivered += 1


def main(arguments: list[str]) -> int:
    """Entry point of the process: one argument, the plan's path."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    plan = HostPlan.read(Path(arguments[0]))
    asyncio.run(WorldHost(plan).run())
    return 0


def plan_json(plan: HostPlan) -> str:
    """The plan as stored."""
    values: dict[str, Any] = {name: getattr(plan, name) for name in HostPlan.__slots__}
    return json.dumps(values, indent=1)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
