"""Observation models: derivatives with every lever arm, values known by hand, bearings at the half turn, cameras."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.motion import (
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    DAMPED_VELOCITY_3D,
    SPATIAL,
    UNICYCLE,
    UNICYCLE_GAINS,
    StateLayout,
)
from agent.estimation.mounting import planar_mount, rotation
from agent.estimation.observation import (
    MEASURED,
    RELATIVE_ANGLES,
    SPATIAL_KINDS,
    AbsoluteModel,
    Intrinsics,
    OutOfViewError,
    RelativeModel,
    absolute_components,
    absolute_model,
    relative_model,
    told,
)
from agent.estimation.unscented import observe
from agent.events import Observation
from network.messages import NO_MOUNT, Measurement, Mount
from network.wire_fields import MEASUREMENT_DIMS

Array = NDArray[np.float64]

METRE = st.floats(-30.0, 30.0)
HEADING = st.floats(-3.14, 3.14)
MOUNT = st.one_of(
    st.just(NO_MOUNT),
    st.builds(planar_mount, st.just(0.0), st.just(0.0), HEADING),
    st.builds(planar_mount, st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), HEADING),
)
ARM = st.floats(-1.0, 1.0)
TILT = st.floats(-1.2, 1.2)
MOUNT3 = st.one_of(st.just(NO_MOUNT), st.tuples(ARM, ARM, ARM, HEADING, st.floats(-1.57, 1.57), HEADING))
PLANAR_KINDS = sorted(set(RELATIVE_ANGLES) - set(SPATIAL_KINDS))
KIND = st.sampled_from(PLANAR_KINDS)
DOWN: Mount = (0.0, 0.0, 0.0, 0.0, math.pi / 2.0, 0.0)
"""A camera that looks straight down, the top of its image ahead."""


def central_difference(model: RelativeModel | AbsoluteModel, at: Array) -> Array:
    """(m, n), differences of angles wrapped."""
    columns = []
    for step in 1e-6 * np.eye(len(at)):
        columns.append(wrap_components(model.h(at + step) - model.h(at - step), model.angles) / 2e-6)
    return np.stack(columns, axis=-1)


@given(KIND, MOUNT, METRE, METRE, HEADING, METRE, METRE, st.sampled_from([0, 1, 2]))
def test_the_jacobian_of_a_relative_measurement_is_the_finite_difference(
    kind: str,
    mount: Mount,
    x: float,
    y: float,
    heading: float,
    east: float,
    north: float,
    rest: int,
) -> None:
    """Of a peer or target with `rest` more components, which it doesn't depend on."""
    model = RelativeModel(kind, UNICYCLE, mount)
    state = np.concatenate([[x, y, heading, east, north], np.full(rest, 0.7)])
    assume(float(RelativeModel("range", UNICYCLE, mount).h(state)[0]) > 0.5)
    found = model.jacobian(state)
    assert found.shape == (len(model.h(state)), 5 + rest)
    assert np.allclose(found, central_difference(model, state), atol=1e-6)
    assert not found[:, 5:].any()


@given(KIND, MOUNT, METRE, METRE, HEADING, METRE, METRE)
def test_a_landmark_is_a_subject_without_columns(
    kind: str, mount: Mount, x: float, y: float, heading: float, east: float, north: float
) -> None:
    observer, stacked = np.array([x, y, heading]), np.array([x, y, heading, east, north])
    fixed = RelativeModel(kind, UNICYCLE, mount, (east, north))
    free = RelativeModel(kind, UNICYCLE, mount)
    assume(float(RelativeModel("range", UNICYCLE, mount).h(stacked)[0]) > 0.5)
    assert np.allclose(fixed.h(observer), free.h(stacked))
    assert np.allclose(fixed.jacobian(observer), free.jacobian(stacked)[:, :3])
    assert np.allclose(fixed.jacobian(observer), central_difference(fixed, observer), atol=1e-6)


