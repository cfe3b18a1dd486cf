"""What a simulated vehicle knows of itself, and how it says it in MAVLink; the link is `sim.autopilot`'s matter."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.flight_modes import ROVERS, Controls, controls
from sim.vehicle_control import VehicleControl

Array = NDArray[np.float64]

MS = 1_000_000
NAN = math.nan
HDG_UNKNOWN = 65535
MAX_MOVES = 1024
"""Increments of odometry by which a late fix is carried on."""
FLAVOURS = {"ardupilot": dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": dialect.MAV_AUTOPILOT_PX4}
VEHICLES = {False: dialect.MAV_TYPE_GROUND_ROVER, True: dialect.MAV_TYPE_QUADROTOR}
"""MAVLink's type of a vehicle, by whether it flies."""
SENDS = ("odometry", "global_position", "attitude", "local_position")

NEEDS = {
    "ODOMETRY": "odometry",
    "ATTITUDE": "attitude",
    "ATTITUDE_QUATERNION": "attitude",
    "LOCAL_POSITION_NED": "local_position",
    "GLOBAL_POSITION_INT": "global_position",
    "HOME_POSITION": "global_position",
    "GPS_GLOBAL_ORIGIN": "global_position",
}
"""Messages a vehicle refuses unless it `sends` the thing."""

SENSORS = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_AHRS
    | dialect.MAV_SYS_STATUS_PREARM_CHECK
)
EKF_GLOBAL, EKF_ATTITUDE_ONLY = 831, 167


@dataclass(frozen=True, slots=True)
class StandInSettings:
    """One vehicle. `boot_ns` is the fleet instant at which it was switched on; `sends` what it can tell.

    `own_fixes`: the positions it tells are those of `set_fix` alone, and there is none before the first.
    `armed`, `mode`: how it is found at the start; without a mode in one that a person drives in.
    """

    system_id: int = 1
    flavour: str = "ardupilot"
    sends: tuple[str, ...] = ("odometry", "attitude")
    origin: frames.Origin = (0.0, 0.0, 0.0)
    boot_ns: int = 0
    vehicle_type: int = dialect.MAV_TYPE_GROUND_ROVER
    gps_accuracy_m: float | None = None
    own_fixes: bool = False
    armed: bool = False
    mode: str | None = None

    def __post_init__(self) -> None:
        if self.flavour not in FLAVOURS:
            raise ValueError(f"flavour: '{self.flavour}' is unknown; valid: {', '.join(FLAVOURS)}")
        for name in self.sends:
            if name not in SENDS:
                raise ValueError(f"sends: '{name}' is unknown; valid: {', '.join(SENDS)}")
        modes = self.controls().modes
        if self.mode is not None and self.mode not in modes:
            raise ValueError(f"mode: '{self.mode}' is unknown; valid: {', '.join(modes)}")

    def controls(self) -> Controls:
        """How it is steered. Raises ValueError for a type of vehicle that nobody knows how to steer."""
        found = controls(FLAVOURS[self.flavour], self.vehicle_type)
        if found is None:
            raise ValueError(f"vehicle_type: {self.vehicle_type} is neither a copter nor a rover")
        return found


@dataclass(slots=True)
class Pose:
    """x, y, z [m] in ENU-like axes and heading [rad], of fleet instant `t_ns`."""

    t_ns: int
    xyz: Array
    heading: float

    def moved(self, t_ns: int, delta: Array) -> Pose:
        step = frames.from_level_body(delta[:3], self.heading)
        return Pose(t_ns, self.xyz + step, frames.wrap(self.heading + float(delta[3])))


