"""The reader against the stand-in, bytes passed by hand: increments, fixes, stamps, faults and rubbish."""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.autopilot import AutopilotReader
from agent.autopilot_settings import AutopilotSettings
from agent.autopilot_settings import fix_settings as settings_of_fixes
from agent.estimation.motion import between, compose
from agent.estimation.odometry import OdometryNoise
from agent.events import Fix, Odometry
from agent.vehicle_fixes import VehicleFixes
from sim.autopilot import StandIn, StandInSettings

S = 1_000_000_000
MS = 1_000_000
T0 = 1_700_000_000 * S
BOOT = T0 - 77 * S - 123_456_789
ORIGIN = (47.397742, 8.545594, 488.0)
GPS = ("odometry", "global_position", "attitude", "local_position")
NAN = math.nan


class Desk:
    """A reader and a stand-in on a cable with a delay each way, driven in steps of fleet time."""

    def __init__(
        self, *, reader: AutopilotSettings | None = None, vehicle: StandInSettings | None = None, delay_ns: int = 0
    ) -> None:
        self.reader = AutopilotReader(reader or AutopilotSettings(origin=ORIGIN))
        self.vehicle = StandIn(vehicle or StandInSettings(sends=GPS, origin=ORIGIN, boot_ns=BOOT))
        self.delay_ns = delay_ns
        self.now_ns = T0
        self.events: list[Odometry | Fix] = []
        self.filter: Callable[[bytes], bytes | None] = lambda data: data

    @property
    def odometry(self) -> list[Odometry]:
        return [event for event in self.events if isinstance(event, Odometry)]

    @property
    def fixes(self) -> list[Fix]:
        return [event for event in self.events if isinstance(event, Fix)]

    def to_reader(self, data: list[bytes]) -> None:
        for frame in data:
            passed = self.filter(frame)
            if passed is not None:
                self.events += self.reader.datagram(self.now_ns + self.delay_ns, passed)

    def exchange(self) -> None:
        """Everything due now, and the answers, until both are content."""
        self.to_reader(self.vehicle.outgoing(self.now_ns))
        for _ in range(8):
            for frame in self.reader.outgoing(self.now_ns):
                answers = self.vehicle.receive(self.now_ns + self.delay_ns, frame)
                self.now_ns += self.delay_ns
                self.to_reader(answers)
                self.now_ns -= self.delay_ns

    def step(self, dt_ns: int, delta: np.ndarray | None = None, fix: np.ndarray | None = None) -> None:
        self.now_ns += dt_ns
        if delta is not None:
            self.vehicle.set_odometry(self.now_ns, delta)
        if fix is not None:
            self.vehicle.set_fix(self.now_ns, fix[0], fix[1], 0.0, fix[2])
        self.exchange()
        self.to_reader(self.vehicle.push(self.now_ns))

    def warm_up(self) -> None:
        for _ in range(4):
            self.step(100 * MS, np.zeros(4))
        self.events.clear()


def frame(message: Any, system: int = 1, component: int = 1) -> bytes:
    return bytes(message.pack(dialect.MAVLink(None, system, component)))


def heartbeat(system: int = 1, autopilot: int = 3, component: int = 1) -> bytes:
    return frame(dialect.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3), system, component)


def odometry_frame(usec: int, **changes: Any) -> bytes:
    values: dict[str, Any] = {
        "time_usec": usec,
        "frame_id": 20,
        "child_frame_id": 12,
        "x": 0.0,
        "y": 0.0,
        "z": 0.0,
        "q": [1.0, 0.0, 0.0, 0.0],
        "vx": 0.0,
        "vy": 0.0,
        "vz": 0.0,
        "rollspeed": 0.0,
        "pitchspeed": 0.0,
        "yawspeed": 0.0,
        "pose_covariance": [NAN] * 21,
        "velocity_covariance": [NAN] * 21,
    }
    return frame(dialect.MAVLink_odometry_message(**(values | changes)))


