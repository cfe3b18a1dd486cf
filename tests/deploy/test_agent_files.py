"""The files of the agents of a run: what one computer for all of them costs is waited for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agent.config import AgentConfig
from agent.config_file import ConfigError
from deploy.agent_files import Host, agent_file
from deploy.launch import Launcher
from sim.host import HostPlan
from sim.scenario_file import load
from sim.trial import open_world


def tables_of(speed: float, *overrides: str) -> dict[str, Any]:
    scenario = load("ajlatt", list(overrides))
    plan = HostPlan("", 1, speed, "/tmp/control", "tcp/127.0.0.1:7000", {"r1": 7001}, {}, "")
    ports = {robot.id: 7100 + 2 * k for k, robot in enumerate(scenario.robots)}
    world = open_world(scenario, 1)
    return agent_file(scenario, world, scenario.robots[0], 1, speed, plan, Path("run"), Path("state"), ports, {})


@pytest.mark.parametrize(
    ("speed", "settle_s", "odometry_wait_s", "round_wait_s"),
    [(1.0, 0.015, 1.0, 0.2), (5.0, 0.075, 1.5, 0.225), (10.0, 0.15, 3.0, 0.45), (40.0, 0.6, 12.0, 0.45)],
)
def test_the_faster_the_run_the_longer_are_data_waited_for(
    speed: float, settle_s: float, odometry_wait_s: float, round_wait_s: float
) -> None:
    tables = tables_of(speed)
    assert tables["lateness"]["settle_s"] == pytest.approx(settle_s)
    assert tables["lateness"]["odometry_wait_s"] == pytest.approx(odometry_wait_s)
    assert tables["round"]["wait_s"] == pytest.approx(round_wait_s)
    AgentConfig.model_validate(tables)


def test_what_the_scenario_waits_for_longer_is_kept() -> None:
    tables = tables_of(10.0, "round.wait_s=0.6", "lateness.settle_s=0.5", "lateness.odometry_wait_s=4.0")
    assert (tables["round"]["wait_s"], tables["lateness"]["settle_s"]) == (0.6, 0.5)
    assert tables["lateness"]["odometry_wait_s"] == 4.0


@pytest.mark.parametrize("links", ["{range_m=30.0}", "{nearest=2}", "{rewire=2}"])
def test_who_is_out_of_hearing_is_learnt_from_the_world(links: str, tmp_path: Path) -> None:
    injection = AgentConfig.model_validate(tables_of(1.0, f"links={links}")).injection
    assert injection is not None
    assert injection.links.settings(injection.seed).limited
    assert injection.table == "tcp/127.0.0.1:7000"
    scenario, key = load("ajlatt", [f"links={links}"]), links[1:].partition("=")[0]
    with pytest.raises(ConfigError, match=f"links.{key}: who hears whom cannot be told"):
        Launcher(scenario, open_world(scenario, 1), 1, 1.0, tmp_path, {"r1": Host("ns1", "10.0.0.1")})
