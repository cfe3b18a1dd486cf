"""Figures of trials against plain loops, and against what chi-square statistics promise."""

from __future__ import annotations

import copy
import json
import math
import pickle
import statistics
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.metrics import (
    MAX_SERIES,
    StateTrace,
    TrialTrace,
    combine,
    components,
    errors,
    is_lost,
    nees,
    position_errors,
    reduce_trial,
    summarize,
    trial_figures,
)
from tests.assertions import anees_band, assert_consistent, assert_covariance

Array = NDArray[np.float64]
WINDOW = (10.0, 60.0)
LOST_M = 8.0


def honest(rng: np.random.Generator, count: int, n: int, angles: tuple[int, ...], scale: float = 1.0) -> StateTrace:
    """Truth on a random walk, an estimate whose errors follow its covariance times scale^2."""
    root = rng.normal(size=(count, n, n)) * 0.05 + 0.1 * np.eye(n)
    cov = root @ root.swapaxes(1, 2) + 1e-4 * np.eye(n)
    error = (np.linalg.cholesky(cov) @ rng.normal(size=(count, n, 1)))[..., 0] * scale
    truth = np.cumsum(rng.normal(size=(count, n)), axis=0)
    mean = truth + error
    for index in angles:
        mean[:, index] = np.remainder(mean[:, index], 2.0 * np.pi)
    return StateTrace(truth, mean, cov, angles)


def trial(seed: int, *, count: int = 71, bound: bool = True, scale: float = 1.0) -> TrialTrace:
    """Two unicycles tracking one target of velocity model, sampled each second; r2 has no estimate for a while."""
    rng = np.random.default_rng(seed)
    robots = {name: honest(rng, count, 3, (2,), scale) for name in ("r1", "r2")}
    robots["r2"].mean[20:25] = np.nan
    targets = {"t1": {name: honest(rng, count, 4, (), scale) for name in ("r1", "r2")}}
    targets["t1"]["r1"].mean[:30] = np.nan
    own = {
        "robots": {n: honest(rng, count, 3, (2,)) for n in ("r1", "r2")},
        "targets": {"t1": honest(rng, count, 4, ())},
    }
    return TrialTrace(np.arange(count) * 1.0, robots, targets, own if bound else None)


def astray(source: TrialTrace, robot: str, by_m: float) -> TrialTrace:
    """The trial with a robot's estimate moved away from the truth."""
    moved = copy.deepcopy(source)
    moved.robots[robot].mean[:, 0] += by_m
    return moved


def samples(traces: list[tuple[Array, StateTrace]]) -> list[tuple[Array, Array]]:
    """(error, covariance) of every estimate in the window, one by one."""
    found = []
    for t_s, trace in traces:
        for k, t in enumerate(t_s):
            if WINDOW[0] <= t <= WINDOW[1] and np.isfinite(trace.mean[k]).all():
                error = trace.mean[k] - trace.truth[k]
                for index in trace.angles:
                    error[index] = math.remainder(error[index], 2.0 * math.pi)
                found.append((error, trace.cov[k]))
    return found


