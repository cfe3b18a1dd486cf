"""A fleet of real processes for tests: the launcher of `cofix run`, in a thread beside the test.

The launcher ends all its processes when it is told to, when the run is over, and when it fails. If it is killed with
the whole test, each process finds the line to it closed and ends by itself.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError
from agent.fault_parts import AnyFaultPart, CrashPart, RestartPart
from deploy.evaluate import trace_of
from deploy.exit_words import ended
from deploy.fault import ask, socket_of
from deploy.fleet import Array, Fleet, until
from deploy.launch import TOLD_S, Launcher, LaunchError
from deploy.member import Member
from deploy.runs import write_scenario
from sim.agents import table
from sim.closed_loop import MOTION
from sim.metrics import StateTrace
from sim.scenario import Scenario
from sim.trial import open_world, played_world

PAUSE_S = 0.05
SETTLE_S = 0.3
"""Wall time within which an agent has used what belongs to an instant."""
STARTED_S = 30.0
"""Wall time after which a process that does not end or start is no longer waited for."""
HEARD_S = 3.0
"""Wall time after which a robot that says nothing is no longer waited for."""


class ProcessFleet(Fleet):
    """In real processes, `speed` times as fast as real time. Time goes on by itself, also between two calls.

    Injecting or ending a fault takes a moment: when the call returns, all processes act on it, who is killed is gone,
    and who is restarted is at work again. Status and traces are those of the time of the call, and waited for.
    """

    def __init__(self, scenario: Scenario, seed: int, speed: float, run_dir: Path) -> None:
        super().__init__(scenario, seed)
        self._speed, self.run_dir = speed, run_dir
        run_dir.mkdir(parents=True)
        write_scenario(scenario, run_dir)
        self._world = open_world(scenario, seed)
        self._launcher = Launcher(scenario, self._world, seed, speed, run_dir)
        self._faults: dict[str, AnyFaultPart] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._begun = threading.Event()
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="cofix-run")
        self._played_s: float | None = None

    # -- the run --------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start all processes; returns at the start of the run. Raises `LaunchError`."""
        self._thread.start()
        self._begun.wait()
        self._check()
        while self._launcher.t_s() <= 0.0:
            time.sleep(PAUSE_S)

    def close(self) -> None:
        """End the run; no process is left when this returns."""
        if self._thread.is_alive() and self._loop is not None:
            self._loop.call_soon_threadsafe(self._launcher.interrupt)
        self._thread.join()

    def _work(self) -> None:
        try:
            asyncio.run(self._run())
        except BaseException as error:
            self._failed = error
        finally:
            self._played_s = self.t_s
            self._begun.set()

    async def _run(self) -> None:
        self._loop = asyncio.get_running_loop()
        await self._launcher.run(lambda _: self._begun.set())

    def _check(self) -> None:
        """Raises `LaunchError` if the run has failed, or an agent has ended that nobody has killed."""
        if self._failed is not None:
            raise LaunchError(str(self._failed)) from self._failed
        for robot in self.robots:
            member = self._launcher.members[robot]
            if member.exit_code is not None and not member.gone and self._thread.is_alive() and self._on():
                raise LaunchError(f"{robot} {ended(member.exit_code, member.log)}; its log is {member.log}")

    def _on(self) -> bool:
        """Whether the run goes on, and is not about to end."""
        return self._thread.is_alive() and self._launcher.t_s() < self.scenario.duration_s

    def _member(self, robot: str) -> Member | None:
        """The process of a robot that is up."""
        member = self._launcher.members[robot]
        return None if member.gone or member.exit_code is not None else member

    # -- what a runtime does --------------------------------------------------------------------------------

    @property
    def t_s(self) -> float:
        now_s = self._launcher.t_s() if self._played_s is None else self._played_s
        return min(now_s, self.scenario.duration_s)

    def run_until(self, t_s: float) -> None:
        """Wait until then. Raises `LaunchError` if the run fails, or an agent ends that nobody has killed."""
        end_s = min(t_s, self.scenario.duration_s)
        while self.t_s < end_s and self._thread.is_alive():
            self._check()
            time.sleep(min(PAUSE_S, (end_s - self.t_s) / self._speed + 1e-4))
        if end_s >= self.scenario.duration_s:
            # The processes settle and end in good order.
            self._thread.join()
        self._check()

    def _heard(self, robots: tuple[str, ...]) -> None:
        """Wait until those of the robots that are up have told what they know of this instant."""
        now = time.monotonic()

        def told() -> bool:
            up = [member for robot in robots if (member := self._member(robot)) is not None and member.status]
            return all(member.heard_s > now + SETTLE_S for member in up)

        self._wait(told, HEARD_S)

    def traces(self) -> tuple[Array, dict[str, StateTrace]]:
        t_s = self.t_s
        self._heard(self.robots)
        self._check()
        played = self._launcher.played()
        world = played_world(self.scenario, self.seed, self.run_dir / MOTION)
        return until(trace_of(played, world, self.run_dir, self._launcher.t0_ns, self.seed), t_s)

    def status(self, robot: str) -> dict[str, Any]:
        self._heard((robot,))
        member = self._member(robot)
        if member is None or "t_ns" not in member.status:
            return {}
        status, t0_ns = member.status, self._launcher.t0_ns
        pairs = {peer: t_ns - t0_ns for peer, t_ns in status["pairs"].items()}
        return {**status, "t_ns": status["t_ns"] - t0_ns, "pairs": pairs}

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        self._check()
        answer = ask(socket_of(self.run_dir), request)
        if "error" not in answer:
            time.sleep(TOLD_S + PAUSE_S)
        return answer

    def _told_since(self, robot: str, before: Member) -> bool:
        """Whether a life after `before` is at work."""
        member = self._launcher.members[robot]
        return member is not before and "t_ns" in member.status

    def _inject(self, name: str, fault: AnyFaultPart) -> None:
        before = {robot: self._launcher.members[robot] for robot in self.robots}
        # From the earliest instant on by which all processes know of it.
        keys = {key: value for key, value in table(fault).items() if key != "at_s"}
        answer = self._ask({"inject": {**keys, "id": name}})
        if "error" in answer:
            raise ConfigError(answer["error"])
        self._faults[name] = fault
        match fault:
            case CrashPart(for_s=None):
                self._wait(lambda: self._member(fault.robot) is None, STARTED_S)
            case RestartPart(for_s=None):
                self._wait(lambda: self._told_since(fault.robot, before[fault.robot]), STARTED_S)

    def _wait(self, until: Callable[[], bool], seconds: float) -> None:
        """Wait until something is so, for so much wall time at most, while the run goes on."""
        end = time.monotonic() + seconds
        while not until() and time.monotonic() < end and self._thread.is_alive():
            time.sleep(PAUSE_S)

    def end(self, name: str) -> bool:
        fault = self._faults.get(name)
        if fault is None or fault.level in ("process", "clock"):
            return False
        return "error" not in self._ask({"end": name})
