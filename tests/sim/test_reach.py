"""Who can hear whom: from distances, with hysteresis, and nothing else of the truth gets out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from network.links import LinkSettings, RangeTable, decode_table, encode_table
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
    reach = Reach(world, LinkSettings(1, range_m=10.0))
    assert reach.at(0) == [("r1", "r2"), ("r2", "r1")]
    assert reach.at(1) == []
    assert reach.at(2) == [("r2", "r3"), ("r3", "r2")]


def test_a_link_that_exists_breaks_only_beyond_the_hysteresis() -> None:
    places = [11.0, 9.0, 11.0, 12.1, 11.0, 10.0]
    reach = Reach(Line(places), LinkSettings(1, range_m=10.0, hysteresis_m=2.0))
    assert [bool(reach.at(k)) for k in range(len(places))] == [False, True, True, False, False, True]


def heard_by(pairs: list[tuple[str, str]], receiver: str) -> set[str]:
    return {source for source, destination in pairs if destination == receiver}


class Scattered(Line):
    """Ten robots that stand anywhere."""

    robots = tuple(f"c{k}" for k in range(10))

    def __init__(self, seed: int) -> None:
        super().__init__([0.0] * 50)
        self.spots = np.random.default_rng(seed).uniform(-40.0, 40.0, (10, 3))

    def truth(self, entity: str, k: int) -> Array:
        return np.asarray(self.spots[self.robots.index(entity)])


def test_only_the_nearest_are_heard_and_hearing_is_one_way() -> None:
    world = Scattered(3)
    pairs = Reach(world, LinkSettings(1, nearest=3)).at(0)
    for index, robot in enumerate(world.robots):
        gaps = np.linalg.norm(world.spots - world.spots[index], axis=1)
        nearest = [world.robots[other] for other in np.argsort(gaps)[1:4]]
        assert heard_by(pairs, robot) == set(nearest), robot
    assert any((destination, source) not in pairs for source, destination in pairs)


def test_the_nearest_follow_the_places_and_lie_within_the_range() -> None:
    reach = Reach(Line([10.0, 60.0, 95.0]), LinkSettings(1, nearest=1))
    assert [heard_by(reach.at(k), "r2") for k in range(3)] == [{"r1"}, {"r3"}, {"r3"}]
    assert heard_by(Reach(Line([10.0]), LinkSettings(1, nearest=1)).at(0), "r3") == {"r2"}
    near = Reach(Line([10.0]), LinkSettings(1, range_m=20.0, nearest=2)).at(0)
    assert near == [("r1", "r2"), ("r2", "r1")]


def test_others_are_drawn_at_every_step_from_the_seed() -> None:
    world, settings = Scattered(3), LinkSettings(7, rewire=3)
    reach, again = Reach(world, settings), Reach(world, settings)
    found = [reach.at(k) for k in range(50)]
    for k, pairs in enumerate(found):
        assert {len(heard_by(pairs, robot)) for robot in world.robots} == {3}, k
    # Instant k is drawn on its own, whatever was asked before.
    assert sorted(again.at(49)) == sorted(found[49])
    assert len({tuple(pairs) for pairs in found}) == 50
    assert Reach(world, LinkSettings(8, rewire=3)).at(0) != found[0]
    # Everybody hears everybody in the end, about equally often: binomial(50, 1 / 3) within five deviations.
    counts = np.zeros((10, 10))
    for pairs in found:
        for source, destination in pairs:
            counts[world.robots.index(source), world.robots.index(destination)] += 1
    others = counts[~np.eye(10, dtype=bool)]
    assert abs(others - 50.0 / 3.0).max() < 5.0 * np.sqrt(50.0 * 2.0 / 9.0)


def test_processes_are_told_of_the_same_directed_graph() -> None:
    """Over the table that the world sends to receivers."""
    world, table = Scattered(5), RangeTable()
    pairs = Reach(world, LinkSettings(1, nearest=3)).at(0)
    table.publish(*decode_table(encode_table(0, world.robots, pairs)))
    told = {(a, b) for a in world.robots for b in world.robots if table.state(a, b, 1)}
    assert told == set(pairs)
