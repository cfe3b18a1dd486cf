"""A recorded world: sightings at their own stamps, odometry between steps, and nothing the recording lacks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError
from agent.timeline import Phase
from sim.recorded_world import RecordedWorld
from sim.scenario import Scenario
from sim.scenario_checks import check
from sim.summary import reduce, summarize
from sim.trial import open_world, run_trial
from sim.world import Output, order

T0 = 1_248_446_180
S = 1_000_000_000
CAMERA = {
    "kind": "range_bearing",
    "of": ["peers", "landmarks"],
    "sigma_m": 0.1,
    "sigma_m_per_m": 0.1,
    "sigma_rad": 0.05,
}


def lines(rows: list[tuple[float, ...]]) -> str:
    return "".join(
        " ".join(f"{value:.3f}" if index < 1 else repr(value) for index, value in enumerate(row)) + "\n" for row in rows
    )


def recorded(folder: Path) -> Path:
    """r1 drives east at 0.2 m/s, r2 stands at (2, 1); r3 moves but nobody measured where."""
    seconds = range(40)
    files = {
        "Barcodes": "1 5\n2 14\n3 41\n6 63\n",
        "Landmark_Groundtruth": "6 4.0 0.0 0.0001 0.0001\n",
        "Robot1_Odometry": lines([(T0 + k, 0.2, 0.0) for k in seconds]),
        "Robot1_Groundtruth": lines([(T0 + k, 0.2 * (k - 5), 0.0, 0.0) for k in seconds]),
        "Robot1_Measurement": f"{T0 + 12}.250 14 1.2 0.9\n{T0 + 12}.750 63 2.5 0.0\n{T0 + 13}.000 41 1.0 0.0\n",
        "Robot2_Odometry": lines([(T0 + k, 0.0, 0.0) for k in seconds]),
        "Robot2_Groundtruth": lines([(T0 + k, 2.0, 1.0, 0.0) for k in seconds]),
        "Robot2_Measurement": f"{T0 + 12}.500 5 1.1 -2.4\n",
        "Robot3_Odometry": lines([(T0 + k, 0.1, 0.0) for k in seconds]),
        "Robot3_Measurement": f"{T0 + 12}.500 5 1.1 -2.4\n",
    }
    for name, text in files.items():
        (folder / f"{name}.dat").write_text("# recorded by hand\n" + text)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return recorded(tmp_path)


def scenario(folder: Path, robots: tuple[str, ...] = ("r1", "r2"), **change: Any) -> Scenario:
    parts = [
        {
            "id": name,
            "start_sigma": {"position_m": 0.1, "heading_rad": 0.05},
            "odometry": {"along_m_per_sqrt_s": 0.1, "scale_along": 0.5},
            "sensors": {"camera": CAMERA},
        }
        for name in robots
    ]
    data = {
        "version": 1,
        "name": "recorded",
        "duration_s": 1000.0,
        "step_s": 1.0,
        "window_s": [0.0, 1000.0],
        "world": {"kind": "recording", "format": "utias", "path": str(folder)},
        "tracking": {"kind": "none"},
        "robots": parts,
    }
    made = Scenario.model_validate(data | change)
    check(made)
    return made


def everything(world: RecordedWorld) -> list[Output]:
    return [item for k in range(1, world.steps + 1) for item in world.outputs(k)]


def start_of(world: RecordedWorld) -> int:
    """Seconds after T0 at which the world begins, from where r1 is."""
    return round(world.truth("r1", 0)[0] / 0.2) + 5


def test_the_run_is_cut_to_what_all_robots_have_in_common(folder: Path) -> None:
    world = RecordedWorld(scenario(folder), 1)
    assert (world.robots, world.targets, world.landmarks) == (("r1", "r2"), (), {"L6": (4.0, 0.0)})
    assert 20 < world.steps < 40
    assert RecordedWorld(scenario(folder, duration_s=7.0), 1).steps == 7


def test_sightings_keep_their_stamps_and_come_once(folder: Path) -> None:
    world = RecordedWorld(scenario(folder), 1)
    start = start_of(world)
    seen = [(item.t_ns / S + start, item.robot, item.of, item.phase) for item in everything(world) if item.of]
    assert seen == [
        (12.25, "r1", "r2", Phase.PAIR),
        (12.5, "r2", "r1", Phase.PAIR),
        (12.75, "r1", "landmark:L6", Phase.PRIVATE),
    ]


def test_a_sighting_has_the_covariance_its_sensor_states(folder: Path) -> None:
    item = next(item for item in everything(RecordedWorld(scenario(folder), 1)) if item.of == "r2")
    assert (item.kind, list(item.z)) == ("range_bearing", [1.2, 0.9])
    np.testing.assert_allclose(item.R, np.diag([(0.1 + 0.1 * 1.2) ** 2, 0.05**2]))


@pytest.mark.parametrize(("kind", "z"), [("range", [1.2]), ("bearing", [0.9])])
def test_a_sensor_may_use_a_part_of_what_was_recorded(folder: Path, kind: str, z: list[float]) -> None:
    made = scenario(folder).model_dump(exclude_none=True)["robots"]
    made[0]["sensors"] = {"eye": {"kind": kind, "of": ["peers"], "sigma_m": 0.1, "sigma_rad": 0.1}}
    items = [i for i in everything(RecordedWorld(scenario(folder, robots=("r1", "r2")), 1)) if i.robot == "r1" and i.of]
    assert len(items) == 2
    data = scenario(folder).model_dump(exclude_none=True) | {"robots": made}
    items = [i for i in everything(RecordedWorld(Scenario.model_validate(data), 1)) if i.robot == "r1" and i.of]
    assert [(item.kind, list(item.z)) for item in items] == [(kind, z)]


def test_odometry_is_the_commanded_motion_with_the_calibrated_gains(folder: Path) -> None:
    world = RecordedWorld(scenario(folder), 1)
    for item in everything(world):
        if item.kind == "odometry" and item.robot == "r1":
            assert item.t_ns - (item.t0_ns or 0) == S
            np.testing.assert_allclose(item.z, [0.1, 0.0, 0.0, 0.0], atol=1e-9)
            assert item.R[0, 0] == pytest.approx(0.01)


def test_data_come_in_order(folder: Path) -> None:
    items = everything(RecordedWorld(scenario(folder), 1))
    assert items == sorted(items, key=order)


def test_a_recording_is_played_like_any_world_and_repeats(folder: Path) -> None:
    made = scenario(folder)
    one, other = (run_trial(made, 1, with_bound=True) for _ in range(2))
    # Both apply the sighting once odometry reaches over it, at the end of its step.
    end = {(t_s + start_of(RecordedWorld(made, 1)), robot, peer) for t_s, robot, peer in one.contacts}
    assert end == {(13.0, "r1", "r2"), (13.0, "r2", "r1")}
    assert one.counters["r1"]["used.landmark_range_bearing"] == 1
    for robot in ("r1", "r2"):
        np.testing.assert_array_equal(one.trace.robots[robot].mean, other.trace.robots[robot].mean)
        assert np.all(np.isfinite(one.trace.robots[robot].cov))


def test_a_robot_the_recording_lacks_is_named(folder: Path) -> None:
    with pytest.raises(ConfigError, match="no data of robot r5; there are: r1, r2, r3"):
        open_world(scenario(folder, ("r1", "r5")), 1)


def changed(made: Scenario, **change: Any) -> Scenario:
    found = Scenario.model_validate(made.model_dump(exclude_none=True) | change)
    check(found)
    return found


def test_a_command_acts_later_by_the_lag(folder: Path) -> None:
    """r1's command changes in the middle of a second; the motion does so 0.25 s after it."""
    (folder / "Robot1_Odometry.dat").write_text(f"{T0 + 1}.000 0.2 0.0\n{T0 + 15}.500 0.6 0.0\n{T0 + 39}.000 0.6 0.0\n")
    made = scenario(folder)
    robots = made.model_dump(exclude_none=True)["robots"]
    robots[0]["odometry"] |= {"scale_along": 1.0, "lag_s": 0.25}
    world = RecordedWorld(changed(made, robots=robots), 1)
    moved = {
        item.t_ns // S + start_of(world): float(item.z[0])
        for item in everything(world)
        if item.kind == "odometry" and item.robot == "r1"
    }
    assert (moved[15], moved[16], moved[17]) == pytest.approx((0.2, 0.2 + 0.4 * 0.25, 0.6))


