"""From a scenario to the file of each agent: what the desk runs is what a robot would be given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tomli_w

from agent.config import load_agent_config
from agent.estimation.mounting import planar_mount
from sim.agents import agent_config, agent_tables, odometry_table, table
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.sensor_noise import control_odometry
from sim.trial import open_world


def configured(*overrides: str) -> tuple[Scenario, dict[str, Any]]:
    made = load("ut-clat", list(overrides))
    world = open_world(made, 3)
    return made, {robot.id: agent_config(made, world, robot) for robot in made.robots}


def test_every_agent_is_given_its_own_start_and_the_common_targets() -> None:
    made, configs = configured()
    world = open_world(made, 3)
    target, _ = world.start_belief("t1")
    for robot, config in configs.items():
        mean, cov = world.start_belief(robot)
        settings = config.settings(0)
        assert (settings.robot, config.identity.incarnation) == (robot, 1)
        np.testing.assert_array_equal(settings.mean, mean)
        np.testing.assert_allclose(settings.cov, cov)
        np.testing.assert_array_equal(settings.targets[0].mean, target)
        assert settings.targets[0].motion.control == (0.05, 0.0)
        assert settings.targets[0].motion.noise_step_s == made.step_s


def test_nothing_of_the_truth_is_in_an_agents_file() -> None:
    made = load("ut-clat")
    world = open_world(made, 3)
    for robot in made.robots:
        text = tomli_w.dumps(agent_tables(made, world, robot))
        for entity in (*world.robots, *world.targets):
            for value in world.truth(entity, 0)[:2]:
                # A target's start is round; the drawn beliefs never are.
                assert entity == "t1" or repr(float(value)) not in text


def test_parts_overridden_for_one_robot_reach_it_alone() -> None:
    _, configs = configured(
        "robots.r2.localization.form=published",
        "robots.r3.lateness.kind=discard",
        "robots.r4.tracking.kind=none",
        "robots.r2.sensors.range.mount=[0.1, 0.2, 0.3]",
        "robots.r3.sensors.range.two_way=false",
    )
    forms = {name: config.localization.form for name, config in configs.items()}
    assert forms == {"r1": "auto", "r2": "published", "r3": "auto", "r4": "auto"}
    assert [config.lateness.kind for config in configs.values()] == [
        "compensate",
        "compensate",
        "discard",
        "compensate",
    ]
    assert [config.settings(0).track for config in configs.values()] == [True, True, True, False]
    assert configs["r2"].sensor_configs()["range"].mount == planar_mount(0.1, 0.2, 0.3)
    assert configs["r3"].settings(0).one_way_sensors == ("range",)
    assert configs["r1"].sensors["target_range"].kind == "range"


@pytest.mark.parametrize("name", ["demo", "ut-clat"])
def test_a_configuration_written_to_a_file_is_read_back_equal(name: str, tmp_path: Any) -> None:
    made = load(name)
    world = open_world(made, 3)
    for robot in made.robots:
        config = agent_config(made, world, robot)
        path = tmp_path / f"{robot.id}.toml"
        path.write_text(tomli_w.dumps(table(config)))
        assert load_agent_config(path) == config


def test_the_odometry_an_agent_assumes_is_that_of_the_world_without_its_gains() -> None:
    made = load("utias-all", ["world.path=/somewhere"])
    assumed = odometry_table(made, made.robots[0])
    stated = control_odometry(made.robots[0], made.step_s)
    assert (stated.scale_along, stated.lag_s) == (0.855, 0.22)
    assert not {"scale_along", "lag_s"} & set(assumed)
    for key, value in assumed.items():
        assert getattr(stated, key) == value
