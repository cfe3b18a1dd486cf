"""Figures of relative places: what counts as right, when somebody is identified, and what is pooled."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agent.effects import RelativeEstimate
from agent.estimation.gate_test import GateTest
from sim.metrics import StateTrace, TrialTrace, combine, reduce_trial, trial_figures
from sim.relative_figures import (
    RelativeTrace,
    ShownGate,
    blank,
    combine_relatives,
    fill,
    identified_s,
    nees,
    reduce_relatives,
    relative_state,
    right,
)
from sim.relative_plots import gate
from sim.store import load_trace, save_trace

T_S = np.arange(0.0, 10.0, 0.1)
TRUTH = np.array([3.0, -1.0, 0.5, 3.0])


def trace(off_m: np.ndarray, turn: float = 0.0, sigma: float = 0.5) -> RelativeTrace:
    """Errors (K,) of the place along x; NaN: nothing is known."""
    found = blank(len(off_m))
    for row, off in enumerate(off_m):
        if np.isfinite(off):
            mean = TRUTH + np.array([off, 0.0, 0.0, turn])
            fill(found, row, RelativeEstimate("p1", 0, mean, sigma**2 * np.eye(4), 0.9, 0.3, 2, True), 0.05)
        found.truth[row] = TRUTH
    return found


def test_a_state_is_seen_from_the_own_body() -> None:
    own = np.array([1.0, 1.0, 2.0, np.pi / 2])
    other = np.array([0.0, 3.0, 1.0, np.pi])
    assert relative_state(own, other) == pytest.approx([2.0, 1.0, -1.0, np.pi / 2])


def test_right_is_within_half_a_metre_in_space() -> None:
    assert right(trace(np.array([0.0, 0.49, 0.51, np.nan]))).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("wrong_until", "wrong_at", "expected"), [(0.0, None, 0.0), (1.0, None, 1.0), (1.0, 2.5, 2.6), (8.5, None, None)]
)
def test_identified_is_who_is_right_for_two_seconds(
    wrong_until: float, wrong_at: float | None, expected: float | None
) -> None:
    good = wrong_until - 1e-9 <= T_S
    if wrong_at is not None:
        good = good & (np.abs(T_S - wrong_at) > 0.01)
    found = identified_s(T_S, good)
    assert found == (None if expected is None else pytest.approx(expected))


def test_headings_are_compared_around_the_circle() -> None:
    found = trace(np.zeros(3), turn=0.5)
    found.mean[:, 3] = TRUTH[3] + 0.5 - 2.0 * np.pi
    assert nees(found) == pytest.approx(0.25)


def test_figures_are_pooled_over_pairs_and_trials() -> None:
    pairs = {("l1", "p1"): trace(np.full(100, 0.3)), ("l1", "p2"): trace(np.full(100, 1.0))}
    inside = T_S >= 5.0
    reduced = reduce_relatives(T_S, pairs, inside)
    assert reduced is not None
    found = combine_relatives([reduced, reduced])
    assert found["identified_share"][0] == [0.0, 0.5]
    assert found["time_to_identify_s"] == {"median": 0.0, "p90": None}
    assert found["never_identified_share"] == 0.5
    assert found["position_rmse_m"] == pytest.approx(np.sqrt((0.09 + 1.0) / 2.0))
    assert found["tracks_mean"] == 2.0 and found["ambiguous_share"] == 1.0
    assert found["lag_median_s"] == pytest.approx(0.05)


def test_the_median_of_nees_is_one_where_claims_are_honest() -> None:
    rng = np.random.default_rng(4)
    found = trace(np.zeros(4000), sigma=0.5)
    found.mean[:] = TRUTH + 0.5 * rng.normal(size=found.mean.shape)
    t_s = np.arange(4000) * 0.1
    reduced = reduce_relatives(t_s, {("l1", "p1"): found}, t_s >= 0.0)
    assert reduced is not None
    assert combine_relatives([reduced])["anees_median"] == pytest.approx(1.0, abs=0.06)


def test_nobody_who_locates_nobody_has_figures() -> None:
    assert reduce_relatives(T_S, {}, T_S > 1.0) is None


def whole() -> TrialTrace:
    own = StateTrace(np.zeros((100, 4)), np.zeros((100, 4)), np.tile(np.eye(4), (100, 1, 1)), (3,), (0, 1, 2))
    return TrialTrace(T_S, {"l1": own}, {}, relatives={("l1", "p1"): trace(np.full(100, 0.2))})


def test_they_are_part_of_the_summary_and_of_a_trials_row() -> None:
    reduced = reduce_trial(whole(), (2.0, 8.0))
    assert combine([reduced], 8.0)["relative"]["position_rmse_m"] == pytest.approx(0.2)
    assert trial_figures(reduced)["relative_right_share"] == 1.0


def test_a_kept_trial_has_them_again(tmp_path: Path) -> None:
    cov = np.tile(0.01 * np.eye(2), (2, 1, 1))
    test = GateTest(np.ones((3, 2)), np.array([0.6, 0.4]), np.zeros((2, 2)), cov, 2.0 * cov, 9.2)
    save_trace(tmp_path, whole(), [], {}, gate=ShownGate(0.5, "l1", "p1", TRUTH, test))
    stored = load_trace(tmp_path)
    assert stored is not None and stored.gate is not None
    assert (stored.gate.t_s, stored.gate.robot, stored.gate.peer) == (0.5, "l1", "p1")
    assert np.array_equal(stored.gate.test.gate, test.gate) and stored.gate.test.limit == 9.2
    assert stored.gate.test.wider == pytest.approx(2.0)
    assert gate(stored.gate, tmp_path / "gate.png").stat().st_size > 1000
    (key, found), before = next(iter(stored.trace.relatives.items())), whole().relatives["l1", "p1"]
    assert key == ("l1", "p1")
    assert np.array_equal(found.mean, before.mean) and np.array_equal(found.confirmed, before.confirmed)
