"""Measurements told by angles: the same information, and none that is not there, for who heads anywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import gain, quadratic_form, symmetrize, wrap_components
from agent.estimation.motion import SPATIAL, UNICYCLE
from agent.estimation.observation import AbsoluteModel, Intrinsics, OutOfViewError, RelativeModel
from agent.estimation.unscented import observe
from agent.estimation.wide_heading import by_angles

Array = NDArray[np.float64]

MOUNTS = [(0.0,) * 6, (0.2, -0.1, 0.0, 0.0, 0.0, 0.7), (0.1, 0.0, -0.1, 0.0, 0.6, 0.2), (0.0, 0.0, 0.0, 0.0, 1.2, 0.0)]


def pixels(mount: tuple[float, ...], attitude: tuple[float, float] = (0.0, 0.0), **more: object) -> RelativeModel:
    return RelativeModel(
        "pixel",
        SPATIAL,
        mount,
        landmark=(6.0, 1.0, -2.5),
        attitude=attitude,
        intrinsics=Intrinsics(),
        **more,  # type: ignore[arg-type]
    )


def wide(n: int, heading: int, sigma_rad: float = 3.0) -> Array:
    variances = np.full(n, 0.04)
    variances[heading] = sigma_rad**2
    return np.diag(variances)


@pytest.mark.parametrize("attitude", [(0.0, 0.0), (0.1, -0.15)])
@pytest.mark.parametrize("mount", MOUNTS[:3])
def test_a_pixel_is_an_azimuth_and_an_elevation(mount: tuple[float, ...], attitude: tuple[float, float]) -> None:
    """What is seen exactly is told exactly, and small errors are mapped as their covariance is."""
    model, state = pixels(mount, attitude), np.array([0.0, 0.0, 0.0, 0.1])
    z, R = model.h(state), np.diag([4.0, 9.0])
    told, angles, noise = by_angles(model, z, R, wide(4, 3))
    assert isinstance(told, RelativeModel) and told.kind == "bearing3" and told.turning
    np.testing.assert_allclose(told.h(state), angles, atol=1e-9)
    offset = np.array([1e-3, -2e-3])
    moved = by_angles(model, z + offset, R, wide(4, 3))[1]
    J = np.stack([by_angles(model, z + step, R, wide(4, 3))[1] - angles for step in 1e-5 * np.eye(2)], axis=1) / 1e-5
    np.testing.assert_allclose(moved - angles, J @ offset, atol=1e-8)
    np.testing.assert_allclose(noise, J @ R @ J.T, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("mount", [(0.0,) * 6, (0.3, -0.1, 0.0, 0.0, 0.0, 0.7)])
def test_a_vector_is_a_range_and_a_bearing(mount: tuple[float, ...]) -> None:
    model = RelativeModel("vector", UNICYCLE, mount, landmark=(3.0, -2.0))  # type: ignore[arg-type]
    state, R = np.array([0.5, 0.4, 2.0]), np.array([[0.02, 0.005], [0.005, 0.01]])
    z = model.h(state)
    told, angles, noise = by_angles(model, z, R, wide(3, 2))
    assert isinstance(told, RelativeModel) and told.kind == "range_bearing"
    np.testing.assert_allclose(told.h(state), angles, atol=1e-12)
    J = np.stack([by_angles(model, z + step, R, wide(3, 2))[1] - angles for step in 1e-6 * np.eye(2)], axis=1) / 1e-6
    np.testing.assert_allclose(noise, J @ R @ J.T, rtol=1e-3)


def test_who_knows_its_heading_and_other_kinds_are_left_alone() -> None:
    model, z, R = pixels(MOUNTS[2]), np.array([300.0, 200.0]), np.eye(2)
    assert by_angles(model, z, R, wide(4, 3, 0.3)) == (model, z, R)
    for other in (RelativeModel("range", UNICYCLE, landmark=(1.0, 1.0)), AbsoluteModel("heading", UNICYCLE)):
        assert by_angles(other, z, R, wide(3, 2))[0] is other


def test_straight_below_there_is_no_azimuth() -> None:
    model = RelativeModel("pixel", SPATIAL, (0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0), landmark=(0.0, 0.0, -9.0))
    z = model.h(np.zeros(4))
    with pytest.raises(OutOfViewError):
        by_angles(model, z, 0.01**2 * np.eye(2), wide(4, 3))


@given(seed=st.integers(0, 2**32 - 1))
def test_a_place_stays_as_unsure_as_it_is(seed: int) -> None:
    """Updates by one pixel with a heading of 3 rad: over all of them the errors are what is claimed."""
    random = np.random.default_rng(seed)
    cov = np.diag([0.3**2, 0.2**2, 0.1**2, 3.0**2])
    model = pixels((0.0, 0.0, 0.0, 0.0, 0.6, 0.2))
    nees = []
    for _ in range(60):
        truth = np.array([0.0, 0.0, 0.0, 0.1])
        mean = wrap_components(truth + np.sqrt(np.diagonal(cov)) * random.standard_normal(4), (3,))
        z, R = model.h(truth) + 2.0 * random.standard_normal(2), 4.0 * np.eye(2)
        told, angles, noise = by_angles(model, z, R, cov)
        seen = observe(told.h, told.jacobian, mean, cov, told.angles, turning=told.turning)
        S = seen.cov + noise
        K = gain(seen.cross, S)
        after = mean + K @ wrap_components(angles - seen.z, told.angles)
        P = symmetrize(cov - K @ S @ K.T)
        nees.append(float(quadratic_form(wrap_components(truth - after, (3,)), P)) / 4.0)
    assert np.mean(nees) < 1.6, seed
