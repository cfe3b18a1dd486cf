"""Chained increments: whatever the clock offset does, motion is neither lost, nor doubled, nor given no time."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.motion import compose
from agent.vehicle_odometry import Increment, OdometryLimits, PoseOdometry, Stamped, VelocityOdometry

S = 1_000_000_000
MS = 1_000_000
OFFSET = 1_700_000_000 * S
STEPS = st.lists(
    st.tuples(st.integers(5, 50), st.integers(-60, 60), st.floats(-0.3, 0.3), st.floats(-0.5, 0.5)),
    min_size=2,
    max_size=40,
)


def planar(increment: Increment) -> np.ndarray:
    return increment.delta[[0, 1, 3]]


@given(STEPS)
def test_increments_compose_to_the_last_pose_under_a_moving_offset(
    steps: list[tuple[int, int, float, float]],
) -> None:
    """Offsets wander by up to 60 ms, more than a step lasts: t0 is always the t1 before, and time goes forward."""
    source = PoseOdometry(OdometryLimits(max_speed_mps=1e3, max_yaw_rate_radps=1e3), counters := Counter())
    boot, pose, chain, stamps = 0, np.zeros(3), [], []
    reached = pose
    for milliseconds, wander, forward, turn in steps:
        boot += milliseconds * MS
        pose = compose(pose, np.array([forward, 0.1 * forward, turn]))
        fleet = OFFSET + boot + wander * MS
        stamped = Stamped(boot, fleet, np.array([pose[0], pose[1], 0.0]), pose[2])
        increment = source.pose(stamped, 0)
        if not stamps:
            origin, stamps = pose, [fleet]
            reached = pose
        elif increment is not None:
            chain.append(increment)
            stamps.append(fleet)
            reached = pose
    assert all(a.t1_ns == b.t0_ns for a, b in pairwise(chain))
    assert all(increment.t0_ns < increment.t1_ns for increment in chain)
    assert [stamps[0], *(increment.t1_ns for increment in chain)] == stamps
    assert len(chain) + counters["mavlink.stamp_held"] == len(steps) - 1
    composed = origin
    for increment in chain:
        composed = compose(composed, planar(increment))
    np.testing.assert_allclose(composed[:2], reached[:2], atol=1e-9)
    assert np.cos(composed[2] - reached[2]) == pytest.approx(1.0)


def test_a_backward_correction_holds_the_motion_for_the_next_increment() -> None:
    source = PoseOdometry(OdometryLimits(), counters := Counter())
    fleet_ms = (0, 100, 90, 300)
    found = [
        source.pose(Stamped(k * 100 * MS, fleet * MS, np.array([0.1 * k, 0.0, 0.0]), 0.0), 0)
        for k, fleet in enumerate(fleet_ms)
    ]
    assert [item is None for item in found] == [True, False, True, False]
    last = found[-1]
    assert last is not None and (last.t0_ns, last.t1_ns) == (100 * MS, 300 * MS)
    np.testing.assert_allclose(last.delta, [0.2, 0.0, 0.0, 0.0], atol=1e-12)
    assert counters == {"mavlink.stamp_held": 1}


def test_a_long_silence_begins_a_new_chain() -> None:
    source = PoseOdometry(OdometryLimits(max_gap_ns=S), counters := Counter())
    stamps = (0, 500 * MS, 2000 * MS, 2500 * MS)
    found = [source.pose(Stamped(t, t, np.array([t * 1e-9, 0.0, 0.0]), 0.0), 0) for t in stamps]
    assert [None if item is None else (item.t0_ns, item.t1_ns) for item in found] == [
        None, (0, 500 * MS), None, (2000 * MS, 2500 * MS),
    ]  # fmt: skip
    assert counters == {"mavlink.odometry_gap": 1}


def test_a_spin_faster_than_any_vehicle_is_a_jump() -> None:
    source = PoseOdometry(OdometryLimits(max_yaw_rate_radps=5.0), counters := Counter())
    found = [source.pose(Stamped(k * 100 * MS, k * 100 * MS, np.zeros(3), yaw), 0) for k, yaw in enumerate((0, 0.4, 3))]
    assert [item is None for item in found] == [True, False, True]
    assert counters == {"mavlink.odometry_jump": 1}


def test_velocity_is_integrated_by_the_trapezoidal_rule() -> None:
    """From rest to 2 m/s eastward within one second, the nose north: one metre to the right."""
    source = VelocityOdometry(OdometryLimits(max_gap_ns=2 * S), Counter())
    source.attitude(S, np.pi / 2)
    assert source.velocity(S, S, np.zeros(3)) == []
    source.velocity(2 * S, 2 * S, np.array([2.0, 0.0, 0.2]))
    (increment,) = source.attitude(2 * S, np.pi / 2)
    np.testing.assert_allclose(increment.delta, [0.0, -1.0, 0.1, 0.0], atol=1e-12)


def test_a_heading_is_interpolated_the_short_way_round() -> None:
    source = VelocityOdometry(OdometryLimits(max_gap_ns=2 * S), Counter())
    source.attitude(S, 3.0)
    source.velocity(S, S, np.zeros(3))
    source.velocity(S + S // 2, S + S // 2, np.zeros(3))
    (increment,) = source.attitude(2 * S, -3.0)
    assert increment.delta[3] == pytest.approx(np.pi - 3.0)


def test_velocities_older_than_every_attitude_are_counted_and_dropped() -> None:
    source = VelocityOdometry(OdometryLimits(), counters := Counter())
    for k in range(40):
        assert source.velocity((k + 1) * MS, (k + 1) * MS, np.ones(3)) == []
    assert source.attitude(S, 0.0) == []
    assert counters["mavlink.no_attitude"] == 40
