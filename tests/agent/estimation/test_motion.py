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
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    CONSTANT_VELOCITY_3D,
    DAMPED_VELOCITY,
    DAMPED_VELOCITY_3D,
    LAYOUTS,
    SPATIAL,
    STATES,
    UNICYCLE,
    HeldAltitude,
    SpatialMotion,
    StateLayout,
    TargetMotion,
    advance,
    advance_spatial,
    between,
    compose,
    split_increment,
    velocity_step,
)
from network.wire_fields import MODEL_DIMS

Array = NDArray[np.float64]

METRE = st.floats(-50.0, 50.0)
POSE = st.tuples(METRE, METRE, st.floats(-3.14, 3.14)).map(np.array)
VELOCITY_LAYOUTS = (CONSTANT_VELOCITY, DAMPED_VELOCITY)
STEPPED = (*VELOCITY_LAYOUTS, CONSTANT_VELOCITY_3D, DAMPED_VELOCITY_3D, CONSTANT_ACCELERATION)


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


@pytest.mark.parametrize("layout", STEPPED)
@given(st.floats(1e-3, 20.0), st.floats(0.05, 0.95), st.floats(0.1, 1e5))
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


@pytest.mark.parametrize(
    ("layout", "rate"),
    [
        (CONSTANT_VELOCITY, 0.0),
        (DAMPED_VELOCITY, 0.5),
        (DAMPED_VELOCITY, 3.0),
        (CONSTANT_VELOCITY_3D, 0.0),
        (DAMPED_VELOCITY_3D, 0.5),
        (CONSTANT_ACCELERATION, 0.0),
    ],
)
@pytest.mark.parametrize("dt", [0.01, 0.4, 2.0])
def test_a_velocity_step_is_van_loans(layout: StateLayout, rate: float, dt: float) -> None:
    """Van Loan 1978: expm([[-A, G], [0, A^T]] dt) holds F and Q of dx = A x dt + noise."""
    n, axes = layout.dim, len(layout.position)
    A, G = np.zeros((n, n)), np.zeros((n, n))
    for row in range(n - axes):
        A[row, row + axes] = 1.0
    for row in range(n - axes, n):
        A[row, row], G[row, row] = -rate, 1.0
    blocks = expm(np.block([[-A, G], [np.zeros((n, n)), A.T]]) * dt)
    expected_F = blocks[n:, n:].T
    F, Q = velocity_step(layout, dt, 1.0 / rate if rate else 2.0)
    assert np.allclose(F, expected_F, rtol=1e-10, atol=1e-13)
    assert np.allclose(Q, expected_F @ blocks[:n, n:], rtol=1e-8, atol=1e-13)


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
    expected = {
        "unicycle": (3, (2,), 2, None),
        "unicycle_gains": (5, (2,), 2, None),
        "spatial": (4, (3,), 3, 2),
        "constant_velocity": (4, (), None, None),
        "damped_velocity": (4, (), None, None),
        "constant_velocity_3d": (6, (), None, 2),
        "damped_velocity_3d": (6, (), None, 2),
        "constant_acceleration": (6, (), None, None),
    }
    assert {n: (lay.dim, lay.angles, lay.heading, lay.altitude) for n, lay in STATES.items()} == expected
    assert {name: layout.name for name, layout in LAYOUTS.items() if name != layout.name} == {
        "quadrotor": "spatial",
        "planar_altitude": "spatial",
    }
    assert {name: layout.dim for name, layout in STATES.items()} == MODEL_DIMS


# --- with an altitude --------------------------------------------------------------------------------------

HELD = HeldAltitude(16.5, 0.1)
POSE3 = st.tuples(METRE, METRE, METRE, st.floats(-3.1, 3.1)).map(np.array)
COV4 = np.array([[0.2, 0.05, 0.01, 0.01], [0.05, 0.3, 0.02, 0.0], [0.01, 0.02, 0.25, 0.01], [0.01, 0.0, 0.01, 0.03]])
NOISE4 = np.diag([0.01, 0.02, 0.03, 0.001])


