"""Updates of a round: never overconfident, as printed where the formulas exist, and what planners predict."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.jlatt import (
    GRID,
    Detection,
    Placed,
    predicted_robot_cov,
    predicted_target_cov,
    robot_update,
    target_correction,
    target_update,
)
from agent.estimation.motion import (
    CONSTANT_VELOCITY,
    CONSTANT_VELOCITY_3D,
    SPATIAL,
    UNICYCLE,
    UNICYCLE_GAINS,
    StateLayout,
)
from agent.estimation.observation import RelativeModel
from agent.estimation.track_start import seen_place
from agent.settings import RoundWeights
from network.messages import NO_MOUNT
from tests.agent.estimation.correlations import least_gap, random_covariance, random_joint

Array = NDArray[np.float64]

RULES: tuple[RoundWeights, ...] = ("split_ci", "trace", "logdet", "info", "pinv_guard")
GUARDED: tuple[RoundWeights, ...] = ("split_ci", "trace", "pinv_guard")
SEED = st.integers(0, 2**32 - 1)
MOUNT = (0.3, -0.1, 0.2, 0.02, 0.15, 0.7)
NOISE = np.diag([0.3**2, math.radians(1.0) ** 2])
SIGHT = RelativeModel("range_bearing", UNICYCLE)


# -- a robot -------------------------------------------------------------------------------------------------


def scene(rng: np.random.Generator, m: int) -> tuple[Array, Array, list[Detection]]:
    """A robot that sees m others, of kinds that tell one or two numbers, from 3 to 12 m."""
    mean, cov = np.array([*rng.normal(size=2), rng.uniform(-3.0, 3.0)]), 0.1 * random_covariance(rng, 3)
    detections = []
    for _ in range(m):
        kind = str(rng.choice(["range_bearing", "range", "bearing", "vector"]))
        subject = [UNICYCLE, CONSTANT_VELOCITY][int(rng.integers(2))]
        model = RelativeModel(kind, UNICYCLE, MOUNT if rng.uniform() < 0.5 else NO_MOUNT, subject=subject)
        other = rng.normal(size=subject.dim)
        angle = rng.uniform(-3.0, 3.0)
        other[:2] = mean[:2] + rng.uniform(3.0, 12.0) * np.array([math.cos(angle), math.sin(angle)])
        predicted = model.h(np.concatenate([mean, other]))
        R = random_covariance(rng, len(predicted), 10.0 ** rng.uniform(-4.0, -1.0))
        z = wrap_components(predicted + 0.1 * rng.normal(size=len(predicted)), model.angles)
        detections.append(Detection(model, z, R, other, random_covariance(rng, subject.dim, 0.05)))
    return mean, cov, detections


def derivatives(mean: Array, item: Detection) -> tuple[Array, Array, Array]:
    """H by the own state, H by the other's, and the innovation."""
    joint = np.concatenate([mean, item.mean])
    H = item.model.jacobian(joint)
    return H[:, :3], H[:, 3:], wrap_components(item.z - item.model.h(joint), item.model.angles)


def gains(mean: Array, cov: Array, detections: list[Detection], rule: RoundWeights) -> list[Array]:
    """How the updated mean follows each measurement: differences, for the update is linear in them."""
    step, found = 1e-3, []
    for index, item in enumerate(detections):
        columns = []
        for unit in np.eye(len(item.z)):
            ends = []
            for sign in (1.0, -1.0):
                changed = list(detections)
                changed[index] = replace(item, z=item.z + sign * step * unit)
                ends.append(robot_update(mean, cov, (2,), changed, rule)[0])
            columns.append(wrap_components(ends[0] - ends[1], (2,)) / (2.0 * step))
        found.append(np.column_stack(columns))
    return found


@pytest.mark.parametrize("rule", RULES)
@given(SEED, st.integers(1, 4))
@settings(max_examples=20)
def test_a_robots_covariance_bounds_the_true_one(rule: RoundWeights, seed: int, m: int) -> None:
    """Whatever the correlation of all beliefs; the noise of sensors is its own, and so are beliefs said to be."""
    rng = np.random.default_rng(seed)
    mean, cov, detections = scene(rng, m)
    detections = [replace(item, dependent=bool(rng.uniform() < 0.8)) for item in detections]
    _, claimed = robot_update(mean, cov, (2,), detections, rule)
    joint = random_joint(rng, [cov, *(item.cov for item in detections if item.dependent)])
    left, rest, mix = np.eye(3), np.zeros((3, 3)), []
    for item, K in zip(detections, gains(mean, cov, detections, rule)):
        own, other, _ = derivatives(mean, item)
        left = left - K @ own
        rest = rest + K @ item.R @ K.T
        if item.dependent:
            mix.append(-K @ other)
        else:
            rest = rest + K @ other @ item.cov @ other.T @ K.T
    whole = np.hstack([left, *mix])
    assert least_gap(claimed, whole @ joint @ whole.T + rest) > -1e-6, seed


