"""Steering over MAVLink, against the stand-in and against vectors from outside; bytes passed by hand."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.autopilot import AutopilotReader
from agent.autopilot_settings import AutopilotSettings
from agent.effects import Steer
from agent.events import ControlReport
from agent.flight_modes import ARDUCOPTER, ARDUROVER, PX4, controls
from agent.steering_link import SteeringSettings
from sim.autopilot import StandIn, StandInSettings

S = 1_000_000_000
MS = 1_000_000
T0 = 1_700_000_000 * S
STEP = 20 * MS
AHEAD = ((0.4, 0.0, 0.0), 0.25)
STILL = ((0.0, 0.0, 0.0), 0.0)
FLAVOURS = ("ardupilot", "px4")
HANDED_OVER = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}
MODEST = SteeringSettings()
ASKING = SteeringSettings(arm=True, set_mode=True)


class Cable:
    """An agent's reader and a vehicle, driven in steps of 20 ms; what the agent says is kept with its time."""

    def __init__(
        self,
        flavour: str = "ardupilot",
        steering: SteeringSettings | None = MODEST,
        *,
        vehicle_type: int = dialect.MAV_TYPE_GROUND_ROVER,
        armed: bool = True,
        boot_ns: int = T0 - 60 * S,
        mode: str | None = None,
    ) -> None:
        self.reader = AutopilotReader(AutopilotSettings(odometry_source="none", steering=steering))
        self.vehicle = StandIn(
            StandInSettings(flavour=flavour, boot_ns=boot_ns, vehicle_type=vehicle_type, armed=armed, mode=mode)
        )
        self.now_ns = T0
        self.said: list[tuple[int, Any]] = []
        self.reports: list[str | None] = []
        self.deaf = False
        self._parser = dialect.MAVLink(None)

    def drive(self, seconds: float, motion: Any = None, until_ns: int | None = None) -> None:
        """Let time pass; a motion is asked for twice a second, for the second that follows, as a planner does."""
        for k in range(round(seconds * S / STEP)):
            self.now_ns += STEP
            if motion is not None and k % 25 == 0:
                self.steer(motion, self.now_ns + S if until_ns is None else until_ns)
            for frame in self.vehicle.outgoing(self.now_ns):
                self._hear(frame)
            for frame in self.reader.outgoing(self.now_ns):
                self.said += [(self.now_ns, message) for message in self._parser.parse_buffer(frame)]
                for answer in self.vehicle.receive(self.now_ns, frame):
                    self._hear(answer)
            self.reports += [report.refused for report in self.reader.reports(self.now_ns)]

    def _hear(self, frame: bytes) -> None:
        if not self.deaf:
            self.reader.datagram(self.now_ns, frame)

    def steer(self, motion: Any, until_ns: int) -> None:
        self.reader.steer(Steer(*motion, until_ns))

    @property
    def commanded(self) -> Any:
        return self.vehicle.control.commanded(self.now_ns)

    def setpoints(self, since_ns: int = 0) -> list[tuple[int, Any]]:
        name = "SET_POSITION_TARGET_LOCAL_NED"
        return [(t, message) for t, message in self.said if message.get_type() == name and t > since_ns]

    def asked(self) -> list[int]:
        """Commands to arm or to change the mode."""
        numbers = [message.command for _, message in self.said if message.get_type() == "COMMAND_LONG"]
        return [number for number in numbers if number != dialect.MAV_CMD_SET_MESSAGE_INTERVAL]

    def hand_over(self) -> None:
        self.vehicle.control.by_hand(self.now_ns, HANDED_OVER[self.vehicle.settings.flavour])


