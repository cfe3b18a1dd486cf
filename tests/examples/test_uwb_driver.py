"""The example driver against a real agent, and what it says when something is wrong."""

from __future__ import annotations

import ast
import math
import os
import socket
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import msgpack
import numpy as np
import pytest

from agent.effects import Estimate, Publish
from agent.events import Observation
from agent.recording import read_boundary, unpack
from agent.sensor_input import decode
from tests.desk_agent import ANCHORS, DeskAgent, desk_agent

pytestmark = pytest.mark.realtime

DRIVER = Path(__file__).resolve().parents[2] / "examples" / "uwb_driver.py"
PLACE = (1.0, 2.0)


def driver(*arguments: str, lines: str = "") -> subprocess.CompletedProcess[str]:
    """Run the driver to its end in an empty environment: it must not need anything of cofix."""
    return subprocess.run(
        [sys.executable, "-I", str(DRIVER), *arguments],
        input=lines,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )


class Listener:
    """A sensor socket that keeps what arrives."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(str(path))
        self.socket.settimeout(10.0)

    def heard(self, count: int) -> list[Observation]:
        found = []
        for _ in range(count):
            event = decode(self.socket.recv(2048), 0, {})
            assert isinstance(event, Observation)
            found.append(event)
        return found


@pytest.fixture
def listener() -> Iterator[Listener]:
    with tempfile.TemporaryDirectory(prefix="cofix-") as name:
        found = Listener(Path(name) / "sensors.sock")
        yield found
        found.socket.close()


def used(agent: DeskAgent) -> tuple[list[Observation], Estimate]:
    """Measurements that entered the stopped agent's core, and the last estimate that left it."""
    events, estimates = [], []
    for event, effects in read_boundary(agent.recording, "r1"):
        if isinstance(event, Observation):
            events.append(event)
        estimates += [made.estimate for made in map(unpack, effects) if isinstance(made, Publish)]
    return events, estimates[-1]