@pytest.mark.parametrize("rule", GUARDED)
@given(SEED, st.integers(0, 5))
@settings(max_examples=20)
def test_a_robot_never_grows_less_sure(rule: RoundWeights, seed: int, m: int) -> None:
    mean, cov, detections = scene(np.random.default_rng(seed), m)
    assert np.trace(robot_update(mean, cov, (2,), detections, rule)[1]) <= np.trace(cov), seed


@pytest.mark.parametrize("rule", ["info", "pinv_guard"])
@given(SEED)
@settings(max_examples=20)
def test_a_robot_is_corrected_as_printed(rule: RoundWeights, seed: int) -> None:
    """Eq. 2.8-2.11 as they stand, for two detections of two numbers each, whose S has an inverse."""
    rng = np.random.default_rng(seed)
    mean, cov, _ = scene(rng, 0)
    mean[2] = 0.3
    detections = []
    for angle in (0.2, 1.9):
        other = np.array([*(mean[:2] + 5.0 * np.array([math.cos(angle), math.sin(angle)])), 0.0])
        z = SIGHT.h(np.concatenate([mean, other])) + np.array([0.2, 0.02]) * rng.normal(size=2)
        detections.append(Detection(SIGHT, z, NOISE, other, random_covariance(rng, 3, 0.1)))
    s, y, size = [], [], []
    for item in detections:
        own, other, nu = derivatives(mean, item)
        noise = np.linalg.inv(item.R + other @ item.cov @ other.T)
        s.append(own.T @ noise @ own)
        y.append(own.T @ noise @ (nu + own @ mean))
        size.append(1.0 / np.trace(s[-1]) if rule == "info" else np.trace(np.linalg.pinv(s[-1], rcond=1e-9)))
    eta = (1.0 / np.array(size)) / np.sum(1.0 / np.array(size))
    S = eta[0] * s[0] + eta[1] * s[1]
    checked = np.linalg.inv(S) @ (eta[0] * y[0] + eta[1] * y[1])
    sizes = [np.trace(np.linalg.inv(S)), np.trace(cov)]
    if rule == "info":
        sizes = [1.0 / np.trace(S), 1.0 / np.trace(np.linalg.inv(cov))]
    zeta = (1.0 / np.array(sizes)) / np.sum(1.0 / np.array(sizes))
    expected = np.linalg.inv(zeta[0] * S + zeta[1] * np.linalg.inv(cov))
    expected_mean = expected @ (zeta[0] * S @ checked + zeta[1] * np.linalg.inv(cov) @ mean)
    if rule == "pinv_guard" and np.trace(expected) >= np.trace(cov):
        expected, expected_mean = cov, mean
    found = robot_update(mean, cov, (2,), detections, rule)
    assert np.allclose(found[1], expected, rtol=1e-6, atol=1e-10), seed
    assert np.allclose(found[0], expected_mean, atol=1e-7), seed


@given(SEED)
@settings(max_examples=30)
def test_a_split_intersection_is_the_best_of_its_grid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, detections = scene(rng, 2)
    found_mean, found = robot_update(mean, cov, (2,), detections, "split_ci")
    expected, moved = cov, np.zeros(3)
    for item in detections:
        H, other, nu = derivatives(mean, item)
        candidates = [(float(np.trace(expected)), expected, np.zeros((3, len(nu))))]
        for w in GRID:
            P1 = expected / w
            K = P1 @ H.T @ np.linalg.inv(H @ P1 @ H.T + item.R + other @ item.cov @ other.T / (1.0 - w))
            new = (np.eye(3) - K @ H) @ P1
            candidates.append((float(np.trace(new)), new, K))
        _, expected, K = min(candidates, key=lambda candidate: candidate[0])
        moved = moved + K @ (nu - H @ moved)
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-12), seed
    assert np.allclose(wrap_components(found_mean - mean - moved, (2,)), 0.0, atol=1e-9), seed


