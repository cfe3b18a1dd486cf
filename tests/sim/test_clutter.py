"""False bearings: as many as expected, anywhere, and the same whatever else is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from sim.clutter import HALF_VIEW_RAD, Clutter

SCANS = 2000


@pytest.mark.parametrize("expected", [0.3, 1.0, 5.0])
def test_as_many_as_expected_and_as_scattered(expected: float) -> None:
    clutter = Clutter(expected, 1, SCANS, "l1", "camera")
    counts = [len(clutter.at(k)) for k in range(SCANS)]
    assert np.mean(counts) == pytest.approx(expected, abs=4.0 * np.sqrt(expected / SCANS))
    assert np.var(counts) == pytest.approx(expected, rel=0.2)


def test_they_are_anywhere_in_view() -> None:
    clutter = Clutter(5.0, 2, SCANS, "l1", "camera")
    found = np.concatenate([clutter.at(k) for k in range(SCANS)])
    for values, half in ((found[:, 0], np.pi), (found[:, 1], HALF_VIEW_RAD)):
        assert np.abs(values).max() <= half
        assert np.var(values) == pytest.approx(half**2 / 3.0, rel=0.05)
    narrow = np.concatenate([clutter.at(k, 1.0) for k in range(SCANS)])
    assert 0.45 < np.abs(narrow[:, 0]).max() <= 0.5


def test_a_scan_is_the_same_in_a_longer_run() -> None:
    short, long = Clutter(2.0, 3, 10, "l1", "camera"), Clutter(2.0, 3, 100, "l1", "camera")
    for k in range(10):
        assert np.array_equal(short.at(k), long.at(k))
    assert not np.array_equal(Clutter(2.0, 3, 10, "l2", "camera").at(0), short.at(0))
