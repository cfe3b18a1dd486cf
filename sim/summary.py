"""`summary.json`: the figures of a run, schema 1."""

from __future__ import annotations

from collections import Counter
from typing import Any

from agent.fault_parts import named as stated
from agent.fault_words import told
from sim.engine import TrialResult
from sim.fault_plan import trial_faults
from sim.metrics import combine, reduce_trial
from sim.motion_figures import over_trials
from sim.scenario import BoundPart, Scenario

SCHEMA = 1
NOT_COMPARED = "timing"
"""The key left out when two summaries are compared for equality."""


def reduce(scenario: Scenario, result: TrialResult) -> dict[str, Any]:
    """The small part of a trial that a summary needs; what a worker process sends back."""
    return {
        "figures": reduce_trial(result.trace, (scenario.window_s[0], scenario.window_s[1]), result.measured),
        "network": result.network,
        "rejected": result.rejected,
        "nis": result.nis,
        "repairs": _total(result, "update.not_positive_definite"),
        "quarantines": [_total(result, "health.quarantined"), _total(result, "health.readmitted")],
        "motion": result.motion,
        "step_us": result.step_us,
        "plan_us": result.plan_us,
    }


def _total(result: TrialResult, name: str) -> int:
    """A counter of all robots together."""
    return sum(own.get(name, 0) for own in result.counters.values())


def summarize(
    scenario: Scenario,
    runtime: str,
    seed: int,
    reduced: list[dict[str, Any]],
    *,
    simulated_s: float,
    timing: dict[str, float],
    exits: dict[str, int] | None = None,
) -> dict[str, Any]:
    """The whole summary, from the reduced trials in order."""
    figures = combine([item["figures"] for item in reduced], scenario.lost_above_m)
    for robot, entry in figures["robots"].items():
        entry["nis"] = _nis([item["nis"].get(robot, {}) for item in reduced])
    network: Counter[str] = Counter()
    pair: Counter[str] = Counter()
    rejected: Counter[str] = Counter()
    for item in reduced:
        network.update({key: value for key, value in item["network"].items() if key != "pair"})
        pair.update(item["network"]["pair"])
        rejected.update(item["rejected"])
    begun, ended = (sum(item["quarantines"][index] for item in reduced) for index in (0, 1))
    seconds = simulated_s * len(reduced) * len(scenario.robots)
    lost = figures.pop("lost")
    return {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "runtime": runtime,
        "seed": seed,
        "trials": len(reduced),
        "lost": lost,
        "window_s": list(scenario.window_s),
        "simulated_s": simulated_s,
        **figures,
        "motion": {**over_trials([item["motion"] for item in reduced]), "collision_m": scenario.collision_m},
        "network": {
            **{key: network[key] for key in ("sent", "delivered", "lost", "bytes")},
            "bytes_per_robot_s": network["bytes"] / seconds if seconds else 0.0,
            "pair": {key: pair[key] for key in ("started", "completed", "one_sided", "fallback", "too_old")},
        },
        "rejected": dict(sorted(rejected.items())),
        "quarantines": {"begun": begun, "ended": ended, "open": begun - ended},
        "covariance_repairs": sum(item["repairs"] for item in reduced),
        "faults": faults(scenario, seed if len(reduced) == 1 else None),
        "unsafe": scenario.unsafe.settings().named(),
        "exit": exits if exits is not None else {robot.id: 0 for robot in scenario.robots},
        "timing": timing,
    }


def _nis(trials: list[dict[str, tuple[float, int]]]) -> dict[str, float]:
    total: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for trial in trials:
        for kind, (value, number) in trial.items():
            total[kind] += value  # type: ignore[assignment]
            count[kind] += number
    return {kind: total[kind] / count[kind] for kind in sorted(count) if count[kind]}


def faults(scenario: Scenario, seed: int | None = None) -> list[str]:
    """What was injected, in words; with the seed of a trial also what was drawn for it."""
    links, named = scenario.links, []
    if links.loss:
        named.append(f"loss {links.loss:g}")
    if links.delay_s or links.delay_tail_s:
        named.append(f"delay {links.delay_s:g} s + tail {links.delay_tail_s:g} s")
    if links.duplicate:
        named.append(f"duplicate {links.duplicate:g}")
    if links.nearest is not None:
        named.append(f"only the nearest {links.nearest} are heard")
    if links.rewire is not None:
        named.append(f"{links.rewire} are heard, others at every step")
    found = stated(scenario.faults) if seed is None else trial_faults(scenario, seed)
    if scenario.fault_plan is not None and seed is None:
        named.append(f"a plan of intensity {scenario.fault_plan.intensity}, drawn for each trial")
    return named + [told(name, fault) for name, fault in found.items()]


def unmet(summary: dict[str, Any], expect: dict[str, BoundPart]) -> list[str]:
    """Conditions of `[expect]` the summary breaks, one line each; keys are dotted paths into it."""
    broken = []
    for path, bound in expect.items():
        value: Any = summary
        for key in path.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if not isinstance(value, (int, float)):
            broken.append(f"{path}: not in the summary")
        elif bound.max is not None and value > bound.max:
            broken.append(f"{path} = {value:.4g} is above {bound.max:g}")
        elif bound.min is not None and value < bound.min:
            broken.append(f"{path} = {value:.4g} is below {bound.min:g}")
    return broken
