"""Updates under partly known correlation: the claimed covariance bounds the true one whatever the correlation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.split_joint import Split, update_from_peer, update_own, update_own_recurring


def random_psd(rng: np.random.Generator, n: int, rank: int) -> np.ndarray:
    root = rng.normal(size=(n, rank))
    return root @ root.T


def random_split(rng: np.random.Generator, n: int) -> Split:
    private = random_psd(rng, n, int(rng.integers(0, n + 1))) * rng.uniform(0.0, 2.0)
    return Split(private, random_psd(rng, n, n) + 1e-3 * np.eye(n))


def correlated(rng: np.random.Generator, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A cross-covariance of the shared errors as strong as can be: canonical correlations in [-1, 1]."""
    left, right = np.linalg.cholesky(own), np.linalg.cholesky(other)
    u, _, vt = np.linalg.svd(rng.normal(size=(len(own), len(other))), full_matrices=False)
    return left @ (u * rng.uniform(-1.0, 1.0, min(len(own), len(other)))) @ vt @ right.T


@given(st.integers(0, 10_000), st.integers(2, 6), st.integers(2, 6), st.integers(1, 4))
def test_the_bound_holds_for_every_correlation_of_the_shared_errors(seed: int, n: int, k: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    own, other = random_split(rng, n), random_split(rng, k)
    H_own, H_other = rng.normal(size=(m, n)), rng.normal(size=(m, k))
    R = random_psd(rng, m, m) + 1e-2 * np.eye(m)
    found = update_from_peer(own, other, H_own, H_other, R)
    if found is None:
        return
    cross = correlated(rng, own.shared, other.shared)
    left, right = np.eye(n) - found.K @ H_own, -found.K @ H_other
    truth = (
        left @ own.cov @ left.T
        + right @ other.cov @ right.T
        + left @ cross @ right.T
        + right @ cross.T @ left.T
        + found.K @ R @ found.K.T
    )
    gap = np.linalg.eigvalsh(found.split.cov - truth)
    assert gap.min() > -1e-8 * max(1.0, np.abs(truth).max()), seed


@given(st.integers(0, 10_000), st.integers(2, 6), st.integers(1, 3))
def test_the_bound_holds_for_noise_that_recurs_with_the_own_error(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    own, H, R = random_split(rng, n), rng.normal(size=(m, n)), random_psd(rng, m, m) + 1e-2 * np.eye(m)
    recurring = random_psd(rng, m, m) + 1e-3 * np.eye(m)
    found = update_own_recurring(own, H, R, recurring)
    if found is None:
        return
    cross = correlated(rng, own.cov, recurring)
    left, K = np.eye(n) - found.K @ H, found.K
    truth = left @ own.cov @ left.T + K @ (R + recurring) @ K.T - left @ cross @ K.T - K @ cross.T @ left.T
    gap = np.linalg.eigvalsh(found.split.cov - truth)
    assert gap.min() > -1e-8 * max(1.0, np.abs(truth).max()), seed


def test_noise_that_recurs_is_never_averaged_out() -> None:
    """However often a range with such an error is repeated, its variance stays in the estimate."""
    split, H, R = Split(np.eye(1), np.zeros((1, 1))), np.eye(1), np.array([[0.01]])
    for _ in range(200):
        found = update_own_recurring(split, H, R, np.array([[0.2]]))
        split = split if found is None else found.split
    assert split.cov[0, 0] > 0.2


def test_the_bound_is_put_to_the_test() -> None:
    """Most random beliefs gain by an update, so the property above is not about nothing."""
    gained = 0
    for seed in range(50):
        rng = np.random.default_rng(seed)
        H_own, H_other = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
        gained += update_from_peer(random_split(rng, 3), random_split(rng, 3), H_own, H_other, np.eye(2)) is not None
    assert gained >= 25


def test_without_shared_errors_it_is_the_kalman_update() -> None:
    rng = np.random.default_rng(3)
    own, other = random_psd(rng, 3, 3), random_psd(rng, 3, 3)
    H_own, H_other, R = rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), np.eye(2)
    found = update_from_peer(Split(own, np.zeros((3, 3))), Split(other, np.zeros((3, 3))), H_own, H_other, R)
    assert found is not None
    S = H_own @ own @ H_own.T + H_other @ other @ H_other.T + R
    K = own @ H_own.T @ np.linalg.inv(S)
    assert np.allclose(found.K, K)
    assert np.allclose(found.split.cov, own - K @ S @ K.T)


def test_an_exact_copy_of_the_own_belief_teaches_nothing() -> None:
    """The peer tells what it has heard from us: fusing it must not lower the claimed covariance."""
    rng = np.random.default_rng(5)
    shared = random_psd(rng, 3, 3) + 0.1 * np.eye(3)
    same = Split(np.zeros((3, 3)), shared)
    found = update_from_peer(same, same, -np.eye(3), np.eye(3), 1e-4 * np.eye(3))
    if found is not None:
        assert np.linalg.eigvalsh(found.split.cov - shared).min() > -1e-9


def test_own_measurements_keep_the_parts_apart() -> None:
    rng = np.random.default_rng(7)
    split, H, R = random_split(rng, 4), rng.normal(size=(2, 4)), np.eye(2)
    found = update_own(split, H, R)
    P = split.cov
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    assert np.allclose(found.split.cov, P - K @ (H @ P @ H.T + R) @ K.T)
    left = np.eye(4) - K @ H
    assert np.allclose(found.split.shared, left @ split.shared @ left.T)


def test_what_was_told_is_private_no_more() -> None:
    split = random_split(np.random.default_rng(9), 3)
    told = split.told()
    assert not told.private.any()
    assert told.shared == pytest.approx(split.cov)
