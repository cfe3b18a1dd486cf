"""The past of a belief: what comes late is used where it belongs, as if it had come in time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.course import Course, Moment
from agent.estimation.unscented import Propagated

SECOND = 1_000_000_000
HORIZON_S = 10


def moved(belief: Moment, F: np.ndarray, Q: np.ndarray) -> Propagated:
    return Propagated(F @ belief.mean, F @ belief.cov @ F.T + Q, F)


def corrected(belief: Moment, H: np.ndarray, z: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kalman's update."""
    K = belief.cov @ H.T @ np.linalg.inv(H @ belief.cov @ H.T + R)
    return belief.mean + K @ (z - H @ belief.mean), (np.eye(len(belief.mean)) - K @ H) @ belief.cov


def course_of(n: int, rng: np.random.Generator) -> Course:
    root = rng.normal(size=(n, n))
    first = Moment(0, rng.normal(size=n), root @ root.T + np.eye(n))
    return Course(first, (), HORIZON_S * SECOND, 1_000)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5))
def test_late_information_gives_what_it_would_have_given_in_time(seed: int, instant: int) -> None:
    rng = np.random.default_rng(seed)
    n, steps = 3, 6
    F = [np.eye(n) + 0.2 * rng.normal(size=(n, n)) for _ in range(steps)]
    Q = np.diag(rng.uniform(0.1, 1.0, n))
    H, z, R = rng.normal(size=(2, n)), rng.normal(size=2), np.diag([0.5, 0.2])
    late, begin = course_of(n, np.random.default_rng(seed + 1)), course_of(n, np.random.default_rng(seed + 1))
    for k in range(steps):
        if k == instant:
            assert begin.correct(begin.newest, *corrected(begin.newest, H, z, R))
        for course in (late, begin):
            course.advance((k + 1) * SECOND, moved(course.newest, F[k], Q))
    then = late.at(instant * SECOND)
    assert then is not None and late.correct(then, *corrected(then, H, z, R))
    np.testing.assert_allclose(late.newest.mean, begin.newest.mean, atol=1e-9, err_msg=f"seed {seed}")
    np.testing.assert_allclose(late.newest.cov, begin.newest.cov, atol=1e-9, err_msg=f"seed {seed}")


def test_two_pieces_of_late_information_both_count() -> None:
    rng = np.random.default_rng(3)
    late, begin = course_of(2, np.random.default_rng(4)), course_of(2, np.random.default_rng(4))
    F, Q, R = np.array([[1.0, 1.0], [0.0, 1.0]]), 0.1 * np.eye(2), np.array([[0.3]])
    H, readings = np.array([[1.0, 0.0]]), rng.normal(size=(2, 1))
    for k in range(2):
        assert begin.correct(begin.newest, *corrected(begin.newest, H, readings[k], R))
        for course in (late, begin):
            course.advance((k + 1) * SECOND, moved(course.newest, F, Q))
    for k in range(2):
        then = late.at(k * SECOND)
        assert then is not None and late.correct(then, *corrected(then, H, readings[k], R))
    np.testing.assert_allclose(late.newest.mean, begin.newest.mean, atol=1e-9)
    np.testing.assert_allclose(late.newest.cov, begin.newest.cov, atol=1e-9)


def test_a_heading_is_shifted_the_short_way() -> None:
    course = Course(Moment(0, np.array([3.1]), np.eye(1)), (0,), SECOND, 1_000)
    course.advance(SECOND // 2, Propagated(np.array([3.1]), 2.0 * np.eye(1), np.eye(1)))
    then = course.at(0)
    assert then is not None and course.correct(then, np.array([-3.1]), 0.5 * np.eye(1))
    assert course.newest.mean[0] == pytest.approx(-3.1)
    assert course.newest.cov[0, 0] == pytest.approx(1.5)


def test_only_the_horizon_is_remembered_and_what_is_gone_is_not_changed() -> None:
    course = Course(Moment(0, np.zeros(1), np.eye(1)), (), HORIZON_S * SECOND, 1_000)
    first = course.newest
    for k in range(1, 100):
        course.advance(k * SECOND, moved(course.newest, np.eye(1), np.eye(1)))
    assert len(course) == HORIZON_S + 1
    assert course.at(88 * SECOND) is None
    between = course.at(95 * SECOND + SECOND // 2)
    assert between is not None and between.t_ns == 95 * SECOND
    assert not course.correct(first, np.ones(1), np.eye(1))


def test_a_covariance_that_would_not_stay_positive_changes_nothing() -> None:
    course = Course(Moment(0, np.zeros(1), np.eye(1)), (), SECOND, 1_000)
    before = course.newest
    assert not course.correct(before, np.ones(1), -np.eye(1))
    assert course.newest is before