def rms(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


def ratios(found: list[tuple[Array, Array]]) -> list[float]:
    return [float(e @ np.linalg.inv(P) @ e) / len(e) for e, P in found]


def test_a_belief_that_comes_late_or_never_tells_when_it_started() -> None:
    late, never = trial(1), trial(2)
    never.targets["t1"]["r2"].mean[:] = np.nan
    tracks = summarize([late, never], WINDOW, LOST_M)["targets"]["t1"]
    assert (tracks["r1"]["started_s"], tracks["r2"]["started_s"]) == (30.0, 0.0)
    assert tracks["r1"]["known_share"] == pytest.approx(31 / 51)
    assert tracks["r2"]["known_share"] == 0.5
    assert summarize([never], WINDOW, LOST_M)["targets"]["t1"]["r2"]["started_s"] is None


def test_figures_are_what_plain_loops_give() -> None:
    traces = [trial(seed) for seed in range(5)]
    summary = summarize(traces, WINDOW, LOST_M)
    assert summary["lost"] == 0
    assert summary["covariance_unusable"] == 0
    pooled = []
    for name in ("r1", "r2"):
        own = [samples([(t.t_s, t.robots[name])]) for t in traces]
        found = [item for items in own for item in items]
        pooled += found
        entry = summary["robots"][name]
        assert entry["position_rmse_m"] == pytest.approx(rms([math.hypot(e[0], e[1]) for e, _ in found]))
        assert entry["heading_rmse_rad"] == pytest.approx(rms([e[2] for e, _ in found]))
        assert entry["position_error_max_m"] == pytest.approx(max(math.hypot(e[0], e[1]) for e, _ in found))
        assert entry["known_share"] == pytest.approx(len(found) / (51 * len(traces)))
        assert entry["started_s"] == 0.0
        last = [math.hypot(*errors(t.robots[name])[-1, :2]) for t in traces]
        assert entry["final_position_error_m"] == pytest.approx(statistics.median(last))
        assert entry["anees"] == pytest.approx(statistics.fmean(ratios(found)))
        inside = [abs(e[i]) <= 3.0 * math.sqrt(P[i, i]) for e, P in found for i in range(3)]
        assert entry["containment_3sigma"] == pytest.approx(statistics.fmean(inside))
        assert entry["dof"] == 3
        for index, key in enumerate(("x_m", "y_m", "heading_rad")):
            largest = [max(abs(e[index]) for e, _ in items) for items in own]
            smallest = [min(abs(e[index]) for e, _ in items) for items in own]
            assert entry["error_max"][key] == pytest.approx(statistics.median(largest))
            assert entry["error_worst"][key] == pytest.approx(max(largest))
            assert entry["error_min"][key] == pytest.approx(statistics.median(smallest))
        assert "velocity_rmse_mps" not in entry
    tracked = []
    for name in ("r1", "r2"):
        own = [samples([(t.t_s, t.targets["t1"][name])]) for t in traces]
        found = [item for items in own for item in items]
        tracked += found
        entry = summary["targets"]["t1"][name]
        assert set(entry) == {
            "dof", "position_rmse_m", "velocity_rmse_mps", "anees", "containment_3sigma",
            "error_min", "error_max", "error_worst", "started_s", "known_share",
        }  # fmt: skip
        for index, key in enumerate(("x_m", "y_m", "vx_mps", "vy_mps")):
            largest = [max(abs(e[index]) for e, _ in items) for items in own]
            assert entry["error_max"][key] == pytest.approx(statistics.median(largest))
        assert entry["velocity_rmse_mps"] == pytest.approx(rms([math.hypot(e[2], e[3]) for e, _ in found]))
        assert entry["anees"] == pytest.approx(statistics.fmean(ratios(found)))
    fleet = summary["fleet"]
    assert fleet["position_rmse_m"] == pytest.approx(rms([math.hypot(e[0], e[1]) for e, _ in pooled]))
    assert fleet["heading_rmse_rad"] == pytest.approx(rms([e[2] for e, _ in pooled]))
    assert fleet["anees"] == pytest.approx(statistics.fmean(ratios(pooled)))
    assert fleet["target_position_rmse_m"] == pytest.approx(rms([math.hypot(e[0], e[1]) for e, _ in tracked]))
    assert fleet["target_anees"] == pytest.approx(statistics.fmean(ratios(tracked)))
    bounds = samples([(t.t_s, b) for t in traces if t.bound for b in t.bound["robots"].values()])
    assert summary["bound"]["position_rmse_m"] == pytest.approx(rms([math.hypot(e[0], e[1]) for e, _ in bounds]))
    assert summary["bound"]["lost"] == 0
    assert set(summary["bound"]["robots"]) == {"r1", "r2"}
    assert set(summary["bound"]["targets"]) == {"t1"}


def test_lost_trials_are_counted_and_kept_out_of_all_but_all_and_median() -> None:
    good = [trial(seed) for seed in range(4)]
    traces = [good[0], astray(good[1], "r1", 20.0), *good[2:]]
    summary = summarize(traces, WINDOW, LOST_M)
    assert summary["lost"] == 1
    without = summarize([good[0], *good[2:]], WINDOW, LOST_M)
    for key in ("robots", "targets", "fleet", "bound", "series"):
        assert summary[key] == without[key], key
    assert summary["all"]["position_rmse_m"] > 5.0
    single = [summarize([t], WINDOW, 1e9)["fleet"]["position_rmse_m"] for t in traces]
    assert summary["median"]["position_rmse_m"] == statistics.median(single)


def test_a_track_gone_astray_loses_the_trial_too() -> None:
    moved = trial(1)
    moved.targets["t1"]["r2"].mean[:, 1] += 9.0
    assert is_lost(reduce_trial(moved, WINDOW), LOST_M)
    assert not is_lost(reduce_trial(moved, WINDOW), 10.0)


def test_outside_the_window_nothing_counts() -> None:
    moved = trial(1)
    moved.robots["r1"].mean[:10] += 100.0
    moved.robots["r1"].mean[61:] += 100.0
    assert summarize([moved], WINDOW, LOST_M)["fleet"] == summarize([trial(1)], WINDOW, LOST_M)["fleet"]


def test_a_robot_without_estimate_is_lost_but_an_untold_target_is_not() -> None:
    silent = trial(1)
    silent.robots["r2"].mean[10:61] = np.nan
    assert is_lost(reduce_trial(silent, WINDOW), LOST_M)
    untold = trial(1)
    untold.targets["t1"]["r1"].mean[:] = np.nan
    assert not is_lost(reduce_trial(untold, WINDOW), LOST_M)
    entry = summarize([untold], WINDOW, LOST_M)["targets"]["t1"]
    assert entry["r1"]["position_rmse_m"] is None
    assert entry["r1"]["anees"] is None
    assert entry["r2"]["position_rmse_m"] is not None


def test_if_all_trials_are_lost_their_figures_remain() -> None:
    summary = summarize([astray(trial(1), "r1", 20.0), astray(trial(2), "r2", 20.0)], WINDOW, LOST_M)
    assert summary["lost"] == 2
    assert summary["fleet"] == summary["all"]


def test_the_bounds_own_lost_trials_do_not_flatter_us() -> None:
    traces = [trial(1), trial(2)]
    assert traces[1].bound is not None
    traces[1].bound["robots"]["r1"].mean[:, 0] += 50.0
    bound = summarize(traces, WINDOW, LOST_M)["bound"]
    assert bound["lost"] == 1
    assert bound["position_rmse_m"] == summarize(traces[:1], WINDOW, LOST_M)["bound"]["position_rmse_m"]
    both = [copy.deepcopy(trace) for trace in (traces[1], traces[1])]
    assert summarize(both, WINDOW, LOST_M)["bound"]["lost"] == 2


def test_heading_and_velocity_are_not_mixed_in_a_mixed_fleet() -> None:
    rng = np.random.default_rng(3)
    rover, drone = honest(rng, 71, 3, (2,)), honest(rng, 71, 4, (), 5.0)
    summary = summarize([TrialTrace(np.arange(71.0), {"rover": rover, "drone": drone}, {})], WINDOW, LOST_M)
    assert summary["fleet"]["heading_rmse_rad"] == summary["robots"]["rover"]["heading_rmse_rad"]
    assert "heading_rmse_rad" not in summary["robots"]["drone"]
    assert summary["robots"]["drone"]["velocity_rmse_mps"] > 0.0
    assert list(summary["robots"]["drone"]["error_max"]) == ["x_m", "y_m", "vx_mps", "vy_mps"]
    alone = summarize([TrialTrace(np.arange(71.0), {"drone": drone}, {})], WINDOW, LOST_M)
    assert alone["fleet"]["heading_rmse_rad"] is None
    assert alone["fleet"]["target_position_rmse_m"] is None


def test_position_is_where_the_state_says_and_parameters_are_no_velocities() -> None:
    rng = np.random.default_rng(4)
    plain = honest(rng, 71, 6, (3,))
    flying = StateTrace(plain.truth, plain.mean, plain.cov, (3,), (0, 1, 2))
    assert components(flying) == ["x_m", "y_m", "z_m", "heading_rad", "parameter_1", "parameter_2"]
    entry = summarize([TrialTrace(np.arange(71.0), {"drone": flying}, {})], WINDOW, LOST_M)["robots"]["drone"]
    found = samples([(np.arange(71.0), flying)])
    assert entry["position_rmse_m"] == pytest.approx(rms([float(np.linalg.norm(e[:3])) for e, _ in found]))
    assert entry["heading_rmse_rad"] == pytest.approx(rms([e[3] for e, _ in found]))
    assert "velocity_rmse_mps" not in entry
    assert list(entry["error_max"])[2] == "z_m"
    assert position_errors(flying)[20] == pytest.approx(float(np.linalg.norm(errors(flying)[20, :3])))


def test_a_covariance_that_is_none_is_counted_and_gives_no_nees() -> None:
    broken = trial(1)
    broken.robots["r1"].cov[15] = -np.eye(3)
    broken.robots["r1"].cov[16] = 0.0
    broken.robots["r1"].cov[17] = np.nan
    ratio = nees(broken.robots["r1"])
    assert np.isnan(ratio[15:18]).all()
    assert np.isfinite(np.delete(ratio, [15, 16, 17])).all()
    summary = summarize([broken], WINDOW, LOST_M)
    assert summary["covariance_unusable"] == 3
    assert summary["fleet"]["position_rmse_m"] == summarize([trial(1)], WINDOW, LOST_M)["fleet"]["position_rmse_m"]
    json.dumps(summary, allow_nan=False)


def test_heading_errors_take_the_short_way() -> None:
    truth = np.array([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1], [0.0, 0.0, 40.0]])
    mean = np.array([[0.0, 0.0, -3.1], [0.0, 0.0, 3.1], [0.0, 0.0, 40.0 - 6.0 * np.pi + 0.1]])
    found = errors(StateTrace(truth, mean, np.tile(np.eye(3), (3, 1, 1)), (2,)))[:, 2]
    gap = 2.0 * np.pi - 6.2
    assert found == pytest.approx([gap, -gap, 0.1])


