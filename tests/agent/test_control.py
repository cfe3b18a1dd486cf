"""The line between a process and its launcher, over a real Unix socket."""

from __future__ import annotations

import asyncio
import json
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from agent.control import ControlLine

TIMEOUT_S = 10.0


class Launcher:
    """The other end: keeps what it was told."""

    def __init__(self) -> None:
        self.path = ""
        self.reader: asyncio.StreamReader | None = None
        self.writer: asyncio.StreamWriter | None = None
        self.connected = asyncio.Event()

    async def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.connected.set()

    async def heard(self) -> dict[str, Any]:
        assert self.reader is not None
        message: dict[str, Any] = json.loads(await asyncio.wait_for(self.reader.readline(), TIMEOUT_S))
        return message

    def write(self, data: bytes) -> None:
        assert self.writer is not None
        self.writer.write(data)

    def hang_up(self) -> None:
        assert self.writer is not None
        self.writer.close()


@asynccontextmanager
async def line() -> AsyncIterator[tuple[Launcher, ControlLine]]:
    """A launcher and a process that has just connected to it."""
    launcher = Launcher()
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "run.sock")
        server = await asyncio.start_unix_server(launcher.accept, path)
        control = ControlLine("r1")
        try:
            await control.connect(path)
            await asyncio.wait_for(launcher.connected.wait(), TIMEOUT_S)
            yield launcher, control
        finally:
            await control.close()
            if launcher.writer is not None:
                launcher.writer.close()
            server.close()
            await server.wait_closed()


def test_a_process_says_who_it_is_and_then_what_it_has_to_say() -> None:
    async def scene() -> None:
        async with line() as (launcher, control):
            assert await launcher.heard() == {"hello": "r1"}
            control.say({"ready": "r1"})
            control.say({"status": {"lag_s": 0.5, "text": "two\nlines"}})
            assert await launcher.heard() == {"ready": "r1"}
            assert await launcher.heard() == {"status": {"lag_s": 0.5, "text": "two\nlines"}}

    asyncio.run(scene())


def test_the_start_comes_once_and_the_stop_ends() -> None:
    async def scene() -> None:
        async with line() as (launcher, control):
            assert control.started is not None
            launcher.write(b'{"start": {"t0_ns": 7, "monotonic0_ns": 9}}\n{"start": {"t0_ns": 8}}\n')
            assert await asyncio.wait_for(control.started, TIMEOUT_S) == {"t0_ns": 7, "monotonic0_ns": 9}
            assert not control.stopped.is_set()
            launcher.write(b'{"stop": true}\n')
            await asyncio.wait_for(control.stopped.wait(), TIMEOUT_S)

    asyncio.run(scene())


def test_words_of_a_later_version_are_passed_over() -> None:
    async def scene() -> None:
        async with line() as (launcher, control):
            assert control.started is not None
            launcher.write(b'{"weather": "fine"}\n{"start": {"t0_ns": 1}}\n')
            assert await asyncio.wait_for(control.started, TIMEOUT_S) == {"t0_ns": 1}

    asyncio.run(scene())


@pytest.mark.parametrize("words", [None, b"not json\n", b"3\n", b"[1]\n", b"null\n", b"\xff\n", b"x" * 200_000])
def test_the_end_of_the_line_or_rubbish_on_it_stops_the_process(words: bytes | None) -> None:
    """Nobody waits for a start that can't come any more."""

    async def scene() -> None:
        async with line() as (launcher, control):
            if words is None:
                launcher.hang_up()
            else:
                launcher.write(words)
            await asyncio.wait_for(control.stopped.wait(), TIMEOUT_S)
            assert control.started is not None
            assert control.started.cancelled()

    asyncio.run(scene())


def test_a_process_may_speak_after_its_launcher_is_gone() -> None:
    async def scene() -> None:
        async with line() as (launcher, control):
            launcher.hang_up()
            await asyncio.wait_for(control.stopped.wait(), TIMEOUT_S)
            for _ in range(3):
                control.say({"status": {}})
                await asyncio.sleep(0)

    asyncio.run(scene())


def test_before_it_is_connected_a_line_swallows_what_is_said() -> None:
    async def scene() -> None:
        control = ControlLine("r1")
        control.say({"ready": "r1"})
        await control.close()

    asyncio.run(scene())


def test_nobody_listening_is_an_error_of_the_system(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        asyncio.run(ControlLine("r1").connect(str(tmp_path / "gone.sock")))
