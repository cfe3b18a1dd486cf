"""A real agent process on loopback, without peers or autopilot, for tests of what people connect to it."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import tomli_w

from network.transport import free_port
from network.zenoh_session import link_pair

DEADLINE_S = 30.0
ANCHORS = {"a1": (0.0, 0.0), "a2": (6.0, 0.0), "a3": (0.0, 8.0)}


class DeskAgent:
    """Robot r1 of the fleet `desk`, which believes to be at (0.5, 1.5) within a metre and knows three anchors."""

    def __init__(self, folder: Path) -> None:
        self.state_dir = folder / "state"
        self.socket = self.state_dir / "sensors.sock"
        self.recording = folder / "r1.mcap"
        self.stream, datagrams = link_pair("127.0.0.1", free_port())
        config = {
            "version": 1,
            "identity": {"fleet": "desk", "robot": "r1"},
            "initial": {"mean": [0.5, 1.5, 0.0], "start_sigma": {"position_m": 1.0, "heading_rad": 0.1}},
            "coast": {"speed_mps": 0.1},
            "lateness": {"odometry_wait_s": 0.05},
            "sensors": {"uwb": {"kind": "range"}},
            "landmarks": [{"id": name, "position": list(position)} for name, position in ANCHORS.items()],
            "zenoh": {"listen": [self.stream, datagrams]},
            "state_dir": str(self.state_dir),
            "recording": str(self.recording),
        }
        path = folder / "r1.toml"
        path.write_text(tomli_w.dumps(config))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "deploy.cli", "agent", str(path)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait(self) -> None:
        """Until it listens and works."""
        deadline = time.monotonic() + DEADLINE_S
        while not (self.socket.exists() and self.recording.exists()):
            assert self._process.poll() is None, self._process.communicate()[1]
            assert time.monotonic() < deadline, "the agent did not start"
            time.sleep(0.05)

    def stop(self) -> None:
        """End it as a service manager does."""
        self._process.send_signal(signal.SIGTERM)
        _, said = self._process.communicate(timeout=DEADLINE_S)
        assert self._process.returncode == 0, said

    def kill(self) -> None:
        if self._process.poll() is None:
            self._process.kill()
        self._process.communicate()


@contextmanager
def desk_agent() -> Iterator[DeskAgent]:
    """An agent that works; ended in any case. Its folder has a name short enough for a socket."""
    with tempfile.TemporaryDirectory(prefix="cofix-") as name:
        agent = DeskAgent(Path(name))
        try:
            agent.wait()
            yield agent
        finally:
            agent.kill()
