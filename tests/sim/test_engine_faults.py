"""A fleet in virtual time under faults of links, clocks and processes: who hears whom, and what it claims."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.fault_parts import made
from sim.engine import TrialResult
from sim.metrics import StateTrace
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import sized


def with_faults(*faults: dict[str, Any], **change: Any) -> Scenario:
    base = load("fault-plan", ["fault_plan.intensity=calm"])
    stated = [made(**fault) for fault in faults]
    return base.model_copy(update={"fault_plan": None, "faults": stated, **change})


def played(*faults: dict[str, Any], seed: int = 7, **change: Any) -> TrialResult:
    return run_trial(with_faults(*faults, **change), seed)


def nees(trace: StateTrace) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Per degree of freedom, NaN where there is no estimate."""
    error = trace.mean - trace.truth
    for index in trace.angles:
        error[:, index] = np.remainder(error[:, index] + np.pi, 2.0 * np.pi) - np.pi
    found = np.full(len(error), np.nan)
    for row in np.flatnonzero(np.isfinite(error).all(axis=1)):
        found[row] = error[row] @ np.linalg.solve(trace.cov[row], error[row]) / error.shape[1]
    return found


def contacts(result: TrialResult, a: str, b: str, span: tuple[float, float]) -> int:
    return sum({robot, peer} == {a, b} and span[0] <= t_s < span[1] for t_s, robot, peer in result.contacts)


def test_a_run_under_a_storm_repeats_bit_for_bit() -> None:
    storm = load("fault-plan", ["fault_plan.intensity=storm"])
    one, two = run_trial(storm, 11), run_trial(storm, 11)
    assert (one.contacts, one.network, one.counters, one.rejected) == (
        two.contacts,
        two.network,
        two.counters,
        two.rejected,
    )
    for robot in one.trace.robots:
        np.testing.assert_array_equal(one.trace.robots[robot].mean, two.trace.robots[robot].mean)


def test_a_partition_keeps_the_groups_apart_and_heals() -> None:
    result = played({"kind": "partition", "groups": [["r1", "r2"], ["r3", "r4", "r5"]], "at_s": 8.0, "for_s": 10.0})
    assert contacts(result, "r1", "r3", (9.0, 18.0)) == 0
    assert contacts(result, "r1", "r2", (9.0, 18.0)) > 0
    assert contacts(result, "r1", "r3", (0.0, 8.0)) > 0 and contacts(result, "r1", "r3", (19.0, 30.0)) > 0


def test_a_one_sided_partition_lets_nothing_be_answered() -> None:
    result = played({"kind": "partition", "sources": ["r1"], "destinations": ["r2"], "both_ways": False, "at_s": 5.0})
    # r2 updates from nobody it does not hear; r1 gets no answer to what r2 has not heard.
    assert contacts(result, "r1", "r2", (8.0, 30.0)) == 0


def test_an_isolated_robot_goes_on_alone() -> None:
    result = played({"kind": "isolate", "robot": "r4", "at_s": 5.0, "for_s": 15.0})
    assert all("r4" not in (robot, peer) for t_s, robot, peer in result.contacts if 6.0 < t_s < 20.0)
    assert np.isfinite(result.trace.robots["r4"].mean).all()


def test_a_crashed_robot_says_nothing_until_it_is_back() -> None:
    result = played({"kind": "crash", "robot": "r5", "at_s": 10.0, "for_s": 8.0, "state": "lost"})
    known = np.isfinite(result.trace.robots["r5"].mean).all(axis=1)
    t_s = result.trace.t_s
    assert known[t_s < 10.0].all() and not known[(t_s > 10.0) & (t_s < 18.0)].any() and known[t_s > 18.0].all()
    assert np.isfinite(result.trace.robots["r1"].mean).all()


def test_a_crash_without_end_is_for_ever() -> None:
    result = played({"kind": "crash", "robot": "r5", "at_s": 10.0})
    assert not np.isfinite(result.trace.robots["r5"].mean[result.trace.t_s > 10.0]).any()


