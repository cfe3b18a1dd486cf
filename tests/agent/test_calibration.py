"""Readings without the errors of their sensor, in the form they are used in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.calibration import NO_CALIBRATION, Calibration, corrected, formed
from agent.estimation.mounting import planar_mount
from agent.events import Observation, Odometry
from agent.sensor_input import SensorConfig, decode, encode


def test_nothing_known_changes_nothing() -> None:
    z = np.array([3.0, 0.2])
    assert corrected("range_bearing", "r2", z, NO_CALIBRATION) is z
    np.testing.assert_array_equal(corrected("range_bearing", "r2", z, Calibration()), z)


@given(st.floats(0.3, 20.0), st.floats(-1.2, 1.2), st.floats(0.8, 1.2), st.floats(-0.2, 0.2))
def test_a_depth_becomes_the_distance(distance: float, bearing: float, scale: float, bias: float) -> None:
    calibration = Calibration(bias_m=bias, scale=scale, depth=True, bias_rad=0.05)
    read = np.array([distance * math.cos(bearing) * scale + bias, bearing + 0.05])
    np.testing.assert_allclose(corrected("range_bearing", "r2", read, calibration), [distance, bearing], atol=1e-9)


def test_a_pairs_own_bias_takes_the_place_of_the_general_one() -> None:
    calibration = Calibration(bias_m=0.1, bias_of={"r2": 0.5, "landmark:a1": -0.2})
    for of, expected in (("r2", 2.5), ("landmark:a1", 3.2), ("r3", 2.9), (None, 2.9)):
        assert corrected("range", of, np.array([3.0]), calibration)[0] == pytest.approx(expected)


def test_a_distance_does_not_become_negative_and_a_bearing_is_no_distance() -> None:
    calibration = Calibration(bias_m=1.0, bias_rad=0.1)
    assert corrected("range", None, np.array([0.2]), calibration)[0] == 0.0
    assert corrected("bearing", None, np.array([0.2]), calibration)[0] == pytest.approx(0.1)
    assert corrected("heading", None, np.array([0.2]), calibration)[0] == 0.2


def test_a_bearing_across_the_axis_is_never_a_huge_distance() -> None:
    far = corrected("range_bearing", "r2", np.array([1.0, math.pi / 2.0]), Calibration(depth=True))
    assert far[0] == pytest.approx(20.0)


@pytest.mark.parametrize(("form", "kind", "size"), [("range", "range", 1), ("bearing", "bearing", 1)])
def test_one_of_the_two_may_be_used_alone(form: str, kind: str, size: int) -> None:
    z, R = np.array([4.0, 0.3]), np.array([[0.04, 0.001], [0.001, 0.0009]])
    found = formed("range_bearing", z, R, form)  # type: ignore[arg-type]
    row = 0 if form == "range" else 1
    assert (found[0], found[1].shape, found[2].shape) == (kind, (size,), (size, size))
    assert (found[1][0], found[2][0, 0]) == (z[row], R[row, row])


def test_what_has_one_form_only_keeps_it() -> None:
    z, R = np.array([4.0]), np.array([[0.04]])
    assert formed("range", z, R, "vector") == ("range", z, R)
    assert formed("range_bearing", z, R, "polar") == ("range_bearing", z, R)


@given(distance=st.floats(0.5, 20.0), bearing=st.floats(-3.0, 3.0))
def test_the_vectors_noise_is_along_and_across_the_sight(distance: float, bearing: float) -> None:
    kind, z, R = formed("range_bearing", np.array([distance, bearing]), np.diag([0.01, 0.0004]), "vector")
    assert kind == "vector"
    np.testing.assert_allclose(z, [distance * math.cos(bearing), distance * math.sin(bearing)])
    along = np.array([math.cos(bearing), math.sin(bearing)])
    across = np.array([-along[1], along[0]])
    assert along @ R @ along == pytest.approx(0.01)
    assert across @ R @ across == pytest.approx(0.0004 * distance**2)
    assert along @ R @ across == pytest.approx(0.0, abs=1e-12)


def test_a_datagram_is_used_as_its_sensor_is_known() -> None:
    camera = SensorConfig(planar_mount(0.1, 0.0, 0.0), Calibration(bias_m=0.5), 30_000_000, "vector")
    payload = encode(1_000_000_000, "range_bearing", np.array([2.5, 0.0]), np.diag([0.01, 0.01]), of="r2", sensor="eye")
    event = decode(payload, 1_100_000_000, {"eye": camera})
    assert isinstance(event, Observation)
    assert (event.kind, event.t_meas_ns, event.mount) == ("vector", 970_000_000, planar_mount(0.1, 0.0, 0.0))
    np.testing.assert_allclose(event.z, [2.0, 0.0])


def test_odometry_that_acts_later_than_it_is_stamped() -> None:
    wheels = SensorConfig(lag_ns=-220_000_000)
    payload = encode(200_000_000, "odometry", np.zeros(4), np.eye(4), sensor="wheels", t0_ns=100_000_000)
    event = decode(payload, 200_000_000, {"wheels": wheels})
    assert isinstance(event, Odometry)
    assert (event.t0_ns, event.t_meas_ns) == (320_000_000, 420_000_000)
