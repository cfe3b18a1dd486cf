"""Worlds in three dimensions: what flies, what its sensors say of it, and that estimators make of it what they can."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from agent.config_file import ConfigError
from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, compose
from agent.estimation.mounting import rotation
from agent.timeline import Phase
from sim.engine import TrialResult, VirtualEngine
from sim.metrics import components, nees, position_errors
from sim.scenario import Scenario
from sim.scenario_checks import check
from sim.scenario_file import load
from sim.world import Output, SimulatedWorld

Array = NDArray[np.float64]

DOWN = [0.1, 0.0, -0.05, 0.0, math.pi / 2, 0.0]
SIGMA = {"position_m": 0.5, "altitude_m": 0.5, "heading_rad": 0.1}
DRONE: dict[str, Any] = {
    "model": "planar_altitude",
    "start_sigma": SIGMA,
    "control": {"speed_mps": 0.5, "yaw_rate_radps": 0.1, "climb_mps": 0.05},
    "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02, "climb_mps": 0.05},
}
ROVER: dict[str, Any] = {
    "model": "unicycle",
    "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
    "control": {"speed_mps": 0.3, "yaw_rate_radps": 0.05},
    "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02},
}


def scenario(robots: list[dict[str, Any]], **change: Any) -> Scenario:
    data = {"version": 1, "name": "test", "duration_s": 60.0, "step_s": 0.5, "window_s": [0.5, 60.0]}
    made = Scenario.model_validate(data | {"robots": robots} | change)
    check(made)
    return made


def drone(name: str, x: float, y: float, z: float, heading: float, **change: Any) -> dict[str, Any]:
    return DRONE | {"id": name, "start": {"pose": [x, y, z, heading]}} | change


def rover(name: str, x: float, y: float, heading: float, **change: Any) -> dict[str, Any]:
    return ROVER | {"id": name, "start": {"pose": [x, y, heading]}} | change


def everything(world: SimulatedWorld, kind: str) -> list[Output]:
    return [item for k in range(1, world.steps + 1) for item in world.outputs(k) if item.kind == kind]


def is_chi_square(values: Array, dof: int) -> bool:
    """Whether the sum of squared normalized errors is what it should be, two-sided at 1e-4."""
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], dof * len(values))
    return bool(low <= values.sum() <= high)


# --- motion ------------------------------------------------------------------------------------------------


def test_truth_minus_odometry_has_the_covariance_odometry_states() -> None:
    squares = []
    for seed in range(8):
        world = SimulatedWorld(scenario([drone("q1", 0.0, 0.0, 10.0, 0.3)]), seed)
        for item in everything(world, "odometry"):
            k = item.t_ns // world.step_ns
            before, after = world.truth("q1", k - 1), world.truth("q1", k)
            moved = compose(before[[0, 1, 3]], item.z[[0, 1, 3]])
            along = (after[:2] - moved[:2]) @ [math.cos(before[3]), math.sin(before[3])]
            error = np.array([along, after[2] - before[2] - item.z[2], wrap(after[3] - moved[2])])
            squares.append(np.sum(error**2 / np.diagonal(item.R)[[0, 2, 3]]))
    assert is_chi_square(np.array(squares), 3)


def test_a_quadrotor_holds_its_altitude() -> None:
    held = drone("q1", 0.0, 0.0, 12.0, 0.0, model="quadrotor")
    held |= {"control": {"speed_mps": 0.5, "altitude_m": 15.0}, "noise": {"speed_mps": 0.1, "altitude_m": 0.2}}
    world = SimulatedWorld(scenario([held], duration_s=400.0), 3)
    z = np.array([world.truth("q1", k)[2] for k in range(world.steps + 1)])
    assert z[0] == 12.0
    assert is_chi_square((z[1:] - 15.0) ** 2 / 0.04, 1)
    assert abs(np.corrcoef(z[1:-1], z[2:])[0, 1]) < 0.15, "the past tells nothing of an altitude"
    assert np.allclose(world.place("q1", 7), world.truth("q1", 7)[:3])


@pytest.mark.parametrize("model", ["constant_velocity_3d", "damped_velocity_3d", "constant_acceleration"])
def test_targets_of_six_states_move_as_their_trackers_take_them_to(model: str) -> None:
    target = {
        "id": "t1",
        "model": model,
        "start": {"pose": [1.0, 2.0, 3.0, 0.3, -0.2, 0.1]},
        "start_sigma": {"position_m": 0.5, "altitude_m": 0.5, "velocity_mps": 0.2, "acceleration_mps2": 0.1},
        "noise": {"acceleration_mps2": 0.2, "jerk_mps3": 0.1},
    }
    made = scenario([rover("r1", 0.0, 0.0, 0.0)], targets=[target], duration_s=200.0)
    world, motion = SimulatedWorld(made, 4), made.targets[0].motion(made.step_s)
    squares = []
    for k in range(1, world.steps + 1):
        drifted = motion.drift(world.truth("t1", k - 1), np.zeros((6, 6)), made.step_s, "unscented")
        error = world.truth("t1", k) - drifted.mean
        squares.append(error @ np.linalg.solve(drifted.cov, error))
    assert is_chi_square(np.array(squares), 6)
    assert world.place("t1", 0).tolist() == [1.0, 2.0, 0.0 if model == "constant_acceleration" else 3.0]


def test_a_start_has_as_many_numbers_as_its_model() -> None:
    wrong = drone("q1", 0.0, 0.0, 10.0, 0.0) | {"start": {"pose": [0.0, 0.0, 0.0]}}
    with pytest.raises(ConfigError, match=r"q1.start.pose needs 4 numbers for 'planar_altitude'"):
        SimulatedWorld(scenario([wrong]), 1)


def test_robots_on_circles_start_at_their_altitude() -> None:
    on_circle = drone("q1", 0.0, 0.0, 0.0, 0.0) | {"start": {"circle": {"center_m": [0.0, 0.0], "radius_m": 5.0}}}
    on_circle["control"] = {"speed_mps": 0.5, "altitude_m": 9.0}
    placement = {"contact_range_m": 5.0, "reaches": "q1"}
    world = SimulatedWorld(scenario([on_circle], world={"placement": placement}), 1)
    x, y, z, _ = world.truth("q1", 0)
    assert (math.hypot(x, y), z) == (pytest.approx(5.0), 9.0)


# --- sensors -----------------------------------------------------------------------------------------------

SENSORS: dict[str, dict[str, Any]] = {
    "range": {"sigma_m": 0.1},
    "bearing": {"sigma_rad": 0.02},
    "bearing3": {"sigma_rad": 0.02},
    "range_bearing": {"sigma_m": 0.1, "sigma_rad": 0.02},
    "pixel": {"sigma_px": 3.0, "intrinsics": {"focal_px": 100.0, "size_px": [4000.0, 4000.0]}},
}
MOUNT = [0.4, -0.2, 0.3, 0.1, 0.9, 0.5]


@pytest.mark.parametrize("tilt_rad", [0.0, 0.2])
@pytest.mark.parametrize("kind", SENSORS)
def test_a_sensor_says_the_truth_plus_the_noise_it_states(kind: str, tilt_rad: float) -> None:
    """The expected reading is made here from rotation matrices, lever arm and attitude and all."""
    eye = {"kind": kind, "of": ["landmarks"], "mount": MOUNT} | SENSORS[kind]
    robot = drone("q1", 0.0, 0.0, 10.0, 0.3, sensors={"eye": eye}, tilt_rad=tilt_rad)
    landmark = np.array([9.0, 5.0, 1.5])
    made = scenario([robot], landmarks=[{"id": "L1", "position": landmark.tolist()}], duration_s=300.0)
    world, squares, tilts = SimulatedWorld(made, 5), [], []
    for item in everything(world, kind):
        x, y, z, heading = world.truth("q1", item.t_ns // world.step_ns)
        assert (item.of, item.phase, item.attitude is None) == ("landmark:L1", Phase.PRIVATE, tilt_rad == 0.0)
        tilts.append(item.attitude or (0.0, 0.0))
        body = rotation(*tilts[-1], heading)
        a, b, c = rotation(*MOUNT[3:]).T @ (body.T @ (landmark - [x, y, z]) - MOUNT[:3])
        distance, azimuth = math.sqrt(a * a + b * b + c * c), math.atan2(b, a)
        expected = {
            "range": [distance],
            "bearing": [azimuth],
            "bearing3": [azimuth, math.atan2(c, math.hypot(a, b))],
            "range_bearing": [distance, azimuth],
            "pixel": [2000.0 - 100.0 * b / a, 2000.0 - 100.0 * c / a],
        }[kind]
        error = item.z - np.array(expected)
        if "bearing" in kind:
            error[-1 if kind != "bearing3" else 0] = wrap(error[-1 if kind != "bearing3" else 0])
        squares.append(error @ np.linalg.solve(item.R, error))
    assert len(squares) > 100
    assert is_chi_square(np.array(squares), len(expected))
    if tilt_rad:
        assert is_chi_square(np.ravel(tilts) ** 2 / tilt_rad**2, 1)


def test_a_camera_sees_what_is_in_its_image_alone() -> None:
    camera = {"kind": "pixel", "of": ["landmarks"], "sigma_px": 5.0, "mount": DOWN}
    robot = drone("q1", 0.0, 0.0, 15.0, 0.0, sensors={"camera": camera}, noise={"climb_mps": 0.01})
    robot["control"] = {"speed_mps": 0.0}
    # 320 px of 500 to the side are 9.6 m on the ground, 240 px ahead 7.2 m.
    spots = {"below": [0.0, 0.0], "side": [0.1, -9.4], "far": [0.1, -9.8], "ahead": [7.1, 0.0], "off": [7.5, 0.0]}
    marks = [{"id": name, "position": [*place, 0.0]} for name, place in spots.items()]
    marks.append({"id": "above", "position": [0.0, 0.0, 20.0]})
    world = SimulatedWorld(scenario([robot], landmarks=marks, duration_s=5.0), 1)
    assert {item.of for item in everything(world, "pixel")} == {"landmark:below", "landmark:side", "landmark:ahead"}


@pytest.mark.parametrize(
    ("kind", "sensor", "sigma"),
    [
        ("position", {"sigma_m": 0.2, "sigma_z_m": 0.1}, [0.2, 0.2, 0.1]),
        ("position", {"sigma_m": 0.2}, [0.2, 0.2, 0.2]),
        ("pose", {"sigma_m": 0.2, "sigma_z_m": 0.1, "sigma_rad": 0.05}, [0.2, 0.2, 0.1, 0.05]),
        ("altitude", {"sigma_z_m": 0.3}, [0.3]),
        ("heading", {"sigma_rad": 0.3}, [0.3]),
    ],
)
def test_fixes_in_space(kind: str, sensor: dict[str, float], sigma: list[float]) -> None:
    robot = drone("q1", 0.0, 0.0, 10.0, 0.3, sensors={"fix": {"kind": kind} | sensor})
    world = SimulatedWorld(scenario([robot], duration_s=200.0), 2)
    squares = []
    for item in everything(world, kind):
        state = world.truth("q1", item.t_ns // world.step_ns)
        clean = {"position": state[:3], "pose": state, "altitude": state[2:3], "heading": state[3:]}[kind]
        error = item.z - clean
        if kind in ("pose", "heading"):
            error[-1] = wrap(error[-1])
        squares.append(error @ np.linalg.solve(item.R, error))
        assert np.allclose(np.sqrt(np.diagonal(item.R)), sigma)
    assert is_chi_square(np.array(squares), len(sigma))


def test_rovers_and_drones_range_each_other_in_space() -> None:
    sensor = {"range": {"of": ["peers"], "sigma_m": 1e-4}}
    robots = [rover("a", 0.0, 0.0, 0.0, sensors=sensor), drone("b", 3.0, 4.0, 12.0, 0.0, sensors=sensor)]
    world = SimulatedWorld(scenario(robots, duration_s=5.0), 1)
    for item in everything(world, "range"):
        k = item.t_ns // world.step_ns
        assert item.z[0] == pytest.approx(float(np.linalg.norm(world.place("a", k) - world.place("b", k))), abs=1e-3)


def test_a_range_is_too_long_by_its_bias_and_calibration_takes_it_off() -> None:
    sensor = {"of": ["peers", "landmarks"], "sigma_m": 0.05, "bias_m": 0.3, "bias_of": {"landmark:L1": -0.2}}
    known = {"bias_m": 0.3, "bias_of": {"landmark:L1": -0.2}}
    robots = [
        rover("a", 0.0, 0.0, 0.0, sensors={"range": sensor | {"calibration": known}}),
        rover("b", 6.0, 0.0, 0.0, sensors={"range": sensor}),
    ]
    marks = [{"id": "L1", "position": [3.0, 20.0]}, {"id": "L2", "position": [3.0, -20.0]}]
    made = scenario(robots, landmarks=marks, duration_s=100.0)
    world = SimulatedWorld(made, 1)
    marked = {"landmark:L1": (np.array([3.0, 20.0, 0.0]), -0.2), "landmark:L2": (np.array([3.0, -20.0, 0.0]), 0.3)}
    errors: dict[str, list[float]] = {}
    for item in everything(world, "range"):
        k = item.t_ns // world.step_ns
        assert item.of is not None
        place, bias = marked.get(item.of) or (world.place(item.of, k), 0.3)
        distance = float(np.linalg.norm(place - world.place(item.robot, k)))
        errors.setdefault(item.of, []).append(float(item.z[0]) - distance - bias)
    assert set(errors) == {"b", "landmark:L1", "landmark:L2"}
    for found in errors.values():
        assert is_chi_square(np.square(found) / 0.05**2, 1)


# --- estimators --------------------------------------------------------------------------------------------


def played(made: Scenario, seed: int, with_bound: bool = False) -> TrialResult:
    return VirtualEngine(made, SimulatedWorld(made, seed), seed, with_bound=with_bound).run()


def test_a_lone_drone_with_a_camera_is_its_own_bound() -> None:
    camera = {"kind": "pixel", "of": ["landmarks"], "sigma_px": 3.0, "mount": DOWN, "intrinsics": {"focal_px": 300.0}}
    robot = drone("q1", 0.0, 0.0, 10.0, 0.3, sensors={"camera": camera}, tilt_rad=0.1)
    marks = [{"id": f"L{i}", "position": [6.0 * (i % 3 - 1), 6.0 * (i // 3 - 1), 0.3 * i]} for i in range(9)]
    result = played(scenario([robot], landmarks=marks), 3, with_bound=True)
    assert result.rejected == {}
    assert result.counters["q1"]["used.landmark_pixel"] > 100
    own, bound = result.trace.robots["q1"], result.trace.bound
    assert bound is not None
    assert np.allclose(own.mean, bound["robots"]["q1"].mean, atol=1e-7)
    assert np.allclose(own.cov, bound["robots"]["q1"].cov, atol=1e-8)
    assert components(own) == ["x_m", "y_m", "z_m", "heading_rad"]
    assert position_errors(own)[20:].max() < 0.5
    assert nees(own)[10:].mean() < 2.0


def test_a_rover_is_localized_by_drones_and_they_by_it() -> None:
    """The rover has fixes; two drones above it know their altitude and where they see each other and the rover."""
    eyes = {
        "range": {"of": ["peers"], "sigma_m": 0.1},
        "eye": {"kind": "bearing3", "of": ["peers"], "sigma_rad": 0.03, "mount": DOWN, "rate_hz": 1.0},
        "altitude": {"sigma_z_m": 0.2},
    }
    robots = [
        rover("a", 0.0, 0.0, 0.0, sensors={"range": eyes["range"], "position": {"sigma_m": 0.3}}),
        drone("b", 6.0, 2.0, 12.0, 1.0, sensors=eyes, control={"speed_mps": 0.5, "yaw_rate_radps": 0.1}),
        drone("c", -5.0, 3.0, 9.0, 2.0, sensors=eyes, control={"speed_mps": 0.5, "yaw_rate_radps": -0.1}),
    ]
    result = played(scenario(robots, localization={"form": "published"}), 2, with_bound=True)
    assert result.rejected == {}
    for name in ("a", "b", "c"):
        trace = result.trace.robots[name]
        assert position_errors(trace)[30:].max() < 1.5, name
        assert nees(trace)[10:].mean() < 2.5, name
        assert result.counters[name].get("pair.indefinite", 0) == 0
    assert result.network["pair"]["completed"] > 300


def test_the_quadrotors_of_the_experiment_are_localized_from_the_one_that_knows_where_it_is() -> None:
    made = load("ut-clat-quadrotors", ["duration_s=30.0", "window_s=[10, 30]"])
    result = played(made, 1, with_bound=True)
    assert result.rejected == {}
    bound = result.trace.bound
    assert bound is not None
    for name, limit in (("q1", 0.2), ("q2", 0.35), ("q3", 0.3)):
        error = position_errors(result.trace.robots[name])[10:]
        assert np.sqrt(np.mean(error**2)) < limit, name
        assert np.sqrt(np.mean(position_errors(bound["robots"][name])[10:] ** 2)) < limit, name
        assert nees(result.trace.robots[name])[10:].mean() < 2.0, name
    assert result.nis["q2"]["target_pixel"][1] > 50
    seen = {robot for robot, of in result.measured if of == "target:t1"}
    assert seen == {"q2"}, "the printed geometry shows the target to quad 2 alone"


def test_who_hears_whom_is_a_matter_of_distance_in_space() -> None:
    robots = [rover("a", 0.0, 0.0, 0.0), drone("b", 0.0, 0.0, 12.0, 0.0)]
    made = scenario(robots, links={"range_m": 10.0}, duration_s=2.0)
    world = SimulatedWorld(made, 1)
    engine = VirtualEngine(made, world, 1)
    assert engine._reach is not None
    assert engine._reach.at(0) == []
    assert LAYOUTS["planar_altitude"].altitude == 2
