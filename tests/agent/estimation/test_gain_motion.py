"""A unicycle that learns the gains of its odometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.estimation.gain_motion import ALONG, TURN, GainMotion, _linearized, scaled
from agent.estimation.motion import LAYOUTS, RobotMotion, compose
from agent.estimation.observation import AbsoluteModel
from agent.estimation.unscented import observe

UNIT = st.floats(-1.0, 1.0)
GAIN = st.floats(0.5, 1.5)


def spread(seed: int) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(5, 5)) * 0.1
    return np.asarray(root @ root.T + 1e-4 * np.eye(5))


@settings(deadline=None, max_examples=50)
@given(along=GAIN, turn=GAIN, speed=UNIT, yaw=st.floats(-0.5, 0.5))
def test_scaled_is_the_arc_driven_with_scaled_rates(along: float, turn: float, speed: float, yaw: float) -> None:
    def arc(distance: float, angle: float) -> np.ndarray:
        chord = distance * np.sinc(angle / 2.0 / np.pi)
        return np.array([chord * np.cos(angle / 2.0), chord * np.sin(angle / 2.0), angle])

    state = np.array([0.0, 0.0, 0.0, along, turn])
    np.testing.assert_allclose(scaled(state, arc(speed, yaw)), arc(along * speed, turn * yaw), atol=0.03 * abs(speed))


@settings(deadline=None, max_examples=50)
@given(pose=st.tuples(UNIT, UNIT, st.floats(-1.0, 1.0)), along=GAIN, turn=GAIN, delta=st.tuples(UNIT, UNIT, UNIT))
def test_the_jacobian_is_the_derivative(
    pose: tuple[float, float, float], along: float, turn: float, delta: tuple[float, float, float]
) -> None:
    mean, increment = np.array([*pose, along, turn]), np.array(delta)

    def move(state: np.ndarray) -> np.ndarray:
        image = state.copy()
        image[:3] = compose(state[:3], scaled(state, increment))
        return image

    moved, F, G = _linearized(mean, increment)
    np.testing.assert_allclose(moved, move(mean), atol=1e-12)
    step = 1e-6 * np.eye(5)
    numeric = np.stack([(move(mean + e) - move(mean - e)) / 2e-6 for e in step], axis=1)
    np.testing.assert_allclose(F, numeric, atol=1e-7)
    cos, sin = np.cos(mean[2]), np.sin(mean[2])
    np.testing.assert_allclose(G[:3], [[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_known_gains_of_one_move_like_a_plain_unicycle(transform: str) -> None:
    cov = np.diag([0.04, 0.02, 0.01, 1e-12, 1e-12])
    cov[0, 1] = cov[1, 0] = 0.01
    mean = np.array([1.0, -2.0, 0.4, 1.0, 1.0])
    delta, noise = np.array([0.3, 0.01, 0.0, 0.2]), np.diag([1e-4, 1e-6, 1e-4, 1e-5])
    plain = RobotMotion().advance(mean[:3], cov[:3, :3], delta, noise, 0.1, transform)  # type: ignore[arg-type]
    gains = GainMotion(walk=0.0).advance(mean, cov, delta, noise, 0.1, transform)  # type: ignore[arg-type]
    np.testing.assert_allclose(gains.mean[:3], plain.mean, atol=1e-4)
    np.testing.assert_allclose(gains.cov[:3, :3], plain.cov, atol=2e-5)
    np.testing.assert_allclose(gains.mean[3:], [1.0, 1.0])


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), dt_s=st.floats(0.01, 1.0))
def test_both_transforms_agree_on_small_increments(seed: int, dt_s: float) -> None:
    rng = np.random.default_rng(seed)
    cov, mean = 0.01 * spread(seed), np.array([*rng.normal(size=3), 0.9, 1.1])
    mean[2] = np.clip(mean[2], -2.5, 2.5)
    delta, noise = np.append(0.1 * rng.normal(size=3), 0.1 * rng.normal()), np.diag([1e-4, 1e-5, 1e-4, 1e-4])
    one = GainMotion().advance(mean, cov, delta, noise, dt_s, "unscented")
    other = GainMotion().advance(mean, cov, delta, noise, dt_s, "jacobian")
    np.testing.assert_allclose(one.mean, other.mean, atol=2e-3)
    np.testing.assert_allclose(one.cov, other.cov, atol=2e-4)


def test_gains_walk_with_time_however_it_is_cut() -> None:
    mean, cov = np.array([0.0, 0.0, 0.0, 1.0, 1.0]), 1e-6 * np.eye(5)
    motion, still = GainMotion(walk=0.01), np.zeros((4, 4))
    for transform in ("unscented", "jacobian"):
        whole = motion.advance(mean, cov, np.zeros(4), still, 4.0, transform)  # type: ignore[arg-type]
        first = motion.advance(mean, cov, np.zeros(4), still, 1.0, transform)  # type: ignore[arg-type]
        second = motion.advance(first.mean, first.cov, np.zeros(4), still, 3.0, transform)  # type: ignore[arg-type]
        assert whole.cov[ALONG, ALONG] == pytest.approx(1e-6 + 4e-4)
        np.testing.assert_allclose(second.cov, whole.cov, atol=1e-12)


def test_a_robot_with_position_fixes_learns_its_gains() -> None:
    layout = LAYOUTS["unicycle_gains"]
    motion, rng = GainMotion(walk=0.0), np.random.default_rng(1)
    pose, mean, cov = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0, 1.0]), np.diag([1e-4, 1e-4, 1e-4, 0.04, 0.04])
    noise, R = np.diag([1e-6, 1e-8, 1e-8, 1e-6]), 1e-4 * np.eye(2)
    model = AbsoluteModel("position", layout)
    for _ in range(400):
        reported = np.array([0.02, 0.0, 0.0, 0.02])
        truly = scaled(np.array([*pose, 0.85, 0.9]), reported[[0, 1, 3]])
        pose = compose(pose, truly)
        moved = motion.advance(mean, cov, reported, noise, 0.1, "unscented")
        predicted = observe(model.h, model.jacobian, moved.mean, moved.cov, ())
        K = predicted.cross @ np.linalg.inv(predicted.cov + R)
        z = pose[:2] + 0.01 * rng.normal(size=2)
        mean, cov = moved.mean + K @ (z - predicted.z), moved.cov - K @ (predicted.cov + R) @ K.T
    assert mean[ALONG] == pytest.approx(0.85, abs=0.02)
    assert mean[TURN] == pytest.approx(0.9, abs=0.02)
    assert np.sqrt(cov[TURN, TURN]) < 0.01


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_a_heading_nobody_knows_any_more_stays_unknown(transform: str) -> None:
    mean, cov = np.array([0.0, 0.0, 3.0, 1.0, 1.0]), np.diag([0.1, 0.1, 4.0, 0.01, 0.01])
    delta, noise = np.array([0.1, 0.0, 0.0, 0.3]), np.diag([1e-4, 0.0, 0.0, 1e-3])
    moved = GainMotion().advance(mean, cov, delta, noise, 0.1, transform)  # type: ignore[arg-type]
    assert moved.cov[2, 2] >= 4.0
    assert -np.pi < moved.mean[2] <= np.pi
