"""What was told of one instant, at another one: where it would be, and unsure enough of that."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.ageing import AWAY_M, TURNED_RAD, bounded_sum, place_at_age, pose_at_age, target_at_age
from agent.estimation.gaussian import wrap
from agent.estimation.jlatt import Placed
from agent.estimation.motion import CONSTANT_VELOCITY, SPATIAL, UNICYCLE, UNICYCLE_GAINS, TargetMotion, compose
from tests.agent.estimation.correlations import least_gap, random_covariance, random_joint

Array = NDArray[np.float64]

SEED = st.integers(0, 2**32 - 1)
WALKER = TargetMotion(UNICYCLE, (0.25, 0.0), (0.0053, 0.0212))
DRIFTER = TargetMotion(CONSTANT_VELOCITY, noise_sigma=(0.1, 0.1))
FORWARD = np.array([0.5, 0.1, 0.2])


@pytest.mark.parametrize("yaw_rate", [0.0, 1e-9, 0.6, -0.6])
@pytest.mark.parametrize("age_s", [0.4, 3.0, -2.0])
def test_a_pose_goes_on_along_its_arc(yaw_rate: float, age_s: float) -> None:
    mean, steps = np.array([1.0, -2.0, 3.0]), 20_000
    expected, dt = mean.copy(), age_s / 20_000
    for _ in range(steps):
        expected = compose(expected, np.array([FORWARD[0] * dt, FORWARD[1] * dt, yaw_rate * dt]))
    found, _ = pose_at_age(UNICYCLE, mean, np.eye(3), FORWARD, yaw_rate, age_s, 1.0)
    assert np.allclose(found[:2], expected[:2], atol=1e-4)
    assert found[2] == pytest.approx(float(wrap(expected[2])))


def test_a_spatial_pose_climbs_and_gains_stay() -> None:
    found, cov = pose_at_age(SPATIAL, np.zeros(4), np.zeros((4, 4)), FORWARD, 0.0, 2.0, 1.0)
    assert np.allclose(found, [1.0, 0.2, 0.4, 0.0])
    assert np.allclose(np.diag(cov), 4.0 * np.array([AWAY_M**2, AWAY_M**2, AWAY_M**2, TURNED_RAD**2]))
    found, cov = pose_at_age(UNICYCLE_GAINS, np.array([0.0, 0.0, 0.0, 1.1, 0.9]), np.eye(5), FORWARD, 0.3, 2.0, 1.0)
    assert np.array_equal(found[3:], [1.1, 0.9])
    assert np.array_equal(cov[3:, 3:], np.eye(2))


@pytest.mark.parametrize("age_s", [1.5, -1.5])
def test_the_covariance_of_a_pose_is_that_of_finite_differences_and_grows(age_s: float) -> None:
    mean, cov, step = np.array([1.0, -2.0, 0.4]), random_covariance(np.random.default_rng(3), 3), 1e-6

    def moved(start: Array) -> Array:
        return pose_at_age(UNICYCLE, start, cov, FORWARD, 0.6, age_s, 1.0)[0]

    F = np.column_stack([(moved(mean + step * unit) - moved(mean - step * unit)) / (2.0 * step) for unit in np.eye(3)])
    _, found = pose_at_age(UNICYCLE, mean, cov, FORWARD, 0.6, age_s, 1.0)
    away = np.diag([AWAY_M**2, AWAY_M**2, TURNED_RAD**2])
    assert np.allclose(found, F @ cov @ F.T + 1.5**2 * away, atol=1e-8)


def test_less_than_a_round_is_a_fraction_of_one_and_rounds_have_a_length() -> None:
    still = np.zeros(3)
    _, half = pose_at_age(UNICYCLE, still, np.zeros((3, 3)), still, 0.0, 0.5, 1.0)
    _, whole = pose_at_age(UNICYCLE, still, np.zeros((3, 3)), still, 0.0, 1.0, 1.0)
    _, short = pose_at_age(UNICYCLE, still, np.zeros((3, 3)), still, 0.0, 0.1, 0.2)
    assert np.allclose(half, 0.5 * whole)
    assert np.allclose(short, half)


@pytest.mark.parametrize("motion", [WALKER, DRIFTER])
def test_a_target_moves_on_and_back(motion: TargetMotion) -> None:
    mean = np.array([1.0, 2.0, 3.1]) if motion is WALKER else np.array([1.0, 2.0, 0.4, -0.2])
    cov = 0.01 * np.eye(len(mean))
    ahead, grown = target_at_age(motion, mean, cov, 2.0, "jacobian")
    back, wider = target_at_age(motion, ahead, grown, -2.0, "jacobian")
    assert np.allclose(back, mean, atol=1e-9)
    assert np.trace(cov) < np.trace(grown) < np.trace(wider)
    same = target_at_age(motion, mean, cov, 0.0, "jacobian")
    assert same[0] is mean and same[1] is cov


@given(SEED, st.sampled_from(["walker", "drifter"]), st.floats(0.2, 6.0))
@settings(max_examples=40)
def test_a_place_that_moved_on_bounds_the_true_error(seed: int, name: str, age_s: float) -> None:
    """Whatever the correlation of the robot's pose and of what is believed of the target."""
    rng = np.random.default_rng(seed)
    motion = WALKER if name == "walker" else DRIFTER
    n = motion.layout.dim
    mean, cov = np.array([1.0, 2.0, 0.4, 0.3])[:n], random_covariance(rng, n, 0.05)
    placed = Placed(np.array([1.2, 1.9]), random_covariance(rng, 2, 0.01), random_covariance(rng, 2, 0.1))
    found = place_at_age(motion, placed, mean, cov, age_s, "jacobian")
    moved = motion.drift(mean, cov, age_s, "jacobian")
    assert np.allclose(found.place - placed.place, moved.mean[:2] - mean[:2])
    assert np.array_equal(found.sensor, placed.sensor)
    joint = random_joint(rng, [placed.pose, cov])
    mix = np.hstack([np.eye(2), (moved.F - np.eye(n))[:2]])
    noise = (moved.cov - moved.F @ cov @ moved.F.T)[:2, :2]
    assert least_gap(found.pose, mix @ joint @ mix.T + noise) > -1e-9, seed


def test_a_place_goes_back_as_far_as_it_went() -> None:
    mean, cov = np.array([1.0, 2.0, 0.4]), 0.01 * np.eye(3)
    placed = Placed(np.array([1.2, 1.9]), 0.01 * np.eye(2), 0.02 * np.eye(2))
    ahead = place_at_age(WALKER, placed, mean, cov, 3.0, "unscented")
    back = place_at_age(WALKER, placed, mean, cov, -3.0, "unscented")
    assert np.allclose(ahead.place + back.place, 2.0 * placed.place)
    assert np.linalg.norm(ahead.place - placed.place) == pytest.approx(0.75, rel=0.02)
    assert np.array_equal(ahead.pose, back.pose)
    assert place_at_age(WALKER, placed, mean, cov, 0.0, "unscented") is placed


def test_a_sum_of_what_may_be_one_error_adds_deviations() -> None:
    assert bounded_sum(np.diag([4.0]), np.diag([9.0])) == pytest.approx(25.0)
    assert np.array_equal(bounded_sum(np.eye(2), np.zeros((2, 2))), np.eye(2))
    assert math.isfinite(bounded_sum(np.eye(1), 1e-200 * np.eye(1)).sum())
