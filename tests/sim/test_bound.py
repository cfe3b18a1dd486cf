"""The centralized filter on the data of a world: never worse informed than the fleet, and honest."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from agent.config_file import ConfigError
from sim.bound import BoundRunner
from sim.engine import TrialResult
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized

SHORT = ["duration_s=120", "window_s=[30, 120]"]


def alone(sensors: dict[str, Any], **change: Any) -> Scenario:
    """One robot by itself: nothing has to be sent, so its own filter is the centralized one."""
    robot = {
        "id": "r1",
        "start": {"pose": [0.0, 0.0, 0.5]},
        "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
        "control": {"speed_mps": 0.3, "yaw_rate_radps": 0.05},
        "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02},
        "sensors": sensors,
    }
    data = {"version": 1, "name": "alone", "duration_s": 60.0, "step_s": 1.0, "window_s": [0.0, 60.0]}
    return Scenario.model_validate(data | {"robots": [robot]} | change)


@pytest.mark.parametrize(
    "sensors",
    [
        {},
        {"pose": {"sigma_m": 0.5, "sigma_rad": 0.1}},
        {"position": {"sigma_m": 0.3, "rate_hz": 0.2}},
        {
            "eye": {
                "kind": "range_bearing",
                "of": ["landmarks"],
                "sigma_m": 0.2,
                "sigma_rad": 0.05,
                "mount": [0.3, 0, 1],
            }
        },
    ],
    ids=["nothing", "pose", "position", "landmarks"],
)
def test_for_a_robot_alone_the_bound_is_its_own_filter(sensors: dict[str, Any]) -> None:
    made = alone(sensors, landmarks=[{"id": "A", "position": [5.0, 4.0]}, {"id": "B", "position": [-3.0, 2.0]}])
    trace = run_trial(made, 3, with_bound=True).trace
    assert trace.bound is not None
    np.testing.assert_allclose(trace.bound["robots"]["r1"].mean, trace.robots["r1"].mean, atol=1e-9)
    np.testing.assert_allclose(trace.bound["robots"]["r1"].cov, trace.robots["r1"].cov, atol=1e-9)


SEEDS = tuple(range(40, sized(44, 48)))


@pytest.fixture(scope="module")
def trials() -> list[TrialResult]:
    return [run_trial(load("ut-clat", SHORT), seed, with_bound=True) for seed in SEEDS]


def test_the_bound_knows_at_least_as_much_as_any_robot(trials: list[TrialResult]) -> None:
    """By its own account, summed over a run: the fleet uses a part of the bound's data."""
    for seed, trial in zip(SEEDS, trials, strict=True):
        assert trial.trace.bound is not None
        for robot, state in trial.trace.robots.items():
            own = np.trace(state.cov[:, :2, :2], axis1=1, axis2=2).mean()
            best = np.trace(trial.trace.bound["robots"][robot].cov[:, :2, :2], axis1=1, axis2=2).mean()
            assert best <= 1.02 * own, f"seed {seed}, {robot}"


def test_the_bound_errs_less_than_the_fleet(trials: list[TrialResult]) -> None:
    def mean_square(states: Any) -> float:
        return float(np.mean([np.sum((s.mean - s.truth)[30:, :2] ** 2) for s in states]))

    fleet = mean_square([state for trial in trials for state in trial.trace.robots.values()])
    bound = mean_square([state for trial in trials for state in (trial.trace.bound or {})["robots"].values()])
    assert bound < fleet, f"seeds {SEEDS}"


def test_the_bound_is_honest(trials: list[TrialResult]) -> None:
    """One instant per trial is independent of the others: mean NEES within a two-sided chi-square of 1e-3."""
    values = [
        nees((trial.trace.bound or {})["robots"][robot])[-1] for trial in trials for robot in ("r1", "r2", "r3", "r4")
    ]
    # Robots of one trial are correlated: only the trials count as independent.
    low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], 3 * len(SEEDS)) / (3 * len(SEEDS))
    assert low <= np.mean(values) <= high, f"seeds {SEEDS}"


