"""The file a robot keeps across starts: written whole or not at all, and refused with the reason if it is not whole."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

from agent.effects import Estimate
from agent.saved_state import MAX_BYTES, MAX_INCARNATION, StateError, decode, encode

log = logging.getLogger("cofix.agent")

FILE = "state.bin"
REFUSED = "state.refused"
MODE = 0o600


@dataclass(frozen=True, slots=True)
class Found:
    """What a start finds: the number of the life that begins, the last estimate, and why a file was refused."""

    incarnation: int
    estimate: Estimate | None = None
    refused: str | None = None


class StateFile:
    """The state file of one robot in its folder. `sync`: on the disk itself, so that it outlasts a power cut."""

    def __init__(self, state_dir: Path, robot: str, sync: bool = True) -> None:
        self._path, self._robot, self._sync = state_dir / FILE, robot, sync
        self._incarnation = 0

    def begin(self, now_ns: int, first: int | None = None) -> Found:
        """Begin a life, and write down that it has begun. Raises OSError if that cannot be written.

        Its number is one more than the last one. Without a usable file (first start, or a disk that was lost) it is
        `first`, or comes from the clock in seconds, which is later than any number counted up from an earlier start.
        A file that cannot be used is kept aside as `state.refused`.
        """
        estimate, refused, last = None, None, 0
        try:
            payload = self._read()
            if payload is not None:
                last, estimate = decode(payload, self._robot)
        except StateError as error:
            refused = error.reason
            self._path.replace(self._path.with_name(REFUSED))
        number = last + 1 if last else first or min(max(1, now_ns // 1_000_000_000), MAX_INCARNATION - 1)
        self._incarnation = number
        self.write(estimate)
        return Found(number, estimate, refused)

    def _read(self) -> bytes | None:
        try:
            with self._path.open("rb") as file:
                return file.read(MAX_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError:
            raise StateError("unreadable") from None

    def write(self, estimate: Estimate | None) -> None:
        """Replace the file. Raises OSError; the old one is there still then."""
        payload = encode(self._robot, self._incarnation, estimate)
        temporary = self._path.with_suffix(".tmp")
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, MODE)
        try:
            written = 0
            while written < len(payload):
                written += os.write(handle, payload[written:])
            if self._sync:
                os.fdatasync(handle)
        finally:
            os.close(handle)
        temporary.replace(self._path)
        if self._sync:
            folder = os.open(self._path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
