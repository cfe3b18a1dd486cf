"""Who can hear whom: from distances, with hysteresis, and nothing else of the truth gets out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.reach import Reach
from sim.world import Output

Array = NDArray[np.float64]


class Line:
    """A world of three robots on a line; r2 moves: its place at each instant is given."""

    robots = ("r1", "r2", "r3")
    targets: tuple[str, ...] = ()
    landmarks: dict[str, tuple[float, float]] = {}
    step_ns = 1_000_000_000

    def __init__(self, places: list[float]) -> None:
        self._places = places
        self.steps = len(places) - 1

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        return self.truth(entity, 0), np.eye(3)

    def place(self, entity: str, k: int) -> Array:
        return self.truth(entity, k)

    def truth(self, entity: str, k: int) -> Array:
        return np.array([{"r1": 0.0, "r2": self._places[k], "r3": 100.0}[entity], 0.0, 0.0])

    def outputs(self, k: int) -> list[Output]:
        return []


def test_pairs_within_range_hear_each_other_and_nobody_hears_himself() -> None:
    world = Line([10.0, 10.1, 95.0])
    reach = Reach(world, range_m=10.0, hysteresis_m=0.0)
    assert reach.at(0) == [("r1", "r2"), ("r2", "r1")]
    assert reach.at(1) == []
    assert reach.at(2) == [("r2", "r3"), ("r3", "r2")]


def test_a_link_that_exists_breaks_only_beyond_the_hysteresis() -> None:
    places = [11.0, 9.0, 11.0, 12.1, 11.0, 10.0]
    reach = Reach(Line(places), range_m=10.0, hysteresis_m=2.0)
    assert [bool(reach.at(k)) for k in range(len(places))] == [False, True, True, False, False, True]