def test_a_finer_grid_would_hardly_do_better() -> None:
    rng, worst = np.random.default_rng(3), 0.0
    for _ in range(100):
        mean, cov, (item,) = scene(rng, 1)
        H, other, _ = derivatives(mean, item)
        fine = np.linspace(0.001, 0.999, 999)[:, None, None]
        S = H @ cov @ H.T / fine + other @ item.cov @ other.T / (1.0 - fine) + item.R
        best = np.trace(cov / fine - cov @ H.T @ np.linalg.inv(S) @ H @ cov / fine**2, axis1=1, axis2=2).min()
        found = np.trace(robot_update(mean, cov, (2,), [item], "split_ci")[1])
        worst = max(worst, found / min(best, np.trace(cov)) - 1.0)
    assert worst < 0.035, "seed 3"


@given(SEED)
@settings(max_examples=20)
def test_of_independent_beliefs_a_split_intersection_is_a_kalman_filter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, detections = scene(rng, 3)
    kalman = KalmanFilter(dim_x=3, dim_z=1)
    kalman.x, kalman.P = np.zeros(3), cov.copy()
    for item in detections:
        own, other, nu = derivatives(mean, item)
        kalman.dim_z = len(nu)
        kalman.update(nu, R=item.R + other @ item.cov @ other.T, H=own)
    independent = [replace(item, dependent=False) for item in detections]
    found = robot_update(mean, cov, (2,), independent, "split_ci")
    assert np.allclose(wrap_components(found[0] - mean - kalman.x, (2,)), 0.0, atol=1e-8), seed
    assert np.allclose(found[1], kalman.P, rtol=1e-7, atol=1e-10), seed


@pytest.mark.parametrize("rule", RULES)
def test_a_heading_is_corrected_across_the_half_turn(rule: RoundWeights) -> None:
    """A surely known body straight behind is seen 0.1 rad to the other side of where it was to be seen."""
    mean, cov = np.array([0.0, 0.0, 3.1]), np.diag([1e-6, 1e-6, 0.04])
    place = np.array([5.0 * math.cos(0.0), 5.0 * math.sin(0.0), 0.0])
    z = np.array([5.0, float(wrap(np.asarray(-3.2)))])
    item = Detection(SIGHT, z, np.diag([1e-4, 1e-6]), place, 1e-8 * np.eye(3), dependent=False)
    found, _ = robot_update(mean, cov, (2,), [item], rule)
    assert float(wrap(found[2] - 3.1)) > 0.0
    if rule == "split_ci":
        assert abs(float(wrap(found[2] - 3.2))) < 1e-3
    assert -math.pi < found[2] <= math.pi


@pytest.mark.parametrize("rule", RULES)
def test_nothing_seen_changes_nothing(rule: RoundWeights) -> None:
    mean, cov = np.array([1.0, 2.0, 3.0]), np.diag([1.0, 2.0, 3.0])
    found = robot_update(mean, cov, (2,), [], rule)
    assert np.array_equal(found[0], mean)
    assert np.array_equal(found[1], cov)


@pytest.mark.parametrize("rule", RULES)
def test_a_landmark_corrects_a_robot(rule: RoundWeights) -> None:
    model = RelativeModel("range", UNICYCLE, landmark=(5.0, 0.0))
    mean, cov = np.array([0.0, 0.0, 0.0]), np.diag([4.0, 0.1, 0.01])
    item = Detection(model, np.array([4.0]), np.array([[0.01]]), np.zeros(0), np.zeros((0, 0)))
    found, _ = robot_update(mean, cov, (2,), [item], rule)
    if rule == "pinv_guard":
        # The range is so sure that all else would be forgotten.
        assert found[0] == 0.0
    else:
        assert 0.5 < found[0] < 1.1


def test_two_robots_that_correct_each_other_do_not_fool_themselves() -> None:
    """Their places relative to each other become known; where they are in the world does not."""
    cov = np.diag([1.0, 1.0, 0.01])
    beliefs = [(np.array([0.0, 0.0, 0.0]), cov), (np.array([5.0, 0.0, math.pi]), cov)]
    z = np.array([5.0, 0.0])
    for _ in range(50):
        beliefs = [
            robot_update(*own, (2,), [Detection(SIGHT, z, NOISE, *other)], "split_ci")
            for own, other in (beliefs, beliefs[::-1])
        ]
    for _, cov in beliefs:
        # The mean of two independent errors of variance 1 has 1/2; no correlation lets them be surer of it.
        assert cov[0, 0] > 0.5 and cov[1, 1] > 0.5


