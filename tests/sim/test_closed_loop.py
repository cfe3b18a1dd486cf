"""Worlds that robots steer while they are played: truth follows commands, and odometry says so, noise and all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from agent.effects import Steer
from agent.estimation.gaussian import wrap
from agent.estimation.motion import RobotMotion, between
from agent.settings import NS
from sim.agents import odometry_table
from sim.closed_loop import MotionWriter
from sim.sensor_noise import control_odometry
from sim.trial import played_world
from sim.world import Output, SimulatedWorld
from tests.sim.steered import SHARES, scenario
from tests.sizes import sized

Array = NDArray[np.float64]
def play(world: SimulatedWorld, speed: float = 0.4, every: int = 1) -> list[Output]:
    """All outputs, with both robots told something new at every `every`-th step and 0.2 s after it."""
    found = []
    for k in range(1, world.steps + 1):
        if (k - 1) % every == 0:
            t_ns = (k - 1) * world.step_ns + NS // 5
            for robot, sign in (("r1", 1.0), ("r2", -1.0)):
                turn = sign * 0.4 * np.sin(0.3 * k)
                world.steer(robot, t_ns, Steer((speed, 0.0, 0.0), turn, t_ns + 2 * world.step_ns))
        found += world.outputs(k)
    return found


def odometry(items: list[Output], robot: str) -> list[Output]:
    return [item for item in items if item.kind == "odometry" and item.robot == robot]


def is_chi_square(total: float, dof: int) -> bool:
    """Whether a sum of squares has the stated mean: two-sided at 1e-4."""
    low, high = stats.chi2.ppf([5e-5, 1.0 - 5e-5], dof)
    return bool(low <= total <= high)


def test_truth_minus_odometry_has_the_covariance_odometry_states() -> None:
    total, count = 0.0, 0
    for seed in range(10):
        world = SimulatedWorld(scenario(SHARES | {"speed_mps": 0.02, "yaw_rate_radps": 0.01}), seed)
        for item in odometry(play(world), "r1"):
            k = item.t_ns // world.step_ns
            error = between(world.truth("r1", k - 1), world.truth("r1", k)) - item.z[[0, 1, 3]]
            assert error[1] == pytest.approx(0.0, abs=1e-9)
            total += error[0] ** 2 / item.R[0, 0] + error[2] ** 2 / item.R[3, 3]
            count += 2
    assert count == 2000
    assert is_chi_square(total, count)


@pytest.mark.parametrize("speed", [0.1, 0.4])
def test_noise_is_in_proportion_to_the_speed(speed: float) -> None:
    errors = []
    for seed in range(10):
        world = SimulatedWorld(scenario(), seed)
        for item in odometry(play(world, speed), "r2")[1:]:
            k = item.t_ns // world.step_ns
            assert np.hypot(*item.z[:2]) == pytest.approx(speed, rel=0.02), "an arc is hardly longer than its chord"
            errors.append(between(world.truth("r2", k - 1), world.truth("r2", k)) - item.z[[0, 1, 3]])
    along, _, turn = np.std(errors, axis=0)
    assert along == pytest.approx(0.05 * speed, rel=0.08)
    assert turn == pytest.approx(0.1 * speed, rel=0.08)


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_what_stands_still_has_no_noise(turn: float) -> None:
    """Turning on the spot is free of noise too (Su 2022, chapter 4)."""
    world = SimulatedWorld(scenario(), 3)
    start = world.truth("r1", 0).copy()
    for k in range(1, 11):
        world.steer("r1", (k - 1) * NS, Steer((0.0, 0.0, 0.0), turn, k * NS))
        (item,) = odometry(world.outputs(k), "r1")
        np.testing.assert_array_equal(item.R, np.zeros((4, 4)))
    np.testing.assert_allclose(world.truth("r1", 10), [*start[:2], wrap(np.array(start[2] + 10 * turn))], atol=1e-12)


def test_constant_controls_have_noise_by_their_speed_too() -> None:
    """Robot r3 is not steered: its odometry states the same, and it is what truth is off by."""
    total, count = 0.0, 0
    for seed in range(10):
        world = SimulatedWorld(scenario(), seed)
        for item in odometry(play(world), "r3"):
            k = item.t_ns // world.step_ns
            error = between(world.truth("r3", k - 1), world.truth("r3", k)) - item.z[[0, 1, 3]]
            assert item.R[0, 0] == pytest.approx((0.05 * 0.3) ** 2)
            assert item.R[3, 3] == pytest.approx((0.1 * 0.3) ** 2)
            total += error[0] ** 2 / item.R[0, 0] + error[2] ** 2 / item.R[3, 3]
            count += 2
    assert is_chi_square(total, count)


@pytest.mark.parametrize("step_s", [0.25, 1.0])
def test_the_odometry_of_an_agent_is_that_of_the_world(step_s: float) -> None:
    made = scenario(SHARES | {"speed_mps": 0.02}).model_copy(update={"step_s": step_s})
    stated = control_odometry(made.robots[0], step_s)
    told = odometry_table(made, made.robots[0])
    assert told["along_share"] == 0.05
    assert told["heading_rad_per_m"] == 0.1
    delta = np.array([0.3, 0.0, 0.0, 0.1])
    np.testing.assert_allclose(
        np.diagonal(stated.covariance(delta, step_s)),
        [(0.02 * step_s) ** 2 + (0.05 * 0.3) ** 2, 0.0, 0.0, (0.1 * 0.3) ** 2],
    )


def test_dead_reckoning_is_consistent() -> None:
    """NEES of a belief that is moved by odometry alone, spells of standing still included."""
    ratios = []
    seeds = sized(40, 200)
    for seed in range(seeds):
        world = SimulatedWorld(scenario(), seed)
        mean, cov = world.start_belief("r1")
        for item in odometry(play(world, every=4), "r1")[:40]:
            moved = RobotMotion().advance(mean, cov, item.z, item.R, 1.0, "unscented")
            mean, cov = moved.mean, moved.cov
        error = mean - world.truth("r1", 40)
        error[2] = wrap(error[2])
        ratios.append(error @ np.linalg.solve(cov, error))
    assert is_chi_square(sum(ratios), 3 * seeds)


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_a_belief_that_does_not_move_keeps_its_covariance(transform: Any) -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    cov = root @ root.T + 0.1 * np.eye(3)
    moved = RobotMotion().advance(np.array([1.0, 2.0, 0.3]), cov, np.zeros(4), np.zeros((4, 4)), 1.0, transform)
    np.testing.assert_allclose(moved.cov, cov, rtol=1e-12)
    np.testing.assert_allclose(moved.mean, [1.0, 2.0, 0.3], rtol=1e-12)


def test_equal_commands_make_equal_worlds_and_sensors_see_them() -> None:
    one, same = SimulatedWorld(scenario(), 4), SimulatedWorld(scenario(), 4)
    for left, right in zip(play(one), play(same), strict=True):
        assert (left.t_ns, left.robot, left.of) == (right.t_ns, right.robot, right.of)
        np.testing.assert_array_equal(left.z, right.z)
    np.testing.assert_array_equal(one.truth("r1", 100), same.truth("r1", 100))


def test_draws_do_not_depend_on_commands() -> None:
    """Robot r3 and all noise stay as they are, whatever the others are told."""
    fast, slow = SimulatedWorld(scenario(), 4), SimulatedWorld(scenario(), 4)
    errors = []
    for world, speed in ((fast, 0.4), (slow, 0.2)):
        items = odometry(play(world, speed), "r1")[1:]
        truths = [between(world.truth("r1", k), world.truth("r1", k + 1)) for k in range(1, world.steps)]
        off = np.array([truth[0] - item.z[0] for truth, item in zip(truths, items, strict=True)])
        errors.append(off / np.array([np.sqrt(item.R[0, 0]) for item in items]))
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-6)
    np.testing.assert_array_equal(fast.truth("r3", 100), slow.truth("r3", 100))


def test_ranges_are_of_the_places_that_were_steered_to() -> None:
    world = SimulatedWorld(scenario(), 4)
    off = []
    for item in play(world):
        if item.kind == "range":
            k = item.t_ns // world.step_ns
            assert item.of is not None
            off.append(item.z[0] - np.linalg.norm(world.place(item.robot, k) - world.place(item.of, k)))
    assert len(off) == 300
    assert np.std(off) == pytest.approx(0.1, rel=0.15)


def test_what_is_not_played_is_not_known() -> None:
    world = SimulatedWorld(scenario(), 4)
    assert world.closed_loop
    world.outputs(1)
    assert np.isfinite(world.truth("r1", 1)).all()
    assert np.isnan(world.truth("r1", 2)).all()
    with pytest.raises(RuntimeError, match="step 3 of a closed loop after step 1"):
        world.outputs(3)
    with pytest.raises(RuntimeError, match="once, in order"):
        world.outputs(1)


def test_who_does_not_choose_its_motion_is_not_steered() -> None:
    steer = Steer((0.1, 0.0, 0.0), 0.0, NS)
    with pytest.raises(ValueError, match=r"r3 does not choose its motion.*planning\.kind"):
        SimulatedWorld(scenario(), 4).steer("r3", 0, steer)
    plain = scenario()
    for robot in plain.robots:
        robot.planning.clear()
    world = SimulatedWorld(plain, 4)
    assert not world.closed_loop
    with pytest.raises(ValueError, match=r"r1 cannot be steered.*planning\.kind"):
        world.steer("r1", 0, steer)


def test_gains_and_altitudes_go_with_it() -> None:
    """The odometry of `unicycle_gains` reports what its gains make of the motion; a held altitude stays held."""
    world = SimulatedWorld(scenario(model="unicycle_gains", start_sigma=GAINS), 2)
    item = odometry(play(world), "r1")[50]
    gain = world.truth("r1", 50)[3]
    assert np.hypot(*item.z[:2]) * gain == pytest.approx(0.4, rel=0.01)
    assert gain != 1.0
    high = scenario(
        SHARES | {"altitude_m": 0.1},
        model="quadrotor",
        control={"altitude_m": 5.0},
        start={"pose": [0.0, 0.0, 5.0, 0.0]},
        start_sigma={"position_m": 0.5, "altitude_m": 0.1, "heading_rad": 0.1},
    )
    high.robots.pop()
    air = SimulatedWorld(high, 2)
    play(air)
    assert abs(air.place("r1", 60)[2] - 5.0) < 0.5
    assert np.isfinite(air.place("r1", 60)).all()


def test_who_flies_goes_up_and_to_the_side_and_its_odometry_states_all_of_its_noise() -> None:
    total, count, noise = 0.0, 0, {"speed_mps": 0.1, "climb_mps": 0.05, "yaw_rate_radps": 0.02}
    for seed in range(10):
        made = scenario(
            noise,
            model="planar_altitude",
            vehicle={"flies": True, "max_speed_mps": 2.0, "max_acceleration_mps2": 1.0},
            start={"pose": [0.0, 0.0, 5.0, 0.4]},
            start_sigma={"position_m": 0.5, "altitude_m": 0.1, "heading_rad": 0.1},
        )
        world = SimulatedWorld(made, seed)
        for k in range(1, 61):
            world.steer("r1", (k - 1) * NS, Steer((0.3, -0.8, 0.2), 0.1 * np.sin(k), k * NS))
            (item,) = odometry(world.outputs(k), "r1")
            before, after = world.truth("r1", k - 1), world.truth("r1", k)
            error = np.zeros(4)
            error[[0, 1, 3]] = between(before[[0, 1, 3]], after[[0, 1, 3]]) - item.z[[0, 1, 3]]
            error[2] = after[2] - before[2] - item.z[2]
            total += float(np.sum(error**2 / np.diagonal(item.R)))
            count += 4
        assert world.place("r1", 60)[2] == pytest.approx(5.0 + 0.2 * 59.5, abs=2.0)
        assert item.z[1] < -0.5
    assert is_chi_square(total, count)


GAINS = {"position_m": 0.5, "heading_rad": 0.1, "gain_along": 0.05, "gain_turn": 0.05}


def test_a_world_that_was_played_can_be_asked_again(tmp_path: Path) -> None:
    """From its file, also while it goes on; a row that is cut is not used."""
    made, path = scenario(), tmp_path / "motion.bin"
    world = SimulatedWorld(made, 6)
    writer = MotionWriter(path, world.motion)
    writer.add(0)
    found: list[Output] = []
    for k in range(1, 31):
        world.steer("r1", (k - 1) * NS + NS // 3, Steer((0.3, 0.0, 0.0), 0.2, k * NS + NS // 2))
        found += world.outputs(k)
        writer.add(k)
    writer.close()
    with path.open("ab") as file:
        file.write(b"\0" * 20)
    again = played_world(made, 6, path)
    assert not again.closed_loop
    for left, right in zip(found, [item for k in range(1, 31) for item in again.outputs(k)], strict=True):
        np.testing.assert_array_equal(left.z, right.z)
        np.testing.assert_array_equal(left.R, right.R)
    for k in (0, 17, 30):
        np.testing.assert_array_equal(again.truth("r1", k), world.truth("r1", k))
        np.testing.assert_array_equal(again.place("r2", k), world.place("r2", k))
    assert np.isnan(again.truth("r1", 31)).all()
