"""Commands of `cofix` that a comparison is made of."""

from __future__ import annotations

import sys
from pathlib import Path

from deploy.cli import main as cofix


def run(arguments: list[str], out: Path) -> None:
    """One command whose results are in `out`, going on where it was. Raises `RuntimeError` if it fails.

    What it prints goes to standard error.
    """
    arguments = [*arguments, "--out", str(out)]
    if out.exists():
        arguments.append("--resume")
    stdout, sys.stdout = sys.stdout, sys.stderr
    try:
        status = cofix(arguments)
    finally:
        sys.stdout = stdout
    if status != 0:
        raise RuntimeError(f"cofix {' '.join(arguments)} ended with status {status}")
