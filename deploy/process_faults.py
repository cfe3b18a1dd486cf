"""Faults of a run's processes: agents that are killed, restarted and paused, at their instants."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
import time
import tomllib
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import tomli_w

from agent.fault_parts import AnyFaultPart, CrashPart, PausePart, RestartPart
from agent.settings import NS
from deploy.agent_files import life_file
from deploy.live_faults import LiveFaults
from deploy.member import Member


class ProcessFaults:
    """Plays them on the `members` of a run, by their process ids.

    faults    knows what is ended by hand
    start     starts an agent in a new life, with its file
    run_dir   of the agents' files; speed: of fleet time

    `private`, the folder of the agents' state directories, is set before the run begins.
    """

    def __init__(
        self,
        members: dict[str, Member],
        faults: LiveFaults,
        start: Callable[[str, Path, int], Awaitable[None]],
        run_dir: Path,
        speed: float,
    ) -> None:
        self._members, self._faults, self._start, self._run_dir, self._speed = members, faults, start, run_dir, speed
        self._monotonic0_ns = 0
        self.private = Path()
        self.past: dict[str, list[dict[str, Any]]] = {}
        """Figures of the lives that a fault has ended in good order."""
        self._tasks: list[asyncio.Task[None]] = []

    def begin(self, monotonic0_ns: int) -> None:
        """The run starts at an instant of this computer's monotonic clock: play the faults of the schedule."""
        self._monotonic0_ns = monotonic0_ns
        for name, fault in self._faults.faults.items():
            if fault.level == "process":
                self.strike_soon(name, fault)

    def strike_soon(self, name: str, fault: AnyFaultPart) -> None:
        """Play a fault at its instant."""
        self._tasks.append(asyncio.create_task(self._strike(name, fault)))

    async def close(self) -> None:
        """Play no more; who is paused goes on."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _until(self, at_s: float) -> None:
        """Wait for an instant of the run, in seconds of fleet time since its start."""
        due_ns = self._monotonic0_ns + int(at_s / self._speed * NS)
        await asyncio.sleep(max(due_ns - time.monotonic_ns(), 0) / NS)

    async def _over(self, name: str, fault: AnyFaultPart) -> None:
        """Wait until a fault is over: by its own time, never without one, or because it is ended by hand."""
        over = self._faults.over(name)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(None) as limit:
                if fault.for_s is not None:
                    due_ns = self._monotonic0_ns + int((fault.at_s + fault.for_s) / self._speed * NS)
                    wait_s = max(due_ns - time.monotonic_ns(), 0) / NS
                    limit.reschedule(asyncio.get_running_loop().time() + wait_s)
                await over.wait()

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
                self._members[fault.robot].signal(signal.SIGSTOP)
                try:
                    await self._over(name, fault)
                finally:
                    self._members[fault.robot].signal(signal.SIGCONT)

    async def _kill(self, robot: str, number: int) -> None:
        """End an agent, and wait until it is gone."""
        member = self._members[robot]
        if member.gone:
            return
        member.gone = True
        member.signal(number)
        if member.reaper is not None:
            await member.reaper
        if member.done is not None:
            self.past.setdefault(robot, []).append(member.done)

    async def _revive(self, robot: str, keep_state: bool) -> None:
        """Start an agent again with its own file; what it writes besides its state goes to files of the new life."""
        before = self._members[robot]
        if not before.gone or before.exit_code is None:
            return
        if not keep_state:
            shutil.rmtree(self.private / robot, ignore_errors=True)
        life = before.life + 1
        path = self._run_dir / "agents" / f"{robot}.toml"
        tables = tomllib.loads(path.read_text())
        tables["identity"]["incarnation"] = life
        tables["recording"] = str(life_file(self._run_dir, robot, life, "mcap"))
        tables["injection"]["fate_log"] = str(life_file(self._run_dir, robot, life, "fates.csv"))
        path.write_text(tomli_w.dumps(tables))
        await self._start(robot, path, life)
