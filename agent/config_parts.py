"""Parts that the file of a scenario and that of an agent have in common."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from agent.calibration import NO_CALIBRATION, Calibration
from agent.config_file import ConfigError, Finite, Id, LandmarkId, NotNegative, Part, Point, Positive, Share, Vector2
from agent.estimation.gain_motion import GainMotion
from agent.estimation.motion import (
    LAYOUTS,
    HeldAltitude,
    RobotMotion,
    SpatialMotion,
    StateLayout,
)
from agent.estimation.observation import Intrinsics
from agent.settings import (
    CoastSettings,
    HealthSettings,
    LatenessKind,
    LatenessSettings,
    LocalizationSettings,
    RoundWeights,
    TeamMember,
    UnsafeSettings,
    nanoseconds,
)
from network.endpoint import EndpointSettings
from network.links import LinkSettings

MAX_TEAM = 15
"""Others of a team that share a joint belief: time and memory grow with powers of their number."""

PROTECTED = UnsafeSettings()
"""No protection is switched off."""


class LocalizationPart(Part):
    kind: Literal["clat", "replica", "jlatt", "leader", "relative", "fixed"] = "clat"
    form: Literal["auto", "split_joint", "safe", "published", "joint"] = "auto"
    transform: Literal["unscented", "linearized", "jacobian"] | None = None
    correlation: Literal["factors", "ignored"] = "factors"
    weights: RoundWeights = "split_ci"
    pair_interval_s: NotNegative | None = None
    pair_timeout_s: Positive = 2.0
    innovation_cap: NotNegative | None = None
    leader: Id | None = None
    exchange: Literal["broadcast", "request"] = "broadcast"
    fixes: Literal["fused", "trusted"] = "fused"
    leader_correlation_s: NotNegative = 0.0
    clock_state: bool = False

    def settings(self) -> LocalizationSettings:
        """`safe` uses a contact of a pair every 3 s and trace weights; `published` every one and log det.

        `split_joint` and `joint` use every contact, and cap innovations unless told otherwise; `replica` and `jlatt`
        have no forms, and cap them only if told. `jlatt` is linearized, as in Su 2022: a transform
        that allows for wrong headings makes beliefs vague that no correlation is known of. Raises `ConfigError` for
        what the kind does not have, and for a naive baseline of `split_joint` and `joint`.
        """
        if self.kind != "jlatt":
            self._refuse("weights", "jlatt", f"kind '{self.kind}' has no rounds")
        if self.kind != "leader":
            for key in ("leader", "exchange", "fixes", "leader_correlation_s", "clock_state"):
                self._refuse(key, "leader", f"kind '{self.kind}' follows nobody")
        elif self.leader is None:
            raise ConfigError("leader is missing: kind = 'leader' needs the id of who leads, as leader = 'r1'")
        if self.kind in ("fixed", "relative"):
            self._refuse("innovation_cap", "clat", f"kind '{self.kind}' has no innovations of poses")
        if self.kind != "clat":
            for key in ("form", "correlation", "pair_interval_s"):
                self._refuse(key, "clat", f"kind '{self.kind}' has no contacts of pairs")
            if self.kind == "leader":
                return self._following()
            return LocalizationSettings(
                kind=self.kind,
                transform=self.transform or ("jacobian" if self.kind == "jlatt" else "unscented"),
                weights=self.weights,
                innovation_cap=self.innovation_cap or 0.0,
            )
        joint = self.form in ("auto", "split_joint", "joint")
        if self.correlation == "ignored" and joint:
            raise ConfigError(
                "correlation = 'ignored' is a baseline of two forms only; add form = 'published' or 'safe'"
            )
        safe = self.form == "safe"
        interval_s = self.pair_interval_s if self.pair_interval_s is not None else (3.0 if safe else 0.0)
        cap = self.innovation_cap if self.innovation_cap is not None else (9.0 if joint else 0.0)
        return LocalizationSettings(
            form=self.form,
            transform=self.transform or "unscented",
            correlation=self.correlation,
            sighting_weight="trace" if safe else "logdet",
            fusion_weight="fast" if safe else "logdet",
            pair_interval_ns=nanoseconds(interval_s),
            pair_timeout_ns=nanoseconds(self.pair_timeout_s),
            innovation_cap=cap,
        )

    def _following(self) -> LocalizationSettings:
        """Of the kind `leader`, which is an EKF as published."""
        return LocalizationSettings(
            kind="leader",
            leader=self.leader or "",
            exchange=self.exchange,
            fixes=self.fixes,
            leader_correlation_ns=nanoseconds(self.leader_correlation_s),
            clock_state=self.clock_state,
            transform=self.transform or "jacobian",
            innovation_cap=self.innovation_cap or 0.0,
            pair_timeout_ns=nanoseconds(self.pair_timeout_s),
        )

    def rigid(self) -> str | None:
        """What makes robots begin together, with tracks that last; None: nothing."""
        if self.kind == "replica":
            return "kind = 'replica'"
        return "form = 'joint'" if self.form == "joint" else None

    def _refuse(self, key: str, owner: str, why: str) -> None:
        """Raises `ConfigError` for a key of another kind; a default that is stated is none."""
        stated, default = getattr(self, key), getattr(LocalizationPart(), key)
        if stated != default:
            remedy = f"leave {key} out" if default is None else f"leave {key} out, or say {key} = {default!r}"
            raise ConfigError(f"{key} = {stated!r} is of kind '{owner}', and {why}; {remedy}")


class ThenPart(Part):
    """Another policy from `at_s` after the start on."""

    at_s: NotNegative
    kind: LatenessKind


class LatenessPart(Part):
    """What happens to what comes late; see docs/late-measurements.md."""

    kind: LatenessKind = "compensate"
    then: ThenPart | None = None
    iterations: Annotated[int, Field(ge=1, le=10)] | None = None
    settle_s: NotNegative = 0.0
    tolerance_s: NotNegative = 0.001
    horizon_s: Positive = 5.0
    odometry_wait_s: NotNegative = 1.0
    clock_sigma_s: NotNegative = 0.0
    max_clock_sigma_s: Positive = 0.1

    def settings(self) -> LatenessSettings:
        return LatenessSettings(
            kind=self.kind,
            then=None if self.then is None else (nanoseconds(self.then.at_s), self.then.kind),
            iterations=2 if self.iterations is None else self.iterations,
            settle_ns=nanoseconds(self.settle_s),
            tolerance_ns=nanoseconds(self.tolerance_s),
            horizon_ns=nanoseconds(self.horizon_s),
            odometry_wait_ns=nanoseconds(self.odometry_wait_s),
            clock_sigma_ns=nanoseconds(self.clock_sigma_s),
        )


class HealthPart(Part):
    window: Annotated[int, Field(ge=2, le=1000)] = 8
    suspect_nis: Annotated[float, Field(gt=1.0, allow_inf_nan=False)] = 6.0
    gate_nis: Annotated[float, Field(gt=1.0, allow_inf_nan=False)] = 12.0
    readmit_after: Annotated[int, Field(ge=1, le=1000)] = 8

    def settings(self, form: str) -> HealthSettings:
        """The form `published` is as published, and judges nobody. Raises `ConfigError`."""
        if self.gate_nis < self.suspect_nis:
            raise ConfigError(
                f"health.gate_nis = {self.gate_nis:g} is below health.suspect_nis = {self.suspect_nis:g}, and nobody"
                " would ever be quarantined; make it at least as large"
            )
        return HealthSettings(enabled=form != "published", **self.model_dump())


class CoastPart(Part):
    speed_mps: Positive = 0.5
    yaw_rate_radps: Positive = 0.5

    def settings(self) -> CoastSettings:
        return CoastSettings(self.speed_mps, self.yaw_rate_radps)


class StatePart(Part):
    """The file kept across starts: how often it is written, whether to the disk itself, until what age it is used."""

    interval_s: Positive = 1.0
    sync: bool = True
    max_age_s: Positive = 600.0


class NetworkPart(Part):
    hello_period_s: Positive = 0.5
    silent_after_s: Positive = 3.0

    def settings(self, lateness: LatenessPart, unsafe: UnsafeSettings = PROTECTED) -> EndpointSettings:
        return EndpointSettings(
            hello_period_ns=nanoseconds(self.hello_period_s),
            silent_after_ns=nanoseconds(self.silent_after_s),
            horizon_ns=nanoseconds(lateness.horizon_s),
            clock_sigma_ns=nanoseconds(lateness.clock_sigma_s),
            max_clock_sigma_ns=nanoseconds(lateness.max_clock_sigma_s),
            accept_duplicates=unsafe.accept_duplicates,
            accept_stale=unsafe.accept_stale,
            trust_clocks=unsafe.trust_clocks,
        )


class LinksPart(Part):
    """Link model. `range_m` absent: everybody hears everybody.

    A robot hears only the `nearest` senders in range, or `rewire` of them drawn anew at every step of the world.
    """

    range_m: Positive | None = None
    hysteresis_m: NotNegative = 0.0
    nearest: Annotated[int, Field(ge=1)] | None = None
    rewire: Annotated[int, Field(ge=1)] | None = None
    loss: Share = 0.0
    delay_s: NotNegative = 0.0
    delay_tail_s: NotNegative = 0.0
    delay_spread_s: NotNegative = 0.0
    duplicate: Share = 0.0

    def settings(self, seed: int) -> LinkSettings:
        """Raises `ConfigError` if senders are chosen in two ways."""
        if self.nearest is not None and self.rewire is not None:
            raise ConfigError(
                "links.nearest and links.rewire both choose who is heard; state one, as "
                f"links = {{ rewire = {self.rewire} }}"
            )
        return LinkSettings(seed=seed, **self.model_dump())


class SigmaPart(Part):
    """Standard deviations of an initial belief: of x and y, and of what else the state has."""

    position_m: Positive | None = None
    altitude_m: Positive | None = None
    heading_rad: Positive | None = None
    velocity_mps: Positive | None = None
    acceleration_mps2: Positive | None = None
    gain_along: Positive | None = None
    gain_turn: Positive | None = None

    def covariance(self, model: str, placed: bool = True) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Diagonal covariance of a state of `model`; one that is not `placed` has nothing to say of x and y (zeros)."""
        layout = LAYOUTS[model]
        if placed and self.position_m is None:
            raise ConfigError("start_sigma.position_m is missing")
        keys = [] if layout.altitude is None else ["altitude_m"]
        if layout.heading is not None:
            keys += ["heading_rad", "gain_along", "gain_turn"][: layout.dim - len(layout.position)]
        else:
            axes = len(layout.position)
            keys += [key for key in ("velocity_mps", "acceleration_mps2") for _ in range(axes)][: layout.dim - axes]
        place = self.position_m if placed and self.position_m is not None else 0.0
        sigmas = [place, place]
        for key in keys:
            sigma = getattr(self, key)
            if sigma is None:
                raise ConfigError(f"start_sigma.{key} is missing: the model '{model}' needs it")
            sigmas.append(sigma)
        return np.diag(np.square(sigmas))


