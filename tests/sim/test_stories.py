"""The bundled stories of faults hold what they expect of themselves."""

from __future__ import annotations

import pytest

from agent.fault_parts import named, told
from sim.invariants import InvariantChecker
from sim.scenario_file import load
from sim.summary import reduce, summarize, unmet
from sim.trial import run_trial
from tests.sizes import sized

SEEDS = range(1, sized(1, 20) + 1)
STORIES = ("clock-step", "kill-and-return", "late-packets", "lossy-radio", "partition-and-heal", "stale-burst")


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
