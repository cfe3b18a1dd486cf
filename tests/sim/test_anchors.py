"""UWB anchors, a camera on a lever arm, and a target that moves by a velocity model, in whole trials."""

from __future__ import annotations

from pathlib import Path

import pytest

from sim.montecarlo import run_trials
from sim.scenario_file import load
from sim.summary import summarize
from tests.sizes import sized

SCENARIO = """
version = 1
name = "anchors"
duration_s = 90.0
step_s = 0.5
window_s = [20.0, 90.0]

[links]
range_m = 30.0

[[robots]]
id = "a1"
start = { pose = [2.0, 2.0, 0.0] }
start_sigma = { position_m = 0.5, heading_rad = 0.1 }
control = { speed_mps = 0.5, yaw_rate_radps = 0.08 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.02 }
[robots.sensors.uwb]
kind = "range"
of = ["peers", "landmarks"]
sigma_m = 0.1
max_range_m = 12.0
mount = [0.2, 0.1, 0.0]
[robots.sensors.camera]
kind = "bearing"
of = ["targets"]
sigma_rad = 0.02
mount = [0.3, 0.0, 0.2]

[[robots]]
id = "a2"
start = { pose = [8.0, 12.0, 1.0] }
start_sigma = { position_m = 0.5, heading_rad = 0.1 }
control = { speed_mps = 0.5, yaw_rate_radps = -0.08 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.02 }
[robots.sensors.uwb]
kind = "range"
of = ["peers", "landmarks"]
sigma_m = 0.1
max_range_m = 12.0
[robots.sensors.camera]
kind = "range_bearing"
of = ["targets"]
sigma_m = 0.5
sigma_rad = 0.02
rate_hz = 1.0

[[targets]]
id = "ball"
model = "damped_velocity"
damping_s = 5.0
start = { pose = [10.0, 5.0, 0.3, 0.1] }
start_sigma = { position_m = 1.0, velocity_mps = 0.5 }
noise = { acceleration_mps2 = 0.1 }

[[landmarks]]
id = "A1"
position = [0.0, 0.0]
[[landmarks]]
id = "A2"
position = [15.0, 0.0]
[[landmarks]]
id = "A3"
position = [0.0, 15.0]
"""

TRIALS, SEED = sized(4, 12), 30


@pytest.mark.parametrize(("model", "acceleration"), [("damped_velocity", "0.1"), ("constant_velocity", "0.01")])
def test_anchored_robots_and_a_moving_target_are_honest(tmp_path: Path, model: str, acceleration: str) -> None:
    path = tmp_path / "anchors.toml"
    text = SCENARIO.replace('"damped_velocity"', f'"{model}"')
    path.write_text(text.replace("acceleration_mps2 = 0.1", f"acceleration_mps2 = {acceleration}"))
    scenario = load(str(path))
    reduced = run_trials(scenario, TRIALS, 1, SEED, True)
    summary = summarize(scenario, "virtual", SEED, reduced, simulated_s=scenario.duration_s, timing={})
    note = f"seeds {SEED}-{SEED + TRIALS - 1}, {model}"
    assert summary["lost"] == 0, note
    for robot, figures in summary["robots"].items():
        assert figures["position_rmse_m"] < 0.25, f"{robot}: {note}"
        assert 0.6 < figures["anees"] < 1.35, f"{robot}: {note}"
        assert figures["nis"]["landmark_range"] == pytest.approx(1.0, abs=0.25), f"{robot}: {note}"
    for robot, figures in summary["targets"]["ball"].items():
        assert figures["velocity_rmse_mps"] < 0.5, f"{robot}: {note}"
        assert figures["anees"] < 1.3, f"{robot}: {note}"
    assert summary["bound"]["position_rmse_m"] <= 1.05 * summary["fleet"]["position_rmse_m"], note