@pytest.mark.parametrize("flavour", FLAVOURS)
@pytest.mark.parametrize("vehicle_type", [dialect.MAV_TYPE_GROUND_ROVER, dialect.MAV_TYPE_QUADROTOR])
def test_a_vehicle_that_a_person_hands_over_is_steered_and_never_asked_for_more(
    flavour: str, vehicle_type: int
) -> None:
    cable = Cable(flavour, vehicle_type=vehicle_type, armed=False)
    cable.drive(3.0, AHEAD)
    assert cable.commanded is None
    mode = HANDED_OVER[flavour]
    assert f"switch it to {mode}, or set mavlink.set_mode = true" in (cable.reports[-1] or "")
    cable.hand_over()
    cable.drive(1.5, AHEAD)
    assert cable.reports[-1] == "not armed: arm it, or set mavlink.arm = true"
    assert all((m.vx, m.yaw_rate) == (0.0, 0.0) for _, m in cable.setpoints())
    assert bool(cable.setpoints()) == (flavour == "px4"), "which wants them before"
    cable.vehicle.control.armed = True
    cable.drive(1.5, AHEAD)
    assert cable.reports[-1] is None
    assert cable.commanded == (pytest.approx((0.4, 0.0, 0.0)), pytest.approx(0.25))
    assert cable.asked() == []
    assert len(cable.reports) == 3, "on change only"


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_where_it_is_allowed_the_mode_is_asked_for_and_then_arming(flavour: str) -> None:
    cable = Cable(flavour, ASKING, armed=False)
    cable.drive(2.0)
    assert cable.asked() == [], "nothing is asked for before there is a motion"
    cable.drive(6.0, AHEAD)
    assert cable.asked() == [176, 400]
    assert cable.vehicle.control.armed and cable.reports[-1] is None
    assert cable.commanded == (pytest.approx((0.4, 0.0, 0.0)), pytest.approx(0.25))
    if flavour == "px4":
        first = cable.setpoints()[0][0]
        switch = next(t for t, m in cable.said if m.get_type() == "COMMAND_LONG" and m.command == 176)
        assert switch - first > S, "set-points come before the switch"
        early = [m for t, m in cable.setpoints() if t <= switch]
        assert all((m.vx, m.vy, m.vz, m.yaw_rate) == (0.0, 0.0, 0.0, 0.0) for m in early)


