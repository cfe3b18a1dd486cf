"""The initial belief of a robot in its file: where it comes from, and whether that can be."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from agent.config_file import ConfigError, Finite, Part
from agent.config_parts import LocalizationPart, MotionPart, SigmaPart, start_size
from agent.estimation.motion import LAYOUTS, SpatialMotion
from agent.start import A_HEADING, A_PLACE, AN_ALTITUDE, VIEWS

Array = NDArray[np.float64]
StartSource = Literal["survey", "fix", "peer"]


class InitialPart(Part):
    """Initial belief and where it comes from: `survey`, mean and deviations as stated; `fix`, absolute information of
    place and heading; `peer`, a contact with a robot that knows where it is. Of `fix` and `peer` only the gains of an
    odometry need deviations.
    """

    source: StartSource = "survey"
    mean: Annotated[list[Finite], Field(min_length=3, max_length=8)] | None = None
    start_sigma: SigmaPart = SigmaPart()

    def belief(self, motion: MotionPart) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n), zero of what is found out. Raises `ConfigError`."""
        layout = LAYOUTS[motion.model]
        if self.source == "survey":
            if self.mean is None:
                raise ConfigError("mean is missing: source = 'survey' needs a pose; or take source = 'fix' or 'peer'")
            return motion.completed(self.mean), self.start_sigma.covariance(motion.model)
        if self.mean is not None:
            raise ConfigError(f"mean is not used with source = '{self.source}'; remove it")
        mean, cov = np.zeros(layout.dim), np.zeros((layout.dim, layout.dim))
        for index, key in zip(range(start_size(layout), layout.dim), ("gain_along", "gain_turn")):
            sigma: Any = getattr(self.start_sigma, key)
            if sigma is None:
                raise ConfigError(f"start_sigma.{key} is missing: the model '{motion.model}' needs it")
            mean[index], cov[index, index] = 1.0, sigma**2
        return mean, cov


def check_start(
    source: StartSource,
    localization: LocalizationPart,
    motion: MotionPart,
    kinds: Collection[str],
    fixes: Collection[str],
) -> None:
    """Raises `ConfigError` if nothing can ever tell the start: `kinds` of sensors, `fixes` of the autopilot."""
    if source == "survey":
        return
    if (rigid := localization.rigid()) is not None:
        raise ConfigError(
            f"source = '{source}' does not go with {rigid}, which takes all robots to start together; "
            "take form = 'split_joint'"
        )
    if source == "peer" and localization.kind in ("jlatt", "leader", "relative", "fixed"):
        raise ConfigError(
            f"source = 'peer' does not go with kind = '{localization.kind}', where nobody asks a single peer; "
            "take 'fix' or 'survey'"
        )
    missing = []
    if source == "fix" and not ({"position", "pose"} & {*kinds} or "position" in fixes):
        missing.append(A_PLACE)
    headings = {"heading", "pose"} | ({*VIEWS} if source == "peer" else set())
    if not (headings & {*kinds} or "heading" in fixes):
        missing.append(A_HEADING if source == "fix" else f"{A_HEADING}, or a sensor of peers ({', '.join(VIEWS)})")
    settings = motion.settings()
    climbs = isinstance(settings, SpatialMotion) and settings.held is None
    if climbs and "altitude" not in kinds and "altitude" not in fixes:
        missing.append(AN_ALTITUDE)
    if missing:
        raise ConfigError(f"source = '{source}' can't be: nothing gives {', nor '.join(missing)}")
