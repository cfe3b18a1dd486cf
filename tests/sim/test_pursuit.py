"""A pursuit in the loop: detection, triangulation and formation, as it should be and when links and robots fail."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError
from sim.agents import agent_config
from sim.engine import TrialResult
from sim.invariants import InvariantChecker
from sim.metrics import summarize
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial


def made(*overrides: str) -> Scenario:
    return load("stt-pursuit", list(overrides))


def played(scenario: Scenario, seed: int) -> tuple[TrialResult, dict[str, Any]]:
    result = run_trial(scenario, seed, checker=InvariantChecker(seed))
    print(f"seed {seed}: {result.motion}")
    window_s = scenario.window_s[0], scenario.window_s[1]
    return result, summarize([result.trace], window_s, scenario.lost_above_m)["fleet"]


def test_pursuers_find_the_target_form_and_keep_their_formation() -> None:
    result, fleet = played(made("duration_s=14.0", "window_s=[8.0, 14.0]"), 3)
    motion = result.motion
    assert motion["formation_kept_share"] == 1.0
    assert motion["formation_error"] is not None and motion["formation_error"] < 0.1
    assert motion["bearing_angle_error_rad"] is not None and motion["bearing_angle_error_rad"] < 0.1
    assert motion["collisions"] == 0.0
    assert motion["target_min_distance_m"] is not None and motion["target_min_distance_m"] > 4.0
    assert fleet["target_position_rmse_m"] < 0.6
    assert fleet["target_anees"] < 1.5


def test_loss_and_a_crash_are_borne() -> None:
    """30 % of all messages are lost, and from 8 s on one robot is down: the two others keep the target between them."""
    scenario = made("duration_s=15.0", "window_s=[10.0, 15.0]", "links.loss=0.3")
    crash = {"kind": "crash", "robot": "m2", "at_s": 8.0}
    scenario = Scenario.model_validate({**scenario.model_dump(exclude_none=True), "faults": [crash]})
    result, _ = played(scenario, 4)
    motion = result.motion
    assert motion["formation_kept_share"] == 1.0
    assert motion["bearing_angle_error_rad"] is not None and motion["bearing_angle_error_rad"] < 0.15
    assert motion["collisions"] == 0.0
    hovers = result.trace.robots["m2"].truth[-4:, :3]
    assert np.ptp(hovers, axis=0).max() < 0.5, "its vehicle hovers once its last command is over"


def test_an_agent_is_told_what_its_vehicle_can_do() -> None:
    scenario = made("robots.m1.vehicle.max_climb_mps=1.5", "planning.radius_m=12.0")
    world = open_world(scenario, 1)
    planning = agent_config(scenario, world, scenario.robots[0]).settings(0).planning
    assert (planning.kind, planning.max_speed_mps, planning.max_climb_mps, planning.radius_m) == (
        "encircle",
        5.0,
        1.5,
        12.0,
    )


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["robots.m2.vehicle.flies=false", "robots.m2.vehicle.max_climb_mps=1.0"], r"m2.*set vehicle.flies = true"),
        (["robots.m1.vehicle.min_speed_mps=0.5"], "leave min_speed_mps and turns out"),
        (["robots.m1.vehicle.turns=after"], "leave min_speed_mps and turns out"),
        (["planning.closest_m=11.0"], r"closest_m = 11 is not below planning.radius_m = 10"),
        (["targets.t1.course.min_altitude_m=9.0"], r"min_altitude_m = 9 is above the start at 6"),
    ],
)
def test_what_cannot_be_is_refused_with_key_and_remedy(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        made(*overrides)