def moved_by_hand(state: Array, move: Array, held: HeldAltitude | None, w: float = 0.0) -> Array:
    pose = compose(state[[0, 1, 3]], move[[0, 1, 3]])
    return np.array([pose[0], pose[1], state[2] + move[2] if held is None else held.altitude_m + w, pose[2]])


@pytest.mark.parametrize("held", [None, HELD])
@given(POSE3, POSE3)
def test_the_jacobian_of_a_motion_in_space_is_the_finite_difference(
    held: HeldAltitude | None, mean: Array, move: Array
) -> None:
    assume(abs(float(wrap(mean[3] + move[3]))) < 3.1)
    found = advance_spatial(mean, COV4, move, NOISE4, "jacobian", held=held)
    step = 1e-6 * np.eye(4)
    F = np.stack([moved_by_hand(mean + d, move, held) - moved_by_hand(mean - d, move, held) for d in step], axis=1)
    G = np.stack(
        [moved_by_hand(mean, move + d, held, d[2]) - moved_by_hand(mean, move - d, held, -d[2]) for d in step], axis=1
    )
    noise = NOISE4.copy()
    if held is not None:
        noise[2, 2] = held.sigma_m**2
    F, G = F / 2e-6, G / 2e-6
    assert np.allclose(found.F, F, atol=1e-6)
    assert np.allclose(found.cov, F @ COV4 @ F.T + G @ noise @ G.T, rtol=1e-5, atol=1e-6)
    assert np.allclose(found.mean[:3], moved_by_hand(mean, move, held)[:3])


@pytest.mark.parametrize("held", [None, HELD])
@given(POSE3, st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2), st.floats(-1, 1)).map(np.array))
def test_the_unscented_motion_in_space_tends_to_the_jacobian(
    held: HeldAltitude | None, mean: Array, move: Array
) -> None:
    small = 1e-8
    held = None if held is None else HeldAltitude(held.altitude_m, 1e-5)
    first = advance_spatial(mean, COV4 * small, move, NOISE4 * small, "jacobian", held=held)
    full = advance_spatial(mean, COV4 * small, move, NOISE4 * small, "unscented", held=held)
    assert np.allclose(full.mean[:3], first.mean[:3], atol=1e-6)
    assert abs(float(wrap(full.mean[3] - first.mean[3]))) < 1e-9
    assert np.allclose(full.F, first.F, atol=1e-6)
    assert np.allclose(full.cov, first.cov, rtol=1e-5, atol=1e-6 * small)


@pytest.mark.parametrize("transform", ["unscented", "linearized", "jacobian"])
def test_a_held_altitude_forgets_the_one_before(transform: str) -> None:
    """UT-CLAT eq. 33: z' = z_c + w, so F has a zero row, P_zz is the noise alone, and P can still be inverted."""
    motion = SpatialMotion(held=HELD)
    moved = motion.advance(
        np.array([1.0, 2.0, 99.0, 3.0]), COV4, np.array([0.3, 0.0, 0.5, 0.4]), NOISE4, 0.1, transform
    )  # type: ignore[arg-type]
    assert moved.mean[2] == pytest.approx(16.5)
    assert np.allclose(moved.F[2], 0.0)
    assert np.allclose(moved.cov[2], [0.0, 0.0, 0.01, 0.0], atol=1e-12)
    assert np.linalg.eigvalsh(moved.cov).min() > 1e-4


@given(POSE3, POSE3)
def test_a_motion_in_space_is_the_planar_one_and_a_climb(mean: Array, move: Array) -> None:
    cov = COV4.copy()
    cov[2, [0, 1, 3]] = cov[[0, 1, 3], 2] = 0.0
    planar = advance(mean[[0, 1, 3]], cov[np.ix_((0, 1, 3), (0, 1, 3))], move, NOISE4, "jacobian")
    spatial = SpatialMotion().advance(mean, cov, move, NOISE4, 1.0, "jacobian")
    assert np.allclose(spatial.mean[[0, 1, 3]], planar.mean)
    assert np.allclose(spatial.cov[np.ix_((0, 1, 3), (0, 1, 3))], planar.cov)
    assert spatial.mean[2] == pytest.approx(mean[2] + move[2])
    assert spatial.cov[2, 2] == pytest.approx(0.25 + 0.03)


