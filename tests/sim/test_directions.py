"""Errors of directions are as large as is said, wherever a camera looks."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from sim.directions import DRAWS, DirectionNoise, anywhere, direction_covariance, direction_of, disturbed, vector
from sim.noise import normal_rows, uniform_rows

Array = NDArray[np.float64]
COUNT = 40_000
SIGMA = 0.1
SEED = 11


def measured(noise: DirectionNoise, clean: list[float], sigma_rad: float = SIGMA, count: int = COUNT) -> Array:
    draws = normal_rows(SEED, count, DRAWS[noise], "c1", "camera", noise)
    return disturbed(noise, np.tile(clean, (count, 1)), sigma_rad, draws)


def turns(clean: list[float], found: Array) -> Array:
    """Turns (K, 2) from the true direction to measured ones, to the left and up [rad]."""
    azimuth, elevation = clean
    left = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = vector(np.array([azimuth, elevation + 0.5 * math.pi]))
    to = vector(found)
    across = np.stack([to @ left, to @ up], axis=-1)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(across / size * np.arctan2(size[:, 0], to @ vector(np.array(clean)))[:, None])


@pytest.mark.parametrize("clean", [[0.0, 0.0], [2.5, 0.7], [-3.1, -1.4], [0.3, 1.57]])
def test_isotropic_noise_is_as_large_on_all_sides(clean: list[float]) -> None:
    off = turns(clean, measured("isotropic", clean))
    # The deviation of a sample's variance is sqrt(2 / K) of it: four of them.
    np.testing.assert_allclose(np.mean(off**2, axis=0), SIGMA**2, rtol=4.0 * math.sqrt(2.0 / COUNT), err_msg=f"{SEED}")
    assert abs(np.mean(off[:, 0] * off[:, 1])) < 4.0 * SIGMA**2 / math.sqrt(COUNT)
    assert stats.kstest(off[:, 0] / SIGMA, "norm").pvalue > 1e-4


@pytest.mark.parametrize("clean", [[0.0, 0.0], [2.5, 0.7], [0.3, 1.5]])
def test_published_noise_is_that_of_the_published_simulation(clean: list[float]) -> None:
    """Its root mean square is 0.0814 rad for 0.1 rad, 0.058 along each axis."""
    off = turns(clean, measured("published", clean))
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) == pytest.approx(0.0814, rel=0.015), SEED
    np.testing.assert_allclose(np.sqrt(np.mean(off**2, axis=0)), 0.058, rtol=0.02, err_msg=f"{SEED}")
    # The axis is as long as u is across: as a rotation by a matrix with that axis has it.
    draws = normal_rows(SEED, 1, 4, "c1", "camera", "published")[0]
    g, u = vector(np.array(clean)), draws[:3] / np.linalg.norm(draws[:3])
    wx, wy, wz = np.cross(g, u)
    W, angle = np.array([[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]]), SIGMA * draws[3]
    turned = np.cos(angle) * g + np.sin(angle) * W @ g
    expected = direction_of(turned)
    np.testing.assert_allclose(measured("published", clean, count=1)[0], expected, atol=1e-12)


@pytest.mark.parametrize("noise", ["isotropic", "published"])
@pytest.mark.parametrize("elevation", [0.0, -0.8, 1.3])
def test_the_stated_covariance_is_that_of_azimuth_and_elevation(noise: DirectionNoise, elevation: float) -> None:
    sigma_rad, clean = 0.01, [3.1, elevation]
    found = measured(noise, clean, sigma_rad, 4000)
    error = found - clean
    error[:, 0] = np.remainder(error[:, 0] + math.pi, 2.0 * math.pi) - math.pi
    variances = np.array([np.diagonal(direction_covariance(noise, z, sigma_rad)) for z in found])
    # Published errors have a kurtosis of 27 / 5, so that mean of squares is less sure: its deviation is sqrt(4.4 / K).
    np.testing.assert_allclose(np.mean(error**2 / variances, axis=0), 1.0, atol=5.0 * math.sqrt(4.4 / 4000))


def test_straight_above_nothing_is_said_of_the_azimuth() -> None:
    R = direction_covariance("isotropic", np.array([0.2, 0.5 * math.pi]), SIGMA)
    np.testing.assert_allclose(R, np.diag([math.pi**2 / 3.0, SIGMA**2]))
    assert direction_covariance("isotropic", np.array([0.2, 0.0]), SIGMA)[0, 0] == pytest.approx(SIGMA**2)


def test_no_error_is_no_error() -> None:
    clean = np.array([[0.4, -0.2]])
    np.testing.assert_allclose(disturbed("isotropic", clean, 0.1, np.zeros((1, 2))), clean, atol=1e-15)
    np.testing.assert_allclose(disturbed("published", clean, 0.1, np.array([[1.0, 2.0, 3.0, 0.0]])), clean, atol=1e-15)


@pytest.mark.parametrize("fov_rad", [None, 1.2])
def test_what_is_not_there_is_seen_anywhere_in_the_field_of_view(fov_rad: float | None) -> None:
    found = np.array([anywhere(2, row, fov_rad) for row in uniform_rows(SEED, 5000, 2, "c1", "camera")])
    half = math.pi if fov_rad is None else 0.5 * fov_rad
    assert stats.kstest(found[:, 0], stats.uniform(-half, 2.0 * half).cdf).pvalue > 1e-4, SEED
    assert stats.kstest(np.sin(found[:, 1]), stats.uniform(-1.0, 2.0).cdf).pvalue > 1e-4, SEED
    assert anywhere(1, np.array([0.75, 0.0]), fov_rad).tolist() == [0.5 * half]
