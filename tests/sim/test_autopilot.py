"""The autopilot stand-in: what it tells, to whom, and when."""

from __future__ import annotations

import asyncio
import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.fleet_clock import FleetClock
from network.transport import free_port
from sim.autopilot import StandIn, StandInServer, StandInSettings

S = 1_000_000_000
BOOT = 100 * S
ORIGIN = (47.397742, 8.545594, 488.0)
GPS = ("odometry", "global_position", "attitude", "local_position")


def decoded(data: list[bytes]) -> list[Any]:
    parser = dialect.MAVLink(None)
    return [message for frame in data for message in parser.parse_buffer(frame) or ()]


def names(data: list[bytes]) -> list[str]:
    return [message.get_type() for message in decoded(data)]


def command(number: int, *parameters: float, target: int = 1, component: int = 1) -> bytes:
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    message = dialect.MAVLink_command_long_message(target, component, number, 0, *filled)
    return bytes(message.pack(dialect.MAVLink(None, 255, 190)))


def interval(message_id: int, hz: float, target: int = 1) -> bytes:
    return command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / hz, target=target)


def vehicle(flavour: str = "ardupilot", sends: tuple[str, ...] = GPS) -> StandIn:
    return StandIn(StandInSettings(flavour=flavour, sends=sends, origin=ORIGIN, boot_ns=BOOT))


def result(data: list[bytes]) -> int:
    return int(next(m.result for m in decoded(data) if m.get_type() == "COMMAND_ACK"))


def test_ardupilot_streams_nothing_unasked() -> None:
    stand_in, heard = vehicle(), []
    for k in range(40):
        t = BOOT + k * S // 4
        stand_in.set_odometry(t, np.array([0.1, 0.0, 0.0, 0.0]))
        stand_in.set_fix(t, 1.0, 2.0, 0.0, 0.3)
        heard += names(stand_in.outgoing(t)) + names(stand_in.push(t))
    assert heard.count("HEARTBEAT") == 10
    assert heard.count("TIMESYNC") == 1
    assert len(heard) == 11


def test_px4_streams_its_onboard_set() -> None:
    stand_in = vehicle("px4")
    stand_in.set_fix(BOOT + S, 1.0, 2.0, 0.0, 0.3)
    assert {"ODOMETRY", "GLOBAL_POSITION_INT", "ATTITUDE", "LOCAL_POSITION_NED"} <= set(names(stand_in.push(BOOT + S)))
    assert {"SYS_STATUS", "EXTENDED_SYS_STATE", "HEARTBEAT", "TIMESYNC"} <= set(names(stand_in.outgoing(BOOT + S)))


