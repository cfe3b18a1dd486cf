"""Faults by hand: what `cofix fault` understands, what the launcher answers, and a run into which they are injected."""

from __future__ import annotations

import asyncio
import csv
import math
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError
from agent.fault_parts import AnyFaultPart, CrashPart
from agent.settings import NS
from deploy.evaluate import merge_fates
from deploy.fault import socket_of, split, wanted
from deploy.live_faults import LiveFaults
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from tests.deploy.played import SEED, Live, play

pytestmark = pytest.mark.realtime

COFIX = (sys.executable, "-P", "-m", "deploy.cli")

WORDS: list[tuple[str, dict[str, Any]]] = [
    ("partition r1,r2 r3", {"kind": "partition", "groups": [["r1", "r2"], ["r3"]]}),
    ("loss 0.5", {"kind": "loss", "share": 0.5}),
    ("kill r3", {"kind": "crash", "robot": "r3"}),
    ("crash r3 state=lost", {"kind": "crash", "robot": "r3", "state": "lost"}),
    ("pause r2 for_s=2.0", {"kind": "pause", "robot": "r2", "for_s": 2.0}),
    (
        "sensor_delay r1 0.5 0.2 sensor=range",
        {"kind": "sensor_delay", "robot": "r1", "delay_s": 0.5, "tail_s": 0.2, "sensor": "range"},
    ),
    ("clock_step r2 -0.3", {"kind": "clock_step", "robot": "r2", "offset_s": -0.3}),
    (
        "delay delay_s=0.1 sources=r1 destinations=r2,r3 both_ways=false",
        {"kind": "delay", "delay_s": 0.1, "sources": ["r1"], "destinations": ["r2", "r3"], "both_ways": False},
    ),
    (
        "sensor_dropout r1 range of=landmark:L3",
        {"kind": "sensor_dropout", "robot": "r1", "sensor": "range", "of": "landmark:L3"},
    ),
]


@pytest.mark.parametrize(("words", "keys"), WORDS, ids=[words for words, _ in WORDS])
def test_words_become_keys_of_the_schema(words: str, keys: dict[str, Any]) -> None:
    assert wanted(words.split()) == {"inject": keys}


def test_links_and_time_are_options() -> None:
    assert wanted(["loss", "0.5"], "r1,r2", 10.0) == {
        "inject": {
            "kind": "loss",
            "share": 0.5,
            "sources": ["r1", "r2"],
            "destinations": ["r1", "r2"],
            "for_s": 10.0,
        }
    }


def test_a_run_directory_may_come_first() -> None:
    assert split(["runs/one", "kill", "r3"]) == (Path("runs/one"), ["kill", "r3"])
    assert split(["list"]) == (None, ["list"])


@pytest.mark.parametrize("words", [["kil", "r3"], ["runs/one"], ["runs/one", "kil", "r3"]])
def test_what_is_no_fault_is_answered_with_those_there_are(words: list[str]) -> None:
    with pytest.raises(ConfigError, match="none of list, end, kill, partition"):
        split(words)


@pytest.mark.parametrize("words", [["end"], ["list", "all"], ["kill", "r3", "r4"]])
def test_words_too_many_or_too_few(words: list[str]) -> None:
    with pytest.raises(ConfigError, match="fault: "):
        wanted(words)


def test_without_a_run_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ConfigError, match="no run of processes goes on"):
        socket_of(None)
    with pytest.raises(ConfigError, match="not the directory of a run of processes"):
        socket_of(tmp_path)


# -- the launcher's side ------------------------------------------------------------------------------------


class Run:
    """A run that is at 10 s, and what it was told."""

    def __init__(self) -> None:
        self.scenario: Scenario = load("ut-clat")
        self.at_s = 10.0
        self.told: list[dict[str, Any]] = []
        self.struck: list[tuple[str, AnyFaultPart]] = []
        self.faults = LiveFaults(
            self.scenario,
            1,
            lambda: self.at_s,
            self.told.append,
            lambda name, fault: self.struck.append((name, fault)),
        )

    def refused(self, request: dict[str, Any]) -> str:
        answer = self.faults.answer(request)
        assert not self.told and self.faults.played() is self.scenario
        return str(answer["error"])