@pytest.mark.parametrize("fault", ["crash", "restart", "pause"])
def test_who_comes_back_claims_no_more_than_it_knows(fault: str) -> None:
    """A robot that starts anew in the middle of a run does not know where it has got to, nor where it heads."""
    how = {"state": "lost"} if fault == "crash" else {}
    base = with_faults({"kind": fault, "robot": "r5", "at_s": 8.0, "for_s": 8.0, **how})
    own, others = [], []
    for seed in range(1, sized(2, 6) + 1):
        result = run_trial(base, seed)
        own.append(float(np.nanmean(nees(result.trace.robots["r5"])[result.trace.t_s > 16.0])))
        others += [float(np.nanmean(nees(result.trace.robots[name]))) for name in ("r1", "r2", "r3", "r4")]
    assert np.mean(own) < 1.5, own
    assert np.mean(others) < 1.5, others


def test_a_clock_that_is_off_shifts_every_stamp_and_nothing_else_when_clocks_are_measured() -> None:
    result = played({"kind": "clock_drift", "robot": "r2", "ppm": 100.0})
    assert contacts(result, "r1", "r2", (20.0, 30.0)) > 0
    assert np.nanmean(nees(result.trace.robots["r2"])) < 2.0


@pytest.mark.parametrize("content", ["hostile", "replayed"])
def test_a_forger_changes_nothing(content: str) -> None:
    """What a stranger sends under a robot's name is refused: the estimates are the same bit for bit."""
    forged = played({"kind": "forge", "claims": "r2", "content": content, "rate_hz": 20.0, "at_s": 2.0, "for_s": 20.0})
    clean = played()
    assert sum(forged.rejected.values()) > sum(clean.rejected.values()) + 100
    for robot in clean.trace.robots:
        np.testing.assert_array_equal(clean.trace.robots[robot].mean, forged.trace.robots[robot].mean)


def test_a_stranger_with_a_robot_s_name_costs_cooperation_and_never_honesty() -> None:
    found = played({"kind": "forge", "claims": "r2", "content": "stranger", "rate_hz": 2.0, "at_s": 2.0, "for_s": 20.0})
    for robot, trace in found.trace.robots.items():
        assert np.nanmean(nees(trace)) < 2.5, robot


def test_packets_damaged_in_their_headers_cost_a_robot_no_more_than_seconds() -> None:
    """One may look like a later life of the robot: it begins a new one then, and gives its correlations up."""
    damage = {"kind": "forge", "claims": "r2", "content": "damaged", "rate_hz": 20.0, "at_s": 2.0, "for_s": 20.0}
    forged = played(damage)
    assert sum(forged.rejected.values()) > sum(played().rejected.values()) + 100
    for peer in ("r1", "r3", "r4", "r5"):
        assert contacts(forged, "r2", peer, (24.0, 30.0)) >= 6, peer
    for robot, trace in forged.trace.robots.items():
        assert np.nanmean(nees(trace)) < 1.7, robot


def test_a_robot_is_believed_again_once_a_stranger_with_its_name_is_gone() -> None:
    """The stranger's hellos are of later lives; r2 begins a new one after them, and gives its correlations up."""
    found = played({"kind": "forge", "claims": "r2", "content": "stranger", "rate_hz": 1.7, "at_s": 8.0, "for_s": 6.0})
    for peer in ("r1", "r3", "r4", "r5"):
        assert contacts(found, "r2", peer, (4.0, 8.0)) > 0, peer
        assert contacts(found, "r2", peer, (10.5, 14.0)) == 0, peer
        assert contacts(found, "r2", peer, (24.0, 30.0)) > 0, peer
    assert found.rejected["duplicate_robot"] > 0
    for robot, trace in found.trace.robots.items():
        assert np.nanmean(nees(trace)) < 1.7, robot
