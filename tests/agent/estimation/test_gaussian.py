"""Gaussian algebra against numpy's inverses and the definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import (
    clip_canonical_correlations,
    congruence,
    gain,
    identity,
    is_positive_definite,
    quadratic_form,
    square_root,
    symmetrize,
    wrap,
    wrap_components,
)

Array = NDArray[np.float64]

SEED = st.integers(0, 2**32 - 1)


def random_covariance(rng: np.random.Generator, *shape: int) -> Array:
    """(..., n, n), well conditioned, for a shape (..., n)."""
    root = rng.normal(size=(*shape, shape[-1]))
    return np.asarray(root @ root.swapaxes(-1, -2) + 0.1 * np.eye(shape[-1]))


@given(st.floats(-1e6, 1e6))
def test_wrapping_keeps_the_direction_and_is_idempotent(angle: float) -> None:
    wrapped = float(wrap(np.array(angle)))
    assert -math.pi < wrapped <= math.pi
    turns = (angle - wrapped) / (2.0 * math.pi)
    assert abs(turns - round(turns)) < 1e-9
    assert float(wrap(np.array(wrapped))) == pytest.approx(wrapped, abs=1e-15)


@given(st.integers(-5, 5), st.integers(-4, 4))
def test_wrapped_angles_next_to_a_half_turn_stay_in_the_half_open_interval(turns: int, steps: int) -> None:
    angle = (2 * turns + 1) * math.pi
    for _ in range(abs(steps)):
        angle = math.nextafter(angle, math.copysign(math.inf, steps))
    assert -math.pi < float(wrap(np.array(angle))) <= math.pi


def test_a_half_turn_is_positive_either_way() -> None:
    assert wrap(np.array([math.pi, -math.pi, math.nextafter(-math.pi, -4.0), 0.0])).tolist() == [math.pi] * 3 + [0.0]


def test_only_the_named_components_are_wrapped_in_place() -> None:
    vectors = np.array([[4.0, 4.0, -4.0], [7.0, 7.0, 7.0]])
    assert wrap_components(vectors, (2,)) is vectors
    assert np.array_equal(vectors[:, :2], [[4.0, 4.0], [7.0, 7.0]])
    assert np.allclose(vectors[:, 2], [2.0 * math.pi - 4.0, 7.0 - 2.0 * math.pi])


@given(SEED, st.integers(1, 6))
def test_square_roots_of_definite_matrices(seed: int, n: int) -> None:
    covs = random_covariance(np.random.default_rng(seed), 4, n)
    roots = square_root(covs)
    assert np.allclose(roots @ roots.swapaxes(-1, -2), covs, rtol=1e-10, atol=1e-12)


@given(SEED, st.integers(2, 6))
def test_square_roots_of_semidefinite_matrices(seed: int, n: int) -> None:
    factor = np.random.default_rng(seed).normal(size=(n, n - 1))
    cov = factor @ factor.T
    root = square_root(cov)
    assert np.allclose(root @ root.T, cov, atol=1e-7)
    blocked = np.zeros((n + 1, n + 1))
    blocked[:n, :n] = random_covariance(np.random.default_rng(seed), n)
    root = square_root(blocked)
    assert np.allclose(root @ root.T, blocked, atol=1e-10)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_an_indefinite_covariance_has_no_square_root_at_any_scale(scale: float) -> None:
    indefinite = np.array([[1.0, 1.001], [1.001, 1.0]]) * scale
    with pytest.raises(np.linalg.LinAlgError):
        square_root(indefinite)
    with pytest.raises(np.linalg.LinAlgError):
        square_root(np.stack([np.eye(2) * scale, indefinite]))


def test_what_is_positive_definite() -> None:
    assert is_positive_definite(np.array([[2.0, 1.0], [1.0, 2.0]]))
    assert not is_positive_definite(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert not is_positive_definite(np.diag([1.0, 0.0]))
    assert not is_positive_definite(np.diag([1.0, np.nan]))
    assert not is_positive_definite(np.diag([1.0, np.inf]))


@given(SEED, st.integers(1, 5), st.integers(1, 4))
def test_gain_and_quadratic_form_are_those_of_the_inverse(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    S, cross, vector = random_covariance(rng, 3, m), rng.normal(size=(3, n, m)), rng.normal(size=(3, m))
    inverse = np.linalg.inv(S)
    assert np.allclose(gain(cross, S), cross @ inverse, rtol=1e-8, atol=1e-10)
    forms = quadratic_form(vector, S)
    assert forms.shape == (3,)
    for k in range(3):
        assert float(forms[k]) == pytest.approx(float(vector[k] @ inverse[k] @ vector[k]), rel=1e-8)
        assert float(quadratic_form(vector[k], S[k])) == pytest.approx(float(forms[k]), rel=1e-12)


def test_symmetrizing_keeps_the_symmetric_part() -> None:
    matrix = np.random.default_rng(0).normal(size=(2, 3, 3))
    result = symmetrize(matrix)
    assert np.array_equal(result, result.swapaxes(-1, -2))
    vector = np.array([1.0, -2.0, 0.5])
    assert np.allclose(vector @ result @ vector, vector @ matrix @ vector)


def joint_of(cov_a: Array, cross: Array, cov_b: Array) -> Array:
    return np.block([[cov_a, cross], [cross.T, cov_b]])


@given(SEED, st.integers(1, 6), st.integers(1, 6))
def test_a_congruence_is_the_product_of_three(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    A, P = rng.standard_normal((m, n)), rng.standard_normal((n, n))
    assert np.allclose(congruence(A, P), A @ P @ A.T, rtol=1e-12, atol=1e-12)


def test_the_identity_is_not_to_be_written_to() -> None:
    assert np.array_equal(identity(4), np.eye(4))
    with pytest.raises(ValueError, match="read-only"):
        identity(4)[0, 1] = 1.0


def test_one_number_is_symmetric() -> None:
    number = np.array([[0.1 + 0.2]])
    assert symmetrize(number)[0, 0] == number[0, 0]


@given(SEED, st.integers(1, 4), st.integers(1, 4), st.floats(0.0, 1.99))
def test_clipped_canonical_correlations_give_an_admissible_joint_covariance(
    seed: int, n: int, m: int, strength: float
) -> None:
    rng = np.random.default_rng(seed)
    cov_a, cov_b = random_covariance(rng, n), random_covariance(rng, m)
    root_a, root_b = np.linalg.cholesky(cov_a), np.linalg.cholesky(cov_b)
    left, values, right = np.linalg.svd(rng.normal(size=(n, m)), full_matrices=False)
    values = strength * values / values.max()
    cross = root_a @ (left * values) @ right @ root_b.T
    clipped = clip_canonical_correlations(cov_a, cross, cov_b)
    assert is_positive_definite(joint_of(cov_a, clipped, cov_b))
    if strength <= 0.998:
        assert np.array_equal(clipped, cross)
    # Directions that were admissible keep their correlation; the others get the limit.
    white = np.linalg.solve(root_a, np.linalg.solve(root_b, clipped.T).T)
    assert np.allclose(white, (left * np.minimum(values, 0.999)) @ right, atol=1e-6)