@given(MOUNT, METRE, METRE, HEADING, METRE, METRE, METRE, METRE, HEADING)
def test_what_is_seen_does_not_depend_on_the_frame(
    mount: Mount,
    x: float,
    y: float,
    heading: float,
    east: float,
    north: float,
    shift_x: float,
    shift_y: float,
    turn: float,
) -> None:
    model = RelativeModel("range_bearing", UNICYCLE, mount)
    here = np.array([x, y, heading, east, north])
    cos, sin = math.cos(turn), math.sin(turn)
    rotation, shift = np.array([[cos, -sin], [sin, cos]]), np.array([shift_x, shift_y])
    there = np.concatenate([rotation @ here[:2] + shift, [heading + turn], rotation @ here[3:] + shift])
    assume(float(model.h(here)[0]) > 0.5)
    difference = model.h(there) - model.h(here)
    assert abs(float(difference[0])) < 1e-9
    assert abs(float(wrap(difference[1]))) < 1e-9


@pytest.mark.parametrize(
    ("state", "mount", "distance", "bearing"),
    [
        ([0.0, 0.0, 0.0, 3.0, 4.0], planar_mount(0.0, 0.0, 0.0), 5.0, math.atan2(4.0, 3.0)),
        # Facing north, the subject due east is on the right.
        ([1.0, 1.0, math.pi / 2, 3.0, 1.0], planar_mount(0.0, 0.0, 0.0), 2.0, -math.pi / 2),
        # A sensor that is turned to the left sees the same subject further right.
        ([0.0, 0.0, 0.0, 2.0, 0.0], planar_mount(0.0, 0.0, math.pi / 2), 2.0, -math.pi / 2),
        # A lever arm one metre ahead of a robot facing north is one metre further north.
        ([0.0, 0.0, math.pi / 2, 0.0, 3.0], planar_mount(1.0, 0.0, 0.0), 2.0, 0.0),
        # And one metre to its left is one metre further west.
        ([0.0, 0.0, math.pi / 2, 0.0, 1.0], planar_mount(0.0, 1.0, 0.0), math.sqrt(2.0), -math.pi / 4),
        # Straight behind is the positive half turn.
        ([0.0, 0.0, 0.0, -2.0, 0.0], planar_mount(0.0, 0.0, 0.0), 2.0, math.pi),
    ],
)
def test_known_ranges_and_bearings(
    state: list[float], mount: Mount, distance: float, bearing: float
) -> None:
    at = np.array(state)
    assert np.allclose(RelativeModel("range_bearing", UNICYCLE, mount).h(at), [distance, bearing])
    assert np.allclose(RelativeModel("range", UNICYCLE, mount).h(at), [distance])
    assert np.allclose(RelativeModel("bearing", UNICYCLE, mount).h(at), [bearing])


def test_bearings_are_wrapped_whatever_the_heading() -> None:
    headings = np.linspace(-9.0, 9.0, 181)
    states = np.column_stack([np.zeros((181, 2)), headings, np.full(181, -4.0), np.full(181, 0.5)])
    bearings = RelativeModel("bearing", UNICYCLE, planar_mount(0.0, 0.0, 2.5)).h(states)
    assert bearings.shape == (181, 1)
    assert np.all(bearings > -math.pi)
    assert np.all(bearings <= math.pi)
    assert np.allclose(wrap(bearings[:, 0] + headings + 2.5), math.atan2(0.5, -4.0))


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.3, 0.1)])
def test_a_range_depends_on_the_heading_through_the_lever_arm_alone(x: float, y: float) -> None:
    jacobian = RelativeModel("range", UNICYCLE, planar_mount(x, y, 0.0)).jacobian(np.array([0.0, 0.0, 0.4, 5.0, 7.0]))
    assert bool(jacobian[0, 2]) == bool(x or y)


def test_a_range_needs_no_heading() -> None:
    """Of an observer whose third component is a velocity."""
    model, state = RelativeModel("range", CONSTANT_VELOCITY), np.array([0.0, 0.0, 9.0, 9.0, 3.0, 4.0, 0.0])
    assert np.allclose(model.h(state), [5.0])
    assert np.allclose(model.jacobian(state), [[-0.6, -0.8, 0.0, 0.0, 0.6, 0.8, 0.0]])


def test_derivatives_are_finite_at_the_sensor_itself() -> None:
    state = np.array([1.0, 2.0, 0.3, 1.0, 2.0])
    model = RelativeModel("range_bearing", UNICYCLE)
    assert np.all(np.isfinite(model.h(state)))
    assert np.all(np.isfinite(model.jacobian(state)))