@settings(deadline=None, max_examples=60)
@given(seed=st.integers(0, 10_000), factor=st.floats(0.1, 10.0))
def test_nees_does_not_depend_on_units(seed: int, factor: float) -> None:
    plain = honest(np.random.default_rng(seed), 20, 4, ())
    scaled = StateTrace(plain.truth * factor, plain.mean * factor, plain.cov * factor**2, ())
    assert nees(scaled) == pytest.approx(nees(plain), rel=1e-6)


def test_an_honest_filter_is_consistent_and_others_are_not() -> None:
    rng = np.random.default_rng(11)
    assert_consistent(nees(honest(rng, 2000, 3, (2,))), 3)
    with pytest.raises(AssertionError, match="overconfident"):
        assert_consistent(nees(honest(rng, 2000, 3, (2,), 1.1)), 3)
    with pytest.raises(AssertionError, match="underconfident"):
        assert_consistent(nees(honest(rng, 2000, 3, (2,), 0.9)), 3)
    assert_consistent(nees(honest(rng, 2000, 3, (2,), 1.1)), 3, slack=1.3)
    assert_consistent(nees(honest(rng, 2000, 3, (2,), 1.1)), 3, independent=20)


def test_the_consistency_band_holds_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    low, high = anees_band(50, 3, 0.95)
    means = rng.chisquare(3, size=(4000, 50)).mean(axis=1) / 3.0
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.015)


