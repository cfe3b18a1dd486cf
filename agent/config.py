"""The configuration file of one agent."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from agent.autopilot_settings import AutopilotSettings
from agent.calibration import Form
from agent.config_file import (
    ConfigError,
    Finite,
    Id,
    NotNegative,
    Part,
    Positive,
    Vector3,
    read_toml,
    validate,
)
from agent.config_parts import (
    MAX_TEAM,
    CalibrationPart,
    CoastPart,
    HealthPart,
    IntrinsicsPart,
    LandmarkPart,
    LatenessPart,
    LinksPart,
    LocalizationPart,
    MotionPart,
    MountVector,
    NetworkPart,
    SensorKind,
    StatePart,
    TeamMemberPart,
)
from agent.estimation.motion import LAYOUTS
from agent.estimation.mounting import mount_of
from agent.fault_parts import FaultPart
from agent.joint_room import check_room
from agent.leader_parts import check_lateness
from agent.mavlink_endpoint import MavlinkEndpointError, parse_endpoint
from agent.motion_parts import OdometryPart
from agent.planning_parts import PlanningPart, RoundPart
from agent.relative_parts import CAMERAS, AgentCorrespondencePart, check_altitude, check_leader
from agent.sensor_input import SensorConfig
from agent.settings import AgentSettings, nanoseconds
from agent.start_config import InitialPart, check_start
from agent.steering_link import SteeringSettings
from agent.target_parts import AgentTargetPart, TrackingPart
from agent.unsafe_parts import UnsafePart

_LOOPBACK = re.compile(r"\w+/(127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+(\?.*)?\Z")


class IdentityPart(Part):
    fleet: Id = "fleet"
    robot: Id
    incarnation: Annotated[int, Field(ge=1, lt=2**53)] | None = None


class ClockPart(Part):
    """`source = "run"`: fleet time starts at `t0_ns` when the launcher says so, and runs at `speed`."""

    source: Literal["system", "run"] = "system"
    t0_ns: Annotated[int, Field(ge=0)] = 0
    speed: Positive = 1.0


class AgentSensorPart(Part):
    """A sensor as the estimator knows it; the covariance comes with every measurement."""

    kind: SensorKind | Literal["odometry"]
    mount: MountVector = [0.0, 0.0, 0.0]
    two_way: bool = True
    calibration: CalibrationPart = CalibrationPart()
    lag_s: Finite = 0.0
    form: Form = "polar"
    intrinsics: IntrinsicsPart | None = None

    def settings(self) -> SensorConfig:
        intrinsics = None if self.intrinsics is None else self.intrinsics.settings()
        calibration, lag_ns = self.calibration.settings(), nanoseconds(self.lag_s)
        return SensorConfig(mount_of(self.mount), calibration, lag_ns, self.form, intrinsics)


class PeerPart(Part):
    id: Id
    endpoints: list[str]


class ZenohPart(Part):
    """Zenoh endpoints: what this robot listens on, and where its peers do (lower ids are dialled).

    Links are neither encrypted nor authenticated: beyond loopback only with `insecure_lan`.
    """

    listen: list[str]
    peers: list[PeerPart] = []
    lease_ms: Annotated[int, Field(ge=100)] = 1000
    insecure_lan: bool = False


class MavlinkPart(Part):
    """The autopilot's link, what is read from it, and whether it is steered: see `agent.steering_link`."""

    endpoint: str
    simulated: bool = False
    steer: bool = False
    arm: bool = False
    set_mode: bool = False
    fixes: list[Literal["position", "heading", "altitude"]] = []
    fix_sigma_m: Positive = 2.0
    fix_sigma_altitude_m: Positive = 3.0
    fix_sigma_rad: Positive = 0.1
    fix_interval_s: NotNegative = 1.0
    fix_inflation: Annotated[float, Field(ge=1.0)] = 1.0
    odometry_source: Literal["odometry", "velocity", "none"] = "odometry"
    odometry: OdometryPart = OdometryPart()
    rate_hz: Positive = 10.0
    system_id: Annotated[int, Field(ge=1, le=255)] | None = None
    position_source: Literal["global", "local"] = "global"
    max_speed_mps: Positive = 30.0
    max_distance_m: Positive = 100_000.0

    def settings(self, origin: list[float]) -> AutopilotSettings:
        return AutopilotSettings(
            origin=(origin[0], origin[1], origin[2]),
            fixes=tuple(self.fixes),
            fix_sigma_m=self.fix_sigma_m,
            fix_sigma_altitude_m=self.fix_sigma_altitude_m,
            fix_sigma_rad=self.fix_sigma_rad,
            fix_interval_ns=nanoseconds(self.fix_interval_s),
            fix_inflation=self.fix_inflation,
            odometry_source=self.odometry_source,
            odometry_noise=self.odometry.noise(),
            message_interval_ns=nanoseconds(1.0 / self.rate_hz),
            system_id=self.system_id,
            position_source=self.position_source,
            max_speed_mps=self.max_speed_mps,
            max_distance_m=self.max_distance_m,
            steering=SteeringSettings(self.arm, self.set_mode) if self.steer else None,
        )

    def check_steering(self, planning: str) -> None:
        """Nothing is steered that nobody plans for, or asked for that is not steered. Raises `ConfigError`."""
        if self.steer and planning == "none":
            raise ConfigError(
                "mavlink.steer = true needs a planner: set planning.kind, or set mavlink.steer = false if the vehicle "
                "is moved by others"
            )
        for key, value in (("arm", self.arm), ("set_mode", self.set_mode)):
            if value and not self.steer:
                raise ConfigError(f"mavlink.{key} = true needs mavlink.steer = true; set that too, or remove it")


