"""`summary.json`, schema 1: the names other programs rely on, and the figures under them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from sim.scenario import BoundPart, Scenario
from sim.scenario_file import load
from sim.summary import faults, reduce, summarize, unmet
from sim.trial import run_trial

FLEET = {
    "position_rmse_m",
    "heading_rmse_rad",
    "anees",
    "target_position_rmse_m",
    "target_velocity_rmse_mps",
    "target_anees",
}


def short(*overrides: str) -> Scenario:
    return load("ut-clat", ["duration_s=60", "window_s=[10, 60]", *overrides])


def summary_of(made: Scenario, seeds: list[int], with_bound: bool = False) -> dict[str, Any]:
    reduced = [reduce(made, run_trial(made, seed, with_bound=with_bound)) for seed in seeds]
    return summarize(made, "virtual", seeds[0], reduced, simulated_s=60.0, timing={"wall_s": 1.5})


@pytest.fixture(scope="module")
def summary() -> dict[str, Any]:
    return summary_of(short(), [3, 4], with_bound=True)


def test_the_keys_of_schema_1(summary: dict[str, Any]) -> None:
    assert {
        "schema", "scenario", "runtime", "seed", "trials", "lost", "window_s", "simulated_s", "robots", "targets",
        "fleet", "all", "median", "bound", "network", "series", "rejected", "covariance_repairs", "quarantines",
        "faults", "unsafe", "exit", "timing",
    } <= summary.keys()  # fmt: skip
    assert {
        "position_rmse_m", "heading_rmse_rad", "position_error_max_m", "final_position_error_m", "anees",
        "containment_3sigma", "error_max", "nis",
    } <= summary["robots"]["r1"].keys()  # fmt: skip
    assert summary["robots"]["r1"]["error_max"].keys() == {"x_m", "y_m", "heading_rad"}
    assert {
        "position_rmse_m", "heading_rmse_rad", "anees", "containment_3sigma", "error_min", "error_max", "error_worst",
    } <= summary["targets"]["t1"]["r1"].keys()  # fmt: skip
    for part in ("fleet", "all", "median", "bound"):
        assert summary[part].keys() >= FLEET
    assert summary["network"].keys() == {"sent", "delivered", "lost", "bytes", "bytes_per_robot_s", "pair"}
    assert summary["network"]["pair"].keys() == {"started", "completed", "one_sided", "fallback", "too_old"}
    assert {"t_s", "position_rmse_m"} <= summary["series"].keys()


def test_the_head_says_what_was_run(summary: dict[str, Any]) -> None:
    assert (summary["schema"], summary["scenario"], summary["runtime"]) == (1, "ut-clat", "virtual")
    assert (summary["seed"], summary["trials"], summary["lost"]) == (3, 2, 0)
    assert (summary["window_s"], summary["simulated_s"]) == ([10.0, 60.0], 60.0)
    assert summary["exit"] == {"r1": 0, "r2": 0, "r3": 0, "r4": 0}
    assert summary["timing"] == {"wall_s": 1.5}
    assert (summary["faults"], summary["covariance_repairs"]) == ([], 0)


def test_it_is_json_without_inventions(summary: dict[str, Any]) -> None:
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_every_robot_and_track_has_its_series(summary: dict[str, Any]) -> None:
    robots = ["r1", "r2", "r3", "r4"]
    assert list(summary["robots"]) == robots
    assert list(summary["targets"]["t1"]) == robots
    for robot in robots:
        assert len(summary["series"]["position_rmse_m"][robot]) == len(summary["series"]["t_s"]) == 61


def test_traffic_is_summed_over_trials() -> None:
    both, one, other = summary_of(short(), [3, 4]), summary_of(short(), [3]), summary_of(short(), [4])
    for key in ("sent", "delivered", "lost", "bytes"):
        assert both["network"][key] == one["network"][key] + other["network"][key]
    assert both["network"]["bytes_per_robot_s"] == pytest.approx(both["network"]["bytes"] / (60.0 * 2 * 4))
    started = [item["network"]["pair"]["started"] for item in (both, one, other)]
    assert started[0] == started[1] + started[2]


def test_innovations_are_means_per_kind(summary: dict[str, Any]) -> None:
    nis = summary["robots"]["r1"]["nis"]
    assert "pose" in nis
    # Mean of 120 innovations of 3 degrees of freedom, correlated: far from what a wrong covariance would give.
    assert 0.5 < nis["pose"] < 1.6


def test_without_the_bound_there_is_no_such_key() -> None:
    assert "bound" not in summary_of(short(), [3])


def test_what_was_injected_is_said_in_words() -> None:
    made = short("links.loss=0.25", "links.delay_s=0.1", "links.duplicate=0.5")
    assert faults(made) == ["loss 0.25", "delay 0.1 s + tail 0 s", "duplicate 0.5"]
    assert faults(short("links.nearest=2")) == ["only the nearest 2 are heard"]
    assert faults(short("links.rewire=1")) == ["1 are heard, others at every step"]


def test_exits_of_processes_are_kept() -> None:
    made = short()
    reduced = [reduce(made, run_trial(made, 3))]
    told = summarize(made, "processes", 3, reduced, simulated_s=60.0, timing={}, exits={"r1": 0, "r2": -9})
    assert told["exit"] == {"r1": 0, "r2": -9}


def test_expectations_are_held_against_the_figures(summary: dict[str, Any]) -> None:
    rmse = summary["fleet"]["position_rmse_m"]
    met = {"fleet.position_rmse_m": BoundPart(min=rmse, max=rmse), "lost": BoundPart(max=0)}
    assert unmet(summary, met) == []
    broken = {
        "fleet.position_rmse_m": BoundPart(max=rmse / 2),
        "trials": BoundPart(min=3),
        "fleet.no_such_figure": BoundPart(max=1),
        "fleet": BoundPart(max=1),
        "scenario.name": BoundPart(max=1),
    }
    assert unmet(summary, broken) == [
        f"fleet.position_rmse_m = {rmse:.4g} is above {rmse / 2:g}",
        "trials = 2 is below 3",
        "fleet.no_such_figure: not in the summary",
        "fleet: not in the summary",
        "scenario.name: not in the summary",
    ]
