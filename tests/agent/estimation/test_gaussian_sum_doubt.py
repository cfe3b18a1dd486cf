"""The share of the weight that is kept by what has not been refuted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.estimation.gaussian_sum import Tracks
from agent.estimation.gaussian_sum_doubt import REFUTED, distinct, doubted
from agent.estimation.gaussian_sum_pruning import pruned
from tests.agent.estimation.test_gaussian_sum import IMPROVED, tracks_of

PLACES = [[3.0, 4.0, 0.5, 0.2], [3.0, -4.0, 0.5, -0.2], [-5.0, 0.0, 0.5, 0.0]]


def three(*weight: float, misfit: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tracks:
    """Three modes of one robot, heaviest first."""
    return replace(tracks_of(0, 0, 0, mean=PLACES, weight=weight), misfit=np.array(misfit))


def test_what_fits_keeps_its_share_in_proportion_and_the_heaviest_the_rest() -> None:
    assert doubted(three(0.997, 0.002, 0.001), 0.3).weight == pytest.approx([0.7, 0.2, 0.1])


def test_what_is_refuted_keeps_nothing_but_its_weight() -> None:
    found = doubted(three(0.95, 0.049, 0.001, misfit=(0.0, REFUTED, 0.0)), 0.2)
    assert found.misfit.tolist() == [0.0, 0.0, REFUTED]
    assert found.weight / found.weight[0] == pytest.approx([1.0, 0.2 / 0.8, 0.049 / 0.95])
    assert found.weight.sum() == pytest.approx(1.0)
    alone = three(0.95, 0.04, 0.01, misfit=(0.0, REFUTED, REFUTED))
    assert np.array_equal(doubted(alone, 0.2).weight, alone.weight)


def test_the_heaviest_is_believed_however_badly_it_fits() -> None:
    assert doubted(three(0.99, 0.01, 0.0, misfit=(REFUTED, 0.0, 0.0)), 0.2).weight == pytest.approx([0.8, 0.2, 0.0])


def test_doubt_that_is_there_already_is_left_alone() -> None:
    some = three(0.5, 0.3, 0.2)
    assert np.array_equal(doubted(some, 0.4).weight, some.weight)


def test_the_same_mode_is_no_doubt() -> None:
    near = tracks_of(0, 0, mean=[PLACES[0], [3.4, 4.4, 0.5, 0.2]], weight=[0.99, 0.01])
    assert np.array_equal(doubted(near, 0.2).weight, near.weight)


def test_each_robot_has_its_own_doubt() -> None:
    both = tracks_of(2, 0, 0, 2, mean=[PLACES[0], PLACES[0], PLACES[1], PLACES[2]], weight=[1.0, 0.6, 0.4, 1e-4])
    found = doubted(both, 0.2)
    assert found.of.tolist() == [2, 0, 0, 2] and found.weight == pytest.approx([0.8, 0.6, 0.4, 0.2])


def test_doubt_makes_nothing_heavier_than_the_heaviest() -> None:
    """A fan of headings is no mode and its opposite: only the last one is distinct from the first."""
    places = [[3.0, 4.0, 0.5, heading] for heading in (0.0, 0.6, 1.2, -0.6, -1.2, 3.1)]
    fan = tracks_of(0, 0, 0, 0, 0, 0, mean=places, weight=[0.2, 0.18, 0.18, 0.18, 0.18, 0.08], heading=0.47)
    found = doubted(fan, 0.4).weight
    assert found[0] == found.max() and found.min() / found[0] == pytest.approx(0.4 / 0.6)


def test_modes_are_distinct_beyond_their_common_deviation_and_across_the_half_turn() -> None:
    mean, cov = np.array([0.0, 0.0, 0.0, 3.1]), np.eye(4)
    assert not distinct(mean, cov, np.array([0.0, 0.0, 0.0, -3.1]), cov)
    assert not distinct(mean, cov, mean + np.array([5.1, 0.0, 0.0, 0.0]), cov)
    assert distinct(mean, cov, mean + np.array([5.2, 0.0, 0.0, 0.0]), cov)


def test_pruning_leaves_doubt_where_the_rules_have_any() -> None:
    some = three(0.9995, 0.0005, 0.0)
    assert pruned(some, replace(IMPROVED, doubt=0.2), families=True).weight == pytest.approx([0.8, 0.2])
    assert pruned(some, IMPROVED, families=False).weight == pytest.approx([0.9995, 0.0005])