def test_derivatives_of_many_states_are_those_of_each() -> None:
    rng = np.random.default_rng(2)
    states = rng.normal(size=(3, 2, 6)) * 4.0
    for kind in PLANAR_KINDS:
        for landmark in (None, (20.0, 3.0)):
            model = RelativeModel(kind, UNICYCLE, planar_mount(0.3, -0.2, 0.5), landmark)
            at = states if landmark is None else states[..., :3]
            batch = model.jacobian(at)
            for index in np.ndindex(3, 2):
                assert np.allclose(batch[index], model.jacobian(at[index]))
                assert np.allclose(model.h(at)[index], model.h(at[index]))


LAYOUTS = (UNICYCLE, UNICYCLE_GAINS, SPATIAL, CONSTANT_VELOCITY, DAMPED_VELOCITY_3D, CONSTANT_ACCELERATION)
ABSOLUTE = [("position", 2), ("position", 3), ("pose", 3), ("pose", 4), ("heading", 1), ("altitude", 1)]


@pytest.mark.parametrize(("kind", "size"), ABSOLUTE)
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_absolute_information_is_compared_with_what_of_it_a_state_has(
    kind: str, size: int, layout: StateLayout
) -> None:
    """Numbers 1, 2, ... stand for x, y, z, heading; the state holds those in its own places."""
    named = dict(zip("xyzh", (1.0, 2.0, 3.0, 0.4)))
    told_of = {"position": "xyz", "pose": "xyzh" if size == 4 else "xyh", "heading": "h", "altitude": "z"}[kind][:size]
    state = np.full(layout.dim, 9.0)
    state[list(layout.position)] = [named[name] for name in "xyz"[: len(layout.position)]]
    if layout.heading is not None:
        state[layout.heading] = named["h"]
    has = {"x", "y"} | ({"z"} if layout.altitude is not None else set())
    has |= {"h"} if layout.heading is not None else set()
    common = [name for name in told_of if name in has]
    z, R = np.array([named[name] + 0.1 for name in told_of]), np.diag(np.arange(1.0, size + 1.0))
    found = absolute_model(kind, layout, z, R)
    if not common:
        assert found is None
        with pytest.raises(ValueError, match=kind):
            AbsoluteModel(kind, layout, size)
        return
    assert found is not None
    model, kept, noise = found
    assert model.h(state).tolist() == [named[name] for name in common]
    assert np.allclose(kept - model.h(state), 0.1)
    assert np.diagonal(noise).tolist() == [told_of.index(name) + 1.0 for name in common]
    assert np.allclose(model.jacobian(state) @ state, model.h(state))
    assert model.jacobian(np.stack([state, state])).shape == (2, len(common), layout.dim)
    assert model.angles == tuple(row for row, name in enumerate(common) if name == "h")


def test_sizes_that_absolute_information_does_not_have_say_nothing() -> None:
    for kind, size in (("position", 4), ("pose", 2), ("heading", 2), ("altitude", 2), ("range", 1), ("", 0)):
        assert absolute_components(kind, SPATIAL, size) is None


@given(MOUNT, METRE, METRE, HEADING, METRE, METRE)
def test_a_vector_is_range_and_bearing_in_cartesian_form(
    mount: Mount, x: float, y: float, heading: float, east: float, north: float
) -> None:
    state = np.array([x, y, heading, east, north])
    distance, bearing = RelativeModel("range_bearing", UNICYCLE, mount).h(state)
    vector = RelativeModel("vector", UNICYCLE, mount).h(state)
    assert np.allclose(vector, [distance * math.cos(bearing), distance * math.sin(bearing)], atol=1e-9)


# --- in space ----------------------------------------------------------------------------------------------


def in_view(model: RelativeModel, state: Array) -> bool:
    """Whether the subject is far enough from where the measurement is undefined."""
    place = model._in_sensor(model._levelled(state, model._between(state)))
    if model.kind == "pixel":
        return bool(place[0] > 0.5)
    return math.hypot(place[0], place[1]) > 0.5


