"""`comparison.html`: several runs beside each other, what differs between them and what came of it."""

from __future__ import annotations

import html
import json
import os
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim import plots, series_plots
from sim.error_plots import label
from sim.page import number, page, picture, section, size, table
from sim.settings_table import differing

FILE = "comparison.html"
MAX_SETTINGS = 40


class NoRun(ValueError):
    """A directory does not hold a finished run; the message says which and what to do."""


@dataclass(frozen=True, slots=True)
class Run:
    """One of the runs compared."""

    name: str
    path: Path
    summary: dict[str, Any]
    scenario: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Figure:
    """A column of the table of figures; the best is marked if there is one."""

    group: str
    name: str
    pick: Callable[[dict[str, Any]], Any]
    digits: int
    best: Callable[[float], float] | None = None
    """What to make small."""


def write_comparison(runs: list[tuple[str, Path]], out_dir: Path, title: str) -> Path:
    """Write `comparison.html` and `plots/comparison-*.png` into `out_dir` from the summaries of (name, run directory).

    Raises `NoRun` when a directory has no summary, `ReportUnavailable` without matplotlib.
    """
    plots.require()
    found = [_read(name, path) for name, path in runs]
    if not found:
        raise NoRun("nothing to compare; name at least one run directory")
    folder = out_dir / "plots"
    folder.mkdir(parents=True, exist_ok=True)
    path = out_dir / FILE
    path.write_text(_page(found, out_dir, folder, title), encoding="utf-8")
    return path


def _read(name: str, path: Path) -> Run:
    try:
        summary = json.loads((path / "summary.json").read_text())
    except (OSError, ValueError):
        raise NoRun(f"{path}: no readable summary.json; name the directory of a finished run") from None
    try:
        scenario = tomllib.loads((path / "scenario.toml").read_text())
    except (OSError, ValueError):
        scenario = {}
    return Run(name, path, summary, scenario)


def _page(runs: list[Run], out_dir: Path, folder: Path, title: str) -> str:
    shown = runs[: series_plots.MAX_RUNS]
    lines = [(run.name, run.summary["series"]) for run in shown]
    few = "" if len(shown) == len(runs) else f" The first {len(shown)} of {len(runs)} runs."
    bound = any("bound" in run.summary for run in runs)
    dotted = " Dotted, the centralized filter on the same data." if bound else ""
    targets = any(run.summary["targets"] for run in runs)

    def draw(name: str, make: Callable[[series_plots.Runs, Path], Path]) -> Path:
        return make(lines, folder / f"comparison-{name}.png")

    blocks = [
        '<div class="over">cofix comparison</div>',
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="sub">{len(runs)} runs: {html.escape(_trials(runs))}</p>',
        section(
            "Figures",
            _figures(runs),
            "In colour the best of a column; ANEES is best at 1. × centralized: in units of the centralized filter.",
        ),
        section("What differs", _settings(runs)),
        picture(
            "Position error over time",
            f"Root mean square over robots{' and tracks' if targets else ''} and converged trials.{dotted}{few}",
            draw("rmse", series_plots.fleet_rmse),
        ),
        picture(
            "Robot by robot",
            f"The same for each robot{' and track' if targets else ''}.{few}",
            draw("each", series_plots.each_rmse),
        ),
        picture(
            "Consistency over time",
            "NEES per degree of freedom, averaged over robots and converged trials. 1 is honest, above is "
            f"overconfident.{few}",
            draw("anees", series_plots.fleet_anees),
        ),
        _extremes(runs),
        section("Messages", _messages(runs)),
        _links(runs, out_dir),
    ]
    return page(title, blocks)


def _trials(runs: list[Run]) -> str:
    """How many trials each run has, in words."""
    counts = sorted({run.summary["trials"] for run in runs})
    if len(counts) > 1:
        return f"{counts[0]} to {counts[-1]} trials each"
    return f"{counts[0]} trials each" if counts[0] > 1 else "one trial each"


def _first(runs: Sequence[Run]) -> list[str]:
    """The first cell of each run's row: its colour in the pictures, and its name."""
    return [
        f"{index}|{run.name}" if index < series_plots.MAX_RUNS else run.name.replace("|", "/")
        for index, run in enumerate(runs)
    ]


# --- figures -----------------------------------------------------------------------------------------------


def _ratio(summary: dict[str, Any], key: str) -> float | None:
    own, bound = summary["fleet"].get(key), (summary.get("bound") or {}).get(key)
    return own / bound if own is not None and bound else None


def _from_one(value: float) -> float:
    return max(value, 1.0 / value) if value > 0.0 else float("inf")


def _small(value: float) -> float:
    return value


FIGURES = (
    Figure("robots", "position RMSE [m]", lambda s: s["fleet"]["position_rmse_m"], 3, _small),
    Figure("robots", "× centralized", lambda s: _ratio(s, "position_rmse_m"), 2),
    Figure("robots", "heading RMSE [rad]", lambda s: s["fleet"]["heading_rmse_rad"], 3, _small),
    Figure("robots", "ANEES", lambda s: s["fleet"]["anees"], 2, _from_one),
    Figure("targets", "position RMSE [m]", lambda s: s["fleet"]["target_position_rmse_m"], 3, _small),
    Figure("targets", "× centralized", lambda s: _ratio(s, "target_position_rmse_m"), 2),
    Figure("targets", "ANEES", lambda s: s["fleet"]["target_anees"], 2, _from_one),
    Figure("run", "lost", lambda s: s["lost"], 0, _small),
    Figure("run", "B per robot and s", lambda s: s["network"]["bytes_per_robot_s"], 0, _small),
)


