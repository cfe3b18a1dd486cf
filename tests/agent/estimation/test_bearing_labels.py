"""Which bearing gets a name: only one that is beyond doubt a robot's, whatever else may have made it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.bearing_labels import certain_labels
from agent.estimation.correspondence import BodyMotion, Correspondence, CorrespondenceSettings, Scan
from agent.estimation.gaussian_sum import Rules, Seen, Tracks, gate_limit

Array = NDArray[np.float64]

SIGMA = 0.03
RULES = Rules(
    detection=0.95,
    gate=0.999,
    birth=5e-4,
    clutter=0.1,
    anywhere=0.1,
    strangeness=1.0,
    adoption=0.005,
    improved=True,
    floor=1e-5,
    depth=4,
    family=1e-3,
)
HERE, THERE = (8.0, 0.0), (0.0, 8.0)
"""Places of two robots, a right angle apart."""


def tracks(*items: tuple[int, float, tuple[float, float]], sigma: float = 0.1) -> Tracks:
    """Tracks (robot, weight, place)."""
    count = len(items)
    mean = np.array([[[x, y, 0.0, 0.0]] for _, _, (x, y) in items])
    return Tracks(
        np.array([of for of, _, _ in items]),
        np.array([weight for _, weight, _ in items]),
        mean,
        np.broadcast_to(np.diag([sigma**2, sigma**2, sigma**2, 0.04]), (count, 1, 4, 4)).copy(),
        np.zeros(count, dtype=np.bool_),
        np.zeros((count, 4), dtype=np.int64),
        np.zeros(count),
    )


def seen(*azimuths: float, n: int = 2) -> Seen:
    """A scan with these bearings, all level."""
    bearings = np.array([[azimuth, 0.0] for azimuth in azimuths]).reshape(-1, 2)
    none, no = np.zeros(n), np.zeros(n, dtype=np.bool_)
    possible = np.ones((n, len(bearings)), dtype=np.bool_)
    return Seen(none, none, no, none, none, no, ~no, bearings, SIGMA**2 * np.eye(2), possible, False)


def named(
    found: Tracks, *azimuths: float, sure: tuple[bool, bool] = (True, True), rules: Rules = RULES
) -> dict[int, int]:
    return certain_labels(found, seen(*azimuths), rules, np.array(sure))


APART = tracks((0, 1.0, HERE), (1, 1.0, THERE))


def test_bearings_of_robots_that_are_apart_get_their_names() -> None:
    assert named(APART, 0.5 * math.pi, -2.0, 0.01) == {0: 2, 1: 0}


def test_a_robot_that_was_never_certain_gives_no_name() -> None:
    assert named(APART, 0.5 * math.pi, 0.01, sure=(True, False)) == {0: 1}


def test_two_bearings_in_one_gate_get_no_name() -> None:
    assert named(APART, 0.01, -0.01) == {}
    assert named(APART, 0.01, -0.5) == {0: 0}


@pytest.mark.parametrize(("weight", "expected"), [(0.5, {}), (2e-3, {}), (5e-4, {0: 0})])
def test_a_bearing_that_another_may_have_made_gets_no_name(weight: float, expected: dict[int, int]) -> None:
    found = tracks((0, 1.0, HERE), (1, 1.0 - weight, THERE), (1, weight, HERE))
    assert named(found, 0.0) == expected


def test_all_hypotheses_of_a_robot_count_for_its_bearing() -> None:
    """Two that say nearly the same are as good as one; one that is elsewhere, and not seen there, leaves a doubt."""
    near = tracks((0, 0.6, HERE), (0, 0.4, (8.0, 0.1)), (1, 1.0, THERE))
    assert named(near, 0.0) == {0: 0}
    elsewhere = tracks((0, 0.02, HERE), (0, 0.98, (-8.0, 0.0)), (1, 1.0, THERE))
    assert named(elsewhere, 0.0) == {}


def test_the_probability_against_clutter_is_that_of_two_explanations() -> None:
    """By hand: the bearing is the robot's, or it is false and the robot was missed."""
    found = tracks((0, 1.0, HERE), (1, 1.0, THERE))
    S = np.diag([0.1**2 / 64.0 + SIGMA**2, 0.1**2 / 64.0 + SIGMA**2])
    azimuth = 0.06
    density = math.exp(-0.5 * azimuth**2 / S[0, 0]) / (2.0 * math.pi * math.sqrt(np.linalg.det(S)))
    made = RULES.detection * density
    at = made * (1.0 / 0.99 - 1.0) / RULES.missed
    assert named(found, azimuth, rules=replace(RULES, clutter=0.999 * at)) == {0: 0}
    assert named(found, azimuth, rules=replace(RULES, clutter=1.001 * at)) == {}