def silent(folder: Path, **more: Any) -> Scenario:
    """r1 alone, r2 as a target."""
    made = scenario(folder, ("r1",))
    robots = made.model_dump(exclude_none=True)["robots"]
    robots[0]["sensors"]["eye"] = CAMERA | {"of": ["targets"], "form": "vector", "lag_s": 0.1} | more
    target = {
        "id": "r2",
        "recorded": True,
        "model": "damped_velocity",
        "start_sigma": {"position_m": 0.1, "velocity_mps": 0.1},
        "noise": {"acceleration_mps2": 0.1},
    }
    return changed(made, robots=robots, targets=[target], tracking={"kind": "clat"})


def test_a_robot_that_sends_nothing_is_a_target(folder: Path) -> None:
    world = RecordedWorld(silent(folder), 1)
    assert (world.robots, world.targets) == (("r1",), ("r2",))
    np.testing.assert_allclose(world.truth("r2", 3), [2.0, 1.0, 0.0, 0.0])
    mean, cov = world.start_belief("r2")
    assert (mean.shape, cov.shape) == ((4,), (4, 4))
    seen = [(item.sensor, item.of, item.phase) for item in everything(world) if item.of]
    assert seen == [("eye", "target:r2", Phase.TARGET), ("camera", "landmark:L6", Phase.PRIVATE)]
    result = run_trial(silent(folder), 1, with_bound=True)
    assert result.nis["r1"]["target_vector"][1] == 1
    assert result.trace.bound is not None
    for track in (result.trace.targets["r2"]["r1"], result.trace.bound["targets"]["r2"]):
        assert np.all(np.isfinite(track.mean))


