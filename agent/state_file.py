"""What a robot keeps across starts: so far its incarnation, which names its lives in ascending order."""

from __future__ import annotations

import json
import os
from pathlib import Path

FILE = "state.json"


def next_incarnation(state_dir: Path, now_ns: int) -> int:
    """The number of the life that begins now, written to disk before it is used.

    One more than the last one. Without a readable file (first start, or a disk that was lost) the number comes
    from the clock in seconds, which is later than any number counted up from an earlier start.
    """
    path = state_dir / FILE
    try:
        number = int(json.loads(path.read_text())["incarnation"]) + 1
    except (OSError, ValueError, KeyError, TypeError):
        number = max(1, now_ns // 1_000_000_000)
    temporary = path.with_suffix(".tmp")
    with temporary.open("w") as file:
        json.dump({"incarnation": number}, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    return number
