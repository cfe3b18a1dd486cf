"""Robots that are killed and come back, in fleets that know nothing of it: nobody knows more than there is to know."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.fault_parts import made
from agent.recording import Life, RecordingWriter, read_lives, replay
from sim.agents import agent_config
from sim.engine import TrialResult
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized


def story(form: str, duration_s: float, *faults: dict[str, Any]) -> Scenario:
    """Three quadrotors that hardly turn: nobody's heading is lost while it coasts."""
    span = [f"duration_s={duration_s}", f"window_s=[0, {duration_s}]"]
    base = load("ut-clat-quadrotors", [f"localization.form={form}", "coast.yaw_rate_radps=0.06", *span])
    return base.model_copy(update={"faults": [made(**fault) for fault in faults]})


def crash(state: str, at_s: float = 15.0, for_s: float = 5.0) -> dict[str, Any]:
    return {"kind": "crash", "robot": "q2", "at_s": at_s, "for_s": for_s, "state": state}


def total(result: TrialResult, name: str) -> int:
    return sum(counters.get(name, 0) for counters in result.counters.values())


@pytest.mark.parametrize("state", ["kept", "lost"])
@pytest.mark.parametrize(("form", "seeds"), [("auto", (1,)), ("safe", tuple(range(1, sized(1, 6) + 1)))])
def test_nobody_is_overconfident_after_a_crash(form: str, seeds: tuple[int, ...], state: str) -> None:
    """NEES per degree of freedom of all robots after the return, over seeds."""
    found = []
    for seed in seeds:
        result = run_trial(story(form, 35.0, crash(state)), seed)
        late = result.trace.t_s > 21.0
        found += [float(np.nanmean(nees(trace)[late])) for trace in result.trace.robots.values()]
        if form != "auto":
            # With its factors nothing is begun anew; without, each of the two peers does so once.
            assert total(result, "pair.restarts") == (0 if state == "kept" else 2), f"seed {seed}"
            assert total(result, "pair.resumed") == (2 if state == "kept" else 0), f"seed {seed}"
            assert total(result, "pair.fallback") == 0, f"seed {seed}"
    assert np.mean(found) < 1.5 and max(found) < 4.0, f"seeds {seeds}: {found}"


def test_nobody_is_overconfident_after_a_name_was_borne_twice() -> None:
    """q2 is held to be over, goes on in a life that follows, and each of its peers begins anew with it."""
    seeds, found = range(1, sized(2, 6) + 1), []
    for seed in seeds:
        stranger = {"kind": "forge", "claims": "q2", "content": "stranger", "rate_hz": 1.7, "at_s": 12.0, "for_s": 3.0}
        result = run_trial(story("safe", 35.0, stranger), seed)
        late = result.trace.t_s > 21.0
        found += [float(np.nanmean(nees(trace)[late])) for trace in result.trace.robots.values()]
        assert total(result, "pair.restarts") == 2, f"seed {seed}"
    assert np.mean(found) < 1.5 and max(found) < 4.0, f"seeds {seeds}: {found}"


@pytest.mark.parametrize("state", ["kept", "lost"])
def test_fifty_starts_in_a_minute_inflate_nobody_further(state: str) -> None:
    crashes = [crash(state, 5.0 + 1.1 * k, 0.4) for k in range(50)]
    found = run_trial(story("safe", 62.0, *crashes), 2)
    alone = run_trial(story("safe", 62.0, {"kind": "isolate", "robot": "q2", "at_s": 5.0}), 2)
    for robot in ("q1", "q3"):
        assert found.counters[robot].get("pair.restarts", 0) <= (0 if state == "kept" else 1)
        wide, bound = (np.trace(result.trace.robots[robot].cov[-1][:2, :2]) for result in (found, alone))
        assert wide < 2.5 * bound


def test_a_recording_over_several_lives_plays_back_bit_for_bit(tmp_path: Path) -> None:
    """A life that follows in the same process, when a stranger with its name is gone, and two crashes."""
    stranger = {"kind": "forge", "claims": "q2", "content": "stranger", "rate_hz": 1.7, "at_s": 5.0, "for_s": 3.0}
    scenario = story("safe", 26.0, stranger, crash("kept", 14.0, 2.0), crash("lost", 20.0, 2.0))
    world = open_world(scenario, 1)
    writer = RecordingWriter(tmp_path / "run.mcap")
    recorders = {}
    for robot in scenario.robots:
        writer.add_robot(agent_config(scenario, world, robot), 0)
        recorders[robot.id] = lambda event, effects, name=robot.id: writer.record(name, event, effects)
    run_trial(scenario, 1, recorders=recorders, life_sink=writer.begin_life)
    writer.close()
    lives = [what for what in read_lives(tmp_path / "run.mcap", "q2") if isinstance(what, Life)]
    assert [life.state is not None for life in lives] == [True, True, False]
    for robot in scenario.robots:
        assert replay(tmp_path / "run.mcap", robot.id)[2] is None
