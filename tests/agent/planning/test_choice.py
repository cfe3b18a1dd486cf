"""Settings name a planner, and all of them reach it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest

from agent.planning.choice import build_planner
from agent.planning.potential import PotentialPlanner
from agent.planning.situation import Command, Situation
from agent.settings import PlanningSettings
from tests.agent.planning.field import member, view


def chosen(settings: PlanningSettings, situation: Situation) -> Command:
    planner = build_planner(settings, "r1")
    assert planner is not None
    return planner.command(situation)


def test_none_is_no_planner() -> None:
    assert build_planner(PlanningSettings(), "r1") is None


def test_the_potential_law_has_the_distances_of_the_settings() -> None:
    made = build_planner(
        PlanningSettings(
            kind="potential", closest_m=2.0, apart_m=3.0, radio_range_m=9.0, max_speed_mps=2.0, max_turn_radps=1.5
        ),
        "r1",
    )
    assert isinstance(made, PotentialPlanner)
    law = made.law
    assert (law.closest_m, law.apart_m, law.radio_range_m) == (2.0, 3.0, 9.0)
    assert (law.max_speed_mps, law.max_turn_radps) == (2.0, 1.5)


@pytest.mark.parametrize("kind", ["potential", "optimal"])
def test_the_vehicle_s_limits_are_used_up_and_kept(kind: Literal["potential", "optimal"]) -> None:
    settings = PlanningSettings(kind=kind, max_speed_mps=1.4, max_turn_radps=0.2)
    ahead = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([40.0, 0.0, 0.0])))
    assert chosen(settings, ahead).speed_mps == pytest.approx(1.4)
    aside = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([0.0, 40.0, 0.0])))
    assert chosen(settings, aside).yaw_rate_radps == pytest.approx(0.2)


def test_the_sensor_of_the_settings_decides_what_is_near_enough() -> None:
    """A target 11.5 m ahead is near enough for a sensor of 15 m and more, and not for one of 10 m."""
    seen = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([11.5, 0.0, 3.1])))
    far_sighted = PlanningSettings(kind="optimal")
    assert chosen(far_sighted, seen).speed_mps == 0.0
    near_sighted = replace(far_sighted, sensing=replace(far_sighted.sensing, max_range_m=10.0))
    assert chosen(near_sighted, seen).speed_mps > 0.3
