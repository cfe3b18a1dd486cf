"""Robots that fly arcs exactly, and odometry that errs as it says."""

from __future__ import annotations

import numpy as np
import pytest

from agent.config_file import ConfigError
from sim.arcs import ArcPart, KidnapPart, flown
from sim.scenario_file import load
from sim.world import SimulatedWorld

STEP_S, STEPS = 0.05, 400
START = np.array([1.0, 2.0, 3.0, 0.5])


def way(arc: ArcPart, seed: int = 1, name: str = "p1") -> tuple[np.ndarray, np.ndarray]:
    return flown(arc, START, STEP_S, STEPS, seed, name)


def test_it_flies_a_circle_up_and_down() -> None:
    track, moves = way(ArcPart(speed_mps=[0.5, 0.5], turn_radps=[0.2, 0.2], side=1.0, climb_mps=[0.3, 0.3]))
    assert np.array_equal(track[0], START)
    assert moves[:, 0] == pytest.approx(0.5 * STEP_S) and not moves[:, 1].any()
    # A circle of radius v / w about a point to its left.
    center = START[:2] + 2.5 * np.array([-np.sin(0.5), np.cos(0.5)])
    assert np.linalg.norm(track[:, :2] - center, axis=1) == pytest.approx(2.5, abs=0.02)
    assert np.abs(np.diff(track[:, 2])).max() <= 0.3 * STEP_S + 1e-12
    assert track[:, 2].max() - track[:, 2].min() == pytest.approx(2.0 * 0.3 / 0.5, rel=0.05)


def test_motions_lead_from_state_to_state() -> None:
    track, moves = way(ArcPart())
    cos, sin = np.cos(track[:-1, 3]), np.sin(track[:-1, 3])
    assert track[1:, 0] - track[:-1, 0] == pytest.approx(cos * moves[:, 0] - sin * moves[:, 1])
    assert track[1:, 1] - track[:-1, 1] == pytest.approx(sin * moves[:, 0] + cos * moves[:, 1])


def test_draws_lie_within_their_bounds_and_follow_from_seed_and_name() -> None:
    speeds, turns, sides = [], [], set()
    for seed in range(60):
        _, moves = way(ArcPart(), seed)
        speeds.append(moves[0, 0] / STEP_S)
        turns.append(abs(moves[0, 3]) / STEP_S)
        sides.add(np.sign(moves[0, 3]))
    assert 0.4 <= min(speeds) < 0.5 and 0.7 < max(speeds) <= 0.8
    assert 0.1 <= min(turns) < 0.15 and 0.2 < max(turns) <= 0.25
    assert sides == {-1.0, 1.0}
    assert np.array_equal(way(ArcPart())[0], way(ArcPart())[0])
    assert not np.array_equal(way(ArcPart())[0], way(ArcPart(), name="p2")[0])
    assert np.array_equal(way(ArcPart())[0], way(ArcPart(as_of="p1"), name="p2")[0])


def test_it_goes_straight_until_it_turns() -> None:
    track, _ = way(ArcPart(turns_from_s=12.0))
    assert track[: round(12.0 / STEP_S) + 1, 3] == pytest.approx(START[3])
    assert abs(track[-1, 3] - START[3]) > 0.5


def test_a_kidnapping_is_no_motion() -> None:
    kidnapped, moves = way(ArcPart(kidnapped=KidnapPart(at_s=5.0)))
    free, same = way(ArcPart())
    assert np.array_equal(moves, same)
    k = round(5.0 / STEP_S)
    assert np.array_equal(kidnapped[: k + 1], free[: k + 1])
    assert np.linalg.norm(kidnapped[k + 1, :2] - free[k + 1, :2]) == pytest.approx(4.0)
    turned = np.angle(np.exp(1j * (kidnapped[-1, 3] - free[-1, 3])))
    assert turned == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("arc", "words"),
    [
        (ArcPart(speed_mps=[0.8, 0.4]), "lower one first"),
        (ArcPart(climb_mps=[-0.1, 0.4]), "not below 0"),
        (ArcPart(side=0.5), "1 is to the left"),
    ],
)
def test_what_is_no_arc_is_refused(arc: ArcPart, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        arc.check()


def test_odometry_errs_as_it_says_and_sensors_do_not_say_whom_they_see() -> None:
    scenario = load("correspondence", ["duration_s=10", "window_s=[5, 10]"])
    world = SimulatedWorld(scenario, 3)
    errors, bearings, order = [], [], []
    for k in range(1, world.steps + 1):
        seen = []
        for item in world.outputs(k):
            if item.kind == "odometry":
                true = world._flown[item.robot][k - 1]
                errors.append((item.z - true) / np.sqrt(np.diagonal(item.R)))
                assert np.diagonal(item.R) / 0.05**2 == pytest.approx([0.05, 0.05, 0.05, 0.01], rel=1e-6)
            elif item.kind == "bearing3":
                bearings.append(item.of)
                if item.robot == "l1":
                    seen.append(item.z[0])
        order.append(seen == sorted(seen))
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=0.1)
    assert set(bearings) == {None} and all(order)
    # Four others, seen with 0.95, and one that is not there, per leader and scan.
    assert len(bearings) / 200.0 == pytest.approx(4.8, abs=0.3)


def test_robots_start_apart_anywhere() -> None:
    scenario = load("correspondence")
    least = []
    for seed in range(20):
        world = SimulatedWorld(scenario.model_copy(update={"duration_s": 0.1}), seed)
        places = np.array([world.place(robot, 0)[:2] for robot in world.robots])
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)
        least.append(gaps[np.triu_indices(5, 1)].min())
        assert (places >= 0.0).all() and (places <= 10.0).all()
    assert 2.0 <= min(least) < 3.0
    crowded = load("correspondence", ["world.placement.apart_m=30", "world.placement.max_draws=10"])
    with pytest.raises(ConfigError, match="apart_m"):
        SimulatedWorld(crowded, 1)