def test_a_set_point_says_forward_right_down_and_clockwise() -> None:
    """Literal values of MAVLink's common.xml; frame and mask as flown with a real ArduPilot, frame as PX4 documents."""
    cable = Cable(mode="GUIDED", vehicle_type=dialect.MAV_TYPE_QUADROTOR)
    cable.drive(1.0, ((1.0, 0.5, 0.25), 0.3))
    message = cable.setpoints()[-1][1]
    assert (message.vx, message.vy, message.vz) == (1.0, -0.5, -0.25)
    assert message.yaw_rate == pytest.approx(-0.3)
    assert (message.coordinate_frame, message.type_mask) == (8, 0x05C7)
    assert (message.target_system, message.target_component) == (1, 1)
    assert cable.commanded == (pytest.approx((1.0, 0.5, 0.25)), pytest.approx(0.3))


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_the_rate_suits_both(flavour: str) -> None:
    """PX4 wants more than 2 Hz, ArduPilot holds one for 3 s; a slow serial line has to carry it."""
    cable = Cable(flavour, mode=HANDED_OVER[flavour])
    cable.drive(1.5, AHEAD)
    begun = cable.now_ns
    cable.drive(5.0, AHEAD)
    times = [t for t, _ in cable.setpoints(begun)]
    assert max(b - a for a, b in pairwise(times)) <= {"ardupilot": 3 * S // 10, "px4": S // 5}[flavour]
    assert len(times) in {"ardupilot": range(18, 22), "px4": range(45, 63)}[flavour]


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_when_a_motion_ends_the_vehicle_is_stopped_and_then_left_alone(flavour: str) -> None:
    cable = Cable(flavour, mode=HANDED_OVER[flavour])
    cable.drive(2.0, AHEAD)
    until = cable.now_ns + 250 * MS
    cable.steer(AHEAD, until)
    cable.drive(0.24)
    assert cable.commanded != STILL
    cable.drive(0.04)
    assert cable.commanded == STILL, "at once, not at the next interval"
    cable.drive(2.0)
    late = cable.setpoints(until - MS)
    assert len(late) in {"ardupilot": range(4, 6), "px4": range(5, 13)}[flavour]
    assert all((m.vx, m.vy, m.vz, m.yaw_rate) == (0.0, 0.0, 0.0, 0.0) for _, m in late)
    assert late[-1][0] <= until + S
    # Told to move again, ArduPilot does; PX4 has left OFFBOARD.
    cable.drive(1.5, AHEAD)
    assert (cable.commanded is None) == (flavour == "px4")
    assert (cable.reports[-1] or "").startswith("taken over: the mode is POSCTL") == (flavour == "px4")


@pytest.mark.parametrize("steering", [MODEST, ASKING])
def test_who_changes_the_mode_has_the_vehicle(steering: SteeringSettings) -> None:
    cable = Cable("ardupilot", steering, mode="GUIDED")
    cable.drive(2.0, AHEAD)
    cable.vehicle.control.by_hand(cable.now_ns, "MANUAL")
    cable.drive(1.1, AHEAD)
    noticed = cable.now_ns
    cable.drive(5.0, AHEAD)
    assert cable.setpoints(noticed) == [] and cable.asked() == []
    assert cable.reports[-1] == "taken over: the mode is MANUAL; switch it to GUIDED to hand the vehicle over"
    cable.hand_over()
    cable.drive(1.5, AHEAD)
    assert cable.reports[-1] is None and cable.commanded != STILL


def test_px4_in_another_mode_is_told_to_stand_still_so_that_a_person_can_switch_back() -> None:
    cable = Cable("px4", ASKING, mode="OFFBOARD")
    cable.drive(2.0, AHEAD)
    cable.vehicle.control.by_hand(cable.now_ns, "POSCTL")
    cable.drive(1.1, AHEAD)
    noticed = cable.now_ns
    cable.drive(3.0, AHEAD)
    assert all((m.vx, m.yaw_rate) == (0.0, 0.0) for _, m in cable.setpoints(noticed)) and cable.setpoints(noticed)
    assert cable.asked() == []
    flag, main, sub = PX4.parameters("OFFBOARD")
    answer = cable.vehicle.receive(cable.now_ns, order(dialect.MAV_CMD_DO_SET_MODE, flag, main, sub))
    assert dialect.MAVLink(None).parse_buffer(answer[0])[0].result == dialect.MAV_RESULT_ACCEPTED
    cable.drive(1.5, AHEAD)
    assert cable.reports[-1] is None and cable.commanded != STILL


def test_the_mode_of_a_vehicle_that_is_armed_is_left_alone() -> None:
    """Somebody may be driving: after a restart of the agent too."""
    cable = Cable("ardupilot", ASKING, armed=True)
    cable.drive(5.0, AHEAD)
    assert cable.asked() == [] and cable.setpoints() == []
    assert cable.reports == ["the mode is MANUAL: switch it to GUIDED"]


def test_a_mode_that_somebody_else_chooses_meanwhile_stands() -> None:
    cable = Cable("ardupilot", ASKING, armed=False)
    cable.drive(1.2)
    # The requests get lost.
    cable.vehicle.control.change_mode = lambda now_ns, base, custom: (4, None)  # type: ignore[method-assign]
    cable.drive(1.2, AHEAD)
    assert cable.reports[-1] == "GUIDED refused: failed"
    cable.vehicle.control.by_hand(cable.now_ns, "HOLD")
    cable.drive(1.2, AHEAD)
    asked = len(cable.asked())
    cable.drive(6.0, AHEAD)
    assert len(cable.asked()) == asked
    assert (cable.reports[-1] or "").startswith("taken over: the mode is HOLD")


def test_who_disarms_a_vehicle_has_it() -> None:
    cable = Cable("ardupilot", ASKING, armed=False)
    cable.drive(4.0, AHEAD)
    assert cable.vehicle.control.armed
    cable.vehicle.control.armed = False
    asked = cable.asked()
    cable.drive(6.0, AHEAD)
    assert cable.asked() == asked and not cable.vehicle.control.armed
    assert cable.reports[-1] == "disarmed: arm it to go on"


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_why_arming_is_refused_is_told_and_it_is_tried_again(flavour: str) -> None:
    cable = Cable(flavour, ASKING, armed=False, boot_ns=T0 - 8 * S)
    cable.drive(5.0, AHEAD)
    assert cable.reports[-1] == "arming refused: Arm: Gyros inconsistent"
    cable.drive(6.0, AHEAD)
    assert cable.reports[-1] is None and cable.commanded != STILL


def test_an_autopilot_that_falls_silent_is_told_to_stop_and_no_more() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    cable.drive(2.0, AHEAD)
    cable.deaf = True
    cable.drive(7.0, AHEAD, until_ns=cable.now_ns + 3600 * S)
    since = cable.now_ns - 2 * S
    assert cable.reports[-1] == "the autopilot is silent: it is not steered"
    assert cable.setpoints(since) == [] and cable.commanded == STILL
    cable.deaf = False
    cable.drive(1.5, AHEAD)
    assert cable.reports[-1] is None and cable.commanded != STILL


def test_the_last_words_stop_a_vehicle_that_moves_and_nobody_elses() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    cable.drive(1.2)
    assert cable.reader.parting(cable.now_ns) == []
    cable.drive(1.0, AHEAD)
    parting = cable.reader.parting(cable.now_ns)
    assert len(parting) == 3
    cable.vehicle.receive(cable.now_ns, parting[0])
    assert cable.commanded == STILL
    cable.vehicle.control.by_hand(cable.now_ns, "MANUAL")
    cable.drive(1.2, AHEAD)
    assert cable.reader.parting(cable.now_ns) == []


def test_nothing_is_said_where_steering_is_not_switched_on() -> None:
    cable = Cable("ardupilot", None, mode="GUIDED")
    cable.drive(3.0)
    assert cable.setpoints() == [] and cable.asked() == [] and cable.reports == []
    assert cable.reader.status()["steering"] is None


def test_the_status_says_how_it_stands() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    cable.drive(2.0, AHEAD)
    assert cable.reader.status()["steering"] == {"mode": "GUIDED", "armed": True, "missing": None, "moving": True}


def test_a_motion_that_is_not_finite_stands_for_standing_still() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    cable.drive(2.0, AHEAD)
    cable.drive(0.1, ((math.nan, 0.0, 0.0), 0.0))
    assert cable.commanded == STILL
    assert cable.reader.counters["steer.not_finite"] == 1


def test_a_clock_that_is_set_back_ends_what_was_wanted() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    cable.drive(2.0, AHEAD)
    cable.reader.steer(Steer(*AHEAD, cable.now_ns + 3600 * S))
    said = len(cable.said)
    for _ in range(100):
        cable.now_ns += STEP
        for frame in cable.reader.outgoing(cable.now_ns - 3000 * S):
            cable.said += [(0, message) for message in dialect.MAVLink(None).parse_buffer(frame)]
    assert not [m for _, m in cable.said[said:] if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]


def test_a_clock_that_is_set_back_a_little_makes_no_gap() -> None:
    cable = Cable("px4", mode="OFFBOARD")
    cable.drive(2.0, AHEAD)
    until = cable.now_ns + 10 * S
    cable.drive(1.0, AHEAD, until_ns=until)
    said = len(cable.said)
    for k in range(1, 11):
        for frame in cable.reader.outgoing(cable.now_ns - 900 * MS + k * STEP):
            cable.said += [(0, message) for message in dialect.MAVLink(None).parse_buffer(frame)]
    assert [m.vx for _, m in cable.said[said:] if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"] != []


def order(number: int, *parameters: float) -> bytes:
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    message = dialect.MAVLink_command_long_message(1, 1, number, 0, *filled)
    return bytes(message.pack(dialect.MAVLink(None, 255, 190)))


def heard(*messages: Any) -> AutopilotReader:
    """A reader that steers, and has heard these from an autopilot."""
    reader, pack = AutopilotReader(AutopilotSettings(steering=ASKING)), dialect.MAVLink(None, 1, 1)
    reader.steer(Steer(*AHEAD, T0 + 100 * S))
    for k, message in enumerate(messages):
        reader.datagram(T0 + k * MS, bytes(message.pack(pack)))
        reader.outgoing(T0 + k * MS)
        reader.reports(T0 + k * MS)
    return reader


@pytest.mark.parametrize(("autopilot", "vehicle_type"), [(3, dialect.MAV_TYPE_FIXED_WING), (4, 2), (12, 1)])
def test_a_vehicle_that_nobody_knows_how_to_steer_is_not(autopilot: int, vehicle_type: int) -> None:
    reader = heard(dialect.MAVLink_heartbeat_message(vehicle_type, autopilot, 128 | 1, 15, 4, 3))
    missing = reader.status()["steering"]["missing"]
    assert f"autopilot {autopilot} of vehicle type {vehicle_type}" in missing and "mavlink.steer = false" in missing
    assert reader.counters["steer.setpoints"] == 0


def test_words_of_an_autopilot_are_told_without_what_a_terminal_would_obey() -> None:
    text = dialect.MAVLink_statustext_message(2, b"Arm: \x1b[31mno\xff GPS\n")
    reader = heard(
        dialect.MAVLink_heartbeat_message(10, 3, 1, 15, 4, 3),
        dialect.MAVLink_command_ack_message(400, 4, 0, 0, 1, 191),
        text,
    )
    assert reader.status()["steering"]["missing"] == "arming refused: Arm: [31mno GPS"


whole = st.integers(0, 255)
said = st.one_of(
    st.builds(
        dialect.MAVLink_heartbeat_message,
        whole,
        st.sampled_from([3, 12, 4]),
        whole,
        st.integers(0, 2**32 - 1),
        whole,
        st.just(3),
    ),
    st.builds(
        dialect.MAVLink_command_ack_message,
        st.sampled_from([176, 400, 511, 0, 65535]),
        whole,
        whole,
        st.integers(-(2**31), 2**31 - 1),
        st.sampled_from([0, 1, 7]),
        whole,
    ),
    st.builds(dialect.MAVLink_statustext_message, whole, st.binary(max_size=50)),
)


@given(st.lists(said, max_size=20))
def test_no_autopilot_can_hurt(messages: list[Any]) -> None:
    reader = heard(dialect.MAVLink_heartbeat_message(10, 3, 1, 15, 4, 3), *messages)
    missing = reader.status()["steering"]["missing"]
    assert missing is None or (missing.isascii() and missing.isprintable())
    assert reader.next_deadline_ns() < T0 + 200 * S


@given(st.lists(st.binary(max_size=60), max_size=5))
def test_rubbish_is_counted(datagrams: list[bytes]) -> None:
    reader = heard(dialect.MAVLink_heartbeat_message(10, 3, 1, 15, 4, 3))
    for data in datagrams:
        reader.datagram(T0 + S, data)
    assert reader.status()["steering"]["mode"] == "GUIDED"


def test_modes_are_those_of_an_independent_table() -> None:
    for found, table in ((ARDUCOPTER, mavutil.mode_mapping_acm), (ARDUROVER, mavutil.mode_mapping_rover)):
        assert {number: name for name, number in found.modes.items()}.items() <= table.items()
        assert found.parameters("GUIDED") == (1.0, {name: n for n, name in table.items()}["GUIDED"], 0.0)
    for name, number in PX4.modes.items():
        assert mavutil.interpret_px4_mode(0, number) == name
        assert PX4.parameters(name)[1:] == mavutil.px4_map[name][1:]
    assert controls(3, dialect.MAV_TYPE_SURFACE_BOAT) is ARDUROVER
    assert PX4.name(PX4.modes["OFFBOARD"]) == "OFFBOARD" and PX4.name(77) == "mode 77"


def test_a_report_is_an_event_of_its_instant() -> None:
    cable = Cable("ardupilot", mode="GUIDED")
    for frame in cable.vehicle.outgoing(T0):
        cable.reader.datagram(T0, frame)
    assert cable.reader.reports(T0 + 5) == [ControlReport(T0 + 5, None)]
    assert cable.reader.reports(T0 + 6) == []
