"""The file a robot keeps across starts: written whole or not at all, and refused with the reason if it cannot be used.

It holds the robot's incarnation, which names its lives in ascending order, and the newest state of its core. A usable
state is begun with under the same incarnation; peers know by that that nothing they rely on is lost. Without one a new
life begins, and its number is on disk before it is used, if the disk takes it. If not, the next life may have the same
number again: it knows of no correlation, peers find that out at the first contact, and begin the pair anew.
"""

from __future__ import annotations

import fcntl
import os
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgpack

from agent.saved_state import MAX_BYTES
from agent.state_fields import StateError
from network.wire_fields import valid_id

FILE = "state.bin"
REFUSED = "state.bad"
MODE = 0o600
MAGIC = b"cofix state "
VERSION = b"1\n"
LENGTH_BYTES = 4
DIGEST_BYTES = 16
MAX_INCARNATION = 2**53

_LENGTH = len(MAGIC) + len(VERSION)
_DIGEST = _LENGTH + LENGTH_BYTES
_HEAD = _DIGEST + DIGEST_BYTES


@dataclass(frozen=True, slots=True)
class Found:
    """What a start finds: the number of the last life, its state if there is one, and why a file is refused."""

    incarnation: int | None = None
    state: bytes | None = None
    refused: str | None = None


def pack(robot: str, incarnation: int, state: bytes | None) -> bytes:
    """The bytes of a file: what it is, the length and checksum of its body, and the body."""
    body: bytes = msgpack.packb([robot, incarnation, state])
    length = len(body).to_bytes(LENGTH_BYTES, "little")
    return MAGIC + VERSION + length + blake2b(body, digest_size=DIGEST_BYTES).digest() + body


def unpack(payload: bytes, robot: str) -> tuple[int, bytes | None]:
    """(incarnation, state) of a file of `robot`. Raises `StateError`."""
    if len(payload) < _HEAD:
        raise StateError("torn")
    if len(payload) > MAX_BYTES + _HEAD:
        raise StateError("oversize")
    if not payload.startswith(MAGIC):
        raise StateError("corrupt")
    if not payload.startswith(MAGIC + VERSION):
        raise StateError("other_version")
    body = payload[_HEAD:]
    if len(body) < int.from_bytes(payload[_LENGTH:_DIGEST], "little"):
        raise StateError("torn")
    if blake2b(body, digest_size=DIGEST_BYTES).digest() != payload[_DIGEST:_HEAD]:
        raise StateError("corrupt")
    if len(body) != int.from_bytes(payload[_LENGTH:_DIGEST], "little"):
        raise StateError("corrupt")
    try:
        raw: Any = msgpack.unpackb(body, use_list=False, max_map_len=0, max_ext_len=0)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
        raise StateError("malformed") from None
    if type(raw) is not tuple or len(raw) != 3:
        raise StateError("malformed")
    name, incarnation, state = raw
    if type(name) is not str or not valid_id(name) or type(incarnation) is not int:
        raise StateError("malformed")
    if not 1 <= incarnation < MAX_INCARNATION or type(state) not in (bytes, type(None)):
        raise StateError("malformed")
    if name != robot:
        raise StateError("other_robot")
    return incarnation, state


class StateFile:
    """The state file of one robot in its folder. `sync`: on the disk itself, so that it outlasts a power cut."""

    def __init__(self, state_dir: Path, robot: str, sync: bool = True) -> None:
        self._path, self._robot, self._sync = state_dir / FILE, robot, sync
        self._refused = state_dir / REFUSED
        self._claim: int | None = None

    def read(self) -> Found:
        """What the last life has left. A file that cannot be used is kept aside as `state.bad`, one of them."""
        payload, reason = None, None
        try:
            payload = self._bytes(self._path)
        except OSError:
            reason = "unreadable"
        if payload is not None:
            try:
                return Found(*unpack(payload, self._robot))
            except StateError as error:
                reason = error.reason
        if reason is not None:
            self.refuse()
        # What was put aside still tells how many lives there have been.
        try:
            aside = self._bytes(self._refused)
            return Found(None if aside is None else unpack(aside, self._robot)[0], None, reason)
        except (OSError, StateError):
            return Found(None, None, reason)

    def claim(self) -> bool:
        """Take the folder for this process as long as it lives; False if another one has it. Needs no space.

        Raises OSError.
        """
        handle = os.open(self._path.parent, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
            return False
        self._claim = handle
        return True

    def release(self) -> None:
        """Give the folder back."""
        handle, self._claim = self._claim, None
        if handle is not None:
            os.close(handle)

    def _bytes(self, path: Path) -> bytes | None:
        try:
            with path.open("rb") as file:
                return file.read(MAX_BYTES + _HEAD + 1)
        except FileNotFoundError:
            return None

    def refuse(self) -> bool:
        """Put the file aside, so that no start begins with it; needs no space. False if it is still there."""
        try:
            self._path.replace(self._refused)
            self._sync_folder()
        except FileNotFoundError:
            return True
        except OSError:
            return False
        return True

    def write(self, incarnation: int, state: bytes | None) -> None:
        """Replace the file. Raises OSError; the old one is there still then."""
        payload = pack(self._robot, incarnation, state)
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
        self._sync_folder()

    def _sync_folder(self) -> None:
        if not self._sync:
            return
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def next_incarnation(last: int | None, now_ns: int) -> int:
    """The number of a new life: one more than the last one.

    Where that is lost (first start, or a lost disk) it comes from the clock in seconds, which is later than any number
    counted up from an earlier start.
    """
    return last + 1 if last is not None else min(max(1, now_ns // 1_000_000_000), MAX_INCARNATION - 1)