# -- where a target is ---------------------------------------------------------------------------------------

VIEWS = [
    (kind, observer, subject, mount, attitude)
    for kind in ("range_bearing", "vector")
    for observer, subject, mount, attitude in (
        (UNICYCLE, UNICYCLE, NO_MOUNT, (0.0, 0.0)),
        (UNICYCLE_GAINS, CONSTANT_VELOCITY, (0.3, -0.1, 0.0, 0.0, 0.0, 0.7), (0.0, 0.0)),
        (SPATIAL, CONSTANT_VELOCITY_3D, MOUNT, (0.05, -0.03)),
        (SPATIAL, CONSTANT_VELOCITY, MOUNT, (0.0, 0.0)),
    )
]


def own_belief(observer: StateLayout) -> tuple[Array, Array]:
    mean, sigma = np.zeros(observer.dim), np.full(observer.dim, 0.02)
    mean[:2], sigma[:2] = [1.0, -2.0], 0.2
    if observer.altitude is not None:
        mean[2], sigma[2] = 6.0, 0.1
    assert observer.heading is not None
    mean[observer.heading], sigma[observer.heading] = 2.9, 0.05
    mix = np.eye(observer.dim) + 0.3 * np.random.default_rng(1).normal(size=(observer.dim, observer.dim))
    return mean, np.outer(sigma, sigma) * (mix @ mix.T)


def seen_target(subject: StateLayout, own: Array, heading: int) -> Array:
    """A target 9 m ahead and a little to the left, across the half turn."""
    believed = np.zeros(subject.dim)
    believed[:2] = own[:2] + 9.0 * np.array([math.cos(own[heading] + 0.3), math.sin(own[heading] + 0.3)])
    if subject.altitude is not None:
        believed[2] = 1.5
    return believed


@pytest.mark.parametrize(("kind", "observer", "subject", "mount", "attitude"), VIEWS)
def test_a_place_and_its_parts_agree_with_drawn_errors(
    kind: str, observer: StateLayout, subject: StateLayout, mount: tuple[float, ...], attitude: tuple[float, float]
) -> None:
    model = RelativeModel(kind, observer, mount, None, subject, attitude)  # type: ignore[arg-type]
    assert observer.heading is not None
    mean, cov = own_belief(observer)
    target = seen_target(subject, mean, observer.heading)
    z, R = model.h(np.concatenate([mean, target])), np.diag([0.01, 0.0004])
    variance = 0.25 if subject.altitude is not None else 0.0
    # What else is believed of the place does not matter.
    believed = target.copy()
    believed[:2] += [3.0, -2.0]
    found = target_correction(model, mean, cov, believed, z, R, variance)
    assert found is not None
    assert np.allclose(found.place, target[:2], atol=1e-9)

    rng, draws = np.random.default_rng(5), 40_000
    own = mean + rng.normal(size=(draws, len(mean))) @ np.linalg.cholesky(cov).T
    noisy = z + rng.normal(size=(draws, 2)) @ np.linalg.cholesky(R).T
    height = np.full(draws, target[2] if subject.altitude is not None else 0.0)
    by_sensor = seen_place(model, np.broadcast_to(mean, own.shape), height, noisy)
    heights = height + math.sqrt(variance) * rng.normal(size=draws)
    by_pose = seen_place(model, own, heights, np.broadcast_to(z, (draws, 2)))
    for drawn, part in ((by_sensor, found.sensor), (by_pose, found.pose)):
        ratio = np.linalg.eigvals(np.linalg.solve(part, np.cov(drawn.T)))
        assert np.all(np.abs(ratio - 1.0) < 0.06), "seed 5"


