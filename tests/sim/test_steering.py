"""Steered worlds: motion on true places, and cameras that see a part of their surroundings only."""

from __future__ import annotations

import numpy as np
import pytest

from agent.config_file import ConfigError
from agent.estimation.gaussian import wrap
from agent.estimation.motion import compose
from sim.scenario_file import load
from sim.world import SimulatedWorld

SHORT = ["duration_s=40.0", "window_s=[10, 40]"]
NAMES = ("dense-6", "dense-6-anchored", "dense-10", "dense-10-anchored")


@pytest.mark.parametrize("name", NAMES)
def test_robots_keep_around_the_target_and_off_each_other(name: str) -> None:
    scenario = load(name, SHORT)
    world = SimulatedWorld(scenario, 3)
    places = np.stack([[world.truth(robot, k)[:2] for k in range(world.steps + 1)] for robot in world.robots])
    target = np.array([world.truth("t1", k)[:2] for k in range(world.steps + 1)])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[~np.eye(len(places), dtype=bool)]
    assert apart[:, 20:].min() > 1.0
    assert np.linalg.norm(places - target, axis=-1)[:, 20:].max() < 25.0
    assert apart.max() < 30.0, "all are in reach of each other"


def test_odometry_tells_the_commands_and_the_truth_differs_by_the_stated_noise() -> None:
    world = SimulatedWorld(load("dense-6", SHORT), 3)
    errors = []
    for k in range(1, world.steps + 1):
        for item in world.outputs(k):
            if item.kind == "odometry":
                told = compose(world.truth(item.robot, k - 1), item.z[[0, 1, 3]])
                difference = world.truth(item.robot, k) - told
                assert np.abs(difference[:2]).max() < 0.05
                errors.append(float(wrap(difference[2])) ** 2 / item.R[3, 3])
    assert np.mean(errors) == pytest.approx(1.0, abs=0.3)


def test_a_camera_sees_what_is_in_its_field_of_view() -> None:
    scenario = load("dense-6", SHORT)
    camera = scenario.robots[0].sensors["camera"]
    world = SimulatedWorld(scenario, 3)
    seen: set[tuple[str, str, int]] = set()
    for k in range(1, world.steps + 1):
        seen |= {(item.robot, item.of or "", k) for item in world.outputs(k) if item.kind == "range_bearing"}
    assert camera.fov_rad is not None
    assert camera.max_range_m is not None
    for k in range(1, world.steps + 1):
        for robot in world.robots:
            pose = world.truth(robot, k)
            for of in (*world.robots, "target:t1"):
                if of == robot:
                    continue
                d = world.truth(of.removeprefix("target:"), k)[:2] - pose[:2]
                azimuth, distance = float(wrap(np.arctan2(d[1], d[0]) - pose[2])), float(np.hypot(*d))
                inside = abs(azimuth) <= camera.fov_rad / 2.0
                inside = inside and camera.min_range_m <= distance <= camera.max_range_m
                assert ((robot, of, k) in seen) == inside


@pytest.mark.parametrize(
    ("override", "names"),
    [
        ("robots.r01.control={speed_mps=1.0}", "robots.r01.control"),
        ("robots.r01.model=quadrotor", "robots.r01"),
        ("targets=[]", "targets"),
        ("world.steering.rule=optimal", "world.steering.rule"),
        ("world.steering.max_sped_mps=1.0", "max_speed_mps"),
    ],
)
def test_what_can_not_be_steered_is_refused(override: str, names: str) -> None:
    with pytest.raises(ConfigError, match=names.replace(".", r"\.")):
        load("dense-6", [override])


def test_starts_are_spread_as_stated() -> None:
    scenario = load("dense-6", SHORT)
    starts = np.array([SimulatedWorld(scenario, seed).truth("r01", 0) for seed in range(12)])
    pose, spread = scenario.robots[0].start.pose, scenario.robots[0].start.spread
    assert np.all(np.abs(starts - pose) <= spread)
    assert np.all(np.ptp(starts, axis=0) > 0.5 * np.array(spread))
