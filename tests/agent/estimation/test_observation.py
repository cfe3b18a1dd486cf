"""Observation models: derivatives with every lever arm, values known by hand, and bearings at the half turn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.motion import CONSTANT_VELOCITY, UNICYCLE, StateLayout
from agent.estimation.observation import ABSOLUTE, RELATIVE_ANGLES, AbsoluteModel, RelativeModel, planar_mount

Array = NDArray[np.float64]

METRE = st.floats(-30.0, 30.0)
HEADING = st.floats(-3.14, 3.14)
MOUNT = st.one_of(
    st.just((0.0, 0.0, 0.0)),
    st.tuples(st.just(0.0), st.just(0.0), HEADING),
    st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), HEADING),
)
PLANAR_KINDS = sorted(kind for kind in RELATIVE_ANGLES if kind not in ("pixel", "bearing3"))
KIND = st.sampled_from(PLANAR_KINDS)


def central_difference(model: RelativeModel | AbsoluteModel, at: Array) -> Array:
    """(m, n), differences of angles wrapped."""
    columns = []
    for step in 1e-6 * np.eye(len(at)):
        columns.append(wrap_components(model.h(at + step) - model.h(at - step), model.angles) / 2e-6)
    return np.stack(columns, axis=-1)


@given(KIND, MOUNT, METRE, METRE, HEADING, METRE, METRE, st.sampled_from([0, 1, 2]))
def test_the_jacobian_of_a_relative_measurement_is_the_finite_difference(
    kind: str,
    mount: tuple[float, float, float],
    x: float,
    y: float,
    heading: float,
    east: float,
    north: float,
    rest: int,
) -> None:
    """Of a peer or target with `rest` more components, which it doesn't depend on."""
    model = RelativeModel(kind, UNICYCLE, planar_mount(*mount))
    state = np.concatenate([[x, y, heading, east, north], np.full(rest, 0.7)])
    assume(float(RelativeModel("range", UNICYCLE, planar_mount(*mount)).h(state)[0]) > 0.5)
    found = model.jacobian(state)
    assert found.shape == (len(model.h(state)), 5 + rest)
    assert np.allclose(found, central_difference(model, state), atol=1e-6)
    assert not found[:, 5:].any()


@given(KIND, MOUNT, METRE, METRE, HEADING, METRE, METRE)
def test_a_landmark_is_a_subject_without_columns(
    kind: str, mount: tuple[float, float, float], x: float, y: float, heading: float, east: float, north: float
) -> None:
    observer, stacked = np.array([x, y, heading]), np.array([x, y, heading, east, north])
    fixed = RelativeModel(kind, UNICYCLE, planar_mount(*mount), (east, north))
    free = RelativeModel(kind, UNICYCLE, planar_mount(*mount))
    assume(float(RelativeModel("range", UNICYCLE, planar_mount(*mount)).h(stacked)[0]) > 0.5)
    assert np.allclose(fixed.h(observer), free.h(stacked))
    assert np.allclose(fixed.jacobian(observer), free.jacobian(stacked)[:, :3])
    assert np.allclose(fixed.jacobian(observer), central_difference(fixed, observer), atol=1e-6)


@given(MOUNT, METRE, METRE, HEADING, METRE, METRE, METRE, METRE, HEADING)
def test_what_is_seen_does_not_depend_on_the_frame(
    mount: tuple[float, float, float],
    x: float,
    y: float,
    heading: float,
    east: float,
    north: float,
    shift_x: float,
    shift_y: float,
    turn: float,
) -> None:
    model = RelativeModel("range_bearing", UNICYCLE, planar_mount(*mount))
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
        ([0.0, 0.0, 0.0, 3.0, 4.0], (0.0, 0.0, 0.0), 5.0, math.atan2(4.0, 3.0)),
        # Facing north, the subject due east is on the right.
        ([1.0, 1.0, math.pi / 2, 3.0, 1.0], (0.0, 0.0, 0.0), 2.0, -math.pi / 2),
        # A sensor that is turned to the left sees the same subject further right.
        ([0.0, 0.0, 0.0, 2.0, 0.0], (0.0, 0.0, math.pi / 2), 2.0, -math.pi / 2),
        # A lever arm one metre ahead of a robot facing north is one metre further north.
        ([0.0, 0.0, math.pi / 2, 0.0, 3.0], (1.0, 0.0, 0.0), 2.0, 0.0),
        # And one metre to its left is one metre further west.
        ([0.0, 0.0, math.pi / 2, 0.0, 1.0], (0.0, 1.0, 0.0), math.sqrt(2.0), -math.pi / 4),
        # Straight behind is the positive half turn.
        ([0.0, 0.0, 0.0, -2.0, 0.0], (0.0, 0.0, 0.0), 2.0, math.pi),
    ],
)
def test_known_ranges_and_bearings(
    state: list[float], mount: tuple[float, float, float], distance: float, bearing: float
) -> None:
    at = np.array(state)
    assert np.allclose(RelativeModel("range_bearing", UNICYCLE, planar_mount(*mount)).h(at), [distance, bearing])
    assert np.allclose(RelativeModel("range", UNICYCLE, planar_mount(*mount)).h(at), [distance])
    assert np.allclose(RelativeModel("bearing", UNICYCLE, planar_mount(*mount)).h(at), [bearing])


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


@pytest.mark.parametrize("kind", sorted(ABSOLUTE))
@pytest.mark.parametrize("dim", [3, 4])
def test_absolute_information_selects_components(kind: str, dim: int) -> None:
    components, angles = ABSOLUTE[kind]
    layout = StateLayout("pose and more", dim, (2,), 2)
    model, state = AbsoluteModel(kind, layout), np.array([5.0, -6.0, 0.7, 0.1])[:dim]
    assert model.h(state).tolist() == [state[index] for index in components]
    assert np.array_equal(model.jacobian(state), np.eye(dim)[list(components)])
    assert model.jacobian(np.stack([state, state])).shape == (2, len(components), dim)
    assert [components[index] for index in angles] == [index for index in components if index == 2]


@given(MOUNT, METRE, METRE, HEADING, METRE, METRE)
def test_a_vector_is_range_and_bearing_in_cartesian_form(
    mount: tuple[float, float, float], x: float, y: float, heading: float, east: float, north: float
) -> None:
    state = np.array([x, y, heading, east, north])
    distance, bearing = RelativeModel("range_bearing", UNICYCLE, planar_mount(*mount)).h(state)
    vector = RelativeModel("vector", UNICYCLE, planar_mount(*mount)).h(state)
    assert np.allclose(vector, [distance * math.cos(bearing), distance * math.sin(bearing)], atol=1e-9)