def test_a_requested_message_comes_at_its_interval_and_stops_when_told() -> None:
    stand_in = vehicle()
    assert result(stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_SYS_STATUS, 5.0))) == 0
    heard = [n for k in range(100) for n in names(stand_in.outgoing(BOOT + k * S // 50))]
    assert heard.count("SYS_STATUS") == 10
    off = command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_SYS_STATUS, -1.0)
    assert result(stand_in.receive(BOOT + 2 * S, off)) == 0
    assert "SYS_STATUS" not in names(stand_in.outgoing(BOOT + 4 * S))


def test_motion_is_told_once_per_world_state_with_its_stamp() -> None:
    stand_in = vehicle()
    for message_id in (dialect.MAVLINK_MSG_ID_ODOMETRY, dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT):
        stand_in.receive(BOOT, interval(message_id, 10.0))
    t = BOOT + 2 * S + 345_678_000
    stand_in.set_odometry(t, np.array([1.0, 0.5, 0.25, 0.2]))
    stand_in.set_fix(t, 3.0, 4.0, 5.0, 0.0)
    odometry, position = decoded(stand_in.push(t))
    assert odometry.time_usec == 2_345_678
    assert (odometry.x, odometry.y, odometry.z) == (1.0, -0.5, -0.25)
    assert (odometry.frame_id, odometry.child_frame_id) == (20, 12)
    assert 2.0 * math.atan2(odometry.q[3], odometry.q[0]) == pytest.approx(-0.2, abs=1e-6)
    assert math.isnan(odometry.pose_covariance[0])
    assert position.time_boot_ms == 2345
    assert position.hdg == 9000  # nose east
    here = frames.geodetic_to_enu(position.lat * 1e-7, position.lon * 1e-7, position.alt * 1e-3, ORIGIN)
    np.testing.assert_allclose(here, [3.0, 4.0, 5.0], atol=0.01)
    assert stand_in.push(t) == []
    # Without a new fix there is odometry alone.
    assert names(stand_in.push(t + S)) == ["ODOMETRY"]


def test_a_vehicle_without_gps_knows_neither_place_nor_north() -> None:
    stand_in = vehicle(sends=("odometry", "attitude"))
    for message_id in (
        dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        dialect.MAVLINK_MSG_ID_HOME_POSITION,
        dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    ):
        assert result(stand_in.receive(BOOT, interval(message_id, 1.0))) == dialect.MAV_RESULT_DENIED
    for message_id in (dialect.MAVLINK_MSG_ID_ATTITUDE, dialect.MAVLINK_MSG_ID_GPS_RAW_INT):
        assert result(stand_in.receive(BOOT, interval(message_id, 1.0))) == dialect.MAV_RESULT_ACCEPTED
    stand_in.set_state(BOOT + S, 100.0, 50.0, 0.0, 2.5)
    stand_in.set_odometry(BOOT + S, np.array([1.0, 0.0, 0.0, 0.4]))
    (attitude,) = decoded(stand_in.push(BOOT + S))
    assert frames.heading_from_yaw(attitude.yaw) == pytest.approx(0.4, abs=1e-6)
    gps = next(m for m in decoded(stand_in.outgoing(BOOT + S)) if m.get_type() == "GPS_RAW_INT")
    assert (gps.fix_type, gps.lat, gps.lon) == (dialect.GPS_FIX_TYPE_NO_FIX, 0, 0)


def test_between_fixes_the_attitude_follows_the_odometry_and_not_the_truth() -> None:
    stand_in = vehicle()
    stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_ATTITUDE, 10.0))
    stand_in.set_fix(BOOT + S, 0.0, 0.0, 0.0, 1.0)
    stand_in.set_odometry(BOOT + 2 * S, np.array([1.0, 0.0, 0.0, 0.25]))
    stand_in.set_state(BOOT + 2 * S, 9.0, 9.0, 0.0, -2.0)
    (attitude,) = decoded(stand_in.push(BOOT + 2 * S))
    assert frames.heading_from_yaw(attitude.yaw) == pytest.approx(1.25, abs=1e-6)
    assert attitude.yawspeed == pytest.approx(0.0)


def test_a_late_fix_keeps_its_stamp_and_is_carried_on_by_the_odometry_since() -> None:
    stand_in = vehicle()
    for message_id in (dialect.MAVLINK_MSG_ID_ATTITUDE, dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT):
        stand_in.receive(BOOT, interval(message_id, 10.0))
    for k in (1, 2, 3):
        stand_in.set_odometry(BOOT + k * S, np.array([1.0, 0.0, 0.0, 0.25]))
    stand_in.set_fix(BOOT + S, 3.0, 4.0, 0.0, 1.0)
    found = {message.get_type(): message for message in decoded(stand_in.push(BOOT + 3 * S))}
    assert found["GLOBAL_POSITION_INT"].time_boot_ms == 1000
    assert frames.heading_from_yaw(found["ATTITUDE"].yaw) == pytest.approx(1.5, abs=1e-6)


