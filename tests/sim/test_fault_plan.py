"""Plans of faults: drawn from the seed alone, all over before the quiet end, worse with the intensity."""

from __future__ import annotations

from collections import Counter

import pytest

from agent.config_file import ConfigError
from agent.fault_parts import FAULT_KINDS, AnyFaultPart, check_faults, made, named
from sim.fault_plan import STABLE_S, trial_faults
from sim.scenario import Scenario
from sim.scenario_file import load

SEEDS = range(1, 31)


def plan(intensity: str, *overrides: str) -> Scenario:
    return load("fault-plan", [f"fault_plan.intensity={intensity}", *overrides])


@pytest.fixture(scope="module", params=["calm", "field", "storm"])
def drawn(request: pytest.FixtureRequest) -> list[dict[str, AnyFaultPart]]:
    made = plan(request.param)
    return [trial_faults(made, seed) for seed in SEEDS]


def test_equal_seeds_draw_equal_plans_and_others_do_not() -> None:
    assert trial_faults(plan("field"), 3) == trial_faults(plan("field"), 3)
    assert trial_faults(plan("field"), 3) != trial_faults(plan("field"), 4)
    assert trial_faults(plan("field"), 3) != trial_faults(plan("storm"), 3)


def test_all_is_over_before_the_quiet_end(drawn: list[dict[str, AnyFaultPart]]) -> None:
    for faults in drawn:
        for name, fault in faults.items():
            assert fault.for_s is not None and fault.at_s + fault.for_s <= 25.001, name


def test_partitions_are_stable_and_never_overlap(drawn: list[dict[str, AnyFaultPart]]) -> None:
    for faults in drawn:
        last_s = 0.0
        for fault in sorted(faults.values(), key=lambda fault: fault.at_s):
            if fault.kind in ("partition", "isolate"):
                assert fault.for_s is not None and fault.for_s >= STABLE_S
                assert fault.at_s >= last_s + STABLE_S
                last_s = fault.at_s + fault.for_s


def test_all_robots_exist(drawn: list[dict[str, AnyFaultPart]]) -> None:
    for faults in drawn:
        check_faults(faults.values(), ["r1", "r2", "r3", "r4", "r5"])


def test_intensities_differ_in_number() -> None:
    sizes = [
        sum(len(trial_faults(plan(intensity), seed)) for seed in SEEDS) for intensity in ("calm", "field", "storm")
    ]
    assert sizes[0] * 1.5 < sizes[1] and sizes[1] * 1.5 < sizes[2]


def test_a_storm_draws_nearly_every_kind() -> None:
    kinds = Counter(fault.kind for seed in SEEDS for fault in trial_faults(plan("storm"), seed).values())
    # Biases, outliers and clock steps are not recovered from by themselves: stories state them.
    left_out = {"sensor_bias", "sensor_delay", "sensor_outliers", "clock_step"}
    assert set(FAULT_KINDS) - left_out == set(kinds)


def test_a_plan_without_processes_leaves_them_alone() -> None:
    made = plan("storm", "fault_plan.processes=false")
    kinds = {fault.kind for seed in SEEDS for fault in trial_faults(made, seed).values()}
    assert not kinds & {"crash", "restart", "pause"} and kinds


def test_stated_faults_come_besides() -> None:
    stated = plan("calm", 'faults=[{kind = "isolate", robot = "r2", at_s = 1.0, for_s = 2.0}]')
    assert "isolate-1" in trial_faults(stated, 1)


def test_a_run_too_short_for_faults_has_none() -> None:
    assert trial_faults(plan("storm", "duration_s=5.5", "window_s=[0, 5]"), 1) == {}


def test_names_are_those_stated_or_kind_and_number() -> None:
    faults = [made(kind="clog", for_s=2.0), made(kind="loss", share=0.1, id="rain")]
    assert list(named(faults)) == ["clog-1", "rain"]
    with pytest.raises(ConfigError, match="rain"):
        named([*faults, faults[1]])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"kind": "los", "share": 0.1}, "kind"),
        ({"kind": "loss", "share": 1.1}, "share"),
        ({"kind": "clog"}, "for_s"),
        ({"kind": "pause", "robot": "r1"}, "for_s"),
        ({"kind": "crash", "robot": "R1"}, "robot"),
        ({"kind": "loss", "share": 0.1, "at_s": -1.0}, "at_s"),
    ],
)
def test_what_is_no_fault_is_refused(table: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        made(**table)
