"""A vehicle: what it is told, within its limits, for as long as it is told; against integration in small steps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.effects import Steer
from agent.settings import NS
from sim.scenario import VehiclePart
from sim.vehicle import Vehicle, arc

Array = NDArray[np.float64]

FINE_NS = NS // 1000


def told(speed: float, turn: float, until_s: float) -> Steer:
    return Steer((speed, 0.0, 0.0), turn, round(until_s * NS))


def driven(limits: VehiclePart, commands: list[tuple[int, Steer]], end_ns: int) -> Array:
    """The pose (3,) after `end_ns` by small steps, with nothing of the vehicle's own code: midpoint rule."""
    x = y = heading = 0.0
    speed = min(max(0.0, limits.min_speed_mps), limits.max_speed_mps)
    for t_ns in range(0, end_ns, FINE_NS):
        wanted, turn = 0.0, 0.0
        begun = [steer for at_ns, steer in commands if at_ns <= t_ns]
        if begun and begun[-1].until_ns > t_ns:
            wanted, turn = begun[-1].velocity_mps[0], begun[-1].yaw_rate_radps
        wanted = min(max(wanted, limits.min_speed_mps), limits.max_speed_mps)
        turn = min(max(turn, -limits.max_turn_radps), limits.max_turn_radps)
        dt, before = FINE_NS / NS, speed
        if limits.max_acceleration_mps2 is None:
            before = speed = wanted
        else:
            most = limits.max_acceleration_mps2 * dt
            speed += min(max(wanted - speed, -most), most)
        middle = heading + 0.5 * turn * dt
        x += 0.5 * (before + speed) * dt * math.cos(middle)
        y += 0.5 * (before + speed) * dt * math.sin(middle)
        heading += turn * dt
    return np.array([x, y, heading])


LIMITS: dict[str, dict[str, Any]] = {
    "at once": {},
    "slow to start": {"max_acceleration_mps2": 0.3},
    "cannot stand still": {"min_speed_mps": 0.2, "max_acceleration_mps2": 0.4},
    "backwards": {"min_speed_mps": -0.5, "max_acceleration_mps2": 0.5},
}


@pytest.mark.parametrize("name", LIMITS)
def test_a_drive_is_that_of_small_steps(name: str) -> None:
    limits = VehiclePart(max_speed_mps=0.8, max_turn_radps=0.7, **LIMITS[name])
    commands = [
        (0, told(0.5, 0.3, 1.2)),
        (NS // 5, told(0.8, -0.6, 1.7)),
        (9 * NS // 10, told(2.0, 3.0, 1.4)),
        (2 * NS, told(-1.0, 0.2, 9.0)),
        (5 * NS // 2, told(0.4, 0.0, 2.7)),
    ]
    vehicle = Vehicle(limits)
    pose = 0j
    heading, waiting = 0.0, list(commands)
    for k in range(1, 4):
        while waiting and waiting[0][0] < k * NS:
            vehicle.steer(*waiting.pop(0))
        dx, dy, turned = vehicle.advance(k * NS)
        pose += complex(dx, dy) * np.exp(1j * heading)
        heading += turned
    expected = driven(limits, commands, 3 * NS)
    np.testing.assert_allclose([pose.real, pose.imag, heading], expected, atol=2e-3)


@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-3.0, 3.0), st.floats(0.01, 3.0))
def test_an_arc_cut_in_two_is_the_same_arc(begin: float, end: float, turn: float, seconds: float) -> None:
    whole = arc(begin, end, turn, seconds)
    middle = 0.5 * (begin + end)
    first, second = arc(begin, middle, turn, 0.5 * seconds), arc(middle, end, turn, 0.5 * seconds)
    joined = complex(*first[:2]) + complex(*second[:2]) * np.exp(1j * first[2])
    np.testing.assert_allclose([joined.real, joined.imag, first[2] + second[2]], whole, atol=1e-9)


def test_a_command_counts_from_its_instant_within_a_step() -> None:
    vehicle = Vehicle(VehiclePart())
    vehicle.steer(0, told(0.5, 0.0, 9.0))
    vehicle.advance(NS)
    vehicle.steer(NS + NS // 5, told(0.1, 0.0, 9.0))
    assert vehicle.advance(2 * NS)[0] == pytest.approx(0.2 * 0.5 + 0.8 * 0.1)


def test_a_command_at_the_end_of_a_step_is_of_the_next() -> None:
    vehicle = Vehicle(VehiclePart())
    vehicle.steer(NS, told(0.5, 0.0, 9.0))
    np.testing.assert_array_equal(vehicle.advance(NS), np.zeros(3))
    assert vehicle.advance(2 * NS)[0] == pytest.approx(0.5)


def test_a_vehicle_stands_still_once_its_command_is_over() -> None:
    vehicle = Vehicle(VehiclePart())
    vehicle.steer(0, told(0.5, 0.4, 1.25))
    vehicle.advance(NS)
    assert vehicle.advance(2 * NS)[2] == pytest.approx(0.25 * 0.4)
    np.testing.assert_array_equal(vehicle.advance(3 * NS), np.zeros(3))
    assert vehicle.speed_mps == 0.0


def test_a_new_command_replaces_the_old_one_and_its_end() -> None:
    vehicle = Vehicle(VehiclePart())
    vehicle.steer(0, told(0.5, 0.0, 1.5))
    vehicle.steer(NS // 2, told(0.3, 0.0, 2.5))
    vehicle.advance(NS)
    assert vehicle.advance(2 * NS)[0] == pytest.approx(0.3)
    assert vehicle.advance(3 * NS)[0] == pytest.approx(0.15)


def test_a_command_that_is_over_when_it_comes_stops_the_vehicle() -> None:
    vehicle = Vehicle(VehiclePart())
    vehicle.steer(0, told(0.5, 0.0, 9.0))
    vehicle.advance(NS)
    vehicle.steer(NS // 2, told(0.5, 0.0, 0.9))
    np.testing.assert_array_equal(vehicle.advance(2 * NS), np.zeros(3))


def test_limits_hold_whatever_is_commanded() -> None:
    limits = VehiclePart(max_speed_mps=0.6, max_turn_radps=0.5, max_acceleration_mps2=0.25)
    rng = np.random.default_rng(5)
    vehicle = Vehicle(limits)
    before = 0.0
    for k in range(200):
        vehicle.steer(k * NS, told(rng.normal(0.0, 5.0), rng.normal(0.0, 5.0), k + 2.0))
        dx, dy, turned = vehicle.advance((k + 1) * NS)
        assert math.hypot(dx, dy) <= 0.6 + 1e-9
        assert abs(turned) <= 0.5 + 1e-9
        assert 0.0 <= vehicle.speed_mps <= 0.6
        assert abs(vehicle.speed_mps - before) <= 0.25 + 1e-9
        before = vehicle.speed_mps


def test_the_discrete_unicycle_drives_straight_on_and_turns_at_the_end_of_each_step() -> None:
    vehicle = Vehicle(VehiclePart(max_speed_mps=2.0, max_turn_radps=1.0, turns="after"))
    vehicle.steer(0, Steer((1.5, 0.0, 0.0), 0.5, 10 * NS))
    np.testing.assert_allclose(vehicle.advance(2 * NS), [3.0, 0.0, 1.0])
    np.testing.assert_allclose(vehicle.advance(4 * NS), [3.0, 0.0, 1.0])