def test_a_covariance_is_symmetric_and_positive_definite() -> None:
    assert_covariance(np.eye(3))
    for wrong in (np.diag([1.0, -1e-9]), np.array([[1.0, 0.5], [0.4, 1.0]]), np.full((2, 2), np.nan)):
        with pytest.raises(AssertionError):
            assert_covariance(wrong)


def test_summary_figures_of_an_honest_filter_are_honest() -> None:
    summary = summarize([trial(seed) for seed in range(40)], WINDOW, LOST_M)
    assert summary["fleet"]["anees"] == pytest.approx(1.0, abs=0.04)
    assert summary["fleet"]["target_anees"] == pytest.approx(1.0, abs=0.04)
    for entry in summary["robots"].values():
        assert entry["containment_3sigma"] == pytest.approx(0.9973, abs=0.002)


def test_reduced_trials_cross_processes_and_combine_to_the_same_bits() -> None:
    traces = [trial(seed) for seed in range(6)]
    here = [reduce_trial(trace, WINDOW) for trace in traces]
    there: list[dict[str, Any]] = [None] * 6  # type: ignore[list-item]
    for index in (4, 1, 5, 0, 3, 2):
        there[index] = pickle.loads(pickle.dumps(reduce_trial(traces[index], WINDOW)))
    assert json.dumps(combine(here, LOST_M)) == json.dumps(combine(there, LOST_M))


def test_a_long_trial_is_reduced_to_a_small_record() -> None:
    long = trial(1, count=5001)
    reduced = reduce_trial(long, (10.0, 5000.0))
    assert len(reduced["t_s"]) <= MAX_SERIES
    assert len(pickle.dumps(reduced)) < 50_000
    series = combine([reduced], LOST_M)["series"]
    for name in ("r1", "r2"):
        assert len(series["position_rmse_m"][name]) == len(series["anees"][name]) == len(series["t_s"])
    assert len(series["target_position_rmse_m"]["t1"]["r2"]) == len(series["t_s"])
    assert len(series["bound_position_rmse_m"]["r1"]) == len(series["t_s"])
    assert len(series["bound_target_position_rmse_m"]["t1"]) == len(series["t_s"])


