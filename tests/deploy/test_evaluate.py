"""Figures from recordings of processes: the same as the engine's, also of robots that start late."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from agent.recording import RecordingWriter
from deploy.evaluate import collect
from deploy.launch import Outcome
from sim.agents import agent_config
from sim.trial import open_world, run_trial
from tests.sim.test_starts import beginners


def test_recordings_give_the_traces_of_the_engine_and_nothing_before_a_robot_has_started(tmp_path: Path) -> None:
    made = beginners("fix", "split_joint")
    world = open_world(made, 3)
    (tmp_path / "agents").mkdir()
    writers = {}
    for robot in made.robots:
        writers[robot.id] = RecordingWriter(tmp_path / "agents" / f"{robot.id}.mcap")
        writers[robot.id].add_robot(agent_config(made, world, robot), 0)
    recorders = {name: partial(writer.record, name) for name, writer in writers.items()}
    played = run_trial(made, 3, recorders=recorders, world=world).trace
    for writer in writers.values():
        writer.close()
    found = collect(made, world, tmp_path, Outcome({}, {}, {}, 0, False, []), False).trace
    late = np.isnan(played.robots["r2"].mean).any(axis=1)
    assert 2 <= late.sum() <= 6
    for name, trace in played.robots.items():
        np.testing.assert_array_equal(np.isnan(found.robots[name].mean), np.isnan(trace.mean))
        np.testing.assert_allclose(found.robots[name].mean, trace.mean)