def test_ranges_to_anchors_locate_a_real_agent() -> None:
    ranges = {name: math.dist(PLACE, position) for name, position in ANCHORS.items()}
    with desk_agent() as agent:
        run = subprocess.Popen(
            [sys.executable, "-I", str(DRIVER), str(agent.socket), "--sigma-m", "0.05", "--sensor", "uwb"],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert run.stdin is not None
            for _ in range(15):
                for name, distance in ranges.items():
                    run.stdin.write(f"{time.time_ns()},landmark:{name},{distance:.4f}\n")
                run.stdin.flush()
                time.sleep(0.05)
            _, said = run.communicate(timeout=30)
        finally:
            run.kill()
            run.wait()
        assert run.returncode == 0
        assert said == "uwb_driver: 45 measurements sent\n"
        # What was sent last is used once it is clear that no odometry comes.
        time.sleep(0.5)
        agent.stop()
        events, estimate = used(agent)
    assert len(events) == 45
    assert {event.of for event in events} == {f"landmark:{name}" for name in ANCHORS}
    assert all((event.kind, event.sensor) == ("range", "uwb") for event in events)
    assert math.dist(PLACE, estimate.mean[:2]) < 0.1
    assert np.sqrt(estimate.cov[0, 0]) < 0.1


def test_made_up_ranges_are_measurements(listener: Listener) -> None:
    done = driver(str(listener.path), "--simulate", "r2", "--count", "5", "--rate-hz", "200", "--sigma-m", "0.2")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "uwb_driver: 5 measurements sent\n"
    heard = listener.heard(5)
    assert [event.of for event in heard] == ["r2"] * 5
    assert all(2.0 < event.z[0] < 8.0 and event.R[0, 0] == pytest.approx(0.04) for event in heard)
    assert all(a.t_meas_ns < b.t_meas_ns for a, b in pairwise(heard))


def test_a_serial_device_is_read_line_by_line(listener: Listener) -> None:
    ours, theirs = os.openpty()
    run = subprocess.Popen(
        [sys.executable, "-I", str(DRIVER), str(listener.path), "--device", os.ttyname(theirs), "--baud", "57600"],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 30.0
        while termios.tcgetattr(theirs)[3] & termios.ICANON:
            assert time.monotonic() < deadline, "the device was not opened"
            time.sleep(0.02)
        time.sleep(0.2)
        os.write(ours, b"7,r2,")
        time.sleep(0.2)
        os.write(ours, b"1.5\r\n\xff\xfe\r\n,landmark:a1,2.25\r\n")
        first, second = listener.heard(2)
        os.close(ours)
        _, said = run.communicate(timeout=30)
    finally:
        run.kill()
        run.wait()
        os.close(theirs)
    assert run.returncode == 0
    assert (first.t_meas_ns, first.of, first.z[0]) == (7, "r2", 1.5)
    # Without a stamp the measurement is of the instant its line arrived.
    assert abs(second.t_meas_ns - time.time_ns()) < 60e9
    assert (second.of, second.z[0]) == ("landmark:a1", 2.25)
    assert said.splitlines() == ["uwb_driver: 2 measurements sent", "uwb_driver: 1 lines were not t_ns,peer,range_m"]


BAD = ["r2,1.0", "1,r2", "1,r2,1,2", "x,r2,1", "1,R2,1", "1,r2,nan", "1,r2,-1", "1,r2,inf", "-1,r2,1", f"{2**70},r2,1"]


def test_lines_that_are_no_measurement_are_counted_and_the_others_used(listener: Listener) -> None:
    lines = "\n".join(["# t_ns,peer,range_m", "", *BAD, " 5 , r2 , 1.0 "])
    done = driver(str(listener.path), lines=lines)
    assert done.returncode == 0
    assert f"{len(BAD)} lines were not t_ns,peer,range_m" in done.stderr
    (event,) = listener.heard(1)
    assert (event.t_meas_ns, event.z[0]) == (5, 1.0)
    only_bad = driver(str(listener.path), lines="\n".join(BAD))
    assert only_bad.returncode == 1


def test_an_agent_that_is_restarted_is_found_again(listener: Listener) -> None:
    run = subprocess.Popen(
        [sys.executable, "-I", str(DRIVER), str(listener.path)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert run.stdin is not None
        run.stdin.write("1,r2,1.0\n")
        run.stdin.flush()
        assert listener.heard(1)[0].t_meas_ns == 1
        listener.socket.close()
        run.stdin.write("2,r2,1.0\n")
        run.stdin.flush()
        time.sleep(0.5)
        listener.path.unlink()
        again = Listener(listener.path)
        run.stdin.write("3,r2,1.0\n")
        _, said = run.communicate(timeout=30)
        assert again.heard(1)[0].t_meas_ns == 3
        again.socket.close()
    finally:
        run.kill()
        run.wait()
    assert run.returncode == 0
    assert "2 measurements sent" in said
    assert "1 not delivered" in said


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["gone.sock"], "gone.sock: no such socket; start the agent"),
        (["stale.sock"], "stale.sock: nobody listens; start the agent"),
        (["stream.sock"], "stream.sock: not a datagram socket"),
        (["plain"], "plain: nobody listens"),
        (["good.sock", "--device", "gone"], "--device gone: No such file"),
        (["good.sock", "--device", "/dev/null"], "--device /dev/null: not a serial device"),
        (["good.sock", "--device", "/dev/null", "--baud", "17"], "--baud 17"),
        (["good.sock", "--simulate", "R2"], "--simulate R2"),
        (["good.sock", "--simulate", "r2", "--rate-hz", "0"], "--rate-hz"),
        ([], "socket"),
    ],
)
def test_wrong_use_names_the_remedy(arguments: list[str], remedy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with tempfile.TemporaryDirectory(prefix="cofix-") as name:
        monkeypatch.chdir(name)
        Path("plain").touch()
        opened = []
        for path, kind in (
            ("stale.sock", socket.SOCK_DGRAM),
            ("stream.sock", socket.SOCK_STREAM),
            ("good.sock", socket.SOCK_DGRAM),
        ):
            opened.append(socket.socket(socket.AF_UNIX, kind))
            opened[-1].bind(path)
        opened[0].close()
        opened[1].listen()
        done = driver(*arguments)
        for item in opened:
            item.close()
    assert (done.returncode, done.stdout) == (2, "")
    assert remedy in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_it_needs_nothing_of_cofix() -> None:
    names = set()
    for node in ast.walk(ast.parse(DRIVER.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names.add(node.module.split(".")[0])
    assert names - set(sys.stdlib_module_names) == {msgpack.__name__}
