"""On linear-Gaussian problems every transform is a Kalman filter; on others, a public library's."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from agent.estimation.colocalization import Options, absolute_update
from agent.estimation.motion import UNICYCLE, compose
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.unscented import DEFAULT, Transform, observe
from tests.agent.estimation.sigma_points import propagate

Array = NDArray[np.float64]

TRANSFORMS: tuple[Transform, ...] = ("unscented", "linearized", "jacobian")


class Linear:
    """h(x) = H x, as an observation model."""

    angles = ()
    turning = ()

    def __init__(self, H: Array) -> None:
        self.H = H

    def h(self, state: Array) -> Array:
        return np.asarray(state @ self.H.T)

    def jacobian(self, state: Array) -> Array:
        return np.broadcast_to(self.H, (*state.shape[:-1], *self.H.shape))


@pytest.mark.parametrize("transform", TRANSFORMS)
def test_a_linear_problem_gives_the_kalman_filter(transform: Transform) -> None:
    rng = np.random.default_rng(4)
    F = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.95]])
    noise_root = np.linalg.cholesky(np.diag([0.01, 0.02, 0.03]))
    H, R = rng.normal(size=(2, 3)), np.diag([0.2, 0.1])
    mean, cov = np.array([1.0, -1.0, 0.5]), np.eye(3)
    library = KalmanFilter(dim_x=3, dim_z=2)
    library.x, library.P, library.F, library.H = mean[:, None].copy(), cov.copy(), F, H
    library.Q, library.R = noise_root @ noise_root.T, R
    options = Options(transform, DEFAULT)
    layout = type(UNICYCLE)("linear", 3, (), None)
    for _ in range(100):
        moved = propagate(lambda x, w: x @ F.T + w, mean, cov, noise_root, ())
        assert np.allclose(moved.F, F, atol=1e-9)
        z = rng.normal(size=2)
        update = absolute_update(moved.mean, moved.cov, layout, Linear(H), z, R, options)  # type: ignore[arg-type]
        assert update is not None
        mean, cov = update.mean, update.cov
        library.predict()
        library.update(z[:, None])
        assert np.abs(mean - library.x[:, 0]).max() < 1e-9
        assert np.abs(cov - library.P).max() < 1e-9
        assert np.allclose(update.left, np.eye(3) - library.K @ H, atol=1e-9)


def test_the_unscented_update_is_the_librarys() -> None:
    """Range and bearing to a landmark, sigma points of the same spread and weights."""
    model = RelativeModel("range_bearing", UNICYCLE, landmark=(8.0, 3.0))
    mean, cov = np.array([1.0, 2.0, 0.3]), np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.02], [0.0, 0.02, 0.05]])
    R, z = np.diag([0.04, 0.01]), np.array([7.3, -0.2])
    points = MerweScaledSigmaPoints(3, alpha=1.0, beta=0.0, kappa=0.0)
    library = UnscentedKalmanFilter(3, 2, 1.0, hx=lambda x: model.h(x), fx=lambda x, dt: x, points=points)
    library.x, library.P, library.R, library.Q = mean.copy(), cov.copy(), R, np.zeros((3, 3))
    library.predict()
    library.update(z)
    update = absolute_update(mean, cov, UNICYCLE, model, z, R, Options("unscented", DEFAULT))
    assert update is not None
    assert np.abs(update.mean - library.x).max() < 1e-9
    assert np.abs(update.cov - library.P).max() < 1e-9


def test_the_unscented_prediction_is_the_librarys() -> None:
    mean, cov = np.array([1.0, 2.0, 0.3]), np.diag([0.5, 0.4, 0.05])
    step = np.array([0.8, 0.1, 0.2])
    points = MerweScaledSigmaPoints(3, alpha=1.0, beta=0.0, kappa=0.0)
    library = UnscentedKalmanFilter(3, 1, 1.0, hx=lambda x: x[:1], fx=lambda x, dt: compose(x, step), points=points)
    library.x, library.P, library.Q = mean.copy(), cov.copy(), np.zeros((3, 3))
    library.predict()
    ours = propagate(lambda x, w: compose(x, step), mean, cov, np.zeros((3, 0)), (2,))
    assert np.abs(ours.mean - library.x).max() < 1e-9
    assert np.abs(ours.cov - library.P).max() < 1e-9


def test_batches_equal_single_calls() -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(5, 3))
    roots = rng.normal(size=(5, 3, 3))
    covs = roots @ roots.swapaxes(-1, -2) * 0.05 + 0.01 * np.eye(3)
    model = RelativeModel("range_bearing", UNICYCLE, mount=planar_mount(0.2, -0.1, 0.4), landmark=(4.0, 9.0))
    for transform in TRANSFORMS:
        batch = observe(model.h, model.jacobian, means, covs, model.angles, transform)
        for k in range(5):
            single = observe(model.h, model.jacobian, means[k], covs[k], model.angles, transform)
            assert np.allclose(batch.z[k], single.z)
            assert np.allclose(batch.cov[k], single.cov)
            assert np.allclose(batch.cross[k], single.cross)
    pose = AbsoluteModel("pose", UNICYCLE)
    assert np.allclose(pose.h(means), means)


def test_the_unscented_residual_is_not_negative() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        root = rng.normal(size=(6, 6))
        model = RelativeModel(("range", "bearing", "range_bearing")[rng.integers(3)], UNICYCLE)
        mean = rng.normal(size=6) * 5
        predicted = observe(model.h, model.jacobian, mean, root @ root.T * 0.02 + np.eye(6) * 1e-3, model.angles)
        assert np.linalg.eigvalsh(predicted.residual).min() > -1e-12
