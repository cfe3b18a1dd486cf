"""The pose of a follower by words of its leader and its odometry alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.delayed import LeaderSight, predicted
from agent.estimation.gaussian import wrap
from agent.estimation.motion import compose
from agent.estimation.pose_from_words import Way, no_way, pose_from_words
from tests.sizes import sized

Array = NDArray[np.float64]

STEP_S = 0.1
R = np.diag([0.5, 0.0087]) ** 2
PLACE_COV = 0.01 * np.eye(2)
NOISE = np.diag([1e-2, 1e-6, 5e-3]) ** 2


def met(
    rng: np.random.Generator, count: int, tau_s: float = 0.0, speed_mps: float = 1.0
) -> tuple[list[LeaderSight], list[Way], Array]:
    """Sights of a leader that drives a circle 3 m ahead, own ways since then, and the true pose at the last of them."""
    pose = np.array([*rng.uniform(-20.0, 20.0, 2), rng.uniform(-np.pi, np.pi)])
    ahead = np.array([3.0, rng.uniform(-1.0, 1.0), rng.uniform(-0.5, 0.5)])
    leader = compose(pose, ahead)
    sights: list[LeaderSight] = []
    ways: list[Way] = []
    for index in range(count):
        if index:
            gone = STEP_S * np.array([speed_mps, 0.0, rng.uniform(-0.5, 0.5)])
            pose = compose(pose, gone)
            leader = compose(leader, STEP_S * np.array([speed_mps, 0.0, 0.4]))
            told = gone + rng.normal(0.0, np.sqrt(np.diagonal(NOISE)))
            ways = [way.moved(told, NOISE) for way in ways]
        velocity = speed_mps * np.array([np.cos(leader[2]), np.sin(leader[2])])
        clean, _, _ = predicted(pose, leader[:2], LeaderSight(np.zeros(2), R, leader[:2], PLACE_COV, velocity))
        place = leader[:2] - tau_s * velocity + rng.normal(0.0, 0.1, 2)
        z = clean + rng.normal(0.0, np.sqrt(np.diagonal(R)))
        sights.append(LeaderSight(z, R, place, PLACE_COV, velocity))
        ways.append(no_way())
    return sights, ways, pose


def off(found: Array, pose: Array) -> Array:
    error = found[:3] - pose
    error[2] = wrap(error[2])
    return error


@pytest.mark.parametrize(("count", "trials"), [(12, sized(100, 1000)), (20, sized(40, 1000))])
def test_what_it_claims_holds(count: int, trials: int) -> None:
    found = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        sights, ways, pose = met(rng, count)
        told = pose_from_words(sights, ways)
        if told is None or told[1][2, 2] > 0.04:
            continue
        error = off(told[0], pose)
        found.append(error @ np.linalg.solve(told[1], error) / 3.0)
    assert len(found) > 0.5 * trials, len(found)
    # The deviation of the mean; ways count more often than they err.
    margin = 3.0 * np.sqrt(2.0 / 3.0 / len(found))
    assert 0.8 - margin < np.mean(found) < 1.05 + margin, (count, np.mean(found))


def test_the_leaders_clock_is_told_apart_only_as_far_as_it_is_known() -> None:
    errors, claims = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        tau_s = rng.normal(0.0, 0.2)
        sights, ways, pose = met(rng, 20, tau_s)
        told = pose_from_words(sights, ways, (0.0, 0.04))
        assert told is not None, seed
        error = np.append(off(told[0], pose), told[0][3] - tau_s)
        errors.append(error @ np.linalg.solve(told[1], error) / 4.0)
        claims.append(told[1][3, 3])
    assert np.mean(errors) < 1.0 + 3.0 * np.sqrt(0.5 / len(errors)), np.mean(errors)
    assert max(claims) <= 0.04 + 1e-9


def test_few_words_that_fit_several_poses_tell_none() -> None:
    """Eight words over 0.7 s mostly have a second answer, which fits a little worse and may be the true one."""
    errors = []
    for seed in range(40):
        sights, ways, pose = met(np.random.default_rng(seed), 8)
        told = pose_from_words(sights, ways)
        if told is not None and told[1][2, 2] <= 0.04:
            errors.append(float(np.abs(off(told[0], pose)).max()))
    assert len(errors) < 15
    assert max(errors) < 2.0, max(errors)


def test_one_word_tells_no_pose_and_a_leader_that_stands_hardly_a_heading() -> None:
    rng = np.random.default_rng(5)
    sights, ways, _ = met(rng, 1)
    assert pose_from_words(sights, ways) is None
    for seed in range(20):
        sights, ways, _ = met(np.random.default_rng(seed), 8, speed_mps=0.0)
        told = pose_from_words(sights, ways)
        assert told is None or told[1][2, 2] > 0.04, seed


def test_words_that_do_not_fit_together_tell_nothing() -> None:
    sights, ways, _ = met(np.random.default_rng(2), 20)
    assert pose_from_words(sights, ways) is not None
    wrong = [
        LeaderSight(item.z, item.R, item.place + rng_off, item.place_cov, item.velocity)
        for item, rng_off in zip(sights, 10.0 * np.random.default_rng(3).normal(size=(20, 2)), strict=True)
    ]
    assert pose_from_words(wrong, ways) is None
