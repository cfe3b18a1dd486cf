"""How a peer moved: what it told, cut and joined as needed, and honest guesses in between."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from agent.peer_motion import PeerMotion, Stretch
from agent.settings import NS, CoastSettings

STEP = NS // 20
VELOCITY = np.array([0.6, 0.1, -0.1, 0.2])
COV = np.diag([0.05, 0.05, 0.05, 0.01])
COAST = CoastSettings(0.5, 0.25)
ACCELERATIONS = (1.0, 0.5)


def peer(*steps: int, start_ns: int = 0) -> PeerMotion:
    """A peer that told of the steps with these numbers; step k ends at k STEP."""
    found = PeerMotion(start_ns, COAST, ACCELERATIONS, 1_000_000)
    for k in steps:
        assert found.add(Stretch((k - 1) * STEP, k * STEP, VELOCITY, COV))
    return found


def test_a_step_that_was_told_is_used_as_it_is() -> None:
    motion, guessed = peer(1, 2, 3).over(STEP, 2 * STEP)
    assert not guessed
    assert motion.velocity == pytest.approx(VELOCITY)
    assert motion.cov == pytest.approx(COV, abs=1e-9)


def test_stamps_that_differ_by_little_are_of_one_instant() -> None:
    motion, guessed = peer(1, 2, 3).over(STEP + 400_000, 2 * STEP + 400_000)
    assert not guessed
    assert motion.cov == pytest.approx(COV, rel=0.05, abs=1e-6)


def test_half_a_step_is_known_less_well_and_two_steps_better() -> None:
    """White noise: the variance of the mean velocity goes with one over the time."""
    told = peer(1, 2, 3, 4)
    half, _ = told.over(STEP, STEP + STEP // 2)
    two, _ = told.over(STEP, 3 * STEP)
    assert half.cov.diagonal() == pytest.approx(2.0 * COV.diagonal(), rel=1e-6)
    assert two.cov.diagonal() == pytest.approx(0.5 * COV.diagonal(), rel=2e-3)
    assert two.velocity[3] == pytest.approx(VELOCITY[3])


def test_steps_of_another_phase_are_cut_and_joined() -> None:
    motion, guessed = peer(1, 2, 3).over(STEP // 2, STEP + STEP // 2)
    assert not guessed
    assert motion.velocity == pytest.approx(VELOCITY, abs=2e-3)
    assert motion.cov.diagonal() == pytest.approx(COV.diagonal(), rel=0.01)


def test_who_falls_silent_goes_on_as_before_and_less_and_less_is_known() -> None:
    told = peer(1, 2)
    variances = []
    for k in range(3, 43):
        motion, guessed = told.over((k - 1) * STEP, k * STEP)
        assert guessed and motion.velocity == pytest.approx(VELOCITY)
        variances.append(motion.cov[0, 0])
    assert variances[0] < 2.0 * COV[0, 0], "one lost report costs little"
    assert min(variances) > 0.0 and variances[10] > 10.0 * variances[0]


@pytest.mark.parametrize("cuts", [1, 4, 20])
def test_how_often_a_gap_is_cut_does_not_matter(cuts: int) -> None:
    told, edges = peer(1), np.linspace(STEP, STEP + 2 * NS, cuts + 1).astype(int).tolist()
    way = 0.0
    for begin, end in pairwise(edges):
        motion, _ = told.over(begin, end)
        way += motion.cov[2, 2] * ((end - begin) * 1e-9) ** 2
    most = np.hypot(abs(VELOCITY[2]), COAST.speed_mps)
    expected = (min(0.5 * ACCELERATIONS[0] * 2.0, most) * 2.0) ** 2 + COV[2, 2] * 2.0**2
    assert way == pytest.approx(expected, rel=1e-6)


def test_guesses_are_as_far_off_as_they_say() -> None:
    """Peers that speed up as much as is assumed: the way over a gap of half a second, NEES 1."""
    rng, ratios = np.random.default_rng(7), []
    gap_s = 0.5
    for _ in range(400):
        told = PeerMotion(0, COAST, ACCELERATIONS, 1_000_000)
        true = VELOCITY[0]
        told.add(Stretch(0, STEP, VELOCITY + np.array([rng.normal() * COV[0, 0] ** 0.5, 0.0, 0.0, 0.0]), COV))
        way = true * gap_s + 0.5 * rng.normal() * ACCELERATIONS[0] * gap_s**2
        motion, _ = told.over(STEP, STEP + round(gap_s * NS))
        # Along the way turning costs nothing of first order.
        ratios.append((motion.velocity[2 - 2] * gap_s - way) ** 2 / (motion.cov[0, 0] * gap_s**2))
    assert 0.8 < np.mean(ratios) < 1.2, np.mean(ratios)


def test_of_who_never_told_only_its_speed_is_guessed() -> None:
    motion, guessed = peer().over(0, NS)
    assert guessed and not motion.velocity.any()
    assert motion.cov.diagonal() == pytest.approx([0.25, 0.25, 0.25, 0.0625])


def test_a_gap_is_guessed_and_the_rest_is_not() -> None:
    told = peer(1, 2, 4)
    assert told.over(2 * STEP, 3 * STEP)[1]
    assert told.over(STEP, 4 * STEP)[1]
    assert not told.over(3 * STEP, 4 * STEP)[1]


def test_reports_may_come_in_any_order_and_count_once() -> None:
    told = peer(3, 1)
    assert told.add(Stretch(STEP, 2 * STEP, VELOCITY, COV))
    assert not told.add(Stretch(STEP, 2 * STEP, VELOCITY, COV))
    assert not told.add(Stretch(STEP // 2, STEP + STEP // 2, VELOCITY, COV)), "it overlaps what is known"
    assert not told.over(0, 3 * STEP)[1]
    assert told.covers(3 * STEP) and not told.covers(4 * STEP) and told.end_ns == 3 * STEP


def test_nobody_can_make_its_memory_grow() -> None:
    told = peer(*range(1, 2000))
    assert len(told._stretches) <= 512
