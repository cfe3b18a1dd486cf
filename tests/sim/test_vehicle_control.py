"""How the stand-in obeys: arming, modes and set-points, as measured with ArduPilot and as PX4 documents."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.effects import Steer
from agent.flight_modes import PX4
from sim.autopilot import StandIn, StandInSettings

S = 1_000_000_000
MS = 1_000_000
BOOT = 100 * S
NOW = BOOT + 60 * S
STILL = ((0.0, 0.0, 0.0), 0.0)
ROVER, COPTER = dialect.MAV_TYPE_GROUND_ROVER, dialect.MAV_TYPE_QUADROTOR
VELOCITY_AND_YAW_RATE, VELOCITY, VELOCITY_AND_YAW, POSITION = 0x05C7, 0x0DC7, 0x09C7, 0x0DF8
STEERED = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}


def vehicle(flavour: str = "ardupilot", kind: int = COPTER, *, armed: bool = True, mode: str | None = None) -> StandIn:
    mode = STEERED[flavour] if mode is None else mode
    return StandIn(
        StandInSettings(flavour=flavour, boot_ns=BOOT, vehicle_type=kind, armed=armed, mode=mode, sends=("odometry",))
    )


def setpoint(
    *velocity: float, yaw_rate: float = 0.0, yaw: float = 0.0, frame: int = 8, mask: int = 0x05C7, target: int = 1
) -> bytes:
    message = dialect.MAVLink_set_position_target_local_ned_message(
        0, target, 1, frame, mask, 0, 0, 0, *velocity, 0, 0, 0, yaw, yaw_rate
    )
    return bytes(message.pack(dialect.MAVLink(None, 1, 191)))


def order(number: int, *parameters: float, target: int = 1) -> bytes:
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    message = dialect.MAVLink_command_long_message(target, 1, number, 0, *filled)
    return bytes(message.pack(dialect.MAVLink(None, 1, 191)))


def arm(value: float = 1.0, target: int = 1) -> bytes:
    return order(dialect.MAV_CMD_COMPONENT_ARM_DISARM, value, target=target)


def decoded(data: list[bytes]) -> list[Any]:
    parser = dialect.MAVLink(None)
    return [message for frame in data for message in parser.parse_buffer(frame) or ()]


def answer(stand_in: StandIn, t_ns: int, data: bytes) -> tuple[int, str | None]:
    """The result, and the text that came with it."""
    messages = decoded(stand_in.receive(t_ns, data))
    texts = [message.text for message in messages if message.get_type() == "STATUSTEXT"]
    return messages[0].result, texts[0] if texts else None


def beat(stand_in: StandIn, t_ns: int) -> Any:
    return next(message for message in decoded(stand_in.outgoing(t_ns)) if message.get_type() == "HEARTBEAT")


def turned(stand_in: StandIn, angle: float, t_ns: int = NOW) -> None:
    """The vehicle's local frame starts with its nose to the east."""
    stand_in.set_odometry(t_ns, np.array([0.0, 0.0, 0.0, angle]))


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_velocity_in_the_body_frame_is_forward_right_down_and_clockwise(flavour: str) -> None:
    stand_in = vehicle(flavour)
    turned(stand_in, 1.0)
    assert stand_in.receive(NOW, setpoint(1.0, -0.5, -0.25, yaw_rate=-0.3)) == [], "set-points are not acknowledged"
    assert stand_in.control.commanded(NOW) == (pytest.approx((1.0, 0.5, 0.25)), pytest.approx(0.3))


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_velocity_in_the_local_frame_is_north_east_down_and_goes_with_the_heading(flavour: str) -> None:
    stand_in = vehicle(flavour)
    stand_in.receive(NOW, setpoint(2.0, 1.0, 0.0, frame=1, mask=VELOCITY))
    assert stand_in.control.commanded(NOW) == (pytest.approx((1.0, 2.0, 0.0)), 0.0)
    turned(stand_in, math.pi / 2.0)
    assert stand_in.control.commanded(NOW) == (pytest.approx((2.0, -1.0, 0.0)), 0.0)


