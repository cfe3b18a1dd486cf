"""Flight modes of autopilots: by name, and which of them obeys set-points from a companion computer."""

from __future__ import annotations

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

MS = 1_000_000

COPTERS = (
    dialect.MAV_TYPE_QUADROTOR,
    dialect.MAV_TYPE_COAXIAL,
    dialect.MAV_TYPE_HELICOPTER,
    dialect.MAV_TYPE_HEXAROTOR,
    dialect.MAV_TYPE_OCTOROTOR,
    dialect.MAV_TYPE_TRICOPTER,
    dialect.MAV_TYPE_DODECAROTOR,
    dialect.MAV_TYPE_DECAROTOR,
    dialect.MAV_TYPE_GENERIC_MULTIROTOR,
)
ROVERS = (dialect.MAV_TYPE_GROUND_ROVER, dialect.MAV_TYPE_SURFACE_BOAT)

_ARDUCOPTER = {
    "STABILIZE": 0,
    "ALT_HOLD": 2,
    "AUTO": 3,
    "GUIDED": 4,
    "LOITER": 5,
    "RTL": 6,
    "LAND": 9,
    "POSHOLD": 16,
    "BRAKE": 17,
}
_ARDUROVER = {"MANUAL": 0, "ACRO": 1, "STEERING": 3, "HOLD": 4, "LOITER": 5, "AUTO": 10, "RTL": 11, "GUIDED": 15}
_PX4 = {
    "MANUAL": (1, 0),
    "ALTCTL": (2, 0),
    "POSCTL": (3, 0),
    "TAKEOFF": (4, 2),
    "LOITER": (4, 3),
    "MISSION": (4, 4),
    "RTL": (4, 5),
    "LAND": (4, 6),
    "ACRO": (5, 0),
    "OFFBOARD": (6, 0),
    "STABILIZED": (7, 0),
}
"""Main mode and sub-mode."""


@dataclass(frozen=True, slots=True)
class Controls:
    """How a kind of vehicle is steered.

    modes         custom mode of HEARTBEAT, by name (an extract)
    steered       the mode in which it obeys velocity set-points
    by_hand       the mode it starts in
    stream_first  whether set-points have to arrive for a while before it enters that mode
    setpoint_ns   interval of set-points that it gets, several times shorter than it holds one
    """

    modes: dict[str, int]
    steered: str
    by_hand: str
    stream_first: bool
    setpoint_ns: int

    def name(self, custom_mode: int) -> str:
        """A mode for people."""
        return next((name for name, number in self.modes.items() if number == custom_mode), f"mode {custom_mode}")

    def parameters(self, mode: str) -> tuple[float, float, float]:
        """Parameters 1 to 3 of MAV_CMD_DO_SET_MODE."""
        number, flag = self.modes[mode], float(dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        if self.stream_first:
            return flag, float(number >> 16 & 0xFF), float(number >> 24)
        return flag, float(number), 0.0


ARDUCOPTER = Controls(_ARDUCOPTER, "GUIDED", "STABILIZE", stream_first=False, setpoint_ns=250 * MS)
ARDUROVER = Controls(_ARDUROVER, "GUIDED", "MANUAL", stream_first=False, setpoint_ns=250 * MS)
"""They hold a set-point for 3 s."""
PX4 = Controls(
    {name: main << 16 | sub << 24 for name, (main, sub) in _PX4.items()},
    "OFFBOARD",
    "POSCTL",
    stream_first=True,
    setpoint_ns=100 * MS,
)
"""It wants more than 2 Hz, and leaves OFFBOARD after a second without."""


def controls(autopilot: int, vehicle_type: int) -> Controls | None:
    """By HEARTBEAT's `autopilot` and `type`; None: it is not known how such a vehicle is steered."""
    if vehicle_type not in COPTERS and vehicle_type not in ROVERS:
        return None
    if autopilot == dialect.MAV_AUTOPILOT_PX4:
        return PX4
    if autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
        return ARDUCOPTER if vehicle_type in COPTERS else ARDUROVER
    return None