@pytest.mark.parametrize(("kind", "observer", "subject", "mount", "attitude"), VIEWS)
def test_the_parts_are_those_of_finite_differences(
    kind: str, observer: StateLayout, subject: StateLayout, mount: tuple[float, ...], attitude: tuple[float, float]
) -> None:
    model = RelativeModel(kind, observer, mount, None, subject, attitude)  # type: ignore[arg-type]
    assert observer.heading is not None
    mean, cov = own_belief(observer)
    target = seen_target(subject, mean, observer.heading)
    z, R, step = model.h(np.concatenate([mean, target])), np.diag([0.01, 0.0004]), 1e-6
    found = target_correction(model, mean, cov, target, z, R)
    assert found is not None
    height = np.asarray(target[2] if subject.altitude is not None else 0.0)

    def slope(of_own: Array, of_z: Array) -> Array:
        ends = [seen_place(model, mean + s * step * of_own, height, z + s * step * of_z) for s in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))

    G = np.column_stack([slope(np.zeros(len(mean)), unit) for unit in np.eye(2)])
    J = np.column_stack([slope(unit, np.zeros(2)) for unit in np.eye(len(mean))])
    assert np.allclose(found.sensor, G @ R @ G.T, rtol=1e-6, atol=1e-10)
    assert np.allclose(found.pose, J @ cov @ J.T, rtol=1e-6, atol=1e-10)


@given(SEED)
@settings(max_examples=20)
def test_a_correction_linearized_at_the_belief_is_as_printed(seed: int) -> None:
    """Eq. 2.12: S = Ht^T (R + H P H^T)^-1 Ht and y = S m, with the innovation."""
    rng = np.random.default_rng(seed)
    mean, cov = np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]), random_covariance(rng, 3, 0.001)
    believed = np.array([*rng.uniform(3.0, 8.0, size=2), 0.0])
    H = SIGHT.jacobian(np.concatenate([mean, believed]))
    nu = np.array([0.5, 0.1]) * rng.normal(size=2)
    z = wrap_components(SIGHT.h(np.concatenate([mean, believed])) + nu, (1,))
    found = target_correction(SIGHT, mean, cov, believed, z, NOISE, exact=False)
    assert found is not None
    information = H[:, 3:5].T @ np.linalg.inv(NOISE + H[:, :3] @ cov @ H[:, :3].T) @ H[:, 3:5]
    pulled = H[:, 3:5].T @ np.linalg.inv(NOISE + H[:, :3] @ cov @ H[:, :3].T) @ (nu + H[:, 3:5] @ believed[:2])
    assert np.allclose(np.linalg.inv(found.sensor + found.pose), information), seed
    assert np.allclose(information @ found.place, pulled), seed


def test_a_conversion_does_not_depend_on_what_was_believed() -> None:
    """Five metres off and printed, the place is far from where it was measured; converted, it is there."""
    mean, cov, truth = np.zeros(3), np.diag([0.01, 0.01, 1e-4]), np.array([6.0, 0.0, 0.0])
    z, believed = SIGHT.h(np.concatenate([mean, truth])), np.array([6.0, 5.0, 0.0])
    exact = target_correction(SIGHT, mean, cov, believed, z, NOISE)
    printed = target_correction(SIGHT, mean, cov, believed, z, NOISE, exact=False)
    assert exact is not None and printed is not None
    assert np.allclose(exact.place, [6.0, 0.0])
    assert np.linalg.norm(printed.place - truth[:2]) > 0.5


@pytest.mark.parametrize("sigma", [0.21, 0.4, 0.8, 1.5])
def test_of_a_robot_that_hardly_knows_its_heading_the_place_is_a_ring(sigma: float) -> None:
    """The mean square error of drawn places, which lie on a ring, is nowhere more than claimed."""
    mean, cov, truth = np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.04, sigma**2]), np.array([8.0, -3.0, 0.0])
    z = SIGHT.h(np.concatenate([mean, truth]))
    found = target_correction(SIGHT, mean, cov, truth, z, NOISE)
    assert found is not None
    rng = np.random.default_rng(6)
    own = mean + rng.normal(size=(40_000, 3)) @ np.linalg.cholesky(cov).T
    errors = seen_place(SIGHT, own, np.zeros(len(own)), np.broadcast_to(z, (len(own), 2))) - truth[:2]
    assert least_gap(found.pose, errors.T @ errors / len(errors)) > -0.02, "seed 6"


def test_of_a_heading_that_is_known_the_place_is_linear() -> None:
    mean, truth = np.array([1.0, 2.0, 0.5]), np.array([8.0, -3.0, 0.0])
    z = SIGHT.h(np.concatenate([mean, truth]))
    found = target_correction(SIGHT, mean, np.diag([0.04, 0.04, 0.01]), truth, z, NOISE)
    assert found is not None
    arm = np.array([5.0, 7.0])
    assert np.allclose(found.pose, 0.04 * np.eye(2) + 0.01 * np.outer(arm, arm))


