"""What a report is made from survives the disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.metrics import StateTrace
from sim.scenario import load
from sim.store import load_trace, save_trace
from sim.trial import run_trial


def assert_equal(left: StateTrace, right: StateTrace) -> None:
    for name in ("truth", "mean", "cov"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
    assert left.angles == right.angles


@pytest.mark.parametrize("with_bound", [False, True])
def test_a_trial_comes_back_as_it_was(tmp_path: Path, with_bound: bool) -> None:
    result = run_trial(load("ut-clat", ["duration_s=40", "window_s=[0, 40]"]), 3, with_bound=with_bound)
    landmarks = {"L1": (1.0, 2.5)}
    save_trace(tmp_path, result.trace, result.contacts, landmarks)
    stored = load_trace(tmp_path)
    assert stored is not None
    assert (stored.contacts, stored.landmarks) == (result.contacts, landmarks)
    np.testing.assert_array_equal(stored.trace.t_s, result.trace.t_s)
    for robot, state in result.trace.robots.items():
        assert_equal(stored.trace.robots[robot], state)
        assert_equal(stored.trace.targets["t1"][robot], result.trace.targets["t1"][robot])
    assert (stored.trace.bound is None) == (not with_bound)
    for group, states in (result.trace.bound or {}).items():
        assert stored.trace.bound is not None
        for name, state in states.items():
            assert_equal(stored.trace.bound[group][name], state)


def test_a_run_without_samples_has_none(tmp_path: Path) -> None:
    assert load_trace(tmp_path) is None