RobotModel = Literal["unicycle", "unicycle_gains", "quadrotor", "planar_altitude"]
class MotionPart(Part):
    """How the robot moves with its odometry.

    The gains of `unicycle_gains` wander by `gain_walk_per_sqrt_s`; a `quadrotor` holds `altitude_m` with the standard
    deviation `altitude_sigma_m`.
    """

    model: RobotModel = "unicycle"
    gain_walk_per_sqrt_s: NotNegative = 0.003
    altitude_m: Finite = 0.0
    altitude_sigma_m: NotNegative = 0.0

    def settings(self) -> RobotMotion:
        """Raises `ConfigError` for a held altitude without noise: nothing could be learnt of it."""
        match self.model:
            case "unicycle_gains":
                return GainMotion(walk=self.gain_walk_per_sqrt_s)
            case "quadrotor":
                return SpatialMotion(held=held_altitude(self.altitude_m, self.altitude_sigma_m))
            case "planar_altitude":
                return SpatialMotion()
        return RobotMotion(LAYOUTS[self.model])

    def completed(self, mean: list[float]) -> np.ndarray[Any, np.dtype[np.float64]]:
        """An initial mean; of a pose alone the gains are 1. Raises `ConfigError` for another size."""
        dim = LAYOUTS[self.model].dim
        pose = start_size(LAYOUTS[self.model])
        if len(mean) not in (pose, dim):
            raise ConfigError(
                f"mean needs {pose} numbers{f' or {dim}' if dim != pose else ''} for the model '{self.model}'"
            )
        return np.array([*mean, *[1.0] * (dim - len(mean))])