def test_a_moving_target_has_its_velocity(folder: Path) -> None:
    made = silent(folder)
    data = made.model_dump(exclude_none=True)
    data["robots"][0]["id"], data["targets"][0]["id"] = "r2", "r1"
    world = RecordedWorld(Scenario.model_validate(data), 1)
    np.testing.assert_allclose(world.truth("r1", 4)[2:], [0.2, 0.0], atol=1e-9)


def test_a_sensor_reaches_so_far_and_no_further(folder: Path) -> None:
    far = [item.of for item in everything(RecordedWorld(silent(folder, max_range_m=1.1), 1)) if item.of]
    near = [item.of for item in everything(RecordedWorld(silent(folder, max_range_m=1.3), 1)) if item.of]
    assert "target:r2" not in far
    assert "target:r2" in near


def test_without_truth_a_recording_plays_from_a_start_that_is_said(folder: Path) -> None:
    robots = scenario(folder, ("r1", "r3")).model_dump(exclude_none=True)["robots"]
    with pytest.raises(ConfigError, match=r"say where it starts, --set 'robots\.r3\.start\.pose="):
        RecordedWorld(scenario(folder, ("r1", "r3")), 1)
    robots[1]["start"] = {"pose": [1.0, 2.0, 0.5]}
    made = changed(scenario(folder, ("r1", "r3")), robots=robots)
    world = RecordedWorld(made, 1)
    assert list(world.start_belief("r3")[0]) == [1.0, 2.0, 0.5]
    assert np.isnan(world.truth("r3", 0)).all()
    result = run_trial(made, 1, with_bound=True)
    summary = summarize(made, "virtual", 1, [reduce(made, result)], simulated_s=30.0, timing={})
    assert summary["lost"] == 0
    assert summary["robots"]["r3"]["position_rmse_m"] is None
    assert summary["robots"]["r1"]["position_rmse_m"] is not None
    assert summary["robots"]["r1"]["nis"]["pair_range_bearing"] > 0.0
    json.dumps(summary, allow_nan=False)
    robots[1]["sensors"]["position"] = {"sigma_m": 1.0}
    with pytest.raises(ConfigError, match="no ground truth of robot r3 to make fixes of"):
        RecordedWorld(changed(made, robots=robots), 1)


def test_gains_of_the_odometry_have_no_truth_and_no_figures(folder: Path) -> None:
    robots = scenario(folder).model_dump(exclude_none=True)["robots"]
    for robot in robots:
        robot |= {"model": "unicycle_gains"}
        robot["start_sigma"] |= {"gain_along": 0.1, "gain_turn": 0.1}
    made = changed(scenario(folder), robots=robots)
    mean, cov = RecordedWorld(made, 1).start_belief("r1")
    assert list(mean[3:]) == [1.0, 1.0]
    assert cov[4, 4] == pytest.approx(0.01)
    trace = run_trial(made, 1, with_bound=True).trace
    assert trace.robots["r1"].mean.shape == trace.robots["r1"].truth.shape == (trace.t_s.size, 3)


def test_the_stated_deviation_is_that_of_the_calibrated_distance(folder: Path) -> None:
    robots = scenario(folder).model_dump(exclude_none=True)["robots"]
    robots[0]["sensors"]["camera"] |= {"calibration": {"depth": True, "bias_m": 0.2}}
    item = next(i for i in everything(RecordedWorld(changed(scenario(folder), robots=robots), 1)) if i.of == "r2")
    assert list(item.z) == [1.2, 0.9]
    assert item.R[0, 0] == pytest.approx((0.1 + 0.1 * 1.0 / np.cos(0.9)) ** 2)


def test_a_robot_that_is_not_in_the_recording_is_not_seen(folder: Path) -> None:
    (folder / "Robot3_Odometry.dat").unlink()
    seen = [item.of for item in everything(RecordedWorld(scenario(folder), 1)) if item.of]
    assert seen == ["r2", "r1", "landmark:L6"]