def walk(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.normal(size=(count, 4)) * [0.05, 0.01, 0.01, 0.1] + [0.1, 0.0, 0.0, 0.03]


# -- odometry ---------------------------------------------------------------------------------------------------


def test_increments_are_recovered_and_their_stamps_are_those_of_the_world() -> None:
    desk = Desk()
    desk.warm_up()
    start = desk.now_ns
    deltas = walk(np.random.default_rng(1), 300)
    stamps = [start]
    for k, delta in enumerate(deltas):
        desk.step(50 * MS + (k % 7) * 1000 * 1000, delta)
        stamps.append(desk.now_ns)
    assert len(desk.odometry) == len(deltas)
    for event, delta, t0, t1 in zip(desk.odometry, deltas, stamps[:-1], stamps[1:], strict=True):
        np.testing.assert_allclose(event.delta, delta, atol=1e-5)
        # ODOMETRY tells whole microseconds.
        assert abs(event.t0_ns - t0) < 1000 and abs(event.t_meas_ns - t1) < 1000
    chain = desk.odometry
    assert all(a.t_meas_ns == b.t0_ns for a, b in pairwise(chain))


def test_gains_and_covariance_come_from_the_settings() -> None:
    noise = OdometryNoise(along_m_per_sqrt_s=0.3, heading_rad_per_sqrt_s=0.1, scale_along=1.1, scale_turn=0.9)
    desk = Desk(reader=AutopilotSettings(odometry_noise=noise))
    desk.warm_up()
    desk.step(100 * MS, np.array([0.2, 0.0, 0.0, 0.1]))
    (event,) = desk.odometry
    np.testing.assert_allclose(event.delta, [0.22, 0.0, 0.0, 0.09], atol=1e-5)
    np.testing.assert_allclose(np.diagonal(event.cov), [0.009, 0.0, 0.02**2 * 0.1, 0.001], rtol=1e-3)


def test_lost_frames_make_one_longer_increment() -> None:
    desk = Desk()
    desk.warm_up()
    begin, pose = desk.now_ns, np.zeros(3)
    desk.filter = lambda data: None
    for _ in range(5):
        desk.step(100 * MS, np.array([0.1, 0.02, 0.0, 0.2]))
        pose = compose(pose, np.array([0.1, 0.02, 0.2]))
    desk.filter = lambda data: data
    desk.step(100 * MS, np.array([0.1, 0.02, 0.0, 0.2]))
    pose = compose(pose, np.array([0.1, 0.02, 0.2]))
    (event,) = desk.odometry
    assert abs(event.t0_ns - begin) < 1000 and abs(event.t_meas_ns - desk.now_ns) < 1000
    np.testing.assert_allclose(event.delta[[0, 1, 3]], between(np.zeros(3), pose), atol=1e-5)


def test_a_repeated_or_late_frame_changes_nothing() -> None:
    desk = Desk()
    desk.warm_up()
    kept: list[bytes] = []
    desk.filter = lambda data: kept.append(data) or data
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    count = len(desk.odometry)
    for data in kept:
        assert desk.reader.datagram(desk.now_ns, data) == []
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    assert len(desk.odometry) == count + 1
    np.testing.assert_allclose(desk.odometry[-1].delta, [0.1, 0.0, 0.0, 0.0], atol=1e-5)
    assert desk.reader.counters["mavlink.out_of_order"] == 2


@pytest.mark.parametrize("announced", [True, False])
def test_a_jump_of_the_local_frame_is_no_motion(announced: bool) -> None:
    desk = Desk()
    desk.warm_up()
    for k in range(10):
        if k == 5:
            desk.vehicle.jump(np.array([20.0, -5.0, 0.0, 1.0]), announced=announced)
        desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.05]))
    assert len(desk.odometry) == 9
    for event in desk.odometry:
        np.testing.assert_allclose(event.delta, [0.1, 0.0, 0.0, 0.05], atol=1e-5)
    # The gap stays open: nothing pretends to know the motion of the jump's interval.
    assert sum(a.t_meas_ns != b.t0_ns for a, b in pairwise(desk.odometry)) == 1
    assert desk.reader.counters["mavlink.odometry_reset" if announced else "mavlink.odometry_jump"] == 1


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"x": NAN}, "not_finite"),
        ({"z": math.inf}, "not_finite"),
        ({"q": [NAN, 0.0, 0.0, 0.0]}, "not_finite"),
        ({"q": [0.0, 0.0, 0.0, 0.0]}, "quaternion"),
        ({"q": [3e38, 3e38, 3e38, 3e38]}, "quaternion"),
        ({"frame_id": 12}, "frame"),
        ({"child_frame_id": 4}, "frame"),
        ({"quality": -1}, "odometry_failed"),
        ({"x": 3e38}, "odometry_jump"),
        ({"time_usec": 2**63}, "unix_time"),
        ({"time_usec": 10**14}, "stamp_future"),
    ],
)
def test_an_absurd_odometry_is_counted_under_its_reason(changes: dict[str, Any], reason: str) -> None:
    desk = Desk()
    desk.warm_up()
    usec = (desk.now_ns + 50 * MS - BOOT) // 1000
    desk.now_ns += 50 * MS
    desk.to_reader([odometry_frame(usec, **changes)])
    assert desk.events == []
    assert desk.reader.counters[f"mavlink.{reason}"] == 1
    desk.step(50 * MS, np.zeros(4))
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(desk.odometry[-1].delta, [0.1, 0.0, 0.0, 0.0], atol=1e-5)


