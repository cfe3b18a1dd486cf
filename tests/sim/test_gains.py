"""Robots that estimate the gains of their odometry, in a simulated fleet: honest, and within one message."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import run_trial

SEEDS = range(1, 9)


def fleet(**change: Any) -> Scenario:
    """Three robots on circles of their own that range; r1 has fixes."""

    def robot(index: int) -> dict[str, Any]:
        sensors: dict[str, Any] = {
            "camera": {"kind": "range_bearing", "of": ["peers"], "sigma_m": 0.1, "sigma_rad": 0.03, "rate_hz": 0.5}
        }
        if index == 1:
            sensors["position"] = {"sigma_m": 0.1, "rate_hz": 1.0}
        return {
            "id": f"r{index}",
            "model": "unicycle_gains",
            "gain_walk_per_sqrt_s": 0.01,
            "start": {"pose": [4.0 * index, 0.0, 0.5]},
            "start_sigma": {"position_m": 0.3, "heading_rad": 0.1, "gain_along": 0.1, "gain_turn": 0.1},
            "control": {"speed_mps": 0.5, "yaw_rate_radps": 0.1 * index},
            "noise": {"speed_mps": 0.05, "yaw_rate_radps": 0.02},
            "sensors": sensors,
        }

    data = {
        "version": 1,
        "name": "gains",
        "duration_s": 80.0,
        "step_s": 1.0,
        "window_s": [20.0, 80.0],
        "tracking": {"kind": "none"},
        "localization": {"form": "safe"},
        "robots": [robot(index) for index in (1, 2, 3)],
    }
    return Scenario.model_validate(data | change)


def test_gains_are_learnt_and_the_fleet_stays_honest() -> None:
    values, learnt = [], []
    for seed in SEEDS:
        trace = run_trial(fleet(), seed).trace
        for state in trace.robots.values():
            assert state.mean.shape[1] == 5
            values.append(np.mean(nees(state)[20:]))
            learnt.append(state.cov[-1, 3, 3] < 0.5 * state.cov[0, 3, 3])
    # One independent sample of five degrees of freedom per trial, as in the tests of consistency.
    dof = 5 * len(SEEDS)
    low, high = stats.chi2.ppf([0.005, 0.995], dof) / dof
    assert low <= np.mean(values) <= high
    assert all(learnt)


def test_the_bound_knows_the_gains_too() -> None:
    made = fleet()
    trace = run_trial(made, 3, with_bound=True).trace
    assert trace.bound is not None
    for name, state in trace.robots.items():
        best = trace.bound["robots"][name]
        assert np.trace(best.cov[-1]) <= 1.05 * np.trace(state.cov[-1])


def test_messages_stay_within_one_datagram_when_contacts_are_open() -> None:
    """Lines of open contacts pile up; what does not fit is left out, and the pair still goes on."""
    lossy = ["links.loss=0.6", "links.delay_s=0.1", "lateness.horizon_s=1.5", "tracking.kind=none"]
    made = load("ut-clat", ["duration_s=60", "window_s=[10,60]", *lossy])
    data = made.model_dump(exclude_none=True)
    data["localization"] |= {"form": "published", "pair_timeout_s": 0.3}
    for robot in data["robots"]:
        robot["model"] = "unicycle_gains"
        robot["start_sigma"] |= {"gain_along": 0.05, "gain_turn": 0.05}
    result = run_trial(Scenario.model_validate(data), 1)
    assert sum(own.get("pair.shortened", 0) for own in result.counters.values()) > 0
    assert sum(own.get("pair.applied_responder", 0) for own in result.counters.values()) > 5
    assert not [reason for reason in result.rejected if "oversize" in reason]


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_a_robot_alone_is_its_own_bound_whatever_the_lag_of_its_sensors(transform: str) -> None:
    made = fleet().model_dump(exclude_none=True)
    made["robots"] = made["robots"][:1]
    made["robots"][0]["sensors"] = {
        "eye": {"kind": "range_bearing", "of": ["landmarks"], "sigma_m": 0.1, "sigma_rad": 0.02, "lag_s": 0.4}
    }
    made["landmarks"] = [{"id": "A", "position": [8.0, 6.0]}]
    made["localization"] = {"transform": transform}
    trace = run_trial(Scenario.model_validate(made), 2, with_bound=True).trace
    assert trace.bound is not None
    # The agent compensates for what came late, the bound waits for it: equal to first order. Within the lag the robot
    # moves by 0.2 m.
    np.testing.assert_allclose(trace.bound["robots"]["r1"].mean[:, :3], trace.robots["r1"].mean[:, :3], atol=0.12)