def test_what_does_not_tell_a_place_is_no_correction() -> None:
    mean, cov, believed = np.zeros(3), np.diag([0.01, 0.01, 1e-4]), np.array([6.0, 1.0, 0.0])
    for kind in ("range", "bearing", "bearing3", "pixel"):
        model = RelativeModel(kind, UNICYCLE)
        z = np.array([0.1] if kind in ("range", "bearing") else [0.1, 0.0])
        assert target_correction(model, mean, cov, believed, z, np.eye(len(z))) is None
    z = SIGHT.h(np.concatenate([mean, believed]))
    assert target_correction(SIGHT, mean, cov, believed, z, NOISE) is not None
    nameless = RelativeModel("range_bearing", CONSTANT_VELOCITY)
    assert target_correction(nameless, np.zeros(4), np.eye(4), believed, z, NOISE) is None
    # From 3 m above, what is 2 m away is nowhere at altitude 0; what is 3 m away is straight below.
    above, steep = np.array([0.0, 0.0, 3.0, 0.0]), RelativeModel("range_bearing", SPATIAL)
    for range_m in (2.0, 3.0):
        assert target_correction(steep, above, 0.01 * np.eye(4), believed, np.array([range_m, 0.0]), NOISE) is None


# -- a target ------------------------------------------------------------------------------------------------


def sightings(
    rng: np.random.Generator, n: int, others: int, m: int
) -> tuple[Array, Array, list[tuple[Array, Array]], list[Placed]]:
    """An own belief of a target (n,), (n, n), those of others, and m corrections."""
    mean, cov = 0.3 * rng.normal(size=n), random_covariance(rng, n)
    beliefs = [(mean + 0.3 * rng.normal(size=n), random_covariance(rng, n)) for _ in range(others)]
    placed = [
        Placed(mean[:2] + 0.3 * rng.normal(size=2), random_covariance(rng, 2, 0.05), random_covariance(rng, 2, 0.2))
        for _ in range(m)
    ]
    return mean, cov, beliefs, placed


@pytest.mark.parametrize("rule", RULES)
@given(SEED, st.sampled_from([3, 4]), st.integers(0, 3), st.integers(0, 3))
@settings(max_examples=20)
def test_a_targets_covariance_bounds_the_true_one(
    rule: RoundWeights, seed: int, n: int, others: int, m: int
) -> None:
    """Whatever the correlation of beliefs and of the corrections' pose parts, all of them with each other."""
    rng = np.random.default_rng(seed)
    mean, cov, beliefs, placed = sightings(rng, n, others, m)
    _, claimed = target_update(mean, cov, (), beliefs, placed, rule)
    joint = random_joint(rng, [cov, *(item for _, item in beliefs), *(item.pose for item in placed)])

    def updated(shifts: Array) -> Array:
        """The mean after all inputs were shifted; it is linear in them."""
        parts = np.split(shifts, np.cumsum([n, *([n] * others), *([2] * m)])[:-1])
        moved = [(item[0] + shift, item[1]) for item, shift in zip(beliefs, parts[1 : 1 + others])]
        found = [replace(item, place=item.place + shift) for item, shift in zip(placed, parts[1 + others :])]
        return target_update(mean + parts[0], cov, (), moved, found, rule)[0]

    start = updated(np.zeros(len(joint)))
    mix = np.column_stack([updated(unit) - start for unit in np.eye(len(joint))])
    truth = mix @ joint @ mix.T
    for index, item in enumerate(placed):
        K = mix[:, n * (1 + others) + 2 * index :][:, :2]
        truth = truth + K @ item.sensor @ K.T
    assert least_gap(claimed, truth) > -1e-6, seed


@pytest.mark.parametrize("rule", GUARDED)
@given(SEED, st.integers(0, 3), st.integers(0, 3))
@settings(max_examples=20)
def test_a_target_is_never_known_less_well(rule: RoundWeights, seed: int, others: int, m: int) -> None:
    mean, cov, beliefs, placed = sightings(np.random.default_rng(seed), 3, others, m)
    assert np.trace(target_update(mean, cov, (2,), beliefs, placed, rule)[1]) <= np.trace(cov), seed


