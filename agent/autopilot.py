"""What a vehicle's autopilot says, as core events: MAVLink bytes and fleet times in, events and bytes out; no I/O.

The reader locks on one autopilot, keeps its boot clock in fleet time, asks for the messages it uses and reads nothing
else. It steers the vehicle only if that is switched on, see `agent.steering_link`. Whatever arrives is foreign: it is
counted under `mavlink.*` and never raises.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.autopilot_settings import NS, AutopilotSettings, fix_settings, reads_attitude_heading, reads_place, wanted
from agent.effects import Steer
from agent.events import ControlReport, Fix, Odometry
from agent.requests import MessageRequests, command_long
from agent.steering_link import SteeringLink
from agent.timesync import TimeSync
from agent.vehicle_fixes import VehicleFixes
from agent.vehicle_odometry import Increment, OdometryLimits, PoseOdometry, Stamped, VelocityOdometry

OWN_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
HEARTBEAT_INTERVAL_NS = NS
SILENT_AFTER_NS = 5 * NS
CLOCK_STEP_NS = NS
MAX_REPLIES = 16
LOCAL_FRAMES = (dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_LOCAL_FRD)
CHILD_FRAMES = (
    dialect.MAV_FRAME_BODY_FRD,
    dialect.MAV_FRAME_LOCAL_FRD,
    dialect.MAV_FRAME_LOCAL_NED,
    dialect.MAV_FRAME_BODY_NED,
)


Output = Odometry | Fix | ControlReport


class AutopilotReader:
    """One link to one vehicle.

    `counters` says what was ignored and why, `status` why nothing happens, `messages` how many the vehicle sent.
    """

    def __init__(self, settings: AutopilotSettings) -> None:
        self._settings = settings
        self.counters: Counter[str] = Counter()
        self.messages = 0
        self._stream = _parser()
        self._sync = TimeSync(settings.timesync, self.counters)
        self._epoch = 0
        self._requests = MessageRequests(wanted(settings), self.counters)
        limits = OdometryLimits(max_speed_mps=settings.max_speed_mps)
        self._poses = PoseOdometry(limits, self.counters)
        self._velocities = VelocityOdometry(
            replace(limits, max_gap_ns=max(NS, 3 * settings.message_interval_ns)), self.counters
        )
        self._steering = SteeringLink(settings.steering, self.counters)
        self._now_ns = 0
        self._received = 0
        self._vehicle: tuple[int, int] | None = None
        self._heartbeat_ns = 0
        self._next_heartbeat_ns = 0
        self._pack = dialect.MAVLink(None, settings.system_id or 1, OWN_COMPONENT)
        self._replies: deque[bytes] = deque(maxlen=MAX_REPLIES)
        self._fixes = VehicleFixes(fix_settings(settings), self.counters)
        self._handlers: dict[str, Callable[[int, Any], list[Output]]] = {
            "HEARTBEAT": self._on_heartbeat,
            "TIMESYNC": self._on_timesync,
            "COMMAND_ACK": self._on_ack,
            "STATUSTEXT": self._on_text,
            "ODOMETRY": self._on_odometry,
            "ATTITUDE": self._on_attitude,
            "LOCAL_POSITION_NED": self._on_local_position,
            "GLOBAL_POSITION_INT": self._on_global_position,
            "GPS_RAW_INT": self._on_gps,
            "GPS_GLOBAL_ORIGIN": self._on_origin,
        }

    # -- bytes in -------------------------------------------------------------------------------------------

    def datagram(self, now_ns: int, data: bytes) -> list[Output]:
        """One datagram: whole frames; what is incomplete is dropped with it."""
        parser = _parser()
        outputs = self._feed(now_ns, parser, data)
        if parser.buf_len() > 0:
            self.counters["mavlink.bad_data"] += 1
        return outputs

    def stream(self, now_ns: int, data: bytes) -> list[Output]:
        """The next bytes of a stream (serial, TCP)."""
        return self._feed(now_ns, self._stream, data)

    def new_stream(self) -> None:
        """The stream was opened anew: the rest of a broken frame is forgotten."""
        self._stream = _parser()

    def _feed(self, now_ns: int, parser: Any, data: bytes) -> list[Output]:
        self._advance(now_ns)
        self._received += len(data)
        outputs: list[Output] = []
        for message in parser.parse_buffer(data) or ():
            outputs.extend(self._on_message(now_ns, message))
        return outputs

    def _advance(self, now_ns: int) -> None:
        """Time goes on; a fleet clock that was set back would leave every deadline in a far future."""
        if now_ns < self._now_ns - CLOCK_STEP_NS:
            self._sync.step()
            self._steering.restart()
            self._next_heartbeat_ns = 0
        self._now_ns = now_ns
        self._check_epoch()

    def _check_epoch(self) -> None:
        if self._sync.epoch == self._epoch:
            return
        self._epoch = self._sync.epoch
        self._poses.restart()
        self._velocities.restart()
        self._requests.restart()
        self._fixes.restart()

    def _on_message(self, now_ns: int, message: Any) -> list[Output]:
        name = message.get_type()
        if name == "BAD_DATA":
            self.counters["mavlink.bad_data"] += 1
            return []
        if name.startswith("UNKNOWN_"):
            self.counters["mavlink.unknown_message"] += 1
            return []
        source = (message.get_srcSystem(), message.get_srcComponent())
        if self._vehicle is None:
            if not self._lock(source, name, message):
                return []
        elif source != self._vehicle:
            other = "system" if source[0] != self._vehicle[0] else "component"
            self.counters[f"mavlink.other_{other}"] += 1
            return []
        self.messages += 1
        self._requests.arrived(now_ns, message.get_msgId(), name)
        handler = self._handlers.get(name)
        if handler is None:
            return []
        outputs = handler(now_ns, message)
        self._check_epoch()
        return outputs

    def _lock(self, source: tuple[int, int], name: str, message: Any) -> bool:
        """Lock on the first autopilot, or the one that was named."""
        if name != "HEARTBEAT":
            self.counters["mavlink.no_vehicle"] += 1
            return False
        if message.autopilot == dialect.MAV_AUTOPILOT_INVALID or source[0] == 0:
            self.counters["mavlink.not_an_autopilot"] += 1
            return False
        if self._settings.system_id not in (None, source[0]):
            self.counters["mavlink.other_system"] += 1
            return False
        self._vehicle = source
        self._pack.srcSystem = source[0]
        # From now on as a member of that vehicle.
        self._next_heartbeat_ns = 0
        return True

    # -- bytes out ------------------------------------------------------------------------------------------

    def outgoing(self, now_ns: int) -> list[bytes]:
        """Frames due by now: own heartbeat, clock requests and answers, requests for messages."""
        self._advance(now_ns)
        out = list(self._replies)
        self._replies.clear()
        if now_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = now_ns + HEARTBEAT_INTERVAL_NS
            out.append(
                self._encode(
                    dialect.MAVLink_heartbeat_message(
                        dialect.MAV_TYPE_ONBOARD_CONTROLLER,
                        dialect.MAV_AUTOPILOT_INVALID,
                        0,
                        0,
                        dialect.MAV_STATE_ACTIVE,
                        3,
                    )
                )
            )
        if self._vehicle is None:
            return out
        if now_ns >= self._sync.next_request_ns:
            out.append(self._encode(dialect.MAVLink_timesync_message(0, self._sync.request(now_ns))))
        wanted = self._requests.due(now_ns)
        if wanted is not None:
            number, interval_us = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, wanted.interval_ns / 1000.0
            out.append(self._encode(command_long(self._vehicle, number, wanted.message_id, interval_us)))
        out.extend(self._encode(message) for message in self._steering.due(now_ns, self._vehicle))
        return out

    def next_deadline_ns(self) -> int:
        """When `outgoing` has something to say."""
        if self._replies:
            return self._now_ns
        if self._vehicle is None:
            return self._next_heartbeat_ns
        others = (self._requests.next_deadline_ns(), self._steering.next_deadline_ns())
        return min(self._next_heartbeat_ns, self._sync.next_request_ns, *others)

    def steer(self, steer: Steer) -> None:
        """How the vehicle is to move from now on."""
        self._steering.steer(steer)

    def reports(self, now_ns: int) -> list[ControlReport]:
        """What there is to tell of the vehicle's obedience."""
        return self._steering.reports(now_ns)

    def parting(self, now_ns: int) -> list[bytes]:
        """The last frames before the link is closed: a vehicle that is steered is to stand still."""
        if self._vehicle is None:
            return []
        return [self._encode(message) for message in self._steering.parting(now_ns, self._vehicle)]

    def _encode(self, message: Any) -> bytes:
        data: bytes = message.pack(self._pack)
        self._pack.seq = (self._pack.seq + 1) % 256
        return data

    # -- messages -------------------------------------------------------------------------------------------

    def _on_heartbeat(self, now_ns: int, message: Any) -> list[Output]:
        self._heartbeat_ns = now_ns
        self._steering.heartbeat(now_ns, message)
        return []

    def _on_text(self, now_ns: int, message: Any) -> list[Output]:
        self._steering.text(now_ns, message)
        return []

    def _on_timesync(self, now_ns: int, message: Any) -> list[Output]:
        if message.tc1 != 0:
            self._sync.answer(now_ns, message.tc1, message.ts1)
        else:
            # A zero would make the answer a request.
            self._replies.append(self._encode(dialect.MAVLink_timesync_message(max(now_ns, 1), message.ts1)))
        return []

    def _on_ack(self, now_ns: int, message: Any) -> list[Output]:
        ours = message.target_system in (0, self._pack.srcSystem) and message.target_component in (0, OWN_COMPONENT)
        if ours and message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._requests.answered(now_ns, message.result)
        elif ours:
            self._steering.acknowledged(now_ns, message)
        return []

    def _on_odometry(self, now_ns: int, message: Any) -> list[Output]:
        if self._settings.odometry_source != "odometry":
            return []
        if message.frame_id not in LOCAL_FRAMES or message.child_frame_id not in CHILD_FRAMES:
            self.counters["mavlink.frame"] += 1
            return []
        if message.quality < 0:
            self.counters["mavlink.odometry_failed"] += 1
            self._poses.restart()
            return []
        position = np.array([message.x, message.y, message.z], dtype=np.float64)
        quaternion = [float(value) for value in message.q]
        if not self._finite(*position, *quaternion):
            return []
        if not 0.9 <= math.hypot(*quaternion) <= 1.1:
            self.counters["mavlink.quaternion"] += 1
            return []
        boot_ns = self._sync.boot_usec(message.time_usec)
        t_ns = self._sync.stamp(now_ns, boot_ns) if boot_ns is not None else None
        if boot_ns is None or t_ns is None:
            return []
        pose = Stamped(boot_ns, t_ns, frames.ned_to_enu(position), frames.heading_from_quaternion(*quaternion))
        increment = self._poses.pose(pose, message.reset_counter)
        return [self._odometry(now_ns, increment)] if increment is not None else []

    def _on_attitude(self, now_ns: int, message: Any) -> list[Output]:
        by_velocity = self._settings.odometry_source == "velocity"
        as_fix = reads_attitude_heading(self._settings)
        if not (by_velocity or as_fix) or not self._finite(message.yaw):
            return []
        if abs(message.yaw) > math.tau:
            self.counters["mavlink.out_of_range"] += 1
            return []
        boot_ns, t_ns = self._boot_stamp(now_ns, message.time_boot_ms)
        if t_ns is None:
            return []
        heading = frames.heading_from_yaw(message.yaw)
        outputs: list[Output] = []
        if by_velocity:
            outputs += [self._odometry(now_ns, item) for item in self._velocities.attitude(boot_ns, heading)]
        if as_fix:
            outputs += self._fixes.heading(now_ns, t_ns, heading)
        return outputs

    def _on_local_position(self, now_ns: int, message: Any) -> list[Output]:
        by_velocity = self._settings.odometry_source == "velocity"
        as_fix = reads_place(self._settings) and self._settings.position_source == "local"
        position = np.array([message.x, message.y, message.z], dtype=np.float64)
        velocity = np.array([message.vx, message.vy, message.vz], dtype=np.float64)
        if not (by_velocity or as_fix) or not self._finite(*position, *velocity):
            return []
        boot_ns, t_ns = self._boot_stamp(now_ns, message.time_boot_ms)
        if t_ns is None:
            return []
        outputs: list[Output] = []
        if by_velocity:
            increments = self._velocities.velocity(boot_ns, t_ns, frames.ned_to_enu(velocity))
            outputs += [self._odometry(now_ns, item) for item in increments]
        if as_fix:
            outputs += self._fixes.local_position(now_ns, t_ns, frames.ned_to_enu(position))
        return outputs

    def _on_global_position(self, now_ns: int, message: Any) -> list[Output]:
        if not reads_place(self._settings) or self._settings.position_source != "global":
            return []
        _, t_ns = self._boot_stamp(now_ns, message.time_boot_ms)
        if t_ns is None:
            return []
        return [*self._fixes.global_position(now_ns, t_ns, message.lat, message.lon, message.alt, message.hdg)]

    def _on_gps(self, now_ns: int, message: Any) -> list[Output]:
        self._fixes.gps(now_ns, message.fix_type, message.h_acc, message.v_acc)
        return []

    def _on_origin(self, now_ns: int, message: Any) -> list[Output]:
        self._fixes.origin(message.latitude, message.longitude, message.altitude)
        return []

    # -- parts ----------------------------------------------------------------------------------------------

    def _finite(self, *values: float) -> bool:
        if all(math.isfinite(value) for value in values):
            return True
        self.counters["mavlink.not_finite"] += 1
        return False

    def _boot_stamp(self, now_ns: int, time_boot_ms: int) -> tuple[int, int | None]:
        boot_ns = self._sync.boot_ms(now_ns, time_boot_ms)
        return boot_ns, self._sync.stamp(now_ns, boot_ns)

    def _odometry(self, now_ns: int, increment: Increment) -> Odometry:
        noise = self._settings.odometry_noise
        delta = noise.calibrated(increment.delta)
        seconds = (increment.t1_ns - increment.t0_ns) * 1e-9
        lag_ns = round(noise.lag_s * 1e9)
        t0_ns, t1_ns = increment.t0_ns + lag_ns, increment.t1_ns + lag_ns
        return Odometry(now_ns, t0_ns, t1_ns, delta, noise.covariance(delta, seconds))

    # -- for people -----------------------------------------------------------------------------------------

    def status(self) -> dict[str, Any]:
        """Plain values: the vehicle, its clock, what arrives how often, and why nothing happens."""
        best = self._sync.best
        return {
            "vehicle": None if self._vehicle is None else {"system": self._vehicle[0], "component": self._vehicle[1]},
            "timesync": None
            if best is None
            else {
                "offset_ns": best.offset_ns,
                "rtt_ns": best.rtt_ns,
                "samples": self._sync.samples,
            },
            "messages": self._requests.rates(self._now_ns),
            "steering": self._steering.status(self._now_ns),
            "reasons": self._reasons(),
        }

    def _reasons(self) -> list[str]:
        if self._received == 0:
            return ["nothing received on the link: is the autopilot on, and the endpoint right?"]
        if self._vehicle is None:
            if self.counters["mavlink.other_system"]:
                return ["only vehicles with other system ids are heard: check system_id"]
            if self.counters["mavlink.not_an_autopilot"] or self.counters["mavlink.no_vehicle"]:
                return ["MAVLink is received, but no HEARTBEAT of an autopilot"]
            return ["bytes are received, but no MAVLink frames: check the baud rate and the protocol"]
        reasons = []
        if self._now_ns - self._heartbeat_ns > SILENT_AFTER_NS:
            reasons.append("the autopilot has fallen silent: no HEARTBEAT")
        if self._sync.best is None:
            reasons.append("no TIMESYNC answer: data cannot be stamped and are not used")
        reasons += self._requests.reasons(self._now_ns)
        return reasons + self._fixes.reasons()


def _parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