def test_local_ned_and_a_tilted_body_give_the_level_motion() -> None:
    """North-east-down poses written by hand: 3 m to the north with the nose at east is 3 m to the left."""
    desk = Desk()
    desk.warm_up()
    usec = (desk.now_ns - BOOT) // 1000
    half = math.sqrt(0.5)
    desk.reader._poses.restart()
    desk.now_ns += 2 * S
    desk.to_reader(
        [
            odometry_frame(usec + 1_000_000, frame_id=1, q=[half, 0.0, 0.0, half]),
            odometry_frame(usec + 2_000_000, frame_id=1, x=3.0, z=-0.5, q=[math.cos(0.1), math.sin(0.1), 0.0, 0.0]),
        ]
    )
    (event,) = desk.odometry
    np.testing.assert_allclose(event.delta, [0.0, 3.0, 0.5, math.pi / 2], atol=1e-6)


def test_velocity_and_attitude_as_odometry() -> None:
    """A circle of 2 m/s and 0.2 rad/s: chords and turns to 1e-4 of what was driven."""
    settings = AutopilotSettings(origin=ORIGIN, odometry_source="velocity", message_interval_ns=50 * MS)
    desk = Desk(reader=settings, vehicle=StandInSettings(sends=("attitude", "local_position"), boot_ns=BOOT))
    desk.warm_up()
    delta = between(np.zeros(3), np.array([10 * math.sin(0.01), 10 * (1 - math.cos(0.01)), 0.01]))
    for _ in range(40):
        desk.step(50 * MS, np.insert(delta, 2, 0.0))
    driven = np.zeros(3)
    for event in desk.odometry[2:]:
        np.testing.assert_allclose(event.delta[[0, 3]], delta[[0, 2]], atol=2e-5)
        np.testing.assert_allclose(event.delta[1], delta[1], atol=2e-3)
        driven = compose(driven, event.delta[[0, 1, 3]])
    assert len(desk.odometry) >= 38
    assert desk.reader.counters["mavlink.no_attitude"] == 0


def test_attitudes_between_velocities_are_interpolated() -> None:
    desk = Desk(reader=AutopilotSettings(odometry_source="velocity"))
    desk.warm_up()
    base = (desk.now_ns - BOOT) // MS
    desk.now_ns += S

    def attitude(ms: int, yaw: float) -> bytes:
        return frame(dialect.MAVLink_attitude_message(base + ms, 0.0, 0.0, yaw, 0.0, 0.0, 0.0))

    def velocity(ms: int) -> bytes:
        return frame(dialect.MAVLink_local_position_ned_message(base + ms, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0))

    # The nose turns clockwise through north, from -0.2 to +0.2 rad; the motion is north, first to its right.
    desk.to_reader([attitude(100, -0.2), velocity(200), velocity(400), attitude(500, 0.2)])
    (event,) = desk.odometry
    assert event.t_meas_ns - event.t0_ns == 200 * MS
    np.testing.assert_allclose(event.delta, [0.2 * math.cos(0.1), -0.2 * math.sin(0.1), 0.0, -0.2], atol=1e-6)


# -- fixes ------------------------------------------------------------------------------------------------------


def fix_settings(**changes: Any) -> AutopilotSettings:
    values: dict[str, Any] = {
        "origin": ORIGIN,
        "fixes": ("position", "heading"),
        "fix_interval_ns": 0,
        "fix_sigma_m": 0.5,
        "fix_sigma_rad": 0.05,
    }
    return AutopilotSettings(**(values | changes))


def test_a_pose_is_recovered_to_two_centimetres_with_its_stamp() -> None:
    desk = Desk(reader=fix_settings())
    desk.warm_up()
    poses, stamps = [], []
    for k in range(50):
        pose = np.array([300.0 * math.sin(k), -200.0 * math.cos(k), frames.wrap(0.3 * k)])
        desk.step(100 * MS, np.zeros(4), pose)
        poses.append(pose)
        stamps.append(desk.now_ns)
    assert len(desk.fixes) == 50
    for event, pose, stamp in zip(desk.fixes, poses, stamps, strict=True):
        assert event.kind == "pose"
        np.testing.assert_allclose(event.z[:2], pose[:2], atol=0.02)
        assert abs(frames.wrap(event.z[2] - pose[2])) < 1e-4
        assert abs(event.t_meas_ns - stamp) <= MS
        np.testing.assert_allclose(event.R, np.diag([0.25, 0.25, 0.0025]))


def test_only_the_fixes_named_are_used() -> None:
    for fixes, kinds in (((), []), (("position",), ["position"]), (("heading",), ["heading"])):
        desk = Desk(reader=fix_settings(fixes=fixes))
        desk.warm_up()
        desk.step(100 * MS, np.zeros(4), np.array([1.0, 2.0, 0.7]))
        assert [event.kind for event in desk.fixes] == kinds
    np.testing.assert_allclose(desk.fixes[0].z, [0.7], atol=1e-6)


