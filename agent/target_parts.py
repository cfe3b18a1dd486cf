"""Parts of files that are about targets: how they move, and when their tracks start and end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from agent.config_file import ConfigError, Finite, Id, NotNegative, Part, Positive
from agent.config_parts import LocalizationPart, SigmaPart, held_altitude
from agent.estimation.motion import LAYOUTS, SPATIAL, TargetMotion
from agent.motion_parts import ControlNoisePart, ControlPart
from agent.settings import TargetSettings, TrackEnd, TrackingSettings, nanoseconds

TargetModel = Literal[
    "unicycle",
    "quadrotor",
    "constant_velocity",
    "damped_velocity",
    "constant_velocity_3d",
    "damped_velocity_3d",
    "constant_acceleration",
]


class TrackingPart(Part):
    """How targets are tracked, and how their tracks start and end.

    `clat`: by the filter that localizes the robot. The others triangulate: robots tell each other bearings once per
    round (`agent.triangulator`); `memory_s` and `parallax_rad` are of those.

    A bearing or a range alone starts one only with `start_within_m`, how far off a target can be then. A track ends
    when nothing was learnt of its target for `end_after_s`, or it is less sure than `end_above_m`; absent: never.
    """

    kind: Literal["clat", "stt", "cmkf", "cikf", "hcmci", "tkf", "kcf_plus", "icf_plus", "none"] = "clat"
    memory_s: Positive | None = None
    parallax_rad: NotNegative = 0.1
    start_within_m: Positive | None = None
    end_after_s: Positive | None = None
    end_above_m: Positive | None = None

    def end(self) -> TrackEnd:
        return TrackEnd(None if self.end_after_s is None else nanoseconds(self.end_after_s), self.end_above_m)

    def settings(self) -> TrackingSettings:
        if self.kind == "clat" or self.kind == "none":
            return TrackingSettings()
        return TrackingSettings(self.kind, self.memory_s, self.parallax_rad)

    def check_targets(self, models: Sequence[tuple[str, str]]) -> None:
        """Raises `ConfigError` if targets (id, model) can't be triangulated, or a key is of another kind."""
        if self.memory_s is not None and self.kind != "stt":
            raise ConfigError(f"tracking.memory_s is of kind 'stt', and tracking.kind = '{self.kind}'; remove it")
        if self.kind in ("clat", "none"):
            return
        flat = next((name for name, model in models if model != "constant_velocity_3d"), None)
        if flat is not None:
            raise ConfigError(
                f"targets.{flat}.model: tracking.kind = '{self.kind}' needs 'constant_velocity_3d': it triangulates a "
                "place and a velocity in space"
            )
        if self.start_within_m is not None:
            raise ConfigError(
                f"tracking.start_within_m does not go with tracking.kind = '{self.kind}', whose tracks begin where "
                "bearings cross; remove it"
            )

    def check_kind(self, localization: LocalizationPart, without_prior: Sequence[str]) -> None:
        """Raises `ConfigError` if tracks are to start or end, and the filter has the same ones all the time."""
        if localization.kind == "leader" and self.kind not in ("clat", "none"):
            raise ConfigError(
                f"tracking.kind = '{self.kind}' does not go with kind = 'leader', which tracks nothing; take 'none'"
            )
        rigid = localization.rigid()
        if rigid is None or self.kind != "clat":
            return
        if without_prior:
            raise ConfigError(
                f"target '{without_prior[0]}' has no prior, and {rigid} starts no tracks; state one, or take "
                "form = 'split_joint'"
            )
        if self.end() != TrackEnd():
            raise ConfigError(f"{rigid} ends no tracks; remove tracking.end_after_s and tracking.end_above_m")


class AgentTargetPart(Part):
    """A target as a tracker knows it: model and common prior; without a mean it is tracked once it is seen."""

    id: Id
    model: TargetModel
    mean: list[Finite] | None = None
    start_sigma: SigmaPart
    control: ControlPart = ControlPart()
    noise: ControlNoisePart = ControlNoisePart()
    noise_step_s: Positive = 1.0
    damping_s: Positive = 2.0

    def settings(self) -> TargetSettings:
        """Raises `ConfigError` for a mean of another size, or a deviation that is missing."""
        layout = LAYOUTS[self.model]
        if self.mean is not None and len(self.mean) != layout.dim:
            raise ConfigError(f"targets.{self.id}.mean needs {layout.dim} numbers for the model '{self.model}'")
        try:
            cov = self.start_sigma.covariance(self.model, self.mean is not None)
        except ConfigError as error:
            raise ConfigError(f"targets.{self.id}.{error}") from None
        return TargetSettings(
            self.id,
            target_motion(self.model, self.control, self.noise, self.noise_step_s, self.damping_s),
            None if self.mean is None else np.array(self.mean),
            cov,
            self.control.altitude_m,
        )


def target_motion(
    model: str, control: ControlPart, noise: ControlNoisePart, noise_step_s: float, damping_s: float
) -> TargetMotion:
    """The motion model a table describes. Raises `ConfigError` for a held altitude without noise."""
    layout, held = LAYOUTS[model], None
    sigma: tuple[float, ...] = noise.deviations(control.speed_mps)
    if layout is SPATIAL:
        held = held_altitude(control.altitude_m, noise.altitude_m)
    elif layout.heading is None:
        drive = noise.jerk_mps3 if model == "constant_acceleration" else noise.acceleration_mps2
        sigma = (drive,) * len(layout.position)
    steer = (control.speed_mps, control.yaw_rate_radps)
    return TargetMotion(layout, steer, sigma, noise_step_s, damping_s, held=held)
