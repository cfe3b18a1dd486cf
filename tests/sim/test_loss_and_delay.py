"""Lost, late, repeated and disordered messages change which information arrives, not how honestly it is used."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sim.metrics import reduce_trial
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import sized

SEEDS = range(1, sized(3, 12) + 1)
WINDOW = (100.0, sized(300.0, 400.0))
ROBOTS = ("r2", "r3", "r4")
"""Robot 1 has fixes."""

DISORDER = ("links.delay_tail_s=1", "links.duplicate=0.3")
LINKS = {
    "60 % lost": ("links.loss=0.6",),
    "30 % lost, 0.2 s late, in disorder": ("links.loss=0.3", "links.delay_s=0.2", *DISORDER),
    "2 s late, in disorder": ("links.delay_s=2", *DISORDER),
}


@dataclass(frozen=True)
class Fleet:
    rmse_m: float
    anees: dict[str, float]


def fleet(*links: str) -> Fleet:
    """Position RMSE of the robots without fixes, and ANEES of each robot, over all seeds."""
    made = load(
        "ut-clat",
        [
            f"duration_s={WINDOW[1]}",
            f"window_s=[{WINDOW[0]}, {WINDOW[1]}]",
            "lateness.horizon_s=30",
            "localization.pair_timeout_s=8",
            *links,
        ],
    )
    squares: list[float] = []
    nees: dict[str, list[float]] = {}
    for seed in SEEDS:
        for name, item in reduce_trial(run_trial(made, seed).trace, WINDOW)["robots"].items():
            nees.setdefault(name, []).append(item["nees"] / item["count"])
            if name in ROBOTS:
                squares.append(item["position"] / item["count"])
    return Fleet(float(np.sqrt(np.mean(squares))), {name: float(np.mean(found)) for name, found in nees.items()})


@pytest.fixture(scope="module")
def whole() -> Fleet:
    return fleet()


@pytest.fixture(scope="module")
def alone() -> Fleet:
    return fleet("links.loss=1")


@pytest.mark.parametrize("links", LINKS)
def test_the_fleet_hardly_notices_what_links_do(links: str, whole: Fleet, alone: Fleet) -> None:
    found = fleet(*LINKS[links])
    assert found.rmse_m <= 1.15 * whole.rmse_m < alone.rmse_m, (found, whole, alone, SEEDS)
    for robot, anees in found.anees.items():
        assert anees <= max(1.15, 1.1 * whole.anees[robot]), (robot, found, whole, SEEDS)
