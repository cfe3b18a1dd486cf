"""Filters that triangulate, side by side: `python -m benchmarks.bearings`.

Plays `stt-circle` and `stt-square` with every kind of `tracking.kind`, with the published layout of cameras and with
ones drawn anew for each trial, all kinds on the same data, and prints a table in Markdown, with the centralized filters
on top: the published one, and ours. Published kinds tell their track from the first bearing on. Trials that are
finished stay in the output directory, so that an interrupted run goes on where it was. With `--noise 0.01 0.05 ...` it
plays `stt-noise`, cameras drawn anew and the square, and prints errors by noise; with `--breaks`, errors and ANEES of
`stt-circle` with each of what a fleet must bear.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.runs import run

SCENARIOS = ("stt-circle", "stt-square")
PUBLISHED = ("stt", "tkf", "cmkf", "hcmci", "cikf")
IMPROVED = ("kcf_plus", "icf_plus")
RANDOM = (
    "robots.*.start={pose = [0.0, 0.0, 0.0, 0.0], spread = [40.0, 40.0, 20.0, 3.1415926], "
    "error = [0.0, 0.0, 0.0, 0.0]}"
)
"""Cameras drawn evenly in a box of 80 x 80 x 40 m."""

FAULTS = (
    "links.loss=0.3",
    "links.delay_tail_s=0.1",
    "robots.*.sensors.camera.detects=0.8",
    "robots.*.sensors.camera.false_share=0.05",
)
TAIL_S = 10.0

BREAKS: dict[str, list[str]] = {
    "nominal": [],
    "70 % loss": ["links.loss=0.7"],
    "0.3 s late": ["links.delay_s=0.3"],
    "5 % false": ["robots.*.sensors.camera.false_share=0.05"],
    "isolated": ["links.loss=1.0"],
    "parallel": [
        "robots.*.start={pose = [-40.0, 0.0, 0.0, 0.0], spread = [1.0, 1.0, 1.0, 3.1415926], "
        "error = [0.0, 0.0, 0.0, 0.0]}"
    ],
}
"""Isolated: nobody hears anybody. Parallel: all within 2 m, the target 24 to 56 m away."""



@dataclass(frozen=True, slots=True)
class Row:
    """Figures of one kind over all trials, robots and instants at which it tells a track.

    all_m, tail_m   RMSE of the place, from the start on and from 10 s on
    velocity_mps    RMSE of the velocity
    anees           per degree of freedom
    bytes_s         told per robot and second
    step_us         median wall time of an event of a robot
    """

    trials: int
    all_m: float
    tail_m: float
    median_m: float
    velocity_mps: float
    anees: float
    bytes_s: float
    step_us: float


def row(summary: dict[str, Any], which: str = "fleet") -> Row:
    """The figures of a run directory's summary; `which`: `fleet`, or the centralized filter's `bound`."""
    fleet, series = summary[which], summary["series"]
    lines = list(series["target_position_rmse_m" if which == "fleet" else "bound_target_position_rmse_m"].values())
    if which == "fleet":
        lines = [line for by_robot in lines for line in by_robot.values()]
    squares = [(t_s, value**2) for line in lines for t_s, value in zip(series["t_s"], line) if value is not None]
    tail = [square for t_s, square in squares if t_s >= TAIL_S]
    return Row(
        summary["trials"],
        math.sqrt(sum(square for _, square in squares) / len(squares)),
        math.sqrt(sum(tail) / len(tail)),
        summary["median"]["target_position_rmse_m"] if which == "fleet" else math.nan,
        fleet["target_velocity_rmse_mps"],
        fleet["target_anees"],
        summary["network"]["bytes_per_robot_s"] if which == "fleet" else math.nan,
        summary["timing"]["step_us_median"] if which == "fleet" else math.nan,
    )


HEADS = ("filter", "place [m]", "from 10 s on", "median trial", "velocity [m/s]", "ANEES", "bytes/s", "event [us]")


def table(rows: dict[str, Row], what: str) -> str:
    """Rows in Markdown under a heading."""
    lines = [f"**{what}**", "", f"| {' | '.join(HEADS)} |", f"|{' --- |' * len(HEADS)}"]
    for name, found in rows.items():
        cells = [found.all_m, found.tail_m, found.median_m, found.velocity_mps, found.anees]
        shown = ["" if math.isnan(cell) else f"{cell:.2f}" for cell in cells]
        shown += ["" if math.isnan(cell) else f"{cell:.0f}" for cell in (found.bytes_s, found.step_us)]
        lines.append(f"| `{name}` | {' | '.join(shown)} |")
    return "\n".join([*lines, ""])


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(prog="python -m benchmarks.bearings", description=__doc__)
    found.add_argument("--trials", type=int, default=10)
    found.add_argument("--seed", type=int, default=1)
    found.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="trials played at once")
    found.add_argument("--kinds", nargs="+", default=[*PUBLISHED, *IMPROVED], choices=[*PUBLISHED, *IMPROVED])
    found.add_argument("--layouts", nargs="+", default=["fixed", "random"], choices=["fixed", "random", "faults"])
    found.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    found.add_argument("--noise", nargs="+", type=float, default=[], metavar="SIGMA", help="play stt-noise [rad]")
    found.add_argument("--breaks", action="store_true", help="play stt-circle with what may break a kind instead")
    found.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    found.add_argument("--out", type=Path, default=Path("runs/bearings"), help="where finished trials are")
    return found


def played(options: argparse.Namespace, scenario: str, kind: str, case: str, changes: Sequence[str]) -> dict[str, Any]:
    """The summary of a kind's trials of a scenario; `case` names where they are kept."""
    command = ["montecarlo", scenario, "--trials", str(options.trials), "--seed", str(options.seed)]
    command += ["--jobs", str(options.jobs), "--no-report", "--bound"]
    alone = [] if kind in IMPROVED else ["tracking.parallax_rad=0"]
    for change in [f"tracking.kind={kind}", *alone, *changes, *options.overrides]:
        command += ["--set", change]
    out = options.out / f"{scenario}-{case.replace(' ', '-')}-{kind}-{options.seed}-{options.trials}"
    run(command, out)
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


