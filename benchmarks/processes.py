"""A scenario with one process per robot, for benchmarks: `cofix run`, its summary, and how busy the machine was."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

LOOK_S = 5.0


class RunFailed(RuntimeError):
    """A run that was not played to its end; what it said."""


def summary_of_processes(
    scenario: str, overrides: Sequence[str], seed: int, speed: float, bound: bool
) -> tuple[dict[str, Any], float]:
    """The summary of a run of processes, and the mean over it of the machine's load. Raises `RunFailed`."""
    options = [word for item in overrides for word in ("--set", item)]
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as said:
        command = [
            *(sys.executable, "-P", "-m", "deploy.cli", "run", scenario, "--runtime", "processes"),
            *("--speed", str(speed), "--seed", str(seed), "--out", str(Path(folder) / "run"), "--json", "--no-report"),
            *(["--bound"] if bound else []),
            *options,
        ]
        loads = []
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said) as process:
            while process.poll() is None:
                loads.append(os.getloadavg()[0])
                try:
                    process.wait(LOOK_S)
                except subprocess.TimeoutExpired:
                    continue
        found = Path(folder) / "run" / "summary.json"
        if process.returncode != 0 or not found.exists():
            said.seek(0)
            raise RunFailed(said.read().strip() or f"{scenario}: ended with exit status {process.returncode}")
        summary: dict[str, Any] = json.loads(found.read_text())
    return summary, sum(loads) / len(loads)
