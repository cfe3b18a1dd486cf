"""Five real robots (UTIAS MR.CLAM run 7) against the centralized filter: `python -m benchmarks.utias FOLDER`.

Every case is a bundled scenario with one set of parameters, scored after the first 300 s; where they come from, and
what of them was changed after a look at the score, is told in `sim/scenarios/utias-all.toml`. The yardstick is the
joint filter of all robots with the same parameters on the same data, run by the same code. Prints the figures of all
cases and whether each condition holds; exit status 1 if one does not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError
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

Figures = dict[str, dict[str, Any]]


def figures(name: str, path: str, seed: int, more: tuple[str, ...] = ()) -> dict[str, Any]:
    """Figures of one case: the fleet's, its robots', and with a bound the same of it; tracks pooled over robots."""
    case = CASES[name]
    scenario = load(case.scenario, [f"world.path={path}", *case.overrides, *more])
    result = run_trial(scenario, seed, with_bound=case.bound)
    reduced = reduce(scenario, result)["figures"]
    whole = combine([reduced], scenario.lost_above_m)
    found: dict[str, Any] = {
        "position_m": whole["fleet"]["position_rmse_m"],
        "heading_rad": whole["fleet"]["heading_rmse_rad"],
        "anees": whole["fleet"]["anees"],
        "anees_max": max(robot["anees"] for robot in whole["robots"].values()),
        "inside_3sigma": _mean([robot["containment_3sigma"] for robot in whole["robots"].values()]),
        "bytes_per_robot_s": result.network["bytes"] / (float(result.trace.t_s[-1]) * len(scenario.robots)),
    }
    if case.bound:
        found["bound"] = {
            "position_m": whole["bound"]["position_rmse_m"],
            "heading_rad": whole["bound"]["heading_rmse_rad"],
            "anees": whole["bound"]["anees"],
        }
    for target, owners in reduced["targets"].items():
        recent = [item["recent"] for item in owners.values()]
        found["track_2s_m"] = math.sqrt(sum(r["position"] for r in recent) / max(1, sum(r["count"] for r in recent)))
        found["track_max_2s_m"] = max((r["max_position"] for r in recent if r["count"]), default=None)
        found["track_anees"] = whole["fleet"]["target_anees"]
        if case.bound:
            found["bound"]["track_2s_m"] = whole["bound"]["targets"][target]["position_rmse_2s_m"]
    return found


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _of_bound(case: str, key: str) -> Callable[[Figures], float]:
    return lambda all_: all_[case][key] / all_[case]["bound"][key]


def _over(case: str, other: str, key: str) -> Callable[[Figures], float]:
    return lambda all_: all_[case][key] / all_[other][key]


def _plain(case: str, key: str) -> Callable[[Figures], float]:
    return lambda all_: all_[case][key]


@dataclass(frozen=True, slots=True)
class Condition:
    """A figure made of those of the cases, and where it must lie."""

    what: str
    value: Callable[[Figures], float]
    low: float = -math.inf
    high: float = math.inf

    def holds(self, all_: Figures) -> bool:
        return self.low <= self.value(all_) <= self.high

    def limits(self) -> str:
        if self.low == -math.inf:
            return f"<= {self.high:g}"
        return f">= {self.low:g}" if self.high == math.inf else f"{self.low:g} to {self.high:g}"


CONDITIONS = (
    Condition("A position / bound", _of_bound("all", "position_m"), high=1.15),
    Condition("B position / bound", _of_bound("anchor", "position_m"), high=1.25),
    Condition("D position / bound", _of_bound("range", "position_m"), high=1.30),
    Condition("E position / bound", _of_bound("bearing", "position_m"), high=1.30),
    Condition("A heading / bound", _of_bound("all", "heading_rad"), high=1.12),
    Condition("B heading / bound", _of_bound("anchor", "heading_rad"), high=1.12),
    Condition("A ANEES", _plain("all", "anees"), 0.5, 1.4),
    Condition("B ANEES", _plain("anchor", "anees"), 0.5, 1.6),
    Condition("A largest ANEES of a robot", _plain("all", "anees_max"), high=2.2),
    Condition("B largest ANEES of a robot", _plain("anchor", "anees_max"), high=2.2),
    Condition("A inside 3 sigma", _plain("all", "inside_3sigma"), low=0.975),
    Condition("B inside 3 sigma", _plain("anchor", "inside_3sigma"), low=0.975),
    Condition("B position / alone", _over("anchor", "anchor-alone", "position_m"), high=0.15),
    Condition("naive ANEES / B", _over("anchor-naive", "anchor", "anees"), low=2.5),
    Condition("every-sighting ANEES / B", _over("anchor-every", "anchor", "anees"), low=1.3),
    Condition("A lossy / lossless position", _over("all-lossy", "all", "position_m"), high=1.2),
    Condition("B lossy / lossless position", _over("anchor-lossy", "anchor", "position_m"), high=1.4),
    Condition("silent robot within 2 s / bound", _of_bound("silent", "track_2s_m"), high=1.5),
    Condition("silent robot, largest error within 2 s [m]", _plain("silent", "track_max_2s_m"), high=0.8),
    Condition("A position [m]", _plain("all", "position_m"), high=0.10),
    Condition("B position [m]", _plain("anchor", "position_m"), high=0.20),
)


def run(path: str, seed: int, jobs: int, progress: Callable[[str], None] = lambda name: None) -> Figures:
    """Figures of all cases, several at once. Raises `ConfigError` if the recording cannot be used."""
    with ProcessPoolExecutor(max_workers=jobs) as pool:
        futures = {name: pool.submit(figures, name, path, seed) for name in CASES}
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


def verdicts(all_: Figures) -> str:
    """Every condition with its value, in Markdown."""
    lines = ["| condition | value | limit | |", "|---|---|---|---|"]
    for item in CONDITIONS:
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
    options = parser.parse_args(arguments)
    try:
        found = run(options.path, options.seed, options.jobs, lambda name: print(f"{name} done", file=sys.stderr))
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    print(table(found), verdicts(found), sep="\n\n")
    return 0 if all(item.holds(found) for item in CONDITIONS) else 1


if __name__ == "__main__":
    sys.exit(main())
