"""Robots that fly around a target form the ring from which bearings cross at right angles, and hurt nobody."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, TargetMotion
from agent.planning.choice import build_planner
from agent.planning.encircle import HEIGHT_SHARE, ring, slots_of
from agent.planning.situation import Command, Member, Situation, TargetView
from agent.settings import PlanningSettings

Array = NDArray[np.float64]
RADIUS, CLOSEST = 10.0, 4.0
SETTINGS = PlanningSettings(
    kind="encircle", radius_m=RADIUS, closest_m=CLOSEST, max_speed_mps=5.0, max_climb_mps=2.0, max_turn_radps=1.0
)
MOTION = TargetMotion(LAYOUTS["constant_velocity_3d"], noise_sigma=(1.0,), noise_step_s=1.0)


def view(mean: Array, sigma_m: float = 0.3) -> TargetView:
    return TargetView("t1", MOTION, mean, np.diag([sigma_m**2] * 3 + [0.1] * 3))


def member(robot: str, place: Array, heading: float = 0.0, *views: TargetView, age_s: float = 0.0) -> Member:
    pose = np.array([place[0], place[1], heading])
    return Member(robot, pose, 0.01 * np.eye(3), 0.0, 0.0, views, age_s, float(place[2]))


def chosen(own: Member, *others: Member, settings: PlanningSettings = SETTINGS) -> Command:
    planner = build_planner(settings, own.robot)
    assert planner is not None
    return planner.command(Situation(0, 0.1, own, others))


def over_ground(command: Command, heading: float) -> Array:
    cos, sin = math.cos(heading), math.sin(heading)
    ahead, left = command.speed_mps, command.left_mps
    return np.array([cos * ahead - sin * left, sin * ahead + cos * left, command.up_mps])


def flown(places: Array, target: Array, count: int, settings: PlanningSettings = SETTINGS) -> Array:
    """Places (count + 1, n, 3) of robots that obey at once and know everything; the target goes straight on."""
    dt, track, headings = 0.1, [places], np.zeros(len(places))
    for _ in range(count):
        here = track[-1]
        team = [member(f"r{i}", here[i], headings[i], view(target)) for i in range(len(here))]
        new = []
        for i, own in enumerate(team):
            command = chosen(own, *(other for other in team if other is not own), settings=settings)
            assert math.hypot(command.speed_mps, command.left_mps) <= settings.max_speed_mps + 1e-9
            assert abs(command.up_mps) <= settings.max_climb_mps and abs(command.yaw_rate_radps) <= 1.0
            new.append(here[i] + dt * over_ground(command, headings[i]))
            headings[i] = float(wrap(np.array(headings[i] + dt * command.yaw_rate_radps)))
        track.append(np.array(new))
        target = np.concatenate([target[:3] + dt * target[3:], target[3:]])
    return np.array(track)


def bearing_angles(places: Array, target: Array) -> list[float]:
    rays = (target - places) / np.linalg.norm(target - places, axis=1, keepdims=True)
    return [math.acos(float(rays[i] @ rays[j])) for i, j in itertools.combinations(range(len(rays)), 2)]


def gaps(track: Array) -> Array:
    pairs = itertools.combinations(range(track.shape[1]), 2)
    return np.array([np.linalg.norm(track[:, i] - track[:, j], axis=1) for i, j in pairs])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_from_the_slots_bearings_cross_at_right_angles(count: int) -> None:
    rng = np.random.default_rng(count)
    for _ in range(20):
        target = rng.normal(size=3) * 20.0
        slots = slots_of(target + rng.normal(size=(count, 3)) * 9.0, target, RADIUS)
        np.testing.assert_allclose(bearing_angles(slots, target), 0.5 * math.pi, atol=1e-9)
        np.testing.assert_allclose(slots[:, 2] - target[2], RADIUS * HEIGHT_SHARE)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_who_is_in_a_ring_stays_there_and_it_turns_with_them(count: int) -> None:
    apart = 2.0 * math.pi / max(count, 3)
    for way in (1.0, -1.0):
        there = 0.7 + way * apart * np.arange(count)
        np.testing.assert_allclose(wrap(ring(there) - there), 0.0, atol=1e-9)
        off = there + 0.05 * np.sin(np.arange(count))
        np.testing.assert_allclose(wrap(ring(off + 1.0) - ring(off) - 1.0), 0.0, atol=1e-9)


def test_nobody_has_to_move_when_one_falls_silent() -> None:
    target = np.array([3.0, 4.0, 5.0])
    slots = slots_of(target + np.array([[9.0, 1.0, 7.0], [-5.0, 8.0, 7.0], [-5.0, -8.0, 7.0]]), target, RADIUS)
    for gone in range(3):
        left = np.delete(slots, gone, axis=0)
        np.testing.assert_allclose(slots_of(left, target, RADIUS), left, atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_robots_form_the_ring_around_a_target_that_moves_and_keep_clear(seed: int) -> None:
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    target = np.concatenate([[0.0, 0.0, 5.0], rng.normal(size=3) * [1.2, 1.2, 0.2]])
    begin = np.array([[-30.0, 12.0, 10.0], [-30.0, 0.0, 10.0], [-30.0, -12.0, 10.0]]) + rng.normal(size=(3, 3)) * 2.0
    track = flown(begin, target, 400)
    end = target[:3] + 40.0 * target[3:]
    np.testing.assert_allclose(bearing_angles(track[-1], end), 0.5 * math.pi, atol=0.03)
    assert gaps(track).min() > CLOSEST
    at = target[:3] + 0.1 * np.arange(401)[:, None] * target[3:]
    assert np.linalg.norm(track - at[:, None], axis=2).min() > CLOSEST


def test_a_target_in_the_middle_of_robots_that_are_too_near_drives_them_apart() -> None:
    target = np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    begin = np.array([[2.0, 0.0, 6.0], [0.5, 1.0, 6.0], [-1.0, -1.0, 7.0]])
    track = flown(begin, target, 300)
    assert gaps(track[100:]).min() > CLOSEST
    np.testing.assert_allclose(bearing_angles(track[-1], target[:3]), 0.5 * math.pi, atol=0.03)


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.0])
def test_it_goes_with_the_target_whatever_its_heading_and_faces_it(heading: float) -> None:
    target = np.array([0.0, 0.0, 5.0, 1.0, -2.0, 0.3])
    slot = np.array([RADIUS, 0.0, 5.0 + RADIUS * HEIGHT_SHARE])
    found = chosen(member("r1", slot, heading, view(target)))
    np.testing.assert_allclose(over_ground(found, heading), target[3:], atol=1e-9)
    assert math.copysign(1.0, found.yaw_rate_radps) == math.copysign(1.0, float(wrap(np.array(math.pi - heading))))


def test_without_a_target_or_with_one_that_is_too_vague_it_hovers_and_turns_slowly() -> None:
    place = np.array([1.0, 2.0, 9.0])
    vague = view(np.array([50.0, 0.0, 5.0, 2.0, 0.0, 0.0]), sigma_m=0.51 * RADIUS)
    for found in (chosen(member("r1", place)), chosen(member("r1", place, 0.0, vague))):
        assert (found.speed_mps, found.left_mps, found.up_mps) == (0.0, 0.0, 0.0)
        assert found.yaw_rate_radps == 0.3
    near = chosen(member("r1", place), member("r2", place + np.array([0.0, 2.0, 0.0])))
    assert near.left_mps < -0.5, "it hovers beside somebody who is too near"


def test_who_sees_nothing_follows_what_another_tells_moved_on_to_the_present() -> None:
    target = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0])
    at = np.array([RADIUS, 0.0, 5.0 + RADIUS * HEIGHT_SHARE])
    other = member("r2", np.array([-5.0, 8.0, 12.0]), 0.0, view(target))
    told = over_ground(chosen(member("r1", at), replace(other, age_s=0.4)), 0.0)
    now = view(np.array([0.4, 0.0, 5.0, 1.0, 0.0, 0.0]))
    knows = over_ground(chosen(member("r1", at, 0.0, now), replace(other, targets=())), 0.0)
    np.testing.assert_allclose(told, knows, atol=1e-9)


def test_who_has_fallen_silent_is_kept_clear_of_and_has_no_slot() -> None:
    target = np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])
    slots = slots_of(np.array([[9.0, 1.0, 12.0], [-5.0, 8.0, 12.0]]), target[:3], RADIUS)
    own, other = member("r1", slots[0], 0.0, view(target)), member("r2", slots[1])
    beside = replace(member("r0", slots[0] + np.array([0.0, 3.0, 0.0])), silent=True)
    far = replace(beside, pose=np.array([40.0, 0.0, 0.0]))
    np.testing.assert_allclose(over_ground(chosen(own, far, other), 0.0), 0.0, atol=1e-9)
    assert over_ground(chosen(own, beside, other), 0.0)[1] == pytest.approx(-0.5 * (CLOSEST - 3.0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e9])
def test_what_peers_tell_cannot_hurt(bad: float) -> None:
    slot = np.array([RADIUS, 0.0, 5.0 + RADIUS * HEIGHT_SHARE])
    own = member("r1", slot, 0.0, view(np.array([0.0, 0.0, 5.0, 0.0, 0.0, 0.0])))
    strange = member("r2", np.array([-5.0, 8.0, bad]), 0.0, view(np.array([bad, 0.0, 5.0, 0.0, 0.0, 0.0])))
    found = chosen(own, strange)
    assert all(math.isfinite(value) for value in (found.speed_mps, found.left_mps, found.up_mps, found.yaw_rate_radps))
    assert found == chosen(own)
