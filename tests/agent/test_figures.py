"""Figures of a core: kinds have a bound, and what is done again is counted once."""

from __future__ import annotations

from contextlib import suppress

import pytest

from agent.figures import MAX_KINDS, Figures, NisSum


def test_kinds_beyond_the_bound_share_one_entry() -> None:
    figures = Figures()
    for number in range(2 * MAX_KINDS):
        figures.count_nis(f"kind {number}", 1.0)
    figures.count_nis("kind 0", 3.0)
    assert len(figures.nis) == MAX_KINDS
    assert figures.nis["kind 0"] == NisSum(4.0, 2)
    assert figures.nis["other"].count == MAX_KINDS + 1


@pytest.mark.parametrize("kept", [True, False])
def test_what_is_done_again_is_not_counted_again_even_if_it_fails(kept: bool) -> None:
    figures = Figures()
    counters, nis = figures.counters, figures.nis
    counters["used"] = 1
    with suppress(ZeroDivisionError), figures.kept(kept):
        counters["used"] += 1
        counters["late"] += 1
        figures.count_nis("range", 2.0)
        raise ZeroDivisionError
    assert dict(counters) == ({"used": 1} if kept else {"used": 2, "late": 1})
    assert (nis == {}) is kept
    figures.count_nis("range", 2.0)
    assert nis["range"].count == (1 if kept else 2)
    assert figures.counters is counters
