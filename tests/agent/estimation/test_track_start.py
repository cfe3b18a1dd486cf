"""A track that begins with one sighting: where the target is, and how sure that is, given the own pose's errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap_components
from agent.estimation.motion import (
    CONSTANT_VELOCITY,
    CONSTANT_VELOCITY_3D,
    SPATIAL,
    UNICYCLE,
    UNICYCLE_GAINS,
    StateLayout,
)
from agent.estimation.observation import NO_MOUNT, OutOfViewError, RelativeModel
from agent.estimation.track_start import MAX_HEADING_RAD, seen_place, start_track, start_vaguely

Array = NDArray[np.float64]

DOWN = (0.2, 0.1, -0.05, 0.05, 0.5, -0.2)
"""A camera that looks ahead and down."""
TILT = (0.06, -0.04)
R = {
    "range_bearing": np.diag([0.04, 0.0009]),
    "vector": np.diag([0.05, 0.03]),
    "bearing3": np.diag([0.0004, 0.0004]),
    "pixel": np.diag([0.0004, 0.0004]),
}
FLAT = [
    (kind, observer, CONSTANT_VELOCITY, mount, (0.0, 0.0))
    for kind in ("range_bearing", "vector")
    for observer in (UNICYCLE, UNICYCLE_GAINS)
    for mount in (NO_MOUNT, (0.3, -0.1, 0.0, 0.0, 0.0, 0.7))
]
IN_SPACE = [
    (kind, SPATIAL, subject, mount, attitude)
    for kind in R
    for subject in (UNICYCLE, SPATIAL, CONSTANT_VELOCITY_3D)
    for mount, attitude in ((DOWN, (0.0, 0.0)), (DOWN, TILT))
]


def rest(layout: StateLayout, altitude_m: float = 0.4) -> tuple[Array, Array]:
    """What is known of a target but its place: an altitude, and that it moves slowly or heads about east."""
    mean, cov = np.zeros(layout.dim), 0.09 * np.eye(layout.dim)
    if layout.altitude is not None:
        mean[layout.altitude] = altitude_m
        cov[layout.altitude, layout.altitude] = 0.01
    return mean, cov


def scene(rng: np.random.Generator, model: RelativeModel) -> tuple[Array, Array]:
    """True states of a robot and of a target ahead of it that its sensor sees."""
    while True:
        own = np.zeros(model.observer.dim)
        own[:2] = rng.uniform(-20.0, 20.0, 2)
        if model.observer.altitude is not None:
            own[2] = rng.uniform(4.0, 8.0)
        if model.observer is UNICYCLE_GAINS:
            own[3:] = 1.0
        assert model.observer.heading is not None
        own[model.observer.heading] = heading = rng.uniform(-np.pi, np.pi)
        ahead = heading + rng.uniform(-0.3, 0.3)
        target = rest(model.subject)[0]
        target[:2] = own[:2] + rng.uniform(5.0, 12.0) * np.array([np.cos(ahead), np.sin(ahead)])
        try:
            model.h(np.concatenate([own, target]))
        except OutOfViewError:
            continue
        return own, target


def model_of(case: tuple[Any, ...]) -> RelativeModel:
    kind, observer, subject, mount, attitude = case
    return RelativeModel(kind, observer, mount, subject=subject, attitude=attitude)


def name(case: tuple[Any, ...]) -> str:
    return f"{case[0]}-{case[1].name}-{case[2].name}-{'tilted' if any(case[4]) else case[3][0]}"


@pytest.mark.parametrize("case", FLAT + IN_SPACE, ids=name)
def test_the_place_is_where_the_measurement_would_be_made(case: tuple[Any, ...]) -> None:
    model, rng = model_of(case), np.random.default_rng(4)
    for _ in range(50):
        own, target = scene(rng, model)
        altitude = target[2] if model.subject.altitude is not None else 0.0
        place = seen_place(model, own, np.array(altitude), model.h(np.concatenate([own, target])))
        assert np.abs(place - target[:2]).max() < 1e-9


@pytest.mark.parametrize(
    ("kind", "z", "why"),
    [
        ("bearing3", [0.1, 0.8], "it looks above the horizon"),
        ("pixel", [0.0, -2.0], "it looks above the horizon"),
        ("range_bearing", [2.0, 0.1], "nothing as low is as near"),
    ],
)
def test_a_view_that_meets_nothing_of_that_altitude_tells_no_place(kind: str, z: list[float], why: str) -> None:
    model = RelativeModel(kind, SPATIAL, DOWN, subject=UNICYCLE)
    assert np.isnan(seen_place(model, np.array([1.0, 2.0, 6.0, 0.3]), np.array(0.0), np.array(z))).any(), why
    mean, cov = np.array([1.0, 2.0, 6.0, 0.3]), 1e-4 * np.eye(4)
    assert start_track(model, (mean, cov), rest(UNICYCLE), np.array(z), R[kind]) is None


@pytest.mark.parametrize("kind", ["bearing3", "pixel"])
def test_from_the_ground_a_direction_tells_no_place_on_the_ground(kind: str) -> None:
    model = RelativeModel(kind, UNICYCLE, subject=UNICYCLE)
    z = np.array([0.1, 0.0])
    assert start_track(model, (np.zeros(3), 1e-4 * np.eye(3)), rest(UNICYCLE), z, R[kind]) is None


@pytest.mark.parametrize("kind", ["range", "bearing"])
def test_one_number_tells_no_place(kind: str) -> None:
    model = RelativeModel(kind, UNICYCLE, subject=UNICYCLE)
    assert start_track(model, (np.zeros(3), 1e-4 * np.eye(3)), rest(UNICYCLE), np.ones(1), np.eye(1)) is None


def test_a_robot_that_does_not_know_its_heading_starts_nothing() -> None:
    model = RelativeModel("range_bearing", UNICYCLE, subject=CONSTANT_VELOCITY)
    z = np.array([8.0, 0.2])
    for sigma, found in ((0.99 * MAX_HEADING_RAD, True), (1.01 * MAX_HEADING_RAD, False)):
        own = np.zeros(3), np.diag([0.1, 0.1, sigma**2])
        assert (start_track(model, own, rest(CONSTANT_VELOCITY), z, R["range_bearing"]) is not None) is found


def test_a_grazing_view_starts_nothing() -> None:
    """The error of where a flat ray meets the ground is no Gaussian, however small that of its angle."""
    own = np.array([0.0, 0.0, 2.0, 0.0]), np.diag([0.01, 0.01, 0.04, 1e-4])
    model = RelativeModel("bearing3", SPATIAL, subject=UNICYCLE)
    steep = start_track(model, own, rest(UNICYCLE), np.array([0.0, -0.5]), R["bearing3"])
    flat = start_track(model, own, rest(UNICYCLE), np.array([0.0, -0.06]), R["bearing3"])
    assert steep is not None
    assert flat is None


@pytest.mark.parametrize("case", FLAT + IN_SPACE, ids=name)
def test_small_errors_enter_as_the_derivatives_say(case: tuple[Any, ...]) -> None:
    """By the implicit function theorem: what a change of the pose does to h, the place undoes."""
    model = model_of(case)
    own, target = scene(np.random.default_rng(2), model)
    joint = np.concatenate([own, target])
    n, z = len(own), model.h(joint)
    small = 1e-10 * np.eye(n)
    mean, cov = rest(model.subject)
    mean[2:] = target[2:]
    start = start_track(model, (own, small), (mean, 1e-6 * cov), z, 1e-6 * R[case[0]])
    assert start is not None
    H = model.jacobian(joint)
    by_place = np.linalg.inv(H[:, n : n + 2])
    assert start.G[:2] == pytest.approx(-by_place @ H[:, :n], abs=1e-4)
    assert not start.G[2:].any()
    assert start.measured[:2, :2] == pytest.approx(by_place @ (1e-6 * R[case[0]]) @ by_place.T, rel=1e-3, abs=1e-12)
    assert np.abs(start.mean - target).max() < 1e-4


def test_it_is_the_limit_of_a_filter_that_knew_nothing_of_the_place() -> None:
    """With the heading known everything is linear: the textbook update of an ever wider prior gives the same."""
    heading = 0.7
    own_mean, own_cov = np.array([1.0, 2.0, heading]), np.array([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 1e-14]])
    model = RelativeModel("vector", UNICYCLE, subject=CONSTANT_VELOCITY)
    mean, cov = rest(CONSTANT_VELOCITY)
    z = np.array([4.0, -1.5])
    start = start_track(model, (own_mean, own_cov), (mean, cov), z, R["vector"])
    assert start is not None
    wide = cov.copy()
    wide[0, 0] = wide[1, 1] = 1e7
    joint, state = np.zeros((7, 7)), np.concatenate([own_mean, mean])
    joint[:3, :3], joint[3:, 3:] = own_cov, wide
    H = model.jacobian(state)
    S = H @ joint @ H.T + R["vector"]
    K = np.linalg.solve(S, H @ joint).T
    state = state + K @ (z - model.h(state))
    joint = joint - K @ S @ K.T
    assert start.mean == pytest.approx(state[3:], abs=1e-5)
    assert start.cov(own_cov) == pytest.approx(joint[3:, 3:], abs=1e-5)
    assert start.G @ own_cov == pytest.approx(joint[3:, :3], abs=1e-5)


@pytest.mark.parametrize(
    ("case", "sigma_heading", "low", "high"),
    [
        (FLAT[0], 0.05, 0.93, 1.07),
        (FLAT[1], 0.3, 0.8, 1.07),
        (FLAT[6], 0.2, 0.85, 1.07),
        *((case, 0.05, 0.85, 1.1) for case in IN_SPACE if any(case[4])),
    ],
    ids=lambda item: name(item) if isinstance(item, tuple) else None,
)
def test_the_claimed_covariance_is_that_of_the_errors(
    case: tuple[Any, ...], sigma_heading: float, low: float, high: float
) -> None:
    """NEES per degree of freedom over 1500 draws of pose, target and measurement."""
    model, rng = model_of(case), np.random.default_rng(11)
    sigma = np.full(model.observer.dim, 0.3)
    sigma[model.observer.heading] = sigma_heading
    if model.observer is UNICYCLE_GAINS:
        sigma[3:] = 0.05
    cov = np.diag(sigma**2)
    total, count = 0.0, 0
    mean, prior = rest(model.subject)
    own, seen = scene(rng, model)
    while count < 1500:
        target = mean + np.sqrt(prior.diagonal()) * rng.standard_normal(len(mean))
        target[:2] = seen[:2]
        try:
            clean = model.h(np.concatenate([own, target]))
        except OutOfViewError:
            continue
        z = clean + np.sqrt(R[case[0]].diagonal()) * rng.standard_normal(2)
        believed = own + sigma * rng.standard_normal(len(own))
        start = start_track(model, (believed, cov), (mean, prior), z, R[case[0]])
        assert start is not None
        error = wrap_components(start.mean - target, model.subject.angles)
        total += float(error @ np.linalg.solve(start.cov(cov), error)) / len(error)
        count += 1
    assert low < total / count < high


# -- one number alone ----------------------------------------------------------------------------------------------

WITHIN_M = 12.0
ARM = (0.5, -0.3, 0.0, 0.0, 0.0, 0.7)


@pytest.mark.parametrize("mount", [NO_MOUNT, ARM], ids=["centred", "with a lever arm"])
@pytest.mark.parametrize("kind", ["bearing", "range"])
def test_a_vague_start_is_as_far_off_as_it_says(kind: str, mount: tuple[float, ...]) -> None:
    """Targets at all distances on the line of sight, or in all directions: second moments are what they are."""
    model, rng = RelativeModel(kind, UNICYCLE, mount, subject=CONSTANT_VELOCITY), np.random.default_rng(5)  # type: ignore[arg-type]
    sigma, deviation = np.array([0.3, 0.3, 0.05]), 0.05 if kind == "bearing" else 0.2
    mean, prior = rest(CONSTANT_VELOCITY)
    squares, claimed = np.zeros((4, 4)), np.zeros((4, 4))
    trials = 3000
    for _ in range(trials):
        own = np.array([2.0, -1.0, 0.8])
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, WITHIN_M)
        if kind == "bearing":
            angle = 0.3
        else:
            distance = 7.0
        cos, sin = np.cos(own[2]), np.sin(own[2])
        sensor = own[:2] + np.array([cos * mount[0] - sin * mount[1], sin * mount[0] + cos * mount[1]])
        target = mean + np.sqrt(prior.diagonal()) * rng.standard_normal(4)
        target[:2] = sensor + distance * np.array([np.cos(angle), np.sin(angle)])
        z = model.h(np.concatenate([own, target])) + deviation * rng.standard_normal(1)
        believed = own + sigma * rng.standard_normal(3)
        own_cov = np.diag(sigma**2)
        start = start_vaguely(model, (believed, own_cov), (mean, prior), z, np.array([[deviation**2]]), WITHIN_M)
        assert start is not None
        error = start.mean - target
        squares += np.outer(error, error) / trials
        claimed += start.cov(own_cov) / trials
    np.testing.assert_allclose(squares, claimed, atol=0.06 * claimed[0, 0])


@pytest.mark.parametrize("kind", ["bearing", "range"])
def test_what_is_open_is_common_to_all_who_see_the_target(kind: str) -> None:
    model = RelativeModel(kind, UNICYCLE, subject=UNICYCLE)
    own, tiny = (np.zeros(3), 1e-6 * np.eye(3)), np.array([[1e-6]])
    start = start_vaguely(model, own, rest(UNICYCLE), np.array([0.5]), tiny, WITHIN_M)
    assert start is not None
    assert np.trace(start.measured) < 1e-3
    expected = WITHIN_M**2 / 12.0 if kind == "bearing" else 0.25
    assert np.trace(start.common[:2, :2]) == pytest.approx(expected, rel=0.01)


def test_a_range_beyond_the_limit_and_what_tells_a_place_start_nothing_vague() -> None:
    own, one = (np.zeros(3), 1e-4 * np.eye(3)), np.array([[0.01]])
    ranged = RelativeModel("range", UNICYCLE, subject=UNICYCLE)
    assert start_vaguely(ranged, own, rest(UNICYCLE), np.array([12.1]), one, WITHIN_M) is None
    assert start_vaguely(ranged, own, rest(UNICYCLE), np.array([11.9]), one, WITHIN_M) is not None
    polar = RelativeModel("range_bearing", UNICYCLE, subject=UNICYCLE)
    assert start_vaguely(polar, own, rest(UNICYCLE), np.array([5.0, 0.1]), R["range_bearing"], WITHIN_M) is None