@pytest.mark.parametrize("rule", ["info", "pinv_guard"])
@given(SEED)
@settings(max_examples=20)
def test_a_target_of_two_numbers_is_corrected_as_printed(rule: RoundWeights, seed: int) -> None:
    """Eq. 2.13-2.15 as they stand; for a state of x, y alone all inverses exist."""
    rng = np.random.default_rng(seed)
    mean, cov, beliefs, placed = sightings(rng, 2, 2, 3)

    def shares(covs: list[Array]) -> Array:
        sizes = [1.0 / np.trace(np.linalg.inv(item)) if rule == "info" else np.trace(item) for item in covs]
        return np.asarray((1.0 / np.array(sizes)) / np.sum(1.0 / np.array(sizes)))

    def together(means: list[Array], covs: list[Array]) -> tuple[Array, Array]:
        w = shares(covs)
        P = np.linalg.inv(sum(share * np.linalg.inv(item) for share, item in zip(w, covs)))
        return P @ sum(share * np.linalg.inv(item) @ x for share, x, item in zip(w, means, covs)), P

    def guarded(old: tuple[Array, Array], new: tuple[Array, Array]) -> tuple[Array, Array]:
        return old if rule == "pinv_guard" and np.trace(new[1]) >= np.trace(old[1]) else new

    prior = guarded((mean, cov), together([mean, *(x for x, _ in beliefs)], [cov, *(P for _, P in beliefs)]))
    checked = together([item.place for item in placed], [item.sensor + item.pose for item in placed])
    expected = guarded(prior, together([checked[0], prior[0]], [checked[1], prior[1]]))
    found = target_update(mean, cov, (), beliefs, placed, rule)
    assert np.allclose(found[0], expected[0]), seed
    assert np.allclose(found[1], expected[1]), seed


@pytest.mark.parametrize("rule", RULES)
def test_headings_of_neighbours_are_taken_on_the_own_side_of_the_half_turn(rule: RoundWeights) -> None:
    cov = np.diag([1.0, 1.0, 0.04])
    others = [(np.array([0.0, 0.0, -3.1]), cov), (np.array([0.0, 0.0, -3.12]), cov)]
    mean, _ = target_update(np.array([0.0, 0.0, 3.1]), cov, (2,), others, [], rule)
    # Equal covariances: either the mean of the three, or the own one, which is as good.
    assert abs(float(wrap(mean[2] - 3.1))) < 0.09
    assert abs(float(wrap(mean[2] - math.pi))) < 0.05


def test_a_correction_counts_as_new_once() -> None:
    """Told again, its sensor's noise counts as known to the belief: however often, the belief grows no surer by it."""
    mean, cov = np.zeros(2), np.eye(2)
    placed = Placed(np.array([0.3, -0.2]), 0.04 * np.eye(2), 0.01 * np.eye(2))
    once = target_update(mean, cov, (), [], [placed], "split_ci")
    used = placed.used()
    assert not used.sensor.any()
    assert np.allclose(used.pose, placed.sensor + placed.pose)
    again = once
    for _ in range(20):
        again = target_update(*again, (), [], [used], "split_ci")
    assert again[1][0, 0] >= 0.04
    naive = once
    for _ in range(20):
        naive = target_update(*naive, (), [], [placed], "split_ci")
    assert naive[1][0, 0] < 0.03


@pytest.mark.parametrize("rule", RULES)
def test_only_x_and_y_of_a_correction_count(rule: RoundWeights) -> None:
    mean, cov, _, placed = sightings(np.random.default_rng(4), 4, 0, 2)
    spatial = []
    for item in placed:
        sensor, pose = np.eye(3), np.eye(3)
        sensor[:2, :2], pose[:2, :2] = item.sensor, item.pose
        spatial.append(Placed(np.append(item.place, 7.0), sensor, pose))
    flat, deep = target_update(mean, cov, (), [], placed, rule), target_update(mean, cov, (), [], spatial, rule)
    assert np.array_equal(flat[0], deep[0])
    assert np.array_equal(flat[1], deep[1])


def test_a_neighbour_that_claims_to_know_all_is_an_error() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        target_update(np.zeros(3), np.eye(3), (2,), [(np.zeros(3), np.zeros((3, 3)))], [], "trace")


