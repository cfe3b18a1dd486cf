"""Fleets that find out where everybody is and who is who, through the network of the virtual engine."""

from __future__ import annotations

import numpy as np
import pytest

from deploy.fleet import VirtualFleet
from sim.engine import TrialResult
from sim.fault_plan import trial_faults
from sim.faulty_world import FaultyWorld
from sim.invariants import InvariantChecker
from sim.relative_figures import combine_relatives, place_errors, reduce_relatives
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized

SECONDS = 5.0
SEEDS = range(1, sized(2, 25) + 1)
FEW_SEEDS = range(1, sized(1, 25) + 1)


def fleet(*overrides: str, name: str = "correspondence", seconds: float = SECONDS) -> Scenario:
    return load(name, [f"duration_s={seconds}", f"window_s=[{min(3.0, 0.5 * seconds)}, {seconds}]", *overrides])


def figures(results: list[TrialResult]) -> dict[str, object]:
    reduced = []
    for result in results:
        found = reduce_relatives(result.trace.t_s, result.trace.relatives, result.trace.t_s >= 3.0)
        assert found is not None
        reduced.append(found)
    return combine_relatives(reduced)


def played(
    *overrides: str, check: bool = True, seeds: range = SEEDS, **how: object
) -> tuple[list[TrialResult], dict[str, object]]:
    results = []
    for seed in seeds:
        checker = InvariantChecker(seed) if check else None
        results.append(run_trial(fleet(*overrides, **how), seed, checker=checker))  # type: ignore[arg-type]
    return results, figures(results)


def shown(found: dict[str, object]) -> str:
    return f"seeds {list(SEEDS)}: " + str({key: value for key, value in found.items() if key != "identified_share"})


def test_leaders_find_out_where_everybody_is() -> None:
    results, found = played()
    assert found["identified_share"][-1][1] >= 0.85, shown(found)  # type: ignore[index]
    assert found["position_error_median_m"] < 0.25, shown(found)  # type: ignore[operator]
    assert found["anees_median"] <= 1.3, shown(found)  # type: ignore[operator]
    assert found["lag_median_s"] == 0.0
    for result in results:
        assert sorted(result.trace.relatives) == [
            (one, other) for one in ("l1", "l2") for other in ("l1", "l2", "p1", "p2", "p3") if one != other
        ]
        counters = result.counters["l1"]
        assert counters["round.closed"] >= SECONDS - 1 and counters["hypotheses.used"] > 4 * (SECONDS - 2)
        assert not counters.get("motion.guessed", 0) > 10
        for name in ("update.failed", "relative.late", "hypotheses.unsendable", "motion.known"):
            assert not counters.get(name), name


def test_names_help() -> None:
    scenario = fleet()
    robots = []
    for robot in scenario.robots:
        sensors = {
            name: sensor.model_copy(update={"anonymous": False, "clutter": 0.0})
            for name, sensor in robot.sensors.items()
        }
        robots.append(robot.model_copy(update={"sensors": sensors}))
    part = scenario.correspondence.model_copy(update={"kind": "known"})
    scenario = scenario.model_copy(update={"robots": robots, "correspondence": part})
    found = figures([run_trial(scenario, seed) for seed in FEW_SEEDS])
    assert found["identified_share"][-1][1] >= 0.9, shown(found)  # type: ignore[index]


def test_lost_and_late_messages_cost_something_and_break_nothing() -> None:
    faults = ("links.loss=0.3", "links.delay_s=0.03", "links.delay_tail_s=0.05", "links.duplicate=0.2")
    results, found = played(*faults, seeds=FEW_SEEDS)
    assert found["identified_share"][-1][1] >= 0.6, shown(found)  # type: ignore[index]
    assert found["anees_median"] <= 1.5, shown(found)  # type: ignore[operator]
    assert 0.0 < found["lag_median_s"] < 0.35, shown(found)  # type: ignore[operator]
    guessed = [result.counters["l1"]["motion.guessed"] for result in results]
    assert min(guessed) > 40, guessed


