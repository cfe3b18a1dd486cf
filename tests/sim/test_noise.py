"""Noise that is named, not drawn in an order."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from sim.noise import generator, normal_rows, uniform_rows

SEEDS = st.integers(0, 2**40)


@given(SEEDS, st.integers(1, 40), st.integers(1, 40), st.integers(1, 4))
def test_a_row_does_not_depend_on_how_many_are_drawn(seed: int, some: int, more: int, size: int) -> None:
    rows, longer = normal_rows(seed, some, size, "r1", "range"), normal_rows(seed, some + more, size, "r1", "range")
    assert rows.shape == (some, size)
    np.testing.assert_array_equal(rows, longer[:some])


@given(SEEDS, st.integers(1, 40), st.integers(1, 40))
def test_a_uniform_row_does_not_either(seed: int, some: int, more: int) -> None:
    rows, longer = uniform_rows(seed, some, 4, "c1", "camera"), uniform_rows(seed, some + more, 4, "c1", "camera")
    np.testing.assert_array_equal(rows, longer[:some])
    assert rows.min() >= 0.0
    assert rows.max() < 1.0


@given(SEEDS, st.permutations([("r1", "range"), ("r1", "pose"), ("r2", "range"), ("t1", "control")]))
def test_the_order_of_drawing_does_not_matter(seed: int, order: list[tuple[str, str]]) -> None:
    drawn = {names: normal_rows(seed, 3, 2, *names) for names in order}
    for names in sorted(order):
        np.testing.assert_array_equal(drawn[names], normal_rows(seed, 3, 2, *names))


def test_names_and_seeds_are_told_apart() -> None:
    names = [("r1", "range"), ("r1", "rang"), ("r1range",), ("range", "r1"), ("r1", "range", ""), ("r", "1range")]
    first = [normal_rows(seed, 1, 1, *name)[0, 0] for seed in (1, 2, 11) for name in names]
    first.append(normal_rows(1, 1, 1, "1", "range")[0, 0])
    assert len(set(first)) == len(first)


def test_streams_are_standard_normal_and_unrelated() -> None:
    one, other = normal_rows(7, 4000, 1, "r1", "range")[:, 0], normal_rows(7, 4000, 1, "r2", "range")[:, 0]
    assert stats.kstest(one, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(one, other)[0, 1]) < 4.0 / np.sqrt(4000)


def test_numbers_are_written_down() -> None:
    """A seed in a report must mean the same run in a later version."""
    np.testing.assert_allclose(normal_rows(1, 2, 2, "r1", "range"), NUMBERS, rtol=1e-12)
    assert generator(1, "r1").integers(0, 2**32) == DRAWN


NUMBERS = [[-1.1924848746044285, 1.3944600114447014], [0.3437299545930755, -1.425035055323935]]
DRAWN = 2_836_951_614
