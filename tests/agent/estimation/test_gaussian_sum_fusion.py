"""What other leaders tell: the way into the own frame, weights, and what is shared already."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from agent.estimation.gaussian_sum import Rules, Tracks, no_tracks
from agent.estimation.gaussian_sum_fusion import Fusion, Told, fused, intersected, seen_back, seen_through, subtracted
from agent.estimation.relative_motion import composed, inverted
from tests.agent.estimation.test_gaussian_sum import IMPROVED, tracks_of
from tests.agent.estimation.test_intersection import joint_of, random_correlation
from tests.agent.estimation.test_relative_motion import SEED, a_cov, a_state, apart

Array = NDArray[np.float64]

RULES = replace(IMPROVED, strangeness=1.0, adoption=0.005, floor=1e-9)


def told_of(mean: Array, cov: Array, weight: Array | float = 1.0) -> Told:
    """Hypotheses (k, 4), (k, 4, 4) without a past."""
    mean, cov = np.atleast_2d(mean), np.asarray(cov).reshape(-1, 4, 4)
    weight = np.broadcast_to(np.asarray(weight, dtype=np.float64), len(mean))
    return Told(weight, mean[:, None], cov[:, None], np.zeros(len(mean), dtype=np.bool_))


def with_past(mean: Array, cov: Array, past: Array, past_cov: Array, known: bool = True) -> Told:
    return Told(np.ones(1), np.stack([mean, past])[None], np.stack([cov, past_cov])[None], np.array([known]))


@given(SEED)
def test_subtraction_leaves_what_two_independent_sensors_and_one_prior_say(seed: int) -> None:
    """Own: prior and own sensor; told: the same prior and another sensor. Fused, the prior counts once."""
    rng = np.random.default_rng(seed)
    x = a_state(rng)
    x[3] = 0.1
    Y0, Ya, Yb = (np.linalg.inv(a_cov(rng)) for _ in range(3))
    x0, xa, xb = (x + 0.1 * rng.normal(size=4) for _ in range(3))

    def together(*parts: tuple[Array, Array]) -> tuple[Array, Array]:
        P = np.linalg.inv(sum(Y for Y, _ in parts))
        return P @ sum(Y @ m for Y, m in parts), P

    own, P = together((Y0, x0), (Ya, xa))
    other, Pe = together((Y0, x0), (Yb, xb))
    expected, cov = together((Y0, x0), (Ya, xa), (Yb, xb))
    found, found_cov = subtracted(own[None], P[None], with_past(other, Pe, x0, np.linalg.inv(Y0)))
    assert np.allclose(found[0], expected, atol=1e-7) and np.allclose(found_cov[0], cov, atol=1e-7)


def test_subtraction_of_more_than_is_there_leaves_a_track_its_own_belief() -> None:
    mean, cov = np.array([[3.0, 1.0, 0.0, 0.2]]), np.eye(4)[None]
    told = with_past(mean[0] + 0.1, 10.0 * np.eye(4), mean[0], 0.5 * np.eye(4))
    found, found_cov = subtracted(mean, cov, told)
    assert np.allclose(found, mean, atol=1e-12) and np.array_equal(found_cov, cov)
    unknown = replace(told, known=np.array([False]))
    assert np.allclose(subtracted(mean, cov, unknown)[1], np.eye(4) / 1.1)


def test_an_intersection_bounds_the_error_whatever_is_shared() -> None:
    seed = 7
    rng = np.random.default_rng(seed)
    for draw in range(60):
        Pa, Pb = a_cov(rng), a_cov(rng)
        joint = joint_of(Pa, random_correlation(rng, Pa, Pb), Pb)
        _, claimed = intersected(np.zeros((1, 4)), Pa[None], told_of(np.zeros(4), Pb))
        pulls = [intersected(np.zeros((1, 4)), Pa[None], told_of(1e-3 * unit, Pb))[0][0] / 1e-3 for unit in np.eye(4)]
        K = np.stack(pulls, axis=-1)
        mix = np.hstack([np.eye(4) - K, K])
        assert np.linalg.eigvalsh(claimed[0] - mix @ joint @ mix.T).min() > -1e-9, f"seed {seed}, draw {draw}"
        assert np.linalg.slogdet(claimed[0])[1] <= min(np.linalg.slogdet(P)[1] for P in (Pa, Pb)) + 1e-9


@pytest.mark.parametrize("merge", [intersected, subtracted])
def test_headings_either_side_of_the_half_turn_meet_there(merge: object) -> None:
    mean, other = np.array([[3.0, 1.0, 0.0, 3.1]]), np.array([3.0, 1.0, 0.0, -3.1])
    cov = 0.1 * np.eye(4)
    found, _ = merge(mean, cov[None], with_past(other, cov, other, cov, known=False))  # type: ignore[operator]
    assert abs(abs(found[0, 3]) - np.pi) < 1e-9 and np.allclose(found[0, :3], mean[0, :3])


def test_hypotheses_come_into_the_own_frame_by_inverse_and_by_all_pairs_of_weight() -> None:
    rng = np.random.default_rng(2)
    a = told_of(np.array([a_state(rng) for _ in range(2)]), np.array([a_cov(rng) for _ in range(2)]), [0.9, 0.1])
    b = told_of(np.array([a_state(rng) for _ in range(2)]), np.array([a_cov(rng) for _ in range(2)]), [0.995, 0.005])
    back = seen_back(a, matched=True)
    assert np.array_equal(back.weight, a.weight)
    assert np.allclose(back.mean[1, 0], inverted(a.mean[1, 0], a.cov[1, 0], True)[0])
    through = seen_through(a, b, matched=True)
    # 0.1 times 0.005 is too little.
    assert through.weight == pytest.approx([0.9 * 0.995, 0.9 * 0.005, 0.1 * 0.995])
    mean, cov = composed(a.mean[1, 0], a.cov[1, 0], b.mean[0, 0], b.cov[0, 0], True)
    assert np.allclose(through.mean[2, 0], mean) and np.allclose(through.cov[2, 0], cov)


@pytest.mark.parametrize("by", ["intersection", "subtraction"])
def test_weights_after_fusion_are_those_of_an_enumeration(by: Fusion) -> None:
    """An intersection takes the geometric mean of both opinions, a subtraction their product."""
    rules = replace(RULES, layers=2)
    own = tracks_of(0, 0, mean=[[4.0, 1.0, 0.5, 0.3], [-4.0, 2.0, 0.5, -2.0]], weight=[0.4, 0.6])
    own = replace(own, mean=np.repeat(own.mean, 2, axis=1), cov=np.repeat(own.cov, 2, axis=1))
    cov = np.diag([0.1, 0.1, 0.01, 0.05])
    told = told_of(np.array([[4.2, 1.1, 0.52, 0.2], [9.0, 9.0, 0.5, 0.0]]), np.stack([cov, cov]), [0.8, 0.2])
    told = replace(told, mean=np.repeat(told.mean, 2, axis=1), cov=np.repeat(told.cov, 2, axis=1))
    found = fused(own, told, 0, rules, by, 77)
    missed = (1.0 - RULES.detection * RULES.gate) * RULES.strangeness
    match = multivariate_normal(np.zeros(4), own.cov[0, 0] + cov).pdf(apart(told.mean[0, 0], own.mean[0, 0]))
    one, other, near, far = np.array([0.4, 0.6, 0.8, 0.2]) ** (0.5 if by == "intersection" else 1.0)
    weights = np.array([one * near * match, one * missed, other * missed, 0.005 * far])
    adopted = found.mean[:, 0, 0] == 9.0
    away = found.mean[:, 0, 0] == -4.0
    assert found.weight[away] == pytest.approx([weights[2] / weights.sum()], rel=1e-6)
    assert found.weight[adopted] == pytest.approx([weights[3] / weights.sum()], rel=1e-6)
    assert found.weight[~adopted & ~away].sum() == pytest.approx(weights[:2].sum() / weights.sum(), rel=1e-6)
    assert found.lineage[adopted, -1].tolist() == [77] and not found.known[adopted].any()


def test_hearing_one_s_own_opinion_back_makes_nobody_surer_of_it() -> None:
    mean = np.array([[4.0, 1.0, 0.5, 0.3], [-4.0, 2.0, 0.5, -2.0]])
    own = tracks_of(0, 0, mean=mean, weight=[0.4, 0.6])
    found = own
    for _ in range(5):
        found = fused(found, told_of(found.mean[:, 0], found.cov, found.weight), 0, RULES, "intersection", 9)
    assert np.sort(found.weight) == pytest.approx([0.4, 0.6], abs=0.01)
    assert np.allclose(np.sort(found.mean[:, 0, 0]), [-4.0, 4.0]) and np.allclose(
        found.cov[:, 0], own.cov[0, 0], rtol=0.1
    )


@pytest.mark.parametrize("by", ["intersection", "subtraction"])
def test_a_leader_without_tracks_adopts_what_it_hears_and_nothing_changes_if_it_hears_nothing(by: Fusion) -> None:
    layers: Rules = replace(RULES, layers=2)
    told = with_past(np.array([4.0, 1.0, 0.5, 0.3]), np.eye(4), np.zeros(4), np.eye(4))
    found: Tracks = fused(no_tracks(layers), told, 3, layers, by, 5)
    assert found.of.tolist() == [3] and found.weight.tolist() == [1.0] and np.array_equal(found.mean, told.mean)
    nothing = Told(np.empty(0), np.empty((0, 2, 4)), np.empty((0, 2, 4, 4)), np.empty(0, dtype=np.bool_))
    assert fused(found, nothing, 3, layers, by, 6) is found
