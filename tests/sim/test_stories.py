"""The bundled stories of faults hold what they expect of themselves, and would not without what protects them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from agent.fault_parts import named
from agent.fault_words import told
from deploy.testing import FleetMaker, fleet
from sim.invariants import InvariantBreach, InvariantChecker
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.summary import reduce, summarize, unmet
from sim.trial import run_trial
from tests.sizes import sized

__all__ = ["fleet"]

SEEDS = range(1, sized(1, 20) + 1)
STORIES = ("clock-step", "kill-and-return", "late-packets", "liar", "lossy-radio", "partition-and-heal", "stale-burst")


UNPROTECTED = {
    "clock-step": ("trust_clocks", "robots.r3.anees", 120.0),
    "kill-and-return": ("ignore_gaps", "robots.r3.anees", 60.0),
    "late-packets": ("use_late_as_new", ".anees", 60.0),
    "liar": ("trust_liars", "robots.r3.anees", 60.0),
    "lossy-radio": ("accept_duplicates", "once: ", 20.0),
    "partition-and-heal": ("ignore_correlation", "fleet.anees", 90.0),
    "stale-burst": ("accept_stale", "quarantines.begun", 85.0),
}
"""The switch of `[unsafe]` that takes a story's protection away, what is told of that, and how long it takes [s]."""


def played(scenario: Scenario, seed: int) -> tuple[dict[str, Any], list[str]]:
    """A story with all invariants checked: its summary and what it breaks of what it expects."""
    result = run_trial(scenario, seed, checker=InvariantChecker(seed))
    summary = summarize(
        scenario, "virtual", seed, [reduce(scenario, result)], simulated_s=scenario.duration_s, timing={}
    )
    return summary, unmet(summary, scenario.expect)


@pytest.mark.parametrize("name", STORIES)
def test_a_story_fails_without_its_protection(name: str) -> None:
    """The story's own seed does, and most others: not every course of chance needs every protection."""
    switch, sign, until_s = UNPROTECTED[name]
    scenario = load(name, [f"unsafe.{switch}=true"])
    scenario = scenario.model_copy(update={"duration_s": until_s, "window_s": [5.0, until_s]})
    ends = {seed: broken_by(scenario, seed) for seed in SEEDS}
    failed = [seed for seed, broken in ends.items() if any(sign in line for line in broken)]
    assert 1 in failed, f"cofix run {name} --set unsafe.{switch}=true: {ends[1]}"
    assert len(failed) >= 0.75 * len(SEEDS), (name, switch, failed)


def broken_by(scenario: Scenario, seed: int) -> list[str]:
    try:
        return played(scenario, seed)[1]
    except InvariantBreach as breach:
        return [str(breach)]


@pytest.mark.parametrize("name", STORIES)
def test_a_story_ends_as_it_should(name: str) -> None:
    """With its own seed in every line, with any other in all that is not chance, and on average in everything."""
    scenario = load(name)
    assert scenario.faults and scenario.expect
    found = {seed: played(scenario, seed) for seed in SEEDS}
    assert found[1][1] == [], f"cofix run {name}"
    for seed, (summary, broken) in found.items():
        assert [line for line in broken if not chance(line)] == [], f"cofix run {name} --seed {seed}"
        assert summary["faults"] == [told(key, fault) for key, fault in named(scenario.faults).items()]
    for key, limit in scenario.expect.items():
        if chance(key):
            values = [float(value_of(summary, key)) for summary, _ in found.values()]
            assert math.sqrt(sum(value**2 for value in values) / len(values)) <= (limit.max or math.inf), (key, values)


def chance(line: str) -> bool:
    """Whether a line of `[expect]` is of errors of one robot, which any single trial may have large by chance."""
    return line.startswith("robots.") and ("_error_m" in line or "_rmse_m" in line)


def value_of(summary: dict[str, Any], key: str) -> Any:
    found: Any = summary
    for part in key.split("."):
        found = found[part]
    return found


@pytest.mark.parametrize("form", ["auto", "safe"])
def test_a_liar_is_found_within_ten_seconds_and_readmitted_within_ten(fleet: FleetMaker, form: str) -> None:
    robots = fleet("liar", f"localization.form={form}")

    def judged(robot: str) -> dict[str, dict[str, object]]:
        found: dict[str, dict[str, object]] = robots.status(robot)["health"]["peers"]
        return found

    def verdicts() -> list[object]:
        return [judged(name)["r1"]["verdict"] for name in ("r2", "r3", "r4")]

    robots.run_for(19.0)
    assert verdicts() == ["trusted"] * 3
    robots.run_for(11.0)
    assert verdicts() == ["quarantined"] * 3
    for name in ("r2", "r3", "r4"):
        assert any(line.startswith("r1 is quarantined") for line in robots.status(name)["health"]["reasons"])
        assert not any(f["verdict"] == "quarantined" for peer, f in judged(name).items() if peer != "r1")
    # The liar knows: by its own innovations, or since it is told.
    assert robots.status("r1")["health"]["reasons"]
    robots.run_for(40.0)
    assert verdicts() == ["trusted"] * 3
    assert not any(robots.status(name)["health"]["reasons"] for name in robots.robots)