class InjectionPart(Part):
    """Faults injected at this receiver, for runs on one computer; their times count from the start of the run."""

    seed: int
    links: LinksPart = LinksPart()
    faults: list[FaultPart] = []
    table: str | None = None
    fate_log: str | None = None


class AgentConfig(Part):
    """One robot's file."""

    version: Literal[1]
    identity: IdentityPart
    origin: Vector3 = [0.0, 0.0, 0.0]
    clock: ClockPart = ClockPart()
    initial: InitialPart
    motion: MotionPart = MotionPart()
    localization: LocalizationPart = LocalizationPart()
    tracking: TrackingPart = TrackingPart()
    correspondence: AgentCorrespondencePart = AgentCorrespondencePart()
    lateness: LatenessPart = LatenessPart()
    health: HealthPart = HealthPart()
    round: RoundPart = RoundPart()
    planning: PlanningPart = PlanningPart()
    unsafe: UnsafePart = UnsafePart()
    coast: CoastPart = CoastPart()
    network: NetworkPart = NetworkPart()
    state: StatePart = StatePart()
    sensors: dict[str, AgentSensorPart] = {}
    targets: list[AgentTargetPart] = []
    landmarks: list[LandmarkPart] = []
    team: Annotated[list[TeamMemberPart], Field(max_length=MAX_TEAM)] = []
    zenoh: ZenohPart
    mavlink: MavlinkPart | None = None
    injection: InjectionPart | None = None
    state_dir: str
    recording: str | None = None
    control_socket: str | None = None

    def settings(self, start_ns: int) -> AgentSettings:
        """What the core is given when it starts at `start_ns`."""
        mean, cov = self.initial.belief(self.motion)
        # The paper predicts each step by itself; intersections of tracks leave room enough for what that misses.
        form = self.localization.form if self.localization.kind == "clat" else None
        motion = self.motion.settings()
        if form == "published":
            motion = replace(motion, persistent_rad2=math.inf)
        targets = [target.settings() for target in self.targets]
        if form in ("safe", "published"):
            targets = [replace(item, motion=replace(item.motion, persistent_rad2=math.inf)) for item in targets]
        unsafe, localization, health = (
            self.unsafe.settings(),
            self.localization.settings(),
            self.health.settings(self.localization.form),
        )
        lateness, coast = self.lateness.settings(), self.coast.settings()
        if unsafe.ignore_correlation:
            localization = replace(localization, correlation="ignored")
        if unsafe.trust_liars:
            health = replace(health, enabled=False)
        if unsafe.trust_clocks:
            lateness = replace(lateness, clock_sigma_ns=0)
        if unsafe.ignore_gaps:
            coast = replace(coast, speed_mps=0.0, yaw_rate_radps=0.0)
        return AgentSettings(
            robot=self.identity.robot,
            start_ns=start_ns,
            mean=mean,
            cov=cov,
            source=self.initial.source,
            motion=motion,
            targets=tuple(targets),
            landmarks={item.id: item.place() for item in self.landmarks},
            one_way_sensors=tuple(name for name, part in sorted(self.sensors.items()) if not part.two_way),
            localization=localization,
            lateness=lateness,
            health=health,
            # In a run all clocks begin at the same instant; in the field the epoch is what all have in common.
            round=self.round.settings(start_ns if self.clock.source == "run" else 0),
            planning=self.planning.settings(),
            unsafe=unsafe,
            coast=coast,
            track=self.tracking.kind != "none",
            tracking=self.tracking.settings(),
            relative=self.correspondence.settings(self.correspondence.peers, self.leads()),
            team=tuple(member.settings() for member in self.team),
            track_end=self.tracking.end(),
            track_within_m=self.tracking.start_within_m,
            persist_ns=nanoseconds(self.state.interval_s),
        )

    def leads(self) -> bool:
        """Whether it has a camera that sees others."""
        return any(part.kind in CAMERAS for part in self.sensors.values())

    def sensor_configs(self) -> dict[str, SensorConfig]:
        return {name: part.settings() for name, part in self.sensors.items()}


