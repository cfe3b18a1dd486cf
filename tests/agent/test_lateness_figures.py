"""Lags of timers: the largest, and percentiles to the millisecond."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from agent.lateness_figures import BIN_NS, LAST_BIN, LatenessFigures


@given(st.lists(st.integers(0, LAST_BIN * BIN_NS - 1), min_size=1, max_size=60), st.floats(0.01, 1.0))
def test_a_percentile_is_that_of_the_lags_to_the_millisecond(lags: list[int], share: float) -> None:
    figures = LatenessFigures()
    for lag in lags:
        figures.add(lag)
    exact = float(np.quantile(lags, share, method="inverted_cdf"))
    assert exact <= figures.percentile_ns(share) + 1e-6
    assert figures.percentile_ns(share) <= exact + BIN_NS
    assert figures.percentile_ns(1.0) == figures.max_ns == max(lags)


@given(st.lists(st.integers(0, 10**10), max_size=40), st.lists(st.integers(0, 10**10), max_size=40))
def test_figures_of_two_processes_add_up(first: list[int], second: list[int]) -> None:
    whole, parts = LatenessFigures(), LatenessFigures()
    for lags in (first, second):
        one = LatenessFigures()
        for lag in lags:
            one.add(lag)
            whole.add(lag)
        parts.heard(one.max_ns, one.told())
    assert parts.told() == whole.told()
    assert parts.percentile_ns(0.9) == whole.percentile_ns(0.9)


def test_early_timers_are_on_time_and_very_late_ones_are_not_forgotten() -> None:
    figures = LatenessFigures()
    assert figures.percentile_ns(0.99) == 0
    figures.add(-5)
    assert figures.max_ns == 0
    figures.add(10**15)
    assert figures.max_ns == 10**15
    assert figures.percentile_ns(1.0) >= LAST_BIN * BIN_NS
