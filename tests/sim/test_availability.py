"""When measurements were there: stretches of time, and rows of pairs and of targets."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.availability import MAX_IDLE, pair_rows, sighting_rows, spells, usual_gap
from sim.store import Instants

ROBOTS = ["r1", "r2", "r3"]


def every(start: float, end: float, period: float = 1.0) -> np.ndarray:
    return np.arange(start, end + period / 2.0, period)


def test_a_pause_ends_a_spell() -> None:
    times = np.concatenate([every(3.0, 10.0), every(20.0, 21.0), [40.0]])
    assert spells(times, 1.5) == [(3.0, 10.0), (20.0, 21.0), (40.0, 40.0)]
    assert spells(times, 10.0) == [(3.0, 21.0), (40.0, 40.0)]
    assert spells(np.array([]), 1.0) == []


@given(st.lists(st.floats(0.0, 1e4), min_size=1, unique=True), st.floats(1e-3, 1e3))
def test_spells_hold_every_instant_and_lie_further_apart_than_the_gap(instants: list[float], gap_s: float) -> None:
    times = np.sort(instants)
    found = spells(times, gap_s)
    assert all(any(start <= t <= end for start, end in found) for t in times)
    assert {edge for spell in found for edge in spell} <= set(times.tolist())
    assert all(after[0] - before[1] > gap_s for before, after in pairwise(found))


def test_a_sensor_of_any_rate_counts_as_there_all_the_time() -> None:
    for period in (0.1, 1.0, 5.0):
        times = [every(0.0, 50.0, period), every(70.0, 100.0, period)]
        gap_s = usual_gap(times, 100.0)
        assert [len(spells(item, gap_s)) for item in times] == [1, 1]
        assert len(spells(np.concatenate(times), gap_s)) == 2
    assert usual_gap([], 100.0) > 0.0


def test_a_pair_is_one_row_whoever_measures() -> None:
    measured: Instants = {
        ("r1", "r2"): every(0.0, 10.0),
        ("r2", "r1"): every(5.0, 20.0),
        ("r1", "target:t1"): every(0.0, 100.0),
    }
    rows = pair_rows(measured, [(4.0, "r2", "r1"), (4.1, "r1", "r2"), (9.0, "r3", "r1")], ROBOTS, 100.0)
    assert list(rows) == [("r1", "r2"), ("r1", "r3"), ("r2", "r3")]
    assert rows["r1", "r2"].spells == [(0.0, 20.0)]
    assert rows["r1", "r2"].share(100.0) == pytest.approx(0.2)
    assert rows["r1", "r2"].used == [4.0, 4.1]
    assert (rows["r1", "r3"].spells, rows["r1", "r3"].used) == ([], [9.0])
    assert (rows["r2", "r3"].spells, rows["r2", "r3"].used) == ([], [])


def test_those_that_never_met_are_told_only_in_a_small_fleet_and_if_anybody_did() -> None:
    swarm = [f"r{k}" for k in range(MAX_IDLE)]
    assert list(pair_rows({("r1", "r2"): every(0.0, 1.0)}, [], swarm, 10.0)) == [("r1", "r2")]
    assert pair_rows({("r1", "target:t1"): every(0.0, 1.0)}, [], ROBOTS, 10.0) == {}


def test_targets_have_a_row_per_robot_and_landmarks_are_taken_together() -> None:
    measured: Instants = {
        ("r1", "landmark:L1"): every(0.0, 10.0),
        ("r1", "landmark:L2"): every(11.0, 20.0),
        ("r1", "r2"): every(0.0, 50.0),
        ("r2", "target:t1"): every(30.0, 60.0),
    }
    rows = sighting_rows(measured, ROBOTS, ["t1"], 100.0)
    assert rows["r1", "landmarks"].spells == [(0.0, 20.0)]
    assert rows["r2", "t1"].spells == [(30.0, 60.0)]
    assert rows["r3", "t1"].spells == []
    assert sighting_rows({("r1", "r2"): every(0.0, 1.0)}, ROBOTS, ["t1"], 100.0) == {}
