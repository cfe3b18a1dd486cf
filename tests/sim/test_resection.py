"""Poses and clock of cameras from a known track: found exactly, robustly, and not where nothing fits."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim.recordings.resection import CameraPose, ResectionError, Sighted, Track, clock_shift, pose

Array = NDArray[np.float64]

SHIFT_S = 7.34
LENGTH_S = 60.0
PLACES = ((40.0, -30.0, 2.0), (-35.0, -20.0, 5.0), (5.0, 60.0, 1.0))


def flown(t_s: Array) -> Array:
    """A flight that never repeats itself."""
    return np.column_stack(
        [
            12.0 * np.sin(0.31 * t_s) + 6.0 * np.cos(0.83 * t_s),
            14.0 * np.cos(0.23 * t_s) + 5.0 * np.sin(0.71 * t_s),
            15.0 + 4.0 * np.sin(0.43 * t_s) + 0.1 * t_s,
        ]
    )


def looking(place: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 15.0)) -> CameraPose:
    forward = np.subtract(at, place) / np.linalg.norm(np.subtract(at, place))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    return CameraPose(Rotation.from_euler("z", 0.05).as_matrix() @ level, np.array(place))


def track(rate_hz: float = 5.0) -> Track:
    t_s = np.arange(0.0, LENGTH_S, 1.0 / rate_hz)
    return Track(t_s, flown(t_s))


def sighted(camera: CameraPose, seed: int, sigma: float, rate_hz: float = 20.0) -> Sighted:
    """On a clock that is SHIFT_S behind that of the track."""
    t_s = np.arange(5.0, 50.0, 1.0 / rate_hz) - SHIFT_S
    plane = camera.project(flown(t_s + SHIFT_S))
    return Sighted(t_s, plane + sigma * np.random.default_rng(seed).standard_normal(plane.shape))


def test_poses_and_clock_are_found() -> None:
    cameras = [looking(place) for place in PLACES]
    seen = [sighted(camera, seed, 1e-4) for seed, camera in enumerate(cameras)]
    shift_s = clock_shift(seen, track())
    assert shift_s == pytest.approx(SHIFT_S, abs=1e-3)
    for camera, item in zip(cameras, seen):
        found = pose(item, track(), shift_s)
        np.testing.assert_allclose(found.centre, camera.centre, atol=0.02)
        np.testing.assert_allclose(found.turn, camera.turn, atol=5e-4)


def test_a_camera_whose_clock_is_off_does_not_move_the_common_one() -> None:
    seen = [sighted(looking(place), seed, 1e-4) for seed, place in enumerate(PLACES)]
    seen[0] = Sighted(seen[0].t_s + 0.08, seen[0].plane)
    assert clock_shift(seen, track()) == pytest.approx(SHIFT_S, abs=5e-3)


def test_gross_errors_hardly_move_a_pose() -> None:
    camera = looking(PLACES[0])
    seen = sighted(camera, 3, 1e-4)
    seen.plane[::20] += 0.1
    found = pose(seen, track(), SHIFT_S)
    np.testing.assert_allclose(found.centre, camera.centre, atol=0.2)


def test_points_are_right_and_down_of_where_a_camera_looks() -> None:
    camera = CameraPose(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(camera.project(np.array([[2.0, 12.0, 1.0]])), [[0.1, 0.2]])


def test_sightings_of_another_flight_are_refused() -> None:
    seen = sighted(looking(PLACES[0]), 1, 1e-4)
    mixed = np.random.default_rng(5).permutation(seen.plane)
    with pytest.raises(ResectionError, match="does not fit the track"):
        clock_shift([Sighted(seen.t_s, mixed)], track())


def test_a_pose_takes_enough_sightings_within_the_track() -> None:
    seen = sighted(looking(PLACES[0]), 1, 1e-4)
    with pytest.raises(ResectionError, match="0 sightings fall into the track"):
        pose(seen, track(), 1000.0)
    with pytest.raises(ResectionError, match="does not fit"):
        clock_shift([Sighted(seen.t_s[:10], seen.plane[:10])], track())
