"""What trials are made from: two runs of equal provenance give equal trials, so one may go on with the other's."""

from __future__ import annotations

import hashlib
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from sim.agents import table
from sim.lives import SOFTWARE
from sim.scenario import Scenario

FILE = "montecarlo.json"
SHOWN = 3
FLOORS = ("network", "agent", "sim")
DRAWING = (
    "report.py",
    "page.py",
    "tables.py",
    "plots.py",
    "error_plots.py",
    "series_plots.py",
    "availability.py",
    "animation.py",
    "comparison.py",
    "settings_table.py",
)
"""Files of `sim` that look at figures only when they are there."""


def provenance(scenario: Scenario, seed: int, with_bound: bool, checked: bool = False) -> dict[str, Any]:
    """Everything a trial follows from, as plain JSON values; `checked`: no invariant was broken in it."""
    made = {
        "scenario": table(scenario),
        "seed": seed,
        "bound": with_bound,
        **({"check": True} if checked else {}),
        "software": {
            "cofix": SOFTWARE,
            "code": _code(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "machine": platform.machine(),
        },
    }
    plain: dict[str, Any] = json.loads(json.dumps(made))
    return plain


def _code() -> str:
    """Digest of the source."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for floor in FLOORS:
        for path in sorted((root / floor).rglob("*.py")):
            if floor != "sim" or path.name not in DRAWING:
                digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def differences(there: Any, here: Any, path: str = "") -> list[str]:
    """What differs, by dotted key; entries of arrays of tables go by their id."""
    if there == here and type(there) is type(here):
        return []
    if isinstance(there, dict) and isinstance(here, dict):
        keys = list(dict.fromkeys([*there, *here]))
        found = [differences(there.get(key), here.get(key), f"{path}.{key}" if path else str(key)) for key in keys]
        return [line for lines in found for line in lines]
    if _named(there) and _named(here):
        before, after = [{item["id"]: item for item in items} for items in (there, here)]
        if list(before) == list(after):
            return differences(before, after, path)
        there, here = list(before), list(after)
    return [f"{path.removeprefix('scenario.')} is {_shown(there)} there, {_shown(here)} here"]


def _named(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, dict) and "id" in item for item in value)


def _shown(value: Any) -> str:
    if value is None:
        return "absent"
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def summed_up(lines: list[str]) -> str:
    """The first few differences in one line."""
    more = f", and {len(lines) - SHOWN} more" if len(lines) > SHOWN else ""
    return "; ".join(lines[:SHOWN]) + more