def test_a_copter_turns_to_the_yaw_it_is_given() -> None:
    stand_in = vehicle()
    stand_in.receive(NOW, setpoint(0.0, 0.0, 0.0, yaw=0.0, frame=1, mask=VELOCITY_AND_YAW))
    for k in range(100):
        rate = (stand_in.control.commanded(NOW) or STILL)[1]
        assert 0.0 <= rate <= 1.0
        turned(stand_in, 0.1 * rate, NOW + k)
    assert stand_in.control.commanded(NOW) == ((0.0, 0.0, 0.0), pytest.approx(0.0, abs=1e-3))


def test_a_rover_told_to_go_east_turns_there_and_goes() -> None:
    """As a real one did: frame 1, (0, 1.5)."""
    stand_in = vehicle(kind=ROVER)
    turned(stand_in, -math.pi / 2.0)
    stand_in.receive(NOW, setpoint(0.0, 1.5, 0.0, frame=1, mask=VELOCITY))
    velocity, rate = stand_in.control.commanded(NOW) or STILL
    assert velocity == pytest.approx((0.0, 0.0, 0.0)) and rate == 1.0
    for k in range(100):
        turned(stand_in, 0.1 * (stand_in.control.commanded(NOW) or STILL)[1], NOW + k)
    velocity, rate = stand_in.control.commanded(NOW) or STILL
    assert velocity == (pytest.approx(1.5, abs=1e-3), 0.0, 0.0) and rate == pytest.approx(0.0, abs=1e-3)


def test_a_rover_does_not_go_sideways() -> None:
    stand_in = vehicle(kind=ROVER)
    stand_in.receive(NOW, setpoint(1.0, 0.7, 0.2, yaw_rate=0.3))
    assert stand_in.control.commanded(NOW) == ((1.0, 0.0, 0.0), pytest.approx(-0.3))


def test_ardupilot_holds_a_set_point_for_three_seconds_and_then_stands_still_in_guided() -> None:
    stand_in = vehicle()
    stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
    assert stand_in.control.commanded(NOW + 3 * S - 1) != STILL
    assert stand_in.control.commanded(NOW + 3 * S) == STILL
    assert beat(stand_in, NOW + 10 * S).custom_mode == 4
    stand_in.receive(NOW + 10 * S, setpoint(1.0, 0.0, 0.0))
    assert stand_in.control.commanded(NOW + 10 * S) != STILL


def test_px4_leaves_offboard_after_a_second() -> None:
    stand_in = vehicle("px4")
    stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
    assert stand_in.control.commanded(NOW + S - 1) != STILL
    assert stand_in.control.commanded(NOW + S + 1) is None
    assert beat(stand_in, NOW + 2 * S).custom_mode == PX4.modes["POSCTL"]
    stand_in.receive(NOW + 2 * S, setpoint(1.0, 0.0, 0.0))
    assert stand_in.control.commanded(NOW + 2 * S) is None, "and does not come back by itself"


def test_px4_enters_offboard_only_while_set_points_come() -> None:
    stand_in, switch = vehicle("px4", mode="POSCTL"), order(dialect.MAV_CMD_DO_SET_MODE, 1.0, 6.0)
    result, text = answer(stand_in, NOW, switch)
    assert result == dialect.MAV_RESULT_TEMPORARILY_REJECTED and "Offboard" in (text or "")
    t = NOW
    for gap, count, good in ((600 * MS, 6, False), (400 * MS, 3, False), (400 * MS, 5, True)):
        t += 5 * S
        for _ in range(count):
            t += gap
            stand_in.receive(t, setpoint(0.0, 0.0, 0.0))
        assert (answer(stand_in, t, switch)[0] == dialect.MAV_RESULT_ACCEPTED) == good, (gap, count)
    assert beat(stand_in, t + 1).custom_mode == 6 << 16


@pytest.mark.parametrize("kind", [COPTER, ROVER])
def test_ardupilot_stops_on_a_frame_or_mask_it_does_not_know(kind: int) -> None:
    """BODY_FRD, which the standard recommends, made both stop without a word."""
    for wrong in (
        setpoint(1.0, 0.0, 0.0, frame=12),
        setpoint(1.0, 0.0, 0.0, mask=POSITION),
        setpoint(1.0, 0.0, 0.0, mask=0x05C7 | 0x200),
        setpoint(math.nan, 0.0, 0.0),
    ):
        stand_in = vehicle(kind=kind)
        stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
        assert stand_in.receive(NOW + 1, wrong) == []
        assert stand_in.control.commanded(NOW + 1) == STILL


