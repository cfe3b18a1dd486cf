"""Finished trials of a Monte Carlo run, kept as they come in `trials.bin`; floats survive bit for bit.

The file is a row of records, each written at once and checked by a CRC-32, so that an interrupted run loses at most the
record it was writing. A record is a head of four little-endian uint32 (mark, length of the map, length of the arrays,
checksum of both), a msgpack map, and the map's arrays as little-endian float64, both padded to eight bytes. Records are
read through a memory map: the memory of a run does not grow with its trials.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import msgpack
import numpy as np

FILE = "trials.bin"

_HEAD = struct.Struct("<4I")
_MARK = 0x54584643
_PLACE = struct.Struct("<2I")
_ARRAY = 1
_ALIGN = 8


class StoreBusy(Exception):
    """Another process is writing to the file."""


def pack(seed: int, reduced: dict[str, Any]) -> bytes:
    """The record of one reduced trial; arrays must be one-dimensional float64."""
    arrays = bytearray()

    def place(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            data = np.ascontiguousarray(value, dtype="<f8").tobytes()
            arrays.extend(data)
            return msgpack.ExtType(_ARRAY, _PLACE.pack(len(arrays) - len(data), value.size))
        if isinstance(value, np.integer):
            return int(value)
        raise TypeError(f"a trial cannot keep a {type(value).__name__}")

    text: bytes = msgpack.packb({"seed": seed, "reduced": reduced}, default=place)
    text += b"\xc1" * (-len(text) % _ALIGN)
    body = text + bytes(arrays)
    return _HEAD.pack(_MARK, len(text), len(arrays), zlib.crc32(body)) + body


def records(data: bytes | mmap.mmap) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """(end of the record, seed, reduced trial), up to the first record that is cut or damaged.

    The arrays are views of `data`.
    """
    start, view = 0, memoryview(data)
    while start + _HEAD.size <= len(view):
        mark, texts, arrays, checksum = _HEAD.unpack_from(view, start)
        body = start + _HEAD.size
        end = body + texts + arrays
        if mark != _MARK or end > len(view) or zlib.crc32(view[body:end]) != checksum:
            return
        first = body + texts

        def array(code: int, text: bytes, first: int = first) -> Any:
            offset, size = _PLACE.unpack(text)
            return np.frombuffer(view, dtype="<f8", count=size, offset=first + offset)

        unpacker = msgpack.Unpacker(ext_hook=array, max_buffer_size=texts)
        unpacker.feed(view[body:first])
        record = unpacker.unpack()
        yield end, record["seed"], record["reduced"]
        start = end


class TrialStore:
    """The file open for appending, by one process at a time. Raises `StoreBusy`; `OSError` if it can't be opened."""

    def __init__(self, run_dir: Path) -> None:
        self._path = run_dir / FILE
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._file)
            raise StoreBusy(str(run_dir)) from None
        whole = 0
        for end, _, _ in records(self._map()):
            whole = end
        os.ftruncate(self._file, whole)

    def append(self, seed: int, reduced: dict[str, Any]) -> None:
        """Keep one trial."""
        rest = memoryview(pack(seed, reduced))
        while rest:
            rest = rest[os.write(self._file, rest) :]

    def trials(self) -> dict[int, dict[str, Any]]:
        """What is kept, by seed, in the order of the seeds."""
        found = {seed: reduced for _, seed, reduced in records(self._map())}
        return dict(sorted(found.items()))

    def _map(self) -> bytes | mmap.mmap:
        size = os.fstat(self._file).st_size
        return mmap.mmap(self._file, size, access=mmap.ACCESS_READ) if size else b""

    def close(self) -> None:
        os.close(self._file)

    def __enter__(self) -> TrialStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
