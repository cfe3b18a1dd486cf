"""What a report is made from survives the disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.metrics import StateTrace, TrialTrace
from sim.scenario_file import load
from sim.sight import View, views
from sim.store import FILE, load_trace, save_trace
from sim.trial import run_trial


def assert_equal(left: StateTrace, right: StateTrace) -> None:
    for name in ("truth", "mean", "cov"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
    assert (left.angles, left.position) == (right.angles, right.position)


@pytest.mark.parametrize("with_bound", [False, True])
def test_a_trial_comes_back_as_it_was(tmp_path: Path, with_bound: bool) -> None:
    result = run_trial(load("ut-clat", ["duration_s=40", "window_s=[0, 40]"]), 3, with_bound=with_bound)
    landmarks = {"L1": (1.0, 2.5)}
    save_trace(tmp_path, result.trace, result.contacts, landmarks, result.measured)
    stored = load_trace(tmp_path)
    assert stored is not None
    assert (stored.contacts, stored.landmarks) == (result.contacts, landmarks)
    np.testing.assert_array_equal(stored.trace.t_s, result.trace.t_s)
    assert list(stored.measured) == list(result.measured)
    for pair, instants in result.measured.items():
        np.testing.assert_allclose(stored.measured[pair], instants, rtol=0.0, atol=1e-6)
    for robot, state in result.trace.robots.items():
        assert_equal(stored.trace.robots[robot], state)
        assert_equal(stored.trace.targets["t1"][robot], result.trace.targets["t1"][robot])
    assert (stored.trace.bound is None) == (not with_bound)
    for group, states in (result.trace.bound or {}).items():
        assert stored.trace.bound is not None
        for name, state in states.items():
            assert_equal(stored.trace.bound[group][name], state)


def test_fields_of_view_come_back(tmp_path: Path) -> None:
    found = views(load("dense-6"))
    assert found["r03"] == [View(0.0, 0.0, 0.0, 1.0471976, 2.0, 15.0)]
    assert views(load("ut-clat")) == {}
    state = StateTrace(np.zeros((2, 3)), np.ones((2, 3)), np.tile(np.eye(3), (2, 1, 1)), (2,))
    save_trace(tmp_path, TrialTrace(np.arange(2.0), {"r03": state}, {}), [], {}, views=found)
    stored = load_trace(tmp_path)
    assert stored is not None
    assert stored.views == found


def test_a_position_of_three_components_comes_back(tmp_path: Path) -> None:
    state = StateTrace(np.zeros((2, 4)), np.ones((2, 4)), np.tile(np.eye(4), (2, 1, 1)), (3,), (0, 1, 2))
    save_trace(tmp_path, TrialTrace(np.arange(2.0), {"drone": state}, {}), [], {})
    stored = load_trace(tmp_path)
    assert stored is not None
    assert_equal(stored.trace.robots["drone"], state)
    assert stored.measured == {}


def test_regular_measurements_cost_next_to_nothing(tmp_path: Path) -> None:
    state = StateTrace(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3, 3)), (2,))
    trace = TrialTrace(np.arange(2.0), {"r1": state}, {})
    save_trace(tmp_path, trace, [], {})
    without = (tmp_path / FILE).stat().st_size
    save_trace(tmp_path, trace, [], {}, {("r1", f"r{k}"): np.arange(10_000) * 0.1 for k in range(20)})
    assert (tmp_path / FILE).stat().st_size - without < 20_000


def test_a_run_without_samples_has_none(tmp_path: Path) -> None:
    assert load_trace(tmp_path) is None
