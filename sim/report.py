"""`report.html`: one file with pictures inside, to look at and to send around."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim import plots
from sim.metrics import TrialTrace
from sim.plots import Contacts, ReportUnavailable

CONSISTENT = (0.5, 1.7)
"""ANEES within these is called consistent in words; the figure itself stands beside it."""

STYLE = """
:root { --ink: #1f2430; --soft: #5f6675; --line: #e3e6eb; --accent: #0072B2; --warn: #D55E00; --good: #007a58; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f7f9; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 36px 24px 56px; }
.over { color: var(--accent); font-size: 12px; font-weight: 600; letter-spacing: .09em; text-transform: uppercase; }
h1 { font-size: 30px; line-height: 1.2; margin: 2px 0 6px; letter-spacing: -0.015em; }
h2 { font-size: 17px; margin: 0 0 4px; letter-spacing: -0.005em; }
p.sub { margin: 0 0 24px; color: var(--soft); }
section { background: #fff; border: 1px solid var(--line); border-radius: 12px; padding: 20px 24px; margin: 0 0 18px;
  overflow-x: auto; }
section p { margin: 0 0 14px; color: var(--soft); font-size: 14px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(132px, 1fr)); gap: 12px; margin-bottom: 18px; }
.card { background: #fff; border: 1px solid var(--line); border-radius: 12px; padding: 14px 16px; }
.card b { display: block; font-size: 24px; line-height: 1.3; font-weight: 600; font-variant-numeric: tabular-nums; }
.card b small { font-size: 14px; font-weight: 500; color: var(--soft); }
.card span { display: block; color: var(--soft); font-size: 13px; }
.card em { font-style: normal; font-size: 12px; font-weight: 600; color: var(--soft); }
.card em.good { color: var(--good); }
.card em.warn { color: var(--warn); }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: 14px; margin-top: 8px; }
th { text-align: right; font-weight: 500; color: var(--soft); font-size: 13px; padding: 6px 10px;
  border-bottom: 1px solid var(--line); vertical-align: bottom; }
