"""Each fault of processes, disks and sessions, once, on real processes: the healthy stay honest, and it is named.

The long ones are for `make check-matrix` (COFIX_MATRIX=1).
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import combinations
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import tomli_w
import zenoh

from agent.effects import Publish
from agent.recording import read_boundary, unpack
from agent.settings import NS
from agent.state_file import FILE, REFUSED, StateFile
from sim.metrics import nees
from sim.scenario_file import load
from tests.deploy.lan import Lan, missing
from tests.deploy.played import Live, Played, play, scenario
from tests.deploy.test_restart import locate
from tests.desk_agent import DeskAgent, desk_agent

COFIX = (sys.executable, "-P", "-m", "deploy.cli")
LONG = pytest.mark.skipif(not os.environ.get("COFIX_MATRIX"), reason="long: make check-matrix")
ALL = ("r1", "r2", "r3", "r4")
TEAM = (*ALL, "r5", "r6")
SILENT_S = 1.5
"""No healthy pair is silent for longer, whoever else is lost."""


def assert_all_well(played: Played, *except_for: str) -> None:
    assert played.outcome.exits == dict.fromkeys(ALL, 0), played.outcome.messages
    assert played.outcome.interrupted == played.ended_by_scene
    played.assert_honest(*except_for)


def lost(peer: str) -> Any:
    """A status that says that a peer is not heard."""
    return lambda status: status.get("peers", {}).get(peer) is False


def hearing(live: Live, peer: str, heard: bool = True) -> bool:
    """Whether all others hear a peer, or none of them does."""
    return all(live.status(robot).get("peers", {}).get(peer) is heard for robot in ALL if robot != peer)


async def gone_and_back(live: Live, robot: str) -> None:
    """Until all others have lost a robot and hear it again; the run ends then."""
    await live.wait(lambda: hearing(live, robot, False))
    await live.wait(lambda: hearing(live, robot))
    await live.end(6.0)


# -- two short ones -----------------------------------------------------------------------------------------


def status_of(agent: DeskAgent, until: Any) -> dict[str, Any]:
    """The first status for which something is so, as a person's tool hears it."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{agent.stream}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        statuses = session.declare_subscriber("cofix/v1/desk/r1/status")
        for _ in range(40):
            status: dict[str, Any] = msgpack.unpackb(statuses.recv().payload.to_bytes())
            if until(status):
                return status
    pytest.fail(f"no such status; the last one: {status}")


