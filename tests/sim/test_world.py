"""The simulated world: what sensors say is the truth plus exactly the noise they state."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from agent.config_file import ConfigError
from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, between, velocity_step
from agent.timeline import Phase
from sim.placement import draw_phases
from sim.scenario import Scenario
from sim.scenario_checks import check
from sim.scenario_file import load
from sim.sensor_noise import control_odometry
from sim.world import Output, SimulatedWorld, order

Array = NDArray[np.float64]
RANGE = {"of": ["peers"], "sigma_m": 0.1}


def scenario(**change: Any) -> Scenario:
    """Three robots that drive slowly through each other's sight."""
    robots = [
        {
            "id": name,
            "start": {"pose": [4.0 * index, 0.0, 0.5]},
            "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
            "control": {"speed_mps": 0.3, "yaw_rate_radps": 0.05},
            "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02},
            "sensors": {"range": RANGE},
        }
        for index, name in enumerate(("r1", "r2", "r3"))
    ]
    data = {"version": 1, "name": "test", "duration_s": 100.0, "step_s": 1.0, "window_s": [0.0, 100.0]}
    made = Scenario.model_validate(data | {"robots": robots} | change)
    check(made)
    return made


def equipped(sensors: dict[str, Any], **change: Any) -> Scenario:
    """The same with other sensors on robot r1 and none on the others."""
    plain = scenario().model_dump()["robots"]
    for robot in plain:
        robot["sensors"] = sensors if robot["id"] == "r1" else {}
    return scenario(robots=plain, **change)


def everything(world: SimulatedWorld) -> list[Output]:
    return [item for k in range(1, world.steps + 1) for item in world.outputs(k)]


def is_chi_square(values: Array, dof: int, samples: int) -> bool:
    """Whether squared normalized errors, independent, have the stated mean: two-sided at 1e-4."""
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], dof * samples)
    return bool(low <= values.sum() <= high)


# --- odometry and truth -----------------------------------------------------------------------------------


def test_truth_minus_odometry_has_the_covariance_odometry_states() -> None:
    squares = []
    for seed in range(20):
        world = SimulatedWorld(scenario(), seed)
        for item in everything(world):
            if item.kind == "odometry" and item.robot == "r1":
                k = item.t_ns // world.step_ns
                moved = between(world.truth("r1", k - 1), world.truth("r1", k))
                error = moved - item.z[[0, 1, 3]]
                assert error[1] == pytest.approx(0.0, abs=1e-9), "a unicycle does not slip"
                assert item.t0_ns == item.t_ns - world.step_ns
                squares.append(error[0] ** 2 / item.R[0, 0] + error[2] ** 2 / item.R[3, 3])
    assert len(squares) == 2000
    assert is_chi_square(np.array(squares), 2, 2000)


@pytest.mark.parametrize("step_s", [0.25, 1.0, 4.0])
def test_odometry_noise_follows_from_control_noise_at_any_step(step_s: float) -> None:
    """A control held over a step carries its noise times the step into the increment."""
    robot = scenario().robots[0]
    cov = control_odometry(robot, step_s).covariance(np.zeros(4), step_s)
    np.testing.assert_allclose(np.diagonal(cov), [(0.1 * step_s) ** 2, 0.0, 0.0, (0.02 * step_s) ** 2])


def test_a_stated_odometry_replaces_it() -> None:
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[0]["odometry"] = {"along_m_per_sqrt_s": 0.7}
    assert control_odometry(scenario(robots=plain).robots[0], 1.0).along_m_per_sqrt_s == 0.7


@pytest.mark.parametrize("model", ["constant_velocity", "damped_velocity"])
def test_a_target_moves_as_its_model_says(model: str) -> None:
    target = {
        "id": "t1",
        "model": model,
        "start": {"pose": [0.0, 0.0, 1.0, -1.0]},
        "start_sigma": {"position_m": 1.0, "velocity_mps": 0.1},
        "noise": {"acceleration_mps2": 0.3},
        "damping_s": 3.0,
    }
    world = SimulatedWorld(scenario(targets=[target], step_s=0.5, duration_s=300.0), 3)
    F, Q = velocity_step(LAYOUTS[model], 0.5, 3.0)
    # The noise is an acceleration held over the step: density = variance times step.
    inverse = np.linalg.inv(Q * 0.3**2 * 0.5)
    errors = np.array([world.truth("t1", k + 1) - F @ world.truth("t1", k) for k in range(world.steps)])
    assert is_chi_square(np.einsum("ki,ij,kj->k", errors, inverse, errors), 4, world.steps)


def test_a_target_without_noise_keeps_its_course() -> None:
    target = {
        "id": "t1",
        "model": "unicycle",
        "start": {"pose": [1.0, 2.0, 0.0]},
        "start_sigma": {"position_m": 1.0, "heading_rad": 0.1},
        "control": {"speed_mps": 0.5},
    }
    world = SimulatedWorld(scenario(targets=[target]), 3)
    np.testing.assert_allclose(world.truth("t1", 100), [51.0, 2.0, 0.0])