def test_px4_ignores_a_frame_that_it_does_not_know() -> None:
    stand_in = vehicle("px4")
    stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
    for k in range(5):
        stand_in.receive(NOW + k * S // 5, setpoint(0.5, 0.0, 0.0, frame=12))
    assert stand_in.control.commanded(NOW + S - 1) == ((1.0, 0.0, 0.0), 0.0)
    assert stand_in.control.commanded(NOW + S + 1) is None, "nor do they count as a sign of life"
    assert stand_in.control.counters["setpoint.frame"] == 5


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_unarmed_or_in_another_mode_set_points_are_ignored(flavour: str) -> None:
    for stand_in in (vehicle(flavour, armed=False), vehicle(flavour, mode="LOITER")):
        stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
        assert stand_in.control.commanded(NOW) is None
        assert stand_in.control.counters["setpoint.ignored"] == 1


def test_set_points_and_commands_for_others_are_left_alone() -> None:
    stand_in = vehicle()
    assert stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0, target=7)) == []
    assert stand_in.receive(NOW, arm(0.0, target=7)) == []
    assert stand_in.control.commanded(NOW) == STILL
    assert stand_in.counters["other_target"] == 2


def test_arming_is_refused_until_the_sensors_have_settled() -> None:
    not_now = dialect.MAV_RESULT_TEMPORARILY_REJECTED
    for flavour, refused in (("ardupilot", dialect.MAV_RESULT_FAILED), ("px4", not_now)):
        stand_in = vehicle(flavour, armed=False, mode="LOITER")
        assert answer(stand_in, BOOT + 5 * S, arm()) == (refused, "Arm: Gyros inconsistent")
        # MAVSDK sends NaN for what it does not mean.
        unmeant = order(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, math.nan, math.nan)
        assert answer(stand_in, BOOT + 20 * S, unmeant) == (dialect.MAV_RESULT_ACCEPTED, None)
        armed = beat(stand_in, BOOT + 21 * S)
        assert armed.base_mode & 128 and armed.system_status == dialect.MAV_STATE_ACTIVE
        assert answer(stand_in, BOOT + 30 * S, arm(0.0)) == (dialect.MAV_RESULT_ACCEPTED, None)
        assert not beat(stand_in, BOOT + 31 * S).base_mode & 128
        assert answer(stand_in, BOOT + 40 * S, arm(2.0))[0] == dialect.MAV_RESULT_UNSUPPORTED


def test_px4_is_not_armed_in_offboard_without_set_points() -> None:
    stand_in = vehicle("px4", armed=False)
    result, text = answer(stand_in, NOW, arm())
    assert result == dialect.MAV_RESULT_TEMPORARILY_REJECTED and text == "Arming denied: no offboard signal"


def test_modes_by_number() -> None:
    stand_in, change = vehicle(kind=ROVER, mode="MANUAL"), dialect.MAV_CMD_DO_SET_MODE
    assert beat(stand_in, NOW).custom_mode == 0
    assert answer(stand_in, NOW, order(change, 1.0, 15.0))[0] == dialect.MAV_RESULT_ACCEPTED
    assert beat(stand_in, NOW + S).custom_mode == 15
    assert answer(stand_in, NOW, order(change, 1.0, 77.0))[0] == dialect.MAV_RESULT_FAILED
    assert answer(stand_in, NOW, order(change, 0.0, 4.0))[0] == dialect.MAV_RESULT_DENIED
    assert answer(stand_in, NOW, order(change, math.nan, math.inf))[0] == dialect.MAV_RESULT_DENIED
    old = dialect.MAVLink_set_mode_message(1, 1, 4).pack(dialect.MAVLink(None, 255, 190))
    (ack,) = decoded(stand_in.receive(NOW + S, old))
    assert (ack.command, ack.result) == (dialect.MAVLINK_MSG_ID_SET_MODE, dialect.MAV_RESULT_ACCEPTED)
    assert beat(stand_in, NOW + 2 * S).custom_mode == 4


def test_a_reboot_disarms() -> None:
    stand_in = vehicle()
    stand_in.reboot(NOW)
    assert not stand_in.control.armed


