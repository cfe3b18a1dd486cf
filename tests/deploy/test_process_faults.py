"""The schedule of faults in runs of real processes: equal fates, and robots that are killed, restarted and paused."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.events import Fix, Observation
from agent.recording import read_agents, read_boundary, replay
from sim.metrics import nees
from sim.store import load_trace

pytestmark = pytest.mark.realtime

COFIX = (sys.executable, "-P", "-m", "deploy.cli")

FAULTS = """
[[faults]]
kind = "loss"
share = 0.2

[[faults]]
kind = "burst_loss"
good_s = 2.0
bad_s = 0.5

[[faults]]
kind = "delay"
delay_s = 0.05
tail_s = 0.05

[[faults]]
kind = "duplicate"
share = 0.2
within_s = 0.5

[[faults]]
kind = "corrupt"
share = 0.05

[[faults]]
kind = "partition"
groups = [["r1", "r2"], ["r3", "r4", "r5"]]
at_s = 12.0
for_s = 5.0

[[faults]]
kind = "autopilot_silence"
robot = "r1"
at_s = 8.0
for_s = 1.5

[[faults]]
kind = "sensor_delay"
robot = "r1"
delay_s = 0.2
tail_s = 0.4

[[faults]]
kind = "forge"
claims = "r1"
content = "damaged"
at_s = 5.0
for_s = 10.0

[[faults]]
kind = "clock_step"
robot = "r4"
offset_s = 0.3
at_s = 10.0

[[faults]]
kind = "crash"
robot = "r3"
at_s = 10.0
for_s = 4.0

[[faults]]
kind = "crash"
robot = "r5"
at_s = 6.0
for_s = 6.0
state = "lost"

[[faults]]
kind = "restart"
robot = "r4"
at_s = 13.0

[[faults]]
kind = "pause"
robot = "r2"
at_s = 15.0
for_s = 3.0
"""


def run(folder: Path, out: str, *options: str) -> dict[str, Any]:
    """What `cofix run` of five robots under all of these faults tells."""
    import sim.scenario_file

    text = sim.scenario_file.locate("fault-plan").read_text()
    begin, end = text.index("[fault_plan]"), text.index("[lateness]")
    text = text[:begin] + text[end:].replace("clock_sigma_s = 0.005", "clock_sigma_s = 1.0") + FAULTS
    path = folder / "faults.toml"
    path.write_text(text)
    done = subprocess.run(
        [*COFIX, "run", str(path), "--seed", "4", "--json", "--no-report", "--out", str(folder / out), *options],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "TMPDIR": str(folder)},
        cwd=folder,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def fates(folder: Path) -> dict[tuple[str, ...], dict[str, str]]:
    """What became of each packet, by what names it."""
    with (folder / "fates.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {tuple(row[k] for k in ("source", "destination", "channel", "incarnation", "seq")): row for row in rows}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], dict[str, Any]]:
    folder = tmp_path_factory.mktemp("faults")
    virtual = run(folder, "virtual", "--runtime", "virtual", "--check")
    processes = run(folder, "processes", "--runtime", "processes", "--speed", "2")
    return folder, virtual, processes


def test_every_robot_is_there_at_the_end_and_honest(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    folder, _, processes = runs
    assert processes["exit"] == dict.fromkeys(("r1", "r2", "r3", "r4", "r5"), 0)
    trace = load_trace(folder / "processes").trace
    for robot, state in trace.robots.items():
        assert np.isfinite(state.mean[-3:]).all(), robot
        assert float(np.nanmean(nees(state))) < 3.0, robot
    assert processes["fleet"]["anees"] < 1.7


def test_who_is_killed_is_gone_for_as_long_as_stated(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    trace = load_trace(runs[0] / "processes").trace
    for robot, span in (("r3", (11.5, 13.5)), ("r5", (7.5, 11.5))):
        known = np.isfinite(trace.robots[robot].mean).all(axis=1)
        during = (trace.t_s > span[0]) & (trace.t_s < span[1])
        assert not known[during].any() and known.any(), robot


def test_the_faults_are_told_alike(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    _, virtual, processes = runs
    assert virtual["faults"] == processes["faults"] and len(virtual["faults"]) == 14


def waits_s(folder: Path, of_autopilot: bool) -> dict[int, float]:
    """How long after its instant [ms since the start] each sighting, or each fix, of r1 came to its core."""
    path = folder / "recording.mcap"
    start_ns = read_agents(path)["r1"][1]
    kind = Fix if of_autopilot else Observation
    return {
        round((event.t_meas_ns - start_ns) * 1e-6): (event.t_ns - event.t_meas_ns) * 1e-9
        for event, _ in read_boundary(path, "r1")
        if isinstance(event, kind) and (of_autopilot or event.of == "target:t1")
    }


def test_sensor_data_are_late_alike_and_fixes_in_their_order(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    virtual, processes = (waits_s(runs[0] / name, False) for name in ("virtual", "processes"))
    shared = virtual.keys() & processes.keys()
    assert len(shared) > 15, len(shared)
    over = [processes[t_ms] - virtual[t_ms] for t_ms in shared]
    assert min(over) > -0.01 and np.median(over) < 0.3, over
    fixes = waits_s(runs[0] / "processes", True)
    assert len(fixes) > 10 and min(fixes.values()) >= 0.2 and list(fixes) == sorted(fixes), fixes


def test_equal_packets_have_equal_fates(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    """Loss, damage and delay follow from what a packet is; its instant decides about spells and partitions alone."""
    folder = runs[0]
    virtual, processes = fates(folder / "virtual"), fates(folder / "processes")
    # A robot that has started again counts its packets anew: those of two lives bear the same numbers.
    shared = {name for name in virtual.keys() & processes.keys() if name[0] in ("r1", "r2")}
    assert len(shared) > 200, len(shared)
    timed = ("burst_loss-2", "partition-6")
    differing = 0
    for name in shared:
        a, b = virtual[name], processes[name]
        # A receiver that has just started again does not know yet who is in reach.
        if a["cause"] in timed or b["cause"] in timed or a["in_range"] != b["in_range"]:
            continue
        differing += any(a[key] != b[key] for key in ("cause", "lost", "delay_ns", "corrupted"))
    assert differing == 0
    assert {row["cause"] for row in processes.values()} >= {"loss-1", "burst_loss-2", "partition-6", ""}


def test_all_lives_are_in_the_recording(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    folder = runs[0]
    for runtime in ("virtual", "processes"):
        path = folder / runtime / "recording.mcap"
        for robot in ("r1", "r3", "r4", "r5"):
            events, _, broken = replay(path, robot)
            assert broken is None and events > 50, (runtime, robot, broken)


def test_nothing_is_left_behind(runs: tuple[Path, dict[str, Any], dict[str, Any]]) -> None:
    folder = runs[0]
    assert not list(folder.glob("cofix-*"))
    assert sorted(path.name for path in (folder / "processes" / "agents").iterdir()) == [
        f"r{k}.toml" for k in range(1, 6)
    ]
