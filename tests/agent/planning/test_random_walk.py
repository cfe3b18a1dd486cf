"""Random motion: within the limits, spread over them, and named by seed, robot and choice alone."""

from __future__ import annotations

import numpy as np

from agent.planning.choice import build_planner
from agent.planning.situation import Situation
from agent.settings import PlanningSettings
from tests.agent.planning.field import member, view

SETTINGS = PlanningSettings(kind="random", max_speed_mps=0.7, max_turn_radps=0.4)


def turns(robot: str, seed: int, count: int = 400) -> np.ndarray:
    planner = build_planner(PlanningSettings(kind="random", max_speed_mps=0.7, max_turn_radps=0.4, seed=seed), robot)
    assert planner is not None
    found = [planner.command(Situation(k, 1.0, member(robot, [0.0, 0.0, 0.0]))) for k in range(count)]
    assert {command.speed_mps for command in found} == {0.7}
    return np.array([command.yaw_rate_radps for command in found])


def test_speed_is_full_and_yaw_rates_are_uniform_within_the_limits() -> None:
    found = turns("r1", 0)
    assert np.all(np.abs(found) <= 0.4)
    counts = np.histogram(found, bins=8, range=(-0.4, 0.4))[0]
    # Chi square with 7 degrees of freedom; 26 is passed once in 2000 draws.
    assert ((counts - 50.0) ** 2 / 50.0).sum() < 26.0
    assert abs(np.corrcoef(found[1:], found[:-1])[0, 1]) < 0.2


def test_a_draw_is_named_by_seed_robot_and_choice() -> None:
    first = turns("r1", 0, 20)
    assert np.array_equal(first, turns("r1", 0, 20))
    assert np.array_equal(first[:5], turns("r1", 0, 5))
    for other in (turns("r2", 0, 20), turns("r1", 1, 20)):
        assert not np.isin(other, first).any()


def test_it_looks_at_nothing() -> None:
    planner = build_planner(SETTINGS, "r1")
    assert planner is not None
    alone = Situation(7, 1.0, member("r1", [0.0, 0.0, 0.0]))
    crowded = Situation(7, 1.0, member("r1", [1.0, 2.0, 3.0], view([1.0, 2.0, 0.0])), (member("r2", [1.1, 2.0, 0.0]),))
    assert planner.command(alone) == planner.command(crowded)
