"""Whole fleets: in the virtual engine, as processes, and what memory they hold."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import time
import tracemalloc
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w

from deploy.cli import main as cofix
from sim.engine import VirtualEngine
from sim.scenario import Scenario
from sim.world import SimulatedWorld


def scenario(
    count: int, rate_hz: float, interval_s: float, duration_s: float, reach_m: float = 1000.0
) -> dict[str, object]:
    """`count` robots on a ring, `SPACING_M` apart, that range all within reach once per step; robot 1 has fixes."""
    robots, radius = [], SPACING_M * count / (2.0 * np.pi)
    for index in range(count):
        angle = 2.0 * np.pi * index / count
        sensors: dict[str, object] = {"range": {"of": ["peers"], "sigma_m": 0.1, "max_range_m": reach_m}}
        if index == 0:
            sensors["pose"] = {"sigma_m": 0.3, "sigma_rad": 0.05, "rate_hz": 1.0}
        robots.append(
            {
                "id": f"r{index:02d}",
                "start": {"pose": [float(radius * np.cos(angle)), float(radius * np.sin(angle)), float(angle)]},
                "start_sigma": {"position_m": 0.3, "heading_rad": 0.05},
                "control": {"speed_mps": 0.3, "yaw_rate_radps": 0.1},
                "noise": {"speed_mps": 0.05, "yaw_rate_radps": 0.01},
                "sensors": sensors,
            }
        )
    return {
        "version": 1,
        "name": "ring",
        "duration_s": duration_s,
        "step_s": 1.0 / rate_hz,
        "window_s": [0.0, duration_s],
        "localization": {"pair_interval_s": interval_s},
        "tracking": {"kind": "none"},
        "robots": robots,
    }


SPACING_M = 6.0


@dataclass(frozen=True, slots=True)
class Virtual:
    """Simulated seconds per CPU second, and contacts used per simulated second."""

    speed: float
    contacts_per_s: float


def virtual(count: int, rate_hz: float, interval_s: float, duration_s: float) -> Virtual:
    """A run in virtual time on one core."""
    made = Scenario.model_validate(scenario(count, rate_hz, interval_s, duration_s))
    engine = VirtualEngine(made, SimulatedWorld(made, 1), 1)
    begin = time.process_time()
    result = engine.run()
    return Virtual(duration_s / (time.process_time() - begin), len(result.contacts) / 2.0 / duration_s)


def memory_growth(count: int, rate_hz: float, duration_s: float) -> tuple[float, float]:
    """Growth of the memory agents hold over the second half of a run, relative, and that memory at its begin [bytes].

    Figures of a whole run are kept by the engine on purpose; agents alone are weighed.
    """
    made = Scenario.model_validate(scenario(count, rate_hz, 0.0, duration_s))
    engine = VirtualEngine(made, SimulatedWorld(made, 1), 1)
    taken: list[int] = []

    def progress(step: int, steps: int) -> None:
        engine.contacts.clear()
        if step in (steps // 2, steps):
            taken.append(_held())

    tracemalloc.start()
    try:
        engine.run(progress)
    finally:
        tracemalloc.stop()
    half, end = taken
    return (end - half) / half, float(half)


AGENTS = [tracemalloc.Filter(True, "*/agent/*"), tracemalloc.Filter(True, "*/network/*")]


def _held() -> int:
    """Bytes that lines of the agents and the network have allocated and still hold."""
    return sum(item.size for item in tracemalloc.take_snapshot().filter_traces(AGENTS).statistics("filename"))


@dataclass(frozen=True, slots=True)
class Processes:
    """Worst lag of any process behind the fleet's clock, and the 99th percentile of all agents' timers."""

    lag_max_s: float
    lag_p99_s: float


def processes(count: int, rate_hz: float, duration_s: float) -> Processes:
    """`cofix run` with one process per robot. Raises `RuntimeError` if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "ring.toml", Path(folder) / "run"
        path.write_text(tomli_w.dumps(scenario(count, rate_hz, 1.0, duration_s, 1.5 * SPACING_M)))
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as told:
            status = cofix(["run", str(path), "--runtime", "processes", "--out", str(out)])
        if status != 0:
            raise RuntimeError(f"cofix run ended with status {status}: {told.getvalue()[-400:]}")
        summary = json.loads((out / "summary.json").read_text())
        return Processes(summary["timing"]["lag_max_s"], summary["timing"]["lag_p99_s"])