@given(
    st.sampled_from(sorted(RELATIVE_ANGLES)),
    st.sampled_from([(SPATIAL, SPATIAL), (SPATIAL, UNICYCLE), (UNICYCLE, SPATIAL), (SPATIAL, DAMPED_VELOCITY_3D)]),
    MOUNT3,
    st.tuples(TILT, TILT),
    st.lists(METRE, min_size=10, max_size=10),
)
def test_the_jacobian_in_space_is_the_finite_difference(
    kind: str,
    layouts: tuple[StateLayout, StateLayout],
    mount: Mount,
    attitude: tuple[float, float],
    numbers: list[float],
) -> None:
    observer, subject = layouts
    state = np.array(numbers[: observer.dim + subject.dim])
    camera = Intrinsics() if kind == "pixel" else None
    model = RelativeModel(kind, observer, mount, None, subject, attitude, camera)
    assume(in_view(model, state))
    found, expected = model.jacobian(state), central_difference(model, state)
    assert found.shape == (MEASUREMENT_DIMS[kind], len(state))
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-4 * max(1.0, np.abs(expected).max()))
    landmark = tuple(state[observer.dim + i] for i in subject.position)
    fixed = RelativeModel(kind, observer, mount, landmark, attitude=attitude, intrinsics=camera)
    assert np.allclose(fixed.h(state[: observer.dim]), model.h(state))
    assert np.allclose(fixed.jacobian(state[: observer.dim]), found[:, : observer.dim])


@given(st.sampled_from(PLANAR_KINDS), MOUNT, st.lists(METRE, min_size=5, max_size=5))
def test_in_a_common_plane_space_is_the_plane(kind: str, mount: Mount, numbers: list[float]) -> None:
    x, y, heading, east, north = numbers
    flat, high = np.array(numbers), np.array([x, y, 7.0, heading, east, north, 7.0, 0.3])
    planar, spatial = RelativeModel(kind, UNICYCLE, mount), RelativeModel(kind, SPATIAL, mount, subject=SPATIAL)
    assume(float(RelativeModel("range", UNICYCLE, mount).h(flat)[0]) > 0.5)
    assert np.allclose(spatial.h(high), planar.h(flat))
    found, columns = spatial.jacobian(high), [0, 1, 3, 4, 5]
    assert np.allclose(found[:, columns], planar.jacobian(flat))
    assert np.allclose(found[:, [2, 6]], 0.0, atol=1e-9)


def test_what_is_planar_lies_on_the_ground() -> None:
    drone, rover = np.array([0.0, 0.0, 12.0, 0.3]), np.array([3.0, 4.0, 1.0])
    assert RelativeModel("range", SPATIAL).h(np.append(drone, rover)) == pytest.approx(13.0)
    assert RelativeModel("range", UNICYCLE, subject=SPATIAL).h(np.append(rover, drone)) == pytest.approx(13.0)
    assert RelativeModel("range", UNICYCLE, landmark=(0.0, 0.0, 12.0)).h(rover) == pytest.approx(13.0)
    assert RelativeModel("range", SPATIAL, landmark=(3.0, 4.0)).h(drone) == pytest.approx(13.0)
    assert RelativeModel("range", UNICYCLE, landmark=(0.0, 0.0)).h(rover) == pytest.approx(5.0)


def test_altitudes_of_lever_arms_count_in_space_alone() -> None:
    """Two rovers with their tags on masts of one height are as far apart as on the ground."""
    mast: Mount = (0.0, 0.0, 2.0, 0.0, 0.0, 0.0)
    assert RelativeModel("range", UNICYCLE, mast).h(np.array([0.0, 0.0, 0.0, 3.0, 4.0])) == pytest.approx(5.0)
    assert RelativeModel("range", UNICYCLE, mast, (0.0, 0.0, 2.0)).h(np.array([3.0, 4.0, 0.0])) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("subject", "azimuth", "elevation"),
    [
        ((10.0, 0.0, 5.0), 0.0, 0.0),
        ((0.0, 10.0, 15.0), math.pi / 2, math.pi / 4),
        ((-10.0, 0.0, -5.0), math.pi, -math.pi / 4),
        ((0.0, -1.0, 5.0 + math.sqrt(3.0)), -math.pi / 2, math.pi / 3),
    ],
)
def test_known_directions(subject: tuple[float, float, float], azimuth: float, elevation: float) -> None:
    state = np.array([0.0, 0.0, 5.0, 0.0])
    assert np.allclose(RelativeModel("bearing3", SPATIAL, landmark=subject).h(state), [azimuth, elevation])
    turned = RelativeModel("bearing3", SPATIAL, planar_mount(0.0, 0.0, 0.4), subject).h(state)
    assert np.allclose([wrap(turned[0] + 0.4 - azimuth), turned[1] - elevation], 0.0, atol=1e-12)


