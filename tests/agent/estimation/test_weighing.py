"""Intersection of many: never overconfident, never worse than the prior, and as good as weights can make it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

from agent.estimation.intersection import fuse
from agent.estimation.weighing import Rule, weighed
from tests.agent.estimation.correlations import least_gap, random_covariance, random_joint

Array = NDArray[np.float64]

RULES: tuple[Rule, ...] = ("trace", "logdet", "info", "pinv_guard")
SEED = st.integers(0, 2**32 - 1)


def everything(m: int) -> NDArray[np.bool_]:
    return np.ones(m, dtype=bool)


def corrections(rng: np.random.Generator, n: int, m: int) -> tuple[Array, list[Array]]:
    """Informations (m, n, n) of rank one or two, and derivatives with unit noise they are made of."""
    H = [rng.normal(size=(int(rng.integers(1, 3)), n)) * 10.0 ** rng.uniform(-1.0, 1.0) for _ in range(m)]
    return np.array([item.T @ item for item in H]), H


@pytest.mark.parametrize("rule", RULES)
@given(SEED, st.integers(2, 5), st.integers(1, 5), st.booleans())
@settings(max_examples=25)
def test_the_claimed_covariance_bounds_the_true_one(rule: Rule, seed: int, n: int, m: int, staged: bool) -> None:
    rng = np.random.default_rng(seed)
    prior = random_covariance(rng, n)
    informations, H = corrections(rng, n, m)
    cov, weights = weighed(prior, informations, everything(m), rule, staged)
    joint = random_joint(rng, [prior, *(np.eye(len(item)) for item in H)])
    # x+ = P (w_0 P_0^-1 x_0 + sum w_l H_l^T z_l), and the error of z_l is the l-th of the joint.
    mix = np.hstack([weights[0] * np.linalg.inv(prior), *(w * item.T for w, item in zip(weights[1:], H))])
    truth = cov @ mix @ joint @ mix.T @ cov
    assert least_gap(cov, truth) > -1e-7, seed
    assert weights.sum() == pytest.approx(1.0) and weights.min() >= 0.0


@pytest.mark.parametrize("rule", ["trace", "pinv_guard", "logdet"])
@given(SEED, st.integers(2, 5), st.integers(0, 5), st.booleans())
@settings(max_examples=25)
def test_a_fusion_never_costs_more_than_the_prior(rule: Rule, seed: int, n: int, m: int, staged: bool) -> None:
    rng = np.random.default_rng(seed)
    prior = random_covariance(rng, n)
    cov, weights = weighed(prior, corrections(rng, n, m)[0].reshape(m, n, n), everything(m), rule, staged)
    if rule == "logdet":
        assert np.linalg.slogdet(cov)[1] <= np.linalg.slogdet(prior)[1], seed
    else:
        assert np.trace(cov) <= np.trace(prior), seed
    if weights[0] == 1.0:
        assert np.array_equal(cov, prior)


def test_the_guard_is_what_keeps_the_prior() -> None:
    """A sure correction of one number takes nearly all the weight by its pseudo-inverse, and the rest is forgotten."""
    prior = np.diag([1.0, 1.0, 1.0])
    informations = np.diag([1e6, 0.0, 0.0])[None]
    assert weighed(prior, informations, everything(1), "pinv_guard")[1][0] == 1.0
    assert weighed(prior, informations, everything(1), "trace")[1][0] < 1.0
    cov, weights = weighed(prior, np.diag([0.01, 0.0, 0.0])[None], everything(1), "info")
    assert weights[0] < 1.0
    assert np.trace(cov) > 3.0


def by_hand(prior: Array, informations: Array, rule: Rule, staged: bool) -> tuple[Array, Array]:
    """Eq. 2.5 and 2.4, or 2.10a and 2.11a, of informations that have inverses."""
    def size(information: Array) -> float:
        return float(1.0 / np.trace(information) if rule == "info" else np.trace(np.linalg.inv(information)))

    own = np.linalg.inv(prior)
    if staged:
        eta = np.array([1.0 / size(item) for item in informations])
        eta /= eta.sum()
        S = np.einsum("l,lij->ij", eta, informations)
        zeta = 1.0 / size(S) / (1.0 / size(S) + 1.0 / size(own))
        weights = np.concatenate([[1.0 - zeta], zeta * eta])
    else:
        weights = np.array([1.0 / size(item) for item in [own, *informations]])
        weights /= weights.sum()
    cov = np.linalg.inv(weights[0] * own + np.einsum("l,lij->ij", weights[1:], informations))
    if rule == "pinv_guard" and np.trace(cov) >= np.trace(prior):
        return prior, np.eye(len(weights))[0]
    return cov, weights


@pytest.mark.parametrize("rule", ["info", "pinv_guard"])
@given(SEED, st.integers(2, 5), st.integers(1, 5), st.booleans())
@settings(max_examples=25)
def test_sizes_weigh_as_printed(rule: Rule, seed: int, n: int, m: int, staged: bool) -> None:
    rng = np.random.default_rng(seed)
    prior = random_covariance(rng, n)
    informations = np.array([np.linalg.inv(random_covariance(rng, n)) for _ in range(m)])
    found, expected = weighed(prior, informations, everything(m), rule, staged), by_hand(
        prior, informations, rule, staged
    )
    assert np.allclose(found[1], expected[1], rtol=1e-5, atol=1e-9), seed
    assert np.allclose(found[0], expected[0], rtol=1e-5, atol=1e-8), seed


def optimum(prior: Array, informations: Array, rule: Rule) -> float:
    """The least cost of any weights, by a general optimizer."""
    own = np.linalg.inv(prior)

    def cost(logits: Array) -> float:
        w = np.exp(logits - logits.max())
        w /= w.sum()
        cov = np.linalg.inv(w[0] * own + np.einsum("l,lij->ij", w[1:], informations))
        return float(np.trace(cov) if rule == "trace" else np.linalg.slogdet(cov)[1])

    return float(minimize(cost, np.zeros(len(informations) + 1), method="BFGS", options={"gtol": 1e-8}).fun)


@pytest.mark.parametrize("rule", ["trace", "logdet"])
def test_the_weights_are_near_the_best(rule: Rule) -> None:
    rng = np.random.default_rng(7)
    worst = 0.0
    for _ in range(20):
        prior = random_covariance(rng, 3)
        informations, _ = corrections(rng, 3, 3)
        cov, _ = weighed(prior, informations, everything(3), rule)
        best = optimum(prior, informations, rule)
        if rule == "trace":
            worst = max(worst, float(np.trace(cov)) / best - 1.0)
        else:
            worst = max(worst, float(np.linalg.slogdet(cov)[1]) - best)
    assert worst < 0.03, "seed 7"


def test_two_beliefs_are_fused_as_on_a_grid() -> None:
    rng = np.random.default_rng(8)
    for draw in range(20):
        first, second = random_covariance(rng, 3), random_covariance(rng, 3)
        found, _ = weighed(first, np.linalg.inv(second)[None], everything(1), "trace", staged=False)
        _, grid, _ = fuse(np.zeros(3), first, np.zeros(3), second, (), "trace")
        assert np.trace(found) <= 1.01 * np.trace(grid), f"seed 8, draw {draw}"


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("staged", [False, True])
def test_candidates_are_weighed_each_by_itself(rule: Rule, staged: bool) -> None:
    rng = np.random.default_rng(9)
    priors = np.array([random_covariance(rng, 3) for _ in range(6)])
    informations = np.array([corrections(rng, 3, 4)[0] for _ in range(6)])
    used = rng.uniform(size=(6, 4)) < 0.6
    used[0] = False
    informations[~used] = np.nan
    covs, weights = weighed(priors, informations, used, rule, staged)
    for index in range(6):
        alone = informations[index][used[index]]
        cov, some = weighed(priors[index], alone, everything(len(alone)), rule, staged)
        assert np.allclose(covs[index], cov, rtol=1e-10, atol=1e-13)
        assert np.allclose(weights[index, 1:][used[index]], some[1:], rtol=1e-8, atol=1e-13)
    assert np.array_equal(covs[0], priors[0])
    # A prior, or informations, that all candidates have in common.
    same = np.broadcast_to(priors[1], (6, 3, 3))
    assert np.allclose(
        weighed(priors[1], informations, used, rule, staged)[0], weighed(same, informations, used, rule, staged)[0]
    )
    first = informations[1][used[1]]
    assert np.allclose(weighed(priors, first, everything(len(first)), rule, staged)[0][1], covs[1])


@pytest.mark.parametrize("rule", RULES)
def test_a_prior_may_know_something_exactly(rule: Rule) -> None:
    prior = np.diag([1.0, 1.0, 0.0])
    informations = np.array([np.diag([4.0, 4.0, 0.0]), np.diag([1.0, 9.0, 1.0])])
    cov, _ = weighed(prior, informations, everything(2), rule)
    assert np.isfinite(cov).all()
    assert not cov[2].any() and not cov[:, 2].any()
    certain, weights = weighed(np.zeros((3, 3)), informations, everything(2), rule)
    assert not certain.any()
    assert np.isfinite(weights).all()


@pytest.mark.parametrize("rule", RULES)
def test_what_tells_nothing_counts_for_nothing(rule: Rule) -> None:
    prior, useful = np.diag([4.0, 1.0]), np.diag([1.0, 0.25])
    alone, _ = weighed(prior, useful[None], everything(1), rule)
    both, weights = weighed(prior, np.array([useful, np.zeros((2, 2))]), everything(2), rule)
    assert np.allclose(both, alone)
    assert weights[2] == 0.0


def test_an_indefinite_prior_is_refused() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        weighed(np.diag([1.0, -1.0]), np.eye(2)[None], everything(1), "trace")
