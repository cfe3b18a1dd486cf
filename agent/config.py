"""Configuration files: the parts a scenario and an agent share, and the agent's own file.

TOML, read strictly: an unknown key is refused with the nearest valid name, a wrong type with what was expected.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from agent.autopilot import AutopilotSettings
from agent.estimation.motion import LAYOUTS, TargetMotion
from agent.estimation.odometry import OdometryNoise
from agent.sensor_input import SensorConfig
from agent.settings import (
    AgentSettings,
    CoastSettings,
    LatenessSettings,
    LocalizationSettings,
    TargetSettings,
    nanoseconds,
)
from network.endpoint import EndpointSettings
from network.links import LinkSettings

Id = Annotated[str, Field(pattern=r"^[a-z0-9-]{1,24}$")]
LandmarkId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,32}$")]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector2 = Annotated[list[Finite], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]


class ConfigError(ValueError):
    """A file or key the user has to change; the message is one line that says how."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class Part(BaseModel):
    """A table of a configuration file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


P = TypeVar("P", bound=BaseModel)


class LocalizationPart(Part):
    kind: Literal["clat"] = "clat"
    form: Literal["safe", "published"] = "safe"
    transform: Literal["unscented", "linearized", "jacobian"] = "unscented"
    correlation: Literal["factors", "ignored"] = "factors"
    pair_interval_s: NotNegative | None = None
    pair_timeout_s: Positive = 2.0
    innovation_cap: NotNegative = 0.0

    def settings(self) -> LocalizationSettings:
        """`safe` uses a contact of a pair every 3 s and trace weights; `published` every one and log det."""
        safe = self.form == "safe"
        interval_s = self.pair_interval_s if self.pair_interval_s is not None else (3.0 if safe else 0.0)
        return LocalizationSettings(
            form=self.form,
            transform=self.transform,
            correlation=self.correlation,
            sighting_weight="trace" if safe else "logdet",
            fusion_weight="fast" if safe else "logdet",
            pair_interval_ns=nanoseconds(interval_s),
            pair_timeout_ns=nanoseconds(self.pair_timeout_s),
            innovation_cap=self.innovation_cap,
        )


class TrackingPart(Part):
    kind: Literal["clat", "none"] = "clat"


class LatenessPart(Part):
    kind: Literal["compensate", "discard"] = "compensate"
    settle_s: NotNegative = 0.0
    tolerance_s: NotNegative = 0.001
    horizon_s: Positive = 5.0
    odometry_wait_s: NotNegative = 1.0
    clock_sigma_s: NotNegative = 0.0

    def settings(self) -> LatenessSettings:
        return LatenessSettings(
            kind=self.kind,
            settle_ns=nanoseconds(self.settle_s),
            tolerance_ns=nanoseconds(self.tolerance_s),
            horizon_ns=nanoseconds(self.horizon_s),
            odometry_wait_ns=nanoseconds(self.odometry_wait_s),
            clock_sigma_ns=nanoseconds(self.clock_sigma_s),
        )


class CoastPart(Part):
    speed_mps: Positive = 0.5
    yaw_rate_radps: Positive = 0.5

    def settings(self) -> CoastSettings:
        return CoastSettings(self.speed_mps, self.yaw_rate_radps)


class NetworkPart(Part):
    hello_period_s: Positive = 0.5
    silent_after_s: Positive = 3.0

    def settings(self, horizon_s: float) -> EndpointSettings:
        return EndpointSettings(
            hello_period_ns=nanoseconds(self.hello_period_s),
            silent_after_ns=nanoseconds(self.silent_after_s),
            horizon_ns=nanoseconds(horizon_s),
        )


class LinksPart(Part):
    """Link model. `range_m` absent: everybody hears everybody."""

    range_m: Positive | None = None
    hysteresis_m: NotNegative = 0.0
    loss: Share = 0.0
    delay_s: NotNegative = 0.0
    delay_tail_s: NotNegative = 0.0
    duplicate: Share = 0.0

    def settings(self, seed: int) -> LinkSettings:
        return LinkSettings(seed=seed, **self.model_dump())


class SigmaPart(Part):
    """Standard deviations of an initial belief."""

    position_m: Positive
    heading_rad: Positive | None = None
    velocity_mps: Positive | None = None

    def covariance(self, model: str) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Diagonal covariance of a state of `model`."""
        layout = LAYOUTS[model]
        rest = self.heading_rad if layout.heading is not None else self.velocity_mps
        if rest is None:
            key = "heading_rad" if layout.heading is not None else "velocity_mps"
            raise ConfigError(f"start_sigma.{key} is missing: the model '{model}' needs it")
        return np.diag([self.position_m**2] * 2 + [rest**2] * (layout.dim - 2))


