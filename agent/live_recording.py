"""The recording of a robot that is at work: a disk that takes no more ends the recording, never the robot."""

from __future__ import annotations

import contextlib
from pathlib import Path

from agent.config import AgentConfig
from agent.effects import Effect
from agent.events import Event
from agent.recording import RecordingWriter


class LiveRecording:
    """One life of one robot. Raises OSError if the file cannot be opened; `failure`: why it is not written any more."""

    def __init__(self, path: Path, config: AgentConfig, start_ns: int) -> None:
        self._robot = config.identity.robot
        self._writer = RecordingWriter(path)
        self.failure: str | None = None
        try:
            self._writer.add_robot(config, start_ns)
        except OSError as error:
            self._fail(error)

    def begin_life(self, t_ns: int, state: bytes | None) -> None:
        """The robot has lived before; see `RecordingWriter.begin_life`."""
        if self.failure is not None:
            return
        try:
            self._writer.begin_life(self._robot, t_ns, state)
        except OSError as error:
            self._fail(error)

    def record(self, event: Event, effects: list[Effect]) -> None:
        """One call of the core."""
        if self.failure is not None:
            return
        try:
            self._writer.record(self._robot, event, effects)
        except OSError as error:
            self._fail(error)

    def flush(self) -> None:
        """Hand what was recorded to the operating system: it stays if this process is killed."""
        if self.failure is not None:
            return
        try:
            self._writer.flush()
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Finish the file, if it is whole."""
        if self.failure is not None:
            return
        try:
            self._writer.close()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = error.strerror or type(error).__name__
        with contextlib.suppress(OSError):
            self._writer.abandon()
