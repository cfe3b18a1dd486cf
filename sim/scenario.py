"""Scenario files: what a run consists of. `sim/scenarios/ut-clat.toml` is the commented example."""

from __future__ import annotations

import difflib
import tomllib
from importlib import resources
from pathlib import Path
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
    Vector2,
    Vector3,
    read_toml,
    validate,
)
from agent.config_parts import (
    MAX_TEAM,
    CalibrationPart,
    CoastPart,
    ControlNoisePart,
    ControlPart,
    IntrinsicsPart,
    LandmarkPart,
    LatenessPart,
    LinksPart,
    LocalizationPart,
    MotionPart,
    MountVector,
    NetworkPart,
    OdometryPart,
    RobotModel,
    SensorKind,
    SigmaPart,
)
from agent.estimation.motion import LAYOUTS, TargetMotion
from agent.estimation.observation import RELATIVE_ANGLES, mount_of
from agent.joint_room import check_room
from agent.sensor_input import SensorConfig
from agent.settings import nanoseconds
from agent.start_config import StartSource, check_start
from agent.target_parts import TargetModel, TrackingPart, target_motion

Subject = Literal["peers", "landmarks", "targets"]

MIN_STEP_S = 0.001
"""The shortest step of a world."""


class PlacementPart(Part):
    """Where robots start: each on its circle at a phase drawn from the seed.

    A draw is rejected until the contact graph over one lap (who comes within `contact_range_m` of whom on
    undisturbed circles) connects every robot with `reaches`.
    """

    rule: Literal["random_phases"] = "random_phases"
    contact_range_m: Positive
    reaches: Id
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
    format: Literal["utias", "tiers"] = "utias"
    path: str | None = None
    robots: list[Id] | None = None
    placement: PlacementPart | None = None
    steering: SteeringPart | None = None


class CirclePart(Part):
    center_m: Vector2
    radius_m: Positive


class StartPart(Part):
    """True start: a pose (x, y[, z], heading), a full target state, or a place on a circle drawn from the seed.

    A pose may be off by up to `spread` (of each number), drawn evenly from the seed.
    """

    pose: Annotated[list[Finite], Field(min_length=3, max_length=6)] | None = None
    spread: Annotated[list[NotNegative], Field(max_length=6)] = []
    circle: CirclePart | None = None


class SensorPart(Part):
    """A sensor: what it measures (`kind`, by default its name), of whom, how well, how far and how often.

    sigma_m grows by sigma_m_per_m with the distance; sigma_z_m is that of an altitude, sigma_m by default. `rate_hz`
    absent: once per step. Nothing is seen beyond `max_range_m`, nearer than `min_range_m` or out of the field of view
    `fov_rad`, which is centred on the sensor's forward axis. Simulated ranges are too long by `bias_m`, or by what
    `bias_of` says of the subject.
    """

    kind: SensorKind | None = None
    of: list[Subject] = []
    sigma_m: Positive | None = None
    sigma_m_per_m: NotNegative = 0.0
    sigma_z_m: Positive | None = None
    sigma_rad: Positive | None = None
    sigma_px: Positive | None = None
    bias_m: Finite = 0.0
    bias_of: dict[str, Finite] = {}
    max_range_m: Positive | None = None
    min_range_m: NotNegative = 0.0
    fov_rad: Positive | None = None
    rate_hz: Positive | None = None
    mount: MountVector = [0.0, 0.0, 0.0]
    intrinsics: IntrinsicsPart = IntrinsicsPart()
    two_way: bool = True
    calibration: CalibrationPart = CalibrationPart()
    lag_s: Finite = 0.0
    form: Form = "polar"


class AutopilotPart(Part):
    """What the vehicle's autopilot sends. A GPS-denied one sends odometry in a drifting local frame only."""

    sends: list[Literal["odometry", "global_position", "attitude"]] = ["odometry", "attitude"]
    flavour: Literal["ardupilot", "px4"] = "ardupilot"


