"""Scenario files: where they are, what `--set` changes in them, and reading them."""

from __future__ import annotations

import difflib
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

from agent.config_file import (
    ConfigError,
    read_toml,
    validate,
)
from sim.scenario import Scenario
from sim.scenario_checks import check


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
    data = read_scenario(path)
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


def read_scenario(path: Path, below: tuple[Path, ...] = ()) -> dict[str, Any]:
    """The tables of a file, on top of those of the scenario it `extends`. Raises `ConfigError`.

    Tables are merged key by key, entries of arrays of tables by their id; whatever else the file says takes the place
    of what the other one says. A path is relative to the file.
    """
    data = read_toml(path)
    base = data.pop("extends", None)
    if base is None:
        return data
    if not isinstance(base, str):
        raise ConfigError(f"{path}: extends: the name or path of a scenario is needed")
    beside = path.parent / base
    try:
        other = beside if base.endswith(".toml") else locate(base)
    except ConfigError as error:
        raise ConfigError(f"{path}: extends: {error}") from None
    chain = (*below, path.resolve())
    if other.resolve() in chain:
        raise ConfigError(f"{path}: extends '{base}', which extends this one; leave one of the two out")
    return merged(read_scenario(other, chain), data)


def merged(base: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    """Tables `data` on top of `base`, see `read_scenario`."""
    found = dict(base)
    for key, value in data.items():
        before = base.get(key)
        if isinstance(before, dict) and isinstance(value, dict):
            found[key] = merged(before, value)
        elif isinstance(before, list) and _by_id(before) and _by_id(value):
            entries = {item["id"]: item for item in before}
            for item in value:
                entries[item["id"]] = merged(entries.get(item["id"], {}), item)
            found[key] = list(entries.values())
        else:
            found[key] = value
    return found


def _by_id(value: Any) -> bool:
    """Whether it is an array of tables that have ids."""
    return isinstance(value, list) and all(isinstance(item, dict) and "id" in item for item in value)


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
