"""The potential-field law: where it pushes, how fast, and that nothing but relative places matters."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.estimation.gaussian import wrap
from agent.planning.potential import PotentialLaw

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