def test_fixes_are_thinned_and_inflated() -> None:
    desk = Desk(reader=fix_settings(fixes=("position",), fix_interval_ns=S, fix_inflation=4.0))
    desk.warm_up()
    for k in range(50):
        desk.step(100 * MS, np.zeros(4), np.array([float(k), 0.0, 0.0]))
    assert len(desk.fixes) == 5
    assert all(b.t_meas_ns - a.t_meas_ns >= S for a, b in pairwise(desk.fixes))
    np.testing.assert_allclose(desk.fixes[0].R, np.eye(2))


def test_the_gps_own_accuracy_counts_when_it_is_worse() -> None:
    for accuracy, expected in ((None, 0.5), (0.1, 0.5), (3.0, 3.0)):
        vehicle = StandInSettings(sends=GPS, origin=ORIGIN, boot_ns=BOOT, gps_accuracy_m=accuracy)
        desk = Desk(reader=fix_settings(), vehicle=vehicle)
        desk.warm_up()
        for _ in range(12):
            desk.step(100 * MS, np.zeros(4), np.array([1.0, 2.0, 0.0]))
        np.testing.assert_allclose(np.diagonal(desk.fixes[-1].R)[:2], expected**2)


def global_position(desk: Desk, lat: int, lon: int, hdg: int = 0) -> bytes:
    ms = (desk.now_ns - BOOT) // MS
    return frame(dialect.MAVLink_global_position_int_message(ms, lat, lon, 488_000, 0, 0, 0, 0, hdg))


def test_an_unknown_heading_leaves_a_position() -> None:
    desk = Desk(reader=fix_settings())
    desk.warm_up()
    desk.to_reader([global_position(desk, 473_977_420, 85_455_940, 65535)])
    (event,) = desk.fixes
    assert event.kind == "position"
    np.testing.assert_allclose(event.z, [0.0, 0.0], atol=0.02)
    assert desk.reader.counters["mavlink.no_heading"] == 1


@pytest.mark.parametrize(
    ("lat", "lon", "reason"),
    [
        (0, 0, "no_position"),
        (910_000_000, 0, "out_of_range"),
        (-(2**31), 2**31 - 1, "out_of_range"),
        (473_977_420, 185_455_940, "far_away"),
    ],
)
def test_impossible_places_are_counted(lat: int, lon: int, reason: str) -> None:
    desk = Desk(reader=fix_settings())
    desk.warm_up()
    desk.to_reader([global_position(desk, lat, lon)])
    assert desk.events == [] and desk.reader.counters[f"mavlink.{reason}"] == 1


def test_without_a_gps_fix_a_global_position_is_not_believed() -> None:
    desk = Desk(reader=fix_settings())
    desk.warm_up()
    desk.to_reader(
        [
            frame(dialect.MAVLink_gps_raw_int_message(0, 1, 0, 0, 0, 0, 0, 0, 0, 0)),
            global_position(desk, 473_977_420, 85_455_940),
        ]
    )
    assert desk.events == [] and desk.reader.counters["mavlink.no_gps_fix"] == 1
    assert "the GPS has no 3-D fix: positions are not used" in desk.reader.status()["reasons"]


