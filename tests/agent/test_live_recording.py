"""A recording whose disk is full ends, says why, and disturbs nobody."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agent.config import load_agent_config
from agent.events import Tick
from agent.live_recording import LiveRecording
from tests.agent.test_config import example, write


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_agent_config(write(tmp_path, example()))
    opened = Path.open

    def full(path: Path, *arguments: Any, **keys: Any) -> Any:
        return opened(Path("/dev/full") if path.suffix == ".mcap" else path, *arguments, **keys)

    monkeypatch.setattr(Path, "open", full)
    recording = LiveRecording(tmp_path / "r1.mcap", config, 0)
    recording.begin_life(0, None)
    for k in range(2_000):
        recording.record(Tick(k), [])
    assert recording.failure == "No space left on device"
    recording.close()