def test_a_copter_that_is_armed_is_in_the_air_and_a_rover_never() -> None:
    for kind, state in ((COPTER, dialect.MAV_LANDED_STATE_IN_AIR), (ROVER, dialect.MAV_LANDED_STATE_ON_GROUND)):
        assert vehicle(kind=kind).message("EXTENDED_SYS_STATE", NOW).landed_state == state


# -- what a world is told ---------------------------------------------------------------------------------------


def test_commands_count_from_their_arrival_and_say_when_they_end() -> None:
    stand_in = vehicle()
    assert stand_in.control.commands(NOW) == []
    stand_in.receive(NOW + 100 * MS, setpoint(1.0, 0.0, 0.0))
    stand_in.receive(NOW + 300 * MS, setpoint(0.5, 0.0, 0.0, yaw_rate=-0.5))
    assert stand_in.control.commands(NOW + 200 * MS) == [
        (NOW + 100 * MS, Steer((1.0, 0.0, 0.0), 0.0, NOW + 100 * MS + 3 * S))
    ]
    assert stand_in.control.commands(NOW + S) == [(NOW + 300 * MS, Steer((0.5, 0.0, 0.0), 0.5, NOW + 300 * MS + 3 * S))]
    assert stand_in.control.commands(NOW + 2 * S) == []


@pytest.mark.parametrize("how", ["by hand", "disarmed", "lost"])
def test_who_takes_the_vehicle_away_stops_it(how: str) -> None:
    """Where a person drives it nobody models: it stands."""
    stand_in = vehicle("px4" if how == "lost" else "ardupilot")
    stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
    stand_in.control.commands(NOW)
    end = NOW + (S if how == "lost" else S // 2)
    if how == "by hand":
        stand_in.control.by_hand(end, "LOITER")
    elif how == "disarmed":
        stand_in.receive(end, arm(0.0))
    assert stand_in.control.commands(NOW + 2 * S) == [(end, Steer((0.0, 0.0, 0.0), 0.0, end))]


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_a_vehicle_that_is_given_back_does_not_go_on_with_what_it_was_told_before(flavour: str) -> None:
    for away in ("mode", "disarmed"):
        stand_in = vehicle(flavour)
        stand_in.receive(NOW, setpoint(1.0, 0.0, 0.0))
        if away == "mode":
            stand_in.control.by_hand(NOW, "LOITER")
            stand_in.control.by_hand(NOW, STEERED[flavour])
        else:
            stand_in.receive(NOW, arm(0.0))
            stand_in.control.armed = True
        assert stand_in.control.commanded(NOW + S // 2) == STILL


def test_a_motion_over_the_ground_is_told_anew_as_the_vehicle_turns() -> None:
    stand_in = vehicle()
    stand_in.receive(NOW, setpoint(0.0, 1.0, 0.0, frame=1, mask=VELOCITY_AND_YAW_RATE, yaw_rate=0.0))
    ((_, first),) = stand_in.control.commands(NOW + S)
    turned(stand_in, math.pi / 2.0, NOW + S)
    ((t, second),) = stand_in.control.commands(NOW + 2 * S)
    assert first.velocity_mps == pytest.approx((1.0, 0.0, 0.0))
    assert t == NOW + S and second.velocity_mps == pytest.approx((0.0, -1.0, 0.0))
    assert second.until_ns == first.until_ns == NOW + 3 * S


number = st.floats(width=32, allow_nan=True, allow_infinity=True)


@given(
    st.lists(st.tuples(number, number, number, number, number, st.integers(0, 255), st.integers(0, 65535)), max_size=5),
    st.sampled_from(["ardupilot", "px4"]),
    st.sampled_from([ROVER, COPTER]),
)
def test_no_set_point_can_hurt(rows: list[Any], flavour: str, kind: int) -> None:
    stand_in = vehicle(flavour, kind)
    for x, y, z, yaw, yaw_rate, frame, mask in rows:
        stand_in.receive(NOW, setpoint(x, y, z, yaw=yaw, yaw_rate=yaw_rate, frame=frame, mask=mask))
        motion = stand_in.control.commanded(NOW)
        assert motion is not None and all(map(math.isfinite, (*motion[0], motion[1])))
    assert len(stand_in.control.commands(NOW)) <= len(rows)
