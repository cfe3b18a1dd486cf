"""Robots that choose their motion, published and improved, side by side: `python -m benchmarks.active`.

Plays the scenarios `ajlatt*` (AJLATT: Su 2022), the published ones with two rules of weights, each beside the
centralized filter on the same data, and prints a table in Markdown. With `--curve` also what loss and delay cost
`ajlatt`. Trials that are finished stay in the output directory, so that an interrupted run goes on where it was; there
are the pictures too.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runs import run
from sim.motion_plots import potentials, snapshots
from sim.scenario_file import load
from sim.series_plots import fleet_rmse, pair_distances
from sim.sight import views
from sim.trial import run_trial

LOST_M = 5.0
"""A trial whose tracks have a larger RMSE has lost the target."""


@dataclass(frozen=True, slots=True)
class Case:
    """A scenario with overrides."""

    scenario: str
    overrides: tuple[str, ...] = ()


def _weighed(rule: str) -> tuple[str, ...]:
    return (f"localization.weights={rule}", f"planning.weights={rule}")


PUBLISHED = ("ajlatt-random", "ajlatt-c", "ajlatt-o1", "ajlatt-o2", "ajlatt-ablation")
RULES = ("trace", "info")
CASES = {f"{name} {rule}": Case(name, _weighed(rule)) for rule in RULES for name in PUBLISHED}
CASES["ajlatt"] = Case("ajlatt")

LOSSES = (0.0, 0.2, 0.4, 0.6, 0.8)
DELAYS = (1, 2, 3, 5)
"""In rounds; no delay is no loss, above."""

PICTURED = ("ajlatt-c trace", "ajlatt-o2 trace", "ajlatt-ablation trace", "ajlatt")
"""Cases of which a trial is shown."""


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of the trials of a case; those of the centralized filter are None where it was not played.

    *_m             position RMSE over all trials, robots and tracks
    *_median_m      median over trials of the trial's RMSE
    *_bound         the centralized filter's RMSE and ANEES
    *_anees         per degree of freedom
    """

    trials: int
    lost: int
    target_m: float
    target_median_m: float
    target_bound: tuple[float, float] | None
    target_anees: float
    robots_m: float
    robots_median_m: float
    robots_bound: tuple[float, float] | None
    robots_anees: float
    collisions: float
    min_distance_m: float
    connected: float
    seen: float
    plan_us: float


def row(summary: dict[str, Any], target_rmse_m: Sequence[float]) -> Row:
    """Figures of a summary, with the RMSE of the tracks of each trial."""
    whole, median, motion = summary["all"], summary["median"], summary["motion"]
    bound = summary.get("bound")
    return Row(
        summary["trials"],
        sum(rmse > LOST_M for rmse in target_rmse_m),
        whole["target_position_rmse_m"],
        median["target_position_rmse_m"],
        None if bound is None else (bound["target_position_rmse_m"], bound["target_anees"]),
        whole["target_anees"],
        whole["position_rmse_m"],
        median["position_rmse_m"],
        None if bound is None else (bound["position_rmse_m"], bound["anees"]),
        whole["anees"],
        motion["collisions"],
        motion["min_distance_m"],
        motion["connected_share"],
        motion["target_seen_share"],
        summary["timing"].get("plan_us_median", math.nan),
    )


def _read(run_dir: Path) -> tuple[Row, dict[str, Any]]:
    """Figures of a run directory, and its series over time."""
    summary = json.loads((run_dir / "summary.json").read_text())
    with (run_dir / "trials.csv").open(newline="") as file:
        rmse = [float(line["target_position_rmse_m"]) for line in csv.DictReader(file)]
    return row(summary, rmse), summary["series"]


def table(rows: dict[str, Row], what: str) -> str:
    """All rows in Markdown, `what` they are of at the head of the first column; of the centralized filter if any is."""
    beside = any(found.target_bound is not None for found in rows.values())
    cells = [_cells(name, found, beside) for name, found in rows.items()]
    error = ("median", "ANEES", *(("centralized (ANEES)",) if beside else ()))
    head = (what, "lost", "target [m]", *error, "robots [m]", *error)
    head += ("collisions", "nearest [m]", "connected", "seen", "plan [us]")
    return "\n".join("| " + " | ".join(line) + " |" for line in (head, ("---",) * len(head), *cells))


