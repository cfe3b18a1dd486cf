"""An autopilot stand-in: telemetry, clock and message requests as a real vehicle shows them on its MAVLink link.

The pure half (`StandIn`) turns states given by a world into frames; `StandInServer` puts it on a socket. Messages that
describe the motion (`PUSHED`) are sent exactly once per world state, stamped with its instant, when they have been
asked for; all others at their interval in fleet time. It is armed, changes its mode and obeys velocity set-points as
`sim.vehicle_control` says; other flight commands are not supported.

`ardupilot` streams nothing unasked but HEARTBEAT and TIMESYNC; `px4` streams its onboard set.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.fleet_clock import FleetClock
from agent.mavlink import Timer, UdpLine
from agent.mavlink_endpoint import Endpoint, MavlinkEndpointError, parse_endpoint
from sim.vehicle_control import COMMANDS
from sim.vehicle_telemetry import StandInSettings, Telemetry

NS = 1_000_000_000
MS = 1_000_000
FOREVER_NS = 2**62
TIMESYNC_INTERVAL_NS = {"ardupilot": 10 * NS, "px4": NS // 10}

PUSHED = ("ODOMETRY", "GLOBAL_POSITION_INT", "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")
PERIODIC = (
    "SYS_STATUS",
    "EXTENDED_SYS_STATE",
    "GPS_RAW_INT",
    "HOME_POSITION",
    "GPS_GLOBAL_ORIGIN",
    "SYSTEM_TIME",
    "EKF_STATUS_REPORT",
)
REQUESTED_ONLY = ("AUTOPILOT_VERSION", "HEARTBEAT")
PX4_STREAMS = {
    "ODOMETRY": NS // 30,
    "GLOBAL_POSITION_INT": NS // 50,
    "ATTITUDE": NS // 100,
    "ATTITUDE_QUATERNION": NS // 50,
    "LOCAL_POSITION_NED": NS // 30,
    "SYS_STATUS": NS,
    "EXTENDED_SYS_STATE": NS // 5,
    "GPS_RAW_INT": NS,
    "HOME_POSITION": 2 * NS,
    "SYSTEM_TIME": NS,
}
"""Intervals [ns] of what PX4 sends unasked on its onboard link (an extract)."""


class StandIn(Telemetry):
    """Pure half: states and bytes in, frames out."""

    def __init__(self, settings: StandInSettings) -> None:
        self.counters: Counter[str] = Counter()
        self._pack = dialect.MAVLink(None, settings.system_id, dialect.MAV_COMP_ID_AUTOPILOT1)
        super().__init__(settings)

    def reboot(self, now_ns: int) -> None:
        """Switched on at `now_ns`: the boot clock, the local frame and the requests begin anew."""
        super().reboot(now_ns)
        self._pushed_ns: int | None = None
        self._sent_fix_ns: int | None = None
        streams = PX4_STREAMS if self.settings.flavour == "px4" else {}
        self._interval_ns = {name: ns for name, ns in streams.items() if self.has(name)}
        self._due_ns = {name: now_ns for name in self._interval_ns if name in PERIODIC}
        self._heartbeat_due_ns = now_ns
        self._timesync_due_ns = now_ns
        self._asked_ts1: int | None = None
        self.companion_offset_ns: int | None = None

    def push(self, t_ns: int) -> list[bytes]:
        """The frames of a new world state at `t_ns`; nothing for a state that has been sent."""
        if self._pushed_ns is not None and t_ns <= self._pushed_ns:
            return []
        self._pushed_ns = t_ns
        out = []
        for name in PUSHED:
            if name not in self._interval_ns:
                continue
            if name == "GLOBAL_POSITION_INT" and self._fix is not None:
                if self._fix.t_ns == self._sent_fix_ns:
                    continue
                self._sent_fix_ns = self._fix.t_ns
            message = self.message(name, t_ns)
            if message is not None:
                out.append(self._encode(message))
        return out

    # -- the link's side ------------------------------------------------------------------------------------

    def outgoing(self, now_ns: int) -> list[bytes]:
        """Frames due by now: HEARTBEAT, TIMESYNC requests, messages with an interval."""
        out = []
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + NS
            out.append(self._encode(self.heartbeat()))
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns = now_ns + TIMESYNC_INTERVAL_NS[self.settings.flavour]
            self._asked_ts1 = self.boot_time(now_ns)
            out.append(self._encode(dialect.MAVLink_timesync_message(0, self._asked_ts1)))
        for name, due_ns in list(self._due_ns.items()):
            if now_ns >= due_ns:
                # On its own grid; what a pause has missed is not made up for.
                due_ns += self._interval_ns[name]
                self._due_ns[name] = due_ns if due_ns > now_ns else now_ns + self._interval_ns[name]
                message = self.message(name, now_ns)
                if message is not None:
                    out.append(self._encode(message))
        return out

    def next_deadline_ns(self) -> int:
        return min(self._heartbeat_due_ns, self._timesync_due_ns, *self._due_ns.values(), FOREVER_NS)

    def receive(self, now_ns: int, data: bytes) -> list[bytes]:
        """A datagram from the companion; returns the answers. Foreign rubbish is counted."""
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        out: list[bytes] = []
        for message in parser.parse_buffer(data) or ():
            match message.get_type():
                case "BAD_DATA":
                    self.counters["bad_data"] += 1
                case "COMMAND_LONG" | "COMMAND_INT":
                    out += self._command(now_ns, message)
                case "SET_MODE":
                    out += self._set_mode(now_ns, message)
                case "SET_POSITION_TARGET_LOCAL_NED":
                    if self._is_meant(message):
                        self.control.setpoint(now_ns, message)
                case "TIMESYNC":
                    out += self._timesync(now_ns, message)
                case "HEARTBEAT":
                    self.counters["heartbeat"] += 1
        return out

    def _timesync(self, now_ns: int, message: Any) -> list[bytes]:
        boot = self.boot_time(now_ns)
        if message.tc1 == 0:
            return [self._encode(dialect.MAVLink_timesync_message(boot, message.ts1))]
        if message.ts1 == self._asked_ts1:
            self._asked_ts1 = None
            self.companion_offset_ns = message.tc1 - (message.ts1 + boot) // 2
        return []

    def _is_meant(self, message: Any) -> bool:
        """Whether a message is for this vehicle; SET_MODE names no component."""
        component = 0 if message.get_type() == "SET_MODE" else message.target_component
        own = (0, dialect.MAV_COMP_ID_AUTOPILOT1)
        if message.target_system in (0, self.settings.system_id) and component in own:
            return True
        self.counters["other_target"] += 1
        return False

    def _set_mode(self, now_ns: int, message: Any) -> list[bytes]:
        """The old way to change the mode; ArduPilot acknowledges it, PX4 does not."""
        if not self._is_meant(message):
            return []
        result, reason = self.control.change_mode(now_ns, message.base_mode, message.custom_mode)
        if self.settings.flavour == "px4":
            return self._said(reason)
        return [self._ack(dialect.MAVLINK_MSG_ID_SET_MODE, result, message), *self._said(reason)]

    def _said(self, reason: str | None) -> list[bytes]:
        if reason is None:
            return []
        return [self._encode(dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_CRITICAL, reason.encode()))]

    def _ack(self, command: int, result: int, message: Any) -> bytes:
        source = (message.get_srcSystem(), message.get_srcComponent())
        return self._encode(dialect.MAVLink_command_ack_message(command, result, 0, 0, *source))

    def _command(self, now_ns: int, message: Any) -> list[bytes]:
        if not self._is_meant(message):
            return []
        result, answers = dialect.MAV_RESULT_UNSUPPORTED, []
        if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(now_ns, message.param1, message.param2)
        elif message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            name = _name(message.param1)
            found = None
            if name in (*PUSHED, *PERIODIC, *REQUESTED_ONLY) and self.has(name):
                found = self.message(name, now_ns if self._pushed_ns is None else self._pushed_ns)
            if found is not None:
                answers = [self._encode(found)]
            result = dialect.MAV_RESULT_DENIED if found is None else dialect.MAV_RESULT_ACCEPTED
        elif message.command in COMMANDS:
            result, reason = self.control.command(now_ns, message)
            answers = self._said(reason)
        else:
            self.counters["unsupported_command"] += 1
        return [self._ack(message.command, result, message), *answers]

    def _set_interval(self, now_ns: int, message_id: float, interval_us: float) -> int:
        name = _name(message_id)
        if name not in (*PUSHED, *PERIODIC) or not self.has(name) or not math.isfinite(interval_us):
            return int(dialect.MAV_RESULT_DENIED)
        interval_ns = int(interval_us * 1000.0)
        if interval_us == 0.0:
            interval_ns = PX4_STREAMS.get(name, -1) if self.settings.flavour == "px4" else -1
        if interval_ns > 0:
            self._interval_ns[name] = max(interval_ns, MS)
            if name in PERIODIC:
                self._due_ns[name] = now_ns
        else:
            self._interval_ns.pop(name, None)
            self._due_ns.pop(name, None)
        return int(dialect.MAV_RESULT_ACCEPTED)

    def _encode(self, message: Any) -> bytes:
        data: bytes = message.pack(self._pack)
        self._pack.seq = (self._pack.seq + 1) % 256
        return data


def _name(message_id: float) -> str:
    """Name of a message id given as a command's parameter; empty when there is none."""
    if not math.isfinite(message_id):
        return ""
    kind = dialect.mavlink_map.get(int(message_id))
    return "" if kind is None else str(kind.msgname)