@pytest.mark.parametrize("own_fixes", [False, True])
def test_a_vehicle_with_fixes_of_its_own_never_tells_the_true_place(own_fixes: bool) -> None:
    """A sensor of the scenario that is silent from the start is not replaced by a perfect one."""
    stand_in = StandIn(StandInSettings(sends=GPS, origin=ORIGIN, boot_ns=BOOT, own_fixes=own_fixes))
    stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 10.0))
    stand_in.set_state(BOOT + S, 1.0, 2.0, 0.0, 0.5)
    assert names(stand_in.push(BOOT + S)) == ([] if own_fixes else ["GLOBAL_POSITION_INT"])
    stand_in.set_fix(BOOT + 2 * S, 3.0, 4.0, 0.0, 1.0)
    assert names(stand_in.push(BOOT + 2 * S)) == ["GLOBAL_POSITION_INT"]


def test_a_fix_that_a_newer_one_has_overtaken_is_not_told() -> None:
    stand_in = vehicle()
    stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, 10.0))
    stand_in.set_fix(BOOT + 2 * S, 3.0, 4.0, 0.0, 1.0)
    stand_in.set_fix(BOOT + S, 9.0, 9.0, 0.0, 1.0)
    (position,) = decoded(stand_in.push(BOOT + 3 * S))
    assert position.time_boot_ms == 2000


def test_local_position_is_told_in_its_own_frame() -> None:
    stand_in = vehicle(sends=("local_position", "global_position"))
    stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 10.0))
    stand_in.set_state(BOOT, 200.0, 100.0, 3.0, 0.0)
    stand_in.push(BOOT)
    stand_in.set_state(BOOT + S, 203.0, 104.0, 4.0, 0.0, 1.0, 2.0, 0.5)
    (local,) = decoded(stand_in.push(BOOT + S))
    np.testing.assert_allclose([local.x, local.y, local.z], [4.0, 3.0, -1.0], atol=1e-3)
    np.testing.assert_allclose([local.vx, local.vy, local.vz], [2.0, 1.0, -0.5], atol=1e-6)


def test_commands_for_other_vehicles_are_left_alone() -> None:
    stand_in = vehicle()
    assert stand_in.receive(BOOT, interval(dialect.MAVLINK_MSG_ID_ODOMETRY, 10.0, target=2)) == []
    stand_in.set_odometry(BOOT + S, np.ones(4))
    assert stand_in.push(BOOT + S) == []
    assert stand_in.counters["other_target"] == 1


def test_other_flight_commands_are_not_supported() -> None:
    stand_in = vehicle()
    answer = stand_in.receive(BOOT, command(dialect.MAV_CMD_NAV_TAKEOFF, 1.0))
    (ack,) = decoded(answer)
    assert (ack.result, ack.target_system, ack.target_component) == (dialect.MAV_RESULT_UNSUPPORTED, 255, 190)


def test_single_messages_on_request() -> None:
    stand_in = vehicle()
    version = command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert names(stand_in.receive(BOOT, version)) == ["COMMAND_ACK", "AUTOPILOT_VERSION"]
    home = command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_HOME_POSITION)
    assert result(stand_in.receive(BOOT, home)) == dialect.MAV_RESULT_DENIED  # not known yet
    stand_in.set_fix(BOOT, 0.0, 0.0, 0.0, 0.0)
    assert names(stand_in.receive(BOOT, home)) == ["COMMAND_ACK", "HOME_POSITION"]


def test_timesync_both_ways() -> None:
    stand_in, own = vehicle(), dialect.MAVLink(None, 1, 191)
    request = dialect.MAVLink_timesync_message(0, 7777)
    (answer,) = decoded(stand_in.receive(BOOT + 5 * S, request.pack(own)))
    assert (answer.tc1, answer.ts1) == (5 * S, 7777)
    asked = next(m for m in decoded(stand_in.outgoing(BOOT + 6 * S)) if m.get_type() == "TIMESYNC")
    assert (asked.tc1, asked.ts1) == (0, 6 * S)
    reply = dialect.MAVLink_timesync_message(BOOT + 6 * S + 1000, asked.ts1)
    assert stand_in.receive(BOOT + 6 * S + 2000, reply.pack(own)) == []
    assert stand_in.companion_offset_ns == BOOT


