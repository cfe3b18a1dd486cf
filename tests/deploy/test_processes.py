"""Runs of real processes over Zenoh and MAVLink, as a person starts them."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from deploy.fault import ask, socket_of
from sim.scenario_file import load
from sim.store import load_trace

pytestmark = pytest.mark.realtime

SCENARIO = """
version = 1
name = "pair"
duration_s = 40.0
step_s = 0.5
window_s = [10.0, 40.0]

[localization]
pair_interval_s = 1.0
pair_timeout_s = 2.0

[lateness]
horizon_s = 10.0

[links]
loss = 0.3

[[robots]]
id = "r1"
start = { pose = [0.0, 0.0, 0.0] }
start_sigma = { position_m = 0.5, heading_rad = 0.05 }
control = { speed_mps = 0.3, yaw_rate_radps = 0.1 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.01 }
autopilot = { sends = ["odometry", "global_position", "attitude"] }
sensors = { range = { of = ["peers"], sigma_m = 0.1 }, pose = { sigma_m = 0.5, sigma_rad = 0.05 } }

[[robots]]
id = "r2"
start = { pose = [5.0, 1.0, 1.0] }
start_sigma = { position_m = 0.5, heading_rad = 0.05 }
control = { speed_mps = 0.3, yaw_rate_radps = -0.1 }
noise = { speed_mps = 0.1, yaw_rate_radps = 0.01 }
sensors = { range = { of = ["peers"], sigma_m = 0.1 } }
"""

SEED = "5"
COFIX = (sys.executable, "-P", "-m", "deploy.cli")
RANDOM_FATE = ("lost", "delay_ns", "duplicate")


class Run:
    """A `cofix run` in a process of its own."""

    def __init__(self, folder: Path, out: str, *options: str) -> None:
        scenario = folder / "pair.toml"
        scenario.write_text(SCENARIO)
        self.directory = folder / out
        self.process = subprocess.Popen(
            [*COFIX, "run", str(scenario), "--seed", SEED, "--json", "--out", str(self.directory), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": str(folder)},
            cwd=folder,
        )

    def finish(self, timeout_s: float = 90.0) -> tuple[int, dict[str, Any] | None, str]:
        """Exit status, summary if one was printed, and what was said on standard error."""
        try:
            out, err = self.process.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            self.process.send_signal(signal.SIGINT)
            out, err = self.process.communicate(timeout=30)
            pytest.fail(f"run did not end within {timeout_s} s: {err}")
        return self.process.returncode, json.loads(out) if out.strip() else None, err

    def members(self) -> dict[str, int]:
        """Process ids of the run's agents and its world, by name, once all of them are there."""
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            found = {}
            for pid in children_of(self.process.pid):
                line = command_of(pid)
                if "sim.host" in line:
                    found["world"] = pid
                elif "deploy.cli" in line and line.endswith(".toml"):
                    found[Path(line.split()[-1]).stem] = pid
            if len(found) == 3:
                return found
            time.sleep(0.05)
        pytest.fail("the run did not start its processes")

    def wait_until_played(self) -> None:
        """Until the run is past its barrier: an agent has written a part of its recording."""
        deadline = time.monotonic() + 60.0
        recording = self.directory / "agents" / "r2.mcap"
        while time.monotonic() < deadline:
            if recording.exists():
                time.sleep(3.0)
                return
            time.sleep(0.05)
        pytest.fail("the run did not pass its barrier")