@pytest.mark.parametrize("held", [None, HELD])
@given(st.floats(0.05, 0.95))
def test_an_altitude_is_the_same_however_the_increment_is_cut(held: HeldAltitude | None, share: float) -> None:
    mean, move = np.array([1.0, 2.0, 15.0, 0.4]), np.array([0.8, 0.1, 0.6, 0.3])
    motion = SpatialMotion(held=held)
    whole = motion.advance(mean, COV4, move, NOISE4, 1.0, "jacobian")
    first, first_cov, second, second_cov = split_increment(move, NOISE4, share)
    half = motion.advance(mean, COV4, first, first_cov, share, "jacobian")
    both = motion.advance(half.mean, half.cov, second, second_cov, 1.0 - share, "jacobian")
    assert np.allclose(both.mean, whole.mean)
    assert np.allclose(both.F @ half.F, whole.F)
    assert both.cov[2, 2] == pytest.approx(whole.cov[2, 2])


def test_a_target_on_the_ground_drifts_in_the_plane_at_its_altitude() -> None:
    ground = TargetMotion(SPATIAL, (0.5, 0.1), (0.1, 0.05), noise_step_s=0.5, held=HeldAltitude(0.0, 0.05))
    planar = TargetMotion(UNICYCLE, (0.5, 0.1), (0.1, 0.05), noise_step_s=0.5)
    cov = np.diag([0.1, 0.2, 0.25, 0.01])
    drifted = ground.drift(np.array([1.0, 2.0, 0.7, 0.3]), cov, 0.5, "unscented")
    flat = planar.drift(np.array([1.0, 2.0, 0.3]), np.diag([0.1, 0.2, 0.01]), 0.5, "unscented")
    assert np.allclose(drifted.mean, [flat.mean[0], flat.mean[1], 0.0, flat.mean[2]], atol=2e-3)
    assert np.allclose(drifted.cov[np.ix_((0, 1, 3), (0, 1, 3))], flat.cov, rtol=0.05, atol=1e-4)
    assert drifted.cov[2, 2] == pytest.approx(0.0025)


@pytest.mark.parametrize("layout", [CONSTANT_VELOCITY_3D, DAMPED_VELOCITY_3D, CONSTANT_ACCELERATION])
def test_each_axis_is_driven_by_its_own_noise(layout: StateLayout) -> None:
    axes = len(layout.position)
    sigma = (0.3, 0.1, 0.2)[:axes]
    motion = TargetMotion(layout, noise_sigma=sigma, noise_step_s=0.5, damping_s=1.5)
    drifted = motion.drift(np.arange(6.0), np.eye(6) * 1e-12, 2.0, "unscented")
    _, Q = velocity_step(layout, 2.0, 1.5)
    for axis, one in enumerate(sigma):
        own = np.arange(axis, 6, axes)
        assert np.allclose(drifted.cov[np.ix_(own, own)], 0.5 * one**2 * Q[np.ix_(own, own)], rtol=1e-6, atol=1e-10)
        others = np.setdiff1d(np.arange(6), own)
        assert np.allclose(drifted.cov[np.ix_(own, others)], 0.0)


@pytest.mark.parametrize("layout", [UNICYCLE, SPATIAL])
@pytest.mark.parametrize("sigma", [0.5, 2.0, 4.0])
def test_a_heading_nobody_knows_is_not_made_known_by_moving(layout: StateLayout, sigma: float) -> None:
    """Deviations beyond half a turn are deviations still: wrapped, they would shrink the variance."""
    heading, turned = layout.dim - 1, 0.2
    cov = np.diag([0.1] * heading + [sigma**2])
    noise = np.diag([1e-4, 1e-4, 1e-4, 1e-2])
    move = advance if layout is UNICYCLE else advance_spatial
    moved = move(np.zeros(layout.dim), cov, np.array([0.1, 0.0, 0.0, turned]), noise, "unscented")
    assert moved.cov[heading, heading] == pytest.approx(sigma**2 + 1e-2)
    assert moved.mean[heading] == pytest.approx(turned)
    assert moved.F[heading, heading] == pytest.approx(1.0)
