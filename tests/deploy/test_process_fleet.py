"""A fleet of real processes in a test: whatever becomes of the test, no process is left."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from agent.config_file import ConfigError
from deploy.launch import LaunchError
from deploy.testing import FleetMaker, fleet
from tests.deploy.test_processes import alive
from tests.sizes import THOROUGH

__all__ = ["fleet"]

# A fleet of processes takes seconds to start; tests/examples plays one in any case.
pytestmark = [pytest.mark.realtime, pytest.mark.skipif(not THOROUGH, reason="long: COFIX_THOROUGH=1")]

CALM = ("fault-plan", "fault_plan.intensity=calm", "fault_plan.processes=false")

BODY = """
import os, signal
from deploy.testing import fleet

def test_that_ends_badly(fleet):
    robots = fleet(*{calm!r}, runtime="processes", speed=2.0)
    robots.pause("r2", for_s=25.0)
    open("pids", "w").write(" ".join(str(member.process.pid) for member in robots._launcher.members.values()))
    {end}
    robots.run_for(20.0)
"""

ENDS = {
    "fails": "assert False",
    # Started in the background, a shell has its processes ignore it.
    "interrupted": "signal.signal(signal.SIGINT, signal.default_int_handler); os.kill(os.getpid(), signal.SIGINT)",
    "terminated": "os.kill(os.getpid(), signal.SIGTERM)",
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
}


@pytest.mark.parametrize("how", ENDS)
def test_no_process_outlives_its_test_though_one_is_paused(tmp_path: Path, how: str) -> None:
    (tmp_path / "test_own.py").write_text(textwrap.dedent(BODY).format(calm=CALM, end=ENDS[how]))
    done = subprocess.run(
        [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_own.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        check=False,
    )
    assert done.returncode != 0
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 6
    deadline = time.monotonic() + 30.0
    while any(alive(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in pids if alive(pid)], done.stdout


def test_an_agent_that_dies_by_itself_fails_the_test(fleet: FleetMaker) -> None:
    robots = fleet(*CALM, runtime="processes", speed=2.0)
    member = robots._launcher.members["r4"]  # type: ignore[attr-defined]
    os.kill(member.process.pid, signal.SIGKILL)
    with pytest.raises(LaunchError, match="r4 was ended by SIGKILL"):
        robots.run_for(10.0)


def test_who_is_killed_stays_away_until_it_is_restarted(fleet: FleetMaker) -> None:
    robots = fleet(*CALM, "duration_s=90.0", runtime="processes", speed=2.0, seed=3)
    robots.run_until(3.0)
    robots.kill("r5")
    assert robots.status("r5") == {}
    robots.run_for(2.0)
    assert math.isnan(robots.error_m("r5"))
    robots.restart("r5")
    assert robots.status("r5")["state"] == "running"
    robots.run_for(5.0)
    assert robots.error_m("r5") < 5.0
    robots.assert_consistent()


def test_it_plays_to_the_end_and_tells_what_it_played(fleet: FleetMaker) -> None:
    robots = fleet(*CALM, "duration_s=12.0", "window_s=[2.0, 12.0]", runtime="processes", speed=2.0, seed=3)
    robots.run_until(4.0)
    lossy = robots.inject("loss", share=0.5)
    robots.link("r1", "r2").delay_s = 0.1
    with pytest.raises(ConfigError, match="share"):
        robots.link("r1", "r2").loss = 2.0
    assert robots.end(lossy) and not robots.end(lossy) and not robots.end("no such")
    robots.run_until(99.0)
    assert robots.t_s == 12.0 and robots.status("r1") == {}
    t_s, traces = robots.traces()
    assert t_s[-1] == 12.0 and set(traces) == set(robots.robots)
    assert robots.error_m("r1") < 3.0
    robots.assert_consistent(since_s=2.0)
    with pytest.raises(ConfigError, match="after the run's end"):
        robots.kill("r1")
