"""What is read from an autopilot, which messages that takes, and whether it is steered."""

from __future__ import annotations

from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.estimation.odometry import OdometryNoise
from agent.requests import Wanted
from agent.steering_link import SteeringSettings
from agent.timesync import MS, TimeSyncSettings
from agent.vehicle_fixes import FixSettings

FIXES = ("position", "heading", "altitude")
ODOMETRY_SOURCES = ("odometry", "velocity", "none")
POSITION_SOURCES = ("global", "local")
NS = 1_000_000_000
ORIGIN_INTERVAL_NS = 5 * NS


@dataclass(frozen=True, slots=True)
class AutopilotSettings:
    """What is read from the autopilot. All times in ns of fleet time.

    fixes            absolute information used, any of "position", "heading" and "altitude"
    position_source  "global": GLOBAL_POSITION_INT; "local": LOCAL_POSITION_NED with GPS_GLOBAL_ORIGIN
    fix_inflation    R is multiplied by it: positions of an autopilot are filtered, hence correlated in time
    odometry_source  "odometry": ODOMETRY; "velocity": LOCAL_POSITION_NED velocity with ATTITUDE yaw; "none"
    system_id        the vehicle; None: the first autopilot heard
    steering         None: the vehicle is never told to move
    max_distance_m   fixes farther from the origin are refused: a wrong origin, or a GPS gone astray
    """

    origin: frames.Origin = (0.0, 0.0, 0.0)
    fixes: tuple[str, ...] = ()
    fix_sigma_m: float = 2.0
    fix_sigma_altitude_m: float = 3.0
    fix_sigma_rad: float = 0.1
    fix_interval_ns: int = NS
    fix_inflation: float = 1.0
    position_source: str = "global"
    odometry_source: str = "odometry"
    odometry_noise: OdometryNoise = field(default_factory=OdometryNoise)
    message_interval_ns: int = 100 * MS
    system_id: int | None = None
    max_speed_mps: float = 30.0
    max_distance_m: float = 100_000.0
    timesync: TimeSyncSettings = field(default_factory=TimeSyncSettings)
    steering: SteeringSettings | None = None

    def __post_init__(self) -> None:
        for key, value, valid in (
            *(("fixes", name, FIXES) for name in self.fixes),
            ("odometry_source", self.odometry_source, ODOMETRY_SOURCES),
            ("position_source", self.position_source, POSITION_SOURCES),
        ):
            if value not in valid:
                raise ValueError(f"{key}: '{value}' is unknown; valid: {', '.join(valid)}")
        if self.message_interval_ns <= 0:
            raise ValueError("message_interval_ns must be positive")
        if self.system_id is not None and not 1 <= self.system_id <= 255:
            raise ValueError("system_id must be from 1 to 255, or None for the first autopilot heard")


def wanted(settings: AutopilotSettings) -> list[Wanted]:
    """The messages the settings need, with the intervals to ask for."""
    intervals: dict[int, int] = {}

    def want(message_id: int, interval_ns: int) -> None:
        intervals[message_id] = min(interval_ns, intervals.get(message_id, interval_ns))

    motion = settings.message_interval_ns
    # Twice the rate of the fixes: thinning then finds one close to each of its instants.
    fix = max(motion, settings.fix_interval_ns // 2)
    if settings.odometry_source == "odometry":
        want(dialect.MAVLINK_MSG_ID_ODOMETRY, motion)
    elif settings.odometry_source == "velocity":
        want(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, motion)
        want(dialect.MAVLINK_MSG_ID_ATTITUDE, motion)
    if reads_place(settings):
        want(dialect.MAVLINK_MSG_ID_GPS_RAW_INT, NS)
        if settings.position_source == "global":
            want(dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT, fix)
        else:
            want(dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, fix)
            want(dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, ORIGIN_INTERVAL_NS)
    if reads_attitude_heading(settings):
        want(dialect.MAVLINK_MSG_ID_ATTITUDE, fix)
    return [Wanted(dialect.mavlink_map[key].msgname, key, interval) for key, interval in intervals.items()]


def reads_place(settings: AutopilotSettings) -> bool:
    return "position" in settings.fixes or "altitude" in settings.fixes


def reads_attitude_heading(settings: AutopilotSettings) -> bool:
    with_position = "position" in settings.fixes and settings.position_source == "global"
    return "heading" in settings.fixes and not with_position


def fix_settings(settings: AutopilotSettings) -> FixSettings:
    return FixSettings(
        origin=settings.origin,
        position="position" in settings.fixes,
        heading="heading" in settings.fixes,
        local=settings.position_source == "local",
        sigma_m=settings.fix_sigma_m,
        sigma_rad=settings.fix_sigma_rad,
        interval_ns=settings.fix_interval_ns,
        inflation=settings.fix_inflation,
        max_distance_m=settings.max_distance_m,
        altitude="altitude" in settings.fixes,
        sigma_altitude_m=settings.fix_sigma_altitude_m,
    )
