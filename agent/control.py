"""The line between a process of a run and its launcher: JSON lines over a local Unix socket.

    process -> launcher   {"hello": id}, {"ready": id}, {"status": {...}}, {"done": {...}}, {"failed": "why"}
    launcher -> process   {"start": {"t0_ns": ..., "monotonic0_ns": ..., "changes": [...]}}, {"stop": true},
                          {"fault": {table of [[faults]]}}, {"end_fault": {"id": ..., "at_s": ...}}

`changes` are the messages about faults so far, for a process that starts while the run goes on; times of faults count
from the start of the run.

The end of the stream counts as a stop: no process outlives its launcher, not even one that is paused.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import json
import signal
from typing import Any

PR_SET_PDEATHSIG = 1
"""Of prctl(2)."""


class ControlLine:
    """A process's end of the line."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._writer: asyncio.StreamWriter | None = None
        self._task: asyncio.Task[None] | None = None
        self.started: asyncio.Future[dict[str, Any]] | None = None
        self.changes: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        """Messages about faults."""
        self.stopped = asyncio.Event()

    async def connect(self, path: str) -> None:
        """Connect and say hello. Raises OSError when nobody listens."""
        # A paused process goes on when its launcher dies, and finds the end of the stream.
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
        reader, self._writer = await asyncio.open_unix_connection(path)
        self.started = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(self._read(reader))
        self.say({"hello": self._name})

    def say(self, message: dict[str, Any]) -> None:
        """Send one line; silently nothing once the launcher is gone."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(json.dumps(message).encode() + b"\n")

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError, ValueError):
            while line := await reader.readline():
                message = json.loads(line)
                if type(message) is not dict:
                    break
                if "start" in message and self.started is not None and not self.started.done():
                    self.started.set_result(message["start"])
                if "fault" in message or "end_fault" in message:
                    self.changes.put_nowait(message)
                if message.get("stop"):
                    break
        self.stopped.set()
        if self.started is not None and not self.started.done():
            self.started.cancel()

    async def close(self) -> None:
        if self._writer is not None:
            with contextlib.suppress(OSError):
                await self._writer.drain()
                self._writer.close()
                await self._writer.wait_closed()
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
