"""Launches a run of real processes: the world with its autopilot stand-ins, and one process per agent.

All wait at a barrier and start on one fleet clock. When something fails before the start, or the world fails, all
are stopped and the reason is told; an agent that dies later is reported and the others go on. Everything started
here is ended here, by its process id.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from agent.config_file import ConfigError
from agent.settings import NS
from deploy.agent_files import Host, agent_file
from deploy.exit_words import ended
from deploy.fault import SOCKET
from deploy.life_figures import summed
from deploy.live_faults import LiveFaults
from deploy.member import Member, spawn
from deploy.process_faults import ProcessFaults
from network.transport import free_port
from sim.closed_loop import MOTION
from sim.host import HostPlan, plan_json
from sim.scenario import Scenario
from sim.world import World

READY_TIMEOUT_S = 30.0
LEAD_S = 2.0
TOLD_S = 0.2
"""Wall time within which all processes have heard of a fault that is injected by hand."""
STOP_TIMEOUT_S = 15.0
SILENT_S = 10.0
WORLD = "world"


class LaunchError(RuntimeError):
    """A run that could not start or had to be stopped; one line says why."""


@dataclass(slots=True)
class Outcome:
    """How a run of processes ended."""

    exits: dict[str, int]
    figures: dict[str, dict[str, Any]]
    world: dict[str, Any]
    t0_ns: int
    interrupted: bool
    messages: list[str]


class Launcher:
    """Starts, watches and ends the processes of one run."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        seed: int,
        speed: float,
        run_dir: Path,
        hosts: Mapping[str, Host] | None = None,
    ) -> None:
        """`hosts`: network namespaces the agents run in (absent: all on loopback); needs root. Raises `ConfigError`."""
        self._hosts = hosts or {}
        for key in ("range_m", "nearest", "rewire"):
            if self._hosts and getattr(scenario.links, key) is not None:
                raise ConfigError(f"links.{key}: who hears whom cannot be told to agents in namespaces; leave it out")
        self._scenario, self._world, self._seed, self._speed = scenario, world, seed, speed
        self._run_dir = run_dir
        self.members: dict[str, Member] = {}
        self.messages: list[str] = []
        self._changed = asyncio.Event()
        self._interrupted = False
        self._t0_ns = 0
        self.begin: dict[str, int] | None = None
        """When the run's clock starts, as it is told to all; None before the barrier."""
        self._faults = LiveFaults(
            scenario, seed, lambda: self.t_s(TOLD_S), self._tell_all, lambda *fault: self._nemesis.strike_soon(*fault)
        )
        self._nemesis = ProcessFaults(self.members, self._faults, self._spawn_agent, run_dir, speed)

    async def run(self, show: Callable[[Launcher], None] | None = None) -> Outcome:
        """Run to the end. Raises `LaunchError` when the run could not start or the world failed."""
        # Sockets live in a short private path: their length is limited.
        private = self._nemesis.private = Path(tempfile.mkdtemp(prefix="cofix-"))
        loop = asyncio.get_running_loop()
        # Signals are the main thread's; beside it whoever started this thread calls `interrupt`.
        watched = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
        for number in watched:
            loop.add_signal_handler(number, self.interrupt)
        server = None
        try:
            plan = self._write_files(private)
            server = await asyncio.start_unix_server(self._serve, path=plan.control_socket, limit=2**22)
            await self._start(private)
            await self._barrier()
            await self._faults.serve(private / SOCKET)
            await self._watch(show)
        finally:
            self._faults.close()
            await self._nemesis.close()
            await self._end()
            if server is not None:
                server.close()
            for number in watched:
                loop.remove_signal_handler(number)
            shutil.rmtree(private, ignore_errors=True)
        return self._outcome()

    def progress(self) -> float:
        """Share of the run that is played, in [0, 1]."""
        world = self.members.get(WORLD)
        return float(world.status.get("progress", 0.0)) if world is not None else 0.0

    def t_s(self, ahead_s: float = 0.0) -> float:
        """The instant of the run, or that in so much wall time, in seconds of fleet time since its start."""
        if self.begin is None:
            return 0.0
        wall_ns = time.monotonic_ns() - self.begin["monotonic0_ns"] + int(ahead_s * NS)
        return max(wall_ns / NS * self._speed, 0.0)

    @property
    def t0_ns(self) -> int:
        """The start of the run in fleet time, 0 before it is known."""
        return self._t0_ns

    def injected(self) -> list[str]:
        """Names of the faults that are on now."""
        return self._faults.active(self.t_s()) if self.begin is not None else []

    def played(self) -> Scenario:
        """The scenario with the faults there were, those by hand too."""
        return self._faults.played()

    # -- start ----------------------------------------------------------------------------------------------

    def _write_files(self, private: Path) -> HostPlan:
        robots = [robot.id for robot in self._scenario.robots]
        taken: list[int] = []

        def port() -> int:
            taken.append(free_port(exclude=taken))
            return taken[-1]

        ports = {name: port() for name in robots}
        plan = HostPlan(
            scenario=str(self._run_dir / "scenario.toml"),
            seed=self._seed,
            speed=self._speed,
            control_socket=str(private / "control.sock"),
            link_endpoint=f"tcp/127.0.0.1:{port()}",
            mavlink_ports={name: port() for name in robots},
            sensor_sockets={name: str(private / name / "sensors.sock") for name in robots},
            motion=str(self._run_dir / MOTION),
            namespaces={name: host.namespace for name, host in self._hosts.items()},
        )
        (private / "plan.json").write_text(plan_json(plan))
        agents = self._run_dir / "agents"
        agents.mkdir(exist_ok=True)
        (self._run_dir / "logs").mkdir(exist_ok=True)
        for robot in self._scenario.robots:
            tables = agent_file(
                self._scenario,
                self._world,
                robot,
                self._seed,
                self._speed,
                plan,
                self._run_dir,
                private,
                ports,
                self._hosts,
            )
            with (agents / f"{robot.id}.toml").open("wb") as file:
                tomli_w.dump(tables, file)
        return plan

    async def _start(self, private: Path) -> None:
        await self._spawn(WORLD, "-m", "sim.host", str(private / "plan.json"))
        for robot in self._scenario.robots:
            await self._spawn_agent(robot.id, self._run_dir / "agents" / f"{robot.id}.toml")

    async def _spawn(self, name: str, *arguments: str, life: int = 1) -> None:
        log = self._run_dir / "logs" / f"{name}.log"
        namespace = self._hosts[name].namespace if name in self._hosts else None
        self.members[name] = await spawn(name, log, arguments, life, self._changed.set, namespace)

    async def _spawn_agent(self, robot: str, config: Path, life: int = 1) -> None:
        await self._spawn(robot, "-m", "deploy.cli", "agent", str(config), life=life)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = None
        with contextlib.suppress(OSError, ValueError, asyncio.IncompleteReadError):
            while line := await reader.readline():
                message = json.loads(line)
                name = message.get("hello", name)
                member = self.members.get(name) if name is not None else None
                if member is None:
                    continue
                member.writer = writer
                member.heard_s = time.monotonic()
                member.ready = member.ready or "ready" in message
                if "ready" in message and self.begin is not None:
                    member.tell({"start": {**self.begin, "changes": self._faults.changes}})
                    member.told = True
                if "status" in message:
                    member.status = message["status"]
                if "done" in message:
                    member.done = message["done"]
                self._changed.set()

    async def _barrier(self) -> None:
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not all(member.ready for member in self.members.values()):
            for member in self.members.values():
                if member.exit_code is not None:
                    raise LaunchError(f"{member.name} {ended(member.exit_code, member.log)} before the start")
            if self._interrupted:
                raise LaunchError("interrupted before the start")
            if time.monotonic() > deadline:
                late = ", ".join(m.name for m in self.members.values() if not m.ready)
                raise LaunchError(f"{late} not ready after {READY_TIMEOUT_S:.0f} s; see {self._run_dir / 'logs'}")
            await self._wait(0.2)
        self._t0_ns = time.time_ns() // NS * NS
        self.begin = {"t0_ns": self._t0_ns, "monotonic0_ns": time.monotonic_ns() + int(LEAD_S * NS)}
        for member in self.members.values():
            member.tell({"start": self.begin})
            member.told = True
        self._nemesis.begin(self.begin["monotonic0_ns"])

    # -- work and end ---------------------------------------------------------------------------------------

    async def _watch(self, show: Callable[[Launcher], None] | None) -> None:
        world = self.members[WORLD]
        reported: list[str] = []
        while world.done is None and not self._interrupted:
            if world.exit_code is not None:
                raise LaunchError(f"the world {ended(world.exit_code, world.log)}; all agents are stopped")
            for member in self.members.values():
                told = self._trouble(member)
                if told is not None and member.name not in reported:
                    reported.append(member.name)
                    at = self.progress() * self._scenario.duration_s
                    self.messages.append(f"{member.name} {told} at about {at:.0f} s; the others go on")
            if show is not None:
                show(self)
            await self._wait(0.25)
        if show is not None:
            show(self)

    @staticmethod
    def _trouble(member: Member) -> str | None:
        """What is wrong with a process, if anything; what a fault has done to it is not."""
        if member.gone:
            return None
        if member.exit_code is not None:
            return ended(member.exit_code, member.log)
        if time.monotonic() - member.heard_s > SILENT_S:
            return f"has not answered for {SILENT_S:.0f} s"
        return None

    async def _wait(self, seconds: float) -> None:
        self._changed.clear()
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._changed.wait(), seconds)

    def interrupt(self) -> None:
        """End the run; to be called in its event loop."""
        self._interrupted = True
        self._changed.set()

    def _tell_all(self, message: dict[str, Any]) -> None:
        """Tell those that have started; who starts later is told with the start."""
        for member in self.members.values():
            if member.told:
                member.tell(message)

    async def _end(self) -> None:
        """Stop what still runs: a word, then SIGTERM, then SIGKILL; by process id."""
        order = [m for m in self.members.values() if m.name != WORLD] + [
            m for m in self.members.values() if m.name == WORLD
        ]
        for member in order:
            member.tell({"stop": True})
        await self._all_gone(STOP_TIMEOUT_S)
        for number in (signal.SIGTERM, signal.SIGKILL):
            for member in order:
                if member.exit_code is None:
                    if number == signal.SIGKILL:
                        self.messages.append(f"{member.name} did not stop when told to and was killed")
                    member.signal(number)
            await self._all_gone(3.0)
        for member in order:
            if member.reaper is not None:
                await member.reaper

    async def _all_gone(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while any(m.exit_code is None for m in self.members.values()) and time.monotonic() < deadline:
            await self._wait(0.1)

    def _outcome(self) -> Outcome:
        agents = {name: member for name, member in self.members.items() if name != WORLD}
        exits = {name: 0 if m.gone else -1 if m.exit_code is None else m.exit_code for name, m in agents.items()}
        figures = {}
        for name, member in agents.items():
            lives = [*self._nemesis.past.get(name, []), *([member.done] if member.done and not member.gone else [])]
            if lives:
                figures[name] = summed(lives)
        world = self.members[WORLD].done or {}
        return Outcome(exits, figures, world, self._t0_ns, self._interrupted, self.messages)
