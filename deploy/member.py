"""One process of a run: its start, its signals, and what is known of it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


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

    def signal(self, number: int) -> None:
        """Send a signal, if it still runs."""
        if self.exit_code is None:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(number)

    def tell(self, message: dict[str, Any]) -> None:
        """Send one line; silently nothing once its end of the line is closed."""
        if self.writer is not None and not self.writer.is_closing():
            self.writer.write(json.dumps(message).encode() + b"\n")

    async def reap(self, changed: Callable[[], None]) -> None:
        self.exit_code = await self.process.wait()
        changed()


async def spawn(
    name: str,
    log: Path,
    arguments: tuple[str, ...],
    life: int,
    changed: Callable[[], None],
    namespace: str | None = None,
) -> Member:
    """Start a process of our own interpreter, in a network `namespace`; `changed` is called when it has ended."""
    entered = () if namespace is None else ("nsenter", f"--net=/run/netns/{namespace}")
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    with log.open("ab" if life > 1 else "wb") as output:
        process = await asyncio.create_subprocess_exec(
            *entered,
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
    member.reaper = asyncio.create_task(member.reap(changed))
    return member
