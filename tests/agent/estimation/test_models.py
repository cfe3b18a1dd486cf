"""Motion and observation models: Jacobians against finite differences, composition, known values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import TWO_PI, square_root, wrap
from agent.estimation.motion import (
    CONSTANT_VELOCITY,
    DAMPED_VELOCITY,
    UNICYCLE,
    TargetMotion,
    advance,
    between,
    compose,
    split_increment,
    velocity_step,
)
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.odometry import OdometryNoise

Array = NDArray[np.float64]

ANGLE = st.floats(-20.0, 20.0)
METRE = st.floats(-20.0, 20.0)
POSE = st.tuples(METRE, METRE, st.floats(-3.1, 3.1)).map(np.array)
MOUNT = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))


@given(ANGLE)
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    wrapped = float(wrap(np.array(angle)))
    assert -math.pi < wrapped <= math.pi
    assert math.isclose((angle - wrapped) / TWO_PI, round((angle - wrapped) / TWO_PI), abs_tol=1e-9)


def test_square_root_takes_semidefinite_and_refuses_indefinite() -> None:
    for cov in (np.diag([1.0, 0.0, 4.0]), np.array([[1.0, 1.0], [1.0, 1.0]]), np.zeros((2, 2))):
        root = square_root(cov)
        assert np.allclose(root @ root.T, cov)
    with pytest.raises(np.linalg.LinAlgError):
        square_root(np.diag([1.0, -1e-3]))


@given(POSE, POSE)
def test_between_undoes_compose(start: Array, delta: Array) -> None:
    assert np.allclose(between(start, compose(start, delta))[:2], delta[:2], atol=1e-9)


@given(POSE, POSE, st.floats(0.01, 0.99))
def test_a_split_increment_composes_to_the_whole(start: Array, move: Array, fraction: float) -> None:
    delta = np.array([move[0], move[1], 0.3, move[2]])
    first, first_cov, second, second_cov = split_increment(delta, np.eye(4), fraction)
    planar = [0, 1, 3]
    whole = compose(start, delta[planar])
    parts = compose(compose(start, first[planar]), second[planar])
    assert np.allclose(whole[:2], parts[:2], atol=1e-8)
    assert abs(float(wrap(np.array(whole[2] - parts[2])))) < 1e-9
    assert np.allclose(first_cov + second_cov, np.eye(4))


def finite_difference(function: object, at: Array) -> Array:
    columns = []
    for index in range(len(at)):
        step = np.zeros(len(at))
        step[index] = 1e-6
        columns.append((function(at + step) - function(at - step)) / 2e-6)  # type: ignore[operator]
    return np.stack(columns, axis=-1)


@given(POSE, POSE, MOUNT, st.sampled_from(["range", "bearing", "range_bearing"]), st.booleans())
def test_relative_jacobians(
    observer: Array, subject: Array, mount: tuple[float, float, float], kind: str, fixed: bool
) -> None:
    landmark = (float(subject[0]), float(subject[1])) if fixed else None
    model = RelativeModel(kind, 3, mount, landmark)
    at = observer if fixed else np.concatenate([observer, subject])
    if float(RelativeModel("range", 3, mount, landmark).h(at)[0]) < 0.1:
        return
    numeric = finite_difference(model.h, at)
    # A bearing near pi jumps by a turn between the two sides of a difference.
    if np.abs(numeric).max() > 1e5:
        return
    assert np.allclose(model.jacobian(at), numeric, atol=1e-5)


def test_known_measurements() -> None:
    ahead = np.array([1.0, 1.0, math.pi / 2, 1.0, 4.0, 0.0])
    assert np.allclose(RelativeModel("range_bearing", 3).h(ahead), [3.0, 0.0])
    left = np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])
    assert np.allclose(RelativeModel("range_bearing", 3).h(left), [2.0, math.pi / 2])
    # A camera one metre ahead of the centre, looking left, sees the same point behind and to its left.
    camera = RelativeModel("range_bearing", 3, mount=(1.0, 0.0, math.pi / 2))
    assert np.allclose(camera.h(left), [math.sqrt(5.0), math.atan2(2.0, -1.0) - math.pi / 2])
    assert AbsoluteModel("heading", 3).h(left[:3]).tolist() == [0.0]


def test_advance_jacobian() -> None:
    mean, delta = np.array([1.0, 2.0, 0.7]), np.array([0.4, -0.1, 0.0, 0.2])
    numeric = finite_difference(lambda x: compose(x, delta[[0, 1, 3]]), mean)
    first = advance(mean, np.eye(3) * 1e-6, delta, np.eye(4) * 1e-6, "jacobian")
    full = advance(mean, np.eye(3) * 1e-6, delta, np.eye(4) * 1e-6, "unscented")
    assert np.allclose(first.F, numeric, atol=1e-8)
    assert np.allclose(full.F, first.F, atol=1e-5)
    assert np.allclose(full.cov, first.cov, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("layout", [CONSTANT_VELOCITY, DAMPED_VELOCITY])
def test_two_half_steps_are_one_step(layout: object) -> None:
    F, Q = velocity_step(layout, 0.8, 1.7)  # type: ignore[arg-type]
    half_F, half_Q = velocity_step(layout, 0.4, 1.7)  # type: ignore[arg-type]
    assert np.allclose(half_F @ half_F, F, atol=1e-12)
    assert np.allclose(half_F @ half_Q @ half_F.T + half_Q, Q, atol=1e-12)


def test_a_targets_drift_covers_where_it_goes() -> None:
    """A thousand targets driven by noisy controls: the drifted covariance is that of their ends (seed 3)."""
    rng = np.random.default_rng(3)
    motion = TargetMotion(UNICYCLE, (0.5, 0.1), (0.1, 0.05), 1.0)
    mean, cov = np.array([1.0, -2.0, 0.4]), np.diag([0.04, 0.04, 0.01])
    ends = rng.multivariate_normal(mean, cov, size=4000)
    for _ in range(5):
        control = np.array([0.5, 0.0, 0.1]) + rng.normal(size=(4000, 3)) * np.array([0.1, 0.0, 0.05])
        ends = compose(ends, control)
        drifted = motion.drift(mean, cov, 1.0, "unscented")
        mean, cov = drifted.mean, drifted.cov
    assert np.allclose(ends.mean(axis=0), mean, atol=0.02)
    assert np.allclose(np.cov(ends.T), cov, atol=0.08 * float(np.abs(cov).max()))


def test_odometry_noise_grows_with_time_way_and_turn() -> None:
    noise = OdometryNoise(
        along_m_per_sqrt_s=0.1, along_m_per_sqrt_m=0.2, heading_rad_per_sqrt_s=0.01, heading_rad_per_sqrt_rad=0.1
    )
    cov = noise.covariance(np.array([3.0, 4.0, 0.0, -0.5]), 2.0)
    assert np.allclose(np.diagonal(cov), [0.02 + 0.2, 0.0, 0.0008, 0.0002 + 0.005])
    scaled = OdometryNoise(scale_along=0.9, scale_turn=0.8).calibrated(np.array([1.0, 1.0, 1.0, 1.0]))
    assert np.allclose(scaled, [0.9, 0.9, 1.0, 0.8])
