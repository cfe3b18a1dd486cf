"""The three transforms: weights, exactness on linear functions, what sets them apart, batches, a public library."""

from __future__ import annotations

import math

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.gaussian import (
    gain,
    quadratic_form,
    square_root,
    symmetrize,
    wrap_components,
    wrap_scalar,
)
from agent.estimation.motion import UNICYCLE, compose
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import RELATIVE_ANGLES, AbsoluteModel, RelativeModel
from agent.estimation.unscented import (
    DEFAULT,
    Transform,
    UnscentedParameters,
    observe,
    sigma_points,
    weights,
)
from tests.agent.estimation.sigma_points import propagate

Array = NDArray[np.float64]

TRANSFORMS: tuple[Transform, ...] = ("unscented", "linearized", "jacobian")
PARAMETERS = st.builds(UnscentedParameters, st.floats(0.3, 1.5), st.floats(0.0, 2.0), st.floats(0.0, 3.0))
SEED = st.integers(0, 2**32 - 1)


def random_covariance(rng: np.random.Generator, *shape: int) -> Array:
    root = rng.normal(size=(*shape, shape[-1]))
    return np.asarray(root @ root.swapaxes(-1, -2) + 0.1 * np.eye(shape[-1]))


@given(st.integers(1, 8), PARAMETERS)
def test_the_points_reproduce_mean_and_covariance(n: int, parameters: UnscentedParameters) -> None:
    mean_weights, cov_weights, spread = weights(n, parameters)
    assert float(mean_weights.sum()) == pytest.approx(1.0)
    assert spread**2 == pytest.approx(parameters.alpha**2 * (n + parameters.kappa))
    assert float(cov_weights[0] - mean_weights[0]) == pytest.approx(1.0 - parameters.alpha**2 + parameters.beta)
    assert np.array_equal(cov_weights[1:], mean_weights[1:])
    rng = np.random.default_rng(n)
    mean, cov = rng.normal(size=n), random_covariance(rng, n)
    points = sigma_points(mean, square_root(cov), spread)
    assert points.shape == (2 * n + 1, n)
    assert np.allclose(mean_weights @ points, mean)
    assert np.allclose((points - mean).T * cov_weights @ (points - mean), cov)


@pytest.mark.parametrize("n", range(1, 9))
def test_the_default_covariance_weights_are_not_negative(n: int) -> None:
    assert weights(n, DEFAULT)[1].min() >= 0.0


def test_weights_are_shared_and_may_not_be_written() -> None:
    mean_weights, cov_weights, _ = weights(3, DEFAULT)
    for shared in (mean_weights, cov_weights):
        with pytest.raises(ValueError, match="read-only"):
            shared[0] = 1.0


@pytest.mark.parametrize("transform", TRANSFORMS)
@given(SEED, PARAMETERS)
def test_a_linear_measurement_is_predicted_as_by_a_kalman_filter(
    transform: Transform, seed: int, parameters: UnscentedParameters
) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, H, offset = rng.normal(size=4), random_covariance(rng, 4), rng.normal(size=(2, 4)), rng.normal(size=2)
    found = observe(lambda x: x @ H.T + offset, lambda x: H, mean, cov, (), transform, parameters)
    assert np.allclose(found.z, H @ mean + offset, atol=1e-9)
    assert np.allclose(found.cov, H @ cov @ H.T, atol=1e-9)
    assert np.allclose(found.cross, cov @ H.T, atol=1e-9)
    assert np.allclose(found.H, H, atol=1e-9)
    assert np.allclose(found.residual, 0.0, atol=1e-9)


@given(SEED, PARAMETERS)
def test_a_linear_motion_is_predicted_as_by_a_kalman_filter(seed: int, parameters: UnscentedParameters) -> None:
    """With noise of fewer dimensions than the state."""
    rng = np.random.default_rng(seed)
    mean, cov = rng.normal(size=3), random_covariance(rng, 3)
    F, G, Q = rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), random_covariance(rng, 2)
    found = propagate(lambda x, w: x @ F.T + w @ G.T, mean, cov, square_root(Q), (), parameters)
    assert np.allclose(found.mean, F @ mean, atol=1e-9)
    assert np.allclose(found.cov, F @ cov @ F.T + G @ Q @ G.T, atol=1e-9)
    assert np.allclose(found.F, F, atol=1e-9)