def test_a_local_position_is_used_once_its_origin_is_known() -> None:
    desk = Desk(reader=fix_settings(fixes=("position",), position_source="local"))
    desk.vehicle.set_fix(desk.now_ns, 250.0, -40.0, 0.0, 0.0)
    early = frame(dialect.MAVLink_local_position_ned_message((T0 - BOOT) // MS, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    desk.exchange()
    desk.to_reader([early])
    assert desk.fixes == [] and desk.reader.counters["mavlink.no_origin"] == 1
    for k in range(10):
        desk.step(100 * MS, np.zeros(4), np.array([250.0 + k, -40.0 + 2 * k, 0.0]))
    np.testing.assert_allclose(desk.fixes[-1].z, [259.0, -22.0], atol=0.02)
    assert desk.fixes[-1].kind == "position"


@pytest.mark.parametrize(
    ("fixes", "kind", "size"),
    [
        (("position", "heading", "altitude"), "pose", 4),
        (("position", "altitude"), "position", 3),
        (("altitude",), "altitude", 1),
    ],
)
def test_a_fix_has_the_altitude_if_that_is_named(fixes: tuple[str, ...], kind: str, size: int) -> None:
    desk = Desk(reader=fix_settings(fixes=fixes, fix_sigma_m=0.5, fix_sigma_altitude_m=0.25, fix_sigma_rad=0.01))
    desk.warm_up()
    desk.now_ns += 100 * MS
    desk.vehicle.set_fix(desk.now_ns, 3.0, -4.0, 17.5, 0.3)
    desk.exchange()
    desk.to_reader(desk.vehicle.push(desk.now_ns))
    (fix,) = desk.fixes
    whole = {"pose": [3.0, -4.0, 17.5, 0.3], "position": [3.0, -4.0, 17.5], "altitude": [17.5]}[kind]
    sigma = {"pose": [0.5, 0.5, 0.25, 0.01], "position": [0.5, 0.5, 0.25], "altitude": [0.25]}[kind]
    assert (fix.kind, len(fix.z), fix.t_meas_ns) == (kind, size, pytest.approx(desk.now_ns, abs=MS))
    assert np.allclose(fix.z, whole, atol=0.02)
    assert np.allclose(np.sqrt(np.diagonal(fix.R)), sigma)


def test_the_altitude_of_a_local_position_is_at_the_fleets_origin() -> None:
    desk = Desk(reader=fix_settings(fixes=("position", "altitude"), position_source="local"))
    for k in range(60):
        desk.now_ns += 100 * MS
        desk.vehicle.set_fix(desk.now_ns, 1.0, 2.0, 10.0 + 0.1 * k, 0.0)
        desk.exchange()
        desk.to_reader(desk.vehicle.push(desk.now_ns))
    assert np.allclose(desk.fixes[-1].z, [1.0, 2.0, 15.9], atol=0.02)


def test_a_vehicle_without_a_compass_tells_no_heading() -> None:
    desk = Desk(reader=fix_settings(fixes=("position", "heading", "altitude")))
    desk.warm_up()
    desk.now_ns += 100 * MS
    desk.vehicle.set_fix(desk.now_ns, 3.0, -4.0, 17.5, None)
    desk.exchange()
    desk.to_reader(desk.vehicle.push(desk.now_ns))
    assert [(fix.kind, len(fix.z)) for fix in desk.fixes] == [("position", 3)]
    assert desk.reader.counters["mavlink.no_heading"] == 1


def test_the_gps_own_vertical_accuracy_counts_when_it_is_worse() -> None:
    fixes = VehicleFixes(settings_of_fixes(AutopilotSettings(origin=ORIGIN, fixes=("altitude",))), Counter())
    fixes.gps(T0, 3, 0, 7_000)
    (fix,) = fixes.global_position(T0, T0, 473_977_420, 85_455_940, 498_000, 0)
    assert np.allclose(fix.z, [10.0])
    assert np.allclose(fix.R, [[49.0]])
    assert fixes.reasons() == []
    fixes.gps(T0, 1, 0, 0)
    assert fixes.global_position(T0, T0 + S, 473_977_420, 85_455_940, 498_000, 0) == []
    assert fixes.reasons() != []


def test_nan_attitude_is_counted() -> None:
    desk = Desk(reader=fix_settings(fixes=("heading",)))
    desk.warm_up()
    ms = (desk.now_ns - BOOT) // MS
    desk.to_reader(
        [frame(dialect.MAVLink_attitude_message(ms, 0.0, 0.0, yaw, 0.0, 0.0, 0.0)) for yaw in (NAN, math.inf, 1e30)]
    )
    assert desk.events == []
    assert (desk.reader.counters["mavlink.not_finite"], desk.reader.counters["mavlink.out_of_range"]) == (2, 1)


# -- time -------------------------------------------------------------------------------------------------------


def test_nothing_is_used_before_the_clock_is_known() -> None:
    reader = AutopilotReader(AutopilotSettings())
    reader.datagram(T0, heartbeat())
    for k in range(5):
        assert reader.datagram(T0 + k, odometry_frame(1000 + k)) == []
    assert reader.counters["mavlink.no_timesync"] == 5
    assert any("TIMESYNC" in reason for reason in reader.status()["reasons"])


def test_the_shortest_round_trip_is_believed() -> None:
    """Answers delayed one way by up to 40 ms: the offset is wrong by at most half the best round trip."""
    reader, rng = AutopilotReader(AutopilotSettings()), random.Random(3)
    vehicle = StandIn(StandInSettings(boot_ns=BOOT))
    reader.datagram(T0, heartbeat())
    now = T0
    for _ in range(40):
        now = max(now, reader.next_deadline_ns())
        for data in reader.outgoing(now):
            out_ns, back_ns = rng.randrange(MS, 2 * MS), rng.randrange(MS, 40 * MS)
            for answer in vehicle.receive(now + out_ns, data):
                reader.datagram(now + out_ns + back_ns, answer)
        now += 60 * MS
    status = reader.status()["timesync"]
    assert status["samples"] >= 10
    assert status["rtt_ns"] < 6 * MS
    assert abs(status["offset_ns"] - BOOT) <= status["rtt_ns"] / 2


def test_a_round_trip_shifts_stamps_by_half_of_it_at_most() -> None:
    desk = Desk(delay_ns=4 * MS)
    desk.warm_up()
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    assert abs(desk.odometry[-1].t_meas_ns - desk.now_ns) <= 4 * MS


@given(st.lists(st.integers(0, 30), min_size=5, max_size=40))
@settings(max_examples=30, deadline=None)
def test_whatever_the_offset_does_increments_follow_each_other(delays_ms: list[int]) -> None:
    """Every exchange has another round trip, so the believed offset moves: no overlap, no gap, no standing still."""
    desk = Desk()
    desk.warm_up()
    driven = 0.0
    for delay in delays_ms:
        desk.delay_ns = delay * MS
        desk.step(20 * MS, np.array([0.05, 0.0, 0.0, 0.0]))
        driven += 0.05
    chain = desk.odometry
    assert all(event.t0_ns < event.t_meas_ns for event in chain)
    assert all(a.t_meas_ns == b.t0_ns for a, b in pairwise(chain))
    held = desk.reader.counters["mavlink.stamp_held"]
    assert sum(float(event.delta[0]) for event in chain) >= driven - 0.05 * held - 1e-4


def test_timesync_is_fast_until_settled_then_slow() -> None:
    desk = Desk()
    asked: list[int] = []
    for _ in range(600):
        desk.now_ns += 10 * MS
        desk.to_reader(desk.vehicle.outgoing(desk.now_ns))
        for data in desk.reader.outgoing(desk.now_ns):
            (message,) = dialect.MAVLink(None).parse_buffer(data)
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                asked.append(desk.now_ns)
            desk.to_reader(desk.vehicle.receive(desk.now_ns, data))
    gaps = [b - a for a, b in pairwise(asked)]
    assert gaps[:9] == [100 * MS] * 9
    assert gaps[11:] == [S] * len(gaps[11:]) and len(gaps) > 12


def test_a_reboot_is_noticed_and_nothing_spans_it() -> None:
    desk = Desk(reader=fix_settings())
    desk.warm_up()
    for k in range(5):
        desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]), np.array([float(k), 0.0, 0.0]))
    desk.now_ns += 200 * MS
    reboot = desk.now_ns
    before = len(desk.odometry)
    desk.vehicle.reboot(reboot)
    for k in range(40):
        desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]), np.array([float(k), 1.0, 0.0]))
    assert desk.reader.counters["mavlink.reboot"] == 1
    after = desk.odometry[before:]
    assert len(after) > 10 and min(event.t0_ns for event in after) > reboot
    for event in after:
        np.testing.assert_allclose(event.delta, [0.1, 0.0, 0.0, 0.0], atol=1e-5)
    assert abs(after[-1].t_meas_ns - desk.now_ns) < 1000
    np.testing.assert_allclose(desk.fixes[-1].z[:2], [39.0, 1.0], atol=0.02)


