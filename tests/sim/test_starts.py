"""Fleets whose robots, or targets, are not known of at first: what they claim is honest from the first instant on."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.engine import TrialResult
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_checks import check
from sim.summary import reduce, summarize
from sim.trial import run_trial
from tests.assertions import anees_band
from tests.sizes import sized

Array = NDArray[np.float64]

SEEDS = range(1, sized(4, 24) + 1)
POLAR = {"kind": "range_bearing", "sigma_m": 0.2, "sigma_rad": 0.03}
FORMS = ("split_joint", "safe")


def scenario(**change: Any) -> Scenario:
    data = {
        "version": 1,
        "name": "starts",
        "duration_s": 40.0,
        "step_s": 1.0,
        "window_s": [0.0, 40.0],
        "lateness": {"horizon_s": 10.0},
    } | change
    made = Scenario.model_validate(data)
    check(made)
    return made


def robot(index: int, place: list[float], sensors: dict[str, Any], source: str = "survey") -> dict[str, Any]:
    return {
        "id": f"r{index}",
        "start": {"pose": place},
        "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
        "start_source": source,
        "control": {"speed_mps": 0.5, "yaw_rate_radps": 0.1},
        "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02},
        "sensors": sensors,
    }


def beginners(source: str, form: str, **change: Any) -> Scenario:
    """One robot that knows where it is, and two that have to find out."""
    camera = {"camera": POLAR | {"of": ["peers"], "max_range_m": 15.0}}
    fixes: dict[str, Any] = {}
    if source == "fix":
        fixes = {"position": {"sigma_m": 0.7, "rate_hz": 0.2}, "heading": {"sigma_rad": 0.1, "rate_hz": 0.5}}
    return scenario(
        duration_s=25.0,
        localization={"form": form},
        robots=[
            robot(1, [-5.0, 3.0, 0.0], camera | {"pose": {"sigma_m": 0.5, "sigma_rad": 0.05}}),
            robot(2, [-1.0, -3.0, 0.9], camera | fixes, source),
            robot(3, [3.0, 3.0, 1.8], camera | fixes, source),
        ],
        **change,
    )


def seekers(form: str, kind: str = "range_bearing", **change: Any) -> Scenario:
    """Three robots, two of which can see a target that comes by and that nobody knows of."""
    eye = {key: value for key, value in POLAR.items() if kind != "bearing" or key != "sigma_m"} | {"kind": kind}
    if kind == "range":
        del eye["sigma_rad"]
    ranging = {"range": {"of": ["peers"], "sigma_m": 0.1, "max_range_m": 12.0}}
    seeing = ranging | {"eye": eye | {"of": ["targets"], "max_range_m": 8.0}}
    target = {
        "id": "t1",
        "model": "constant_velocity",
        "prior": False,
        "start": {"pose": [-12.0, 0.0, 0.4, 0.0]},
        "start_sigma": {"velocity_mps": 0.4},
        "noise": {"acceleration_mps2": 0.03},
    }
    return scenario(
        localization={"form": form},
        robots=[
            robot(1, [-5.0, -4.0, 0.0], seeing | {"pose": {"sigma_m": 0.5, "sigma_rad": 0.05}}),
            robot(2, [0.0, -4.0, 0.3], seeing),
            robot(3, [5.0, -4.0, 0.6], ranging),
        ],
        targets=[target | change.pop("target", {})],
        **change,
    )


def trials(made: Scenario) -> list[TrialResult]:
    return [run_trial(made, seed) for seed in SEEDS]


def assert_honest(ratios: list[Array], dof: int, limit: float = 1.0) -> None:
    """The mean NEES of N trials is at most that of N independent samples; all instants of one trial count as one."""
    known = [float(np.nanmean(row)) for row in ratios if np.isfinite(row).any()]
    assert len(known) >= 0.8 * len(ratios)
    _, high = anees_band(len(known), dof)
    assert np.mean(known) <= limit * high, [round(value, 2) for value in known]


@cache
def begun(source: str, form: str) -> list[TrialResult]:
    return trials(beginners(source, form))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("source", ["fix", "peer"])
def test_a_robot_that_finds_out_where_it_is_is_as_sure_as_it_may_be(source: str, form: str) -> None:
    for name in ("r2", "r3"):
        assert_honest([nees(result.trace.robots[name]) for result in begun(source, form)], 3)
        first = [ratio[np.isfinite(ratio)][:5] for ratio in (nees(r.trace.robots[name]) for r in begun(source, form))]
        assert_honest(first, 3)


@pytest.mark.parametrize("source", ["fix", "peer"])
def test_it_is_not_made_up_before(source: str) -> None:
    for result in begun(source, "split_joint"):
        mean = result.trace.robots["r2"].mean
        started = int(np.flatnonzero(np.isfinite(mean).all(axis=1))[0])
        assert 1 <= started <= 6
        assert np.isfinite(mean[started:]).all()


def test_a_summary_tells_when_a_robot_started_and_how_long_a_track_was_kept() -> None:
    made = beginners("fix", "split_joint")
    reduced = [reduce(made, result) for result in begun("fix", "split_joint")]
    robots = summarize(made, "virtual", 1, reduced, simulated_s=25.0, timing={})["robots"]
    assert robots["r1"]["started_s"] == 0.0 and robots["r1"]["known_share"] == 1.0
    assert 2.0 <= robots["r2"]["started_s"] <= 6.0
    assert robots["r2"]["known_share"] == pytest.approx(1.0 - robots["r2"]["started_s"] / 26.0)


def test_a_robot_to_which_nobody_tells_where_it_is_stays_without_an_estimate() -> None:
    """All wait for each other: nobody makes anything up, and the trial counts as lost."""
    made = beginners("peer", "split_joint")
    robots = [part.model_copy(update={"start_source": "peer"}) for part in made.robots]
    made = made.model_copy(update={"robots": robots, "duration_s": 10.0})
    result = run_trial(made, 1)
    assert not any(np.isfinite(trace.mean).any() for trace in result.trace.robots.values())
    summary = summarize(made, "virtual", 1, [reduce(made, result)], simulated_s=10.0, timing={})
    assert summary["lost"] == 1
    assert summary["robots"]["r1"]["started_s"] is None
    assert summary["robots"]["r1"]["position_rmse_m"] is None


@pytest.mark.parametrize("form", FORMS)
def test_a_track_that_starts_with_a_sighting_is_as_sure_as_it_may_be(form: str) -> None:
    results = trials(seekers(form))
    for name in ("r1", "r2", "r3"):
        assert_honest([nees(result.trace.targets["t1"][name]) for result in results], 4)
    for result in results:
        # Not before somebody sees it.
        assert not np.isfinite(result.trace.targets["t1"]["r3"].mean[0]).any()


@pytest.mark.parametrize("kind", ["bearing", "range"])
def test_a_track_of_one_number_is_as_vague_as_it_may_be(kind: str) -> None:
    results = trials(seekers("split_joint", kind, tracking={"start_within_m": 8.0}))
    for name in ("r1", "r2", "r3"):
        assert_honest([nees(result.trace.targets["t1"][name]) for result in results], 4)


def test_a_target_of_unknown_control_is_covered_by_its_assumed_noise() -> None:
    """It circles; the robots take it to head on as it heads, with noise as large as what they don't know."""
    target = {
        "model": "unicycle",
        "start": {"pose": [-12.0, 0.0, 0.0]},
        "start_sigma": {"heading_rad": 1.8},
        "control": {"speed_mps": 0.4, "yaw_rate_radps": 0.05},
        "assumed_noise": {"speed_mps": 0.5, "yaw_rate_radps": 0.5},
    }
    results = trials(seekers("split_joint", target=target))
    for name in ("r1", "r2"):
        assert_honest([nees(result.trace.targets["t1"][name]) for result in results], 3)


@pytest.mark.parametrize("form", FORMS)
def test_no_stale_track_is_shown(form: str) -> None:
    """The target goes away; some time later nobody has a track of it, and nobody gets one from a peer."""
    target = {"start": {"pose": [-6.0, 0.0, 1.5, 0.0]}, "start_sigma": {"velocity_mps": 2.0}}
    made = seekers(form, target=target, tracking={"end_after_s": 5.0})
    for seed in (1, 2, 3):
        result = run_trial(made, seed)
        last = max(float(times.max()) for (_, of), times in result.measured.items() if of == "target:t1")
        assert last < 30.0
        for name, track in result.trace.targets["t1"].items():
            at = np.isfinite(track.mean).all(axis=1)
            assert at.any(), name
            assert not at[result.trace.t_s > last + 5.0].any(), name
            counters = result.counters[name]
            assert counters["track.started"] == counters["track.ended"] >= 1
