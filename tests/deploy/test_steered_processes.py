"""Robots that choose their motion, as real processes: their vehicles obey over MAVLink, and stop without them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from agent.events import ControlReport, Received
from agent.recording import read_boundary, replay
from agent.settings import NS
from network.messages import RoundReport
from sim.closed_loop import MOTION
from sim.metrics import nees
from sim.scenario_file import load
from sim.store import load_trace
from sim.trial import played_world

pytestmark = pytest.mark.realtime

ROBOT = """
[[robots]]
id = "{id}"
start = {{ pose = [{x}, {y}, 0.0] }}
start_sigma = {{ position_m = 0.1, heading_rad = 0.01 }}
noise = {{ speed_share = 0.007, yaw_rate_per_mps = 0.03 }}
autopilot = {{ flavour = "{flavour}" }}
[robots.sensors.camera]
kind = "range_bearing"
of = ["peers", "targets"]
sigma_m = 0.1
sigma_rad = 0.02
"""

SCENARIO = """
version = 1
name = "steered"
duration_s = 30.0
step_s = 0.5
window_s = [5.0, 30.0]

[localization]
kind = "jlatt"

[planning]
kind = "potential"

[[targets]]
id = "t1"
model = "unicycle"
start = { pose = [10.0, 5.0, 0.0] }
start_sigma = { position_m = 2.0, heading_rad = 1.0 }
control = { speed_mps = 0.3 }
noise = { speed_mps = 0.01, yaw_rate_radps = 0.02 }

[[faults]]
kind = "pause"
robot = "r2"
at_s = 10.0
for_s = 9.0

[[faults]]
kind = "crash"
robot = "r3"
at_s = 10.0
for_s = 3.0
"""

COMMAND = (sys.executable, "-P", "-m", "deploy.cli", "run", "steered.toml")


def test_a_vehicle_goes_as_its_agent_plans_and_stands_when_that_is_gone(tmp_path: Path) -> None:
    """r2 is paused and comes back; r3's autopilot is a PX4, which has left OFFBOARD when its agent is there again."""
    places = (("r1", -6.0, 0.0, "ardupilot"), ("r2", -6.0, 8.0, "ardupilot"), ("r3", 2.0, -6.0, "px4"))
    robots = "".join(ROBOT.format(id=name, x=x, y=y, flavour=flavour) for name, x, y, flavour in places)
    (tmp_path / "steered.toml").write_text(SCENARIO + robots)
    run = subprocess.run(
        [*COMMAND, "--runtime", "processes", "--speed", "4", "--seed", "3", "--json", "--no-report", "--out", "run"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    summary = json.loads(run.stdout)
    assert summary["timing"]["plan_us_median"] > 0.0
    assert summary["robots"]["r1"]["position_error_max_m"] < 1.0, "what the vehicle did is what ODOMETRY tells"
    world = played_world(load(str(tmp_path / "steered.toml")), 3, tmp_path / "run" / MOTION)

    def way(robot: str, begin_s: float, end_s: float) -> float:
        """Metres that the vehicle went between two instants."""
        ks = range(round(begin_s * 2), round(end_s * 2) + 1)
        return float(np.sum(np.hypot(*np.diff([world.place(robot, k)[:2] for k in ks], axis=0).T)))

    assert summary["motion"]["min_distance_m"] > 2.0 and summary["motion"]["collisions"] == 0
    for robot in world.robots:
        assert way(robot, 5.0, 10.0) > 1.5
    assert way("r1", 10.0, 30.0) > 5.0
    # Commands of before end after 2.4 s, ArduPilot's own time-out after 3 s; a moment for the pause to begin.
    assert way("r2", 10.0, 14.5) > 0.3 and way("r2", 14.5, 18.5) == 0.0 and way("r2", 21.0, 30.0) > 2.0
    assert way("r3", 13.0, 30.0) == 0.0
    boundary = tmp_path / "run" / "recording.mcap"
    reports = {
        robot: [event.refused for event, _ in read_boundary(boundary, robot) if isinstance(event, ControlReport)]
        for robot in world.robots
    }
    assert reports["r1"][-1] is None and reports["r2"][-1] is None
    assert "OFFBOARD" in str(reports["r3"][-1])
    assert replay(boundary, "r1")[2] is None
    # Who comes back is heard and hears: reports of rounds that it could not have told before.
    for robot in world.robots:
        told = rounds_told(boundary, robot, 24.0)
        assert set(told) == set(world.robots) - {robot} and min(told.values()) >= 4
    stored = load_trace(tmp_path / "run")
    assert stored is not None
    for robot, trace in stored.trace.robots.items():
        ratio = nees(trace)[stored.trace.t_s >= 24.0]
        assert np.isfinite(ratio).all() and ratio.mean() <= 1.7, f"{robot} is overconfident: {ratio.mean():.2f}"


def rounds_told(boundary: Path, robot: str, since_s: float) -> Counter[str]:
    """Reports of rounds after an instant of the run that have come to a robot, by who told them."""
    events = [event for event, _ in read_boundary(boundary, robot)]
    since_ns = events[0].t_ns + round(since_s * NS)
    return Counter(
        event.message.header.source
        for event in events
        if isinstance(event, Received)
        and isinstance(event.message.body, RoundReport)
        and event.message.header.t_meas_ns > since_ns
    )
