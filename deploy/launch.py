"""Launches a run of real processes: the world with its autopilot stand-ins, and one process per agent.

All wait at a barrier and start on one fleet clock. When something fails before the start, or the world fails, all
are stopped and the reason is told; an agent that dies later is reported and the others go on. Everything started
here is ended here, by its process id.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomli_w

from agent.estimation.motion import LAYOUTS
from agent.fault_parts import AnyFaultPart, CrashPart, PausePart, RestartPart
from agent.settings import NS
from deploy.fault import SOCKET
from deploy.live_faults import LiveFaults
from network.transport import free_port
from network.zenoh_transport import link_pair
from sim.agents import agent_tables, autopilot_fix, odometry_table, table
from sim.fault_plan import trial_faults
from sim.host import HostPlan, plan_json
from sim.scenario import RobotPart, Scenario, sensor_kind
from sim.world import World

READY_TIMEOUT_S = 30.0
LEAD_S = 2.0
TOLD_S = 0.2
"""Wall time within which all processes have heard of a fault that is injected by hand."""
STOP_TIMEOUT_S = 15.0
SILENT_S = 10.0
WORLD = "world"

# What the scheduling of one computer costs, in wall time: data of an instant are waited for so long, and stamps
# that passed through TIMESYNC are off by so much.
SETTLE_WALL_S = 0.015
STAMP_WALL_S = 0.0015
LEASE_MS, LEASE_PER_ROBOT_MS = 1_000, 250
"""Many processes that start on one computer are slow at first: links that are given up too soon are opened again and
again, and with forty of them that takes all the time there is."""


class LaunchError(RuntimeError):
    """A run that could not start or had to be stopped; one line says why."""


@dataclass(slots=True)
class Member:
    """One process of the run."""

    name: str
    process: asyncio.subprocess.Process
    log: Path
    writer: asyncio.StreamWriter | None = None
    ready: bool = False
    told: bool = False
    """When the run started."""
    status: dict[str, Any] = field(default_factory=dict)
    done: dict[str, Any] | None = None
    exit_code: int | None = None
    heard_s: float = 0.0
    life: int = 1
    gone: bool = False
    """A fault has ended it, which is no failure of the run."""
    reaper: asyncio.Task[None] | None = None


@dataclass(slots=True)
class Outcome:
    """How a run of processes ended."""

    exits: dict[str, int]
    figures: dict[str, dict[str, Any]]
    world: dict[str, Any]
    t0_ns: int
    interrupted: bool
    messages: list[str]


def agent_file(
    scenario: Scenario,
    world: World,
    robot: RobotPart,
    seed: int,
    speed: float,
    plan: HostPlan,
    run_dir: Path,
    state_dir: Path,
    ports: dict[str, int],
) -> dict[str, Any]:
    """The file of one agent: what is common to all runtimes, plus endpoints, clock and injection."""
    tables = agent_tables(scenario, world, robot)
    endpoints = {name: list(link_pair("127.0.0.1", port)) for name, port in ports.items()}
    lateness = tables["lateness"]
    lateness["settle_s"] = max(lateness["settle_s"], SETTLE_WALL_S * speed)
    lateness["tolerance_s"] = max(lateness["tolerance_s"], STAMP_WALL_S * speed)
    fix = autopilot_fix(robot)
    mavlink: dict[str, Any] = {
        "endpoint": f"udpin:127.0.0.1:{plan.mavlink_ports[robot.id]}",
        "simulated": True,
        "odometry_source": "odometry",
        "odometry": odometry_table(scenario, robot),
        "rate_hz": 1.0 / scenario.step_s,
    }
    if fix is not None:
        sensor = robot.sensors[fix]
        mavlink |= {"fixes": ["position"], "fix_sigma_m": sensor.sigma_m, "fix_interval_s": 0.0}
        if sensor_kind(fix, sensor) == "pose":
            mavlink |= {"fixes": [*mavlink["fixes"], "heading"], "fix_sigma_rad": sensor.sigma_rad}
        if LAYOUTS[robot.model].altitude is not None:
            sigma_m = sensor.sigma_z_m or sensor.sigma_m
            mavlink |= {"fixes": [*mavlink["fixes"], "altitude"], "fix_sigma_altitude_m": sigma_m}
    return tables | {
        "clock": {"source": "run", "speed": speed},
        "lateness": lateness,
        "zenoh": {
            "listen": endpoints[robot.id],
            "peers": [{"id": name, "endpoints": value} for name, value in endpoints.items() if name != robot.id],
            "lease_ms": max(LEASE_MS, LEASE_PER_ROBOT_MS * len(endpoints)),
        },
        "mavlink": mavlink,
        "injection": {
            "seed": seed,
            "links": table(scenario.links),
            "faults": [
                table(fault.model_copy(update={"id": name}))
                for name, fault in trial_faults(scenario, seed).items()
                if fault.level in ("link", "forgery", "clock")
            ],
            "table": plan.link_endpoint,
            "fate_log": str(life_file(run_dir, robot.id, 1, "fates.csv")),
        },
        "state_dir": str(state_dir / robot.id),
        "recording": str(life_file(run_dir, robot.id, 1, "mcap")),
        "control_socket": plan.control_socket,
    }


def life_file(run_dir: Path, robot: str, life: int, ending: str) -> Path:
    """What a life of an agent leaves: the recording or the fate log of its first one, or of a later one."""
    number = "" if life == 1 else f".{life}"
    return run_dir / "agents" / f"{robot}{number}.{ending}"


def life_files(run_dir: Path, robot: str, ending: str) -> list[Path]:
    """Of all its lives, in order."""
    found, life = [], 1
    while (path := life_file(run_dir, robot, life, ending)).exists():
        found.append(path)
        life += 1
    return found


class Launcher:
    """Starts, watches and ends the processes of one run."""

    def __init__(self, scenario: Scenario, world: World, seed: int, speed: float, run_dir: Path) -> None:
        self._scenario, self._world, self._seed, self._speed = scenario, world, seed, speed
        self._run_dir = run_dir
        self.members: dict[str, Member] = {}
        self.messages: list[str] = []
        self._changed = asyncio.Event()
        self._interrupted = False
        self._t0_ns = 0
        self._begin: dict[str, int] | None = None
        self._private = Path()
        self._past: dict[str, list[dict[str, Any]]] = {}
        self._nemesis: list[asyncio.Task[None]] = []
        self._faults = LiveFaults(scenario, seed, lambda: self.t_s(TOLD_S), self._tell_all, self._strike_soon)

    async def run(self, show: Callable[[Launcher], None] | None = None) -> Outcome:
        """Run to the end. Raises `LaunchError` when the run could not start or the world failed."""
        # Sockets live in a short private path: their length is limited.
        private = self._private = Path(tempfile.mkdtemp(prefix="cofix-"))
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._interrupt)
        server = None
        try:
            plan = self._write_files(private)
            server = await asyncio.start_unix_server(self._serve, path=plan.control_socket, limit=2**22)
            await self._start(private)
            await self._barrier()
            for name, fault in self._faults.faults.items():
                if fault.level == "process":
                    self._strike_soon(name, fault)
            await self._faults.serve(private / SOCKET)
            await self._watch(show)
        finally:
            self._faults.close()
            for task in self._nemesis:
                task.cancel()
            await asyncio.gather(*self._nemesis, return_exceptions=True)
            await self._end()
            if server is not None:
                server.close()
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.remove_signal_handler(number)
            shutil.rmtree(private, ignore_errors=True)
        return self._outcome()

    def progress(self) -> float:
        """Share of the run that is played, in [0, 1]."""
        world = self.members.get(WORLD)
        return float(world.status.get("progress", 0.0)) if world is not None else 0.0

    def t_s(self, ahead_s: float = 0.0) -> float:
        """The instant of the run, or that in so much wall time, in seconds of fleet time since its start."""
        if self._begin is None:
            return 0.0
        wall_ns = time.monotonic_ns() - self._begin["monotonic0_ns"] + int(ahead_s * NS)
        return max(wall_ns / NS * self._speed, 0.0)

    def injected(self) -> list[str]:
        """Names of the faults that are on now."""
        return self._faults.active(self.t_s()) if self._begin is not None else []

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
        )
        (private / "plan.json").write_text(plan_json(plan))
        agents = self._run_dir / "agents"
        agents.mkdir(exist_ok=True)
        (self._run_dir / "logs").mkdir(exist_ok=True)
        for robot in self._scenario.robots:
            tables = agent_file(
                self._scenario, self._world, robot, self._seed, self._speed, plan, self._run_dir, private, ports
            )
            with (agents / f"{robot.id}.toml").open("wb") as file:
                tomli_w.dump(tables, file)
        return plan

    async def _start(self, private: Path) -> None:
        await self._spawn(WORLD, "-m", "sim.host", str(private / "plan.json"))
        for robot in self._scenario.robots:
            config = self._run_dir / "agents" / f"{robot.id}.toml"
            await self._spawn(robot.id, "-m", "deploy.cli", "agent", str(config))

    async def _spawn(self, name: str, *arguments: str, life: int = 1) -> None:
        log = self._run_dir / "logs" / f"{name}.log"
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        with log.open("ab" if life > 1 else "wb") as output:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",
                *arguments,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
            )
        member = Member(name, process, log, life=life, heard_s=time.monotonic())
        self.members[name] = member
        member.reaper = asyncio.create_task(self._reap(member))

    async def _reap(self, member: Member) -> None:
        member.exit_code = await member.process.wait()
        self._changed.set()

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
                if "ready" in message and self._begin is not None:
                    self._tell(member, {"start": {**self._begin, "changes": self._faults.changes}})
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
        self._begin = {"t0_ns": self._t0_ns, "monotonic0_ns": time.monotonic_ns() + int(LEAD_S * NS)}
        for member in self.members.values():
            self._tell(member, {"start": self._begin})
            member.told = True

    # -- faults of processes --------------------------------------------------------------------------------

    async def _until(self, at_s: float) -> None:
        """Wait for an instant of the run, in seconds of fleet time since its start."""
        assert self._begin is not None
        due_ns = self._begin["monotonic0_ns"] + int(at_s / self._speed * NS)
        await asyncio.sleep(max(due_ns - time.monotonic_ns(), 0) / NS)

    async def _over(self, name: str, fault: AnyFaultPart) -> None:
        """Wait until a fault is over: by its own time, never without one, or because it is ended by hand."""
        over = self._faults.over(name)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(None) as limit:
                if fault.for_s is not None:
                    wait_s = (fault.at_s + fault.for_s - self.t_s()) / self._speed
                    limit.reschedule(asyncio.get_running_loop().time() + max(wait_s, 0.0))
                await over.wait()

    def _strike_soon(self, name: str, fault: AnyFaultPart) -> None:
        self._nemesis.append(asyncio.create_task(self._strike(name, fault)))

    async def _strike(self, name: str, fault: AnyFaultPart) -> None:
        """Play a fault of a process."""
        await self._until(fault.at_s)
        if self._faults.over(name).is_set():
            return
        match fault:
            case CrashPart():
                await self._kill(fault.robot, signal.SIGKILL)
                await self._over(name, fault)
                await self._revive(fault.robot, fault.state == "kept")
            case RestartPart():
                await self._kill(fault.robot, signal.SIGTERM)
                if fault.for_s is not None:
                    await self._over(name, fault)
                await self._revive(fault.robot, True)
            case PausePart():
                self._signal(fault.robot, signal.SIGSTOP)
                try:
                    await self._over(name, fault)
                finally:
                    self._signal(fault.robot, signal.SIGCONT)

    def _signal(self, robot: str, number: int) -> None:
        member = self.members[robot]
        if member.exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                member.process.send_signal(number)

    async def _kill(self, robot: str, number: int) -> None:
        """End an agent, and wait until it is gone."""
        member = self.members[robot]
        if member.gone:
            return
        member.gone = True
        self._signal(robot, number)
        if member.reaper is not None:
            await member.reaper
        if member.done is not None:
            self._past.setdefault(robot, []).append(member.done)

    async def _revive(self, robot: str, keep_state: bool) -> None:
        """Start an agent again with its own file; what it writes besides its state goes to files of the new life."""
        before = self.members[robot]
        if not before.gone or before.exit_code is None:
            return
        if not keep_state:
            shutil.rmtree(self._private / robot, ignore_errors=True)
        life = before.life + 1
        path = self._run_dir / "agents" / f"{robot}.toml"
        tables = tomllib.loads(path.read_text())
        tables["identity"]["incarnation"] = life
        tables["recording"] = str(life_file(self._run_dir, robot, life, "mcap"))
        tables["injection"]["fate_log"] = str(life_file(self._run_dir, robot, life, "fates.csv"))
        path.write_text(tomli_w.dumps(tables))
        await self._spawn(robot, "-m", "deploy.cli", "agent", str(path), life=life)

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

    def _interrupt(self) -> None:
        self._interrupted = True
        self._changed.set()

    def _tell_all(self, message: dict[str, Any]) -> None:
        """Tell those that have started; who starts later is told with the start."""
        for member in self.members.values():
            if member.told:
                self._tell(member, message)

    def _tell(self, member: Member, message: dict[str, Any]) -> None:
        if member.writer is not None and not member.writer.is_closing():
            member.writer.write(json.dumps(message).encode() + b"\n")

    async def _end(self) -> None:
        """Stop what still runs: a word, then SIGTERM, then SIGKILL; by process id."""
        order = [m for m in self.members.values() if m.name != WORLD] + [
            m for m in self.members.values() if m.name == WORLD
        ]
        for member in order:
            self._tell(member, {"stop": True})
        await self._all_gone(STOP_TIMEOUT_S)
        for number in (signal.SIGTERM, signal.SIGKILL):
            for member in order:
                if member.exit_code is None:
                    if number == signal.SIGKILL:
                        self.messages.append(f"{member.name} did not stop when told to and was killed")
                    with contextlib.suppress(ProcessLookupError):
                        member.process.send_signal(number)
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
            lives = [*self._past.get(name, []), *([member.done] if member.done and not member.gone else [])]
            if lives:
                figures[name] = summed(lives)
        world = self.members[WORLD].done or {}
        return Outcome(exits, figures, world, self._t0_ns, self._interrupted, self.messages)


def summed(lives: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of an agent over its lives: counts add up, the largest lag counts."""
    total = dict(lives[0])
    for figures in lives[1:]:
        for key in ("counters", "rejected", "endpoint", "transport", "autopilot"):
            total[key] = dict(Counter(total[key]) + Counter(figures[key]))
        nis = {kind: list(entry) for kind, entry in total["nis"].items()}
        for kind, (value, count) in figures["nis"].items():
            entry = nis.setdefault(kind, [0.0, 0])
            entry[0], entry[1] = entry[0] + value, entry[1] + count
        total["nis"] = nis
        total["lag_max_s"] = max(total["lag_max_s"], figures["lag_max_s"])
        total["lags"] = total["lags"] + figures["lags"]
    return total


def describe_exit(code: int) -> str:
    """What an exit code says, in words."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return f"ended with exit status {code}"


def ended(code: int, log: Path) -> str:
    """How a process ended, with the last thing it said."""
    said = last_line(log)
    return describe_exit(code) + (f" ({said})" if said else "")


def last_line(log: Path) -> str:
    """The last thing a process said."""
    try:
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    return lines[-1].strip() if lines else ""