def load_agent_config(path: Path) -> AgentConfig:
    """Read one robot's file. Raises `ConfigError`."""
    config = validate(AgentConfig, read_toml(path), str(path))
    try:
        for target in config.targets:
            target.settings()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        config.motion.settings()
    except ConfigError as error:
        raise ConfigError(f"{path}: motion.altitude_sigma_m: {error}") from None
    sensor = next((n for n, part in config.sensors.items() if part.kind == "pixel" and part.intrinsics is None), None)
    if sensor is not None:
        raise ConfigError(f"{path}: sensors.{sensor}.intrinsics is missing: pixels mean nothing without focal_px")
    try:
        config.initial.belief(config.motion)
        check_start(
            config.initial.source,
            config.localization,
            config.motion,
            {part.kind for part in config.sensors.values()},
            config.mavlink.fixes if config.mavlink is not None else (),
        )
    except ConfigError as error:
        raise ConfigError(f"{path}: initial.{error}") from None
    try:
        config.localization.settings()
        check_lateness(config.lateness, config.localization, config.motion.model)
        config.tracking.check_kind(config.localization, [t.id for t in config.targets if t.mean is None])
        config.tracking.check_targets([(target.id, target.model) for target in config.targets])
        if config.localization.form == "joint":
            followed = config.targets if config.tracking.kind != "none" else []
            check_room(LAYOUTS[config.motion.model], [(target.id, LAYOUTS[target.model]) for target in followed])
    except ConfigError as error:
        raise ConfigError(f"{path}: localization: {error}") from None
    try:
        _check_relative(config)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        for member in config.team:
            member.settings()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        config.health.settings(config.localization.form)
        config.round.settings()
        config.planning.settings()
        config.planning.check_model(config.motion.model, [(target.id, target.model) for target in config.targets])
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if config.localization.kind == "replica" and not config.team:
        raise ConfigError(
            f"{path}: key 'team' is missing: localization.kind = 'replica' needs the id, mean, start_sigma and motion "
            "of every other robot in [[team]]"
        )
    if any(member.id == config.identity.robot for member in config.team):
        raise ConfigError(f"{path}: team.{config.identity.robot} is this robot itself; list the others only")
    for name, ids in (
        ("team", [member.id for member in config.team]),
        ("target", [target.id for target in config.targets]),
        ("landmark", [landmark.id for landmark in config.landmarks]),
        ("peer", [peer.id for peer in config.zenoh.peers]),
    ):
        twice = next((item for item in ids if ids.count(item) > 1), None)
        if twice is not None:
            raise ConfigError(f"{path}: {name} id '{twice}' is used twice; ids must differ")
    try:
        simulated = config.mavlink is None or (
            parse_endpoint(config.mavlink.endpoint).is_loopback and config.mavlink.simulated
        )
    except MavlinkEndpointError as error:
        raise ConfigError(f"{path}: mavlink.endpoint: {error}") from None
    if config.mavlink is not None:
        try:
            config.mavlink.check_steering(config.settings(0).planning.kind)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
    exposed = next((item for item in config.zenoh.listen if not _LOOPBACK.match(item)), None)
    if exposed is not None and not config.zenoh.insecure_lan:
        raise ConfigError(
            f"{path}: zenoh.listen '{exposed}' is open to the network without encryption or authentication; "
            "listen on 127.0.0.1, or set zenoh.insecure_lan = true if you trust everybody on it"
        )
    if not simulated and config.clock.source != "system":
        raise ConfigError(
            f"{path}: clock.source = 'run' needs mavlink.simulated = true on loopback: a real autopilot keeps real time"
        )
    if not simulated and config.injection is not None:
        raise ConfigError(f"{path}: [injection] is refused with a real autopilot; remove it")
    unsafe = config.unsafe.settings().named()
    if unsafe and config.clock.source != "run" and (config.mavlink is None or not simulated):
        raise ConfigError(
            f"{path}: unsafe.{unsafe[0]} turns a protection off, which is refused on a robot that may be real; "
            "remove it, or declare the autopilot with mavlink.simulated = true on loopback"
        )
    return config


def _check_relative(config: AgentConfig) -> None:
    """What it takes to tell others apart is there, and nothing of it where nobody does. Raises `ConfigError`."""
    config.correspondence.check(config.localization, config.motion.model)
    config.correspondence.check_peers(config.identity.robot, config.localization)
    names = config.correspondence.names(config.localization)
    if config.localization.kind != "relative" and not names:
        return
    what = "correspondence.kind = 'gaussian_sum'" if names else "localization.kind = 'relative'"
    kinds = {name: str(part.kind) for name, part in config.sensors.items()}
    if not names:
        check_altitude(kinds, () if config.mavlink is None else tuple(config.mavlink.fixes))
    check_leader(kinds, what)
    for name, part in config.sensors.items():
        if part.kind in CAMERAS and any(mount_of(part.mount)[:3]):
            raise ConfigError(
                f"sensors.{name}.mount: {what} takes a camera to sit at the body's origin; state angles only, and let "
                "the origin be there"
            )