def test_a_nose_that_is_down_sees_the_horizon_above() -> None:
    """Pitch 0.2 rad nose down, then 0.1 rad with the right side down, seen straight ahead and to the left."""
    state = np.array([0.0, 0.0, 0.0, 0.0])
    ahead, left = (5.0, 0.0, 0.0), (0.0, 5.0, 0.0)
    assert np.allclose(RelativeModel("bearing3", SPATIAL, landmark=ahead, attitude=(0.0, 0.2)).h(state), [0.0, 0.2])
    seen = RelativeModel("bearing3", SPATIAL, landmark=left, attitude=(0.1, 0.0)).h(state)
    assert np.allclose(seen, [math.pi / 2, -0.1])


@pytest.mark.parametrize(
    ("heading", "place", "pixel"),
    [
        # Straight below is the middle of the image.
        (0.7, (0.0, 0.0), (320.0, 240.0)),
        # Facing east: what lies east is at the top, what lies south at the right; 500 px x 3 m / 15 m.
        (0.0, (3.0, 0.0), (320.0, 140.0)),
        (0.0, (0.0, -3.0), (420.0, 240.0)),
        # Facing north.
        (math.pi / 2, (3.0, 0.0), (420.0, 240.0)),
    ],
)
def test_known_pixels_of_a_camera_that_looks_down(
    heading: float, place: tuple[float, float], pixel: tuple[float, float]
) -> None:
    state = np.array([1.0, 2.0, 15.0, heading, 1.0 + place[0], 2.0 + place[1], 0.0])
    model = RelativeModel("pixel", SPATIAL, DOWN, intrinsics=Intrinsics())
    assert np.allclose(model.h(state), pixel)
    plane, noise = Intrinsics().normalized(np.array(pixel), np.diag([25.0, 25.0]))
    assert np.allclose(RelativeModel("pixel", SPATIAL, DOWN).h(state), plane)
    assert np.allclose(noise, np.eye(2) * 1e-4)


def test_a_pixel_is_that_of_the_published_camera() -> None:
    """UT-CLAT eq. 36 in the physical order: x_c = R_c R(theta) (x_t - x_i), z = d_f x_c[:2] / x_c[2].

    R(theta) turns ENU into the body, R_c the levelled body into a camera whose x is right, y backward, z down.
    """
    x_i, theta, x_t, d_f = np.array([-8.0, 11.0, 15.0]), 2.35, np.array([-12.0, 9.0, 0.5]), 500.0
    cos, sin = math.cos(theta), math.sin(theta)
    R_theta = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    R_c = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    x_c = R_c @ R_theta @ (x_t - x_i)
    state = np.concatenate([x_i, [theta], x_t, [0.0]])
    model = RelativeModel("pixel", SPATIAL, DOWN, subject=SPATIAL, intrinsics=Intrinsics(d_f, (0.0, 0.0)))
    assert np.allclose(model.h(state), d_f * x_c[:2] / x_c[2])


def test_an_image_ends_at_its_border() -> None:
    camera = Intrinsics()
    for pixel, inside in (((0.0, 480.0), True), ((640.0, 0.0), True), ((641.0, 5.0), False), ((5.0, -1.0), False)):
        assert camera.shows(np.array(pixel)) == inside


@pytest.mark.parametrize("altitude", [0.0, 0.05, -3.0])
@pytest.mark.parametrize("transform", ["unscented", "linearized", "jacobian"])
def test_what_is_behind_the_image_plane_has_no_pixel(altitude: float, transform: str) -> None:
    model = RelativeModel("pixel", SPATIAL, DOWN)
    state = np.array([0.0, 0.0, altitude, 0.0, 1.0, 1.0])
    with pytest.raises(OutOfViewError):
        model.h(state)
    with pytest.raises(OutOfViewError):
        observe(model.h, model.jacobian, state, np.eye(6) * 1e-6, (), transform)  # type: ignore[arg-type]


