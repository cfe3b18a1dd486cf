"""Robots that choose their motion, in real processes: only the world knows where they went, and it says so."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim.scenario_file import load
from sim.store import load_trace
from sim.trial import open_world, played_world

pytestmark = pytest.mark.realtime

SCENARIO = """
version = 1
name = "driving"
duration_s = 30.0
step_s = 0.5
window_s = [5.0, 30.0]

[planning]
kind = "random"

[links]
range_m = 20.0

[[robots]]
id = "r1"
start = { pose = [0.0, 0.0, 0.0] }
start_sigma = { position_m = 0.1, heading_rad = 0.02 }
noise = { speed_share = 0.05, yaw_rate_per_mps = 0.05 }
sensors = { range = { of = ["peers"], sigma_m = 0.1 } }
vehicle = { min_speed_mps = 0.3, max_speed_mps = 0.3 }

[[robots]]
id = "r2"
start = { pose = [5.0, 1.0, 1.5] }
start_sigma = { position_m = 0.1, heading_rad = 0.02 }
noise = { speed_share = 0.05, yaw_rate_per_mps = 0.05 }
sensors = { range = { of = ["peers"], sigma_m = 0.1 } }
vehicle = { min_speed_mps = 0.3, max_speed_mps = 0.3 }
"""


def test_truth_is_what_the_world_has_played(tmp_path: Path) -> None:
    """These vehicles have one speed, whatever they are told."""
    path, out = tmp_path / "driving.toml", tmp_path / "out"
    path.write_text(SCENARIO)
    command = [sys.executable, "-P", "-m", "deploy.cli", "run", str(path), "--runtime", "processes", "--speed", "4"]
    run = subprocess.run(
        [*command, "--seed", "5", "--json", "--no-report", "--bound", "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary["motion"]["speed_mps"] == pytest.approx(0.3, rel=0.05)
    assert summary["motion"]["collisions"] is not None
    assert summary["bound"]["position_rmse_m"] < 1.0
    scenario = load(str(out / "scenario.toml"))
    world = played_world(scenario, 5, out / "motion.bin")
    stored = load_trace(out)
    assert stored is not None
    for robot, trace in stored.trace.robots.items():
        # Places are kept once per second.
        np.testing.assert_array_equal(trace.truth, [world.truth(robot, 2 * k) for k in range(31)])
        assert np.linalg.norm(trace.truth[-1, :2] - trace.truth[0, :2]) > 0.3, "it has moved"
        assert summary["robots"][robot]["position_rmse_m"] < 1.0
        assert summary["robots"][robot]["known_share"] > 0.9
    # Nobody can tell without the world: its robots have not moved yet.
    assert np.isnan(open_world(scenario, 5).truth("r1", 60)).all()
