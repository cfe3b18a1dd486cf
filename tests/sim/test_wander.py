"""Targets that fly at random keep to every limit they are given."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.estimation.motion import LAYOUTS
from sim.course import CoursePart, followed

Array = NDArray[np.float64]
STEP_NS = 50_000_000
SPACE = LAYOUTS["constant_velocity_3d"]
MAX_SPEED, MAX_PULL = 2.39, 1.43


def course(**parts: Any) -> CoursePart:
    limits = {"max_speed_mps": MAX_SPEED, "max_acceleration_mps2": MAX_PULL}
    return CoursePart.model_validate({"kind": "wander", **limits, **parts})


def flown(seed: int, steps: int = 2400, **parts: Any) -> Array:
    return followed(course(**parts), SPACE, np.array([1.0, -2.0, 4.0, 0.0, 0.0, 0.0]), STEP_NS, steps, seed, "t1")


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("reach", [[20.0, 20.0, 8.0], [2.0, 1.0, 0.3]])
def test_limits_hold(seed: int, reach: list[float]) -> None:
    track = flown(seed, reach_m=reach, min_altitude_m=3.0)
    print(f"seed {seed}, reach {reach}")
    np.testing.assert_allclose(track[1:, :3], track[:-1, :3] + 0.05 * track[1:, 3:], atol=1e-12)
    assert (np.abs(track[:, :3] - track[0, :3]) <= np.array(reach) + 1e-9).all()
    assert track[:, 2].min() >= 3.0 - 1e-9
    assert np.linalg.norm(track[:, 3:], axis=1).max() <= MAX_SPEED + 1e-9
    pulls = np.linalg.norm(np.diff(track[:, 3:], axis=0), axis=1) / 0.05
    assert pulls.max() <= MAX_PULL + 1e-9


def test_it_uses_its_limits_and_its_box() -> None:
    tracks = np.stack([flown(seed) for seed in range(8)])
    assert np.linalg.norm(tracks[..., 3:], axis=-1).max() > 0.9 * MAX_SPEED
    pulls = np.linalg.norm(np.diff(tracks[..., 3:], axis=1), axis=-1) / 0.05
    assert pulls.max() > 0.9 * MAX_PULL
    assert (np.ptp(tracks[..., :2], axis=1) > 10.0).all()
    assert np.ptp(tracks[..., 2], axis=1).min() > 1.0


def test_a_longer_run_begins_as_a_shorter_one_and_seeds_differ() -> None:
    np.testing.assert_array_equal(flown(3, 700), flown(3, 1400)[:701])
    assert np.abs(flown(3) - flown(4)).max() > 1.0


def test_a_planar_target_wanders_too() -> None:
    layout = LAYOUTS["constant_velocity"]
    track = followed(course(min_altitude_m=50.0), layout, np.zeros(4), STEP_NS, 400, 1, "t1")
    assert np.ptp(track[:, 0]) > 1.0
    assert np.linalg.norm(track[:, 2:], axis=1).max() <= MAX_SPEED + 1e-9


@pytest.mark.parametrize(
    ("parts", "start", "words"),
    [
        ({"lap_s": 4.0}, None, "course.lap_s is not of kind 'wander'"),
        ({"reach_m": [1.0, 0.0, 1.0]}, None, "course.reach_m must be above 0"),
        ({"min_altitude_m": 5.0}, [0.0, 0.0, 4.0, 0.0, 0.0, 0.0], "course.min_altitude_m = 5 is above the start at 4"),
        ({}, [0.0, 0.0, 4.0, 1.0, 0.0, 0.0], "who wanders starts at rest"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_key(
    parts: dict[str, Any], start: list[float] | None, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        course(**parts).check("constant_velocity_3d", start)


def test_a_key_of_it_is_refused_of_others() -> None:
    with pytest.raises(ConfigError, match=r"course.reach_m is not of kind 'circle'"):
        CoursePart(kind="circle", reach_m=[1.0, 1.0, 1.0]).check("constant_velocity_3d")