class ControlPart(Part):
    speed_mps: Finite = 0.0
    yaw_rate_radps: Finite = 0.0


class ControlNoisePart(Part):
    """White noise on a control, held over the scenario's step (1 sigma)."""

    speed_mps: NotNegative = 0.0
    yaw_rate_radps: NotNegative = 0.0
    acceleration_mps2: NotNegative = 0.0


class OdometryPart(Part):
    """Random-walk rates and calibrated gains of an odometry; see `agent.estimation.odometry`."""

    along_m_per_sqrt_s: NotNegative = 0.02
    along_m_per_sqrt_m: NotNegative = 0.0
    across_m_per_sqrt_s: NotNegative = 0.0
    vertical_m_per_sqrt_s: NotNegative = 0.02
    heading_rad_per_sqrt_s: NotNegative = 0.005
    heading_rad_per_sqrt_rad: NotNegative = 0.0
    scale_along: Positive = 1.0
    scale_turn: Positive = 1.0

    def noise(self) -> OdometryNoise:
        return OdometryNoise(**self.model_dump())


class AgentTargetPart(Part):
    """A target as a tracker knows it: common prior and model."""

    id: Id
    model: Literal["unicycle", "constant_velocity", "damped_velocity"]
    mean: list[Finite]
    start_sigma: SigmaPart
    control: ControlPart = ControlPart()
    noise: ControlNoisePart = ControlNoisePart()
    noise_step_s: Positive = 1.0
    damping_s: Positive = 2.0

    def settings(self) -> TargetSettings:
        layout = LAYOUTS[self.model]
        if len(self.mean) != layout.dim:
            raise ConfigError(f"targets.{self.id}.mean needs {layout.dim} numbers for the model '{self.model}'")
        return TargetSettings(
            self.id,
            target_motion(self.model, self.control, self.noise, self.noise_step_s, self.damping_s),
            np.array(self.mean),
            self.start_sigma.covariance(self.model),
        )


def target_motion(
    model: str, control: ControlPart, noise: ControlNoisePart, noise_step_s: float, damping_s: float
) -> TargetMotion:
    """The motion model a table describes."""
    if LAYOUTS[model].heading is not None:
        sigma = (noise.speed_mps, noise.yaw_rate_radps)
    else:
        sigma = (noise.acceleration_mps2, noise.acceleration_mps2)
    return TargetMotion(LAYOUTS[model], (control.speed_mps, control.yaw_rate_radps), sigma, noise_step_s, damping_s)


class LandmarkPart(Part):
    """A point of known position, a UWB anchor for instance: x, y [m] in the fleet's ENU frame."""

    id: LandmarkId
    position: Vector2


class IdentityPart(Part):
    fleet: Id = "fleet"
    robot: Id
    incarnation: Annotated[int, Field(ge=1, lt=2**53)] | None = None


class ClockPart(Part):
    """`source = "run"`: fleet time starts at `t0_ns` when the launcher says so, and runs at `speed`."""

    source: Literal["system", "run"] = "system"
    t0_ns: Annotated[int, Field(ge=0)] = 0
    speed: Positive = 1.0