def children_of(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task")
    found = []
    for task in tasks.iterdir() if tasks.exists() else []:
        text = (task / "children").read_text()
        found += [int(item) for item in text.split()]
    return found


def command_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
    except OSError:
        return ""


def alive(pid: int) -> bool:
    try:
        return "(zombie)" not in Path(f"/proc/{pid}/status").read_text().splitlines()[2]
    except OSError:
        return False


def assert_nothing_left(folder: Path, members: dict[str, int]) -> None:
    """No process, no socket, no private folder remains."""
    assert not [name for name, pid in members.items() if alive(pid)]
    assert not list(folder.glob("cofix-*"))
    assert not list(folder.rglob("*.sock"))


def fates(directory: Path) -> dict[tuple[str, ...], tuple[str, ...]]:
    with (directory / "fates.csv").open(newline="") as file:
        return {
            (row["source"], row["destination"], row["channel"], row["incarnation"], row["seq"]): tuple(
                row[name] for name in RANDOM_FATE
            )
            for row in csv.DictReader(file)
        }


def test_processes_agree_with_virtual_time(short_path: Path) -> None:
    run = Run(short_path, "processes", "--runtime", "processes", "--speed", "5")
    members = run.members()
    status, real, said = run.finish()
    assert status == 0, said
    assert real is not None
    assert_nothing_left(short_path, members)
    status, virtual, said = Run(short_path, "virtual", "--no-report").finish()
    assert status == 0, said
    assert virtual is not None
    assert real["exit"] == {"r1": 0, "r2": 0}
    assert real["network"]["pair"]["completed"] > 0
    # Equal noise, equal fates: only scheduling differs. A wide margin, since the machine may be loaded.
    ratio = real["fleet"]["position_rmse_m"] / virtual["fleet"]["position_rmse_m"]
    assert 0.6 < ratio < 1.6, f"seed {SEED}: fleet RMSE is {ratio:.2f} x that of virtual time"
    ours, theirs = fates(run.directory), fates(short_path / "virtual")
    shared = [packet for packet in ours if packet in theirs]
    assert len(shared) > 40
    assert [packet for packet in shared if ours[packet] != theirs[packet]] == []
    lost = [packet for packet in shared if ours[packet][0] == "1"]
    assert 0.1 < len(lost) / len(shared) < 0.5
    kept = [load_trace(folder) for folder in (run.directory, short_path / "virtual")]
    measured = [stored.measured for stored in kept if stored is not None]
    # The lower id owns a two-way range; one each step.
    assert [list(found) for found in measured] == [[("r1", "r2")]] * 2
    assert measured[0]["r1", "r2"].tolist() == measured[1]["r1", "r2"].tolist()
    assert len(measured[0]["r1", "r2"]) == 80
    for name in ("summary.json", "report.html", "recording.mcap", "scenario.toml", "agents/r1.toml"):
        assert (run.directory / name).stat().st_size > 0
    replayed = subprocess.run(
        [*COFIX, "replay", str(run.directory / "recording.mcap")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr
    assert replayed.stdout.count("all equal") == 2


def test_a_killed_agent_is_told_and_the_others_finish(short_path: Path) -> None:
    run = Run(short_path, "killed", "--runtime", "processes", "--speed", "4", "--no-report", "--duration", "25")
    members = run.members()
    run.wait_until_played()
    os.kill(members["r2"], signal.SIGKILL)
    assert "error" not in ask(socket_of(run.directory), {"inject": {"kind": "loss", "share": 0.5, "id": "by-hand"}})
    status, summary, said = run.finish()
    assert status == 1
    assert summary is not None
    # What was done by hand is told, and kept as a schedule.
    assert summary["faults"][-1].startswith("by-hand")
    assert [fault.id for fault in load(str(run.directory / "scenario.toml")).faults] == ["by-hand"]
    assert summary["exit"] == {"r1": 0, "r2": -signal.SIGKILL}
    assert "r2 was ended by SIGKILL" in said
    assert summary["robots"]["r1"]["position_rmse_m"] < 1.0
    assert_nothing_left(short_path, members)


def test_interrupt_stops_everything(short_path: Path) -> None:
    run = Run(short_path, "interrupted", "--runtime", "processes", "--speed", "1")
    members = run.members()
    run.wait_until_played()
    run.process.send_signal(signal.SIGINT)
    status, summary, said = run.finish(timeout_s=40.0)
    assert status == 1
    assert summary is None
    assert "interrupted" in said
    assert_nothing_left(short_path, members)