def test_a_fault_is_from_now_on_and_told_to_all() -> None:
    run = Run()
    assert "loss-1" in run.faults.answer({"inject": {"kind": "loss", "share": 0.5}})["done"]
    (message,) = run.told
    assert message["fault"]["id"] == "loss-1" and message["fault"]["at_s"] == 10.0
    assert run.faults.active(10.0) == ["loss-1"] and run.faults.active(9.9) == []
    assert not run.struck


def test_what_was_done_by_hand_is_a_schedule_that_can_be_played_again() -> None:
    run = Run()
    run.faults.answer({"inject": {"kind": "loss", "share": 0.5}})
    run.at_s = 14.0
    assert run.faults.answer({"end": "loss-1"}) == {"done": "loss-1 is ended"}
    (fault,) = run.faults.played().faults
    assert (fault.id, fault.at_s, fault.for_s) == ("loss-1", 10.0, 4.0)
    assert run.told[1] == {"end_fault": {"id": "loss-1", "at_s": 14.0}}
    assert run.faults.changes == run.told


def test_faults_of_processes_are_played_by_the_launcher() -> None:
    run = Run()
    run.faults.answer({"inject": {"kind": "crash", "robot": "r3"}})
    ((name, fault),) = run.struck
    assert isinstance(fault, CrashPart) and fault.robot == "r3"
    assert not run.faults.over(name).is_set()
    run.at_s = 15.0
    run.faults.answer({"end": name})
    assert run.faults.over(name).is_set()


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"inject": {"kind": "los", "share": 0.5}}, "did you mean 'loss'?"),
        ({"inject": {"kind": "loss", "shre": 0.5}}, "did you mean 'share'?"),
        ({"inject": {"kind": "loss", "share": 1.5}}, "share' = 1.5"),
        ({"inject": {"kind": "crash", "robot": "r9"}}, "no robot 'r9'"),
        ({"inject": {"kind": "loss", "share": 0.5, "at_s": 3.0}}, "at_s = 3 is over; the run is at 10 s"),
        ({"inject": {"kind": "loss", "share": 0.5, "at_s": 1e6}}, "after the run's end"),
        ({"inject": {"kind": "sensor_dropout", "robot": "r1", "sensor": "sonar"}}, "has no sensor 'sonar'"),
        ({"inject": {"kind": "sensor_delay", "robot": "r1"}}, "state delay_s, tail_s or both"),
        ({"inject": {"kind": "sensor_delay", "robot": "r1", "delay_s": -1.0}}, "delay_s' = -1.0"),
        ({"inject": {}}, "kind' is missing"),
        ({"inject": {"kind": "loss", "share": 0.5, "id": 7}}, "id' = 7"),
        ({"end": "loss-1"}, "there is no 'loss-1' that goes on; there are: none"),
        ({"stop": True}, "inject, end or list"),
        ([], "inject, end or list"),
    ],
)
def test_what_is_wrong_is_answered_and_changes_nothing(request_: Any, words: str) -> None:
    assert words in Run().refused(request_)


def test_names_differ_and_a_clock_that_was_set_stays() -> None:
    run = Run()
    run.faults.answer({"inject": {"kind": "clock_step", "robot": "r1", "offset_s": 0.1, "id": "wrong"}})
    again = run.faults.answer({"inject": {"kind": "loss", "share": 0.5, "id": "wrong"}})
    assert "'wrong' is used already" in again["error"]
    assert "a clock that was set stays so" in run.faults.answer({"end": "wrong"})["error"]
    assert [entry[:2] for entry in run.faults.answer({"list": True})["faults"]] == [["wrong", True]]


# -- a run of processes -------------------------------------------------------------------------------------

SCENARIO = """
version = 1
name = "trio"
duration_s = 600.0
step_s = 0.5
window_s = [5.0, 600.0]

[localization]
pair_interval_s = 1.0
pair_timeout_s = 2.0

[lateness]
horizon_s = 10.0
clock_sigma_s = 1.0
"""

