"""The potential-field law: where it pushes, how fast, that only relative places matter; and robots that follow it."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.estimation.gaussian import wrap, wrap_scalar
from agent.planning.choice import build_planner
from agent.planning.potential import PotentialLaw
from agent.planning.situation import Command, Member, Situation
from agent.settings import PlanningSettings
from tests.agent.planning.field import TARGET, Field, member, view

Form = Literal["improved", "published"]
FORMS: tuple[Form, ...] = ("improved", "published")

LAW = PotentialLaw()
places = st.lists(st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-3, 3)), min_size=1, max_size=7)


def commands(poses: np.ndarray, target: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    n = len(poses)
    return LAW.commands(poses, np.tile(target, (n, 1)), np.tile(velocity, (n, 1)), np.ones(n))


@given(places)
@settings(max_examples=60, deadline=None)
def test_commands_keep_the_limits(rows: list[tuple[float, float, float]]) -> None:
    found = commands(np.array(rows), np.array([1.0, 2.0]), np.array([0.2, 0.1]))
    assert np.all(np.isfinite(found))
    assert np.all((found[:, 0] >= 0.0) & (found[:, 0] <= LAW.max_speed_mps))
    assert np.all(np.abs(found[:, 1]) <= LAW.max_turn_radps)


@given(places, st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
@settings(max_examples=60, deadline=None)
def test_only_relative_places_matter(
    rows: list[tuple[float, float, float]], turn: float, east: float, north: float
) -> None:
    poses, target, velocity = np.array(rows), np.array([1.0, 2.0]), np.array([0.2, 0.1])
    cos, sin = np.cos(turn), np.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    moved = poses.copy()
    moved[:, :2] = poses[:, :2] @ rotation.T + [east, north]
    moved[:, 2] = wrap(poses[:, 2] + turn)
    first = commands(poses, target, velocity)
    second = commands(moved, rotation @ target + [east, north], rotation @ velocity)
    assert np.abs(first[:, 0] - second[:, 0]).max() < 1e-6
    # A robot that heads straight away turns either way round; anything it does is as good.
    behind = np.isclose(np.abs(first[:, 1]), LAW.max_turn_radps)
    assert np.abs(first[~behind, 1] - second[~behind, 1]).max(initial=0.0) < 1e-5


def test_a_push_changes_its_sense_at_the_distance_to_keep() -> None:
    """Commands subtract it: away from the neighbour below `apart_m`, towards it above, nothing out of reach."""
    for distance, sense in ((1.0, -1.0), (8.0, -1.0), (9.9, -1.0), (15.0, 1.0), (29.0, 1.0), (31.0, 0.0)):
        push = LAW.push(np.array([distance, 0.0]))
        assert np.sign(push[0]) == sense
        assert push[1] == 0.0
    assert np.array_equal(LAW.push(np.zeros(2)), np.zeros(2))


def test_a_lone_robot_drives_to_where_its_push_and_pull_balance() -> None:
    poses, target = np.array([[-20.0, 3.0, 0.0]]), np.array([0.0, 0.0])
    for _ in range(200):
        speed, turn = commands(poses, target, np.zeros(2))[0]
        heading = poses[0, 2]
        poses[0] += [speed * np.cos(heading), speed * np.sin(heading), turn]
    distance = float(np.linalg.norm(poses[0, :2]))
    assert LAW.closest_m - 3.0 * LAW.max_speed_mps < distance < LAW.apart_m


def test_who_is_out_of_reach_does_not_count() -> None:
    near = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    far = np.vstack([near, [1000.0, 0.0, 0.0]])
    target, velocity = np.array([3.0, 4.0]), np.zeros(2)
    assert np.allclose(commands(near, target, velocity), commands(far, target, velocity)[:2])


def test_the_push_is_that_of_the_formula() -> None:
    """Eq. 3.4 with d_s = 6, d_o = 10 and, as in figure 3.1, R = 15; radial, and capped from 6.1 m down."""
    law = PotentialLaw(radio_range_m=15.0)
    direction = np.array([0.6, -0.8])
    for distance, size in ((8.0, -20.0), (7.0, -60.0), (9.0, -20.0 / 3.0), (10.0, 0.0), (12.5, 0.5), (14.999, 0.0)):
        assert np.allclose(law.push(distance * direction), size * direction, atol=1e-3), distance
    for distance in (6.05, 6.0, 3.0, 0.1):
        assert np.allclose(law.push(distance * direction), 200.0 * (distance - 10.0) * direction), distance
    pushes = law.push(np.linspace(0.1, 10.0, 500)[:, None] * direction) @ direction
    assert np.all(np.diff(pushes) > 0.0)


def situation(own: Member, *others: Member, dt_s: float = 1.0) -> Situation:
    return Situation(0, dt_s, own, others)


def command(form: Form, seen: Situation) -> Command:
    planner = build_planner(PlanningSettings(kind="potential", form=form), seen.own.robot)
    assert planner is not None
    found = planner.command(seen)
    assert 0.0 <= found.speed_mps <= LAW.max_speed_mps
    assert abs(found.yaw_rate_radps) <= LAW.max_turn_radps
    return found


@pytest.mark.parametrize("seed", range(5))
def test_published_is_eq_3_2_on_beliefs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = np.c_[rng.uniform(-12, 12, (4, 2)), rng.uniform(-3, 3, 4)]
    targets = np.c_[rng.uniform(8, 12, (4, 2)), rng.uniform(-3, 3, 4)]
    covs = [np.diag(rng.uniform(0.1, 2.0, 3)) for _ in range(4)]
    team = [member(f"r{i}", poses[i], view(targets[i], covs[i])) for i in range(4)]
    p, u = poses[0, :2], np.zeros(2)
    inverse = [1.0 / np.trace(cov) for cov in covs]
    for j in range(4):
        eta = inverse[j] / sum(inverse)
        velocity = 0.25 * np.array([np.cos(targets[j, 2]), np.sin(targets[j, 2])])
        u += eta * velocity - eta * (p - targets[j, :2]) - 0.015 * LAW.push(p - targets[j, :2])
        if j > 0:
            u -= 0.015 * LAW.push(p - poses[j, :2])
    turn = wrap_scalar(np.arctan2(u[1], u[0]) - poses[0, 2])
    found = command("published", situation(team[0], *team[1:]))
    assert found.speed_mps == pytest.approx(min(np.linalg.norm(u), 0.5)), seed
    assert found.yaw_rate_radps == pytest.approx(np.clip(turn, -np.pi / 5, np.pi / 5)), seed


@pytest.mark.parametrize("seed", range(5))
def test_a_mirrored_situation_gives_the_mirrored_command(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mirror = np.array([1.0, -1.0, -1.0])
    poses, target = rng.uniform(-8, 8, (3, 3)) * [1, 1, 0.3], rng.uniform(-8, 8, 3) * [1, 1, 0.3]
    for form in FORMS:
        team = [member(f"r{i}", pose, view(target)) for i, pose in enumerate(poses)]
        mirrored = [member(f"r{i}", pose * mirror, view(target * mirror)) for i, pose in enumerate(poses)]
        first, second = command(form, situation(*team)), command(form, situation(*mirrored))
        assert first.speed_mps == pytest.approx(second.speed_mps), seed
        assert first.yaw_rate_radps == pytest.approx(-second.yaw_rate_radps), seed


def test_who_faces_away_turns_before_it_drives() -> None:
    """As published the robot drives on at full speed, away from the target."""
    away = situation(member("r1", [0.0, 0.0, 3.0], view([20.0, 0.0, 0.0])))
    assert command("published", away) == Command(0.5, -np.pi / 5)
    assert command("improved", away) == Command(0.0, -np.pi / 5)
    aside = situation(member("r1", [0.0, 0.0, 1.0], view([20.0, 0.0, 0.0])))
    assert command("improved", aside).speed_mps == pytest.approx(0.5 * np.cos(1.0), rel=1e-3)


def test_who_is_where_it_should_be_faces_the_target() -> None:
    """A target at rest, seen from where push and pull cancel: little is left to drive, in whatever direction."""
    still = replace(view([0.0, 0.0, 0.0]), motion=replace(TARGET, control=(0.0, 0.0)))
    low, high = 6.0, 10.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        inward = middle + 0.015 * float(LAW.push(np.array([middle, 0.0]))[0])
        low, high = (low, middle) if inward > 0.0 else (middle, high)
    for nudge in (-1e-4, 1e-4):
        seen = situation(member("r1", [low + nudge, 0.0, 2.7], still))
        found = command("improved", seen)
        assert found.speed_mps < 0.1
        assert found.yaw_rate_radps == pytest.approx(np.pi - 2.7)


@pytest.mark.parametrize("form", FORMS)
def test_without_a_target_robots_make_room_and_then_stand_still(form: Form) -> None:
    field = Field(PlanningSettings(kind="potential", form=form), np.array([[0.0, 0, 0], [3.0, 0, 3], [1.0, 2.0, 1]]))
    field.run(150)
    assert np.all(np.array(field.speeds[-20:]) == 0.0)
    assert 8.0 < field.nearest(begin=130) < 10.0
    alone = situation(member("r1", [0.0, 0.0, 0.0]))
    far = situation(member("r1", [0.0, 0.0, 0.0]), member("r2", [20.0, 0.0, 0.0]))
    for seen in (alone, far):
        assert command(form, seen) == Command(0.0, 0.0)


@pytest.mark.parametrize("form", FORMS)
def test_what_neighbours_believe_is_enough(form: Form) -> None:
    seen = situation(member("r1", [0.0, 0.0, 0.0]), member("r2", [0.0, 15.0, 0.0], view([30.0, 0.0, 0.0])))
    found = command(form, seen)
    assert found.speed_mps == pytest.approx(0.5, rel=0.01)
    assert abs(found.yaw_rate_radps) < 0.1


def test_of_two_targets_the_nearest_draws() -> None:
    near, far = view([0.0, 20.0, 0.0], name="t2"), view([0.0, -40.0, 0.0], name="t1")
    for form in FORMS:
        assert command(form, situation(member("r1", [0.0, 0.0, 0.0], far, near))).yaw_rate_radps > 0.5


def test_old_beliefs_of_a_target_are_moved_on() -> None:
    """The target runs north at 0.25 m/s since half a minute; who says so is taken to be where it was."""
    other = member("r2", [0.0, -12.0, 0.0], view([15.0, 0.0, np.pi / 2]), command=(0.5, 0.0), age_s=30.0)
    seen = situation(member("r1", [0.0, 0.0, 0.0]), other)
    assert command("published", seen).yaw_rate_radps == pytest.approx(0.02, abs=0.02)
    assert command("improved", seen).yaw_rate_radps == pytest.approx(np.arctan2(7.5, 15.0), abs=0.03)


@pytest.mark.parametrize("form", FORMS)
def test_robots_that_meet_head_on_keep_clear(form: Form) -> None:
    poses = np.array([[-14.0, 0.0, 0.0], [14.0, 0.1, np.pi], [0.0, 15.0, -np.pi / 2]])
    field = Field(PlanningSettings(kind="potential", form=form), poses, np.array([0.0, 0.0, 0.0])).run(80)
    assert field.nearest() > 3.0
    assert np.linalg.norm(field.poses[:, :2] - np.array([20.0, 0.0]), axis=1).max() < 12.0