@pytest.mark.parametrize("step_ns", [3600 * S, -3600 * S])
def test_a_step_of_the_own_clock_is_survived(step_ns: int) -> None:
    desk = Desk()
    desk.warm_up()
    desk.now_ns += step_ns
    desk.vehicle._boot_ns += step_ns
    desk.vehicle._heartbeat_due_ns = desk.vehicle._timesync_due_ns = desk.now_ns
    desk.vehicle._pushed_ns = None
    for _ in range(150):
        desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    assert desk.reader.counters["mavlink.clock_step"] == 1
    assert abs(desk.odometry[-1].t_meas_ns - desk.now_ns) < 1000
    assert all(event.t_meas_ns - event.t0_ns < S for event in desk.odometry)


def test_boot_milliseconds_may_wrap() -> None:
    boot = T0 - (2**32 - 500) * MS
    vehicle = StandInSettings(sends=GPS, origin=ORIGIN, boot_ns=boot)
    desk = Desk(reader=fix_settings(fix_interval_ns=0), vehicle=vehicle)
    for k in range(20):
        desk.step(100 * MS, np.zeros(4), np.array([float(k), 0.0, 0.0]))
        assert not desk.fixes or desk.fixes[-1].t_meas_ns == desk.now_ns
    assert len(desk.fixes) >= 18 and desk.reader.counters["mavlink.reboot"] == 0


def test_the_autopilots_own_timesync_requests_are_answered() -> None:
    reader = AutopilotReader(AutopilotSettings())
    reader.datagram(T0, heartbeat())
    reader.outgoing(T0)
    reader.datagram(T0 + 5, frame(dialect.MAVLink_timesync_message(0, 4711)))
    assert reader.next_deadline_ns() <= T0 + 5
    (answer,) = [
        m
        for data in reader.outgoing(T0 + 5)
        for m in dialect.MAVLink(None).parse_buffer(data)
        if m.get_type() == "TIMESYNC"
    ]
    assert (answer.tc1, answer.ts1) == (T0 + 5, 4711)