ROBOT = """
[[robots]]
id = "r{k}"
start = {{ pose = [{k}.0, {k}.0, 0.0] }}
start_sigma = {{ position_m = 0.5, heading_rad = 0.05 }}
control = {{ speed_mps = 0.3, yaw_rate_radps = 0.1 }}
noise = {{ speed_mps = 0.1, yaw_rate_radps = 0.01 }}
autopilot = {{ sends = ["odometry", "global_position", "attitude"] }}
sensors = {{ range = {{ of = ["peers"], sigma_m = 0.1 }}, pose = {{ sigma_m = 0.5, sigma_rad = 0.05 }} }}
"""


def fault(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COFIX, "fault", *words], capture_output=True, text=True, timeout=120, check=False)


def test_a_run_that_goes_on_is_broken_and_healed_by_hand(short_path: Path) -> None:
    (short_path / "trio.toml").write_text(SCENARIO + "".join(ROBOT.format(k=k) for k in (1, 2, 3)))
    out = short_path / "run"

    async def injected(*words: str) -> str:
        done = await asyncio.to_thread(fault, str(out), *words)
        assert done.returncode == 0, done.stderr
        return done.stdout.partition(":")[0]

    async def by_hand(live: Live) -> None:
        """The run goes on until all is done, however long the commands take."""
        (there,) = short_path.glob("cofix-*/faults.sock")
        assert stat.S_IMODE(there.stat().st_mode) == 0o600
        live.notes["cut"] = cut = await injected("partition", "r1,r2", "r3")
        live.notes["killed"] = killed = await injected("kill", "r2")
        since_s = live.t_s
        await injected("clock_step", "r1", "0.3")
        await injected("sensor_dropout", "r3", "range", "--for", "5")
        wrong = await asyncio.to_thread(fault, str(out), "isolate", "r7")
        assert wrong.returncode == 2 and "no robot 'r7'" in wrong.stderr
        listed = await asyncio.to_thread(fault, str(out), "list")
        assert f"on  {cut}:" in listed.stdout
        await live.until(since_s + 4.0)
        await injected("end", cut)
        await injected("end", killed)

        def known_until_s() -> float:
            """How far the second life of r2 has come; minus infinity before it is at work."""
            t_ns = live.status("r2").get("t_ns") if live.launcher.members["r2"].life == 2 else None
            return -math.inf if t_ns is None else (t_ns - live.launcher.t0_ns) / NS

        await live.wait(lambda: known_until_s() > since_s, 120.0)
        back_s = live.t_s
        await live.wait(lambda: known_until_s() > back_s + 2.0, 120.0)
        live.notes["end_s"] = known_until_s()
        live.launcher.interrupt()

    played = play(short_path, load(str(short_path / "trio.toml")), speed=3.0, disturb=by_hand)
    cut, killed, end_s = (played.notes[name] for name in ("cut", "killed", "end_s"))
    assert played.outcome.exits == {"r1": 0, "r2": 0, "r3": 0}, played.outcome.messages
    assert [fault.kind for fault in played.scenario.faults] == ["partition", "crash", "clock_step", "sensor_dropout"]
    faults = {fault.id: fault for fault in played.scenario.faults}
    assert faults.keys() == {cut, killed, "clock_step-3", "sensor_dropout-4"}
    window = (played.t_s >= 5.0) & (played.t_s <= end_s)
    assert np.nanmean([nees(trace)[window] for trace in played.robots.values()]) < 2.0, f"seed {SEED}"
    merge_fates(played.scenario, out)
    with (out / "fates.csv").open(newline="") as file:
        lost = {(row["source"], row["destination"]) for row in csv.DictReader(file) if row["cause"] == cut}
    assert lost and all("r3" in link for link in lost)
    # Who was killed was gone for as long as is told, and came back.
    crash = faults[killed]
    assert crash.for_s is not None
    known = np.isfinite(played.robots["r2"].mean).all(axis=1)
    gone = (played.t_s > crash.at_s + 1.5) & (played.t_s < crash.at_s + crash.for_s)
    back = (played.t_s > end_s - 1.5) & (played.t_s < end_s - 0.5)
    assert gone.any() and not known[gone].any() and back.any() and known[back].all()
