"""What is pruned of a sum, and that what is left has the same moments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.gaussian_sum import Tracks
from agent.estimation.gaussian_sum_pruning import merged, pruned
from tests.agent.estimation.test_gaussian_sum import IMPROVED, tracks_of
from tests.agent.estimation.test_relative_motion import SEED, a_cov

Array = NDArray[np.float64]

RULES = replace(IMPROVED, floor=1e-5, family=0.01)


def moments(tracks: Tracks, centre: Array, layer: int = 0) -> tuple[float, Array, Array]:
    """Weight, mean and covariance of all as one, headings being taken about that of `centre`."""
    w, m = tracks.weight, tracks.mean[:, layer] - centre
    m[:, 3] = wrap(m[:, 3])
    mean = w @ m / w.sum()
    off = m - mean
    return (
        float(w.sum()),
        mean,
        np.einsum("h,hij->ij", w, tracks.cov[:, layer] + off[:, :, None] * off[:, None]) / w.sum(),
    )


@given(SEED)
def test_merging_keeps_weight_mean_and_covariance_also_across_the_half_turn(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = np.array([3.0, -2.0, 1.0, np.pi])
    mean = np.tile(centre, (4, 1)) + 0.05 * rng.normal(size=(4, 4))
    mean[:, 3] = wrap(mean[:, 3])
    many = tracks_of(0, 0, 0, 0, mean=mean, weight=rng.dirichlet(np.ones(4)))
    many = replace(many, cov=np.array([a_cov(rng) + np.eye(4) for _ in range(4)])[:, None] * 0.3)
    one = merged(many)
    assert len(one) == 1
    assert -np.pi < one.mean[0, 0, 3] <= np.pi
    for mine, theirs in zip(moments(one, centre), moments(many, centre)):
        assert np.allclose(mine, theirs, atol=1e-9), f"seed {seed}"
    heaviest = int(many.weight.argmax())
    assert np.array_equal(one.lineage[0], many.lineage[heaviest])


def test_what_was_known_at_the_last_fusion_is_merged_of_those_that_knew_anything() -> None:
    many = tracks_of(0, 0, 0, mean=np.tile([3.0, 0.0, 0.0, 0.0], (3, 1)), weight=[0.5, 0.3, 0.2])
    past = np.array([[9.0, 9.0, 9.0, 0.0], [3.2, 0.0, 0.0, 0.1], [2.8, 0.2, 0.0, -0.1]])
    many = replace(
        many,
        mean=np.stack([many.mean[:, 0], past], axis=1),
        cov=np.repeat(many.cov, 2, axis=1),
        known=np.array([False, True, True]),
    )
    one = merged(many)
    _, mean, cov = moments(many.rows(many.known), np.zeros(4), layer=1)
    assert one.known.tolist() == [True]
    assert np.allclose(one.mean[0, 1], mean) and np.allclose(one.cov[0, 1], cov)


def test_tracks_of_other_robots_far_places_and_wide_headings_stay_apart() -> None:
    here, there = [3.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0]
    assert len(merged(tracks_of(0, 1, mean=[here, here], weight=[1.0, 1.0]))) == 2
    assert len(merged(tracks_of(0, 0, mean=[here, there], weight=[0.6, 0.4]))) == 2
    assert len(merged(tracks_of(0, 0, mean=[here, here], weight=[0.6, 0.4], heading=1.2))) == 2
    assert len(merged(tracks_of(0, 0, mean=[here, here], weight=[0.6, 0.4]))) == 1


def test_a_chain_of_tracks_is_not_merged_beyond_the_heaviest_one_s_reach() -> None:
    """0.25 m apart with 0.3 m of deviation: the heaviest, an end of the chain, takes the next one alone."""
    mean = np.array([[3.0 + 0.25 * k, 0.0, 0.0, 0.0] for k in range(4)])
    found = merged(tracks_of(0, 0, 0, 0, mean=mean, weight=[0.4, 0.3, 0.2, 0.1]))
    assert found.weight.tolist() == pytest.approx([0.7, 0.3])


def test_families_of_little_weight_end_and_young_tracks_stay() -> None:
    apart = [[10.0 * k, 0.0, 0.0, 0.0] for k in range(5)]
    some = tracks_of(0, 0, 0, 0, 0, mean=apart, weight=[0.96, 0.006, 0.006, 0.005, 0.023])
    lineage = some.lineage.copy()
    # The second and third have one ancestor, the fourth an own one, the fifth began within the last N scans.
    lineage[:, 0] = [1, 2, 2, 3, 0]
    some = replace(some, lineage=lineage)
    kept = pruned(some, RULES, families=True)
    assert sorted(kept.mean[:, 0, 0].tolist()) == [0.0, 10.0, 20.0, 40.0]
    assert kept.weight.sum() == pytest.approx(1.0)
    assert len(pruned(some, RULES, families=False)) == 5


def test_light_tracks_and_those_beyond_the_most_of_a_robot_go() -> None:
    apart = [[10.0 * k, 0.0, 0.0, 0.0] for k in range(4)]
    some = tracks_of(0, 0, 0, 1, mean=apart, weight=[0.6, 0.4 - 1e-6, 1e-6, 1.0])
    assert len(pruned(some, RULES, families=False)) == 3
    few = pruned(some, replace(RULES, most=1), families=False)
    assert sorted(few.of.tolist()) == [0, 1] and np.allclose(few.weight, 1.0)