class RobotPart(Part):
    """A robot.

    `start_source` is where it has its start from, see `agent.start_config`; `tilt_rad` is the standard deviation of its
    roll and pitch, new at every instant and known to it.
    """

    id: Id
    model: RobotModel = "unicycle"
    gain_walk_per_sqrt_s: NotNegative = 0.003
    start: StartPart = StartPart()
    start_sigma: SigmaPart
    start_source: StartSource = "survey"
    control: ControlPart = ControlPart()
    noise: ControlNoisePart = ControlNoisePart()
    odometry: OdometryPart | None = None
    tilt_rad: NotNegative = 0.0
    sensors: dict[str, SensorPart] = {}
    autopilot: AutopilotPart = AutopilotPart()
    localization: dict[str, Any] = {}
    tracking: dict[str, Any] = {}
    lateness: dict[str, Any] = {}

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
    noise.
    """

    id: Id
    model: TargetModel = "unicycle"
    recorded: bool = False
    prior: bool = True
    start: StartPart = StartPart()
    start_sigma: SigmaPart
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
    window_s: Vector2
    lost_above_m: Positive = 8.0
    origin: Vector3 = [47.397742, 8.545594, 488.0]
    world: WorldPart = WorldPart()
    localization: LocalizationPart = LocalizationPart()
    tracking: TrackingPart = TrackingPart()
    lateness: LatenessPart = LatenessPart()
    coast: CoastPart = CoastPart()
    network: NetworkPart = NetworkPart()
    links: LinksPart = LinksPart()
    robots: Annotated[list[RobotPart], Field(min_length=1)]
    targets: list[TargetPart] = []
    landmarks: list[LandmarkPart] = []
    centralized: CentralizedPart = CentralizedPart()
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

    def _overridden(self, model: type[P], base: P, robot: RobotPart, name: str) -> P:
        own: dict[str, Any] = getattr(robot, name)
        if not own:
            return base
        merged = {**base.model_dump(), **own}
        try:
            return validate(model, merged, f"robots.{robot.id}.{name}")
        except ConfigError as error:
            raise ConfigError(f"{self.name}: {error}") from None


def bundled() -> list[str]:
    """Names of the bundled scenarios."""
    folder = resources.files("sim.scenarios")
    return sorted(item.name.removesuffix(".toml") for item in folder.iterdir() if item.name.endswith(".toml"))


def locate(name: str) -> Path:
    """The file of a scenario given by path or bundled name. Raises `ConfigError` with the nearest name."""
    path = Path(name)
    if path.suffix == ".toml" or path.exists():
        return path
    if name in bundled():
        return Path(str(resources.files("sim.scenarios") / f"{name}.toml"))
    near = difflib.get_close_matches(name, bundled(), n=1, cutoff=0.4)
    hint = f"did you mean '{near[0]}'?" if near else "bundled: " + ", ".join(bundled())
    raise ConfigError(f"no scenario '{name}': {hint}")


def load(name: str, overrides: list[str] | None = None) -> Scenario:
    """Read a scenario and apply `--set` overrides (`links.loss=0.3`, `robots.r2.sensors.range.sigma_m=0.1`)."""
    path = locate(name)
    data = read_toml(path)
    for override in overrides or []:
        apply_override(data, override)
    scenario = validate(Scenario, data, str(path))
    if (only := scenario.world.robots) is not None:
        ids = [robot.id for robot in scenario.robots]
        stranger = next((name for name in only if name not in ids), None)
        if stranger is not None or not only:
            there = ", ".join(ids)
            raise ConfigError(f"{scenario.name}: world.robots: no robot '{stranger or ''}'; there are: {there}")
        scenario = scenario.model_copy(update={"robots": [robot for robot in scenario.robots if robot.id in only]})
    check(scenario)
    return scenario


def apply_override(data: dict[str, Any], override: str) -> None:
    """Set one dotted key; entries of arrays of tables go by their id, `*` meaning all of them."""
    key, separator, text = override.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {override}: write KEY=VALUE, for instance links.loss=0.3")
    _assign(data, key.strip().split("."), _parse(text.strip()), override)


def _parse(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _assign(here: dict[str, Any], path: list[str], value: Any, override: str) -> None:
    head, rest = path[0], path[1:]
    if not rest:
        here[head] = value
        return
    below = here.setdefault(head, {})
    if isinstance(below, list):
        entries = [item for item in below if isinstance(item, dict) and (rest[0] == "*" or item.get("id") == rest[0])]
        if not entries:
            ids = ", ".join(str(item.get("id")) for item in below if isinstance(item, dict))
            raise ConfigError(f"--set {override}: no '{rest[0]}' in {head}; there are: {ids}")
        if len(rest) == 1:
            raise ConfigError(f"--set {override}: name a key of {head}.{rest[0]}")
        for entry in entries:
            _assign(entry, rest[1:], value, override)
        return
    if not isinstance(below, dict):
        raise ConfigError(f"--set {override}: '{head}' is a value, not a table")
    _assign(below, rest, value, override)


def check(scenario: Scenario) -> None:
    """What no single key can tell. Raises `ConfigError`."""
    ids = [robot.id for robot in scenario.robots] + [target.id for target in scenario.targets]
    for name in ids:
        if ids.count(name) > 1:
            raise ConfigError(f"{scenario.name}: id '{name}' is used twice; ids must differ")
    names = [landmark.id for landmark in scenario.landmarks]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{scenario.name}: landmark id '{name}' is used twice; ids must differ")
    if scenario.step_s < MIN_STEP_S:
        raise ConfigError(f"{scenario.name}: step_s = {scenario.step_s:g} is below {MIN_STEP_S:g} s; enlarge it")
    if scenario.duration_s < scenario.step_s:
        raise ConfigError(
            f"{scenario.name}: duration_s = {scenario.duration_s:g} is shorter than one step; "
            f"make it at least step_s = {scenario.step_s:g}"
        )
    if not 0.0 <= scenario.window_s[0] < scenario.window_s[1]:
        raise ConfigError(f"{scenario.name}: window_s must be [from, to] with from < to")
    if scenario.window_s[0] >= scenario.duration_s:
        raise ConfigError(
            f"{scenario.name}: window_s starts at {scenario.window_s[0]:g} s, after the run's end at "
            f"{scenario.duration_s:g} s; shorten it with --set 'window_s=[0, {scenario.duration_s:g}]'"
        )
    recorded = scenario.world.kind == "recording"
    if recorded and scenario.world.path is None:
        raise ConfigError(f"{scenario.name}: world.path is missing; add --set world.path=FOLDER of the recording")
    placement = scenario.world.placement
    circling = [robot.id for robot in scenario.robots if robot.start.circle is not None]
    if placement is not None and circling and placement.reaches not in circling:
        raise ConfigError(
            f"{scenario.name}: world.placement.reaches = '{placement.reaches}' is no robot on a circle; "
            f"there are: {', '.join(circling)}"
        )
    _check_steering(scenario)
    _check_team(scenario)
    for robot in scenario.robots:
        _check_mover(f"{scenario.name}: robots.{robot.id}", robot)
        if recorded and LAYOUTS[robot.model].altitude is not None:
            raise ConfigError(
                f"{scenario.name}: robots.{robot.id}.model = '{robot.model}' has an altitude, and recordings are "
                "planar; take 'unicycle'"
            )
        scenario.lateness_of(robot)
        localization, tracking = scenario.localization_of(robot), scenario.tracking_of(robot)
        try:
            localization.settings()
            tracking.check_kind(localization, [target.id for target in scenario.targets if not target.prior])
            if localization.form == "joint":
                followed = scenario.targets if tracking.kind != "none" else []
                check_room(LAYOUTS[robot.model], [(target.id, LAYOUTS[target.model]) for target in followed])
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: localization: {error}") from None
        try:
            kinds = {sensor_kind(name, sensor) for name, sensor in robot.sensors.items()}
            check_start(robot.start_source, localization, robot.motion(), kinds, ())
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start_{error}") from None
        if not recorded and (robot.start.pose is None) == (robot.start.circle is None):
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start needs either 'pose' or 'circle'")
        if robot.start.circle is not None and scenario.world.placement is None:
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start.circle needs a [world.placement]")
        for name, sensor in robot.sensors.items():
            where = f"{scenario.name}: robots.{robot.id}.sensors.{name}"
            check_sensor(where, name, sensor)
    for target in scenario.targets:
        _check_mover(f"{scenario.name}: targets.{target.id}", target)
        if target.recorded != recorded:
            raise ConfigError(
                f"{scenario.name}: targets.{target.id}.recorded = {str(recorded).lower()} is needed in a "
                f"{scenario.world.kind} world"
            )
        if recorded and (LAYOUTS[target.model].heading is not None or LAYOUTS[target.model].dim != 4):
            raise ConfigError(
                f"{scenario.name}: targets.{target.id}.model = '{target.model}' needs what nobody knows of a "
                "recorded target; take 'damped_velocity' or 'constant_velocity'"
            )
        if not recorded and target.start.pose is None:
            raise ConfigError(f"{scenario.name}: targets.{target.id}.start.pose is missing")


def _check_team(scenario: Scenario) -> None:
    """Either all robots tell each other raw data or none, and they are few."""
    kinds = {robot.id: scenario.localization_of(robot).kind for robot in scenario.robots}
    if "replica" not in kinds.values():
        return
    other = next((name for name, kind in kinds.items() if kind != "replica"), None)
    if other is not None:
        raise ConfigError(
            f"{scenario.name}: robots.{other}.localization.kind = '{kinds[other]}' beside 'replica': who does not tell "
            "its raw data is nowhere in the belief of the others; give all robots one kind"
        )
    if len(kinds) > MAX_TEAM + 1:
        raise ConfigError(
            f"{scenario.name}: localization.kind = 'replica' takes {MAX_TEAM + 1} robots at most, there are "
            f"{len(kinds)}; take 'clat'"
        )


def _check_steering(scenario: Scenario) -> None:
    """Steered robots move in the plane around a target, and by nothing else."""
    if scenario.world.steering is None:
        return
    where = f"{scenario.name}: world.steering"
    if scenario.world.kind == "recording":
        raise ConfigError(f"{where} does not go with a recording; leave it out")
    if not scenario.targets:
        raise ConfigError(f"{where} needs one of [[targets]] to keep around")
    for robot in scenario.robots:
        if robot.model != "unicycle":
            raise ConfigError(f"{where}: robots.{robot.id}.model = '{robot.model}' is not steered; take 'unicycle'")
        if robot.control != ControlPart():
            raise ConfigError(f"{where}: robots.{robot.id}.control is not used with it; leave it out")


def _check_mover(where: str, part: RobotPart | TargetPart) -> None:
    """Deviations of the start, altitude noise and size of the pose are those the model needs."""
    try:
        part.start_sigma.covariance(part.model, isinstance(part, RobotPart) or part.prior)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from None
    try:
        if isinstance(part, RobotPart):
            part.motion().settings()
        else:
            part.motion(1.0)
    except ConfigError as error:
        raise ConfigError(f"{where}.noise: {error}") from None


KINDS: tuple[str, ...] = get_args(SensorKind)


def sensor_kind(name: str, sensor: SensorPart) -> str:
    """The kind of a sensor: stated, or its name."""
    return sensor.kind if sensor.kind is not None else name


def sensor_config(sensor: SensorPart) -> SensorConfig:
    """The sensor as an estimator knows it."""
    return SensorConfig(
        mount_of(sensor.mount),
        sensor.calibration.settings(),
        nanoseconds(sensor.lag_s),
        sensor.form,
        sensor.intrinsics.settings(),
    )


def check_sensor(where: str, name: str, sensor: SensorPart) -> None:
    """Raises `ConfigError` if the sensor lacks a kind, a subject or a standard deviation."""
    kind = sensor_kind(name, sensor)
    if kind not in KINDS:
        raise ConfigError(f"{where}: state its kind, one of {', '.join(KINDS)}")
    needs_m = kind in ("range", "range_bearing", "vector", "position", "pose")
    needs_rad = kind in ("bearing", "bearing3", "range_bearing", "pose", "heading")
    if needs_m and sensor.sigma_m is None:
        raise ConfigError(f"{where}: sigma_m is missing")
    if needs_rad and sensor.sigma_rad is None:
        raise ConfigError(f"{where}: sigma_rad is missing")
    if kind == "altitude" and sensor.sigma_m is None and sensor.sigma_z_m is None:
        raise ConfigError(f"{where}: sigma_z_m is missing")
    if kind == "pixel" and sensor.sigma_px is None:
        raise ConfigError(f"{where}: sigma_px is missing")
    if kind in RELATIVE_ANGLES and not sensor.of:
        raise ConfigError(f'{where}: of is missing, for instance of = ["peers"]')
