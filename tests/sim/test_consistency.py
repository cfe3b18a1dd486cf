"""Honest estimates: the errors of the fleet are as large as it says they are.

NEES per degree of freedom, ideal 1. The errors of one trial are correlated over its window, so a trial counts as
one independent sample only: the mean over N trials of three degrees of freedom is then chi-square with 3 N degrees
of freedom over 3 N, and the band is its two-sided 1 % interval. Seeds are fixed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from scipy import stats

from sim.metrics import reduce_trial
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import sized

SEEDS = range(1, sized(6, 24) + 1)
FEW_SEEDS = range(1, sized(4, 8) + 1)
WINDOW = (100.0, 300.0)
NEVER_ABOVE = 1.7


def anees(overrides: list[str], seeds: Iterable[int], tracks_last: bool = True) -> dict[str, dict[int, float]]:
    """Mean NEES over the window by robot and seed; tracks of the target are under `t1 of <robot>`."""
    made = load("ut-clat", [f"duration_s={WINDOW[1]}", f"window_s=[{WINDOW[0]}, {WINDOW[1]}]", *overrides])
    found: dict[str, dict[int, float]] = {}
    for seed in seeds:
        reduced = reduce_trial(run_trial(made, seed).trace, WINDOW)
        items = dict(reduced["robots"])
        items.update({f"t1 of {robot}": item for robot, item in reduced["targets"]["t1"].items()})
        for name, item in items.items():
            assert item["count"] == 201 or (name not in reduced["robots"] and not tracks_last), (name, seed)
            found.setdefault(name, {})[seed] = item["nees"] / item["count"]
    return found


def report(name: str, values: dict[int, float]) -> str:
    return (
        f"{name}: ANEES {np.mean(list(values.values())):.2f}; by seed { ({s: round(v, 2) for s, v in values.items()}) }"
    )


@pytest.fixture(scope="module")
def honest() -> dict[str, dict[int, float]]:
    return anees([], SEEDS)


@pytest.mark.parametrize("robot", ["r1", "r2", "r3", "r4"])
def test_the_default_form_is_neither_overconfident_nor_timid(robot: str, honest: dict[str, dict[int, float]]) -> None:
    dof = 3 * len(SEEDS)
    low, high = stats.chi2.ppf([0.005, 0.995], dof) / dof
    assert low <= np.mean(list(honest[robot].values())) <= min(high, NEVER_ABOVE), report(robot, honest[robot])


@pytest.mark.parametrize("robot", ["r1", "r2", "r3", "r4"])
def test_the_target_is_not_claimed_to_be_known_better_than_it_is(
    robot: str, honest: dict[str, dict[int, float]]
) -> None:
    """Beliefs of the target are fused by intersection, which is timid by design: only the upper end is a promise."""
    name = f"t1 of {robot}"
    assert np.mean(list(honest[name].values())) <= NEVER_ABOVE, report(name, honest[name])


def test_without_correlations_the_fleet_fools_itself() -> None:
    """The naive baseline: robots that treat each other as independent grow far too sure."""
    # Tracks of robots that are far too sure contradict what they see, and end.
    naive = anees(["localization.form=safe", "localization.correlation=ignored"], FEW_SEEDS, tracks_last=False)
    for robot in ("r1", "r2", "r3", "r4"):
        assert np.mean(list(naive[robot].values())) > 5.0, report(robot, naive[robot])
