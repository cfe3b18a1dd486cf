"""Figures from recordings of processes are those of the engine, also of late starters and sensors that lag."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from agent.recording import RecordingWriter
from deploy.evaluate import collect
from deploy.launch import Outcome
from sim.agents import agent_config
from sim.metrics import TrialTrace
from sim.scenario import Scenario
from sim.trial import open_world, run_trial
from tests.sim.test_recorded_world import changed, recorded
from tests.sim.test_recorded_world import scenario as recorded_scenario
from tests.sim.test_starts import beginners


def both(made: Scenario, seed: int, run_dir: Path) -> tuple[TrialTrace, TrialTrace]:
    """The traces the engine gives, and those found in what it recorded."""
    world = open_world(made, seed)
    (run_dir / "agents").mkdir()
    writers = {}
    for robot in made.robots:
        writers[robot.id] = RecordingWriter(run_dir / "agents" / f"{robot.id}.mcap")
        writers[robot.id].add_robot(agent_config(made, world, robot), 0)
    recorders = {name: partial(writer.record, name) for name, writer in writers.items()}
    played = run_trial(made, seed, recorders=recorders, world=world).trace
    for writer in writers.values():
        writer.close()
    return played, collect(made, world, run_dir, Outcome({}, {}, {}, 0, False, []), False).trace


def assert_alike(played: TrialTrace, found: TrialTrace) -> None:
    for name, trace in played.robots.items():
        np.testing.assert_array_equal(np.isnan(found.robots[name].mean), np.isnan(trace.mean))
        np.testing.assert_allclose(found.robots[name].mean, trace.mean)
        np.testing.assert_allclose(found.robots[name].cov, trace.cov)


def test_recordings_give_the_traces_of_the_engine_and_nothing_before_a_robot_has_started(tmp_path: Path) -> None:
    played, found = both(beginners("fix", "split_joint"), 3, tmp_path)
    late = np.isnan(played.robots["r2"].mean).any(axis=1)
    assert 2 <= late.sum() <= 6
    assert_alike(played, found)


@pytest.mark.parametrize("of", ["peers", "landmarks"])
def test_what_sensors_that_lag_tell_of_an_instant_later_is_no_estimate_of_it(tmp_path: Path, of: str) -> None:
    """Sightings a quarter and three quarters of a second after a sampled instant are of instants before it."""
    made = recorded_scenario(recorded(tmp_path), localization={"form": "safe"})
    robots = made.model_dump(exclude_none=True)["robots"]
    for robot in robots:
        robot["sensors"]["camera"] |= {"lag_s": 0.8, "of": [of]}
    played, found = both(changed(made, robots=robots), 1, tmp_path)
    assert_alike(played, found)