class StandInServer:
    """Puts a stand-in on a socket: `udpout:HOST:PORT` sends to a companion that listens there."""

    def __init__(self, stand_in: StandIn, endpoint: str, clock: FleetClock) -> None:
        self.stand_in = stand_in
        self._endpoint: Endpoint = parse_endpoint(endpoint)
        if self._endpoint.kind != "udpout":
            raise MavlinkEndpointError(f"'{endpoint}': a stand-in speaks on udpout:HOST:PORT")
        self._clock = clock
        self._line = UdpLine(self._endpoint, self._on_data)
        self._timer = Timer(clock, self._serve)

    async def start(self) -> None:
        """Raises `MavlinkError` when the socket cannot be opened."""
        await self._line.start()
        self._serve()

    async def close(self) -> None:
        self._timer.cancel()
        await self._line.close()

    def push(self, t_ns: int) -> None:
        """Send the world's new state of instant `t_ns`."""
        self._send(self.stand_in.push(t_ns))

    def _on_data(self, data: bytes) -> bool:
        self._send(self.stand_in.receive(self._clock.now_ns(), data))
        # What is due goes out now: a timer that each of many datagrams sets anew would never run out.
        self._serve()
        return True

    def _serve(self) -> None:
        self._send(self.stand_in.outgoing(self._clock.now_ns()))
        self._timer.arm(self.stand_in.next_deadline_ns())

    def _send(self, data: list[bytes]) -> None:
        for frame in data:
            self._line.send(frame)
