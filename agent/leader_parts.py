"""What goes together in the files of robots that follow a leader, and of all others."""

from __future__ import annotations

from agent.config_file import ConfigError
from agent.config_parts import LatenessPart, LocalizationPart

OF_LEADERS = ("algorithm1", "equivalent", "ignore")
"""Policies of late data that only the kind `leader` has."""


def check_lateness(lateness: LatenessPart, localization: LocalizationPart, model: str) -> None:
    """Raises `ConfigError` for a policy that a kind of localization does not have, and for a clock that nobody says
    anything about."""
    if localization.kind == "leader":
        if model != "unicycle":
            raise ConfigError(f"kind = 'leader' is of model = 'unicycle', not of '{model}'; take that")
        if localization.clock_state and lateness.clock_sigma_s == 0.0:
            raise ConfigError(
                "clock_state = true needs lateness.clock_sigma_s above 0: how well clocks agree by themselves"
            )
        return
    kinds = [lateness.kind] if lateness.then is None else [lateness.kind, lateness.then.kind]
    other = next((kind for kind in kinds if kind in OF_LEADERS), None)
    if other is not None:
        raise ConfigError(
            f"lateness.kind = '{other}' is of kind 'leader' alone: elsewhere it would count what is late twice, or "
            "as of another instant; take 'compensate', 'replay' or 'discard'"
        )
    for key in ("iterations", "then"):
        if getattr(lateness, key) is not None:
            raise ConfigError(f"lateness.{key} is of kind 'leader', not of '{localization.kind}'; leave it out")
