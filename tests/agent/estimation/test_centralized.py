"""The centralized filter against a joint Kalman filter written out here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.centralized import CentralizedFilter
from agent.estimation.gaussian import wrap
from agent.estimation.motion import PLANAR_MOTION, UNICYCLE, TargetMotion
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import RelativeModel
from agent.estimation.unscented import Transform

Array = NDArray[np.float64]

ROBOTS = {
    "r1": (np.array([0.0, 0.0, 0.3]), np.diag([0.3, 0.2, 0.01]), PLANAR_MOTION),
    "r2": (np.array([6.0, 2.0, -1.0]), np.diag([0.4, 0.5, 0.02]), PLANAR_MOTION),
}
MOTION = TargetMotion(UNICYCLE, (0.1, 0.02), (0.05, 0.03), 1.0)
TARGETS = {"t1": (np.array([3.0, -4.0, 0.8]), np.diag([0.6, 0.6, 0.05]), MOTION)}
LANDMARKS = {"L1": (9.0, -2.0)}
START = {"r1": 0, "r2": 3, "t1": 6}
NOISE = np.diag([0.01, 0.02, 0.0, 0.001])


class JointFilter:
    """An EKF over nine states."""

    def __init__(self) -> None:
        everybody = [ROBOTS["r1"], ROBOTS["r2"], TARGETS["t1"]]
        self.x = np.concatenate([mean for mean, _, _ in everybody])
        self.P = np.zeros((9, 9))
        for index, (_, cov, _) in enumerate(everybody):
            self.P[3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = cov

    def move(self, name: str, step: Array, noise: Array) -> None:
        at = START[name]
        cos, sin = np.cos(self.x[at + 2]), np.sin(self.x[at + 2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        world = turn @ step
        F = np.eye(9)
        F[at, at + 2], F[at + 1, at + 2] = -world[1], world[0]
        self.x[at : at + 3] += world
        self.P = F @ self.P @ F.T
        self.P[at : at + 3, at : at + 3] += turn @ noise @ turn.T
        self.x[[2, 5, 8]] = wrap(self.x[[2, 5, 8]])

    def update(self, H: Array, innovation: Array, R: Array) -> None:
        K = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        self.x = self.x + K @ innovation
        self.P = (np.eye(9) - K @ H) @ self.P @ (np.eye(9) - K @ H).T + K @ R @ K.T
        self.x[[2, 5, 8]] = wrap(self.x[[2, 5, 8]])


def test_it_is_the_joint_filter() -> None:
    rng = np.random.default_rng(21)
    ours, joint = CentralizedFilter(ROBOTS, TARGETS, LANDMARKS, "jacobian"), JointFilter()
    for step in range(150):
        for name in ROBOTS:
            delta = np.array([rng.uniform(0.0, 0.4), rng.uniform(-0.1, 0.1), 0.0, rng.uniform(-0.2, 0.2)])
            ours.odometry(name, delta, NOISE, 0.5)
            joint.move(name, delta[[0, 1, 3]], NOISE[np.ix_((0, 1, 3), (0, 1, 3))])
        ours.drift_targets(1.0)
        joint.move("t1", np.array([0.1, 0.0, 0.02]), np.diag([0.05**2, 0.0, 0.03**2]))
        robot = ("r1", "r2")[int(rng.integers(2))]
        of = ("r2" if robot == "r1" else "r1", "target:t1", "landmark:L1")[int(rng.integers(3))]
        kind = ("range", "bearing", "range_bearing")[int(rng.integers(3))]
        mount = planar_mount(0.2, -0.1, 0.5)
        landmark = LANDMARKS["L1"] if of.startswith("landmark") else None
        model = RelativeModel(kind, UNICYCLE, mount, landmark)
        rows = list(range(START[robot], START[robot] + 3))
        if landmark is None:
            other = START[of.removeprefix("target:")]
            rows += list(range(other, other + 3))
        predicted = model.h(joint.x[rows])
        R = np.diag(np.full(len(predicted), 0.01))
        z = predicted + rng.normal(size=len(predicted)) * 0.05
        H = np.zeros((len(z), 9))
        H[:, rows] = model.jacobian(joint.x[rows])
        ours.observe(robot, kind, of, z, R, mount)
        joint.update(H, z - predicted, R)
        if step % 7 == 0:
            fix, noise = joint.x[:2] + rng.normal(size=2) * 0.1, np.diag([0.04, 0.04])
            ours.fix("r1", "position", fix, noise)
            joint.update(np.eye(2, 9), fix - joint.x[:2], noise)
        assert np.abs(ours.mean - joint.x).max() < 1e-9, f"seed 21, step {step}"
        assert np.abs(ours.cov - joint.P).max() < 1e-9, f"seed 21, step {step}"
    mean, cov = ours.belief("t1")
    assert np.allclose(mean, joint.x[6:])
    assert np.allclose(cov, joint.P[6:, 6:])
    assert np.allclose(ours.cross("r1", "t1"), joint.P[:3, 6:])


@pytest.mark.parametrize("cap", [0.0, 4.0])
def test_an_outlier_is_weakened_by_the_cap_alone(cap: float) -> None:
    subject = CentralizedFilter(ROBOTS, TARGETS, LANDMARKS, "unscented", cap)
    before = subject.belief("r1")[0]
    subject.fix("r1", "position", before[:2] + 30.0, np.diag([0.01, 0.01]))
    moved = float(np.hypot(*(subject.belief("r1")[0] - before)[:2]))
    assert (moved > 20.0) == (cap == 0.0)
    np.linalg.cholesky(subject.cov)


@pytest.mark.parametrize("transform", ["unscented", "linearized", "jacobian"])
def test_the_joint_covariance_stays_symmetric_and_positive_definite(transform: Transform) -> None:
    """Four robots and a target, sharp measurements of all kinds, 300 steps (seed 22)."""
    rng = np.random.default_rng(22)
    robots = {f"r{k}": (rng.uniform(-8.0, 8.0, 3), np.diag([0.3, 0.2, 0.01]), PLANAR_MOTION) for k in range(1, 5)}
    subject = CentralizedFilter(robots, TARGETS, LANDMARKS, transform)
    for _ in range(300):
        for name in robots:
            subject.odometry(name, np.array([rng.uniform(0.0, 0.4), 0.0, 0.0, rng.uniform(-0.2, 0.2)]), NOISE, 0.5)
        subject.drift_targets(0.5)
        subject.fix("r1", "pose", subject.belief("r1")[0] + rng.normal(size=3) * 0.01, np.diag([1e-4, 1e-4, 1e-5]))
        for name, of in (("r1", "r2"), ("r2", "target:t1"), ("r3", "r1"), ("r4", "landmark:L1")):
            point = LANDMARKS["L1"] if of.startswith("landmark") else subject.belief(of.removeprefix("target:"))[0]
            distance = float(np.hypot(*(np.asarray(point)[:2] - subject.belief(name)[0][:2])))
            subject.observe(name, "range", of, np.array([distance + rng.normal() * 0.02]), np.array([[4e-4]]))
        assert np.array_equal(subject.cov, subject.cov.T)
        np.linalg.cholesky(subject.cov)


def test_a_target_nobody_knew_of_joins_correlated_with_everybody() -> None:
    """As in the limit of an ever wider prior, when headings are known and a vector is seen."""
    sure = {name: (mean, np.diag([0.3, 0.2, 1e-12]), motion) for name, (mean, _, motion) in ROBOTS.items()}
    place, cov = np.array([0.0, 0.0, 0.8]), np.diag([0.0, 0.0, 0.05])
    wide = np.diag([1e7, 1e7, 0.05])
    ours = CentralizedFilter(sure, {}, {}, "jacobian", unseen={"t1": (place, cov, MOTION)})
    limit = CentralizedFilter(sure, {"t1": (place, wide, MOTION)}, {}, "jacobian")
    R = np.diag([0.1, 0.05])
    assert "t1" not in ours
    other = ours.copy()
    for subject in (ours, limit):
        subject.observe("r1", "vector", "r2", np.array([5.0, 1.0]), R)
        subject.observe("r2", "vector", "target:t1", np.array([4.0, -1.5]), R)
        subject.observe("r1", "vector", "target:t1", np.array([3.0, -4.0]), R)
    assert "t1" in ours and "t1" not in other
    np.testing.assert_allclose(ours.mean, limit.mean, atol=1e-5)
    np.testing.assert_allclose(ours.cov, limit.cov, atol=1e-5)


def test_a_range_alone_brings_in_a_target_only_within_a_stated_distance() -> None:
    unseen = {"t1": (np.zeros(3), np.diag([0.0, 0.0, 0.05]), MOTION)}
    for within_m, joins in ((None, False), (4.0, False), (6.0, True)):
        subject = CentralizedFilter(ROBOTS, {}, {}, unseen=unseen, within_m=within_m)
        subject.observe("r1", "range", "target:t1", np.array([5.0]), np.array([[0.01]]))
        assert ("t1" in subject) is joins
