"""Motion of one robot in the frame of another: against truth in a common frame, finite differences and samples."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.relative_motion import composed, inverted, stepped
from tests.assertions import assert_covariance

Array = NDArray[np.float64]

SEED = st.integers(0, 2**32 - 1)
NONE = np.zeros((4, 4))
DT = 0.05
SAMPLES = 200_000


def a_state(rng: np.random.Generator) -> Array:
    return np.concatenate([rng.uniform(-8.0, 8.0, size=3), rng.uniform(-np.pi, np.pi, size=1)])


def a_cov(rng: np.random.Generator, heading_var: float = 0.1) -> Array:
    """All correlated, with a given variance of the heading."""
    root = rng.normal(size=(4, 4)) * np.array([0.5, 0.4, 0.2, 1.0])[:, None]
    cov = root @ root.T + 0.01 * np.eye(4)
    scale = np.array([1.0, 1.0, 1.0, np.sqrt(heading_var / cov[3, 3])])
    return np.asarray(scale[:, None] * cov * scale)


def apart(one: Array, other: Array) -> Array:
    d = one - other
    d[..., 3] = wrap(d[..., 3])
    return d


def slope(function: Callable[[Array], Array], at: Array) -> Array:
    """Jacobian by central differences."""
    h = 1e-6
    columns = [apart(function(at + h * unit), function(at - h * unit)) / (2.0 * h) for unit in np.eye(4)]
    return np.stack(columns, axis=-1)


def step(x: Array, own: Array, peer: Array, dt: float = DT) -> Array:
    """States (..., 4) after a step, written with places in a common frame, the one of i before the step."""
    c, s = np.cos(x[..., 3]), np.sin(x[..., 3])
    dx = x[..., 0] + dt * (c * peer[..., 0] - s * peer[..., 1] - own[..., 0])
    dy = x[..., 1] + dt * (s * peer[..., 0] + c * peer[..., 1] - own[..., 1])
    turn = dt * own[..., 3]
    c, s = np.cos(turn), np.sin(turn)
    z = x[..., 2] + dt * (peer[..., 2] - own[..., 2])
    return np.stack([c * dx + s * dy, c * dy - s * dx, z, x[..., 3] + dt * peer[..., 3] - turn], axis=-1)


def invert(x: Array) -> Array:
    c, s = np.cos(x[..., 3]), np.sin(x[..., 3])
    return np.stack([-c * x[..., 0] - s * x[..., 1], s * x[..., 0] - c * x[..., 1], -x[..., 2], -x[..., 3]], axis=-1)


def compose(a: Array, b: Array) -> Array:
    c, s = np.cos(a[..., 3]), np.sin(a[..., 3])
    return np.stack(
        [
            a[..., 0] + c * b[..., 0] - s * b[..., 1],
            a[..., 1] + s * b[..., 0] + c * b[..., 1],
            a[..., 2] + b[..., 2],
            a[..., 3] + b[..., 3],
        ],
        axis=-1,
    )


@given(SEED)
def test_a_linearized_step_is_that_of_finite_differences_in_the_state_and_in_both_velocities(seed: int) -> None:
    """Also the lever arm: an error of the own yaw rate moves what is far away, and turns it at once."""
    rng = np.random.default_rng(seed)
    x, P = a_state(rng), a_cov(rng)
    own, peer = rng.normal(size=4), rng.normal(size=4)
    Si, Sj = a_cov(rng), a_cov(rng)
    F = slope(lambda at: step(at, own, peer), x)
    Gi, Gj = slope(lambda at: step(x, at, peer), own), slope(lambda at: step(x, own, at), peer)
    mean, cov = stepped(x, P, own, Si, peer, Sj, DT, matched=False)
    assert np.allclose(apart(mean, step(x, own, peer)), 0.0, atol=1e-12)
    assert np.allclose(cov, F @ P @ F.T + Gi @ Si @ Gi.T + Gj @ Sj @ Gj.T, atol=1e-7)


def test_noise_of_the_own_yaw_rate_dominates_at_a_distance() -> None:
    x, S = np.array([0.0, 5.0, 0.0, 0.0]), np.diag([0.0, 0.0, 0.0, 0.01])
    _, cov = stepped(x, NONE, np.zeros(4), S, np.zeros(4), NONE, DT, matched=False)
    assert cov[0, 0] == pytest.approx((0.1 * 5.0 * DT) ** 2)
    assert cov[0, 3] == pytest.approx(-(DT**2) * 0.01 * 5.0)


@given(SEED)
def test_linearized_inverse_and_composition_are_those_of_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, Pa, b, Pb = a_state(rng), a_cov(rng), a_state(rng), a_cov(rng)
    J = slope(invert, a)
    mean, cov = inverted(a, Pa, matched=False)
    assert np.allclose(apart(mean, invert(a)), 0.0, atol=1e-12)
    assert np.allclose(cov, J @ Pa @ J.T, atol=1e-6)
    Ja, Jb = slope(lambda at: compose(at, b), a), slope(lambda at: compose(a, at), b)
    mean, cov = composed(a, Pa, b, Pb, matched=False)
    assert np.allclose(apart(mean, compose(a, b)), 0.0, atol=1e-12)
    assert np.allclose(cov, Ja @ Pa @ Ja.T + Jb @ Pb @ Jb.T, atol=1e-6)


@given(SEED)
def test_the_inverse_of_the_inverse_is_the_belief_itself(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = a_state(rng), a_cov(rng)
    mean, cov = inverted(*inverted(x, P, matched=False), matched=False)
    assert np.allclose(apart(mean, x), 0.0, atol=1e-9)
    assert np.allclose(cov, P, atol=1e-9)


@given(SEED, st.booleans())
def test_a_robot_is_at_itself_by_way_of_another_and_ways_may_be_grouped(seed: int, matched: bool) -> None:
    rng = np.random.default_rng(seed)
    a, b, c = (a_state(rng) for _ in range(3))
    home, _ = composed(a, NONE, *inverted(a, NONE, matched), matched)
    assert np.allclose(home, 0.0, atol=1e-9)
    one, _ = composed(*composed(a, NONE, b, NONE, matched), c, NONE, matched)
    other, _ = composed(a, NONE, *composed(b, NONE, c, NONE, matched), matched)
    assert np.allclose(apart(one, other), 0.0, atol=1e-9)


@pytest.mark.parametrize("heading_var", [0.05, 0.5, 3.0])
def test_matched_moments_are_those_of_samples_however_wide_the_heading_is(heading_var: float) -> None:
    seed = 11
    rng = np.random.default_rng(seed)
    x, P = np.array([3.0, -2.0, 1.0, 0.7]), a_cov(rng, heading_var)
    b, Pb = np.array([-4.0, 1.0, 0.5, 2.0]), a_cov(rng)
    own, peer = np.array([0.5, 0.1, 0.2, 0.2]), np.array([3.0, 0.5, -0.1, 0.3])
    Si, Sj = np.diag([0.4, 0.3, 0.2, 0.01]), a_cov(rng)
    X, B = rng.multivariate_normal(x, P, SAMPLES), rng.multivariate_normal(b, Pb, SAMPLES)
    U, V = rng.multivariate_normal(own, Si, SAMPLES), rng.multivariate_normal(peer, Sj, SAMPLES)
    for samples, (mean, cov) in (
        (step(X, U, V, 0.5), stepped(x, P, own, Si, peer, Sj, 0.5, matched=True)),
        (invert(X), inverted(x, P, matched=True)),
        (compose(X, B), composed(x, P, b, Pb, matched=True)),
    ):
        scale = np.sqrt(np.diag(cov))
        assert np.abs(apart(samples.mean(axis=0), mean) / scale).max() < 0.02, f"seed {seed}"
        assert np.abs((np.cov(samples.T) - cov) / np.outer(scale, scale)).max() < 0.03, f"seed {seed}"
        assert_covariance(cov)


@given(SEED)
def test_matched_moments_of_a_heading_that_is_known_are_the_linearized_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P, b, Pb = a_state(rng), a_cov(rng, 1e-12), a_state(rng), a_cov(rng, 1e-12)
    own, peer = rng.normal(size=4), rng.normal(size=4)
    for kernel in (
        lambda matched: stepped(x, P, own, NONE, peer, a_cov(np.random.default_rng(1)), DT, matched),
        lambda matched: inverted(x, P, matched),
        lambda matched: composed(x, P, b, Pb, matched),
    ):
        (one, cov), (other, other_cov) = kernel(True), kernel(False)
        assert np.allclose(apart(one, other), 0.0, atol=1e-5)
        assert np.allclose(cov, other_cov, atol=1e-5)


@pytest.mark.parametrize("matched", [True, False])
def test_stacked_beliefs_are_moved_as_each_by_itself(matched: bool) -> None:
    rng = np.random.default_rng(5)
    x, P = (
        np.array([[a_state(rng) for _ in range(2)] for _ in range(3)]),
        np.array([[a_cov(rng) for _ in range(2)] for _ in range(3)]),
    )
    own, peer, S = rng.normal(size=4), rng.normal(size=(3, 1, 4)), 0.1 * np.eye(4)
    T = np.array([a_cov(rng) for _ in range(3)])[:, None]
    all_of = (
        stepped(x, P, own, S, peer, T, DT, matched),
        inverted(x, P, matched),
        composed(x, P, x[::-1], P[::-1], matched),
    )
    for i in range(3):
        for k in range(2):
            each = (
                stepped(x[i, k], P[i, k], own, S, peer[i, 0], T[i, 0], DT, matched),
                inverted(x[i, k], P[i, k], matched),
                composed(x[i, k], P[i, k], x[2 - i, k], P[2 - i, k], matched),
            )
            for (means, covs), (mean, cov) in zip(all_of, each):
                assert np.allclose(means[i, k], mean, atol=1e-12) and np.allclose(covs[i, k], cov, atol=1e-12)