def held_altitude(altitude_m: float, sigma_m: float) -> HeldAltitude:
    """Raises `ConfigError` without noise."""
    if sigma_m <= 0.0:
        raise ConfigError("a held altitude needs noise, altitude_m above 0: its covariance has to be invertible")
    return HeldAltitude(altitude_m, sigma_m)


def start_size(layout: StateLayout) -> int:
    """Numbers of a start: a whole state, but for gains of an odometry, which start at 1."""
    return 3 if layout.heading == 2 else layout.dim


class CalibrationPart(Part):
    """Systematic errors of a sensor; see `agent.calibration`."""

    bias_m: Finite = 0.0
    bias_of: dict[str, Finite] = {}
    scale: Positive = 1.0
    depth: bool = False
    bias_rad: Finite = 0.0

    def settings(self) -> Calibration:
        """Without errors it is `NO_CALIBRATION`, which costs nothing per reading."""
        if self == CalibrationPart():
            return NO_CALIBRATION
        return Calibration(self.bias_m, dict(self.bias_of), self.scale, self.depth, self.bias_rad)


SensorKind = Literal[
    "range",
    "bearing",
    "bearing3",
    "range_bearing",
    "vector",
    "pixel",
    "position",
    "pose",
    "heading",
    "altitude",
]


def _checked_mount(values: list[float]) -> list[float]:
    if len(values) not in (3, 6):
        raise PydanticCustomError("mount", "x, y, yaw or x, y, z, roll, pitch, yaw are needed")
    return values