def _cells(name: str, found: Row, beside: bool) -> tuple[str, ...]:
    """A row as it is printed, with the centralized filter or without."""

    def error(mean: float, median: float, anees: float, bound: tuple[float, float] | None) -> tuple[str, ...]:
        best = "" if bound is None else f"{bound[0]:.2f} ({bound[1]:.2f})"
        return f"{mean:.2f}", f"{median:.2f}", f"{anees:.2f}", *((best,) if beside else ())

    return (
        name,
        f"{found.lost} of {found.trials}",
        *error(found.target_m, found.target_median_m, found.target_anees, found.target_bound),
        *error(found.robots_m, found.robots_median_m, found.robots_anees, found.robots_bound),
        f"{found.collisions:.1f}",
        f"{found.min_distance_m:.2f}",
        f"{found.connected:.2f}",
        f"{found.seen:.2f}",
        f"{found.plan_us:.0f}",
    )


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is played, and where it is kept."""

    trials: int
    seed: int
    jobs: int
    duration_s: float | None
    out: Path

    def overrides(self, case: Case) -> list[str]:
        """Of the scenario, with its window in what is played of it."""
        if self.duration_s is None:
            return list(case.overrides)
        return [*case.overrides, f"duration_s={self.duration_s!r}", f"window_s=[0.0, {self.duration_s!r}]"]

    def play(self, case: Case, name: str, *more: str) -> Path:
        """Many trials of a case; its run directory. Raises `RuntimeError` if a run fails."""
        out = self.out / f"{name.replace(' ', '-')}-{self.seed}-{self.trials}"
        arguments = ["montecarlo", case.scenario, "--trials", str(self.trials), "--seed", str(self.seed)]
        for override in self.overrides(case):
            arguments += ["--set", override]
        run([*arguments, "--jobs", str(self.jobs), "--no-report", *more], out)
        return out


def compare(plan: Plan, names: Sequence[str]) -> tuple[dict[str, Row], list[tuple[str, dict[str, Any]]]]:
    """Figures of cases beside the centralized filter, and their series over time."""
    found = {name: _read(plan.play(CASES[name], name, "--bound")) for name in names}
    return {name: figures for name, (figures, _) in found.items()}, [(name, found[name][1]) for name in names]


def curve(plan: Plan) -> dict[str, Row]:
    """Figures of `ajlatt` over links that lose and delay messages."""
    case, period_s = CASES["ajlatt"], load("ajlatt").round.period_s
    found = {f"{100.0 * loss:.0f} % lost": f"links.loss={loss}" for loss in LOSSES}
    found |= {f"rounds late: {rounds}": f"links.delay_s={rounds * period_s}" for rounds in DELAYS}
    rows = {}
    for name, override in found.items():
        changed = Case(case.scenario, (*case.overrides, override))
        rows[name] = _read(plan.play(changed, f"ajlatt {override}"))[0]
    return rows


def draw(plan: Plan, series: list[tuple[str, dict[str, Any]]], at_s: Sequence[float]) -> None:
    """Pictures: what distances cost, errors over time, and of one trial of some cases snapshots and distances."""
    sensing = load("ajlatt").robots[0].sensors["camera"]
    assert sensing.max_range_m is not None
    potentials(sensing.max_range_m, plan.out / "potentials.png")
    for rule in RULES:
        shown = [(name, lines) for name, lines in series if name == "ajlatt" or name.endswith(rule)]
        if shown:
            fleet_rmse([_alone(item) for item in shown], plan.out / f"rmse-{rule}.png", narrow=True)
    for name in (name for name, _ in series if name in PICTURED):
        scenario = load(CASES[name].scenario, plan.overrides(CASES[name]))
        trace, file = run_trial(scenario, plan.seed).trace, name.replace(" ", "-")
        snapshots(trace, views(scenario), at_s, plan.out / f"{file}-snapshots.png")
        places = np.stack([item.truth[:, list(item.position[:2])] for item in trace.robots.values()], axis=1)
        pair_distances(trace.t_s, places, scenario.collision_m, plan.out / f"{file}-distances.png")


def _alone(item: tuple[str, dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    """A run's series; the centralized filter stays beside `ajlatt` alone, a dotted line per run would hide the rest."""
    name, series = item
    return name, series if name == "ajlatt" else {k: line for k, line in series.items() if not k.startswith("bound_")}


def parser() -> argparse.ArgumentParser:
    """What can be said on the command line."""
    found = argparse.ArgumentParser(prog="python -m benchmarks.active", description=(__doc__ or "").split("\n\n")[0])
    found.add_argument("--trials", type=int, default=20)
    found.add_argument("--seed", type=int, default=1)
    found.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="trials played at once")
    found.add_argument("--duration", type=float, metavar="S", help="play so much of each trial only")
    found.add_argument("--cases", nargs="+", choices=CASES, metavar="CASE", help=f"only these of {', '.join(CASES)}")
    found.add_argument("--curve", action="store_true", help="what loss and delay cost, too")
    found.add_argument(
        "--at", nargs="+", type=float, default=[25.0, 75.0, 150.0, 300.0], metavar="S", help="instants of snapshots"
    )
    found.add_argument("--out", type=Path, default=Path("runs/active"), help="where finished trials and pictures are")
    return found


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    plan = Plan(options.trials, options.seed, options.jobs, options.duration, options.out)
    rows, series = compare(plan, options.cases or tuple(CASES))
    print(table(rows, "case"), flush=True)
    if options.curve:
        print("\n" + table(curve(plan), "links"), flush=True)
    draw(plan, series, options.at)
    return 0


if __name__ == "__main__":
    # One thread per worker: they are as many as there are cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
