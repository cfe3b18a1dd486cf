"""Directions of cameras: the models' measurements turned round, with the noise of sensor, pose and heading."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.direction import directed
from agent.estimation.motion import CONSTANT_VELOCITY_3D, SPATIAL, UNICYCLE
from agent.estimation.observation import RelativeModel
from network.messages import Mount
from network.wire_fields import SENSOR_FLOOR

ANGLE = st.floats(-3.1, 3.1)
TILT = st.floats(-0.4, 0.4)
METRE = st.floats(-20.0, 20.0)
MOUNT = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1), TILT, TILT, ANGLE)


@given(st.sampled_from(["bearing3", "pixel"]), MOUNT, st.tuples(TILT, TILT), METRE, METRE, METRE, ANGLE, ANGLE, TILT)
def test_the_target_lies_in_the_direction_it_is_measured_in(
    kind: str,
    mount: Mount,
    attitude: tuple[float, float],
    x: float,
    y: float,
    up: float,
    heading: float,
    azimuth: float,
    elevation: float,
) -> None:
    model = RelativeModel(kind, SPATIAL, mount, None, CONSTANT_VELOCITY_3D, attitude)
    own, cov = np.array([x, y, up, heading]), 1e-6 * np.eye(4)
    if kind == "pixel":
        z = np.tan(np.array([0.3 * azimuth, elevation]))
    else:
        z = np.array([azimuth, elevation])
    found = directed(model, own, cov, z, 1e-4 * np.eye(2))
    assert found is not None
    assert np.linalg.norm(found.direction) == pytest.approx(1.0, abs=1e-12)
    target = np.concatenate([found.place + 7.0 * found.direction, np.zeros(3)])
    assert model.h(np.concatenate([own, target])) == pytest.approx(z, abs=1e-9)


def test_noise_of_sensor_and_heading_is_that_of_the_direction() -> None:
    rng = np.random.default_rng(3)
    model = RelativeModel("bearing3", SPATIAL, (0.5, 0.2, 0.1, 0.1, -0.2, 0.7), None, CONSTANT_VELOCITY_3D)
    mean, cov = np.array([1.0, 2.0, 3.0, 0.4]), np.diag([0.04, 0.09, 0.01, 0.0025])
    z, R = np.array([0.3, 0.5]), np.diag([0.0016, 0.0004])
    found = directed(model, mean, cov, z, R)
    assert found is not None
    drawn = [
        directed(model, rng.multivariate_normal(mean, cov), cov, rng.multivariate_normal(z, R), R) for _ in range(4000)
    ]
    directions = np.array([item.direction for item in drawn if item is not None])
    places = np.array([item.place for item in drawn if item is not None])
    spread = np.cov((directions - found.direction).T)
    assert np.sqrt(np.linalg.eigvalsh(spread)[-1]) == pytest.approx(found.sigma_rad, rel=0.05)
    assert np.cov(places.T) == pytest.approx(found.place_cov, abs=0.006)


def test_a_planar_robot_sees_along_its_plane() -> None:
    model = RelativeModel("bearing", UNICYCLE, subject=CONSTANT_VELOCITY_3D)
    found = directed(model, np.array([1.0, 2.0, 0.5]), np.zeros((3, 3)), np.array([0.25]), np.array([[0.01]]))
    assert found is not None
    assert found.direction == pytest.approx([np.cos(0.75), np.sin(0.75), 0.0])
    assert found.place == pytest.approx([1.0, 2.0, 0.0])
    assert found.sigma_rad == pytest.approx(0.1)


def test_a_range_tells_no_direction() -> None:
    model = RelativeModel("range", UNICYCLE, subject=CONSTANT_VELOCITY_3D)
    assert directed(model, np.zeros(3), np.eye(3), np.array([2.0]), np.eye(1)) is None


@pytest.mark.parametrize("heading_sigma", [0.6, 4.0, 1e3])
def test_who_hardly_knows_its_heading_tells_no_direction(heading_sigma: float) -> None:
    model = RelativeModel("bearing3", SPATIAL, subject=CONSTANT_VELOCITY_3D)
    cov = np.diag([0.01, 0.01, 0.01, heading_sigma**2])
    assert directed(model, np.zeros(4), cov, np.array([0.3, 0.1]), 1e-4 * np.eye(2)) is None


def test_no_direction_is_told_that_others_would_refuse_as_too_sure() -> None:
    model = RelativeModel("bearing3", SPATIAL, subject=CONSTANT_VELOCITY_3D)
    found = directed(model, np.zeros(4), np.zeros((4, 4)), np.array([0.3, 0.1]), 1e-14 * np.eye(2))
    assert found is not None and found.sigma_rad**2 > SENSOR_FLOOR
