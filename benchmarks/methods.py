"""Every method of cooperative localization in every regime: `python -m benchmarks.methods`.

Plays the bundled scenarios with each method on the same data, beside the centralized filter, and prints a table in
Markdown: RMSE relative to the centralized filter's, and the ANEES per degree of freedom of the worst robot and track.
Trials that are finished stay in the output directory, so that an interrupted run goes on where it was.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.runs import run


@dataclass(frozen=True, slots=True)
class Regime:
    """A scenario and what is special about it."""

    scenario: str
    what: str
    trials: int
    fixed: str = ""


REGIMES = (
    Regime("ut-clat", "4 robots, rare contacts, robot 1 knows its pose", 100, "r1"),
    Regime("ut-clat-quadrotors", "3 quadrotors in constant contact", 20),
    Regime("dense-6", "6 robots in constant contact, no fix", 20),
    Regime("dense-6-anchored", "the same, robot 1 has fixes", 20),
    Regime("dense-10", "10 robots in constant contact, no fix", 10),
    Regime("dense-10-anchored", "the same, robot 1 has fixes", 10),
)
FORMS = ("auto", "split_joint", "joint", "safe", "published")
METHODS = (*FORMS, "replica")
"""Forms of kind `clat`, and the kind that has none."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one method in one regime, and those of the centralized filter on the same trials."""

    trials: int
    lost: int
    robots_m: float
    robots_bound_m: float
    anees_max: float
    anees_median: float
    bound_anees_max: float
    track_m: float
    track_bound_m: float
    track_anees_max: float
    track_bound_anees: float


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(value**2 for value in values) / len(values)) if values else math.nan


def row(summary: dict[str, Any], fixed: str) -> Row:
    """Figures of a summary with a bound; `fixed` names a robot left out of the RMSE of robots."""
    robots = {name: item for name, item in summary["robots"].items() if name != fixed}
    bound = summary["bound"]
    bound_robots = {name: item for name, item in bound["robots"].items() if name != fixed}
    tracks = [item for by_robot in summary["targets"].values() for item in by_robot.values()]
    bound_tracks = list(bound["targets"].values())
    anees = sorted(item["anees"] for item in summary["robots"].values())
    return Row(
        summary["trials"],
        summary["lost"],
        _rms([item["position_rmse_m"] for item in robots.values()]),
        _rms([item["position_rmse_m"] for item in bound_robots.values()]),
        anees[-1],
        anees[len(anees) // 2],
        max(item["anees"] for item in bound["robots"].values()),
        _rms([item["position_rmse_m"] for item in tracks]),
        _rms([item["position_rmse_m"] for item in bound_tracks]),
        max((item["anees"] for item in tracks), default=math.nan),
        max((item["anees"] for item in bound_tracks), default=math.nan),
    )


def table(rows: dict[tuple[str, str], Row]) -> str:
    """All rows in Markdown, one block per regime."""
    lines = [
        "| scenario | method | lost | robots [m] | x bound | worst ANEES | median "
        "| tracks [m] | x bound | worst ANEES |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (scenario, method), found in rows.items():
        lines.append(
            f"| `{scenario}` | `{method}` | {found.lost} of {found.trials} | {found.robots_m:.3f} "
            f"| {found.robots_m / found.robots_bound_m:.2f} | {found.anees_max:.2f} | {found.anees_median:.2f} "
            f"| {found.track_m:.3f} | {found.track_m / found.track_bound_m:.2f} | {found.track_anees_max:.2f} |"
        )
        if method == METHODS[-1]:
            lines.append(
                f"| | centralized | | {found.robots_bound_m:.3f} | 1 | {found.bound_anees_max:.2f} | "
                f"| {found.track_bound_m:.3f} | 1 | {found.track_bound_anees:.2f} |"
            )
    return "\n".join(lines)


def play(regime: Regime, seed: int, share: float, folder: Path) -> dict[tuple[str, str], Row]:
    """All methods of one regime. Raises `RuntimeError` if a run fails."""
    trials = max(2, round(share * regime.trials))
    out = folder / f"{regime.scenario}-{seed}-{trials}"
    team = folder / f"{out.name}-replica"
    arguments = ["montecarlo", regime.scenario, "--trials", str(trials), "--seed", str(seed), "--bound"]
    run([*arguments, "--vary", "localization.form=" + ",".join(FORMS)], out)
    run([*arguments, "--set", "localization.kind=replica"], team)
    found = {form: out / f"form={form}" for form in FORMS} | {"replica": team}
    return {
        (regime.scenario, method): row(json.loads((found[method] / "summary.json").read_text()), regime.fixed)
        for method in METHODS
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.methods", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--share", type=float, default=1.0, help="of the usual number of trials")
    parser.add_argument("--scenario", action="append", choices=[regime.scenario for regime in REGIMES])
    parser.add_argument("--out", type=Path, default=Path("runs/methods"), help="where finished trials are kept")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    rows: dict[tuple[str, str], Row] = {}
    for regime in REGIMES:
        if not options.scenario or regime.scenario in options.scenario:
            rows |= play(regime, options.seed, options.share, options.out)
    print(table(rows))
    return 0


if __name__ == "__main__":
    # One thread per worker: they are as many as there are cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
