"""Heights, ranges and bearings between robots: Jacobians, the second order of a range, gates, corrections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from agent.estimation.relative_sights import (
    corrected,
    density,
    direction,
    distance,
    height,
    inverse2,
    residuals,
    squared,
    turned_to,
    widened,
)
from tests.agent.estimation.test_relative_motion import SEED, a_cov, a_state
from tests.assertions import assert_covariance

Array = NDArray[np.float64]

NOISE = np.array([[0.0036, 0.0005], [0.0005, 0.0025]])


def expected(x: Array) -> Array:
    """h, r, az, el of states (..., 4)."""
    flat = np.hypot(x[..., 0], x[..., 1])
    return np.stack(
        [x[..., 2], np.hypot(flat, x[..., 2]), np.arctan2(x[..., 1], x[..., 0]), np.arctan2(x[..., 2], flat)], axis=-1
    )


def zero(value: float = 0.0) -> Array:
    return np.asarray(value)


@given(SEED)
def test_jacobians_are_those_of_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P, h = a_state(rng), 1e-9 * np.eye(4), 1e-6
    if np.hypot(x[0], x[1]) < 0.5:
        x[0] += 2.0
    step = [expected(x + h * unit) - expected(x - h * unit) for unit in np.eye(4)]
    J = np.angle(np.exp(1j * np.stack(step, axis=-1))) / (2.0 * h)
    assert np.allclose(height(x, P, zero(), zero()).H, J[0], atol=1e-6)
    assert np.allclose(distance(x, P, zero(), zero(), second=True).H, J[1], atol=1e-6)
    assert np.allclose(direction(x, P, NOISE, modified=False).H, J[2:], atol=1e-6)
    assert np.allclose(direction(x, P, NOISE, modified=False).expected, expected(x)[2:])


def test_a_range_is_expected_with_the_mean_and_variance_of_samples() -> None:
    """Of a place that is known well along and badly across, as after many ranges: linearized, neither would do."""
    seed = 3
    rng = np.random.default_rng(seed)
    x, u = np.array([4.0, 3.0, 1.0, 0.0]), np.array([0.8, 0.6, 0.0, 0.0])
    P = 0.5 * np.eye(4) - 0.498 * np.outer(u, u)
    P[2, 2] = 0.01
    r = expected(rng.multivariate_normal(x, P, 400_000))[:, 1]
    second = distance(x, P, zero(r.mean()), zero(), second=True)
    first = distance(x, P, zero(r.mean()), zero(), second=False)
    assert abs(float(second.residual)) < 0.2 * abs(float(first.residual)), f"seed {seed}"
    assert float(second.variance) == pytest.approx(float(r.var()), rel=0.25)
    assert float(first.variance) < 0.5 * float(second.variance)


@given(SEED)
def test_corrections_are_those_of_a_kalman_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = a_state(rng), a_cov(rng)
    x[0] += np.copysign(6.0, x[0])
    for sight in (height(x, P, zero(1.0), zero(0.2)), distance(x, P, zero(9.0), zero(0.3), second=False)):
        variance = sight.H @ P @ sight.H + (0.2 if sight.H[2] == 1.0 else 0.3)
        K = P @ sight.H / variance
        mean, cov = corrected(x, P, sight)
        assert np.allclose(mean[:3], (x + K * sight.residual)[:3])
        assert np.allclose(cov, P - np.outer(K, K) * variance, atol=1e-12)
    there = direction(x, P, NOISE, modified=False)
    y = np.array([0.1, -0.05])
    K = P @ there.H.T @ np.linalg.inv(there.H @ P @ there.H.T + NOISE)
    mean, cov = turned_to(x, P, there.H, there.S, y)
    assert np.allclose(mean[:3], (x + K @ y)[:3])
    keep = np.eye(4) - K @ there.H
    assert np.allclose(cov, keep @ P @ keep.T + K @ NOISE @ K.T, atol=1e-10)
    assert_covariance(cov)


def test_residuals_of_azimuths_go_the_short_way_round() -> None:
    found = residuals(np.array([[3.1, 0.0]]), np.array([[-3.1, 0.2], [3.0, -0.1]]))
    assert np.allclose(found, [[[2.0 * np.pi - 6.2, 0.2], [-0.1, -0.1]]])


@given(SEED)
def test_densities_are_gaussian_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, y = a_cov(rng)[:2, :2], rng.normal(size=(3, 2))
    d2, likely = squared(y, S)
    assert np.allclose(likely, multivariate_normal(np.zeros(2), S).pdf(y))
    assert np.allclose(d2, np.sum(y * np.linalg.solve(S, y.T).T, axis=-1))
    assert np.allclose(inverse2(S), np.linalg.inv(S))
    assert np.allclose(density(y[:, 0], zero(0.3)), norm(0.0, np.sqrt(0.3)).pdf(y[:, 0]))


@given(SEED, st.sampled_from([0.5, 0.99, 1.01, 12.0]))
def test_the_modified_gate_is_a_circle_around_tracks_of_wide_headings_only(seed: int, heading_var: float) -> None:
    P = a_cov(np.random.default_rng(seed), heading_var)
    wide = widened(P[None])[0]
    if heading_var < 1.0:
        assert np.array_equal(wide, P)
    else:
        assert np.allclose(wide[:2, :2], np.linalg.eigvalsh(P[:2, :2])[-1] * np.eye(2))
    there = direction(np.array([[5.0, 2.0, 1.0, 0.0]]), P[None], NOISE, modified=True)
    x = np.array([[5.0, 2.0, 0.0, 0.0]])
    flat = direction(x, P[None], NOISE, modified=True)
    assert np.allclose(there.gate, there.S) == (heading_var < 1.0)
    assert flat.gate[0, 0, 0] >= flat.S[0, 0, 0] - 1e-12


def test_nothing_is_learnt_of_the_azimuth_of_a_robot_overhead() -> None:
    P = 0.04 * np.eye(4)
    over, aside = np.array([0.3, 0.0, 5.0, 0.0]), np.array([3.0, 0.0, 5.0, 0.0])
    for x, open_to in ((over, True), (aside, False)):
        there = direction(x, P, NOISE, modified=False)
        bare = there.H @ P @ there.H.T + NOISE
        assert bool(there.S[0, 0] > bare[0, 0] + 9.0) is open_to
        assert there.S[1, 1] == pytest.approx(bare[1, 1])