class InitialPart(Part):
    """Initial belief and where it comes from."""

    source: Literal["survey"] = "survey"
    mean: Vector3
    start_sigma: SigmaPart


class AgentSensorPart(Part):
    """A sensor as the estimator knows it; the covariance comes with every measurement."""

    kind: Literal["range", "bearing", "range_bearing", "position", "pose", "heading", "odometry"]
    mount: Vector3 = [0.0, 0.0, 0.0]
    two_way: bool = True


class PeerPart(Part):
    id: Id
    endpoints: list[str]


class ZenohPart(Part):
    """Zenoh endpoints: what this robot listens on, and where its peers do (lower ids are dialled)."""

    listen: list[str]
    peers: list[PeerPart] = []
    lease_ms: Annotated[int, Field(ge=100)] = 1000


class MavlinkPart(Part):
    """The autopilot's link and what is read from it."""

    endpoint: str
    simulated: bool = False
    fixes: list[Literal["position", "heading"]] = []
    fix_sigma_m: Positive = 2.0
    fix_sigma_rad: Positive = 0.1
    fix_interval_s: NotNegative = 1.0
    fix_inflation: Annotated[float, Field(ge=1.0)] = 1.0
    odometry_source: Literal["odometry", "velocity", "none"] = "odometry"
    odometry: OdometryPart = OdometryPart()
    rate_hz: Positive = 10.0

    def settings(self, origin: list[float]) -> AutopilotSettings:
        return AutopilotSettings(
            origin=(origin[0], origin[1], origin[2]),
            fixes=tuple(self.fixes),
            fix_sigma_m=self.fix_sigma_m,
            fix_sigma_rad=self.fix_sigma_rad,
            fix_interval_ns=nanoseconds(self.fix_interval_s),
            fix_inflation=self.fix_inflation,
            odometry_source=self.odometry_source,
            odometry_noise=self.odometry.noise(),
            message_interval_ns=nanoseconds(1.0 / self.rate_hz),
        )


class InjectionPart(Part):
    """Link faults injected at this receiver, for runs on one computer."""

    seed: int
    links: LinksPart = LinksPart()
    table: str | None = None
    fate_log: str | None = None


class AgentConfig(Part):
    """One robot's file."""

    version: Literal[1]
    identity: IdentityPart
    origin: Vector3 = [0.0, 0.0, 0.0]
    clock: ClockPart = ClockPart()
    initial: InitialPart
    localization: LocalizationPart = LocalizationPart()
    tracking: TrackingPart = TrackingPart()
    lateness: LatenessPart = LatenessPart()
    coast: CoastPart = CoastPart()
    network: NetworkPart = NetworkPart()
    sensors: dict[str, AgentSensorPart] = {}
    targets: list[AgentTargetPart] = []
    landmarks: list[LandmarkPart] = []
    zenoh: ZenohPart
    mavlink: MavlinkPart | None = None
    injection: InjectionPart | None = None
    state_dir: str
    recording: str | None = None
    control_socket: str | None = None

    def settings(self, start_ns: int) -> AgentSettings:
        """What the core is given when it starts at `start_ns`."""
        return AgentSettings(
            robot=self.identity.robot,
            start_ns=start_ns,
            mean=np.array(self.initial.mean),
            cov=self.initial.start_sigma.covariance("unicycle"),
            targets=tuple(target.settings() for target in self.targets),
            landmarks={item.id: (item.position[0], item.position[1]) for item in self.landmarks},
            one_way_sensors=tuple(name for name, part in sorted(self.sensors.items()) if not part.two_way),
            localization=self.localization.settings(),
            lateness=self.lateness.settings(),
            coast=self.coast.settings(),
            track=self.tracking.kind != "none",
        )

    def sensor_configs(self) -> dict[str, SensorConfig]:
        return {
            name: SensorConfig((part.mount[0], part.mount[1], part.mount[2])) for name, part in self.sensors.items()
        }


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as a dictionary. Raises `ConfigError` naming the file and what is wrong with it."""
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise ConfigError(f"{path}: is a folder, a TOML file is needed") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error.__class__.__name__})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None


def validate(model: type[P], data: dict[str, Any], where: str) -> P:
    """`data` as a `model`. Raises `ConfigError` with the first offending key and the remedy."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{where}: {explain(model, data, error)}") from None


