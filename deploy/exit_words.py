"""How a process ended, in words."""

from __future__ import annotations

import signal
from pathlib import Path


def describe_exit(code: int) -> str:
    """What an exit code says, in words."""
    if code < 0:
        try:
            return f"was ended by {signal.Signals(-code).name}"
        except ValueError:
            return f"was ended by signal {-code}"
    return f"ended with exit status {code}"


def ended(code: int, log: Path) -> str:
    """How a process ended, with the last thing it said."""
    said = last_line(log)
    return describe_exit(code) + (f" ({said})" if said else "")


def last_line(log: Path) -> str:
    """The last thing a process said."""
    try:
        lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    except OSError:
        return ""
    return lines[-1].strip() if lines else ""
