"""`--vary KEY=A,B`: one scenario in several variants, and which of them share their centralized filter."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from itertools import product
from typing import Any

from agent.config_file import ConfigError
from sim.agents import table
from sim.scenario import Scenario

MAX_VARIANTS = 64
_UNSAFE = re.compile(r"[^A-Za-z0-9._=,+-]+")
_IRRELEVANT = ("name", "lost_above_m", "expect", "links", "network", "lateness", "tracking", "health", "unsafe")
"""What neither the world nor the centralized filter depends on."""


@dataclass(frozen=True, slots=True)
class Varied:
    """One key and its values, as written."""

    key: str
    values: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Choice:
    """One variant: its name, which is also its folder's, and the overrides that make it."""

    name: str
    overrides: tuple[str, ...]


def parse(texts: list[str], fixed: list[str]) -> list[Varied]:
    """The arguments of `--vary`; `fixed` are those of `--set`. Raises `ConfigError`."""
    found: list[Varied] = []
    for text in texts:
        key, separator, rest = text.partition("=")
        key = key.strip()
        values = tuple(value.strip() for value in _split(rest))
        if not separator or not key or not all(values):
            raise ConfigError(f"--vary {text}: write KEY=A,B, for instance links.loss=0,0.3")
        if len(set(values)) < max(len(values), 2):
            raise ConfigError(f"--vary {text}: at least two different values are needed, none of them twice")
        if key in [item.key for item in found]:
            raise ConfigError(f"--vary {text}: {key} is varied twice; give all its values at once")
        if key in [item.partition("=")[0].strip() for item in fixed]:
            raise ConfigError(f"--vary {text}: --set {key} says otherwise; drop one of them")
        found.append(Varied(key, values))
    return found


def _split(text: str) -> list[str]:
    """At commas outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def choices(varied: list[Varied]) -> list[Choice]:
    """The product of all values, the last key turning fastest. Raises `ConfigError` when there are too many."""
    count = 1
    for item in varied:
        count *= len(item.values)
    if count > MAX_VARIANTS:
        raise ConfigError(f"--vary: {count} variants; {MAX_VARIANTS} are the most")
    short = [item.key.rpartition(".")[2] for item in varied]
    labels = short if len(set(short)) == len(short) else [item.key for item in varied]
    found: list[Choice] = []
    for values in product(*(item.values for item in varied)):
        name = ",".join(f"{label}={value}" for label, value in zip(labels, values, strict=True))
        name = _UNSAFE.sub("_", name.replace('"', "").replace("'", "").replace(" ", ""))[:100]
        twins = sum(item.name.partition("~")[0] == name for item in found)
        overrides = tuple(f"{item.key}={value}" for item, value in zip(varied, values, strict=True))
        found.append(Choice(f"{name}~{twins + 1}" if twins else name, overrides))
    return found


def bound_leaders(scenarios: list[Scenario]) -> list[int]:
    """For each scenario the first that gives the same centralized filter for the same seed, often itself."""
    keys = [_bound_key(scenario) for scenario in scenarios]
    return [keys.index(key) for key in keys]


def _bound_key(scenario: Scenario) -> str:
    """Everything the reduced centralized filter follows from, and perhaps a little more."""
    whole: dict[str, Any] = {key: value for key, value in table(scenario).items() if key not in _IRRELEVANT}
    used = scenario.localization
    whole["localization"] = [used.transform or "unscented", used.innovation_cap]
    for robot in whole["robots"]:
        for own in ("localization", "tracking", "lateness", "autopilot"):
            robot.pop(own, None)
    return json.dumps(whole, sort_keys=True)