def explain(model: type[BaseModel], data: dict[str, Any], error: ValidationError) -> str:
    """One line for the first fault of a validation."""
    first = min(error.errors(), key=lambda item: item["type"] != "extra_forbidden")
    path, value = _readable_path(data, first["loc"]), first.get("input")
    if first["type"] == "extra_forbidden":
        names = _valid_names(model, first["loc"][:-1])
        near = difflib.get_close_matches(str(first["loc"][-1]), names, n=1, cutoff=0.5)
        hint = f"did you mean '{near[0]}'?" if near else f"valid keys: {', '.join(names)}"
        return f"unknown key '{path}': {hint}"
    if first["type"] == "missing":
        return f"key '{path}' is missing"
    message = first["msg"][0].lower() + first["msg"][1:]
    if first["type"] in ("model_type", "dict_type"):
        message = "a table is needed"
    shown = repr(value) if isinstance(value, (str, int, float, bool)) else type(value).__name__
    if isinstance(value, float) and math.isnan(value):
        shown = "nan"
    return f"key '{path}' = {shown}: {message}"


def _readable_path(data: Any, location: tuple[Any, ...]) -> str:
    """A dotted path in which entries of an array of tables go by their id."""
    parts, here = [], data
    for key in location:
        if isinstance(key, int):
            here = here[key] if isinstance(here, list) and key < len(here) else None
            parts.append(str(here.get("id", key)) if isinstance(here, dict) else str(key))
        else:
            here = here.get(key) if isinstance(here, dict) else None
            parts.append(str(key))
    return ".".join(parts)


def _valid_names(model: type[BaseModel], location: tuple[Any, ...]) -> list[str]:
    """Field names of the table at `location` below `model`."""
    here: Any = model
    for key in location:
        if _is_table(here):
            field = here.model_fields.get(str(key))
            here = _required(field.annotation) if field is not None else None
        else:
            # An index or a name of free choice: on to the type of the entries.
            here = _required((get_args(here) or (None,))[-1])
    return sorted(here.model_fields) if _is_table(here) else []


def _is_table(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _required(annotation: Any) -> Any:
    """A type without its `| None`."""
    if get_origin(annotation) is UnionType:
        return next(argument for argument in get_args(annotation) if argument is not type(None))
    return annotation


def load_agent_config(path: Path) -> AgentConfig:
    """Read one robot's file. Raises `ConfigError`."""
    config = validate(AgentConfig, read_toml(path), str(path))
    try:
        for target in config.targets:
            target.settings()
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        config.initial.start_sigma.covariance("unicycle")
    except ConfigError as error:
        raise ConfigError(f"{path}: initial.{error}") from None
    for name, ids in (
        ("target", [target.id for target in config.targets]),
        ("landmark", [landmark.id for landmark in config.landmarks]),
        ("peer", [peer.id for peer in config.zenoh.peers]),
    ):
        twice = next((item for item in ids if ids.count(item) > 1), None)
        if twice is not None:
            raise ConfigError(f"{path}: {name} id '{twice}' is used twice; ids must differ")
    simulated = config.mavlink is None or config.mavlink.simulated
    if not simulated and config.clock.source != "system":
        raise ConfigError(
            f"{path}: clock.source = 'run' needs mavlink.simulated = true: a real autopilot keeps real time"
        )
    if not simulated and config.injection is not None:
        raise ConfigError(f"{path}: [injection] is refused with a real autopilot; remove it")
    return config
