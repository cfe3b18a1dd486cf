"""Parts of files that are about rounds, and about robots that choose their motion."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from agent.config_file import ConfigError, NotNegative, Part, Positive
from agent.estimation.motion import LAYOUTS
from agent.settings import PlanningSettings, RoundSettings, RoundWeights, SensingSettings, nanoseconds

PLAIN = PlanningSettings()
SENSING = SensingSettings()


class RoundPart(Part):
    """Rounds in which robots tell each other what they believe; the same for a whole fleet."""

    period_s: Positive = 1.0
    wait_s: Positive = 0.2
    lean: bool = False

    def settings(self, anchor_ns: int = 0) -> RoundSettings:
        """Rounds counted from `anchor_ns`. Raises `ConfigError` for rounds that do not end before the next one."""
        if self.wait_s >= self.period_s:
            raise ConfigError(
                f"round.wait_s = {self.wait_s:g} is not below round.period_s = {self.period_s:g}: a round would not "
                "end before the next begins; shorten it"
            )
        return RoundSettings(
            nanoseconds(self.period_s), anchor_ns, nanoseconds(self.wait_s), self.lean
        )


class SensingPart(Part):
    """What a planner knows of the sensor that sees targets and peers."""

    min_range_m: NotNegative = SENSING.min_range_m
    max_range_m: Positive = SENSING.max_range_m
    fov_rad: Positive = SENSING.fov_rad
    sigma_m: NotNegative = SENSING.sigma_m
    sigma_m_per_m: NotNegative = SENSING.sigma_m_per_m
    sigma_rad: Positive = SENSING.sigma_rad

    def settings(self) -> SensingSettings:
        """Raises `ConfigError` if it sees nothing."""
        if self.min_range_m >= self.max_range_m:
            raise ConfigError(
                f"planning.sensing.min_range_m = {self.min_range_m:g} is not below max_range_m = "
                f"{self.max_range_m:g}, and nothing would be seen; make it smaller"
            )
        return SensingSettings(**self.model_dump())


class PlanningPart(Part):
    """How a robot chooses its motion, see `agent.settings.PlanningSettings`.

    What is absent follows in a scenario from vehicle, noise, sensors, links and seed, and has its plain value in the
    file of an agent.
    """

    kind: Literal["none", "random", "potential", "optimal", "encircle"] = PLAIN.kind
    form: Literal["improved", "published"] = PLAIN.form
    max_speed_mps: Positive | None = None
    max_turn_radps: Positive | None = None
    max_climb_mps: Positive | None = None
    radius_m: Positive = PLAIN.radius_m
    speed_share: NotNegative | None = None
    heading_rad_per_m: NotNegative | None = None
    closest_m: Positive = PLAIN.closest_m
    apart_m: Positive = PLAIN.apart_m
    radio_range_m: Positive | None = None
    self_weight: NotNegative = PLAIN.self_weight
    target_weight: NotNegative = PLAIN.target_weight
    potential_weight: NotNegative = PLAIN.potential_weight
    ahead: Annotated[int, Field(ge=0, le=1000)] = PLAIN.ahead
    horizon: Annotated[int, Field(ge=0, le=1000)] = PLAIN.horizon
    candidates: Annotated[int, Field(ge=1, le=10_000)] = PLAIN.candidates
    weights: RoundWeights = PLAIN.weights
    sensing: SensingPart | None = None
    seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    overrun_s: Positive | None = None

    def check_model(self, model: str, targets: list[tuple[str, str]]) -> None:
        """Raises `ConfigError` if a robot of `model` cannot move so, or there is nobody to follow among `targets` (id,
        model).
        """
        if self.kind != "encircle":
            return
        if model != "planar_altitude":
            raise ConfigError(
                f"planning.kind = 'encircle' is of robots that fly, not of the model '{model}'; take 'planar_altitude'"
            )
        if not any(LAYOUTS[item].heading is None for _, item in targets):
            raise ConfigError(
                "planning.kind = 'encircle' follows a target that moves by a velocity; give one of [[targets]] the "
                "model 'constant_velocity_3d', or take planning.kind = 'none'"
            )

    def settings(self) -> PlanningSettings:
        """Raises `ConfigError` for distances that do not go together, of the kinds that use them."""
        stated: dict[str, Any] = {
            key: value for key, value in self.model_dump(exclude={"sensing", "overrun_s"}).items() if value is not None
        }
        if self.overrun_s is not None:
            stated["overrun_ns"] = nanoseconds(self.overrun_s)
        if self.sensing is not None:
            stated["sensing"] = self.sensing.settings()
        settings = PlanningSettings(**stated)
        pushes = self.kind in ("potential", "optimal")
        for low, high in (("closest_m", "apart_m"), ("apart_m", "radio_range_m")) if pushes else ():
            least, most = getattr(settings, low), getattr(settings, high)
            if least >= most:
                raise ConfigError(
                    f"planning.{low} = {least:g} is not below planning.{high} = {most:g}; make it smaller, or "
                    f"planning.{high} larger"
                )
        # The least any two of three are apart, or any from the target.
        if self.kind == "encircle" and settings.closest_m >= self.radius_m:
            raise ConfigError(
                f"planning.closest_m = {settings.closest_m:g} is not below planning.radius_m = {self.radius_m:g}, and "
                "the circle would be too tight; make it smaller, or planning.radius_m larger"
            )
        return settings
