"""A real agent process that is killed, and stopped, goes on with what it knew."""

from __future__ import annotations

import math
import socket
import tempfile
import time
from pathlib import Path

import msgpack
import pytest

from agent.recording import Life, read_lives, replay
from agent.state_file import FILE, REFUSED, Found, StateFile
from tests.desk_agent import ANCHORS, DeskAgent

pytestmark = pytest.mark.realtime

PLACE = (1.5, 2.0)


def started(folder: Path) -> DeskAgent:
    """An agent in a folder where another one may have left its socket and recording."""
    for name in ("state/sensors.sock", "r1.mcap"):
        (folder / name).unlink(missing_ok=True)
    agent = DeskAgent(folder)
    try:
        agent.wait()
    except BaseException:
        agent.kill()
        raise
    return agent


def locate(agent: DeskAgent, times: int) -> None:
    """Ranges to the anchors, as a driver sends them."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as driver:
        driver.connect(str(agent.socket))
        for _ in range(times):
            for name, anchor in ANCHORS.items():
                z = [math.dist(PLACE, anchor)]
                datum = {"t_ns": time.time_ns(), "kind": "range", "of": f"landmark:{name}", "z": z, "R": [[0.0025]]}
                driver.send(msgpack.packb(datum))
            time.sleep(0.1)


def life(agent: DeskAgent) -> Life | None:
    """What the recording says of the start; None for a first one."""
    first = next(read_lives(agent.recording, "r1", unfinished=True), None)
    return first if isinstance(first, Life) else None


def mean_of(found: Found) -> tuple[float, float]:
    assert found.state is not None
    x, y, _ = memoryview(msgpack.unpackb(found.state)[6]).cast("d").tolist()
    return x, y


def test_it_goes_on_after_a_kill_and_after_a_clean_end_and_begins_anew_with_a_broken_file() -> None:
    with tempfile.TemporaryDirectory(prefix="cofix-") as name:
        folder = Path(name)
        file = StateFile(folder / "state", "r1")
        agent = started(folder)
        try:
            locate(agent, 15)
        finally:
            agent.kill()
        killed = file.read()
        assert math.dist(mean_of(killed), PLACE) < 0.2 and killed.incarnation is not None

        agent = started(folder)
        try:
            locate(agent, 3)
            agent.stop()
        finally:
            agent.kill()
        found = life(agent)
        assert found is not None and found.state == killed.state
        assert replay(agent.recording, "r1")[2] is None
        stopped = file.read()
        assert stopped.incarnation == killed.incarnation and stopped.state != killed.state

        (folder / "state" / FILE).write_bytes((folder / "state" / FILE).read_bytes()[:-9])
        agent = started(folder)
        try:
            agent.stop()
        finally:
            agent.kill()
        assert life(agent) is None
        assert (folder / "state" / REFUSED).exists()
        anew = file.read()
        assert anew.incarnation is not None and anew.incarnation > killed.incarnation
