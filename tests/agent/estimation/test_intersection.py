"""Covariance intersection: a bound whatever the correlation, never worse than either input, the same either way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.intersection import GRID, Weight, best_inflated_update, cost, fuse

Array = NDArray[np.float64]

WEIGHTS: tuple[Weight, ...] = ("trace", "logdet", "fast")
SEED = st.integers(0, 2**32 - 1)


def random_covariance(rng: np.random.Generator, n: int) -> Array:
    """Axes of very different length."""
    root = rng.normal(size=(n, n)) * rng.uniform(0.1, 2.0, size=(n, 1))
    return np.asarray(root @ root.T + 1e-2 * np.eye(n))


def random_correlation(rng: np.random.Generator, cov_a: Array, cov_b: Array) -> Array:
    """A cross-covariance with canonical correlations anywhere in [0, 1], one in four being total."""
    n, m = len(cov_a), len(cov_b)
    left, _ = np.linalg.qr(rng.normal(size=(n, n)))
    right, _ = np.linalg.qr(rng.normal(size=(m, m)))
    k = min(n, m)
    values = np.ones(k) if rng.uniform() < 0.25 else rng.uniform(size=k)
    return np.asarray(np.linalg.cholesky(cov_a) @ (left[:, :k] * values) @ right[:k] @ np.linalg.cholesky(cov_b).T)


def joint_of(cov_a: Array, cross: Array, cov_b: Array) -> Array:
    return np.block([[cov_a, cross], [cross.T, cov_b]])


@pytest.mark.parametrize("weight", WEIGHTS)
def test_a_fused_covariance_bounds_the_true_one_for_any_correlation(weight: Weight) -> None:
    rng = np.random.default_rng(41)
    for draw in range(200):
        P_a, P_b = random_covariance(rng, 3), random_covariance(rng, 3)
        joint = joint_of(P_a, random_correlation(rng, P_a, P_b), P_b)
        # The gains are read from the fused mean itself: one unit of difference at a time.
        _, claimed, _ = fuse(np.zeros(3), P_a, np.zeros(3), P_b, (), weight)
        K_b = np.column_stack([fuse(np.zeros(3), P_a, unit, P_b, (), weight)[0] for unit in np.eye(3)])
        mix = np.hstack([np.eye(3) - K_b, K_b])
        truth = mix @ joint @ mix.T
        assert np.linalg.eigvalsh(claimed - truth).min() > -1e-9, f"seed 41, draw {draw}"


@given(SEED, st.sampled_from(["trace", "logdet"]), st.sampled_from([1e-6, 1.0, 1e6]))
def test_a_fused_belief_is_never_worse_than_the_better_one(seed: int, weight: Weight, scale: float) -> None:
    rng = np.random.default_rng(seed)
    P_a, P_b = random_covariance(rng, 3), random_covariance(rng, 3) * scale
    _, cov, w = fuse(np.zeros(3), P_a, np.ones(3), P_b, (), weight)
    better = min(float(cost(P_a, weight)), float(cost(P_b, weight)))
    assert float(cost(cov, weight)) <= better + 1e-8 * abs(better)
    assert 0.0 <= w <= 1.0


@pytest.mark.parametrize("weight", ["trace", "logdet"])
def test_a_belief_that_is_better_everywhere_is_kept(weight: Weight) -> None:
    mean, cov = np.array([1.0, 2.0, 0.1]), np.diag([0.1, 0.2, 0.01])
    found = fuse(mean, cov, mean + 1.0, cov * 4.0, (2,), weight)
    assert np.allclose(found[0], mean)
    assert np.allclose(found[1], cov)
    assert found[2] == 1.0


@pytest.mark.parametrize("weight", WEIGHTS)
@given(SEED)
def test_fusing_a_belief_with_itself_changes_nothing(weight: Weight, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov = rng.uniform(-3.0, 3.0, size=3), random_covariance(rng, 3)
    found = fuse(mean, cov, mean, cov, (2,), weight)
    assert np.allclose(found[0], mean, atol=1e-9)
    assert np.allclose(found[1], cov, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("weight", WEIGHTS)
@given(SEED, st.booleans())
def test_either_side_finds_the_same_belief(weight: Weight, seed: int, alike: bool) -> None:
    """Also when the covariances are equal and any weight is as good: two trackers must not swap their means."""
    rng = np.random.default_rng(seed)
    P_a = random_covariance(rng, 3)
    P_b = P_a.copy() if alike else random_covariance(rng, 3)
    mean_a = rng.uniform(-3.0, 3.0, size=3)
    mean_b = mean_a + rng.normal(size=3)
    one, other = fuse(mean_a, P_a, mean_b, P_b, (2,), weight), fuse(mean_b, P_b, mean_a, P_a, (2,), weight)
    assert np.allclose(one[0][:2], other[0][:2], atol=1e-7)
    assert abs(float(wrap(one[0][2] - other[0][2]))) < 1e-7
    assert np.allclose(one[1], other[1], rtol=1e-7, atol=1e-9)
    assert one[2] == pytest.approx(1.0 - other[2])
    if alike:
        assert one[2] == pytest.approx(0.5)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_headings_either_side_of_the_half_turn_meet_at_it(weight: Weight) -> None:
    cov = np.diag([1.0, 1.0, 0.1])
    mean, _, _ = fuse(np.array([0.0, 0.0, 3.1]), cov, np.array([0.0, 0.0, -3.1]), cov, (2,), weight)
    assert abs(abs(float(mean[2])) - np.pi) < 1e-9


def test_complementary_beliefs_are_fused_as_by_hand() -> None:
    """Each knows one axis: w = 1/2 doubles the good variance and leaves (1/2 + 1/200)^-1 of it."""
    mean, cov, w = fuse(
        np.array([0.0, 5.0]), np.diag([1.0, 100.0]), np.array([5.0, 0.0]), np.diag([100.0, 1.0]), (), "trace"
    )
    assert w == pytest.approx(0.5)
    assert np.allclose(cov, np.eye(2) * 2.0 / 1.01)
    assert np.allclose(mean, 5.0 * 0.01 / 1.01)


def test_the_cost_is_trace_or_log_determinant() -> None:
    covs = np.stack([np.diag([1.0, 2.0]), np.diag([3.0, 4.0])])
    for weight in ("trace", "fast"):
        assert np.allclose(cost(covs, weight), [3.0, 7.0])
    assert np.allclose(cost(covs, "logdet"), np.log([2.0, 12.0]))


def inflated(own: Array, other: Array, H: Array, R: Array, weight: Weight) -> tuple[Array, Array, Array, float] | None:
    n = len(own)
    H_own, H_other = H[:, :n], H[:, n:]
    return best_inflated_update(own, H_own, H_own @ own @ H_own.T, H_other @ other @ H_other.T, R, weight)


@pytest.mark.parametrize("weight", WEIGHTS)
def test_an_inflated_update_bounds_the_true_covariance_for_any_correlation(weight: Weight) -> None:
    rng, used = np.random.default_rng(42), 0
    for draw in range(200):
        own, other = random_covariance(rng, 3), random_covariance(rng, 4) * rng.uniform(0.01, 1.0)
        joint = joint_of(own, random_correlation(rng, own, other), other)
        m = int(rng.integers(1, 3))
        H, R = rng.normal(size=(m, 7)), np.diag(rng.uniform(0.001, 0.5, size=m))
        found = inflated(own, other, H, R, weight)
        if found is None:
            continue
        used += 1
        K, claimed, left, w = found
        keep = np.eye(3) - K @ H[:, :3]
        mix = np.hstack([keep, -K @ H[:, 3:]])
        truth = mix @ joint @ mix.T + K @ R @ K.T
        assert np.linalg.eigvalsh(claimed - truth).min() > -1e-9, f"seed 42, draw {draw}"
        assert float(cost(claimed, weight)) < float(cost(own, weight)), f"seed 42, draw {draw}"
        # The left factor is what the update does to the old error.
        assert np.allclose(left, keep, atol=1e-8), f"seed 42, draw {draw}"
        assert w in GRID
    assert used > 50


@pytest.mark.parametrize("weight", WEIGHTS)
def test_the_chosen_weight_is_the_best_of_the_grid(weight: Weight) -> None:
    rng = np.random.default_rng(43)
    own, other = random_covariance(rng, 3), random_covariance(rng, 3) * 0.01
    H, R = rng.normal(size=(2, 6)), np.eye(2) * 0.001
    found = inflated(own, other, H, R, weight)
    assert found is not None
    candidates = []
    for w in GRID:
        S = H[:, :3] @ own @ H[:, :3].T / w + H[:, 3:] @ other @ H[:, 3:].T / (1.0 - w) + R
        K = (own / w) @ H[:, :3].T @ np.linalg.inv(S)
        candidates.append(float(cost(own / w - K @ S @ K.T, weight)))
    assert float(cost(found[1], weight)) == pytest.approx(min(candidates))
    assert float(GRID[int(np.argmin(candidates))]) == found[3]


@pytest.mark.parametrize("weight", WEIGHTS)
def test_a_belief_is_left_alone_when_no_weight_helps(weight: Weight) -> None:
    """The other belief is a hundred times worse, or the measurement is mere noise."""
    own, H = np.diag([0.1, 0.1, 0.01]), np.array([[1.0, 0.0, 0.0, -1.0, 0.0, 0.0]])
    assert inflated(own, own * 100.0, H, np.array([[0.01]]), weight) is None
    assert inflated(own, own, H, np.array([[1e6]]), weight) is None


def test_the_grid_is_symmetric_and_may_not_be_written() -> None:
    assert np.allclose(GRID, 1.0 - GRID[::-1])
    assert np.abs(GRID - 0.5).min() < 1e-12
    with pytest.raises(ValueError, match="read-only"):
        GRID[0] = 0.0
