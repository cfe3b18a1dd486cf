"""A drone and a rover as real processes: altitudes and fixes with altitude go through MAVLink, pixels by the socket."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.events import Fix, Observation, Odometry
from agent.recording import read_agents, read_boundary

pytestmark = pytest.mark.realtime

SCENARIO = """
version = 1
name = "drone"
duration_s = 20.0
step_s = 0.5
window_s = [5.0, 20.0]

[localization]
form = "published"

[[robots]]
id = "q1"
model = "planar_altitude"
start = { pose = [0.0, 0.0, 12.0, 0.5] }
start_sigma = { position_m = 1.0, altitude_m = 1.0, heading_rad = 0.1 }
control = { speed_mps = 0.3, yaw_rate_radps = 0.1, climb_mps = 0.2 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.01, climb_mps = 0.1 }
tilt_rad = 0.1
autopilot = { sends = ["odometry", "global_position", "attitude"] }
[robots.sensors.range]
of = ["peers"]
sigma_m = 0.1
[robots.sensors.position]
sigma_m = 0.3
sigma_z_m = 0.2
[robots.sensors.camera]
kind = "pixel"
of = ["landmarks"]
sigma_px = 3.0
mount = [0.0, 0.0, 0.0, 0.0, 1.5707963, 0.0]

[[robots]]
id = "r1"
start = { pose = [5.0, 1.0, 1.0] }
start_sigma = { position_m = 0.5, heading_rad = 0.05 }
control = { speed_mps = 0.3, yaw_rate_radps = -0.1 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.01 }
[robots.sensors.range]
of = ["peers"]
sigma_m = 0.1

[[landmarks]]
id = "spot"
position = [1.0, 0.5, 0.3]
"""

COMMAND = (sys.executable, "-P", "-m", "deploy.cli", "run", "drone.toml")


def test_a_drone_flies_through_mavlink(tmp_path: Path) -> None:
    (tmp_path / "drone.toml").write_text(SCENARIO)
    run = subprocess.run(
        [*COMMAND, "--runtime", "processes", "--speed", "5", "--seed", "2", "--json", "--out", "run"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary["robots"]["q1"]["position_error_max_m"] < 1.0
    assert summary["robots"]["r1"]["position_error_max_m"] < 2.0
    assert "z_m" in summary["robots"]["q1"]["error_max"]
    recording = tmp_path / "run" / "recording.mcap"
    config, _ = read_agents(recording)["q1"]
    events = [event for event, _ in read_boundary(recording, "q1")]
    fixes = [event for event in events if isinstance(event, Fix)]
    moves = [event for event in events if isinstance(event, Odometry)]
    pixels = [event for event in events if isinstance(event, Observation) and event.kind == "pixel"]
    assert {(fix.kind, len(fix.z)) for fix in fixes} == {("position", 3)}
    assert np.allclose([fix.R[2, 2] for fix in fixes], 0.04)
    climbed = sum(float(event.delta[2]) for event in moves)
    assert abs(climbed - 0.2 * 0.5 * len(moves)) < 0.01, "odometry reports the commanded climb"
    assert 12.0 < float(np.mean([fix.z[2] for fix in fixes])) < 17.0
    assert len(pixels) > 5
    assert all(event.attitude != (0.0, 0.0) for event in pixels)
    assert config.mavlink is not None
    assert config.mavlink.fixes == ["position", "altitude"]
