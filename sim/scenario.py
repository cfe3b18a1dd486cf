"""Scenario files: what a run consists of. `sim/scenarios/ut-clat.toml` is the commented example."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from agent.calibration import Form
from agent.config_file import (
    ConfigError,
    Finite,
    Id,
    NotNegative,
    P,
    Part,
    Positive,
    Share,
    Vector2,
    Vector3,
    validate,
)
from agent.config_parts import (
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
    RobotModel,
    SensorKind,
    SigmaPart,
    StatePart,
)
from agent.estimation.motion import TargetMotion
from agent.estimation.mounting import mount_of
from agent.fault_parts import FaultPart
from agent.motion_parts import ControlNoisePart, ControlPart, OdometryPart
from agent.planning_parts import PLAIN, PlanningPart, RoundPart
from agent.relative_parts import CorrespondencePart
from agent.sensor_input import SensorConfig
from agent.settings import nanoseconds
from agent.start_config import StartSource
from agent.target_parts import TargetModel, TrackingPart, target_motion
from agent.unsafe_parts import UnsafePart
from sim.arcs import ArcPart
from sim.course import CoursePart, DrivePart
from sim.directions import DirectionNoise

Subject = Literal["peers", "landmarks", "targets"]

SPATIAL_FORMATS = ("drone_cameras",)
"""Recordings in space; those of other formats are planar."""

MIN_STEP_S = 0.001
"""The shortest step of a world."""


class PlacementPart(Part):
    """Where robots start.

    `random_phases`: each on its circle at a phase drawn from the seed. A draw is rejected until the contact graph over
    one lap (who comes within `contact_range_m` of whom on undisturbed circles) connects every robot with `reaches`.
    `apart`: poses with a `spread` are drawn until no two robots are nearer than `apart_m`, seen from above.
    """

    rule: Literal["random_phases", "apart"] = "random_phases"
    contact_range_m: Positive | None = None
    reaches: Id | None = None
    apart_m: Positive | None = None
    max_draws: Annotated[int, Field(ge=1)] = 10000


class SteeringPart(Part):
    """How robots are steered on their true places, instead of by constant controls; so every method sees the same.

    `potential`: they keep around the first target and off each other; see `agent.planning.potential`.
    """

    rule: Literal["potential"] = "potential"
    max_speed_mps: Positive = 0.5
    max_turn_radps: Positive = 0.62831853
    apart_m: Positive = 10.0
    closest_m: Positive = 6.0
    radio_range_m: Positive = 30.0


class WorldPart(Part):
    kind: Literal["simulated", "recording"] = "simulated"
    format: Literal["utias", "tiers", "drone_cameras"] = "utias"
    path: str | None = None
    robots: list[Id] | None = None
    placement: PlacementPart | None = None
    steering: SteeringPart | None = None


class CirclePart(Part):
    center_m: Vector2
    radius_m: Positive


class StartPart(Part):
    """True start: a pose (x, y[, z], heading), a full target state, or a place on a circle drawn from the seed.

    A pose may be off by up to `spread` (of each number), drawn evenly from the seed. The belief of it is off by `error`
    (of each number), or by a draw from start_sigma.
    """

    pose: Annotated[list[Finite], Field(min_length=3, max_length=6)] | None = None
    spread: Annotated[list[NotNegative], Field(max_length=6)] = []
    error: list[Finite] | None = None
    circle: CirclePart | None = None


class SensorPart(Part):
    """A sensor: what it measures (`kind`, by default its name), of whom, how well, how far and how often.

    sigma_m grows by sigma_m_per_m with the distance; sigma_z_m is that of an altitude, sigma_m by default. `rate_hz`
    absent: once per step; of recorded sightings all, and at most so many otherwise. Nothing is seen beyond
    `max_range_m`, nearer than `min_range_m` or out of the field of view `fov_rad`, which is centred on the sensor's
    forward axis. Simulated ranges are too long by `bias_m`, or by what `bias_of` says of the subject. Directions
    (`bearing3`) err by `noise`, see `sim.directions`. Who could be seen is detected with the probability `detects`; the
    share `false_share` of detections is of a direction drawn evenly. A camera that is `anonymous` does not tell whom it
    sees (it does to robots of `correspondence.kind = "known"`, with the same noise), and sees `clutter` others per scan
    where nobody is. With a `gimbal` the field of view is a cone about
    where the camera saw a target last, see `sim.gimbal`. A recorded camera has the mount and intrinsics of the
    recording. The error of absolute information lasts for `correlation_s` (first-order; 0: each is a new one).
    """

    kind: SensorKind | None = None
    of: list[Subject] = []
    sigma_m: Positive | None = None
    sigma_m_per_m: NotNegative = 0.0
    sigma_z_m: Positive | None = None
    sigma_rad: Positive | None = None
    sigma_px: Positive | None = None
    noise: DirectionNoise = "angles"
    detects: Share = 1.0
    false_share: Share = 0.0
    correlation_s: NotNegative = 0.0
    anonymous: bool = False
    clutter: NotNegative = 0.0
    bias_m: Finite = 0.0
    bias_of: dict[str, Finite] = {}
    max_range_m: Positive | None = None
    min_range_m: NotNegative = 0.0
    fov_rad: Positive | None = None
    gimbal: bool = False
    rate_hz: Positive | None = None
    mount: MountVector = [0.0, 0.0, 0.0]
    intrinsics: IntrinsicsPart = IntrinsicsPart()
    two_way: bool = True
    calibration: CalibrationPart = CalibrationPart()
    lag_s: Finite = 0.0
    form: Form = "polar"


class VehiclePart(Part):
    """What the vehicle of a robot with planning can do, whatever it is told.

    `min_speed_mps` below 0: it drives backwards too; above 0: it cannot stand still. Without `max_acceleration_mps2`
    its speed changes at once. It `turns` along its way, on an arc, or after it: straight on, and then on the spot, as
    the discrete unicycle of publications does in each step.

    One that `flies` goes in any direction, and stands still in the air: `max_speed_mps` is level, `max_climb_mps` up
    and down (absent: as fast), and its velocity changes by `max_acceleration_mps2` whatever way.
    """

    flies: bool = False
    max_climb_mps: Positive | None = None

    max_speed_mps: Positive = PLAIN.max_speed_mps
    max_turn_radps: Positive = PLAIN.max_turn_radps
    max_acceleration_mps2: Positive | None = None
    min_speed_mps: Finite = 0.0
    turns: Literal["along", "after"] = "along"

    @property
    def climb_mps(self) -> float:
        """How fast it climbs and sinks."""
        return self.max_speed_mps if self.max_climb_mps is None else self.max_climb_mps


class AutopilotPart(Part):
    """What the vehicle's autopilot sends: a GPS-denied one odometry in a drifting local frame only. How it is found at
    the start: `mode` is a flight mode of its flavour, `GUIDED` for instance; absent: one that a person drives in.
    """

    sends: list[Literal["odometry", "global_position", "attitude"]] = ["odometry", "attitude"]
    flavour: Literal["ardupilot", "px4"] = "ardupilot"
    armed: bool = False
    mode: str | None = None


class RobotPart(Part):
    """A robot.

    With a `course` it follows that exactly, at its commanded speed, and the noise is what its odometry is off by.
    `start_source` is where it has its start from, see `agent.start_config`; `tilt_rad` is the standard deviation of its
    roll and pitch, new at every instant and known to it. With an `arc` it flies that exactly, and its odometry errs.
    """

    id: Id
    model: RobotModel = "unicycle"
    gain_walk_per_sqrt_s: NotNegative = 0.003
    start: StartPart = StartPart()
    start_sigma: SigmaPart
    start_source: StartSource = "survey"
    course: DrivePart | None = None
    control: ControlPart = ControlPart()
    noise: ControlNoisePart = ControlNoisePart()
    arc: ArcPart | None = None
    odometry: OdometryPart | None = None
    vehicle: VehiclePart = VehiclePart()
    tilt_rad: NotNegative = 0.0
    sensors: dict[str, SensorPart] = {}
    autopilot: AutopilotPart = AutopilotPart()
    localization: dict[str, Any] = {}
    tracking: dict[str, Any] = {}
    correspondence: dict[str, Any] = {}
    lateness: dict[str, Any] = {}
    planning: dict[str, Any] = {}

    def motion(self) -> MotionPart:
        """How an estimator takes the robot to move."""
        return MotionPart(
            model=self.model,
            gain_walk_per_sqrt_s=self.gain_walk_per_sqrt_s,
            altitude_m=self.control.altitude_m,
            altitude_sigma_m=self.noise.altitude_m,
        )


class TargetPart(Part):
    """A target. Without a `prior` no robot knows of its place before it is seen.

    With `assumed_noise` its control is unknown to the robots, but for an altitude: they take it to be none, with this
    noise. One with a `course` follows it exactly, and its noise is only what robots assume of it.
    """

    id: Id
    model: TargetModel = "unicycle"
    recorded: bool = False
    prior: bool = True
    start: StartPart = StartPart()
    start_sigma: SigmaPart
    course: CoursePart | None = None
    control: ControlPart = ControlPart()
    noise: ControlNoisePart = ControlNoisePart()
    assumed_noise: ControlNoisePart | None = None
    damping_s: Positive = 2.0

    def assumed(self) -> tuple[ControlPart, ControlNoisePart]:
        """Control and noise as the robots know them."""
        if self.assumed_noise is None:
            return self.control, self.noise
        return ControlPart(altitude_m=self.control.altitude_m), self.assumed_noise

    def motion(self, step_s: float) -> TargetMotion:
        """How an estimator takes the target to move."""
        return target_motion(self.model, *self.assumed(), step_s, self.damping_s)


class CentralizedPart(Part):
    """The centralized filter of `--bound`: a pair's measurements are used at most so often (0: all of them)."""

    pair_interval_s: NotNegative = 0.0