def test_forged_answers_to_requests_never_made_are_ignored() -> None:
    desk = Desk()
    desk.warm_up()
    before = desk.reader.status()["timesync"]
    for ts1 in (0, 1, -5, 2**62):
        desk.to_reader([frame(dialect.MAVLink_timesync_message(5 * S, ts1))])
    assert desk.reader.status()["timesync"] == before
    assert desk.reader.counters["mavlink.timesync_unmatched"] == 4


# -- the vehicle and its requests -------------------------------------------------------------------------------


def test_own_heartbeat_is_an_onboard_computers_of_the_vehicles_system() -> None:
    reader = AutopilotReader(AutopilotSettings())
    reader.datagram(T0, heartbeat(system=23))
    beats = []
    for k in range(50):
        for data in reader.outgoing(T0 + k * S // 10):
            beats += [m for m in dialect.MAVLink(None).parse_buffer(data) if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 5
    assert {(b.type, b.autopilot, b.get_srcSystem(), b.get_srcComponent()) for b in beats} == {(18, 8, 23, 191)}


def test_other_systems_and_components_are_ignored() -> None:
    desk = Desk()
    desk.warm_up()
    usec = (desk.now_ns - BOOT) // 1000 + 1000
    desk.now_ns += 10 * MS
    for source in ((2, 1), (1, 197), (1, 191), (255, 190)):
        odometry = odometry_frame(usec, x=0.1)
        message = dialect.MAVLink(None).parse_buffer(odometry)[0]
        desk.to_reader([frame(message, *source), heartbeat(system=source[0], component=source[1])])
    assert desk.events == []
    assert desk.reader.counters["mavlink.other_system"] == 4
    assert desk.reader.counters["mavlink.other_component"] == 4
    assert desk.reader.status()["vehicle"] == {"system": 1, "component": 1}


def test_only_an_autopilots_heartbeat_locks_and_only_the_named_one() -> None:
    reader = AutopilotReader(AutopilotSettings(system_id=7))
    reader.datagram(T0, heartbeat(system=255, autopilot=dialect.MAV_AUTOPILOT_INVALID))
    assert reader.counters["mavlink.not_an_autopilot"] == 1
    reader.datagram(T0, heartbeat(system=3))
    assert reader.status()["vehicle"] is None
    assert reader.status()["reasons"] == ["only vehicles with other system ids are heard: check system_id"]
    reader.datagram(T0, heartbeat(system=7))
    assert reader.status()["vehicle"] == {"system": 7, "component": 1}


def test_requests_are_repeated_while_a_message_does_not_come() -> None:
    reader = AutopilotReader(AutopilotSettings(message_interval_ns=50 * MS))
    reader.datagram(T0, heartbeat())
    asked = []
    for k in range(100):
        for data in reader.outgoing(T0 + k * S // 10):
            asked += [m for m in dialect.MAVLink(None).parse_buffer(data) if m.get_type() == "COMMAND_LONG"]
    assert {(m.command, m.param1, m.param2, m.target_system) for m in asked} == {(511, 331.0, 50_000.0, 1)}
    assert len(asked) == 4
    assert "ODOMETRY does not arrive although it was asked for" in reader.status()["reasons"]


def test_messages_that_arrive_are_not_asked_for_again_and_shown_with_their_rate() -> None:
    desk = Desk()
    desk.warm_up()
    received = []
    desk_receive = desk.vehicle.receive
    desk.vehicle.receive = lambda now, data: received.append(data[7]) or desk_receive(now, data)  # type: ignore
    for _ in range(100):
        desk.step(100 * MS, np.zeros(4))
    assert dialect.MAVLINK_MSG_ID_COMMAND_LONG not in received
    shown = desk.reader.status()["messages"]["ODOMETRY"]
    assert shown["rate_hz"] == pytest.approx(10.0) and shown["age_s"] == 0.0
    assert desk.reader.status()["reasons"] == []


def test_a_refusal_is_told_with_its_remedy() -> None:
    desk = Desk(vehicle=StandInSettings(sends=("attitude",), boot_ns=BOOT))
    desk.warm_up()
    assert desk.reader.status()["reasons"] == ["the autopilot refuses to send ODOMETRY: choose another source"]
    assert desk.reader.counters["mavlink.request_refused"] == 1


def test_a_dead_link_says_why() -> None:
    reader = AutopilotReader(AutopilotSettings())
    assert "nothing received" in reader.status()["reasons"][0]
    reader.datagram(T0, b"hello")
    assert "no MAVLink frames" in reader.status()["reasons"][0]
    desk = Desk()
    desk.warm_up()
    desk.reader.outgoing(desk.now_ns + 20 * S)
    assert "the autopilot has fallen silent: no HEARTBEAT" in desk.reader.status()["reasons"]


def test_wrong_settings_name_the_key_and_what_is_valid() -> None:
    with pytest.raises(ValueError, match=r"odometry_source: 'wheel' is unknown; valid: odometry, velocity, none"):
        AutopilotSettings(odometry_source="wheel")
    with pytest.raises(ValueError, match=r"fixes: 'depth' is unknown; valid: position, heading, altitude"):
        AutopilotSettings(fixes=("position", "depth"))
    with pytest.raises(ValueError, match="system_id"):
        AutopilotSettings(system_id=0)
    with pytest.raises(ValueError, match="message_interval_ns"):
        AutopilotSettings(message_interval_ns=0)


# -- rubbish ----------------------------------------------------------------------------------------------------


def test_a_flood_of_rubbish_between_frames_costs_nothing() -> None:
    desk, rng = Desk(), random.Random(5)
    desk.warm_up()
    for _ in range(50):
        for _ in range(20):
            desk.reader.datagram(desk.now_ns, b"\xfd" + rng.randbytes(rng.randrange(300)))
        desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.01]))
    assert len(desk.odometry) == 50
    for event in desk.odometry:
        np.testing.assert_allclose(event.delta, [0.1, 0.0, 0.0, 0.01], atol=1e-5)
    assert desk.reader.counters["mavlink.bad_data"] > 500


