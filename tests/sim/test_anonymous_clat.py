"""Fleets that localize in the global frame by bearings that do not say of whom, through the network of the engine."""

from __future__ import annotations

import numpy as np

from sim.engine import TrialResult
from sim.invariants import InvariantChecker
from sim.metrics import summarize
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized

SECONDS = sized(12.0, 40.0)
WINDOW = (sized(8.0, 10.0), SECONDS)
SEEDS = range(1, sized(1, 10) + 1)


def fleet(*overrides: str, seconds: float = SECONDS) -> Scenario:
    """Three of the four robots: a pair costs time."""
    window = f"window_s=[{min(WINDOW[0], 0.5 * seconds)}, {seconds}]"
    scenario = load("anonymous-clat", [f"duration_s={seconds}", window, *overrides])
    return scenario.model_copy(update={"robots": scenario.robots[: sized(3, 4)]})


def figures(results: list[TrialResult]) -> dict[str, float]:
    found = summarize([result.trace for result in results], WINDOW, 8.0)
    labels = found.get("relative", {}).get("labels", {})
    fleet_wide = found["fleet"]
    return {"rmse": fleet_wide["position_rmse_m"], "anees": fleet_wide["anees"], "lost": found["lost"], **labels}


def test_anonymous_bearings_localize_nearly_as_named_ones() -> None:
    found = figures([run_trial(fleet(), seed) for seed in SEEDS])
    named = figures([run_trial(fleet("correspondence.kind=known"), seed) for seed in SEEDS])
    shown = f"seeds {list(SEEDS)}: {found}, with names {named}"
    assert found["lost"] == 0, shown
    assert found["rmse"] <= 1.3 * named["rmse"], shown
    assert found["anees"] <= max(1.15, 1.1 * named["anees"]), shown
    assert found["wrong_share"] <= 0.005 and found["used_share"] >= 0.15, shown


def test_lost_late_and_doubled_packets_break_nothing() -> None:
    faults = ("links.loss=0.3", "links.delay_s=0.03", "links.delay_tail_s=0.05", "links.duplicate=0.2")
    result = run_trial(fleet(*faults, "localization.form=safe", seconds=14.0), 3, checker=InvariantChecker(3))
    found = figures([result])
    assert found["wrong_share"] <= 0.01 and found["used"] >= 30, f"seed 3: {found}"
    assert found["anees"] <= 1.7, f"seed 3: {found}"
    counters = result.counters["r1"]
    assert counters["motion.guessed"] > 0 and not counters.get("naming.overflow")
    assert any("bearing3" in kind for kind in result.nis["r2"]), result.nis["r2"].keys()


def test_late_data_are_replayed_beside_names() -> None:
    late = 'faults=[{kind="sensor_delay", robot="r1", sensor="position", delay_s=0.3, at_s=0.0}]'
    changes = ("lateness.kind=replay", "localization.form=split_joint", late)
    one, other = (run_trial(fleet(*changes, seconds=7.0), 4, checker=check) for check in (InvariantChecker(4), None))
    assert sum(counters.get("naming.named", 0) for counters in one.counters.values()) > 0, "seed 4"
    assert one.counters["r1"]["replay.rewinds"] > 0 and one.counters["r1"]["used.position"] > 0
    assert one.trace.labels == other.trace.labels, "equal seeds give equal runs"
    for robot, trace in one.trace.robots.items():
        assert np.array_equal(trace.mean, other.trace.robots[robot].mean)


def test_a_robot_that_begins_again_finds_out_again() -> None:
    crash = 'faults=[{kind="crash", robot="r2", at_s=1.0, for_s=0.2, state="kept"}]'
    result = run_trial(fleet(crash, seconds=9.0), 5, checker=InvariantChecker(5))
    assert result.counters["r2"]["naming.named"] > 0, "seed 5: it identifies the others anew"
    assert np.isfinite(result.trace.robots["r2"].mean[-1]).all()


def test_with_names_and_without_the_world_has_the_same_bearings() -> None:
    worlds = [open_world(fleet(f"correspondence.kind={kind}", seconds=2.0), 9) for kind in ("gaussian_sum", "known")]
    for k in range(1, worlds[0].steps + 1):
        secret, told = (
            [item for item in world.outputs(k) if item.kind == "bearing3" and item.robot == "r2"] for world in worlds
        )
        assert sorted(item.z.tobytes() for item in secret) == sorted(item.z.tobytes() for item in told)
        names = {item.z.tobytes(): item.of for item in told}
        for item in secret:
            assert item.of is None and (names[item.z.tobytes()] or "") == item.truly


def test_who_is_told_names_tells_nobody_how_it_moves() -> None:
    result = run_trial(fleet("correspondence.kind=known", seconds=3.0), 1)
    assert result.trace.labels is None and result.trace.relatives == {}
    kinds = result.nis["r1"]
    assert any("bearing3" in kind for kind in kinds), kinds.keys()