def test_series_are_over_the_trials_that_have_an_estimate() -> None:
    traces = [trial(1), trial(2)]
    traces[0].robots["r1"].mean[30] = np.nan
    series = summarize(traces, WINDOW, LOST_M)["series"]
    assert series["t_s"][30] == 30.0
    at = math.hypot(*errors(traces[1].robots["r1"])[30, :2])
    assert series["position_rmse_m"]["r1"][30] == pytest.approx(at)
    both = rms([math.hypot(*errors(t.robots["r1"])[40, :2]) for t in traces])
    assert series["position_rmse_m"]["r1"][40] == pytest.approx(both)
    assert series["position_rmse_m"]["r2"][22] is None
    assert series["anees"]["r2"][22] is None
    assert series["target_position_rmse_m"]["t1"]["r1"][5] is None


def test_a_trials_row_names_fleet_and_robots() -> None:
    row = trial_figures(reduce_trial(trial(1), WINDOW))
    summary = summarize([trial(1)], WINDOW, LOST_M)
    assert row["position_rmse_m"] == summary["fleet"]["position_rmse_m"]
    assert row["r2_position_rmse_m"] == summary["robots"]["r2"]["position_rmse_m"]
    assert row["r2_nees"] == summary["robots"]["r2"]["anees"]


def test_velocities_of_targets_have_figures() -> None:
    made = trial(1)
    row, summary = trial_figures(reduce_trial(made, WINDOW)), summarize([made], WINDOW, LOST_M)
    inside = (made.t_s >= WINDOW[0]) & (made.t_s <= WINDOW[1])
    off = np.concatenate([errors(track)[inside, 2:] for track in made.targets["t1"].values()])
    expected = math.sqrt(np.nanmean(np.sum(off**2, axis=1)))
    assert summary["fleet"]["target_velocity_rmse_mps"] == pytest.approx(expected)
    assert row["target_velocity_rmse_mps"] == row["t1_velocity_rmse_mps"] == pytest.approx(expected)
    assert row["t1_position_rmse_m"] == summary["fleet"]["target_position_rmse_m"]
    # A target with a heading has none.
    made.targets["t1"] = {name: made.robots[name] for name in made.robots}
    row = trial_figures(reduce_trial(made, WINDOW))
    assert not {"target_velocity_rmse_mps", "t1_velocity_rmse_mps"} & row.keys()


def test_nothing_can_be_said_of_no_trials() -> None:
    with pytest.raises(ValueError, match="give at least one"):
        combine([], LOST_M)


def test_a_track_has_figures_of_the_time_shortly_after_its_robots_sightings() -> None:
    t_s = np.arange(20.0)
    truth = np.zeros((20, 4))
    mean = np.tile([1.0, 0.0, 0.0, 0.0], (20, 1))
    mean[5:8, 0], mean[12:15, 0] = 0.1, 0.2
    track = StateTrace(truth, mean, np.tile(np.eye(4), (20, 1, 1)), ())
    own = StateTrace(np.zeros((20, 3)), np.zeros((20, 3)), np.tile(np.eye(3), (20, 1, 1)), (2,))
    robots = {"r1": own, "r2": own, "r3": own}
    trace = TrialTrace(t_s, robots, {"t1": dict.fromkeys(robots, track)}, {"robots": robots, "targets": {"t1": track}})
    measured = {("r1", "target:t1"): np.array([5.0]), ("r2", "target:t1"): np.array([12.0]), ("r3", "r1"): t_s}
    summary = combine([reduce_trial(trace, (0.0, 20.0), measured)], 8.0)
    of = {name: entry["position_rmse_2s_m"] for name, entry in summary["targets"]["t1"].items()}
    assert of == {"r1": pytest.approx(0.1), "r2": pytest.approx(0.2), "r3": None}
    assert summary["targets"]["t1"]["r2"]["error_max_2s_m"] == pytest.approx(0.2)
    assert summary["bound"]["targets"]["t1"]["position_rmse_2s_m"] == pytest.approx(np.sqrt((0.01 + 0.04) / 2.0))
    late = combine([reduce_trial(trace, (14.5, 20.0), measured)], 8.0)
    assert late["targets"]["t1"]["r2"]["position_rmse_2s_m"] is None


def test_a_robot_without_truth_has_no_figures_and_is_not_lost() -> None:
    unknown = StateTrace(np.full((5, 3), np.nan), np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)), (2,))
    summary = summarize([TrialTrace(np.arange(5.0), {"r1": unknown}, {})], (0.0, 5.0), 8.0)
    assert summary["lost"] == 0
    assert summary["robots"]["r1"]["position_rmse_m"] is None
    assert summary["fleet"]["anees"] is None