def _figures(runs: list[Run]) -> str:
    columns = []
    for figure in FIGURES:
        values = [figure.pick(run.summary) for run in runs]
        if any(value is not None for value in values):
            columns.append((figure, values, _best(figure, values)))
    rows = []
    for place, first in enumerate(_first(runs)):
        row = [first]
        for figure, values, best in columns:
            text = number(values[place], figure.digits)
            if figure.name == "lost":
                text += f" of {runs[place].summary['trials']}"
            row.append(f"good|{text}" if place in best else text)
        rows.append(row)
    spans = Counter(figure.group for figure, _, _ in columns)
    return table(["", *(figure.name for figure, _, _ in columns)], rows, groups=[("", 1), *spans.items()])


def _best(figure: Figure, values: list[Any]) -> list[int]:
    """Places of the best values as they are shown, none if all are as good or the figure is not to be judged."""
    if figure.best is None:
        return []
    scores = {
        place: figure.best(round(value, figure.digits)) for place, value in enumerate(values) if value is not None
    }
    found = [place for place, score in scores.items() if score == min(scores.values())]
    return found if len(found) < len(scores) else []


# --- settings ----------------------------------------------------------------------------------------------


def _settings(runs: list[Run]) -> str:
    rows = differing([_told(run) for run in runs])
    if not rows:
        return "<p>Nothing: all settings are equal.</p>"
    shown = rows[:MAX_SETTINGS]
    if len(shown) > len(runs):
        header = ["", *(run.name for run in runs)]
        body = table(header, [[key, *(f"words|{value}" for value in values)] for key, values in shown])
    else:
        firsts = _first(runs)
        body = table(
            ["", *(key for key, _ in shown)],
            [[firsts[place], *(f"right|{values[place]}" for _, values in shown)] for place in range(len(runs))],
        )
    return body + (f"<p>And {len(rows) - len(shown)} more.</p>" if len(shown) < len(rows) else "")


def _told(run: Run) -> dict[str, Any]:
    """Everything a run can differ in: how it was run, and the scenario."""
    summary = run.summary
    made = {key: summary[key] for key in ("runtime", "seed", "trials")}
    made["centralized filter"] = "bound" in summary
    return {**made, **run.scenario}


# --- extremes and messages ---------------------------------------------------------------------------------


def _extremes(runs: list[Run]) -> str:
    """Largest errors of any robot and of any track, by component. Empty if no run has them."""

    def largest(entries: list[dict[str, Any]], key: str, name: str) -> float | None:
        values = [(entry.get(key) or {}).get(name) for entry in entries]
        return max((value for value in values if value is not None), default=None)

    groups = []
    for heading, pick in (("robots", _of_robots), ("tracks", _of_tracks)):
        per_run = [pick(run.summary) for run in runs]
        names = list(dict.fromkeys(n for entries in per_run for e in entries for n in e.get("error_max", {})))
        if names:
            groups.append((heading, per_run, names))
    if not groups:
        return ""
    rows = []
    for place, first in enumerate(_first(runs)):
        row = [first]
        for _, per_run, names in groups:
            for name in names:
                ends = [largest(per_run[place], key, name) for key in ("error_max", "error_worst")]
                alone = runs[place].summary["trials"] == 1 or ends[1] is None
                row.append(number(ends[0], 2) if alone else " / ".join(number(end, 2) for end in ends))
        rows.append(row)
    many = any(run.summary["trials"] > 1 for run in runs)
    text = "Largest absolute error of any robot, and of any robot's track of a target"
    text += "; over trials the median and the worst." if many else "."
    header = ["", *(label(name) for _, _, names in groups for name in names)]
    over = [("", 1), *((heading, len(names)) for heading, _, names in groups)]
    return section("Extremes", table(header, rows, groups=over), text)


def _of_robots(summary: dict[str, Any]) -> list[dict[str, Any]]:
    return list(summary["robots"].values())


def _of_tracks(summary: dict[str, Any]) -> list[dict[str, Any]]:
    return [entry for owners in summary["targets"].values() for entry in owners.values()]


def _messages(runs: list[Run]) -> str:
    header = ["", "sent per robot and second", "messages per robot and second", "contacts used by both sides"]
    header += ["by one side", "unknown correlation", "per trial: rejected"]
    rows = []
    for first, run in zip(_first(runs), runs):
        summary, found = run.summary, run.summary["network"]
        seconds = summary["simulated_s"] * summary["trials"] * len(summary["robots"])
        pair, each = found["pair"], summary["trials"]
        row = [first, " ".join(size(found["bytes_per_robot_s"]))]
        row.append(number(found["sent"] / seconds, 3) if seconds else "–")
        row += [f"{pair[key] / each:,.4g}" for key in ("completed", "one_sided", "fallback")]
        rows.append([*row, f"{sum(summary['rejected'].values()) / each:,.4g}"])
    return table(header, rows)


def _links(runs: list[Run], out_dir: Path) -> str:
    """Where the reports of the runs are, as seen from the page."""
    items = []
    for run in runs:
        report = run.path / "report.html"
        if report.exists():
            place = html.escape(Path(os.path.relpath(report, out_dir)).as_posix().replace("%", "%25"), quote=True)
            items.append(f'<a href="{place}">{html.escape(run.name)}</a>')
    return section("Reports", "<br>".join(items)) if items else ""
