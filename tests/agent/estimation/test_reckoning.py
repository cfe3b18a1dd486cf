"""Sums of odometry: what went in between two of them comes out again, whatever was summed before."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.motion import advance_spatial, compose
from agent.estimation.reckoning import extended, increment, moved_between

Array = NDArray[np.float64]

NOTHING = np.zeros(4), np.zeros((4, 4))

moves = st.tuples(*(st.floats(-3.0, 3.0) for _ in range(4))).map(np.array)
roots = st.lists(st.floats(-0.3, 0.3), min_size=16, max_size=16).map(lambda v: np.array(v).reshape(4, 4))
steps = st.lists(st.tuples(moves, roots.map(lambda root: root @ root.T)), min_size=2, max_size=12)


def summed(parts: list[tuple[Array, Array]], start: tuple[Array, Array] = NOTHING) -> tuple[Array, Array]:
    total = start
    for delta, cov in parts:
        total = extended(*total, delta, cov)
    return total


@given(steps)
def test_an_increment_comes_out_as_it_went_in(parts: list[tuple[Array, Array]]) -> None:
    before, after = summed(parts[:-1]), summed(parts)
    delta, cov = increment(*before, *after)
    np.testing.assert_allclose(delta, parts[-1][0], atol=1e-12)
    np.testing.assert_allclose(cov, parts[-1][1], atol=1e-11)
    np.testing.assert_allclose(moved_between(before[0], after[0]), parts[-1][0], atol=1e-12)


@given(steps, st.data())
def test_what_happened_since_an_instant_does_not_depend_on_the_anchor(
    parts: list[tuple[Array, Array]], data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(parts)))
    delta, cov = increment(*summed(parts[:cut]), *summed(parts))
    alone = summed(parts[cut:])
    np.testing.assert_allclose(delta, alone[0], atol=1e-11)
    np.testing.assert_allclose(cov, alone[1], atol=1e-10)


@given(moves, moves, roots, roots)
def test_a_sum_is_the_motion_of_a_pose(first: Array, second: Array, root: Array, noise_root: Array) -> None:
    cov, noise = root @ root.T, noise_root @ noise_root.T
    total, total_cov = extended(first, cov, second, noise)
    moved = advance_spatial(first, cov, second, noise, "jacobian")
    np.testing.assert_allclose(total_cov, moved.cov, atol=1e-12)
    np.testing.assert_allclose(total[:3], moved.mean[:3], atol=1e-12)
    np.testing.assert_allclose(total[[0, 1, 3]], compose(first[[0, 1, 3]], second[[0, 1, 3]]), atol=1e-12)


def test_turns_are_counted() -> None:
    circle = [(np.array([1.0, 0.0, 0.0, 2.0]), np.zeros((4, 4)))] * 10
    assert summed(circle)[0][3] == pytest.approx(20.0)


def test_a_long_sum_is_still_precise() -> None:
    """Ten minutes at 10 Hz and 10 m/s: an increment of a tenth of a second is known to a micrometre's square."""
    noise = np.diag([4e-5, 1e-5, 1e-5, 2.5e-6])
    part = (np.array([1.0, 0.0, 0.01, 0.003]), noise)
    before = summed([part] * 6000)
    _, cov = increment(*before, *extended(*before, *part))
    np.testing.assert_allclose(cov, noise, atol=1e-11)