def test_wrong_settings_name_what_is_valid() -> None:
    with pytest.raises(ValueError, match=r"flavour.*ardupilot, px4"):
        StandInSettings(flavour="betaflight")
    with pytest.raises(ValueError, match=r"sends.*odometry"):
        StandInSettings(sends=("lidar",))
    with pytest.raises(ValueError, match=r"mode: 'OFFBOARD'.*GUIDED"):
        StandInSettings(mode="OFFBOARD")
    with pytest.raises(ValueError, match="vehicle_type: 1 "):
        StandInSettings(vehicle_type=dialect.MAV_TYPE_FIXED_WING)


@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True, width=32), min_size=7, max_size=7), st.integers(0, 65535)
)
def test_no_command_can_hurt(parameters: list[float], number: int) -> None:
    stand_in = vehicle()
    for choice in (
        number,
        dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
        dialect.MAV_CMD_REQUEST_MESSAGE,
        dialect.MAV_CMD_COMPONENT_ARM_DISARM,
        dialect.MAV_CMD_DO_SET_MODE,
    ):
        assert names(stand_in.receive(BOOT, command(choice, *parameters)))[0] == "COMMAND_ACK"
    stand_in.outgoing(BOOT + S)
    assert stand_in.next_deadline_ns() > BOOT + S


# -- on a socket ------------------------------------------------------------------------------------------------


def test_a_wrong_endpoint_is_refused_with_the_valid_form() -> None:
    with pytest.raises(ValueError, match="udpout:HOST:PORT"):
        StandInServer(vehicle(), "tcp:127.0.0.1:5760", FleetClock())


def test_mavsdk_finds_the_vehicle_and_reads_it() -> None:
    """An independent implementation sets the rates and reads place, attitude, home and health."""
    found = asyncio.run(judged(free_port()))
    assert found["system"] == 3
    np.testing.assert_allclose(
        frames.geodetic_to_enu(found["lat"], found["lon"], found["alt"], ORIGIN), [30.0, 40.0, 2.0], atol=0.02
    )
    assert frames.heading_from_yaw(math.radians(found["yaw_deg"])) == pytest.approx(0.5, abs=1e-4)
    np.testing.assert_allclose([found["north_m"], found["east_m"]], [0.0, 0.0], atol=0.01)
    assert found["home_lat"] == pytest.approx(found["lat"], abs=1e-6)
    assert found["health"]["is_global_position_ok"] and found["health"]["is_home_position_ok"]


async def judged(port: int) -> dict[str, Any]:
    clock = FleetClock(0, time.monotonic_ns())
    settings = StandInSettings(system_id=3, sends=GPS, origin=ORIGIN, boot_ns=-5 * S)
    server = StandInServer(StandIn(settings), f"udpout:127.0.0.1:{port}", clock)
    await server.start()
    judge = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",
        str(Path(__file__).with_name("mavsdk_judge.py")),
        str(port),
        stdout=asyncio.subprocess.PIPE,
    )

    async def drive() -> None:
        while True:
            now = clock.now_ns()
            server.stand_in.set_odometry(now, np.zeros(4))
            server.stand_in.set_fix(now, 30.0, 40.0, 2.0, 0.5)
            server.push(now)
            await asyncio.sleep(0.05)

    driving = asyncio.create_task(drive())
    try:
        output, _ = await judge.communicate()
    finally:
        driving.cancel()
        if judge.returncode is None:
            judge.kill()
            await judge.wait()
        await server.close()
    assert judge.returncode == 0
    # The library logs to standard output as well.
    found: dict[str, Any] = json.loads(output.decode().strip().splitlines()[-1])
    return found