MountVector = Annotated[list[Finite], AfterValidator(_checked_mount)]
"""A sensor on the body: x, y [m], yaw [rad], or x, y, z [m], roll, pitch, yaw [rad]."""


class IntrinsicsPart(Part):
    """A pinhole camera; the principal point is the image's centre unless stated."""

    focal_px: Positive = 500.0
    size_px: Vector2 = [640.0, 480.0]
    center_px: Vector2 | None = None

    def settings(self) -> Intrinsics:
        width, height = self.size_px
        u, v = self.center_px or (0.5 * width, 0.5 * height)
        return Intrinsics(self.focal_px, (u, v), (width, height))


class TeamMemberPart(Part):
    """Another robot of the team: its belief at its start, and how it moves."""

    id: Id
    mean: Annotated[list[Finite], Field(min_length=3, max_length=8)]
    start_sigma: SigmaPart
    motion: MotionPart = MotionPart()

    def settings(self) -> TeamMember:
        """Raises `ConfigError` naming the key."""
        try:
            motion, mean = self.motion.settings(), self.motion.completed(self.mean)
            return TeamMember(self.id, motion, mean, self.start_sigma.covariance(self.motion.model))
        except ConfigError as error:
            raise ConfigError(f"team.{self.id}: {error}") from None


class LandmarkPart(Part):
    """A point of known position, a UWB anchor for instance: x, y or x, y, z [m] in the fleet's ENU frame."""

    id: LandmarkId
    position: Point

    def place(self) -> tuple[float, ...]:
        return tuple(self.position)