def bound_name(kind: str) -> str:
    """The centralized filter that a kind is compared with."""
    return "central_plus" if kind in IMPROVED else "ckf"


Columns = dict[str, tuple[str, str, list[str]]]
"""By heading: scenario, name of the case, what is set."""


def noises(sigmas: Sequence[float]) -> Columns:
    """Of the scenario that noise is swept in."""
    return {
        f"{sigma:g} rad": ("stt-noise", f"{sigma:g}", [f"robots.*.sensors.camera.sigma_rad={sigma:g}"])
        for sigma in sigmas
    }


def breaks() -> Columns:
    """Of what each kind must bear."""
    window = f"window_s=[{TAIL_S}, 20.0]"
    return {name: ("stt-circle", name, [window, *changes]) for name, changes in BREAKS.items()}


def sweep(options: argparse.Namespace, columns: Columns, second: str) -> str:
    """RMSE of place [m] and a `second` figure by filter and column, from 10 s on, in Markdown; - where none is told."""
    cells: dict[str, list[str]] = {}
    for scenario, case, changes in columns.values():
        found: dict[str, str] = {}
        for kind in options.kinds:
            summary = played(options, scenario, kind, case, changes)
            for name, which in ((bound_name(kind), "bound"), (kind, "fleet")):
                figures = summary[which]["target_position_rmse_m"], summary[which][second]
                told = None not in figures
                found.setdefault(name, f"{figures[0]:.2f} / {figures[1]:.2f}" if told else "-")
        for name, cell in found.items():
            cells.setdefault(name, []).append(cell)
    heads = ["filter", *columns]
    lines = [f"**{options.trials} trials**", "", f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    return "\n".join([*lines, *(f"| `{name}` | {' | '.join(row)} |" for name, row in cells.items()), ""])


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    if options.noise or options.breaks:
        if options.noise:
            print(sweep(options, noises(options.noise), "target_velocity_rmse_mps"), flush=True)
        if options.breaks:
            print(sweep(options, breaks(), "target_anees"), flush=True)
        return 0
    for scenario in options.scenarios:
        for layout in options.layouts:
            rows: dict[str, Row] = {}
            changes = [*([] if layout == "fixed" else [RANDOM]), *(FAULTS if layout == "faults" else ())]
            for kind in options.kinds:
                summary = played(options, scenario, kind, layout, changes)
                rows.setdefault(bound_name(kind), row(summary, "bound"))
                rows[kind] = row(summary)
            print(table(rows, f"{scenario}, {layout}, {options.trials} trials"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
