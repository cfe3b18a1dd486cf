"""A complete example of tests of one's own fleet: what is played here may be any scenario file."""

from __future__ import annotations

import math

import pytest

from agent.config_file import ConfigError
from deploy.testing import FleetMaker, fleet
from sim.invariants import InvariantBreach

__all__ = ["fleet"]

OWN = "fault-plan"
QUIET = "fault_plan.intensity=calm"


def test_a_partition_is_survived_and_forgotten(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET, "fault_plan.processes=false")
    robots.run_for(8.0)
    together = robots.status("r3")["pairs"]
    robots.partition(["r1", "r2"], ["r3", "r4", "r5"])
    robots.run_for(8.0)
    assert robots.status("r3")["pairs"]["r1"] <= together["r1"] + 2_000_000_000
    robots.heal()
    robots.run_for(10.0)
    assert robots.status("r3")["pairs"]["r1"] > 16_000_000_000
    robots.assert_consistent()


@pytest.mark.parametrize("runtime", ["virtual", pytest.param("processes", marks=pytest.mark.realtime)])
def test_one_story_in_virtual_time_and_in_real_processes(fleet: FleetMaker, runtime: str) -> None:
    """`speed` makes the example short; without it real processes take the time the world does."""
    speed = 2.5 if runtime == "processes" else 1.0
    robots = fleet(OWN, QUIET, "fault_plan.processes=false", "duration_s=90.0", runtime=runtime, speed=speed, seed=3)
    robots.run_until(4.0)
    cut = robots.partition(["r1", "r2"], ["r3", "r4", "r5"])
    robots.link("r3", "r4").loss = 0.5
    robots.kill("r5")
    robots.run_for(1.0)
    since_ns = robots.status("r3")["pairs"]["r1"]
    assert robots.status("r5") == {} and robots.status("r1")["state"] == "running"
    robots.run_until(9.0)
    assert robots.status("r3")["pairs"]["r1"] == since_ns
    robots.heal()
    assert not robots.end(cut)
    robots.run_for(6.0)
    assert robots.status("r3")["pairs"]["r1"] > since_ns + 1_000_000_000
    assert math.isnan(robots.error_m("r5")) and robots.error_m("r3") < 5.0
    robots.assert_consistent()


def test_a_killed_robot_is_gone_and_comes_back(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET, seed=3)
    robots.run_for(6.0)
    robots.kill("r3", for_s=6.0, state="lost")
    robots.run_for(3.0)
    assert robots.status("r3") == {} and math.isnan(robots.error_m("r3"))
    robots.run_for(12.0)
    assert robots.status("r3")["state"] == "running" and robots.error_m("r3") < 3.0
    robots.assert_consistent()


def test_a_link_gets_worse_and_better(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET)
    link = robots.link("r2", "r1")
    robots.run_for(4.0)
    link.loss, link.delay_s = 1.0, 0.2
    assert robots.link("r1", "r2").loss == 1.0
    robots.run_for(6.0)
    silent_since = robots.status("r2")["pairs"]["r1"]
    assert silent_since < 6_000_000_000
    link.loss = 0.0
    robots.run_for(6.0)
    assert robots.status("r2")["pairs"]["r1"] > silent_since
    assert link.loss == 0.0 and link.delay_s == 0.2


def test_pauses_sensor_faults_and_isolation_leave_the_fleet_honest(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET, seed=2)
    robots.run_for(5.0)
    robots.pause("r2", for_s=4.0)
    robots.inject("sensor_dropout", robot="r1", sensor="position", for_s=10.0)
    robots.isolate("r4", for_s=5.0)
    robots.restart("r5")
    robots.run_for(25.0)
    assert robots.t_s == 30.0
    robots.assert_consistent()


def test_invariants_may_be_watched(fleet: FleetMaker, monkeypatch: pytest.MonkeyPatch) -> None:
    robots = fleet(OWN, check=True)
    robots.run_for(2.0)
    monkeypatch.setattr("sim.invariants.MAX_COUNTERS", 0)
    with pytest.raises(InvariantBreach, match="counters"):
        robots.run_for(2.0)


def test_two_fleets_of_one_seed_are_the_same(fleet: FleetMaker) -> None:
    one, two = fleet(OWN, seed=9), fleet(OWN, seed=9)
    for robots in (one, two):
        robots.run_for(10.0)
        robots.kill("r1", for_s=2.0)
        robots.run_for(10.0)
    assert [one.error_m(robot) for robot in one.robots] == [two.error_m(robot) for robot in two.robots]


def test_what_makes_no_sense_is_refused_with_the_remedy(fleet: FleetMaker) -> None:
    robots = fleet(OWN)
    with pytest.raises(ConfigError, match="there are: r1, r2"):
        robots.kill("r9")
    with pytest.raises(KeyError, match="r9"):
        robots.link("r1", "r9")
    with pytest.raises(ConfigError, match="share"):
        robots.inject("loss", share=2.0)
    with pytest.raises(ConfigError, match="kind"):
        robots.inject("earthquake")
    with pytest.raises(ConfigError, match="r1 has no sensor 'sonar'"):
        robots.inject("sensor_dropout", robot="r1", sensor="sonar")
    with pytest.raises(ConfigError, match="virtual, processes"):
        fleet(OWN, runtime="field")
    with pytest.raises(ConfigError, match="speed is for runtime='processes'"):
        fleet(OWN, speed=2.0)
    with pytest.raises(ConfigError, match="check is for runtime='virtual'"):
        fleet(OWN, runtime="processes", check=True)


def test_an_overconfident_robot_is_found(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET)
    robots.run_for(5.0)
    with pytest.raises(AssertionError, match=r"overconfident.*seed 1"):
        robots.assert_consistent(limit=0.01)


def test_a_robot_that_said_nothing_is_not_taken_for_honest(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET)
    robots.run_for(2.0)
    robots.kill("r2")
    robots.run_for(6.0)
    with pytest.raises(AssertionError, match="r2 had no estimate"):
        robots.assert_consistent(since_s=4.0)


def test_a_value_that_is_refused_leaves_the_link_as_it_was(fleet: FleetMaker) -> None:
    robots = fleet(OWN, QUIET)
    link = robots.link("r1", "r2")
    link.loss = 0.5
    with pytest.raises(ConfigError, match="share"):
        link.loss = 2.0
    assert link.loss == 0.5
    link.loss = 0.0
    assert link.loss == 0.0