def test_a_second_process_of_one_robot_is_refused_and_harms_nothing() -> None:
    with desk_agent() as agent:
        second = subprocess.run(
            [*COFIX, "agent", str(agent.state_dir.parent / "r1.toml")],
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert second.returncode == 2, second.stderr
        (line,) = second.stderr.strip().splitlines()
        assert "is in use: an agent runs with it already; stop that one" in line
        assert agent.socket.exists()
        assert status_of(agent, lambda status: status.get("state") == "running")["troubles"] == {}
        agent.stop()


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of a few kilobytes on a folder."""
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)], check=False)
    if done.returncode != 0:
        pytest.skip("a file system cannot be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting a small file system needs root")
def test_on_a_full_disk_it_goes_on_and_says_so() -> None:
    with tempfile.TemporaryDirectory(prefix="cofix-") as name, small_disk(Path(name), "64k"):
        agent = DeskAgent(Path(name))
        try:
            agent.wait()
            with suppress(OSError), (Path(name) / "ballast").open("wb", buffering=0) as ballast:
                while True:
                    ballast.write(bytes(1024))
            locate(agent, 15)
            found = status_of(agent, lambda status: "state.write_failed" in status["troubles"])
            assert found["troubles"]["state.write_failed"] == "No space left on device"
            assert found["state"] == "running" and found["sigma_m"] > 0.0
            (Path(name) / "ballast").unlink()
            locate(agent, 3)
            status_of(agent, lambda status: "state.write_failed" not in status["troubles"])
            agent.stop()
        finally:
            agent.kill()


# -- processes ----------------------------------------------------------------------------------------------


@LONG
def test_killed_and_started_again(tmp_path: Path) -> None:
    fault = 'faults=[{kind = "crash", robot = "r3", at_s = 6.0, for_s = 8.0}]'
    played = play(tmp_path, scenario(60.0, fault), 2.0, lambda live: gone_and_back(live, "r3"))
    assert_all_well(played)
    for robot in ("r1", "r2", "r4"):
        assert played.ever(robot, lost("r3")) and played.last(robot)["peers"]["r3"]
    assert played.last("r3")["state_file"]["state.used"] == 1


@LONG
def test_paused_and_continued(tmp_path: Path) -> None:
    fault = 'faults=[{kind = "pause", robot = "r2", at_s = 6.0, for_s = 6.0}]'
    played = play(tmp_path, scenario(60.0, fault), 2.0, lambda live: gone_and_back(live, "r2"))
    assert_all_well(played)
    for robot in ("r1", "r3", "r4"):
        assert played.ever(robot, lost("r2")) and played.last(robot)["peers"]["r2"]
        assert played.last(robot)["silence_max_s"]["r2"] > 4.0
    assert played.last("r2")["lag_max_s"] > 4.0


@LONG
def test_stopped_in_good_order_and_started_again(tmp_path: Path) -> None:
    """What it has kept is what it published last, though it had nothing to write down since it was alone."""

    async def disturb(live: Live) -> None:
        await live.wait(lambda: live.launcher.members["r4"].gone and live.launcher.members["r4"].exit_code is not None)
        kept = StateFile(next(tmp_path.glob("cofix-*")) / "r4", "r4").read().state
        assert kept is not None
        live.notes["kept_ns"] = msgpack.unpackb(kept)[5]
        boundary = read_boundary(tmp_path / "run" / "agents" / "r4.mcap", "r4")
        told = [effect for _, packed in boundary for effect in map(unpack, packed) if isinstance(effect, Publish)]
        live.notes["published_ns"] = told[-1].estimate.t_ns
        await gone_and_back(live, "r4")

    alone = '{kind = "isolate", robot = "r4", at_s = 3.0, for_s = 9.0}'
    faults = f'faults=[{alone}, {{kind = "restart", robot = "r4", at_s = 6.5, for_s = 6.0}}]'
    played = play(tmp_path, scenario(60.0, faults, "state.interval_s=60.0"), 2.0, disturb)
    assert_all_well(played)
    assert played.notes["kept_ns"] == played.notes["published_ns"]
    assert played.last("r4")["state_file"]["state.used"] == 1
    assert played.ever("r1", lost("r4")) and played.last("r1")["peers"]["r4"]


@LONG
def test_cut_in_two_and_healed(tmp_path: Path) -> None:
    def heard(live: Live) -> list[bool]:
        return [live.status(a).get("peers", {}).get(b, False) for a in ("r1", "r2") for b in ("r3", "r4")]

    async def disturb(live: Live) -> None:
        await live.until(6.0)
        await live.wait(lambda: not any(heard(live)))
        await live.wait(lambda: all(heard(live)))
        await live.end(6.0)

    fault = 'faults=[{kind = "partition", groups = [["r1", "r2"], ["r3", "r4"]], at_s = 6.0, for_s = 10.0}]'
    played = play(tmp_path, scenario(60.0, fault), 2.0, disturb)
    assert_all_well(played)
    for robot, away in (("r1", "r3"), ("r2", "r4"), ("r3", "r1"), ("r4", "r2")):
        assert played.ever(robot, lost(away)) and played.last(robot)["peers"][away]
        assert played.ever(robot, lambda status: "partition-1" in status["injected"].get("faults", []))
        assert "faults" not in played.last(robot)["injected"]


# -- robots that choose their motion ------------------------------------------------------------------------


@LONG
def test_who_steers_and_hangs_or_dies_stands_still_and_is_one_of_the_team_again(tmp_path: Path) -> None:
    """r2 is paused for 20 s, r5 killed; the others keep clear of both, and all rounds are of six robots again."""
    pause = '{kind = "pause", robot = "r2", at_s = 12.0, for_s = 20.0}'
    crash = '{kind = "crash", robot = "r5", at_s = 16.0, for_s = 8.0}'
    found = load("ajlatt", ["duration_s=60.0", "window_s=[0.0, 60.0]", f"faults=[{pause}, {crash}]"])
    notes: dict[str, Any] = {}

    def closed(live: Live, robot: str) -> int:
        return int(live.status(robot)["counters"]["round.closed"])

    async def disturb(live: Live) -> None:
        await live.until(40.0)
        notes.update({robot: closed(live, robot) for robot in TEAM})
        await live.until(58.0)
        notes.update({robot: closed(live, robot) - notes[robot] for robot in TEAM})

    played = play(tmp_path, found, 2.0, disturb)
    assert played.outcome.exits == dict.fromkeys(TEAM, 0), played.outcome.messages
    played.assert_honest()
    for robot in TEAM:
        assert set(played.last(robot)["steering"]["neighbours"]) == set(TEAM) - {robot}
        assert notes[robot] >= 16
    assert played.last("r5")["state_file"]["state.used"] == 1
    places = {robot: played.robots[robot].truth[:, :2] for robot in TEAM}
    still = slice(17, 32)
    assert np.ptp(places["r2"][still], axis=0).max() == 0.0, "commands of before last for 3 s at most"
    assert np.ptp(places["r2"][36:], axis=0).max() > 1.0
    for one, other in combinations(TEAM, 2):
        assert np.linalg.norm(places[one] - places[other], axis=1).min() > 2.0
    print("ANEES", {robot: round(float(np.nanmean(nees(played.robots[robot])[34:])), 2) for robot in TEAM})


# -- one id twice -------------------------------------------------------------------------------------------


class Impostor:
    """A second process of a robot, with a folder, ports and a launcher of its own, that coasts from the survey."""

    def __init__(self, folder: Path, live: Live, robot: str) -> None:
        self._live, self._folder = live, folder
        tables = tomllib.loads((folder / "run" / "agents" / f"{robot}.toml").read_text())
        for key in ("mavlink", "injection", "recording"):
            tables.pop(key, None)
        self._state = tempfile.TemporaryDirectory(prefix="twin-", dir=folder)
        tables["zenoh"]["listen"] = []
        tables["state_dir"] = self._state.name
        tables["coast"] = {"speed_mps": 1.0}
        tables["control_socket"] = str(Path(self._state.name) / "control.sock")
        self._control = tables["control_socket"]
        self._path = folder / "twin.toml"
        self._path.write_text(tomli_w.dumps(tables))

    async def __aenter__(self) -> Impostor:
        self._server = await asyncio.start_unix_server(self._serve, path=self._control)
        self._process = await asyncio.create_subprocess_exec(*COFIX, "agent", str(self._path))
        return self

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(json.dumps({"start": self._live.launcher.begin}).encode() + b"\n")
        with suppress(OSError):
            while await reader.readline():
                pass

    async def __aexit__(self, *_: Any) -> None:
        if self._process.returncode is None:
            self._process.send_signal(signal.SIGTERM)
        assert await self._process.wait() == 0
        self._server.close()
        self._state.cleanup()


@LONG
@pytest.mark.parametrize("form", ["safe", "split_joint"])
def test_a_second_process_of_one_robot_elsewhere_is_named_and_not_believed(tmp_path: Path, form: str) -> None:
    """r1 and r2 hear both. When the second one has ended, the first one begins a new life by itself."""

    async def disturb(live: Live) -> None:
        await live.until(5.0)
        async with Impostor(tmp_path, live, "r3"):
            told = ("r1", "r2", "r3")
            await live.wait(lambda: all(live.status(robot)["duplicates"] == ["r3"] for robot in told))
            await asyncio.sleep(1.0)
            met = {robot: live.status(robot)["pairs"].get("r3") for robot in ("r1", "r2")}
            await asyncio.sleep(2.0)
            assert met == {robot: live.status(robot)["pairs"].get("r3") for robot in ("r1", "r2")}
            assert live.status("r3")["incarnation"] == 1
        gone_s = live.t_s
        await live.wait(lambda: live.status("r3")["incarnation"] > 1)
        live.notes["begun_s"] = live.t_s - gone_s
        await live.wait(lambda: not any(live.status(robot)["duplicates"] for robot in ALL))
        live.notes["refused"] = {robot: live.status(robot)["rejected"]["old_life"] for robot in ("r1", "r2")}
        if form == "split_joint":
            gone_ns = live.launcher.t0_ns + gone_s * NS
            await live.wait(lambda: all(live.status(robot)["pairs"]["r3"] > gone_ns for robot in ("r1", "r2")))
        await live.end()

    played = play(tmp_path, scenario(60.0, f"localization.form={form}"), 1.0, disturb)
    assert_all_well(played)
    for robot in ("r1", "r2"):
        assert played.last(robot)["rejected"]["old_life"] == played.notes["refused"][robot] >= 3
        assert played.last(robot)["peers"]["r3"]
        assert "duplicate_robot: r3: two processes" in (tmp_path / "run" / "logs" / f"{robot}.log").read_text()
    log = (tmp_path / "run" / "logs" / "r3.log").read_text()
    assert "duplicate_robot: r3: two processes" in log and log.count("new_life: ") == 1
    assert played.outcome.figures["r3"]["endpoint"]["lives_given_up"] == 1
    print(f"a new life begun {played.notes['begun_s']:.1f} s after the other process ({form})")


# -- disks --------------------------------------------------------------------------------------------------


@LONG
def test_a_full_disk_while_contacts_rely_on_the_state_file(tmp_path: Path) -> None:
    """Files of r2 can no more grow; it goes on, and after a kill begins a new life, as its peers do with it."""

    async def disturb(live: Live) -> None:
        await live.until(5.0)
        folder = next(tmp_path.glob("cofix-*")) / "r2"
        used = live.status("r2")["counters"]["pair.applied_initiator"]
        resource.prlimit(live.pid("r2"), resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        await live.wait(lambda: {"state.write_failed", "recording.failed"} <= set(live.status("r2")["troubles"]))
        # Before it is killed.
        more = lambda: live.status("r2")["counters"]["pair.applied_initiator"] >= used + 4
        await live.wait(more, 13.5 - live.t_s)
        live.notes["status"] = live.status("r2")
        live.notes["files"] = (folder / FILE).exists(), (folder / REFUSED).exists()
        await live.wait(lambda: live.launcher.members["r2"].life == 2)
        await live.wait(lambda: live.status("r2").get("counters", {}).get("pair.applied_initiator"))
        await live.end()

    fault = 'faults=[{kind = "crash", robot = "r2", at_s = 14.0, for_s = 2.0}]'
    played = play(tmp_path, scenario(60.0, fault), 1.0, disturb)
    assert_all_well(played)
    assert played.notes["status"]["troubles"]["state.write_failed"] == "File too large"
    # No start begins with a state that knows less than its peers.
    assert played.notes["files"] == (False, True)
    assert "state.held_back" not in played.notes["status"]["state_file"]
    after = played.last("r2")
    assert "state.used" not in after["state_file"] and after["troubles"] == {}
    assert played.last("r2")["counters"]["pair.applied_initiator"] > 0


# -- sessions -----------------------------------------------------------------------------------------------


def shut_streams(pid: int) -> int:
    """Shut all TCP sockets of a process of ours underneath it, listening ones too; how many there were."""
    libc = ctypes.CDLL(None, use_errno=True)
    process = os.pidfd_open(pid)
    count = 0
    try:
        for entry in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                if not os.readlink(entry).startswith("socket:"):
                    continue
                handle = libc.syscall(438, process, int(entry.name), 0)  # pidfd_getfd
                if handle < 0:
                    pytest.skip("sockets of another process cannot be reached here")
                with socket.socket(fileno=handle) as found:
                    if found.family == socket.AF_INET and found.type == socket.SOCK_STREAM:
                        found.shutdown(socket.SHUT_RDWR)
                        count += 1
    finally:
        os.close(process)
    return count


@LONG
def test_a_lost_zenoh_session_is_opened_again(tmp_path: Path) -> None:
    async def disturb(live: Live) -> None:
        await live.until(5.0)
        assert shut_streams(live.pid("r2")) >= 3
        live.notes["after_s"] = await live.wait(lambda: live.status("r2")["transport"].get("reopened"))
        before = {robot: live.status(robot)["pairs"].get("r2", 0) for robot in ("r1", "r3", "r4")}
        await live.wait(
            lambda: all(live.status(robot)["pairs"].get("r2", 0) > then + 3 * NS for robot, then in before.items())
        )
        await live.end()

    played = play(tmp_path, scenario(60.0), 1.0, disturb)
    assert_all_well(played)
    found = played.last("r2")["transport"]
    assert found["reopened"] == 1 and found["lost_deaf"] == 1
    assert not [robot for robot in ("r1", "r3", "r4") if "reopened" in played.last(robot)["transport"]]
    print(f"session opened again after {played.notes['after_s']:.1f} s")


@LONG
@pytest.mark.parametrize("how", ["radio", "process"])
def test_who_vanishes_in_silence_stalls_nobody(tmp_path: Path, how: str) -> None:
    """Twenty times a robot is gone without a word, data to it unacknowledged, and back.

    Contacts are as frequent as can be, so the form is the one that is honest then.
    """
    reason = missing() if how == "radio" else None
    if reason is not None:
        pytest.skip(reason)
    with Lan(ALL if how == "radio" else []) as lan:

        async def disturb(live: Live) -> None:
            await live.until(4.0)
            for _ in range(20):
                if how == "radio":
                    lan.vanish("r3")
                else:
                    os.kill(live.pid("r3"), signal.SIGSTOP)
                try:
                    await live.wait(lambda: hearing(live, "r3", False))
                finally:
                    if how == "radio":
                        lan.appear("r3")
                    else:
                        os.kill(live.pid("r3"), signal.SIGCONT)
                await live.wait(lambda: hearing(live, "r3"))
            live.notes["rounds"] = 20
            await live.end()

        plan = scenario(400.0, "localization.form=split_joint")
        played = play(tmp_path, plan, 1.0, disturb, lan.hosts or None)
    assert lan.left == []
    assert_all_well(played)
    assert played.notes["rounds"] == 20
    healthy = ("r1", "r2", "r4")
    worst = {(a, b): played.last(a)["silence_max_s"][b] for a in healthy for b in healthy if a != b}
    assert max(worst.values()) <= SILENT_S, worst
    assert min(played.last(robot)["silence_max_s"]["r3"] for robot in healthy) > 3.0
    print(f"longest silence of a healthy pair in 20 rounds ({how}): {max(worst.values()):.2f} s")