def test_a_start_of_the_wrong_size_is_named() -> None:
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[0]["start"] = {"pose": [0.0, 0.0, 0.0, 0.0]}
    with pytest.raises(ConfigError, match=r"r1\.start\.pose needs 3 numbers"):
        SimulatedWorld(scenario(robots=plain), 1)


def test_initial_beliefs_are_drawn_from_their_covariance() -> None:
    squares = []
    for seed in range(100):
        world = SimulatedWorld(scenario(duration_s=1.0, window_s=[0.0, 1.0]), seed)
        for robot in world.robots:
            mean, cov = world.start_belief(robot)
            error = mean - world.truth(robot, 0)
            error[2] = wrap(error[2])
            squares.append(error @ np.linalg.solve(cov, error))
    assert is_chi_square(np.array(squares), 3, 300)


def test_a_start_that_is_told_with_an_error_is_off_by_it() -> None:
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[0]["start"]["error"] = [0.0, 5.0, 0.1]
    made = scenario(robots=plain)
    for seed in (1, 2):
        world = SimulatedWorld(made, seed)
        mean, cov = world.start_belief(plain[0]["id"])
        assert np.allclose(mean - world.truth(plain[0]["id"], 0), [0.0, 5.0, 0.1])
        assert np.array_equal(cov, made.robots[0].start_sigma.covariance("unicycle"))


def test_an_error_of_the_start_of_the_wrong_size_is_named() -> None:
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[0]["start"]["error"] = [0.0]
    with pytest.raises(ConfigError, match=r"r1\.start\.error has 1 numbers, not the 3 of 'unicycle'"):
        check(scenario(robots=plain))


# --- sensors ----------------------------------------------------------------------------------------------

SENSORS: dict[str, dict[str, Any]] = {
    "range": {"sigma_m": 0.2},
    "bearing": {"sigma_rad": 0.05},
    "range_bearing": {"sigma_m": 0.1, "sigma_m_per_m": 0.05, "sigma_rad": 0.05},
    "position": {"sigma_m": 0.5},
    "pose": {"sigma_m": 0.5, "sigma_rad": 0.1},
    "heading": {"sigma_rad": 0.1},
}
MOUNT = [0.4, -0.2, 2.0]