def test_the_transforms_differ_in_the_second_order_alone() -> None:
    """h(x) = x^2 at x ~ N(m, p): the unscented mean is m^2 + p, both others' is m^2."""
    mean, cov = np.array([1.5]), np.array([[0.2]])
    found = {name: observe(np.square, lambda x: 2.0 * x[..., None], mean, cov, (), name) for name in TRANSFORMS}
    assert float(found["unscented"].z[0]) == pytest.approx(1.5**2 + 0.2)
    for name in ("linearized", "jacobian"):
        assert float(found[name].z[0]) == pytest.approx(1.5**2)
        assert float(found[name].residual[0, 0]) == pytest.approx(0.0, abs=1e-12)
    for name in TRANSFORMS:
        assert float(found[name].cross[0, 0]) == pytest.approx(2.0 * 1.5 * 0.2)
    # With beta = 2 the fourth moment of a Gaussian is met: variance 4 m^2 p + 2 p^2.
    gaussian = observe(np.square, np.square, mean, cov, (), "unscented", UnscentedParameters(1.0, 2.0, 0.0))
    assert float(gaussian.cov[0, 0]) == pytest.approx(4.0 * 1.5**2 * 0.2 + 2.0 * 0.2**2)


@given(SEED, st.sampled_from(["range", "bearing", "range_bearing"]))
def test_the_residual_is_a_covariance_and_grows_with_the_belief(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    model = RelativeModel(kind, UNICYCLE, planar_mount(0.2, 0.1, 0.3))
    mean = np.concatenate([rng.uniform(-2.0, 2.0, size=3), rng.uniform(5.0, 9.0, size=2), [0.0]])
    cov = random_covariance(rng, 6) * 0.02
    found = observe(model.h, model.jacobian, mean, cov, model.angles)
    assert np.linalg.eigvalsh(found.residual).min() > -1e-12
    small = observe(model.h, model.jacobian, mean, cov * 0.01, model.angles)
    assert np.trace(small.residual) < np.trace(found.residual)


def test_headings_and_bearings_across_the_half_turn_average_to_it() -> None:
    turned = propagate(compose_noise, np.array([0.0, 0.0, 3.1]), np.diag([0.01, 0.01, 0.04]), np.zeros((3, 0)), (2,))
    assert float(turned.mean[2]) == pytest.approx(3.1 + 0.1 - 2.0 * math.pi)
    assert float(turned.cov[2, 2]) == pytest.approx(0.04)
    behind = RelativeModel("bearing", UNICYCLE, landmark=(-5.0, 0.0))
    found = observe(behind.h, behind.jacobian, np.zeros(3), np.diag([0.01, 0.2, 0.04]), behind.angles)
    assert abs(abs(float(found.z[0])) - math.pi) < 1e-6
    assert float(found.cov[0, 0]) == pytest.approx(0.04 + 0.2 / 25.0, rel=0.02)


def compose_noise(x: Array, w: Array) -> Array:
    """A step of 1 m and 0.1 rad; no noise."""
    return compose(x, np.array([1.0, 0.0, 0.1]))


def test_leading_axes_are_a_loop() -> None:
    rng = np.random.default_rng(6)
    means, covs = rng.normal(size=(2, 3, 3)), random_covariance(rng, 2, 3, 3) * 0.1
    Q = square_root(np.diag([0.01, 0.02, 0.03]))
    model = RelativeModel("range_bearing", UNICYCLE, planar_mount(0.2, -0.1, 0.4), (4.0, 9.0))

    def move(x: Array, w: Array) -> Array:
        return compose(x, np.array([0.5, 0.1, 0.3]) + w)

    moved = propagate(move, means, covs, np.broadcast_to(Q, (2, 3, 3, 3)), (2,))
    shared = propagate(move, means, covs, Q, (2,))
    for index in np.ndindex(2, 3):
        single = propagate(move, means[index], covs[index], Q, (2,))
        for batch in (moved, shared):
            assert np.allclose(batch.mean[index], single.mean, atol=1e-12)
            assert np.allclose(batch.cov[index], single.cov, atol=1e-12)
            assert np.allclose(batch.F[index], single.F, atol=1e-12)
    for transform in TRANSFORMS:
        seen = observe(model.h, model.jacobian, means, covs, model.angles, transform)
        for index in np.ndindex(2, 3):
            one = observe(model.h, model.jacobian, means[index], covs[index], model.angles, transform)
            for name in ("z", "cross", "cov", "H", "residual"):
                assert np.allclose(getattr(seen, name)[index], getattr(one, name), atol=1e-12), (transform, name)


def test_the_arguments_are_left_alone() -> None:
    mean, cov = np.array([0.0, 0.0, 3.1]), np.diag([0.01, 0.01, 0.04])
    model = RelativeModel("bearing", UNICYCLE, landmark=(-5.0, 0.0))
    propagate(compose_noise, mean, cov, np.zeros((3, 0)), (2,))
    for transform in TRANSFORMS:
        observe(model.h, model.jacobian, mean, cov, model.angles, transform)
    assert np.array_equal(mean, [0.0, 0.0, 3.1])
    assert np.array_equal(cov, np.diag([0.01, 0.01, 0.04]))


@pytest.mark.parametrize("parameters", [(1.0, 0.0, 0.0), (0.5, 2.0, 1.0)])
def test_fifty_steps_agree_with_a_public_filter(parameters: tuple[float, float, float]) -> None:
    """Range and bearing to a landmark ahead. filterpy reuses the predicted points; here, as there, they are redrawn."""
    rng = np.random.default_rng(17)
    alpha, beta, kappa = parameters
    model = RelativeModel("range_bearing", UNICYCLE, landmark=(40.0, 5.0))
    Q, R = np.diag([0.01, 0.01, 1e-4]), np.diag([0.04, 0.001])
    mean, cov = np.array([0.0, 0.0, 0.1]), np.diag([0.3, 0.2, 0.01])
    points = MerweScaledSigmaPoints(3, alpha, beta, kappa)
    step = np.zeros(3)
    library = UnscentedKalmanFilter(3, 2, 1.0, hx=model.h, fx=lambda x, dt: compose(x, step), points=points)
    library.x, library.P, library.Q, library.R = mean.copy(), cov.copy(), Q, R
    for k in range(50):
        step[:] = rng.uniform(0.0, 0.2), rng.normal() * 0.02, rng.normal() * 0.01
        # Additive noise, as the library has it, enters without points of its own.
        moved = propagate(
            lambda x, w: compose(x, step), mean, cov, np.zeros((3, 0)), (2,), UnscentedParameters(*parameters)
        )
        mean, cov = moved.mean, moved.cov + Q
        library.predict()
        assert np.abs(mean - library.x).max() < 1e-9, f"seed 17, prediction {k}"
        assert np.abs(cov - library.P).max() < 1e-9, f"seed 17, prediction {k}"
        library.sigmas_f = points.sigma_points(library.x, library.P)
        z = model.h(mean) + rng.normal(size=2) * np.array([0.2, 0.03])
        library.update(z)
        found = observe(model.h, model.jacobian, mean, cov, model.angles, "unscented", UnscentedParameters(*parameters))
        K = gain(found.cross, found.cov + R)
        mean, cov = mean + K @ (z - found.z), cov - K @ (found.cov + R) @ K.T
        assert np.abs(mean - library.x).max() < 1e-9, f"seed 17, update {k}"
        assert np.abs(cov - library.P).max() < 1e-9, f"seed 17, update {k}"


@pytest.mark.parametrize("kind", ["bearing", "range_bearing", "bearing3", "heading", "pose"])
@pytest.mark.parametrize("sigma_rad", [0.5, 2.0, 10.0])
def test_a_heading_that_is_hardly_known_does_not_make_a_place_known(kind: str, sigma_rad: float) -> None:
    """A turn of the own body looks like nothing else: the errors after an update are as large as it claims."""
    random = np.random.default_rng(20)
    cov = np.diag([0.4**2, 0.6**2, sigma_rad**2])
    landmark: tuple[float, ...] = (7.0, -3.0, 1.0) if kind == "bearing3" else (7.0, -3.0)
    relative = kind in RELATIVE_ANGLES
    model: RelativeModel | AbsoluteModel = (
        AbsoluteModel(kind, UNICYCLE) if not relative else RelativeModel(kind, UNICYCLE, landmark=landmark)
    )
    m = len(model.h(np.zeros(3)))
    R = 0.02**2 * np.eye(m)
    nees = []
    for _ in range(400):
        truth = np.array([1.0, 2.0, 0.7])
        mean = truth + np.sqrt(np.diagonal(cov)) * random.standard_normal(3)
        mean[2] = wrap_scalar(float(mean[2]))
        z = wrap_components(model.h(truth) + 0.02 * random.standard_normal(m), model.angles)
        seen = observe(model.h, model.jacobian, mean, cov, model.angles, turning=model.turning)
        S = seen.cov + R
        K = gain(seen.cross, S)
        after = mean + K @ wrap_components(z - seen.z, model.angles)
        P = symmetrize(cov - K @ S @ K.T)
        assert P[:2, :2].trace() <= cov[:2, :2].trace() + 1e-12
        nees.append(float(quadratic_form(wrap_components(truth - after, (2,)), P)) / 3.0)
    assert np.mean(nees) < 1.25
