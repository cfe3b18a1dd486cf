"""The gate test as it is shown: that of the scan that was judged."""

from __future__ import annotations

import numpy as np

from agent.estimation.correspondence import BodyMotion, Correspondence, CorrespondenceSettings, Form, Scan

COV = 0.0036 * np.eye(2)
STILL = BodyMotion(np.zeros(4), 1e-4 * np.eye(4))
PLACE = np.array([3.0, 1.0, 0.5])
DIRECTION = np.array([np.arctan2(1.0, 3.0), np.arctan2(0.5, np.hypot(3.0, 1.0))])


def judged(form: Form, steps: int, moving: float = 0.0) -> Correspondence:
    """After some scans of a robot that stands at `PLACE`, or goes who knows where."""
    leader = Correspondence(CorrespondenceSettings(form=form), ["p1"], "l1")
    peer = BodyMotion(np.array([moving, 0.0, 0.0, 0.0]), 1e-4 * np.eye(4))
    bearings = np.stack([DIRECTION, DIRECTION + np.array([1.5, 0.3])])
    for _ in range(steps):
        leader.advance(STILL, {"p1": peer}, 0.1)
        leader.scan(Scan(bearings, COV, {"p1": (float(np.linalg.norm(PLACE)), 1e-4)}, {"p1": (0.5, 1e-4)}))
    return leader


def test_before_anything_was_seen_there_is_nothing_to_show() -> None:
    assert judged("improved", 0).gate_test("p1") is None
    # The first scan begins the hypotheses; none was there to be tested.
    assert judged("improved", 1).gate_test("p1") is None


def test_the_true_bearing_is_inside_the_gate_of_the_right_hypothesis() -> None:
    test = judged("improved", 6).gate_test("p1")
    assert test is not None
    best = int(test.weight.argmax())
    off = test.bearings - test.expected[best]
    inside = np.einsum("mi,ij,mj->m", off, np.linalg.inv(test.gate[best]), off) <= test.limit
    assert inside.tolist() == [True, False]
    assert test.wider == 1.0


def test_published_gates_are_wider_where_a_heading_is_wide_and_the_robot_has_moved() -> None:
    leader = judged("published", 1)
    gone = BodyMotion(np.array([3.0, 0.0, 0.0, 0.0]), 1e-4 * np.eye(4))
    for _ in range(5):
        leader.advance(STILL, {"p1": gone}, 0.1)
    leader.scan(Scan(DIRECTION[None], COV, {}, {}))
    test = leader.gate_test("p1")
    assert test is not None
    assert test.wider > 1.2, test.wider