def test_a_robot_of_which_nothing_is_known_may_be_anywhere() -> None:
    alone = tracks((0, 1.0, HERE))
    assert named(alone, 0.0) == {0: 0}
    crowded = replace(RULES, anywhere=100.0)
    assert named(alone, 0.0, rules=crowded) == {} and named(APART, 0.0, rules=crowded) == {0: 0}


def test_outside_the_gate_nothing_gets_a_name() -> None:
    edge = math.sqrt(gate_limit(RULES.gate, 2) * (0.1**2 / 64.0 + SIGMA**2))
    calm = replace(RULES, clutter=1e-9)
    assert named(APART, 0.999 * edge, rules=calm) == {0: 0}
    assert named(APART, 1.001 * edge, rules=calm) == {}


def test_names_are_known_or_found_never_both() -> None:
    certain = replace(seen(0.0), certain=True)
    assert certain_labels(APART, certain, RULES, np.array([True, True])) == {}
    assert certain_labels(APART, seen(), RULES, np.array([True, True])) == {}


def test_a_leader_names_bearings_once_it_is_sure() -> None:
    """Two robots pass by; names are right, come only after the robots were told apart, and are of honest bearings."""
    rng = np.random.default_rng(7)
    leader = Correspondence(CorrespondenceSettings(clutter=0.5), ("a", "b"), "me")
    place = {"a": np.array([6.0, 3.0, 0.5]), "b": np.array([-4.0, 5.0, -0.3])}
    velocity = {"a": np.array([-0.6, 0.1, 0.0, 0.0]), "b": np.array([0.5, -0.2, 0.0, 0.0])}
    still = BodyMotion(np.zeros(4), 1e-4 * np.eye(4))
    names, wrong, first, squares = 0, 0, None, []
    for k in range(200):
        leader.advance(still, {peer: BodyMotion(velocity[peer], 1e-3 * np.eye(4)) for peer in place}, 0.1)
        directions, ranges, heights = [], {}, {}
        for peer in place:
            place[peer] = place[peer] + 0.1 * velocity[peer][:3]
            x, y, z = place[peer]
            directions.append([math.atan2(y, x), math.atan2(z, math.hypot(x, y))])
            ranges[peer] = float(np.linalg.norm(place[peer]) + 0.05 * rng.standard_normal()), 0.05**2
            heights[peer] = float(z + 0.05 * rng.standard_normal()), 0.05**2
        noisy = np.array(directions) + SIGMA * rng.standard_normal((2, 2))
        false = rng.uniform([-math.pi, -0.7], [math.pi, 0.7], (int(rng.random() < 0.5), 2))
        order = rng.permutation(2 + len(false))
        bearings = np.vstack([noisy, false])[order]
        found = leader.scan(Scan(bearings, SIGMA**2 * np.eye(2), ranges, heights))
        for peer, row in found.items():
            first = k if first is None else first
            names += 1
            index = ("a", "b").index(peer)
            wrong += int(order[row]) != index
            squares.append(float(((bearings[row] - directions[index]) ** 2).mean() / SIGMA**2))
    assert first is not None and first >= 20, "two seconds of certainty come first"
    assert names >= 250 and wrong == 0, (names, wrong)
    # Each is a chi-square of two degrees of freedom over two: what is chosen is no noisier than is stated.
    assert abs(np.mean(squares) - 1.0) < 3.0 / math.sqrt(names), (np.mean(squares), names)
