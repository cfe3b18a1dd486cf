"""Odometry noise: each rate in its place, growth with time and way, and the calibrated gains."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.odometry import OdometryNoise

SILENT = {
    "along_m_per_sqrt_s": 0.0,
    "vertical_m_per_sqrt_s": 0.0,
    "heading_rad_per_sqrt_s": 0.0,
}


@pytest.mark.parametrize(
    ("rate", "component", "variance"),
    [
        ("along_m_per_sqrt_s", 0, 0.09 * 2.0),
        ("along_m_per_sqrt_m", 0, 0.09 * 5.0),
        ("across_m_per_sqrt_s", 1, 0.09 * 2.0),
        ("vertical_m_per_sqrt_s", 2, 0.09 * 2.0),
        ("heading_rad_per_sqrt_s", 3, 0.09 * 2.0),
        ("heading_rad_per_sqrt_rad", 3, 0.09 * 0.4),
    ],
)
def test_each_rate_makes_noise_in_one_component(rate: str, component: int, variance: float) -> None:
    """An increment of 5 m way (the vertical apart) and a turn of -0.4 rad in 2 s, at a rate of 0.3."""
    cov = OdometryNoise(**(SILENT | {rate: 0.3})).covariance(np.array([3.0, -4.0, 7.0, -0.4]), 2.0)
    expected = np.zeros((4, 4))
    expected[component, component] = variance
    assert np.allclose(cov, expected, atol=1e-15)


@given(st.floats(0.01, 0.99), st.floats(0.0, 10.0), st.floats(-3.0, 3.0), st.floats(0.0, 5.0))
def test_the_parts_of_a_straight_increment_have_the_noise_of_the_whole(
    fraction: float, way: float, turn: float, dt_s: float
) -> None:
    noise = OdometryNoise(0.1, 0.2, 0.05, 0.02, 0.01, 0.1)
    delta = np.array([way, 0.0, 0.1, turn])
    parts = noise.covariance(delta * fraction, dt_s * fraction) + noise.covariance(
        delta * (1.0 - fraction), dt_s * (1.0 - fraction)
    )
    assert np.allclose(parts, noise.covariance(delta, dt_s), rtol=1e-9, atol=1e-15)


def test_time_that_runs_backwards_makes_no_negative_variance() -> None:
    noise = OdometryNoise(along_m_per_sqrt_m=0.1)
    still = noise.covariance(np.zeros(4), -1.0)
    assert not still.any()
    assert noise.covariance(np.array([1.0, 0.0, 0.0, 0.0]), -1.0)[0, 0] == pytest.approx(0.01)


def test_gains_scale_the_way_and_the_turn_and_leave_the_reported_increment_alone() -> None:
    reported = np.array([2.0, 1.0, 0.5, 0.3])
    corrected = OdometryNoise(scale_along=1.1, scale_turn=0.9).calibrated(reported)
    assert np.allclose(corrected, [2.2, 1.1, 0.5, 0.27])
    assert np.array_equal(reported, [2.0, 1.0, 0.5, 0.3])
    assert np.array_equal(OdometryNoise().calibrated(reported), reported)
