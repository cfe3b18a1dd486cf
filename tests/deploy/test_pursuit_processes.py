"""A pursuit in the loop with one process per multirotor: bearings over Zenoh, commands and odometry over MAVLink."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.realtime

SECONDS = 16.0
SPEED = 0.5
"""A round of 50 ms then has 100 ms of the computer's time, which others use as well."""

COMMAND = (sys.executable, "-P", "-m", "deploy.cli", "run", "stt-pursuit", "--runtime", "processes")


def test_pursuers_form_and_keep_their_formation(tmp_path: Path) -> None:
    """They begin 9 to 14 m apart, 15 m from the target, and have formed after 10 s."""
    window = f"window_s=[10.0, {SECONDS}]"
    times = ["--duration", f"{SECONDS:g}", "--speed", f"{SPEED:g}", "--set", window]
    run = subprocess.run(
        [*COMMAND, *times, "--seed", "3", "--json", "--no-report", "--out", "run"],
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    motion, fleet = summary["motion"], summary["fleet"]
    print(motion, fleet, summary["timing"])
    assert set(summary["exit"].values()) == {0}
    assert motion["collisions"] == 0 and motion["min_distance_m"] > 2.0
    assert motion["formation_kept_share"] > 0.9 and motion["formation_error"] < 0.15
    assert fleet["target_position_rmse_m"] < 0.8
    assert fleet["target_anees"] < 1.7
