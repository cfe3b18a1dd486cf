"""Scenarios of robots that choose their motion: what an agent is told, and what is refused with a remedy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError
from agent.settings import PlanningSettings, RoundSettings
from sim.agents import agent_config
from sim.invariants import InvariantChecker
from sim.metrics import nees, summarize
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized


def made(*overrides: str, name: str = "ut-clat") -> Any:
    return load(name, list(overrides))


def planning(*overrides: str, seed: int = 7, robot: int = 0) -> PlanningSettings:
    scenario = made(*overrides)
    world = open_world(scenario, seed)
    return agent_config(scenario, world, scenario.robots[robot]).settings(0).planning


WIDE = "links.range_m=30.0"
STILL = "robots.*.control={}"
CAMERA = (
    'robots.*.sensors.eye={kind="range_bearing", of=["peers","targets"], sigma_m=0.01, sigma_m_per_m=0.05, '
    "sigma_rad=0.02, min_range_m=1.5, max_range_m=12.0, fov_rad=1.2}"
)


def test_what_is_not_stated_follows_from_vehicle_noise_sensor_links_and_seed() -> None:
    found = planning(
        "planning.kind=optimal",
        STILL,
        CAMERA,
        "links.range_m=25.0",
        "robots.*.vehicle={max_speed_mps=0.8, max_turn_radps=0.9}",
        "robots.*.noise={speed_share=0.03, yaw_rate_per_mps=0.04}",
        seed=11,
    )
    assert (found.kind, found.max_speed_mps, found.max_turn_radps, found.seed) == ("optimal", 0.8, 0.9, 11)
    assert (found.speed_share, found.heading_rad_per_m, found.radio_range_m) == (0.03, 0.04, 25.0)
    eye = found.sensing
    assert (eye.min_range_m, eye.max_range_m, eye.fov_rad) == (1.5, 12.0, 1.2)
    assert (eye.sigma_m, eye.sigma_m_per_m, eye.sigma_rad) == (0.01, 0.05, 0.02)


def test_what_is_stated_comes_first() -> None:
    found = planning(
        "planning={kind='optimal', max_speed_mps=0.3, seed=5, radio_range_m=40.0, speed_share=0.5}",
        "planning.sensing={max_range_m=6.0}",
        STILL,
        CAMERA,
    )
    assert (found.max_speed_mps, found.seed, found.radio_range_m, found.speed_share) == (0.3, 5, 40.0, 0.5)
    assert (found.sensing.max_range_m, found.sensing.min_range_m) == (6.0, PlanningSettings().sensing.min_range_m)


def test_a_sensor_that_looks_everywhere_and_far_is_taken_so() -> None:
    endless = 'robots.*.sensors.eye={kind="range_bearing", of=["targets"], sigma_m=0.1, sigma_rad=0.02}'
    eye = planning("planning.kind=optimal", STILL, endless, WIDE).sensing
    assert (eye.min_range_m, eye.max_range_m, eye.fov_rad) == (0.0, 1000.0, 2.0 * math.pi)


def test_a_robot_may_have_planning_of_its_own() -> None:
    overrides = ("planning.kind=random", STILL, "robots.r2.planning={kind='none'}")
    assert [planning(*overrides, robot=index).kind for index in (0, 1, 2)] == ["random", "none", "random"]
    assert "r2" not in [robot.id for robot in made(*overrides).planners()]


def test_rounds_are_those_of_the_scenario() -> None:
    scenario = made("round={period_s=2.0, wait_s=0.5, lean=true}")
    config = agent_config(scenario, open_world(scenario, 1), scenario.robots[0])
    assert config.settings(0).round == RoundSettings(period_ns=2_000_000_000, wait_ns=500_000_000, lean=True)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["planning.kind=random"], r"robots\.r1\.control is not used with planning\.kind = 'random'; leave it out"),
        (
            ["planning.kind=optimal", STILL, WIDE],
            r"'optimal' predicts what is seen.*'range_bearing' sees targets; add one, or state planning\.sensing",
        ),
        (
            ["planning.kind=random", STILL, "robots.*.vehicle.min_speed_mps=2.0"],
            r"robots\.r1\.vehicle\.min_speed_mps = 2 is above max_speed_mps = 0\.5; lower it",
        ),
        (
            ["planning.kind=potential", STILL, "links.range_m=8.0"],
            r"planning\.apart_m = 10 is not below planning\.radio_range_m = 8.*which is links\.range_m",
        ),
        (["round.wait_s=3.0"], r"round\.wait_s = 3 is not below round\.period_s = 1"),
        (
            ["robots.r3.localization.kind=jlatt"],
            r"robots\.r1\.localization\.kind = 'clat' beside 'jlatt': who takes no part in rounds.*one kind",
        ),
        (["localization.kind=jlatt", "localization.form=safe"], r"form = 'safe' is of kind 'clat'.*leave form out"),
    ],
)
def test_what_cannot_be_is_refused_with_key_and_remedy(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        made(*overrides)


MIXED = """
extends = "ajlatt"
name = "mixed"
duration_s = 30.0
window_s = [5.0, 30.0]
[[robots]]
id = "r2"
model = "unicycle_gains"
start_sigma = { gain_along = 0.05, gain_turn = 0.05 }
[[robots]]
id = "r3"
model = "planar_altitude"
start = { pose = [-6.0, 13.0, 1.0, 0.0], spread = [0.5, 0.5, 0.2, 1.0], error = [0.0, 0.0, 0.0, 0.0] }
start_sigma = { altitude_m = 0.1 }
noise = { climb_mps = 0.01 }
[[targets]]
id = "t1"
model = "constant_velocity"
start = { pose = [10.0, 5.0, 0.25, 0.0], error = [0.0, 5.0, 0.0, 0.0] }
start_sigma = { velocity_mps = 0.2 }
noise = { acceleration_mps2 = 0.01 }
"""


def test_robots_and_targets_of_any_model_take_part_in_rounds(tmp_path: Path) -> None:
    file = tmp_path / "mixed.toml"
    file.write_text(MIXED)
    result = run_trial(load(str(file)), 1, checker=InvariantChecker(1))
    for robot, counters in result.counters.items():
        assert counters["round.closed"] >= 30, robot
    for robot in ("r2", "r3"):
        assert result.counters[robot]["round.used_detections"] > 0, robot
    for robot, trace in result.trace.robots.items():
        assert float(np.nanmean(nees(trace))) < 1.7, robot


def test_a_start_beside_a_peer_is_not_of_rounds() -> None:
    with pytest.raises(ConfigError, match=r"source = 'peer' does not go with kind = 'jlatt'.*take 'fix' or 'survey'"):
        made("robots.r2.start_source=peer", name="ajlatt")


def test_planning_is_not_of_steered_nor_of_recorded_worlds() -> None:
    with pytest.raises(ConfigError, match=r"does not go with world\.steering.*leave one of them out"):
        made("planning.kind=random", name="dense-6")
    with pytest.raises(ConfigError, match=r"does not go with a recording.*planning\.kind = 'none'"):
        made("planning.kind=random", "world.path=anywhere", name="utias-all")


def test_a_fleet_of_rounds_is_accepted() -> None:
    scenario = made("localization.kind=jlatt", "localization.weights=trace")
    assert {scenario.localization_of(robot).kind for robot in scenario.robots} == {"jlatt"}


@pytest.mark.parametrize("name", ["ajlatt", "ajlatt-replica"])
def test_a_team_that_plans_finds_its_target_and_claims_no_more_than_it_knows(name: str) -> None:
    seconds = sized(20, 300)
    result = run_trial(made(f"duration_s={seconds}", name=name), 41)
    fleet = summarize([result.trace], (5.0, seconds), 1000.0)["fleet"]
    assert fleet["target_position_rmse_m"] < 1.0, "the prior is 5 m off in each direction"
    assert fleet["anees"] < 1.5
    assert fleet["target_anees"] < 1.5
    distance = result.motion["min_distance_m"]
    assert distance is not None and distance > 2.0
    assert result.motion["connected_share"] == 1.0