td { text-align: right; padding: 6px 10px; border-bottom: 1px solid #f0f2f5; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
th:last-child, td:last-child { padding-right: 0; }
tr:last-child td { border-bottom: 0; }
tr.total td { font-weight: 600; }
tr.aside td { color: var(--soft); }
i.dot { display: inline-block; width: 10px; height: 10px; border-radius: 50%; margin-right: 9px; }
.two { display: grid; grid-template-columns: repeat(auto-fit, minmax(320px, 1fr)); gap: 18px; }
.two section { margin: 0; }
.two { margin-bottom: 18px; }
img { width: 100%; display: block; }
pre { background: #f0f2f5; border-radius: 8px; padding: 12px 14px; margin: 8px 0 0; font-size: 13px;
  white-space: pre-wrap; overflow-wrap: anywhere; }
section.warn { border-left: 4px solid var(--warn); padding: 14px 20px; }
footer { color: var(--soft); font-size: 13px; max-width: 88ch; }
"""


def write_report(
    run_dir: Path,
    summary: dict[str, Any],
    trace: TrialTrace | None,
    contacts: Contacts | None,
    landmarks: dict[str, tuple[float, float]],
    title: str,
) -> Path:
    """Write `report.html` and `plots/*.png` into `run_dir`; the page needs no other file.

    `trace` and `contacts` are one trial's samples and applied contacts (time [s], robot, peer), None when they were
    not kept. The command that reproduces the run is read from `command.txt`. Raises `ReportUnavailable` without
    matplotlib.
    """
    plots.require()
    folder = run_dir / "plots"
    folder.mkdir(exist_ok=True)
    path = run_dir / "report.html"
    path.write_text(
        _page(run_dir, summary, _pictures(folder, summary, trace, contacts, landmarks), title), encoding="utf-8"
    )
    return path


def _pictures(
    folder: Path,
    summary: dict[str, Any],
    trace: TrialTrace | None,
    contacts: Contacts | None,
    landmarks: dict[str, tuple[float, float]],
) -> dict[str, tuple[str, str, Path]]:
    """(heading, what it shows, file) by name, in the order of the page."""
    found: dict[str, tuple[str, str, Path]] = {}

    def add(name: str, heading: str, text: str, draw: Callable[[Path], Path]) -> None:
        found[name] = (heading, text, draw(folder / f"{name}.png"))

    if trace is not None:
        add(
            "trajectories",
            "Where they went",
            "Estimated paths in colour over the true ones in grey, with 3σ ellipses now and then.",
            lambda path: plots.trajectories(trace, landmarks, path),
        )
    if summary["trials"] > 1:
        text = "Root mean square over the converged trials"
        if "bound" in summary:
            text += "; dotted, the centralized filter on the same data"
        add("rmse", "Position error over time", text + ".", lambda path: plots.rmse_over_time(summary["series"], path))
    if trace is not None:
        add(
            "errors",
            "Errors inside their claimed bounds",
            f"Error of each robot's own estimate, and the 3σ band it claims.{_shown(len(trace.robots))}",
            lambda path: plots.error_bands(trace, path),
        )
        if trace.targets:
            count = sum(len(owners) for owners in trace.targets.values())
            add(
                "targets",
                "Tracks",
                f"Position error of each robot's track, under the 3σ bound it claims.{_shown(count)}",
                lambda path: plots.target_bands(trace, path),
            )
        add(
            "nees",
            "Consistency",
            "Normalized estimation error squared per degree of freedom. 1 is honest, far above is overconfident; the "
            f"band holds 95 % of an honest filter's samples.{_shown(len(trace.robots))}",
            lambda path: plots.consistency(trace, path),
        )
        if contacts:
            add(
                "contacts",
                "Contacts",
                "A tick for each time a side of a pair used a contact; beside the pair, how many.",
                lambda path: plots.contact_times(contacts, float(trace.t_s[-1]), path),
            )
    return found


def _shown(count: int) -> str:
    return f" The {plots.MAX_PANELS} with the largest errors of {count}." if count > plots.MAX_PANELS else ""


def _page(run_dir: Path, summary: dict[str, Any], pictures: dict[str, tuple[str, str, Path]], title: str) -> str:
    trials = f"{summary['trials']} trials from seed" if summary["trials"] > 1 else "seed"
    start, end = summary["window_s"]
    blocks = [
        '<div class="over">cofix run report</div>',
        f"<h1>{html.escape(title)}</h1>",
        f'<p class="sub">{_runtime(summary)}, {trials} {summary["seed"]}, {summary["simulated_s"]:.0f} s simulated; '
        f"figures over {start:g} to {min(end, summary['simulated_s']):g} s</p>",
        _warnings(summary),
        _cards(summary),
    ]
    first = [name for name in ("trajectories", "rmse") if name in pictures][:1]
    blocks += [_picture(*pictures[name]) for name in first]
    blocks.append(f"<section><h2>Robots</h2>{_robots(summary)}</section>")
    if summary["targets"]:
        blocks.append(f"<section><h2>Targets</h2>{_targets(summary)}</section>")
    blocks += [_picture(*picture) for name, picture in pictures.items() if name not in first]
    blocks.append(
        f'<div class="two"><section><h2>Messages</h2>{_network(summary)}</section>'
        f"<section><h2>Rejected</h2>{_rejected(summary)}</section></div>"
    )
    command = run_dir / "command.txt"
    if command.exists():
        line = html.escape(command.read_text(encoding="utf-8", errors="replace").strip())
        blocks.append(f"<section><h2>Run it again</h2><pre>{line}</pre></section>")
    blocks.append(
        "<footer>RMSE: root mean square error. ANEES: mean of e′P⁻¹e per degree of freedom, 1 when errors are as large "
        "as claimed. Inside 3σ: share of components within three of their claimed standard deviations. Centralized "
        "filter: one filter that has every measurement at once, on the same data.</footer>"
    )
    body = "\n".join(block for block in blocks if block)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)} - cofix</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body><main>{body}</main></body></html>\n"
    )


def _picture(heading: str, text: str, path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f"<section><h2>{html.escape(heading)}</h2><p>{html.escape(text)}</p>"
        f'<img alt="{html.escape(heading)}" src="data:image/png;base64,{data}"></section>'
    )


def _runtime(summary: dict[str, Any]) -> str:
    return {"virtual": "Virtual time", "processes": "One process per robot"}.get(
        summary["runtime"], html.escape(str(summary["runtime"]))
    )


def _number(value: Any, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "–"


def _size(count: float) -> tuple[str, str]:
    for unit in ("B", "kB", "MB"):
        if count < 1000.0:
            return f"{count:.0f}" if unit == "B" or count >= 100.0 else f"{count:.1f}", unit
        count /= 1000.0
    return f"{count:.1f}", "GB"


def _verdict(anees: Any) -> str:
    if not isinstance(anees, (int, float)):
        return ""
    low, high = CONSISTENT
    if anees > high:
        return '<em class="warn">overconfident</em>'
    return '<em class="good">consistent</em>' if anees >= low else "<em>cautious</em>"


def _cards(summary: dict[str, Any]) -> str:
    fleet, network, bound = summary["fleet"], summary["network"], summary.get("bound")
    cards = [(_number(fleet["position_rmse_m"], 2), "m", "fleet position RMSE", "")]
    if bound and bound["position_rmse_m"] and fleet["position_rmse_m"] is not None:
        share = fleet["position_rmse_m"] / bound["position_rmse_m"]
        cards.append((f"{share:.2f}", "×", "the centralized filter's RMSE", ""))
    cards.append((_number(fleet["anees"], 2), "", "ANEES, ideal 1", _verdict(fleet["anees"])))
    if fleet["target_position_rmse_m"] is not None:
        cards.append((_number(fleet["target_position_rmse_m"], 2), "m", "target position RMSE", ""))
    if summary["trials"] > 1:
        cards.append((str(summary["lost"]), f"of {summary['trials']}", "trials lost", ""))
    cards.append((f"{network['sent']:,}", "", "messages", ""))
    cards.append((*_size(network["bytes_per_robot_s"]), "sent per robot and second", ""))
    items = "".join(
        f'<div class="card"><b>{value} <small>{unit}</small></b><span>{name}</span>{mark}</div>'
        for value, unit, name, mark in cards
    )
    return f'<div class="cards">{items}</div>'


def _warnings(summary: dict[str, Any]) -> str:
    lines = []
    dead = [f"{name} (exit {code})" for name, code in summary["exit"].items() if code != 0]
    if dead:
        lines.append(f"Agents that ended early: {', '.join(dead)}.")
    if summary["trials"] == 1 and summary["lost"]:
        lines.append("A belief went astray: this trial counts as lost.")
    elif summary["lost"] == summary["trials"]:
        lines.append("Every trial was lost; the figures are over all of them.")
    if summary.get("covariance_unusable"):
        lines.append(f"{summary['covariance_unusable']} estimates had no positive definite covariance.")
    if summary["faults"]:
        lines.append(f"Injected: {', '.join(summary['faults'])}.")
    if not lines:
        return ""
    return '<section class="warn">' + "".join(f"<div>{html.escape(line)}</div>" for line in lines) + "</section>"


def _table(header: list[str], rows: list[list[str]], classes: list[str] | None = None) -> str:
    """Cells are escaped; a first cell may carry the colour of a robot as `index|text`."""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = ""
    for index, row in enumerate(rows):
        mark = f' class="{classes[index]}"' if classes and classes[index] else ""
        body += f"<tr{mark}>" + "".join(f"<td>{_cell(cell)}</td>" for cell in row) + "</tr>"
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(text: str) -> str:
    place, bar, rest = text.partition("|")
    if bar:
        return f'<i class="dot" style="background:{plots.colour(int(place))}"></i>{html.escape(rest)}'
    return html.escape(text)


def _robots(summary: dict[str, Any]) -> str:
    velocity = any("velocity_rmse_mps" in entry for entry in summary["robots"].values())
    header = ["", "position RMSE [m]", "max [m]", "at the end [m]", "heading RMSE [rad]"]
    header += ["velocity RMSE [m/s]"] if velocity else []
    header += ["ANEES", "inside 3σ", "exit"]

    def row(name: str, entry: dict[str, Any], code: str) -> list[str]:
        cells = [name, _number(entry.get("position_rmse_m"), 3), _number(entry.get("position_error_max_m"), 2)]
        cells += [_number(entry.get("final_position_error_m"), 2), _number(entry.get("heading_rmse_rad"), 3)]
        cells += [_number(entry.get("velocity_rmse_mps"), 3)] if velocity else []
        return [*cells, _number(entry.get("anees"), 2), _number(entry.get("containment_3sigma"), 3), code]

    rows = [
        row(f"{index}|{name}", entry, str(summary["exit"].get(name, "–")))
        for index, (name, entry) in enumerate(summary["robots"].items())
    ]
    classes = [""] * len(rows)
    totals = [("fleet", "fleet", "total")]
    if summary["trials"] > 1:
        totals += [("fleet, median trial", "median", "aside")]
        totals += [("fleet, lost trials included", "all", "aside")] if summary["lost"] else []
    totals.append(("centralized filter", "bound", "aside"))
    for name, key, mark in totals:
        if summary.get(key):
            rows.append(row(name, summary[key], ""))
            classes.append(mark)
    return _table(header, rows, classes)


def _targets(summary: dict[str, Any]) -> str:
    owned = [entry for owners in summary["targets"].values() for entry in owners.values()]
    optional = [
        (key, label)
        for key, label in (("heading_rmse_rad", "heading RMSE [rad]"), ("velocity_rmse_mps", "velocity RMSE [m/s]"))
        if any(key in entry for entry in owned)
    ]
    header = ["", "position RMSE [m]", *(label for _, label in optional), "ANEES", "inside 3σ"]
    robots = list(summary["robots"])
    bound = (summary.get("bound") or {}).get("targets", {})
    rows, classes = [], []
    for target, owners in summary["targets"].items():
        lines = [(f"{robots.index(name)}|{target} by {name}", entry, "") for name, entry in owners.items()]
        if target in bound:
            lines.append((f"{target} by the centralized filter", bound[target], "aside"))
        for name, entry, mark in lines:
            middle = [_number(entry.get(key), 3) for key, _ in optional]
            ends = [_number(entry["anees"], 2), _number(entry["containment_3sigma"], 3)]
            rows.append([name, _number(entry["position_rmse_m"], 3), *middle, *ends])
            classes.append(mark)
    return _table(header, rows, classes)


def _network(summary: dict[str, Any]) -> str:
    network, pair = summary["network"], summary["network"]["pair"]
    rows = [
        ["messages sent", f"{network['sent']:,}"],
        ["delivered, per receiver", f"{network['delivered']:,}"],
        ["lost or out of range, per receiver", f"{network['lost']:,}"],
        ["bytes sent", " ".join(_size(network["bytes"]))],
        ["contacts opened", f"{pair['started']:,}"],
        ["contacts used by both sides", f"{pair['completed']:,}"],
        ["contacts used by one side", f"{pair['one_sided']:,}"],
        ["contacts with unknown correlation", f"{pair['fallback']:,}"],
        ["contacts too old to answer", f"{pair['too_old']:,}"],
    ]
    return _table(["", "count"], rows)


def _rejected(summary: dict[str, Any]) -> str:
    if not summary["rejected"]:
        return "<p>No message was refused.</p>"
    return _table(["reason", "count"], [[name, f"{count:,}"] for name, count in summary["rejected"].items()])


__all__ = ["ReportUnavailable", "write_report"]