def test_a_stream_with_rubbish_in_it_goes_on() -> None:
    """Bytes in pieces of any size, noise without a frame marker in between: every frame is read."""
    reader, rng = AutopilotReader(AutopilotSettings()), random.Random(6)
    noise = bytes(value for value in range(256) if value not in (0xFD, 0xFE))
    data = b"".join(heartbeat() + bytes(rng.choices(noise, k=rng.randrange(30))) for _ in range(200))
    while data:
        size = rng.randrange(1, 40)
        reader.stream(T0, data[:size])
        data = data[size:]
    assert reader.messages == 200
    assert reader.counters["mavlink.bad_data"] > 0
    reader.stream(T0, heartbeat()[:9])
    reader.new_stream()
    reader.stream(T0, heartbeat())
    assert reader.messages == 201


def test_ten_thousand_random_strings_do_no_harm() -> None:
    desk, rng = Desk(reader=fix_settings()), random.Random(7)
    desk.warm_up()
    for k in range(10_000):
        data = rng.randbytes(rng.randrange(80))
        if k % 2:
            data = bytes([0xFD, len(data), 0, 0, k % 256, 1, 1]) + data
        assert desk.reader.datagram(desk.now_ns, data) == []
        assert desk.reader.stream(desk.now_ns, data) == []
    desk.step(100 * MS, np.array([0.1, 0.0, 0.0, 0.0]))
    assert len(desk.odometry) == 1


MESSAGES = [
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
    dialect.MAVLINK_MSG_ID_ATTITUDE,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT,
    dialect.MAVLINK_MSG_ID_ODOMETRY,
    dialect.MAVLINK_MSG_ID_TIMESYNC,
    dialect.MAVLINK_MSG_ID_COMMAND_ACK,
    dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
]


@given(
    st.lists(st.tuples(st.sampled_from(MESSAGES), st.binary(min_size=255, max_size=255)), max_size=20),
    st.sampled_from(["odometry", "velocity"]),
    st.sampled_from(["global", "local"]),
)
@settings(max_examples=150, deadline=None)
def test_valid_frames_with_any_content_do_no_harm(
    contents: list[tuple[int, bytes]], source: str, position: str
) -> None:
    """Right checksums, arbitrary payloads: events are finite, ordered, and the reader still works afterwards."""
    desk = Desk(reader=fix_settings(odometry_source=source, position_source=position))
    desk.warm_up()
    events = []
    for message_id, payload in contents:
        kind = dialect.mavlink_map[message_id]
        fields = kind.unpacker.unpack(payload[: kind.unpacker.size])
        header = dialect.MAVLink_message(message_id, kind.msgname)
        packed = kind.unpacker.pack(*fields)
        data = bytes(header._pack(dialect.MAVLink(None, 1, 1), kind.crc_extra, packed))
        events += desk.reader.datagram(desk.now_ns, data)
        desk.reader.outgoing(desk.now_ns)
    for event in events:
        assert np.all(np.isfinite(event.z if isinstance(event, Fix) else event.delta))
        assert event.t_meas_ns <= desk.now_ns + 2 * S
    desk.reader.status()
    assert desk.reader.status()["vehicle"] == {"system": 1, "component": 1}