class FaultPlanPart(Part):
    """Faults drawn at random, anew for every trial: `calm` rare and short ones, `field` a bad day, `storm` all at once.

    None begins in the last `quiet_s`, and all are over by then.
    """

    intensity: Literal["calm", "field", "storm"]
    quiet_s: NotNegative = 5.0
    processes: bool = True


class BoundPart(Part):
    """A condition on one figure of the summary."""

    min: Finite | None = None
    max: Finite | None = None


class Scenario(Part):
    """A whole scenario."""

    version: Literal[1]
    name: Id
    duration_s: Positive
    step_s: Positive
    sample_s: Positive = 1.0
    window_s: Vector2
    lost_above_m: Positive = 8.0
    collision_m: Positive = 2.0
    origin: Vector3 = [47.397742, 8.545594, 488.0]
    world: WorldPart = WorldPart()
    localization: LocalizationPart = LocalizationPart()
    tracking: TrackingPart = TrackingPart()
    correspondence: CorrespondencePart = CorrespondencePart()
    lateness: LatenessPart = LatenessPart()
    coast: CoastPart = CoastPart()
    health: HealthPart = HealthPart()
    round: RoundPart = RoundPart()
    planning: PlanningPart = PlanningPart()
    unsafe: UnsafePart = UnsafePart()
    network: NetworkPart = NetworkPart()
    state: StatePart = StatePart()
    links: LinksPart = LinksPart()
    robots: Annotated[list[RobotPart], Field(min_length=1)]
    targets: list[TargetPart] = []
    landmarks: list[LandmarkPart] = []
    centralized: CentralizedPart = CentralizedPart()
    faults: list[FaultPart] = []
    fault_plan: FaultPlanPart | None = None
    expect: dict[str, BoundPart] = {}

    def movers(self) -> dict[str, RobotPart | TargetPart]:
        """Robots, then targets, by id."""
        parts: list[RobotPart | TargetPart] = [*self.robots, *self.targets]
        return {part.id: part for part in parts}

    def localization_of(self, robot: RobotPart) -> LocalizationPart:
        return self._overridden(LocalizationPart, self.localization, robot, "localization")

    def lateness_of(self, robot: RobotPart) -> LatenessPart:
        return self._overridden(LatenessPart, self.lateness, robot, "lateness")

    def tracking_of(self, robot: RobotPart) -> TrackingPart:
        return self._overridden(TrackingPart, self.tracking, robot, "tracking")

    def correspondence_of(self, robot: RobotPart) -> CorrespondencePart:
        return self._overridden(CorrespondencePart, self.correspondence, robot, "correspondence")

    def planning_of(self, robot: RobotPart) -> PlanningPart:
        return self._overridden(PlanningPart, self.planning, robot, "planning")

    def planners(self) -> list[RobotPart]:
        """The robots that choose their motion."""
        return [robot for robot in self.robots if self.planning_of(robot).kind != "none"]

    def _overridden(self, model: type[P], base: P, robot: RobotPart, name: str) -> P:
        own: dict[str, Any] = getattr(robot, name)
        if not own:
            return base
        merged = {**base.model_dump(), **own}
        try:
            return validate(model, merged, f"robots.{robot.id}.{name}")
        except ConfigError as error:
            raise ConfigError(f"{self.name}: {error}") from None


KINDS: tuple[str, ...] = get_args(SensorKind)


def sensor_kind(name: str, sensor: SensorPart) -> str:
    """The kind of a sensor: stated, or its name."""
    return sensor.kind if sensor.kind is not None else name


def target_sensor(robot: RobotPart) -> SensorPart | None:
    """The sensor a planner reckons with: the first of kind `range_bearing` that sees targets."""
    for name, sensor in robot.sensors.items():
        if sensor_kind(name, sensor) == "range_bearing" and "targets" in sensor.of:
            return sensor
    return None


def sensor_config(sensor: SensorPart) -> SensorConfig:
    """The sensor as an estimator knows it."""
    return SensorConfig(
        mount_of(sensor.mount),
        sensor.calibration.settings(),
        nanoseconds(sensor.lag_s),
        sensor.form,
        sensor.intrinsics.settings(),
    )
