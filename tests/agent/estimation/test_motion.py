"""Motion models: the group of planar poses, their derivatives, and noise that doesn't depend on how time is cut."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from agent.estimation.gaussian import square_root, wrap
from agent.estimation.motion import (
    CONSTANT_VELOCITY,
    DAMPED_VELOCITY,
    LAYOUTS,
    UNICYCLE,
    StateLayout,
    TargetMotion,
    advance,
    between,
    compose,
    split_increment,
    velocity_step,
)

Array = NDArray[np.float64]

METRE = st.floats(-50.0, 50.0)
POSE = st.tuples(METRE, METRE, st.floats(-3.14, 3.14)).map(np.array)
VELOCITY_LAYOUTS = (CONSTANT_VELOCITY, DAMPED_VELOCITY)


def assert_same_pose(first: Array, second: Array) -> None:
    assert np.allclose(first[..., :2], second[..., :2], atol=1e-9)
    assert np.abs(wrap(first[..., 2] - second[..., 2])).max() < 1e-9


@given(POSE, POSE)
def test_compose_and_between_are_inverse_either_way(start: Array, other: Array) -> None:
    assert_same_pose(between(start, compose(start, other)), other)
    assert_same_pose(compose(start, between(start, other)), other)


@given(POSE, POSE, POSE)
def test_composition_is_associative(first: Array, second: Array, third: Array) -> None:
    assert_same_pose(compose(compose(first, second), third), compose(first, compose(second, third)))


def test_composition_of_known_poses() -> None:
    """Facing north, two metres ahead and one to the left."""
    assert np.allclose(compose(np.array([5.0, 1.0, np.pi / 2]), np.array([2.0, 1.0, 0.5])), [4.0, 3.0, np.pi / 2 + 0.5])
    poses, steps = np.zeros((4, 1, 3)), np.ones((1, 5, 3))
    assert compose(poses, steps).shape == (4, 5, 3)


@given(POSE, POSE, st.floats(0.01, 0.99), METRE)
def test_the_parts_of_a_split_increment_compose_to_the_whole(
    start: Array, move: Array, fraction: float, climb: float
) -> None:
    delta = np.array([move[0], move[1], climb, move[2]])
    cov = np.diag([0.1, 0.2, 0.3, 0.4])
    first, first_cov, second, second_cov = split_increment(delta, cov, fraction)
    planar = [0, 1, 3]
    assert_same_pose(compose(compose(start, first[planar]), second[planar]), compose(start, delta[planar]))
    assert first[2] + second[2] == pytest.approx(climb)
    assert np.allclose(first, delta * fraction)
    assert np.allclose(first_cov, cov * fraction)
    assert np.allclose(first_cov + second_cov, cov)


@given(POSE, POSE)
def test_the_jacobian_of_advance_is_the_finite_difference(mean: Array, move: Array) -> None:
    assume(abs(float(wrap(mean[2] + move[2]))) < 3.1)
    delta = np.array([move[0], move[1], 0.4, move[2]])
    cov = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.002], [0.0, 0.002, 0.01]])
    noise = np.diag([0.01, 0.02, 5.0, 0.001])
    found = advance(mean, cov, delta, noise, "jacobian")
    step = 1e-6 * np.eye(3)
    F = (compose(mean + step, move) - compose(mean - step, move)).T / 2e-6
    G = (compose(mean, move + step) - compose(mean, move - step)).T / 2e-6
    planar = noise[np.ix_((0, 1, 3), (0, 1, 3))]
    assert_same_pose(found.mean, compose(mean, move))
    assert np.allclose(found.F, F, atol=1e-6)
    assert np.allclose(found.cov, F @ cov @ F.T + G @ planar @ G.T, rtol=1e-6, atol=1e-6)


@given(POSE, st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-1.0, 1.0)))
def test_the_unscented_advance_tends_to_the_jacobian(mean: Array, move: tuple[float, float, float]) -> None:
    delta, cov, noise = np.array([move[0], move[1], 0.0, move[2]]), np.eye(3), np.diag([1.0, 2.0, 0.0, 0.5])
    small = 1e-8
    first = advance(mean, cov * small, delta, noise * small, "jacobian")
    full = advance(mean, cov * small, delta, noise * small, "unscented")
    assert np.allclose(full.mean[:2], first.mean[:2], atol=1e-6)
    assert abs(float(wrap(full.mean[2] - first.mean[2]))) < 1e-9
    assert np.allclose(full.F, first.F, atol=1e-6)
    assert np.allclose(full.cov, first.cov, rtol=1e-5, atol=1e-6 * small)


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_advance_wraps_the_heading_and_takes_increments_without_noise(transform: str) -> None:
    moved = advance(
        np.array([0.0, 0.0, 3.0]), np.eye(3) * 1e-4, np.array([0.0, 0.0, 0.0, 0.5]), np.zeros((4, 4)), transform
    )  # type: ignore[arg-type]
    assert float(moved.mean[2]) == pytest.approx(3.5 - 2.0 * np.pi)
    assert np.allclose(moved.cov, np.eye(3) * 1e-4)
    assert np.allclose(moved.F, np.eye(3))


@pytest.mark.parametrize("layout", VELOCITY_LAYOUTS)
@given(st.floats(1e-5, 20.0), st.floats(0.05, 0.95), st.floats(0.1, 1e5))
def test_a_velocity_step_is_its_parts_in_turn(
    layout: StateLayout, dt: float, fraction: float, damping_s: float
) -> None:
    F, Q = velocity_step(layout, dt, damping_s)
    F_a, Q_a = velocity_step(layout, dt * fraction, damping_s)
    F_b, Q_b = velocity_step(layout, dt * (1.0 - fraction), damping_s)
    assert np.allclose(F_b @ F_a, F, rtol=1e-12, atol=1e-12)
    assert np.allclose(F_b @ Q_a @ F_b.T + Q_b, Q, rtol=1e-11, atol=1e-30)


@pytest.mark.parametrize("layout", VELOCITY_LAYOUTS)
def test_two_half_steps_of_a_velocity_model_are_one(layout: StateLayout) -> None:
    F, Q = velocity_step(layout, 1.0, 2.0)
    half_F, half_Q = velocity_step(layout, 0.5, 2.0)
    assert np.abs(half_F @ half_F - F).max() < 1e-12
    assert np.abs(half_F @ half_Q @ half_F.T + half_Q - Q).max() < 1e-12


@given(st.floats(1e-6, 100.0), st.floats(1e-2, 1e6))
def test_the_noise_of_a_damped_velocity_is_a_covariance_however_short_the_step(dt: float, damping_s: float) -> None:
    _, Q = velocity_step(DAMPED_VELOCITY, dt, damping_s)
    scale = 1.0 / np.sqrt(np.diagonal(Q))
    assert np.all(np.isfinite(scale))
    assert np.linalg.eigvalsh(Q * np.outer(scale, scale)).min() > 0.0
    square_root(Q)


@pytest.mark.parametrize(("layout", "rate"), [(CONSTANT_VELOCITY, 0.0), (DAMPED_VELOCITY, 0.5), (DAMPED_VELOCITY, 3.0)])
@pytest.mark.parametrize("dt", [0.01, 0.4, 2.0])
def test_a_velocity_step_is_van_loans(layout: StateLayout, rate: float, dt: float) -> None:
    """Van Loan 1978: expm([[-A, G], [0, A^T]] dt) holds F and Q of dx = A x dt + noise."""
    A, G = np.zeros((4, 4)), np.diag([0.0, 0.0, 1.0, 1.0])
    A[0, 2] = A[1, 3] = 1.0
    A[2, 2] = A[3, 3] = -rate
    blocks = expm(np.block([[-A, G], [np.zeros((4, 4)), A.T]]) * dt)
    expected_F = blocks[4:, 4:].T
    F, Q = velocity_step(layout, dt, 1.0 / rate if rate else 2.0)
    assert np.allclose(F, expected_F, rtol=1e-10, atol=1e-13)
    assert np.allclose(Q, expected_F @ blocks[:4, 4:], rtol=1e-8, atol=1e-13)


def test_a_weakly_damped_velocity_is_a_constant_velocity() -> None:
    damped, constant = velocity_step(DAMPED_VELOCITY, 0.001, 1e9), velocity_step(CONSTANT_VELOCITY, 0.001, 1e9)
    assert np.allclose(damped[0], constant[0], rtol=1e-9)
    assert np.allclose(damped[1], constant[1], rtol=1e-9)


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_two_half_drifts_of_a_unicycle_have_nearly_the_noise_of_one(transform: str) -> None:
    motion = TargetMotion(UNICYCLE, (0.5, 0.1), (0.1, 0.05), noise_step_s=1.0)
    mean, cov = np.array([1.0, 2.0, 0.4]), np.diag([1e-8, 1e-8, 1e-8])
    one = motion.drift(mean, cov, 1.0, transform)  # type: ignore[arg-type]
    half = motion.drift(mean, cov, 0.5, transform)  # type: ignore[arg-type]
    two = motion.drift(half.mean, half.cov, 0.5, transform)  # type: ignore[arg-type]
    assert np.allclose(two.mean, one.mean, atol=0.02)
    # Position variance along the way and heading variance are those of one step; a control held over the whole
    # step puts turns only at its end.
    assert np.allclose(np.linalg.eigvalsh(two.cov[:2, :2])[1], np.linalg.eigvalsh(one.cov[:2, :2])[1], rtol=0.05)
    assert float(two.cov[2, 2]) == pytest.approx(float(one.cov[2, 2]), rel=1e-9)


def test_noise_of_a_held_control_keeps_its_spectral_density() -> None:
    """The declared sigma is that of a control held over `noise_step_s`: in one such step it is that exactly."""
    motion = TargetMotion(UNICYCLE, (0.0, 0.0), (0.3, 0.2), noise_step_s=0.5)
    tiny = np.eye(3) * 1e-12
    for dt, steps in ((0.5, 1.0), (2.0, 4.0), (0.125, 0.25)):
        drifted = motion.drift(np.zeros(3), tiny, dt, "jacobian")
        assert float(drifted.cov[0, 0]) == pytest.approx(steps * (0.3 * 0.5) ** 2, rel=1e-6)
        assert float(drifted.cov[2, 2]) == pytest.approx(steps * (0.2 * 0.5) ** 2, rel=1e-6)


@pytest.mark.parametrize("layout", VELOCITY_LAYOUTS)
def test_drift_of_a_velocity_model_covers_targets_pushed_at_random(layout: StateLayout) -> None:
    """20 000 targets with white acceleration noise, integrated in 200 fine steps (seed 31)."""
    rng = np.random.default_rng(31)
    motion = TargetMotion(layout, noise_sigma=(0.3, 0.1), noise_step_s=0.5, damping_s=1.5)
    mean, cov = np.array([1.0, 2.0, 0.5, -0.4]), np.diag([0.04, 0.09, 0.01, 0.02])
    count, steps, dt = 20_000, 200, 2.0
    targets, fine = rng.multivariate_normal(mean, cov, size=count), dt / steps
    rate = 0.0 if layout is CONSTANT_VELOCITY else 1.0 / 1.5
    push = np.array([0.3, 0.1]) * np.sqrt(0.5 * fine)
    for _ in range(steps):
        middle = targets[:, 2:] * (1.0 - 0.5 * rate * fine)
        targets[:, :2] += fine * middle
        targets[:, 2:] += rng.normal(size=(count, 2)) * push - rate * fine * middle
    drifted = motion.drift(mean, cov, dt, "unscented")
    deviation = np.sqrt(np.diagonal(drifted.cov))
    assert np.all(np.abs(targets.mean(axis=0) - drifted.mean) < 5.0 * deviation / np.sqrt(count))
    assert np.allclose(
        np.cov(targets.T) / np.outer(deviation, deviation), drifted.cov / np.outer(deviation, deviation), atol=0.05
    )


def test_drift_of_a_unicycle_covers_targets_driven_at_random() -> None:
    """20 000 unicycles with noise on speed and turn, each held over the declared step (seed 32)."""
    rng = np.random.default_rng(32)
    motion = TargetMotion(UNICYCLE, (0.6, 0.2), (0.2, 0.1), noise_step_s=1.0)
    mean, cov, count = np.array([0.0, 1.0, 3.0]), np.diag([0.02, 0.03, 0.01]), 20_000
    targets = rng.multivariate_normal(mean, cov, size=count)
    for _ in range(4):
        noise = rng.normal(size=(count, 2)) * np.array([0.2, 0.1])
        targets = compose(targets, np.stack([0.6 + noise[:, 0], np.zeros(count), 0.2 + noise[:, 1]], axis=-1))
        drifted = motion.drift(mean, cov, 1.0, "unscented")
        mean, cov = drifted.mean, drifted.cov
    error = np.column_stack([targets[:, :2] - mean[:2], wrap(targets[:, 2] - mean[2])])
    deviation = np.sqrt(np.diagonal(cov))
    assert np.all(np.abs(error.mean(axis=0)) < 0.06 * deviation)
    assert np.allclose(
        (error.T @ error / count) / np.outer(deviation, deviation), cov / np.outer(deviation, deviation), atol=0.05
    )


def test_layouts_are_known_by_their_names() -> None:
    assert {name: (layout.dim, layout.angles, layout.heading) for name, layout in LAYOUTS.items()} == {
        "unicycle": (3, (2,), 2),
        "unicycle_gains": (5, (2,), 2),
        "constant_velocity": (4, (), None),
        "damped_velocity": (4, (), None),
        "constant_velocity_3d": (6, (), None),
        "damped_velocity_3d": (6, (), None),
        "constant_acceleration": (6, (), None),
        "quadrotor": (4, (3,), 3),
        "planar_altitude": (4, (3,), 3),
    }
