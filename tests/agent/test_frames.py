"""Frames: known directions and places, and round trips."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent import frames

NORTH, EAST, SOUTH, WEST = 0.0, math.pi / 2, math.pi, -math.pi / 2
ANGLES = st.floats(-50.0, 50.0)
VECTORS = st.tuples(*[st.floats(-1e4, 1e4)] * 3).map(np.array)
ORIGINS = st.tuples(st.floats(-85.0, 85.0), st.floats(-180.0, 180.0), st.floats(-100.0, 5000.0))


def test_a_vehicle_north_of_the_origin_and_above_it() -> None:
    np.testing.assert_array_equal(frames.ned_to_enu(np.array([10.0, 0.0, -3.0])), [0.0, 10.0, 3.0])
    np.testing.assert_array_equal(frames.enu_to_ned(np.array([7.0, 0.0, 2.0])), [0.0, 7.0, -2.0])


def test_right_and_down_become_minus_left_and_minus_up() -> None:
    np.testing.assert_array_equal(frames.frd_to_flu(np.array([1.0, 2.0, 3.0])), [1.0, -2.0, -3.0])
    np.testing.assert_array_equal(frames.flu_to_frd(np.array([[1.0, -2.0, -3.0]])), [[1.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("yaw", "heading"),
    [
        (NORTH, math.pi / 2),
        (EAST, 0.0),
        (SOUTH, -math.pi / 2),
        (WEST, math.pi),
        (math.radians(45.0), math.radians(45.0)),
        (math.radians(350.0), math.radians(100.0)),
    ],
)
def test_compass_directions(yaw: float, heading: float) -> None:
    assert frames.heading_from_yaw(yaw) == pytest.approx(heading, abs=1e-12)
    assert frames.wrap(frames.yaw_from_heading(heading) - yaw) == pytest.approx(0.0, abs=1e-12)


def test_quaternions_written_by_hand() -> None:
    half = math.sqrt(0.5)
    assert frames.heading_from_quaternion(1.0, 0.0, 0.0, 0.0) == pytest.approx(math.pi / 2)
    assert frames.heading_from_quaternion(half, 0.0, 0.0, half) == pytest.approx(0.0)  # nose east
    assert frames.heading_from_quaternion(half, 0.0, 0.0, -half) == pytest.approx(math.pi)  # nose west
    # Rolled by 30 deg about a nose that points north: the heading stays.
    assert frames.heading_from_quaternion(
        math.cos(math.radians(15)), math.sin(math.radians(15)), 0.0, 0.0
    ) == pytest.approx(math.pi / 2)
    # Pitched up by 20 deg and turned east: q = q_yaw(90) * q_pitch(20).
    c, s = math.cos(math.radians(10)), math.sin(math.radians(10))
    assert frames.heading_from_quaternion(half * c, -half * s, half * s, half * c) == pytest.approx(0.0, abs=1e-9)


def test_a_leg_to_the_left_of_an_eastbound_vehicle_goes_north() -> None:
    np.testing.assert_allclose(frames.from_level_body(np.array([0.0, 2.0, 0.5]), 0.0), [0.0, 2.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(frames.level_body(np.array([3.0, 0.0, 0.0]), math.pi / 2), [0.0, -3.0, 0.0], atol=1e-12)


def test_metres_of_a_degree() -> None:
    """At the equator a meridian degree is 110.574 km and a parallel degree 111.320 km (WGS-84)."""
    origin = (0.0, 0.0, 0.0)
    np.testing.assert_allclose(frames.geodetic_to_enu(1e-5, 0.0, 0.0, origin), [0.0, 1.10574, 0.0], atol=1e-5)
    np.testing.assert_allclose(frames.geodetic_to_enu(0.0, 1e-5, 0.0, origin), [1.11320, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(frames.geodetic_to_enu(0.0, 0.0, 12.0, origin), [0.0, 0.0, 12.0], atol=1e-9)


def test_at_sixty_degrees_north_a_parallel_degree_is_half_as_long() -> None:
    """55.800 km per degree of longitude at latitude 60 (WGS-84 tables)."""
    east, north, up = frames.geodetic_to_enu(60.0, 10.00001, 100.0, (60.0, 10.0, 100.0))
    assert east == pytest.approx(0.55800, abs=1e-5)
    assert north == pytest.approx(0.0, abs=1e-5) and up == pytest.approx(0.0, abs=1e-5)


def test_a_local_position_is_moved_to_the_fleets_origin() -> None:
    fleet = (47.397742, 8.545594, 488.0)
    own = frames.enu_to_geodetic(np.array([100.0, -50.0, 2.0]), fleet)
    np.testing.assert_allclose(
        frames.local_origin_shift(np.array([3.0, 4.0, 1.0]), own, fleet), [103.0, -46.0, 3.0], atol=1e-3
    )


@given(ANGLES)
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    wrapped = frames.wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_half_a_turn_wraps_to_plus_pi() -> None:
    assert frames.wrap(-math.pi) == math.pi == frames.wrap(math.pi) == frames.wrap(3.0 * math.pi)


@given(VECTORS)
def test_axes_round_trip(vector: np.ndarray) -> None:
    np.testing.assert_array_equal(frames.enu_to_ned(frames.ned_to_enu(vector)), vector)
    np.testing.assert_array_equal(frames.flu_to_frd(frames.frd_to_flu(vector)), vector)


@given(VECTORS, ANGLES)
def test_heading_round_trips(vector: np.ndarray, heading: float) -> None:
    assert frames.wrap(frames.heading_from_yaw(frames.yaw_from_heading(heading)) - heading) == pytest.approx(
        0.0, abs=1e-9
    )
    quaternion = frames.quaternion_from_heading(heading)
    assert frames.wrap(frames.heading_from_quaternion(*quaternion) - heading) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(frames.from_level_body(frames.level_body(vector, heading), heading), vector, atol=1e-8)


@given(VECTORS, ORIGINS)
def test_geodetic_round_trip(point: np.ndarray, origin: frames.Origin) -> None:
    back = frames.geodetic_to_enu(*frames.enu_to_geodetic(point, origin), origin)
    np.testing.assert_allclose(back, point, atol=1e-5)
