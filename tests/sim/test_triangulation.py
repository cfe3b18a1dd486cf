"""Fleets of cameras that triangulate a target, through the network of the virtual engine."""

from __future__ import annotations

import numpy as np
import pytest

from agent.config_file import ConfigError
from sim.engine import TrialResult
from sim.invariants import InvariantChecker
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import sized

KINDS = ("stt", "cmkf", "cikf", "hcmci", "tkf", "kcf_plus", "icf_plus")
IMPROVED = KINDS[-2:]
SECONDS = 6.0
SEEDS = range(1, sized(1, 20) + 1)


def cameras(kind: str, *overrides: str, name: str = "stt-circle", seconds: float = SECONDS) -> Scenario:
    changes = (f"tracking.kind={kind}", f"duration_s={seconds}", f"window_s=[3.0, {seconds}]", *overrides)
    return load(name, changes)


def errors(result: TrialResult) -> np.ndarray:
    """Position errors (robots, instants) of all tracks from 3 s on [m]; NaN where none is told."""
    found = []
    for trace in result.trace.targets["t1"].values():
        found.append(np.linalg.norm((trace.mean - trace.truth)[result.trace.t_s >= 3.0, :3], axis=-1))
    return np.array(found)


@pytest.mark.parametrize("kind", KINDS)
def test_a_target_is_followed_by_cameras_that_tell_each_other_bearings(kind: str) -> None:
    overrides = () if kind in IMPROVED else ("tracking.parallax_rad=0",)
    seconds = 4.5
    result = run_trial(cameras(kind, *overrides, seconds=seconds), 1, checker=InvariantChecker(1))
    found = errors(result)
    assert np.isfinite(found).all(), "every camera of the fixed layout sees bearings cross"
    rmse = float(np.sqrt(np.mean(found**2)))
    assert rmse < (1.5 if kind in IMPROVED else 4.5), (kind, rmse)
    for counters in result.counters.values():
        assert counters["round.closed"] >= 10 * seconds - 1
        assert not counters.get("update.failed")


@pytest.mark.parametrize("name", ["stt-circle", "stt-square"])
@pytest.mark.parametrize("kind", IMPROVED)
def test_claims_are_honest(kind: str, name: str) -> None:
    assert_no_overconfidence([run_trial(cameras(kind, name=name), seed) for seed in SEEDS])


FAULTS = (
    "links.loss=0.3",
    "links.delay_s=0.05",
    "links.delay_tail_s=0.1",
    "robots.*.sensors.camera.detects=0.6",
    "robots.*.sensors.camera.false_share=0.05",
)


@pytest.mark.parametrize("kind", IMPROVED)
def test_claims_are_honest_with_all_faults_at_once(kind: str) -> None:
    results = [run_trial(cameras(kind, *FAULTS), seed, checker=InvariantChecker(seed)) for seed in SEEDS]
    assert_no_overconfidence(results)
    found = np.concatenate([errors(result) for result in results])
    assert float(np.sqrt(np.nanmean(found**2))) < 3.0
    assert np.isfinite(found).mean() > 0.8


@pytest.mark.parametrize("kind", IMPROVED)
def test_claims_are_honest_of_what_cameras_tell_their_robots_late(kind: str) -> None:
    """Half of the frames are lost, the others come 0.7 s late on the mean, so that a newer one may come before."""
    faults = []
    for number in range(1, 11):
        of = f'robot = "c{number}", sensor = "camera"'
        faults.append(f'{{kind = "sensor_dropout", share = 0.5, {of}}}, {{kind = "sensor_delay", tail_s = 0.7, {of}}}')
    scenario = cameras(kind, f"faults=[{', '.join(faults)}]")
    results = [run_trial(scenario, seed, checker=InvariantChecker(seed)) for seed in range(1, sized(1, 20) + 1)]
    assert_no_overconfidence(results)
    found = np.concatenate([errors(result) for result in results])
    assert float(np.sqrt(np.nanmean(found**2))) < 4.0
    assert np.isfinite(found).mean() > 0.8


def assert_no_overconfidence(results: list[TrialResult]) -> None:
    values = []
    for result in results:
        late = result.trace.t_s >= 3.0
        values += [nees(trace)[late] for trace in result.trace.targets["t1"].values()]
    mean = float(np.nanmean(np.array(values)))
    assert mean <= 1.15, mean


def test_cameras_that_hear_nobody_tell_no_place() -> None:
    assert np.isnan(errors(run_trial(cameras("icf_plus", "links.loss=1.0"), 1))).all()


def test_a_camera_that_begins_again_tracks_again() -> None:
    crash = 'faults=[{kind="crash", robot="c1", at_s=3.0, for_s=1.0}]'
    result = run_trial(cameras("icf_plus", crash), 2, checker=InvariantChecker(2))
    trace = result.trace.targets["t1"]["c1"]
    off = np.linalg.norm((trace.mean - trace.truth)[:, :3], axis=-1)
    assert off[result.trace.t_s >= 5.5].max() < 3.0


def test_the_bound_hears_every_bearing() -> None:
    ours, bound = [], []
    for seed in SEEDS:
        result = run_trial(cameras("kcf_plus"), seed, with_bound=True)
        best = result.trace.bound
        assert best is not None
        late = result.trace.t_s >= 3.0
        bound.append(np.linalg.norm((best["targets"]["t1"].mean - best["targets"]["t1"].truth)[late, :3], axis=-1))
        ours.append(errors(result))
    assert np.mean(bound) < np.mean(ours) < 4.0 * np.mean(bound)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("tracking.memory_s=2",), r"memory_s is of kind 'stt'"),
        (("robots.c1.tracking.kind=stt",), r"give all robots one kind"),
        (("targets.t1.model=damped_velocity_3d",), r"targets\.t1\.model.*needs 'constant_velocity_3d'"),
        (("tracking.start_within_m=10",), r"start_within_m does not go with"),
        (("localization.form=safe",), r"form = 'safe' is of kind 'clat'"),
    ],
)
def test_what_does_not_go_together_is_refused(overrides: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load("stt-circle", overrides)