def test_without_each_other_leaders_still_find_the_pods() -> None:
    """Messages between leaders are lost: the pods still tell how they move; the other leader is not claimed."""
    cut = 'faults=[{kind="partition", sources=["l1", "l2"], destinations=["l1", "l2"], at_s=0.0}]'
    results, _ = played(cut, seeds=FEW_SEEDS, seconds=4.0)
    for result in results:
        assert not result.counters["l1"].get("hypotheses.used")
        assert sorted(result.trace.relatives) == [(one, pod) for one in ("l1", "l2") for pod in ("p1", "p2", "p3")]


def test_who_hears_nobody_claims_nothing() -> None:
    result = run_trial(fleet("links.loss=1.0", seconds=2.0), 1)
    assert result.trace.relatives == {} and result.counters["l1"]["motion.guessed"] >= 100


@pytest.mark.parametrize("keep_state", [False, True])
def test_a_leader_that_begins_again_finds_out_again(keep_state: bool) -> None:
    keeps = "kept" if keep_state else "lost"
    crash = f'faults=[{{kind="crash", robot="l1", at_s=2.0, for_s=1.0, state="{keeps}"}}]'
    seconds = 8.0
    result = run_trial(fleet(crash, seconds=seconds), 3, checker=InvariantChecker(3))
    t_s = result.trace.t_s
    for (leader, peer), trace in result.trace.relatives.items():
        errors = place_errors(trace)
        if leader == "l1":
            assert np.isnan(errors[(t_s > 2.05) & (t_s < 3.0)]).all(), "who is down believes nothing"
        assert np.isfinite(errors[t_s >= 6.0]).all(), (leader, peer)
    found = figures([result])
    assert found["identified_share"][-1][1] >= 0.75, shown(found)  # type: ignore[index]


def test_a_pod_that_falls_silent_is_lost_slowly() -> None:
    robots = VirtualFleet(fleet(seconds=8.0), 2, False)
    robots.run_until(4.0)
    before = robots.status("l1")["relatives"]["p1"]["sigma_m"]
    robots.partition(["p1"], ["l1", "l2", "p2", "p3"])
    robots.run_until(6.5)
    assert robots.status("l1")["relatives"]["p1"]["sigma_m"] > before
    robots.run_until(8.0)
    status = robots.status("l1")
    assert "p1" not in status["relatives"] and "p1 not heard" in status["form_reason"]
    assert {"l2", "p2", "p3"} <= status["relatives"].keys()


def test_mirrored_pods_are_taken_for_each_other_at_most() -> None:
    """Nothing tells which one is which: each of them is taken to be where one of both is."""
    result = run_trial(fleet(name="correspondence-symmetric", seconds=5.0), 1)
    late, seen = result.trace.t_s >= 3.0, result.trace.relatives
    for leader in ("l1", "l2"):
        places = [seen[leader, pod].truth[late, :3] for pod in ("p1", "p2")]
        for pod in ("p1", "p2"):
            away = [np.linalg.norm(seen[leader, pod].mean[late, :3] - place, axis=1) for place in places]
            assert np.median(np.min(away, axis=0)) < 0.5, (leader, pod)


def test_equal_seeds_give_equal_runs() -> None:
    one, other = (run_trial(fleet("links.loss=0.2", seconds=3.0), 5) for _ in range(2))
    for key, trace in one.trace.relatives.items():
        assert np.array_equal(trace.mean, other.trace.relatives[key].mean, equal_nan=True)
        assert np.array_equal(trace.cov, other.trace.relatives[key].cov, equal_nan=True)


def test_a_camera_that_loses_half_loses_each_bearing_by_itself() -> None:
    lossy = 'faults=[{kind="sensor_dropout", robot="l1", sensor="camera", share=0.5, at_s=0.0, for_s=2.0}]'
    scenario = fleet(lossy, seconds=2.0)
    world = FaultyWorld(open_world(scenario, 1), 1, {robot.id: None for robot in scenario.robots})
    for name, fault in trial_faults(scenario, 1).items():
        world.add(name, fault)
    counts = []
    for k in range(1, world.steps + 1):
        counts.append(sum(item.robot == "l1" and item.sensor == "camera" for item in world.outputs(k)))
    seen = np.array(counts)[1::2]
    assert 1.5 < seen.mean() < 3.3 and (seen == 0).mean() < 0.3, seen