def test_a_belief_that_reaches_behind_the_image_plane_has_no_pixel() -> None:
    model, state = RelativeModel("pixel", SPATIAL, DOWN), np.array([0.0, 0.0, 3.0, 0.0, 1.0, 1.0])
    sure, vague = np.diag([0.01, 0.01, 0.01, 0.01, 0.01, 0.01]), np.diag([0.01, 0.01, 4.0, 0.01, 0.01, 0.01])
    assert np.all(np.isfinite(observe(model.h, model.jacobian, state, sure, ()).cov))
    with pytest.raises(OutOfViewError):
        observe(model.h, model.jacobian, state, vague, ())


@pytest.mark.parametrize("kind", ["range", "bearing", "bearing3", "range_bearing", "vector"])
@pytest.mark.parametrize("place", [(1.0, 2.0, 3.0), (1.0, 2.0, 9.0), (1.0, 2.0, -1.0)])
def test_derivatives_are_finite_at_the_sensor_and_straight_above_it(
    kind: str, place: tuple[float, float, float]
) -> None:
    model, state = RelativeModel(kind, SPATIAL, landmark=place), np.array([1.0, 2.0, 3.0, 0.3])
    assert np.all(np.isfinite(model.h(state)))
    assert np.all(np.isfinite(model.jacobian(state)))


def test_derivatives_of_many_states_in_space_are_those_of_each() -> None:
    states = np.random.default_rng(3).normal(size=(3, 2, 8)) * 3.0
    states[..., 2] += 40.0
    for kind in RELATIVE_ANGLES:
        model = RelativeModel(kind, SPATIAL, (0.3, -0.2, 0.1, 0.1, 1.4, 0.5), None, SPATIAL, (0.1, -0.2))
        batch, seen = model.jacobian(states), model.h(states)
        for index in np.ndindex(3, 2):
            assert np.allclose(batch[index], model.jacobian(states[index]))
            assert np.allclose(seen[index], model.h(states[index]))


def test_all_but_a_range_from_the_body_itself_needs_a_heading() -> None:
    state = np.zeros(8)
    with pytest.raises(ValueError, match="heading"):
        RelativeModel("bearing", CONSTANT_VELOCITY).h(state)
    with pytest.raises(ValueError, match="heading"):
        RelativeModel("range", CONSTANT_VELOCITY, planar_mount(0.1, 0.0, 0.0)).jacobian(state)


def test_every_kind_has_its_size_everywhere() -> None:
    assert set(RELATIVE_ANGLES) == set(MEASURED) == set(MEASUREMENT_DIMS)
    assert {kind: len(names) for kind, names in MEASURED.items()} == MEASUREMENT_DIMS


# --- mounts ------------------------------------------------------------------------------------------------


@given(
    st.one_of(MOUNT3, st.just(DOWN), st.just((0.1, 0.0, -0.1, 0.0, -math.pi / 2, 0.3))),
    st.tuples(TILT, TILT),
    st.sampled_from(sorted(RELATIVE_ANGLES)),
    st.lists(METRE, min_size=8, max_size=8),
)
def test_a_peer_is_told_of_a_sensor_on_a_level_body(
    mount: Mount, attitude: tuple[float, float], kind: str, numbers: list[float]
) -> None:
    size = MEASUREMENT_DIMS[kind]
    seen = Observation(5, 4, kind, "r2", np.ones(size), np.eye(size), "camera", mount, attitude)
    item, state = told(seen), np.array(numbers)
    own, others = relative_model(seen, SPATIAL, SPATIAL), relative_model(item, SPATIAL, SPATIAL)
    assume(in_view(own, state))
    assert isinstance(item, Measurement)
    difference = wrap_components(own.h(state) - others.h(state), own.angles)
    assert np.allclose(difference, 0.0, atol=1e-3 * max(1.0, np.abs(own.h(state)).max()))
    assert np.allclose(rotation(*attitude, 0.0) @ rotation(*mount[3:]), rotation(*item.mount[3:]), atol=1e-5)
