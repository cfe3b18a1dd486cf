"""Five real robots (UTIAS MR.CLAM run 7) against the centralized filter: `python -m benchmarks.utias FOLDER`.

Every case is a bundled scenario with one set of parameters, scored after the first 300 s; where they come from, and
what of them was changed after a look at the score, is told in `sim/scenarios/utias-all.toml`. The yardstick is the
joint filter of all robots with the same parameters on the same data, run by the same code. Prints the figures of all
cases and whether each condition on them holds; exit status 1 if one does not.

With `--processes` cases A and B are played with one process per robot over Zenoh, in real time: a quarter of an hour.
How late the processes were, and how busy the machine was, is told beside the figures. `--speed` shortens that, but
one computer's delays then count as so much more: agents wait, and believe stamps to be off, `speed` times as long.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError
from benchmarks.processes import RunFailed, summary_of_processes
from sim.metrics import combine
from sim.scenario_file import load
from sim.summary import reduce
from sim.trial import run_trial

LOSSY = ("links.loss=0.3", "links.delay_s=0.5")


@dataclass(frozen=True, slots=True)
class Case:
    """A scenario with overrides; with the centralized filter beside it, or without."""

    title: str
    scenario: str
    overrides: tuple[str, ...] = ()
    bound: bool = False


CASES: dict[str, Case] = {
    "all": Case("A all see landmarks", "utias-all", bound=True),
    "anchor": Case("B only robot 1 sees landmarks", "utias-anchor", bound=True),
    "range": Case("D as B, mates by range only", "utias-range", bound=True),
    "bearing": Case("E as B, mates by bearing only", "utias-bearing", bound=True),
    "silent": Case("F as A, robot 5 silent and tracked", "utias-silent", bound=True),
    "all-lossy": Case("A, 30 % lost, 0.5 s late", "utias-all", LOSSY),
    "anchor-lossy": Case("B, 30 % lost, 0.5 s late", "utias-anchor", LOSSY),
    "anchor-naive": Case("B, correlations ignored", "utias-anchor", ("localization.correlation=ignored",)),
    "anchor-every": Case("B, every sighting used", "utias-anchor", ("localization.pair_interval_s=0.0",)),
    "anchor-alone": Case("B, nothing gets through", "utias-anchor", ("links.loss=1.0",)),
}

IN_PROCESSES = ("all", "anchor")
"""Cases that are played in processes unless others are named."""

Figures = dict[str, dict[str, Any]]


def figures(name: str, path: str, seed: int, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Figures of one case in virtual time: the fleet's, and with a bound the same of it; tracks pooled over robots."""
    case = CASES[name]
    scenario = load(case.scenario, [f"world.path={path}", *case.overrides, *more])
    result = run_trial(scenario, seed, with_bound=case.bound)
    reduced = reduce(scenario, result)["figures"]
    whole = combine([reduced], scenario.lost_above_m)
    found = _fleet(whole, case)
    found["bytes_per_robot_s"] = result.network["bytes"] / (float(result.trace.t_s[-1]) * len(scenario.robots))
    for target, owners in reduced["targets"].items():
        recent = [item["recent"] for item in owners.values()]
        found["track_2s_m"] = math.sqrt(sum(r["position"] for r in recent) / max(1, sum(r["count"] for r in recent)))
        found["track_max_2s_m"] = max((r["max_position"] for r in recent if r["count"]), default=None)
        found["track_anees"] = whole["fleet"]["target_anees"]
        if case.bound:
            found["bound"]["track_2s_m"] = whole["bound"]["targets"][target]["position_rmse_2s_m"]
    return found


def figures_of_processes(
    name: str, path: str, seed: int, more: tuple[str, ...] = (), speed: float = 1.0
) -> dict[str, Any]:
    """The same of one case played in processes, without tracks; with how late they were and how busy the machine was.

    Raises `RunFailed`.
    """
    case = CASES[name]
    overrides = (f"world.path={path}", *case.overrides, *more)
    summary, load_mean = summary_of_processes(case.scenario, overrides, seed, speed, case.bound)
    found = _fleet(summary, case)
    found["bytes_per_robot_s"] = summary["network"]["bytes_per_robot_s"]
    found["contacts"] = dict(summary["network"]["pair"])
    found["lag_p99_s"], found["lag_max_s"] = summary["timing"]["lag_p99_s"], summary["timing"]["lag_max_s"]
    found["load"] = load_mean
    return found


