"""The part of files that says how robots are told apart that locate each other relative to their own bodies."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Literal

from pydantic import Field

from agent.config_file import ConfigError, Id, NotNegative, Part, Positive
from agent.config_parts import LocalizationPart
from agent.estimation.correspondence import CorrespondenceSettings
from agent.estimation.motion import LAYOUTS
from agent.settings import RelativeSettings

MAX_RELATIVE = 15
"""Other robots that one locates: work grows with each, and so do messages."""

CAMERAS = ("bearing3",)
"""Kinds of sensors that tell a leader where others are."""

Probability = Annotated[float, Field(gt=0.0, lt=1.0, allow_inf_nan=False)]


class CorrespondencePart(Part):
    """How robots of `localization.kind = "relative"`, or "clat" with cameras that do not tell whom they see, are told
    apart.

    kind       `known`: cameras say whom they see; `gaussian_sum`: a sum of hypotheses per robot (De Silva, Mann and
               Gosine 2015); `nearest`, of "relative": the nearest bearing is believed, a baseline
    form       of the sum: `improved`, or as `published`
    detection  probability that a camera sees a robot that is in view, and that a range is measured
    clutter    expected false bearings of one scan
    birth, gate  probabilities of a new hypothesis, and that a right bearing is inside the gate; absent: of the form
    fusion     of what other leaders tell: `intersection`, or `subtraction` of what is known of it; absent: of the form
    acceleration_mps2, turn_acceleration_radps2  how the velocity of a robot that is not heard may change (1 sigma)
    """

    kind: Literal["known", "gaussian_sum", "nearest"] = "known"
    form: Literal["improved", "published"] = "improved"
    detection: Probability = 0.95
    clutter: NotNegative = 1.0
    birth: Probability | None = None
    gate: Probability | None = None
    fusion: Literal["intersection", "subtraction"] | None = None
    acceleration_mps2: Positive = 1.0
    turn_acceleration_radps2: Positive = 1.0

    def settings(self, peers: Collection[str], leads: bool) -> RelativeSettings:
        return RelativeSettings(
            peers=tuple(sorted(peers)),
            leads=leads,
            known=self.kind == "known",
            correspondence=CorrespondenceSettings(
                kind="nearest" if self.kind == "nearest" else "gaussian_sum",
                form=self.form,
                detection=self.detection,
                clutter=0.0 if self.kind == "known" else self.clutter,
                birth=self.birth,
                gate=self.gate,
                fusion=self.fusion,
            ),
            acceleration_mps2=self.acceleration_mps2,
            turn_acceleration_radps2=self.turn_acceleration_radps2,
        )

    def names(self, localization: LocalizationPart) -> bool:
        """Whether a robot of the kind `clat` finds out whom its camera sees."""
        return localization.kind == "clat" and self.kind == "gaussian_sum"

    def _refuse(self, localization: LocalizationPart) -> None:
        """Raises `ConfigError` for a key that another kind of localization has no use for."""
        for key, field in CorrespondencePart.model_fields.items():
            stated = getattr(self, key)
            if stated == field.default:
                continue
            remedy = "set that, or leave it out"
            if localization.kind == "clat":
                remedy = "set that, or correspondence.kind = 'gaussian_sum', or leave it out"
            raise ConfigError(
                f"correspondence.{key} = {stated!r} needs localization.kind = 'relative', not "
                f"'{localization.kind}'; {remedy}"
            )

    def check(self, localization: LocalizationPart, model: str) -> None:
        """Raises `ConfigError` if the kind of localization has no use for it, or the robot's model is a planar one."""
        if localization.kind != "relative" and not self.names(localization):
            self._refuse(localization)
            return
        what = "localization.kind = 'relative'" if localization.kind == "relative" else "correspondence.kind"
        if LAYOUTS[model].altitude is None:
            raise ConfigError(
                f"{what} locates robots in space, and the model '{model}' is planar; take 'planar_altitude'"
            )
        if localization.kind == "clat" and self.form != "improved":
            raise ConfigError(
                f"correspondence.form = '{self.form}' weighs nothing against false bearings, so that no name is beyond "
                "doubt; with localization.kind = 'clat' leave it out"
            )
        if self.kind == "known" and self.clutter != CorrespondencePart().clutter:
            raise ConfigError(
                "correspondence.clutter is of kinds that are not told whom a camera sees, and correspondence.kind = "
                "'known'; take 'gaussian_sum', or leave it out"
            )
        if self.kind == "nearest" and self.form != "improved":
            raise ConfigError("correspondence.form is of kind 'gaussian_sum', not of 'nearest'; leave it out")


class AgentCorrespondencePart(CorrespondencePart):
    """The same in the file of one robot, with the others it locates."""

    peers: Annotated[list[Id], Field(max_length=MAX_RELATIVE)] = []

    def check_peers(self, robot: str, localization: LocalizationPart) -> None:
        """Raises `ConfigError` if nobody, somebody twice or the robot itself is to be located."""
        relative = localization.kind == "relative"
        if not relative and not self.names(localization):
            if self.peers:
                raise ConfigError(
                    "correspondence.peers needs localization.kind = 'relative', or 'clat' with correspondence.kind = "
                    "'gaussian_sum'; set that, or leave it out"
                )
            return
        if not self.peers:
            needs = "localization.kind = 'relative'" if relative else "correspondence.kind = 'gaussian_sum'"
            raise ConfigError(f"correspondence.peers is missing: {needs} needs the ids of all other robots")
        if robot in self.peers:
            raise ConfigError(f"correspondence.peers names {robot}, which is this robot itself; list the others only")
        twice = next((name for name in self.peers if self.peers.count(name) > 1), None)
        if twice is not None:
            raise ConfigError(f"correspondence.peers names {twice} twice; ids must differ")


def check_leader(kinds: Mapping[str, str], what: str = "localization.kind = 'relative'") -> None:
    """Raises `ConfigError` if a robot with a camera lacks what goes with it: `kinds` of sensors by name; `what` asks
    for it."""
    found = {*kinds.values()}
    if found.intersection(CAMERAS) and "range" not in found:
        raise ConfigError(
            f"{what}: a robot with a camera (bearing3) needs a range to each of the others, which alone has a name; "
            "add a sensor of kind 'range'"
        )


def check_altitude(kinds: Mapping[str, str], fixes: Collection[str] = ()) -> None:
    """Raises `ConfigError` if nothing tells the altitude: `kinds` of sensors by name, `fixes` of the autopilot."""
    if "altitude" not in kinds.values() and "altitude" not in fixes:
        raise ConfigError(
            "localization.kind = 'relative': robots tell each other their altitudes; add a sensor of kind 'altitude'"
            ", or 'altitude' to mavlink.fixes"
        )
