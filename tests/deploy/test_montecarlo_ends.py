"""However a Monte Carlo run is ended, its workers end with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

COFIX = (sys.executable, "-P", "-m", "deploy.cli")


def members(session: int) -> list[int]:
    """Live processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] not in "ZX":
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_worker_outlives_the_run(tmp_path: Path, number: signal.Signals) -> None:
    run = subprocess.Popen(
        [*COFIX, "montecarlo", "ut-clat", "--trials", "500", "--jobs", "2", "--out", str(tmp_path / "out")],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        # Whoever starts the tests may ignore interrupts; a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 30.0
        while len(members(run.pid)) < 4 and time.monotonic() < deadline:
            time.sleep(0.1)
        assert len(members(run.pid)) >= 4, "the workers did not start"
        time.sleep(1.0)
        if number is signal.SIGINT:
            os.killpg(run.pid, number)
        else:
            run.kill()
        assert run.wait(timeout=30) == (1 if number is signal.SIGINT else -number)
        while members(run.pid) and time.monotonic() < deadline + 30.0:
            time.sleep(0.1)
        assert members(run.pid) == []
    finally:
        for pid in members(run.pid):
            os.kill(pid, signal.SIGKILL)
        run.wait()
    assert not (tmp_path / "out" / "summary.json").exists()
