"""Figures of formations, on places made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.planning.encircle import slots_of
from sim.formation_figures import formation_figures

Array = NDArray[np.float64]
RADIUS = 8.0
TARGET = np.array([3.0, -2.0, 5.0])
RING = slots_of(TARGET + np.array([[9.0, 0.0, 5.0], [-4.0, 7.0, 5.0], [-4.0, -7.0, 5.0]]), TARGET, RADIUS)


def figures(*places: Array, up: list[list[bool]] | None = None) -> dict[str, float | None]:
    there = np.array(places)
    alive = np.ones(there.shape[:2], dtype=bool) if up is None else np.array(up)
    inside = np.ones(len(there), dtype=bool)
    return formation_figures(there, np.tile(TARGET, (len(there), 1)), alive, inside, RADIUS)


def test_in_formation_nothing_is_off() -> None:
    made = figures(RING, RING)
    assert made["formation_error"] == pytest.approx(0.0, abs=1e-9)
    assert made["formation_kept_share"] == 1.0
    assert made["bearing_angle_error_rad"] == pytest.approx(0.0, abs=1e-9)
    assert made["target_min_distance_m"] == pytest.approx(RADIUS * math.sqrt(1.5))


@pytest.mark.parametrize(("share", "kept"), [(0.24, 1.0), (0.26, 0.5)])
def test_one_who_is_too_high_breaks_it(share: float, kept: float) -> None:
    off = RING + np.array([[0.0, 0.0, share * RADIUS], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    made = figures(RING, off)
    assert made["formation_error"] == pytest.approx(share / 6.0)
    assert made["formation_kept_share"] == kept


def test_who_is_down_does_not_count() -> None:
    fallen = RING.copy()
    fallen[1] = TARGET
    made = figures(RING, fallen, up=[[True] * 3, [True, False, True]])
    assert made["formation_kept_share"] == 1.0
    assert made["target_min_distance_m"] == pytest.approx(RADIUS * math.sqrt(1.5))
    assert figures(RING, fallen)["formation_kept_share"] == 0.5


def test_where_nobody_knows_nothing_is_said() -> None:
    unknown = np.full((3, 3), np.nan)
    assert figures(RING, unknown)["formation_kept_share"] == 1.0
    assert set(figures(unknown).values()) == {None}
