"""Bearings tell a place only where they cross."""

from __future__ import annotations

import numpy as np
import pytest

from agent.estimation.parallax import crosses
from agent.estimation.sights import Sight


def towards(target: np.ndarray, *places: list[float], sigma: float = 0.001, seed: int = 1) -> list[Sight]:
    rng, found = np.random.default_rng(seed), []
    for place in places:
        at = np.array(place)
        away = (target - at) / np.linalg.norm(target - at)
        found.append(Sight(at, away + sigma * rng.normal(size=3), sigma))
    return found


TARGET = np.array([20.0, 0.0, 5.0])


@pytest.mark.parametrize(("apart_m", "enough"), [(1.0, False), (3.9, False), (4.4, True), (20.0, True)])
def test_two_bearings_cross_by_the_angle_between_them(apart_m: float, enough: bool) -> None:
    # At 20.6 m an angle of 0.2 rad is a base of 4.1 m.
    assert crosses(towards(TARGET, [0, -apart_m / 2, 0], [0, apart_m / 2, 0]), 0.2) is enough


def test_one_bearing_never_crosses_nor_do_many_of_one_place_whatever_their_noise() -> None:
    for seed in range(40):
        place = [0.0, 0.0, 0.0]
        assert not crosses(towards(TARGET, place, sigma=0.1, seed=seed), 0.2)
        assert not crosses(towards(TARGET, *[place] * 30, sigma=0.1, seed=seed), 0.2), seed


def test_observers_in_line_with_the_target_tell_no_place() -> None:
    assert not crosses(towards(TARGET, [0, 0, 0], [8, 0, 2], [16, 0, 4]), 0.2)


def test_no_bearing_is_none() -> None:
    assert not crosses([], 0.2)
