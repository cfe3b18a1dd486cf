"""The estimator's kernel against public libraries: one prediction and one range update of a planar pose.

Ours carries the correlation factors and identity lines of nine peers along, which the libraries do not have.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from agent.belief import CorrelationStack, Part, RobotState
from agent.estimation.colocalization import Options, absolute_update
from agent.estimation.motion import UNICYCLE, compose
from agent.estimation.observation import RelativeModel
from agent.estimation.unscented import DEFAULT
from agent.factor_model import moved
from agent.settings import AgentSettings, LocalizationSettings
from network.messages import NEVER

Array = NDArray[np.float64]
Step = Callable[[], object]

PEERS = 9
LANDMARK = (4.0, 3.0)
MEAN, COV = np.array([0.0, 0.0, 0.3]), np.diag([0.2, 0.3, 0.05])
DELTA, DELTA_COV = np.array([0.3, 0.0, 0.0, 0.05]), np.diag([1e-3, 1e-3, 1e-3, 1e-4])
Z, R = np.array([4.9]), np.array([[0.01]])
DT_NS = 100_000_000


def ours() -> Step:
    """Predict and update as the factor forms do it."""
    settings = AgentSettings("r1", 0, MEAN, COV, localization=LocalizationSettings(form="published"))
    blocks = {}
    for peer in range(PEERS):
        blocks[Part.FACTOR, f"p{peer}", NEVER] = 0.1 * np.eye(3)
        blocks[Part.BASE_LINE, f"p{peer}", NEVER] = np.eye(3)
    stack = CorrelationStack(np.zeros((3, 0))).changed(blocks)
    begin = RobotState(0, MEAN, COV, stack)
    model = RelativeModel("range", UNICYCLE, landmark=LANDMARK)
    options = Options("unscented", DEFAULT)

    def step() -> RobotState:
        state, _ = moved(settings, begin, DT_NS, DELTA, DELTA_COV)
        update = absolute_update(state.mean, state.cov, UNICYCLE, model, Z, R, options)
        assert update is not None
        return state.updated(update.mean, update.cov, update.left)

    return step


def filterpy() -> Step:
    """Plain UKF of filterpy of the same size."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    points = MerweScaledSigmaPoints(3, alpha=1.0, beta=0.0, kappa=0.0)
    increment = DELTA[[0, 1, 3]]
    ukf = UnscentedKalmanFilter(
        3,
        1,
        0.1,
        hx=lambda x: np.array([np.hypot(LANDMARK[0] - x[0], LANDMARK[1] - x[1])]),
        fx=lambda x, dt: compose(x, increment),
        points=points,
    )
    ukf.Q, ukf.R = DELTA_COV[np.ix_((0, 1, 3), (0, 1, 3))], R

    def step() -> object:
        ukf.x, ukf.P = MEAN.copy(), COV.copy()
        ukf.predict()
        ukf.update(Z)
        return ukf.x

    return step


def stone_soup() -> Step:
    """UKF predictor and updater of Stone Soup with the same models."""
    from datetime import datetime, timedelta

    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition.linear import (
        CombinedLinearGaussianTransitionModel,
        ConstantVelocity,
        RandomWalk,
    )
    from stonesoup.predictor.kalman import UnscentedKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import UnscentedKalmanUpdater

    begin = datetime(2026, 1, 1)
    end = begin + timedelta(seconds=0.1)
    # Three states as ours; a bearing comes with the range, which its measurement models do not separate in the plane.
    transition = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.01), RandomWalk(0.01)])
    measurement = CartesianToBearingRange(3, (0, 2), np.diag([0.01, 0.01]), translation_offset=np.zeros((2, 1)))
    predictor, updater = UnscentedKalmanPredictor(transition), UnscentedKalmanUpdater(measurement)

    def step() -> object:
        # Predictions are cached by their prior: equal numbers in a new object are worked out anew.
        prior = GaussianState([[4.0], [0.0], [3.0]], COV, timestamp=begin)
        detection = Detection(np.array([[0.6], [4.9]]), timestamp=end, measurement_model=measurement)
        prediction = predictor.predict(prior, timestamp=end)
        return updater.update(SingleHypothesis(prediction, detection))

    return step
