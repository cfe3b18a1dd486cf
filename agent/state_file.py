"""What a robot keeps across starts: so far its incarnation, which names its lives in ascending order."""

from __future__ import annotations

import json
import os
from pathlib import Path

FILE = "state.json"
MAX_INCARNATION = 2**53


def next_incarnation(state_dir: Path, now_ns: int) -> int:
    """The number of the life that begins now, written to disk before it is used.

    One more than the last one. Without a readable file (first start, or a disk that was lost) the number comes
    from the clock in seconds, which is later than any number counted up from an earlier start.
    """
    path = state_dir / FILE
    last = _last(path)
    number = last + 1 if last is not None else max(1, now_ns // 1_000_000_000)
    temporary = path.with_suffix(".tmp")
    with temporary.open("w") as file:
        json.dump({"incarnation": number}, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(state_dir, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return number


def _last(path: Path) -> int | None:
    """The number on disk; None when there is none that makes sense."""
    try:
        number = json.loads(path.read_text())["incarnation"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return number if type(number) is int and 1 <= number < MAX_INCARNATION else None
