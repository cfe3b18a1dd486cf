"""Figures of where robots went, on traces made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.motion_figures import CHUNK, connected, motion_figures, over_trials, seen_share, trial_motion
from sim.world import SimulatedWorld
from tests.sim.steered import scenario

Array = NDArray[np.float64]
ALL = np.ones(1000, dtype=bool)


def places(*robots: list[float]) -> Array:
    """Robots on the x axis: (K, n, 3) of their x at each instant."""
    x = np.array(robots, dtype=np.float64).T
    return np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=-1)


def figures(found: Array, inside: NDArray[np.bool_] | None = None, **change: Any) -> dict[str, float | None]:
    inside = ALL[: len(found)] if inside is None else inside
    return motion_figures(found, inside, **{"step_s": 1.0, "collision_m": 2.0, "range_m": 10.0} | change)


def test_a_pair_that_comes_near_twice_has_collided_twice() -> None:
    apart = [5.0, 1.9, 0.4, 1.0, 2.0, 1.99, 7.0]
    made = figures(places([0.0] * 7, apart, [100.0] * 7))
    assert made["collisions"] == 2.0
    assert made["min_distance_m"] == pytest.approx(0.4)


def test_a_pair_that_begins_near_has_collided() -> None:
    assert figures(places([0.0] * 3, [1.0, 1.0, 5.0]))["collisions"] == 1.0
    assert figures(places([0.0] * 3, [1.0, 1.0, 5.0]), collision_m=0.5)["collisions"] == 0.0


def test_who_hears_only_some_is_connected_if_there_is_a_way_back() -> None:
    still = places([0.0] * 2, [5.0] * 2, [9.0] * 2)
    ring, line = np.zeros((3, 3), dtype=bool), np.zeros((3, 3), dtype=bool)
    ring[[0, 1, 2], [1, 2, 0]] = True
    line[[0, 1], [1, 2]] = True
    assert figures(still, heard=np.array([ring, line]))["connected_share"] == 0.5


def test_three_that_meet_are_three_pairs() -> None:
    assert figures(places([0.0, 0.0], [9.0, 1.0], [-9.0, 0.5]))["collisions"] == 3.0


def test_collisions_count_from_the_start_and_shares_in_the_window() -> None:
    inside = np.array([False, False, True, True])
    made = figures(places([0.0] * 4, [1.0, 30.0, 30.0, 10.0]), inside)
    assert made["collisions"] == 1.0
    assert made["connected_share"] == 0.5
    assert made["speed_mps"] == pytest.approx(10.0)


def test_a_collision_is_one_whatever_is_looked_at_at_once() -> None:
    """Over the seam of two chunks too."""
    apart = [5.0] * (CHUNK - 2) + [1.0] * 4 + [5.0] * CHUNK
    made = motion_figures(places([0.0] * len(apart), apart), np.ones(len(apart), dtype=bool), 1.0, 2.0, None)
    assert made["collisions"] == 1.0


def test_a_chain_is_connected_and_a_gap_is_not() -> None:
    chain = [[8.0 * k] * 2 for k in range(7)]
    assert figures(places(*chain))["connected_share"] == 1.0
    chain[4][1] += 3.0
    assert figures(places(*chain))["connected_share"] == 0.5
    assert figures(places(*chain), range_m=None)["connected_share"] == 1.0


@pytest.mark.parametrize("n", [1, 2, 5, 9, 17])
def test_connectivity_is_that_of_a_search(n: int) -> None:
    rng = np.random.default_rng(n)
    near = rng.random((60, n, n)) < 1.3 / n
    near |= near.swapaxes(1, 2)
    expected = []
    for graph in near:
        reached, frontier = {0}, [0]
        while frontier:
            new = [int(k) for k in np.flatnonzero(graph[frontier.pop()]) if int(k) not in reached]
            reached.update(new)
            frontier += new
        expected.append(len(reached) == n)
    np.testing.assert_array_equal(connected(near), expected)
    assert n < 3 or 0 < sum(expected) < 60


def test_one_robot_has_no_distance_and_truth_nobody_knows_no_figures() -> None:
    made = figures(places([0.0, 3.0]), step_s=2.0)
    assert made == {"collisions": 0.0, "min_distance_m": None, "connected_share": 1.0, "speed_mps": 1.5}
    assert set(figures(places([0.0, np.nan], [1.0, 1.0])).values()) == {None}


CAMERA = {"kind": "range_bearing", "of": ["targets"], "sigma_m": 0.1, "sigma_rad": 0.1, "rate_hz": 0.5}
TARGET = {"id": "t1", "start": {"pose": [0.0, 0.0, 0.0]}, "start_sigma": {"position_m": 1.0, "heading_rad": 0.1}}


def test_a_target_is_seen_by_the_share_of_those_that_look() -> None:
    """Of three robots that look every other second, one always sees it, one half of the time, one has no camera."""
    made = scenario(sensors={"eye": CAMERA}, whole={"targets": [TARGET]})
    made.robots[2].sensors.clear()
    inside = np.ones(9, dtype=bool)
    every = np.array([2.0, 4.0, 6.0, 8.0])
    measured = {("r1", "target:t1"): every, ("r2", "target:t1"): every[:2], ("r2", "r1"): every}
    assert seen_share(made, measured, inside) == pytest.approx((1.0 + 0.5 + 0.0) / 3.0)
    inside[:5] = False
    assert seen_share(made, measured, inside) == pytest.approx((1.0 + 0.0 + 0.0) / 3.0)
    assert seen_share(scenario(), {}, inside) is None


def test_a_trial_has_them_all_as_far_as_it_is_played() -> None:
    made = scenario(sensors={"eye": CAMERA}, whole={"targets": [TARGET], "links": {"range_m": 7.0}})
    world = SimulatedWorld(made, 1)
    for k in range(1, 11):
        world.outputs(k)
    found = trial_motion(made, world, {("r1", "target:t1"): np.array([2.0])}, 10)
    assert found["min_distance_m"] == pytest.approx(4.0, abs=0.5)
    assert found["connected_share"] == 1.0
    assert found["speed_mps"] == pytest.approx(0.1, rel=0.1)
    assert found["target_seen_share"] == pytest.approx(0.2 / 3.0)


def test_over_trials_figures_are_means_and_the_smallest_distance() -> None:
    one = {"collisions": 3.0, "min_distance_m": 1.0, "connected_share": 0.5, "speed_mps": 0.4}
    two = {"collisions": 0.0, "min_distance_m": 4.0, "connected_share": 1.0, "speed_mps": 0.6}
    assert over_trials([item | {"target_seen_share": None} for item in (one, two)]) == {
        "collisions": 1.5,
        "min_distance_m": 1.0,
        "connected_share": 0.75,
        "speed_mps": 0.5,
        "target_seen_share": None,
    }