# -- predictions ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_predicted_covariances_of_a_robot_are_those_of_its_updates(rule: RoundWeights) -> None:
    """Candidates that see some of four others each, and one that sees nothing."""
    rng, c, m = np.random.default_rng(11), 8, 4
    covs, seen = np.array([random_covariance(rng, 3) for _ in range(c)]), rng.uniform(size=(c, m)) < 0.6
    seen[0] = False
    means = np.column_stack([rng.normal(size=(c, 2)), rng.uniform(-3.0, 3.0, size=c)])
    others = [(np.array([*rng.uniform(4.0, 9.0, size=2), 0.0]), random_covariance(rng, 3, 0.05)) for _ in range(m)]
    H, expected = np.zeros((c, m, 2, 5)), []
    for index in range(c):
        items = [Detection(SIGHT, SIGHT.h(np.concatenate([means[index], x])), NOISE, x, P) for x, P in others]
        for row, item in enumerate(items):
            H[index, row] = SIGHT.jacobian(np.concatenate([means[index], item.mean]))[:, :5]
        chosen = [item for item, there in zip(items, seen[index]) if there]
        expected.append(robot_update(means[index], covs[index], (2,), chosen, rule)[1])
    noise = np.broadcast_to(NOISE, (c, m, 2, 2))
    other = np.array([P[:2, :2] for _, P in others])
    other = H[..., 3:] @ other @ H[..., 3:].swapaxes(-1, -2)
    found = predicted_robot_cov(covs, H[..., :3], noise, other, seen, rule)
    scale = np.abs(np.array(expected)).max(axis=(1, 2), keepdims=True)
    assert np.abs((found - np.array(expected)) / scale).max() < 1e-10
    assert np.array_equal(found[0], covs[0])


@pytest.mark.parametrize("rule", ["split_ci", "trace", "logdet"])
def test_a_sight_may_be_predicted_as_a_place(rule: RoundWeights) -> None:
    """As range and bearing, or as the place of what is seen relative to the robot: the same information."""
    rng = np.random.default_rng(12)
    mean, cov = np.array([1.0, 2.0, 0.7]), random_covariance(rng, 3)
    other, P = np.array([6.0, 4.0, 0.0]), 0.2 * np.eye(3)
    H = SIGHT.jacobian(np.concatenate([mean, other]))
    G = np.linalg.inv(H[:, 3:5])
    one = np.ones((1, 1), dtype=bool)
    polar = predicted_robot_cov(
        cov[None], H[None, None, :, :3], NOISE[None, None], (H[:, 3:] @ P @ H[:, 3:].T)[None], one, rule
    )
    place = predicted_robot_cov(
        cov[None], (G @ H[:, :3])[None, None], (G @ NOISE @ G.T)[None, None], P[None, :2, :2], one, rule
    )
    assert np.allclose(polar, place, rtol=1e-9)


@pytest.mark.parametrize("rule", RULES)
def test_predicted_covariances_of_a_target_are_those_of_its_updates(rule: RoundWeights) -> None:
    rng, c, m = np.random.default_rng(13), 8, 4
    mean, cov, beliefs, placed = sightings(rng, 4, 3, c * m)
    seen = rng.uniform(size=(c, m)) < 0.6
    seen[0] = False
    sensor = np.array([item.sensor for item in placed]).reshape(c, m, 2, 2)
    pose = np.array([item.pose for item in placed]).reshape(c, m, 2, 2)
    for others in (beliefs, []):
        expected = np.array([
            target_update(mean, cov, (), others, [placed[m * i + j] for j in range(m) if seen[i, j]], rule)[1]
            for i in range(c)
        ])
        priors = np.array([cov, *(P for _, P in others)])
        found = predicted_target_cov(priors, sensor, pose, seen, rule)
        assert np.abs(found - expected).max() < 1e-13 * np.abs(expected).max()


@pytest.mark.parametrize("rule", RULES)
def test_without_corrections_candidates_are_alike(rule: RoundWeights) -> None:
    cov, none = np.diag([1.0, 2.0, 0.1]), np.zeros((5, 0), dtype=bool)
    found = predicted_target_cov(cov[None], np.zeros((5, 0, 2, 2)), np.zeros((5, 0, 2, 2)), none, rule)
    assert np.array_equal(found, np.broadcast_to(cov, (5, 3, 3)))
    H, noise, other = np.zeros((5, 0, 2, 3)), np.zeros((5, 0, 2, 2)), np.zeros((0, 2, 2))
    found = predicted_robot_cov(cov[None], H, noise, other, none, rule)
    assert np.array_equal(found, np.broadcast_to(cov, (5, 3, 3)))
