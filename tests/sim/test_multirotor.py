"""Vehicles that fly go where they are told, within their limits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.effects import Steer
from agent.estimation.motion import compose
from agent.settings import NS
from sim.multirotor import Multirotor
from sim.scenario import VehiclePart

Array = NDArray[np.float64]
MS = NS // 1000


def vehicle(**limits: Any) -> Multirotor:
    usual = {"flies": True, "max_speed_mps": 5.0, "max_turn_radps": 2.0}
    return Multirotor(VehiclePart.model_validate(usual | limits))


def flown(made: Multirotor, until_ns: int, step_ns: int) -> Array:
    """Place and heading (steps + 1, 4): x, y, z, heading."""
    track = [np.zeros(4)]
    for t_ns in range(step_ns, until_ns + 1, step_ns):
        moved, before = made.advance(t_ns), track[-1]
        x, y, heading = compose(before[[0, 1, 3]], moved[[0, 1, 3]])
        track.append(np.array([x, y, before[2] + moved[2], heading]))
    return np.array(track)


def test_without_inertia_it_goes_as_told_until_the_command_ends() -> None:
    made = vehicle()
    made.steer(0, Steer((1.0, -2.0, 0.5), 0.0, 2 * NS))
    track = flown(made, 3 * NS, 50 * MS)
    np.testing.assert_allclose(track[40], [2.0, -4.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(track[60], track[40], atol=1e-12)


def test_a_command_is_relative_to_the_nose() -> None:
    """Turning at 1 rad/s and going forward at 1 m/s is a circle of 1 m."""
    made = vehicle()
    made.steer(0, Steer((1.0, 0.0, 0.0), 1.0, 10 * NS))
    track = flown(made, 3 * NS, 50 * MS)
    t_s = 0.05 * np.arange(61)
    np.testing.assert_allclose(track[:, 0], np.sin(t_s), atol=0.02)
    np.testing.assert_allclose(track[:, 1], 1.0 - np.cos(t_s), atol=0.02)


def test_it_keeps_its_velocity_when_it_turns() -> None:
    """Told to hover and to turn, it brakes along the way it went, wherever its nose points."""
    made = vehicle(max_acceleration_mps2=0.5)
    made.steer(0, Steer((1.0, 0.0, 0.0), 0.0, 10 * NS))
    begun = flown(made, 4 * NS, 50 * MS)
    made.steer(4 * NS, Steer((0.0, 0.0, 0.0), 2.0, 10 * NS))
    turned = made.advance(7 * NS)
    assert begun[-1, 0] == pytest.approx(3.0, abs=1e-6), "2 s of speeding up, 2 s at 1 m/s"
    np.testing.assert_allclose(turned, [1.0, 0.0, 0.0, 6.0], atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_limits_hold_whatever_is_commanded(seed: int) -> None:
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    made = vehicle(max_speed_mps=3.0, max_climb_mps=1.0, max_acceleration_mps2=2.0, max_turn_radps=0.8)
    places = [np.zeros(4)]
    for k in range(400):
        if k % 7 == 0:
            ahead, left, up = (rng.normal(size=3) * 5.0).tolist()
            made.steer(k * 20 * MS, Steer((ahead, left, up), rng.normal() * 3.0, (k + 9) * 20 * MS))
        moved, before = made.advance((k + 1) * 20 * MS), places[-1]
        x, y, heading = compose(before[[0, 1, 3]], moved[[0, 1, 3]])
        places.append(np.array([x, y, before[2] + moved[2], heading]))
    track = np.array(places)
    velocity = np.diff(track[:, :3], axis=0) / 0.02
    assert np.hypot(velocity[:, 0], velocity[:, 1]).max() <= 3.0 + 1e-9
    assert np.abs(velocity[:, 2]).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(track[:, 3])).max() <= 0.8 * 0.02 + 1e-12
    pulls = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / 0.02
    assert 1.9 < pulls.max() <= 2.0 * 1.02, "turning while the velocity changes is summed up in parts"


def test_a_command_counts_from_its_instant_and_replaces_the_one_before() -> None:
    made = vehicle()
    made.steer(0, Steer((0.0, 0.0, 1.0), 0.0, 5 * NS))
    made.steer(NS + 3 * MS, Steer((0.0, 0.0, -1.0), 0.0, NS + 7 * MS))
    assert made.advance(2 * NS)[2] == pytest.approx(1.003 - 0.004, abs=1e-9)


def test_a_climb_is_as_fast_as_the_vehicle_unless_told_otherwise() -> None:
    made = vehicle(max_speed_mps=2.0)
    made.steer(0, Steer((0.0, 0.0, 9.0), math.inf, 5 * NS))
    np.testing.assert_allclose(made.advance(NS), [0.0, 0.0, 2.0, 2.0], atol=1e-9)