def _fleet(whole: dict[str, Any], case: Case) -> dict[str, Any]:
    """What is wanted of a summary."""
    robots = whole["robots"].values()
    found: dict[str, Any] = {
        "position_m": whole["fleet"]["position_rmse_m"],
        "heading_rad": whole["fleet"]["heading_rmse_rad"],
        "anees": whole["fleet"]["anees"],
        "anees_max": max(robot["anees"] for robot in robots),
        "inside_3sigma": sum(robot["containment_3sigma"] for robot in robots) / len(robots),
    }
    if case.bound:
        found["bound"] = {
            "position_m": whole["bound"]["position_rmse_m"],
            "heading_rad": whole["bound"]["heading_rmse_rad"],
            "anees": whole["bound"]["anees"],
        }
    return found


@dataclass(frozen=True, slots=True)
class Value:
    """A figure of a case, or its ratio to that of the case's own bound (`over` is "bound") or of another case."""

    case: str
    key: str
    over: str | None = None

    def __call__(self, all_: Figures) -> float:
        found: float = all_[self.case][self.key]
        if self.over is None:
            return found
        other: float = (all_[self.case]["bound"] if self.over == "bound" else all_[self.over])[self.key]
        return found / other

    def known(self, all_: Figures) -> bool:
        """Whether the cases it is of were played."""
        return self.case in all_ and (self.over in (None, "bound") or self.over in all_)


@dataclass(frozen=True, slots=True)
class Condition:
    """A figure made of those of the cases, and where it must lie."""

    what: str
    value: Value
    low: float = -math.inf
    high: float = math.inf

    def holds(self, all_: Figures) -> bool:
        return self.low <= self.value(all_) <= self.high

    def limits(self) -> str:
        if self.low == -math.inf:
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if self.high == math.inf else f"{self.low:g} to {self.high:g}"


CONDITIONS = (
    Condition("A position / bound", Value("all", "position_m", "bound"), high=1.15),
    Condition("B position / bound", Value("anchor", "position_m", "bound"), high=1.25),
    Condition("D position / bound", Value("range", "position_m", "bound"), high=1.30),
    Condition("E position / bound", Value("bearing", "position_m", "bound"), high=1.30),
    Condition("A heading / bound", Value("all", "heading_rad", "bound"), high=1.12),
    Condition("B heading / bound", Value("anchor", "heading_rad", "bound"), high=1.12),
    Condition("A ANEES", Value("all", "anees"), 0.5, 1.4),
    Condition("B ANEES", Value("anchor", "anees"), 0.5, 1.6),
    Condition("A largest ANEES of a robot", Value("all", "anees_max"), high=2.2),
    Condition("B largest ANEES of a robot", Value("anchor", "anees_max"), high=2.2),
    Condition("A inside 3 sigma", Value("all", "inside_3sigma"), low=0.975),
    Condition("B inside 3 sigma", Value("anchor", "inside_3sigma"), low=0.975),
    Condition("B position / alone", Value("anchor", "position_m", "anchor-alone"), high=0.15),
    Condition("naive ANEES / B", Value("anchor-naive", "anees", "anchor"), low=2.5),
    Condition("every-sighting ANEES / B", Value("anchor-every", "anees", "anchor"), low=1.3),
    Condition("A lossy / lossless position", Value("all-lossy", "position_m", "all"), high=1.2),
    Condition("B lossy / lossless position", Value("anchor-lossy", "position_m", "anchor"), high=1.4),
    Condition("silent robot within 2 s / bound", Value("silent", "track_2s_m", "bound"), high=1.5),
    Condition("silent robot, largest error within 2 s [m]", Value("silent", "track_max_2s_m"), high=0.8),
    Condition("A position [m]", Value("all", "position_m"), high=0.10),
    Condition("B position [m]", Value("anchor", "position_m"), high=0.20),
)