def test_a_peer_is_brought_to_the_instant_at_which_it_is_seen() -> None:
    """r2 drives 3 m per step: a range held against where it was a step ago would be off by as much."""
    part = {"start_sigma": {"position_m": 0.1, "heading_rad": 0.01}, "noise": {"speed_mps": 0.3}}
    seer = {"id": "r1", "start": {"pose": [0.0, 0.0, 0.0]}, "sensors": {"range": {"of": ["peers"], "sigma_m": 0.05}}}
    driver = {"id": "r2", "start": {"pose": [5.0, 0.0, 0.0]}, "control": {"speed_mps": 3.0}}
    made = alone({}, robots=[part | seer, part | driver], duration_s=20.0)
    for seed in range(5):
        world = open_world(made, seed)
        runner = BoundRunner(made, world)
        for k in range(1, 21):
            runner.step(k, world.outputs(k))
        error = np.abs(runner.belief("r2")[0] - runner.belief("r1")[0] - world.truth("r2", 20) + world.truth("r1", 20))
        assert error[0] < 0.3, f"seed {seed}"


def test_a_target_drifts_on_between_sightings() -> None:
    target = {
        "id": "t1",
        "start": {"pose": [0.0, 0.0, 0.0]},
        "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
        "control": {"speed_mps": 1.0},
        "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.01},
    }
    made = alone({}, targets=[target])
    world = open_world(made, 1)
    runner = BoundRunner(made, world)
    start, cov = world.start_belief("t1")
    for k in range(1, 11):
        runner.step(k, world.outputs(k))
    mean, wider = runner.belief("t1")
    assert np.linalg.norm(mean[:2] - start[:2]) == pytest.approx(10.0, rel=0.02)
    assert np.trace(wider) > np.trace(cov)


def test_the_world_of_a_recording_that_is_not_there_is_refused_in_one_line() -> None:
    made = load("utias-all", ["world.path=/nowhere/at/all"])
    with pytest.raises(ConfigError, match=r"utias-all: world\.path: .*no such folder"):
        open_world(made, 1)


def test_a_target_nobody_knew_of_is_in_the_bound_once_somebody_has_seen_it() -> None:
    """Alone, a robot's own filter is the centralized one, also of a track that starts."""
    target = {
        "id": "t1",
        "model": "constant_velocity",
        "prior": False,
        "start": {"pose": [9.0, 1.0, -0.2, 0.1]},
        "start_sigma": {"velocity_mps": 0.3},
        "noise": {"acceleration_mps2": 0.02},
    }
    sensors = {"eye": {"kind": "vector", "of": ["targets"], "sigma_m": 0.2, "max_range_m": 8.0}}
    made = alone(sensors, targets=[target])
    trace = run_trial(made, 3, with_bound=True).trace
    assert trace.bound is not None
    best, own = trace.bound["targets"]["t1"], trace.targets["t1"]["r1"]
    assert not np.isfinite(best.mean[0]).any() and np.isfinite(best.mean[-1]).all()
    np.testing.assert_array_equal(np.isnan(best.mean), np.isnan(own.mean))
    started = np.isfinite(best.mean).all(axis=1)
    np.testing.assert_allclose(best.mean[started][0], own.mean[started][0], atol=1e-9)
    np.testing.assert_allclose(best.cov[started][0], own.cov[started][0], atol=1e-9)


CLOSED = ["duration_s=30", "window_s=[0, 30]"]


@pytest.fixture(scope="module")
def closed() -> list[TrialResult]:
    """Trials of robots that choose their motion by what they believe."""
    return [run_trial(load("ajlatt-c", CLOSED), seed, with_bound=True) for seed in CLOSED_SEEDS]


CLOSED_SEEDS = range(1, 1 + sized(2, 10))


def test_the_bound_looks_on_and_moves_nobody(closed: list[TrialResult]) -> None:
    plain = run_trial(load("ajlatt-c", CLOSED), CLOSED_SEEDS[0]).trace
    for robot, state in plain.robots.items():
        np.testing.assert_array_equal(state.truth, closed[0].trace.robots[robot].truth)
        np.testing.assert_array_equal(state.mean, closed[0].trace.robots[robot].mean)


def test_the_bound_knows_where_robots_went_that_chose_it(closed: list[TrialResult]) -> None:
    """It errs less than the fleet, and no more than it says: mean NEES of whole trials, which are independent."""
    own, bound, ratios = [], [], []
    for trial in closed:
        assert trial.trace.bound is not None
        for robot, state in trial.trace.robots.items():
            best = trial.trace.bound["robots"][robot]
            own.append(np.mean(np.sum((state.mean - state.truth)[:, :2] ** 2, axis=1)))
            bound.append(np.mean(np.sum((best.mean - best.truth)[:, :2] ** 2, axis=1)))
            ratios.append(np.mean(nees(best)))
    assert np.mean(bound) < np.mean(own), f"seeds {CLOSED_SEEDS}"
    assert 0.4 < np.mean(ratios) < 1.6, f"seeds {CLOSED_SEEDS}"