@pytest.mark.parametrize("kind", SENSORS)
def test_a_sensor_says_the_truth_plus_the_noise_it_states(kind: str) -> None:
    """The expected reading is made here from plane geometry, lever arm and all."""
    relative = "range" in kind or "bearing" in kind
    part = {"kind": kind, **SENSORS[kind], **({"of": ["landmarks"], "mount": MOUNT} if relative else {})}
    made = equipped({"eye": part}, landmarks=[{"id": "L1", "position": [7.0, 9.0]}], duration_s=400.0)
    world = SimulatedWorld(made, 5)
    squares = []
    for item in everything(world):
        if item.sensor != "eye":
            continue
        x, y, heading = world.truth("r1", item.t_ns // world.step_ns)
        if relative:
            assert (item.of, item.phase) == ("landmark:L1", Phase.PRIVATE)
            sight = 7.0 + 9.0j - (x + 1j * y) - (MOUNT[0] + 1j * MOUNT[1]) * np.exp(1j * heading)
            bearing = np.angle(sight * np.exp(-1j * (heading + MOUNT[2])))
            expected = {"range": [abs(sight)], "bearing": [bearing], "range_bearing": [abs(sight), bearing]}[kind]
        else:
            expected = {"position": [x, y], "pose": [x, y, heading], "heading": [heading]}[kind]
        error = item.z - np.array(expected)
        if kind != "range" and kind != "position":
            error[-1] = wrap(error[-1])
        if kind == "range_bearing":
            assert item.R[0, 0] == pytest.approx((0.1 + 0.05 * abs(sight)) ** 2)
        squares.append(error @ np.linalg.solve(item.R, error))
    assert len(squares) == 400
    assert is_chi_square(np.array(squares), len(error), 400)


def test_a_two_way_range_is_told_once_by_the_lower_id() -> None:
    pairs = {(item.robot, item.of) for item in everything(SimulatedWorld(scenario(), 1)) if item.kind == "range"}
    assert pairs == {("r1", "r2"), ("r1", "r3"), ("r2", "r3")}


def test_one_way_ranges_are_told_by_both() -> None:
    plain = scenario().model_dump()["robots"]
    for robot in plain:
        robot["sensors"] = {"range": RANGE | {"two_way": False}}
    items = [item for item in everything(SimulatedWorld(scenario(robots=plain), 1)) if item.kind == "range"]
    assert {(item.robot, item.of) for item in items} == {
        (a, b) for a in ("r1", "r2", "r3") for b in ("r1", "r2", "r3") if a != b
    }


def test_a_robot_that_cannot_answer_is_ranged_by_whoever_can() -> None:
    plain = scenario().model_dump()["robots"]
    plain[0]["sensors"] = {}
    pairs = {
        (item.robot, item.of) for item in everything(SimulatedWorld(scenario(robots=plain), 1)) if item.kind == "range"
    }
    assert pairs == {("r2", "r1"), ("r3", "r1"), ("r2", "r3")}


def test_nobody_is_seen_beyond_the_largest_range_and_everybody_within() -> None:
    world = SimulatedWorld(equipped({"range": {**RANGE, "max_range_m": 5.0}}, duration_s=300.0), 2)
    seen = {(item.t_ns // world.step_ns, item.of) for item in everything(world) if item.kind == "range"}
    near = set()
    for k in range(1, world.steps + 1):
        for peer in ("r2", "r3"):
            if np.linalg.norm(world.truth(peer, k)[:2] - world.truth("r1", k)[:2]) <= 5.0:
                near.add((k, peer))
    assert seen == near
    assert 0 < len(near) < 2 * world.steps


def test_noise_does_not_depend_on_who_else_is_in_sight() -> None:
    """The reading at an instant is the same whatever came before."""
    wide = SimulatedWorld(equipped({"range": RANGE}), 2)
    narrow = SimulatedWorld(equipped({"range": {**RANGE, "max_range_m": 4.0}}), 2)
    all_of_it = {(item.t_ns, item.of): item.z[0] for item in everything(wide) if item.kind == "range"}
    part = {(item.t_ns, item.of): item.z[0] for item in everything(narrow) if item.kind == "range"}
    assert 0 < len(part) < len(all_of_it)
    assert part.items() <= all_of_it.items()


def test_a_rate_thins_a_sensor() -> None:
    made = equipped({"pose": {"sigma_m": 0.5, "sigma_rad": 0.1, "rate_hz": 0.25}})
    instants = [item.t_ns // 10**9 for item in everything(SimulatedWorld(made, 1)) if item.kind == "pose"]
    assert instants == list(range(4, 101, 4))


def test_data_come_in_order_of_instant_phase_robot_and_subject() -> None:
    target = {
        "id": "t1",
        "start": {"pose": [3.0, 3.0, 0.0]},
        "start_sigma": {"position_m": 1.0, "heading_rad": 0.1},
    }
    plain = scenario().model_dump()["robots"]
    for robot in plain:
        robot["sensors"] = {
            "range": RANGE,
            "eye": {"kind": "bearing", "of": ["targets", "landmarks"], "sigma_rad": 0.1},
            "heading": {"sigma_rad": 0.1},
        }
    made = scenario(robots=plain[::-1], targets=[target], landmarks=[{"id": "L", "position": [1.0, 1.0]}])
    items = SimulatedWorld(made, 1).outputs(7)
    assert items == sorted(items, key=order)
    assert [int(item.phase) for item in items] == [0] * 3 + [1] * 6 + [2] * 3 + [3] * 3
    assert [item.robot for item in items if item.kind == "odometry"] == ["r1", "r2", "r3"]
    assert [(i.robot, i.of) for i in items if i.kind == "range"] == [("r1", "r2"), ("r1", "r3"), ("r2", "r3")]
    assert {item.t_ns for item in items} == {7_000_000_000}


def test_equal_seeds_make_equal_worlds_and_others_do_not() -> None:
    one, same, other = (SimulatedWorld(scenario(), seed) for seed in (4, 4, 5))
    for left, right in zip(everything(one), everything(same), strict=True):
        np.testing.assert_array_equal(left.z, right.z)
    np.testing.assert_array_equal(one.truth("r2", 100), same.truth("r2", 100))
    assert not np.array_equal(one.truth("r2", 100), other.truth("r2", 100))
    assert not np.array_equal(one.outputs(3)[-1].z, other.outputs(3)[-1].z)


# --- placement --------------------------------------------------------------------------------------------


def test_a_placement_lets_everybody_be_met() -> None:
    """Over a lap of undisturbed circles every robot comes within contact range of a met one."""
    made = load("ut-clat")
    turn = np.linspace(0.0, 2.0 * np.pi, 721)
    for seed in range(20):
        phases = draw_phases(made, seed)
        paths = {}
        for robot in made.robots:
            circle = robot.start.circle
            assert circle is not None
            paths[robot.id] = complex(*circle.center_m) + circle.radius_m * np.exp(1j * (phases[robot.id] + turn))
        met = {"r1"}
        for _ in paths:
            met |= {name for name, path in paths.items() if any(np.abs(path - paths[one]).min() < 10.05 for one in met)}
        assert met == set(paths), f"seed {seed}"


def test_a_placement_is_needed_only_where_starts_are_drawn() -> None:
    assert draw_phases(scenario(), 1) == {}


def test_robots_on_circles_start_along_the_tangent() -> None:
    world = SimulatedWorld(load("ut-clat"), 3)
    for robot, center in (("r1", -10 + 10j), ("r4", 10 - 10j)):
        x, y, heading = world.truth(robot, 0)
        outward = x + 1j * y - center
        assert abs(outward) == pytest.approx(8.0)
        assert wrap(np.angle(outward) + np.pi / 2 - heading) == pytest.approx(0.0, abs=1e-9)


def test_a_placement_that_cannot_be_had_is_refused_with_the_remedy() -> None:
    made = load("ut-clat", ["world.placement.contact_range_m=0.1", "world.placement.max_draws=5"])
    with pytest.raises(ConfigError, match=r"no placement in 5 draws .*contact_range_m"):
        draw_phases(made, 1)
