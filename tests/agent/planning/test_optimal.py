"""The choice by predicted beliefs: its costs, its search, and robots that follow it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from agent.planning.choice import build_planner
from agent.planning.optimal import Objective, Search, spacing_cost
from agent.planning.prediction import Prediction
from agent.planning.situation import Command, Member, Situation
from agent.planning.team_view import believers
from agent.settings import PlanningSettings
from tests.agent.planning.field import Field, member, view
from tests.agent.planning.test_prediction import COMMANDS, team

Form = Literal["improved", "published"]
FORMS: tuple[Form, ...] = ("improved", "published")


def optimal(form: Form = "improved", **others: object) -> PlanningSettings:
    return replace(PlanningSettings(kind="optimal", form=form), **others)  # type: ignore[arg-type]


def chosen(settings: PlanningSettings, situation: Situation) -> Command:
    planner = build_planner(settings, situation.own.robot)
    assert planner is not None
    return planner.command(situation)


def test_the_cost_of_a_distance_is_that_of_the_formula() -> None:
    """Figure 3.2: d from 2 m to 15 m, a = 2 m. Where it is infinite there, it is large here and falls outward."""
    distances = np.array([2.0 + 1e-9, 3.0, 4.0, 8.0, 13.0, 14.0, 15.0, 20.0])
    costs = spacing_cost(distances, 2.0, 15.0)
    assert np.allclose(costs, [-10 * np.log(0.5e-9), 10 * np.log(2.0), 0.0, 0.0, 0.0, 10.0, 40.0, 490.0])
    inner = spacing_cost(np.linspace(0.0, 4.0, 401), 2.0, 15.0)
    assert np.all(np.diff(inner) < 0.0) and inner[0] == 3e4 and inner[200] == 1e4
    outer = spacing_cost(np.linspace(13.0, 100.0, 500), 2.0, 15.0)
    assert np.all(np.diff(outer) > 0.0)


@pytest.mark.parametrize("form", FORMS)
def test_the_objective_of_a_batch_is_that_of_a_loop(form: Form) -> None:
    """Traces are those of the prediction; J is summed here candidate by candidate, body by body, instant by instant."""
    settings = optimal(form, potential_weight=0.7, self_weight=0.3, target_weight=0.9)
    for seed in range(4):
        situation = team(np.random.default_rng(seed), 4)
        costs = Objective(settings, situation)(COMMANDS)
        prediction = Prediction(settings, situation, believers(situation, present=form == "improved"))
        found = prediction.of(COMMANDS)
        for c, (speed, turn) in enumerate(COMMANDS):
            x, y, th = situation.own.pose
            J = 0.0
            for instant in range(5):
                x, y, th = x + speed * np.cos(th), y + speed * np.sin(th), th + turn
                if form == "published" and instant < 4:
                    continue
                bodies = [(other.pose, other.cov, other.speed_mps, other.yaw_rate_radps) for other in situation.others]
                for pose, cov, v, w in bodies:
                    headings = pose[2] + w * np.arange(instant + 1)
                    place = pose[:2] + v * np.array([np.cos(headings).sum(), np.sin(headings).sum()])
                    least = 2.0
                    if form == "improved":
                        ahead = prediction.others.covs[[np.array_equal(cov, o.cov) for o in situation.others]][0]
                        sigma = np.sqrt(np.linalg.eigvalsh(ahead[:2, :2] + situation.own.cov[:2, :2])[-1])
                        least = 3.0 + min(2.0 * sigma, 1.0)
                    J += float(spacing_cost(np.hypot(*(place - [x, y])), least, 30.0))
                target = situation.own.targets[0].mean
                place = target[:2] + 0.25 * (instant + 1) * np.array([np.cos(target[2]), np.sin(target[2])])
                least = 2.0
                if form == "improved":
                    widest = np.linalg.eigvalsh(prediction.targets[0].place_cov + situation.own.cov[:2, :2])[-1]
                    least = 3.0 + min(2.0 * np.sqrt(widest), 1.0)
                J += float(spacing_cost(np.hypot(*(place - [x, y])), least, 14.0 if form == "improved" else 20.0))
            J /= 5.0 if form == "improved" else 1.0
            expected = 0.3 * found.own[c] + 0.9 * found.targets[c] + 0.7 * J
            assert costs[c] == pytest.approx(expected, rel=1e-6, abs=1e-5), seed


@pytest.mark.parametrize("form", FORMS)
def test_a_mirrored_situation_has_mirrored_costs(form: Form) -> None:
    mirror = np.array([1.0, -1.0, -1.0])

    def mirrored(one: Member) -> Member:
        views = tuple(view(item.mean * mirror, _flipped(item.cov, mirror)) for item in one.targets)
        return Member(
            one.robot, one.pose * mirror, _flipped(one.cov, mirror), one.speed_mps, -one.yaw_rate_radps, views
        )

    for seed in range(4):
        situation = team(np.random.default_rng(seed), 4)
        other = Situation(0, 1.0, mirrored(situation.own), tuple(mirrored(one) for one in situation.others))
        first = Objective(optimal(form), situation)(COMMANDS)
        second = Objective(optimal(form), other)(COMMANDS * [1.0, -1.0])
        assert np.allclose(first, second, rtol=1e-9), seed


def _flipped(cov: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    return cov * np.outer(mirror, mirror)


@pytest.mark.parametrize("candidates", [6, 13, 14, 15, 21, 22, 30, 45, 60, 61, 82, 200])
def test_the_search_keeps_its_budget_and_the_limits(candidates: int) -> None:
    tried: list[np.ndarray] = []

    def cost(commands: np.ndarray) -> np.ndarray:
        tried.append(commands)
        return (commands[:, 0] - 0.41) ** 2 + (commands[:, 1] + 0.27) ** 2

    search = Search.within(candidates, 0.5, 0.6)
    speed, turn = search.best(cost)
    every = np.concatenate(tried)
    assert len(every) <= candidates
    assert len(every) > candidates - 22 or candidates > 82
    assert len(tried) <= 3
    assert every[:, 0].min() == 0.0 and every[:, 0].max() == 0.5 and np.abs(every[:, 1]).max() == pytest.approx(0.6)
    if candidates >= 61:
        assert len(tried) == 3
        assert abs(speed - 0.41) <= 0.5 / 16 + 1e-9 and abs(turn + 0.27) <= 0.6 / 16 + 1e-9


def test_the_search_of_the_default_budget_is_five_by_nine_and_two_rounds() -> None:
    assert Search.within(61, 0.5, 0.6) == Search(0.5, 0.6, 5, 2)
    with pytest.raises(ValueError, match=r"planning\.candidates = 5 .* at least 6"):
        build_planner(optimal(candidates=5), "r1")


def test_of_equal_commands_the_slowest_and_straightest_is_taken() -> None:
    search = Search.within(61, 0.5, 0.6)
    assert np.array_equal(search.best(lambda commands: np.zeros(len(commands))), [0.0, 0.0])
    assert np.array_equal(search.best(lambda commands: np.where(commands[:, 0] < 0.4, np.nan, 1.0)), [0.5, 0.0])


@pytest.mark.parametrize("form", FORMS)
def test_equal_situations_give_equal_commands_within_the_limits(form: Form) -> None:
    settings = optimal(form, max_speed_mps=0.8, max_turn_radps=0.3)
    for seed in range(5):
        first, second = (chosen(settings, team(np.random.default_rng(seed), 5)) for _ in range(2))
        assert first == second
        assert 0.0 <= first.speed_mps <= 0.8 and abs(first.yaw_rate_radps) <= 0.3


def test_the_own_uncertainty_costs_as_much_as_its_weight() -> None:
    """O1 (self weight 0) goes after a target out of bounds at any price; with a heavy self weight a robot stands."""
    seen = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([20.0, 0.0, 0.0])))
    light, heavy = (Objective(optimal("published", self_weight=weight), seen)(COMMANDS) for weight in (0.0, 0.2))
    own = Prediction(optimal("published"), seen, believers(seen, present=False)).of(COMMANDS).own
    assert np.allclose(heavy - light, 0.2 * own, rtol=0, atol=1e-12)
    assert chosen(optimal("published", self_weight=0.0), seen) == Command(0.5, 0.0)
    assert chosen(optimal("published", self_weight=1e7), seen).speed_mps == 0.0


def test_the_published_bound_lets_a_target_out_of_sight() -> None:
    """17 m off, ahead: the sensor ends at 15 m, but 18 m is free in the published form."""
    seen = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([16.0, 0.0, 0.0])))
    assert chosen(optimal("published"), seen).speed_mps == 0.0
    assert chosen(optimal("improved"), seen).speed_mps == 0.5


def test_who_faces_away_from_the_target_turns_on_the_spot() -> None:
    seen = Situation(0, 1.0, member("r1", [0.0, 0.0, 3.0], view([9.0, 0.0, 0.0])))
    found = chosen(optimal("improved"), seen)
    assert found.speed_mps == 0.0
    assert found.yaw_rate_radps == pytest.approx(-np.pi / 5)
    near, far = view([0.0, 8.0, 0.0], name="t1"), view([0.0, -10.0, 0.0], name="t2")
    between = chosen(optimal("improved"), Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], near, far)))
    assert between.yaw_rate_radps > 0.3


def test_who_has_nothing_to_gain_stands_and_as_published_looks_around() -> None:
    nothing = Situation(0, 1.0, member("r1", [0.0, 0.0, 1.0]))
    assert chosen(optimal("improved"), nothing) == Command(0.0, 0.0)
    assert chosen(optimal("published"), nothing) == Command(0.0, -np.pi / 5)


@pytest.mark.parametrize("form", FORMS)
def test_without_a_target_robots_keep_apart_and_hardly_move(form: Form) -> None:
    poses = np.array([[0.0, 0.0, 2.0], [3.2, 0.0, -1.0], [1.0, 3.1, 1.0]])
    field = Field(optimal(form), poses).run(40)
    assert field.nearest() > 3.0
    assert np.mean(field.speeds[-10:]) < 0.08
    if form == "improved":
        assert field.nearest(begin=30) > 4.5


@pytest.mark.parametrize("names", [("t1", "t2"), ("t2", "t1")])
def test_of_two_targets_far_apart_the_nearest_is_kept_in_sight(names: tuple[str, str]) -> None:
    """As published the costs of both add up, and the robot goes to the middle, from where it sees neither."""
    views = view([-10.0, 0.0, np.pi], name=names[0]), view([30.0, 0.0, 0.0], name=names[1])
    away = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], *views))
    assert chosen(optimal("published"), away).speed_mps == 0.5
    assert chosen(optimal("improved"), away).speed_mps == 0.0
    toward = Situation(0, 1.0, member("r1", [4.0, 0.0, np.pi], *views))
    assert chosen(optimal("published"), toward).speed_mps == 0.0
    assert chosen(optimal("improved"), toward) == Command(0.5, 0.0)


@pytest.mark.parametrize("form", FORMS)
def test_a_robot_goes_after_a_neighbour_that_gets_out_of_reach(form: Form) -> None:
    for distance, speed in ((26.0, 0.0), (33.0, 0.5)):
        seen = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0]), (member("r2", [distance, 0.0, 0.0]),))
        found = chosen(optimal(form), seen)
        assert found.speed_mps == speed
        assert found.yaw_rate_radps == 0.0 or (form == "published" and speed == 0.0)


def test_what_neighbours_believe_is_enough() -> None:
    other = member("r2", [0.0, 15.0, 0.0], view([30.0, 0.0, 0.0]))
    found = chosen(optimal(), Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0]), (other,)))
    assert found.speed_mps == 0.5
    assert abs(found.yaw_rate_radps) < 0.3


def rubbish() -> Iterator[Member]:
    """What a peer may tell, or a planner be handed, that no robot is."""
    good = member("r2", [4.0, 1.0, 0.0], view([8.0, 0.0, 0.0]))
    yield replace(good, pose=np.array([np.nan, 0.0, 0.0]))
    yield replace(good, pose=np.array([1e300, 0.0, 0.0]))
    yield replace(good, pose=np.zeros(2))
    yield replace(good, cov=-np.eye(3))
    yield replace(good, cov=np.zeros((3, 3)))
    yield replace(good, cov=np.full((3, 3), np.nan))
    yield replace(good, speed_mps=float("inf"))
    yield replace(good, yaw_rate_radps=float("nan"))
    yield replace(good, age_s=1e12)
    yield replace(good, targets=(view([np.inf, 0.0, 0.0]),))
    yield replace(good, targets=(view([8.0, 0.0, 0.0], np.zeros((3, 3))),))
    yield replace(good, targets=(view([8.0, 0.0, 0.0, 0.0]),))
    # What follows can be told and cannot be refused: the same place, far off, most unsure, as fast as light.
    yield replace(good, pose=np.zeros(3))
    yield replace(good, pose=np.array([1e6, -1e6, 1e6]))
    yield replace(good, cov=1e12 * np.eye(3), targets=(view([8.0, 0.0, 0.0], 1e12 * np.eye(3)),))
    yield replace(good, speed_mps=1e6, yaw_rate_radps=-1e6, age_s=1e6)
    yield replace(good, targets=(view([0.0, 0.0, 0.0]),))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["potential", "optimal"])
@pytest.mark.parametrize("form", FORMS)
def test_rubbish_from_a_peer_moves_nobody_out_of_the_limits(kind: Literal["potential", "optimal"], form: Form) -> None:
    settings = optimal(form, kind=kind)
    other = member("r3", [-4.0, 2.0, 0.0], view([8.1, 0.0, 0.0]))
    alone = chosen(settings, Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([8.0, 0.0, 0.0])), (other,)))
    for index, liar in enumerate(rubbish()):
        own = member("r1", [0.0, 0.0, 0.0], view([8.0, 0.0, 0.0]))
        found = chosen(settings, Situation(0, 1.0, own, (liar, other)))
        assert 0.0 <= found.speed_mps <= 0.5 and abs(found.yaw_rate_radps) <= np.pi / 5, index
        if index < 9:
            assert found == alone, index


def test_nobody_follows_a_peer_that_tells_of_a_place_far_out_of_reach() -> None:
    own, far = member("r1", [0.0, 0.0, 0.0], view([8.0, 0.0, 0.0])), member("r2", [400.0, 300.0, 0.0])
    assert chosen(optimal(), Situation(0, 1.0, own, (far,))) == chosen(optimal(), Situation(0, 1.0, own))


def test_a_belief_of_its_own_that_is_none_leaves_the_potential_law() -> None:
    own = replace(member("r1", [0.0, 0.0, 0.0], view([30.0, 0.0, 0.0])), cov=-np.eye(3))
    situation = Situation(0, 1.0, own, (member("r2", [5.0, 0.5, 0.0], view([30.0, 0.0, 0.0])),))
    assert chosen(optimal(weights="trace"), situation) == chosen(optimal(kind="potential"), situation)


@pytest.mark.parametrize("late", [0, 2])
def test_robots_that_meet_head_on_keep_clear(late: int) -> None:
    poses = np.array([[-14.0, 0.0, 0.0], [14.0, 0.1, np.pi], [0.0, 15.0, -np.pi / 2]])
    field = Field(optimal(), poses, np.array([0.0, 0.0, 0.0]), late).run(50)
    assert field.nearest() > 3.0
    assert np.linalg.norm(field.poses[:, :2] - np.array([12.5, 0.0]), axis=1).max() < 14.0
    assert np.mean(field.seeing[25:]) > 0.25


def test_a_team_of_six_keeps_clear_and_sees_the_target() -> None:
    rng = np.random.default_rng(5)
    places = np.array([[x, y] for x in (-6.0, 2.0) for y in (-3.0, 5.0, 13.0)]) + rng.uniform(-0.5, 0.5, (6, 2))
    field = Field(optimal(), np.c_[places, rng.uniform(-1.0, 1.0, 6)], np.array([10.0, 5.0, 0.0])).run(40)
    assert field.nearest() > 3.0
    assert np.min(np.sum(field.seeing[20:], axis=1)) >= 1
    assert np.linalg.norm(field.poses[:, :2] - np.array([20.0, 5.0]), axis=1).max() < 15.0


def test_without_potentials_robots_stop_and_let_the_target_go() -> None:
    """Su 2022, figure 4.4: to stand still and look at each other is the cheapest in the short run, so few follow."""
    poses = np.array([[-6.0, -3.0, 0.3], [2.0, 5.0, -0.5], [2.0, 13.0, 1.0], [-6.0, 13.0, -1.0]])
    with_it, without = (
        Field(optimal(potential_weight=weight), poses, np.array([10.0, 5.0, 0.0])).run(50) for weight in (1.0, 0.0)
    )

    def left_behind(field: Field) -> np.ndarray:
        assert field.target is not None
        far = np.linalg.norm(field.poses[:, :2] - field.target[:2], axis=1) > 20.0
        return far & (np.mean(field.speeds[-15:], axis=0) < 0.02)

    assert left_behind(without).sum() >= 2
    assert not left_behind(with_it).any()
    assert np.mean(without.speeds[-15:]) < 0.5 * np.mean(with_it.speeds[-15:])