def run(
    path: str,
    seed: int,
    jobs: int,
    cases: Sequence[str] = tuple(CASES),
    play: Callable[[str, str, int], dict[str, Any]] = figures,
    progress: Callable[[str], None] = lambda name: None,
) -> Figures:
    """Figures of cases, several at once. Raises `ConfigError` if the recording cannot be used, and what `play` does."""
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        futures = {name: pool.submit(play, name, path, seed) for name in cases}
        found = {}
        for name, future in futures.items():
            found[name] = future.result()
            progress(name)
    return found


def table(all_: Figures) -> str:
    """All cases in Markdown: RMSE [m], heading [rad] and ANEES per degree of freedom, beside those of the bound."""
    lines = [
        "| case | position [m] | bound | heading [rad] | bound | ANEES | bound | bytes/robot/s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, found in all_.items():
        cells = [CASES[name].title]
        for key, digits in (("position_m", 3), ("heading_rad", 3), ("anees", 2)):
            cells.append(f"{found[key]:.{digits}f}")
            cells.append(f"{found['bound'][key]:.{digits}f}" if "bound" in found else "")
        lines.append("| " + " | ".join([*cells, f"{found['bytes_per_robot_s']:.0f}"]) + " |")
        if "track_2s_m" in found:
            track = [f"{found['track_2s_m']:.3f}", f"{found['bound']['track_2s_m']:.3f}"]
            cells = ["F robot 5 within 2 s of a sighting", *track, "", "", f"{found['track_anees']:.2f}", "", ""]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def delays(all_: Figures) -> str:
    """Cases played in processes: contacts, how late timers were, and the mean of the machine's load, in Markdown."""
    lines = [
        "| case | contacts | one-sided | lag, 99 % [ms] | largest [ms] | load / cores |",
        "|---|---|---|---|---|---|",
    ]
    for name, found in all_.items():
        pair, lags = found["contacts"], (found["lag_p99_s"], found["lag_max_s"])
        lines.append(
            f"| {CASES[name].title} | {pair['completed']} of {pair['started']} | {pair['one_sided']} "
            f"| {1e3 * lags[0]:.0f} | {1e3 * lags[1]:.0f} | {found['load']:.1f} / {os.cpu_count()} |"
        )
    return "\n".join(lines)


def conditions(all_: Figures) -> list[Condition]:
    """Those on the cases that were played."""
    return [item for item in CONDITIONS if item.value.known(all_)]


def verdicts(all_: Figures) -> str:
    """Every condition on the cases that were played, with its value, in Markdown."""
    lines = ["| condition | value | limit | |", "|---|---|---|---|"]
    for item in conditions(all_):
        lines.append(
            f"| {item.what} | {item.value(all_):.3f} | {item.limits()} | {'holds' if item.holds(all_) else 'FAILS'} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.utias", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("path", help="folder of MRCLAM_Dataset7")
    parser.add_argument("--seed", type=int, default=1, help="of the initial beliefs and the links")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="cases run at once")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there too")
    parser.add_argument("--processes", action="store_true", help="one process per robot, in real time; cases A and B")
    parser.add_argument("--speed", type=float, default=1.0, help="of processes: recorded time per wall time")
    parser.add_argument("--cases", nargs="+", choices=CASES, metavar="CASE", help=f"only these of {', '.join(CASES)}")
    options = parser.parse_args(arguments)
    if options.speed != 1.0 and not options.processes:
        parser.error("--speed is for --processes; virtual time runs as fast as it can")
    play = partial(figures_of_processes, speed=options.speed) if options.processes else figures
    cases = options.cases or (IN_PROCESSES if options.processes else tuple(CASES))
    try:
        found = run(
            options.path, options.seed, options.jobs, cases, play, lambda name: print(f"{name} done", file=sys.stderr)
        )
    except (ConfigError, RunFailed) as error:
        print(error, file=sys.stderr)
        return 2
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    parts = [table(found), verdicts(found)]
    if options.processes:
        parts.insert(1, delays(found))
    print(*parts, sep="\n\n")
    return 0 if all(item.holds(found) for item in conditions(found)) else 1


if __name__ == "__main__":
    sys.exit(main())
