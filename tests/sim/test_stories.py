"""The bundled stories of faults hold what they expect of themselves."""

from __future__ import annotations

import pytest

from agent.fault_parts import named, told
from deploy.testing import FleetMaker, fleet
from sim.invariants import InvariantChecker
from sim.scenario_file import load
from sim.summary import reduce, summarize, unmet
from sim.trial import run_trial
from tests.sizes import sized

__all__ = ["fleet"]

SEEDS = range(1, sized(1, 20) + 1)
STORIES = ("clock-step", "kill-and-return", "late-packets", "liar", "lossy-radio", "partition-and-heal", "stale-burst")


@pytest.mark.parametrize("name", STORIES)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_story_ends_as_it_should(name: str, seed: int) -> None:
    scenario = load(name)
    assert scenario.faults and scenario.expect
    checker = InvariantChecker(seed, f"cofix run {name} --seed {seed}")
    result = run_trial(scenario, seed, checker=checker)
    summary = summarize(
        scenario, "virtual", seed, [reduce(scenario, result)], simulated_s=scenario.duration_s, timing={}
    )
    assert unmet(summary, scenario.expect) == [], f"cofix run {name} --seed {seed}"
    assert summary["faults"] == [told(key, fault) for key, fault in named(scenario.faults).items()]


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