class Telemetry:
    """State of one vehicle, given by a world, and its messages."""

    def __init__(self, settings: StandInSettings) -> None:
        self.settings = settings
        self._origin: frames.Origin | None = None
        self._truth: Pose | None = None
        self._fix: Pose | None = None
        self._fix_has_heading = True
        self._global: Pose | None = None
        self._state_velocity = np.zeros(4)
        self.reboot(settings.boot_ns)
        self.control.armed = settings.armed

    def reboot(self, now_ns: int) -> None:
        """Switched on at `now_ns`, disarmed: the boot clock and the local frame begin anew."""
        self._boot_ns = now_ns
        kind, mode = self.settings.vehicle_type, self.settings.mode
        self.control = VehicleControl(self.settings.controls(), kind, now_ns, lambda: self._believed().heading, mode)
        self._local = Pose(now_ns, np.zeros(3), 0.0)
        self._odometry_ns: int | None = None
        self._body_velocity: Array | None = None
        self._reset_counter = 0
        self._moves: deque[tuple[int, Array]] = deque(maxlen=MAX_MOVES)

    @property
    def gps_aided(self) -> bool:
        """Whether the vehicle knows where it is on Earth and where north is."""
        return "global_position" in self.settings.sends

    def has(self, name: str) -> bool:
        need = NEEDS.get(name)
        return need is None or need in self.settings.sends

    # -- the world's side -----------------------------------------------------------------------------------

    def set_state(
        self,
        t_ns: int,
        x: float,
        y: float,
        z: float,
        heading: float,
        vx: float = 0.0,
        vy: float = 0.0,
        vz: float = 0.0,
        yaw_rate: float = 0.0,
    ) -> None:
        """The vehicle at `t_ns`: fleet ENU [m], [rad], [m/s], [rad/s]. Its GPS is perfect until `set_fix` is used;
        velocities count until `set_odometry` is used."""
        self._truth = Pose(t_ns, np.array([x, y, z], dtype=np.float64), heading)
        body = frames.level_body(np.array([vx, vy, vz]), heading)
        self._state_velocity = np.append(body, yaw_rate)
        if self._fix is None:
            self._global = self._truth
            self._know_origin(self._truth)

    def set_fix(self, t_ns: int, x: float, y: float, z: float, heading: float | None) -> None:
        """What the vehicle's global estimate says at `t_ns`, errors included: fleet ENU [m], [rad].

        Without a heading the vehicle goes by that of its drifting local frame, and does not tell where it heads. A fix
        that comes after the odometry of later instants is carried on by it; one older than the last is not used.
        """
        if self._fix is not None and t_ns < self._fix.t_ns:
            return
        later = [(end_ns, delta) for end_ns, delta in self._moves if end_ns > t_ns]
        self._fix_has_heading = heading is not None
        if heading is None:
            heading = frames.wrap(self._local.heading - sum(float(delta[3]) for _, delta in later))
        self._fix = self._global = Pose(t_ns, np.array([x, y, z], dtype=np.float64), heading)
        for end_ns, delta in later:
            self._global = self._global.moved(end_ns, delta)
        self._know_origin(self._fix)

    def set_odometry(self, t_ns: int, delta: Array) -> None:
        """Motion (dx, dy, dz, dyaw) in the body frame since the last call, reported at `t_ns`."""
        delta = np.asarray(delta, dtype=np.float64)
        self._local = self._local.moved(t_ns, delta)
        self._moves.append((t_ns, delta))
        if self._fix is not None and self._global is not None and t_ns > self._global.t_ns:
            self._global = self._global.moved(t_ns, delta)
        if self._odometry_ns is not None and t_ns > self._odometry_ns:
            self._body_velocity = delta / ((t_ns - self._odometry_ns) * 1e-9)
        self._odometry_ns = t_ns

    def jump(self, delta: Array, *, announced: bool = True) -> None:
        """Fault: the local frame jumps by a body increment (4,), with or without a new reset counter."""
        self._local = self._local.moved(self._local.t_ns, np.asarray(delta, dtype=np.float64))
        if announced:
            self._reset_counter = (self._reset_counter + 1) % 256

    def _know_origin(self, pose: Pose) -> None:
        if self._origin is None:
            self._origin = frames.enu_to_geodetic(pose.xyz, self.settings.origin)

    # -- messages -------------------------------------------------------------------------------------------

    def boot_time(self, t_ns: int) -> int:
        """Time since boot [ns]; never zero, which would turn a TIMESYNC answer into a request."""
        return max(t_ns - self._boot_ns, 1)

    def _boot_ms(self, t_ns: int) -> int:
        return self.boot_time(t_ns) // MS % 2**32

    def _believed(self) -> Pose:
        """Where the vehicle thinks it is: on Earth, or in its drifting local frame."""
        return self._global if self.gps_aided and self._global is not None else self._local

    def _velocity(self) -> Array:
        """Body FLU velocity and yaw rate (4,)."""
        return self._state_velocity if self._body_velocity is None else self._body_velocity

    def message(self, name: str, t_ns: int) -> Any:
        """The message at instant `t_ns`; None when its content is not known yet."""
        match name:
            case "HEARTBEAT":
                return self.heartbeat()
            case "ODOMETRY":
                return self._odometry(t_ns)
            case "ATTITUDE":
                yaw = frames.yaw_from_heading(self._believed().heading)
                rate = -float(self._velocity()[3])
                return dialect.MAVLink_attitude_message(self._boot_ms(t_ns), 0.0, 0.0, yaw, 0.0, 0.0, rate)
            case "ATTITUDE_QUATERNION":
                rate = -float(self._velocity()[3])
                q = frames.quaternion_from_heading(self._believed().heading)
                return dialect.MAVLink_attitude_quaternion_message(self._boot_ms(t_ns), *q, 0.0, 0.0, rate)
            case "LOCAL_POSITION_NED":
                return self._local_position(t_ns)
            case "GLOBAL_POSITION_INT":
                return self._global_position(t_ns)
            case "GPS_RAW_INT":
                return self._gps_raw(t_ns)
            case "HOME_POSITION" | "GPS_GLOBAL_ORIGIN":
                return self._origin_message(name, t_ns)
            case "SYSTEM_TIME":
                return dialect.MAVLink_system_time_message(0, self._boot_ms(t_ns))
            case "SYS_STATUS":
                sensors = SENSORS | (dialect.MAV_SYS_STATUS_SENSOR_GPS if self.gps_aided else 0)
                return dialect.MAVLink_sys_status_message(
                    sensors, sensors, sensors, 100, 12000, -1, 90, 0, 0, 0, 0, 0, 0
                )
            case "EXTENDED_SYS_STATE":
                flies = self.control.armed and self.settings.vehicle_type not in ROVERS
                landed = dialect.MAV_LANDED_STATE_IN_AIR if flies else dialect.MAV_LANDED_STATE_ON_GROUND
                return dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, landed)
            case "EKF_STATUS_REPORT":
                flags = EKF_GLOBAL if self.gps_aided else EKF_ATTITUDE_ONLY
                return dialect.MAVLink_ekf_status_report_message(flags, 0.05, 0.05, 0.05, 0.05, 0.0)
            case "AUTOPILOT_VERSION":
                return self._version()
        return None

    def heartbeat(self) -> Any:
        armed = self.control.armed
        return dialect.MAVLink_heartbeat_message(
            self.settings.vehicle_type,
            FLAVOURS[self.settings.flavour],
            dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0),
            self.control.mode,
            dialect.MAV_STATE_ACTIVE if armed else dialect.MAV_STATE_STANDBY,
            3,
        )

    def _odometry(self, t_ns: int) -> Any:
        """The drifting local frame as LOCAL_FRD: forward, right, down of the start pose."""
        pose, velocity = self._local, self._velocity()
        x, y, z = frames.flu_to_frd(pose.xyz)
        half = -0.5 * pose.heading
        vx, vy, vz = frames.flu_to_frd(velocity[:3])
        unknown = [NAN] + [0.0] * 20
        return dialect.MAVLink_odometry_message(
            self.boot_time(t_ns) // 1000,
            dialect.MAV_FRAME_LOCAL_FRD,
            dialect.MAV_FRAME_BODY_FRD,
            x,
            y,
            z,
            [math.cos(half), 0.0, 0.0, math.sin(half)],
            vx,
            vy,
            vz,
            0.0,
            0.0,
            -float(velocity[3]),
            unknown,
            unknown,
            self._reset_counter,
            dialect.MAV_ESTIMATOR_TYPE_VIO,
            100,
        )

    def _local_position(self, t_ns: int) -> Any:
        """NED at the own origin; a GPS-denied vehicle takes its start for the origin, its nose for east."""
        pose = self._believed()
        velocity = frames.enu_to_ned(frames.from_level_body(self._velocity()[:3], pose.heading))
        position = pose.xyz
        if self.gps_aided:
            if self._origin is None:
                return None
            position = frames.local_origin_shift(position, self.settings.origin, self._origin)
        return dialect.MAVLink_local_position_ned_message(self._boot_ms(t_ns), *frames.enu_to_ned(position), *velocity)

    def _global_position(self, t_ns: int) -> Any:
        pose = self._fix or (None if self.settings.own_fixes else self._truth)
        if pose is None or self._origin is None:
            return None
        stamp = t_ns if self._fix is None else pose.t_ns
        lat, lon, alt = frames.enu_to_geodetic(pose.xyz, self.settings.origin)
        velocity = frames.enu_to_ned(frames.from_level_body(self._velocity()[:3], pose.heading))
        vx, vy, vz = (int(np.clip(round(100.0 * float(v)), -32767, 32767)) for v in velocity)
        hdg = round(math.degrees(frames.yaw_from_heading(pose.heading)) * 100.0) % 36000
        if self._fix is not None and not self._fix_has_heading:
            hdg = HDG_UNKNOWN
        return dialect.MAVLink_global_position_int_message(
            self._boot_ms(stamp),
            round(lat * 1e7),
            round(lon * 1e7),
            round(alt * 1e3),
            round((alt - self._origin[2]) * 1e3),
            vx,
            vy,
            vz,
            hdg,
        )

    def _gps_raw(self, t_ns: int) -> Any:
        fix_type, lat, lon, alt = dialect.GPS_FIX_TYPE_NO_FIX, 0.0, 0.0, 0.0
        if self.gps_aided:
            if self._global is None:
                return None
            fix_type = dialect.GPS_FIX_TYPE_3D_FIX
            lat, lon, alt = frames.enu_to_geodetic(self._global.xyz, self.settings.origin)
        accuracy = self.settings.gps_accuracy_m
        return dialect.MAVLink_gps_raw_int_message(
            self.boot_time(t_ns) // 1000,
            fix_type,
            round(lat * 1e7),
            round(lon * 1e7),
            round(alt * 1e3),
            65535,
            65535,
            65535,
            65535,
            12 if self.gps_aided else 0,
            h_acc=0 if accuracy is None else round(accuracy * 1e3),
        )

    def _origin_message(self, name: str, t_ns: int) -> Any:
        if self._origin is None:
            return None
        lat, lon, alt = round(self._origin[0] * 1e7), round(self._origin[1] * 1e7), round(self._origin[2] * 1e3)
        usec = self.boot_time(t_ns) // 1000
        if name == "GPS_GLOBAL_ORIGIN":
            return dialect.MAVLink_gps_global_origin_message(lat, lon, alt, usec)
        return dialect.MAVLink_home_position_message(
            lat, lon, alt, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, usec
        )

    def _version(self) -> Any:
        capabilities = dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2 | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        return dialect.MAVLink_autopilot_version_message(
            capabilities, 0, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, self.settings.system_id
        )
