"""Two robots against the joint filter: what must be exact is exact."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import UNICYCLE
from agent.estimation.observation import RelativeModel
from agent.events import Fix
from agent.settings import NS
from tests.agent.courier import FIRST, SECOND, TINY, Pair

Array = NDArray[np.float64]

STARTS = {
    FIRST: (np.array([0.0, 0.0, 0.3]), np.diag([0.3, 0.2, 0.01])),
    SECOND: (np.array([6.0, 2.0, -1.0]), np.diag([0.4, 0.5, 0.02])),
}
NOISE = np.diag([0.02, 0.01, 0.0, 0.001]) ** 2 + np.diag([1e-4, 1e-4, 0.0, 1e-5])


class JointFilter:
    """A plain EKF over both robots, written out; `zero` names a robot whose gain is set to zero."""

    def __init__(self, starts: dict[str, tuple[Array, Array]]) -> None:
        self.x = np.concatenate([mean for mean, _ in starts.values()])
        self.P = np.zeros((6, 6))
        for index, (_, cov) in enumerate(starts.values()):
            self.P[3 * index : 3 * index + 3, 3 * index : 3 * index + 3] = cov

    def odometry(self, index: int, delta: Array, cov: Array) -> None:
        part = slice(3 * index, 3 * index + 3)
        heading = self.x[part][2]
        cos, sin = np.cos(heading), np.sin(heading)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        step = turn @ delta[[0, 1, 3]]
        F = np.eye(6)
        F[3 * index, 3 * index + 2], F[3 * index + 1, 3 * index + 2] = -step[1], step[0]
        self.x[part] += step
        self.P = F @ self.P @ F.T
        self.P[part, part] += turn @ cov[np.ix_((0, 1, 3), (0, 1, 3))] @ turn.T
        self._wrap()

    def update(self, H: Array, innovation: Array, R: Array, zero: int | None = None) -> None:
        K = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        if zero is not None:
            K[3 * zero : 3 * zero + 3] = 0.0
        self.x = self.x + K @ innovation
        keep = np.eye(6) - K @ H
        self.P = keep @ self.P @ keep.T + K @ R @ K.T
        self._wrap()

    def _wrap(self) -> None:
        self.x[[2, 5]] = wrap(self.x[[2, 5]])


def assert_equal(pair: Pair, joint: JointFilter, tolerance: float, note: str) -> None:
    for index, name in enumerate((FIRST, SECOND)):
        part = slice(3 * index, 3 * index + 3)
        state = pair.agents[name].filter.state
        difference = state.mean - joint.x[part]
        difference[2] = wrap(difference[2:])[0]
        scale = max(1.0, float(np.abs(joint.x).max()))
        assert np.abs(difference).max() <= tolerance * scale, f"{note}: mean of {name}"
        assert np.abs(state.cov - joint.P[part, part]).max() <= tolerance, f"{note}: covariance of {name}"
    cross = pair.cross()
    assert cross is not None
    assert np.abs(cross - joint.P[:3, 3:]).max() <= tolerance, f"{note}: cross-covariance"


@pytest.mark.parametrize("private", [False, True])
@pytest.mark.parametrize("seed", [11, 12, 13])
def test_two_robots_equal_the_joint_filter(seed: int, private: bool) -> None:
    """Pair updates give the centralized covariance; private ones that of a filter with zero gain for the partner."""
    rng = np.random.default_rng(seed)
    pair, joint = Pair(STARTS), JointFilter(STARTS)
    used = 0
    for k in range(1, 401):
        t0, t1 = (k - 1) * NS, k * NS
        for index, name in enumerate((FIRST, SECOND)):
            delta = np.array([rng.uniform(0.0, 0.4), rng.uniform(-0.1, 0.1), 0.0, rng.uniform(-0.2, 0.2)])
            pair.converse(pair.odometry(name, t0, t1, delta, NOISE))
            joint.odometry(index, delta, NOISE)
        if private and rng.random() < 0.3:
            index = int(rng.integers(2))
            name = (FIRST, SECOND)[index]
            R = np.diag([0.3, 0.3, 0.05]) ** 2
            z = pair.agents[name].filter.state.mean + rng.normal(size=3) * 0.1
            pair.agents[name].handle(Fix(pair.now_ns, t1, "pose", z, R))
            H = np.zeros((3, 6))
            H[:, 3 * index : 3 * index + 3] = np.eye(3)
            innovation = z - joint.x[3 * index : 3 * index + 3]
            innovation[2] = wrap(innovation[2:])[0]
            joint.update(H, innovation, R, zero=1 - index)
        if rng.random() < 0.5:
            kind = ("range", "bearing", "range_bearing")[int(rng.integers(3))]
            # A two-way range belongs to the lower id; bearings to whoever looks.
            owner = FIRST if kind == "range" or rng.random() < 0.5 else SECOND
            order = [0, 1, 2, 3, 4, 5] if owner == FIRST else [3, 4, 5, 0, 1, 2]
            model = RelativeModel(kind, UNICYCLE)
            z = model.h(joint.x[order]) + rng.normal(size=len(model.angles) or 1) * 0.02
            if kind == "range_bearing":
                z = model.h(joint.x[order]) + rng.normal(size=2) * 0.02
            R = np.diag({"range": [0.05], "bearing": [0.02], "range_bearing": [0.05, 0.02]}[kind]) ** 2
            H = np.zeros((len(z), 6))
            H[:, order] = model.jacobian(joint.x[order])
            innovation = z - model.h(joint.x[order])
            for angle in model.angles:
                innovation[angle] = wrap(innovation[angle : angle + 1])[0]
            pair.converse(pair.measure(owner, t1, kind, z, R))
            joint.update(H, innovation, R)
            used += 1
        assert_equal(pair, joint, 1e-9, f"seed {seed}, step {k}")
    counters = pair.agents[FIRST].counters + pair.agents[SECOND].counters
    assert used > 150
    assert counters["pair.applied_initiator"] == counters["pair.applied_responder"] == used


@pytest.mark.parametrize("seed", [31, 32])
def test_a_lost_reply_leaves_the_joint_filter_with_zero_gain_for_the_initiator(seed: int) -> None:
    """Nonlinear, 300 steps: a third of the contacts get no reply through; the other robot opens the next one."""
    rng = np.random.default_rng(seed)
    pair, joint = Pair(STARTS, timeout_s=1000.0), JointFilter(STARTS)
    owner, lost = 0, 0
    for k in range(1, 301):
        for index, name in enumerate((FIRST, SECOND)):
            delta = np.array([rng.uniform(0.0, 0.4), rng.uniform(-0.1, 0.1), 0.0, rng.uniform(-0.2, 0.2)])
            pair.odometry(name, (k - 1) * NS, k * NS, delta, NOISE)
            joint.odometry(index, delta, NOISE)
        if rng.random() < 0.6:
            order = [0, 1, 2, 3, 4, 5] if owner == 0 else [3, 4, 5, 0, 1, 2]
            model, R = RelativeModel("range_bearing", UNICYCLE), np.diag([0.05, 0.02]) ** 2
            z = model.h(joint.x[order]) + rng.normal(size=2) * 0.02
            H = np.zeros((2, 6))
            H[:, order] = model.jacobian(joint.x[order])
            innovation = z - model.h(joint.x[order])
            innovation[1] = wrap(innovation[1:])[0]
            (request,) = pair.measure((FIRST, SECOND)[owner], k * NS, "range_bearing", z, R)
            (reply,) = pair.deliver(request)
            if rng.random() < 0.35:
                joint.update(H, innovation, R, zero=owner)
                lost, owner = lost + 1, 1 - owner
            else:
                pair.deliver(reply)
                joint.update(H, innovation, R)
        assert_equal(pair, joint, 1e-9, f"seed {seed}, step {k}")
    counters = pair.agents[FIRST].counters + pair.agents[SECOND].counters
    assert lost > 30
    assert counters["pair.applied_responder"] - counters["pair.applied_initiator"] == lost


@pytest.mark.parametrize("delay", [1, 4, 9])
def test_a_late_reply_gives_the_in_time_result_when_linear(delay: int) -> None:
    """Headings known: the initiator applies a contact `delay` steps late, with odometry in between."""
    starts = {name: (mean, np.diag([cov[0, 0], cov[1, 1], TINY])) for name, (mean, cov) in STARTS.items()}
    noise = np.diag([0.01, 0.02, 0.0, 0.0])
    pair, joint = Pair(starts, timeout_s=100.0), JointFilter(starts)
    rng = np.random.default_rng(delay)
    k = 0
    for _ in range(12):
        waiting = []
        for step in range(delay + 1):
            k += 1
            for index, name in enumerate((FIRST, SECOND)):
                delta = np.array([rng.uniform(0.0, 0.4), rng.uniform(-0.1, 0.1), 0.0, 0.0])
                pair.converse(pair.odometry(name, (k - 1) * NS, k * NS, delta, noise))
                joint.odometry(index, delta, noise)
            if step == 0:
                model = RelativeModel("range", UNICYCLE)
                z, R = model.h(joint.x) + 0.03, np.array([[0.04]])
                requests = pair.measure(FIRST, k * NS, "range", z, R)
                waiting = [reply for request in requests for reply in pair.deliver(request)]
                joint.update(model.jacobian(joint.x), z - model.h(joint.x), R)
        assert len(waiting) == 1
        pair.converse(waiting)
        assert_equal(pair, joint, 1e-8, f"delay {delay}, step {k}")
