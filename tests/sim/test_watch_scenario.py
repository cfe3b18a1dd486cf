"""Cameras that never move around a target that manoeuvres: what is drawn for them, what they see, whom they hear."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS
from agent.estimation.observation import RelativeModel
from sim.engine import VirtualEngine
from sim.metrics import summarize
from sim.scenario import Scenario
from sim.scenario_file import load, locate
from sim.world import Output, SimulatedWorld

RANDOM = (
    "robots.*.start={pose = [0.0, 0.0, 0.0, 0.0], spread = [40.0, 40.0, 20.0, 3.1415926], "
    "error = [0.0, 0.0, 0.0, 0.0]}"
)
SEED = 5
SPACE = LAYOUTS["planar_altitude"]
MODEL = RelativeModel("bearing3", SPACE, subject=LAYOUTS["constant_velocity_3d"])


def seen(scenario: Scenario, seed: int = SEED) -> tuple[SimulatedWorld, list[Output]]:
    world = SimulatedWorld(scenario, seed)
    return world, [item for k in range(1, world.steps + 1) for item in world.outputs(k) if item.kind == "bearing3"]


def angles(world: SimulatedWorld, items: list[Output]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Between measured and true directions (K, 2), azimuth and elevation."""
    off = []
    for item in items:
        k = item.t_ns // world.step_ns
        off.append(item.z - MODEL.h(np.concatenate([world.truth(item.robot, k), world.truth("t1", k)])))
    found = np.array(off)
    found[:, 0] = wrap(found[:, 0])
    return found


@pytest.mark.parametrize("name", ["stt-circle", "stt-square"])
def test_the_cameras_stand_where_they_are_told_and_see_the_target_at_every_step(name: str) -> None:
    world, found = seen(load(name))
    assert len(found) == 10 * 200
    assert {item.of for item in found} == {"target:t1"}
    for robot in world.robots:
        mean, _ = world.start_belief(robot)
        np.testing.assert_array_equal(mean, world.truth(robot, 0))
        np.testing.assert_array_equal(world.truth(robot, 200), mean)
    np.testing.assert_allclose(world.place("c1", 0), [-26.7479536, 5.9787907, -12.9122474], atol=1e-6)
    np.testing.assert_allclose(world.truth("t1", 200)[:3], world.truth("t1", 0)[:3], atol=1e-9)
    # R states what the errors are.
    off = angles(world, found)
    ratio = off**2 / np.array([np.diagonal(item.R) for item in found])
    np.testing.assert_allclose(ratio.mean(axis=0), 1.0, atol=0.25)


def test_places_are_drawn_anew_for_each_trial_within_the_box() -> None:
    scenario = load("stt-circle", [RANDOM])
    starts = np.array([[SimulatedWorld(scenario, s).truth(f"c{k}", 0) for k in range(1, 11)] for s in range(30)])
    assert (np.abs(starts) <= [40.0, 40.0, 20.0, math.pi]).all()
    # Evenly: the deviation of a mean of K is the half width / sqrt(3 K).
    widths = np.array([40.0, 40.0, 20.0, math.pi])
    assert (np.abs(starts.mean(axis=(0, 1))) < 4.0 * widths / math.sqrt(3.0 * 300)).all()
    np.testing.assert_allclose(starts.std(axis=(0, 1)), widths / math.sqrt(3.0), rtol=0.1)


def test_the_scenario_says_how_places_are_drawn() -> None:
    (line,) = [line for line in Path(locate("stt-circle")).read_text().splitlines() if line.startswith("# --set")]
    assert load("stt-circle", [line.removeprefix("# --set '").removesuffix("'")]) == load("stt-circle", [RANDOM])


def test_a_share_of_the_detections_is_missed_and_another_is_anywhere() -> None:
    missed = [f"robots.*.sensors.camera.{key}" for key in ("detects=0.5", "noise=isotropic", "sigma_rad=0.01")]
    world, found = seen(load("stt-circle", missed))
    # Four deviations of a binomial of 2000.
    assert len(found) == pytest.approx(1000, abs=4.0 * math.sqrt(500.0)), SEED
    assert (np.abs(angles(world, found)[:, 1]) < 0.06).all()
    world, false = seen(load("stt-circle", [*missed, "robots.*.sensors.camera.false_share=0.2"]))
    assert [(item.t_ns, item.robot) for item in false] == [(item.t_ns, item.robot) for item in found]
    wrong = [a for a, b in zip(false, found, strict=True) if (a.z != b.z).any()]
    assert len(wrong) == pytest.approx(0.2 * len(found), abs=4.0 * math.sqrt(0.16 * len(found))), SEED
    assert np.mean([abs(off) > 0.06 for off in angles(world, wrong)[:, 1]]) > 0.8


def test_without_a_chance_nothing_changes() -> None:
    """Draws of detections leave those of the noise alone."""
    _, plain = seen(load("stt-circle"))
    _, kept = seen(load("stt-circle", ["robots.*.sensors.camera.detects=0.7"]))
    clean = {(item.t_ns, item.robot): item.z for item in plain}
    assert 0 < len(kept) < len(plain)
    for item in kept:
        np.testing.assert_array_equal(item.z, clean[item.t_ns, item.robot])


def test_draws_are_named_by_seed_robot_and_instant() -> None:
    chance = ["robots.*.sensors.camera.detects=0.7", "robots.*.sensors.camera.false_share=0.1"]
    _, whole = seen(load("stt-circle", chance))
    _, short = seen(load("stt-circle", [*chance, "duration_s=5.0"]))
    told = [(item.t_ns, item.robot, item.z.tobytes(), item.R.tobytes()) for item in whole]
    assert [(item.t_ns, item.robot, item.z.tobytes(), item.R.tobytes()) for item in short] == told[: len(short)]
    _, other = seen(load("stt-circle", chance), SEED + 1)
    assert [(item.t_ns, item.robot) for item in other] != [(item.t_ns, item.robot) for item in whole]


def test_it_plays_and_each_hears_its_three_nearest() -> None:
    scenario = load("stt-square", ["duration_s=3.0", "window_s=[0.0, 3.0]"])
    result = VirtualEngine(scenario, SimulatedWorld(scenario, SEED), SEED).run()
    summary = summarize([result.trace], (0.0, 3.0), scenario.lost_above_m)
    assert result.rejected == {}
    assert result.network["delivered"] == 3 * result.network["sent"] > 0
    assert summary["fleet"]["position_rmse_m"] < 1e-3
    assert summary["fleet"]["target_velocity_rmse_mps"] > 0.0
    assert summary["targets"]["t1"]["c1"]["known_share"] >= 0.9, "from the first round after the start on"
