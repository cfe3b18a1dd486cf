"""`report.html`: one file with pictures inside, to look at and to send around."""

from __future__ import annotations

import base64
import html
from pathlib import Path
from typing import Any

from sim import plots
from sim.metrics import TrialTrace
from sim.plots import Contacts, ReportUnavailable

STYLE = """
:root { --ink: #1f2430; --soft: #5f6675; --line: #e3e6eb; --accent: #0072B2; }
* { box-sizing: border-box; }
body { margin: 0; background: #f6f7f9; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 32px 24px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 17px; margin: 0 0 12px; }
p.sub { margin: 0 0 24px; color: var(--soft); }
section { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 20px 22px; margin: 0 0 18px; }
section p { margin: 0 0 12px; color: var(--soft); max-width: 75ch; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(165px, 1fr)); gap: 12px; margin-bottom: 18px; }
.card { background: #fff; border: 1px solid var(--line); border-radius: 10px; padding: 14px 16px; }
.card b { display: block; font-size: 22px; font-weight: 600; font-variant-numeric: tabular-nums; }
.card span { color: var(--soft); font-size: 13px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { text-align: right; font-weight: 600; color: var(--soft); font-size: 13px; padding: 6px 10px;
  border-bottom: 1px solid var(--line); }
td { text-align: right; padding: 6px 10px; border-bottom: 1px solid #f0f2f5; }
th:first-child, td:first-child { text-align: left; }
tr.total td { font-weight: 600; }
img { max-width: 100%; display: block; }
code { background: #f0f2f5; border-radius: 5px; padding: 2px 6px; font-size: 13px; overflow-wrap: anywhere; }
.warn { border-left: 4px solid #D55E00; }
"""


def write_report(
    run_dir: Path,
    summary: dict[str, Any],
    trace: TrialTrace | None,
    contacts: Contacts | None,
    landmarks: dict[str, tuple[float, float]],
    title: str,
) -> Path:
    """Write `report.html` and `plots/*.png` into `run_dir`. Raises `ReportUnavailable` without matplotlib."""
    folder = run_dir / "plots"
    folder.mkdir(exist_ok=True)
    pictures: list[tuple[str, str, Path]] = []
    if trace is not None:
        pictures.append(
            (
                "Where they went",
                "Estimated paths in colour over the true ones in grey, with 3-sigma ellipses; dots mark the start.",
                plots.trajectories(trace, landmarks, folder / "trajectories.png"),
            )
        )
        pictures.append(
            (
                "Errors inside their claimed bounds",
                "Error of each robot's own estimate, and the 3-sigma band it claims.",
                plots.error_bands(trace, folder / "errors.png"),
            )
        )
        if trace.targets:
            pictures.append(
                (
                    "Tracks",
                    "Position error of each robot's track, under the 3-sigma bound it claims.",
                    plots.target_bands(trace, folder / "targets.png"),
                )
            )
        pictures.append(
            (
                "Consistency",
                "Normalized estimation error squared per degree of freedom: 1 is honest, far above is overconfident.",
                plots.consistency(trace, folder / "nees.png"),
            )
        )
        if contacts:
            pictures.append(
                (
                    "Contacts",
                    "When a pair's measurement was used by either side.",
                    plots.contact_times(contacts, float(trace.t_s[-1]), folder / "contacts.png"),
                )
            )
    if summary["trials"] > 1:
        pictures.append(
            (
                "Position error over time",
                "Root mean square over the converged trials.",
                plots.rmse_over_time(summary["series"], folder / "rmse.png"),
            )
        )
    path = run_dir / "report.html"
    path.write_text(_page(run_dir, summary, pictures, title))
    return path


def _page(run_dir: Path, summary: dict[str, Any], pictures: list[tuple[str, str, Path]], title: str) -> str:
    command = run_dir / "command.txt"
    how = f"<code>{html.escape(command.read_text().strip())}</code>" if command.exists() else ""
    trials = f", {summary['trials']} trials" if summary["trials"] > 1 else ""
    blocks = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p class=sub>{html.escape(summary['runtime'])}, seed {summary['seed']}{trials}, "
        f"{summary['simulated_s']:.0f} s simulated, figures over {summary['window_s'][0]:g}-"
        f"{summary['window_s'][1]:g} s. {how}</p>",
        _cards(summary),
        _warnings(summary),
        f"<section><h2>Figures</h2>{_robots(summary)}</section>",
    ]
    if summary["targets"]:
        blocks.append(f"<section><h2>Targets</h2>{_targets(summary)}</section>")
    for heading, text, picture in pictures:
        data = base64.b64encode(picture.read_bytes()).decode()
        blocks.append(
            f"<section><h2>{heading}</h2><p>{text}</p>"
            f'<img alt="{heading}" src="data:image/png;base64,{data}"></section>'
        )
    blocks.append(f"<section><h2>Messages</h2>{_network(summary)}</section>")
    body = "\n".join(blocks)
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title>"
        f'<meta name=viewport content="width=device-width, initial-scale=1"><style>{STYLE}</style>'
        f"<main>{body}</main></html>\n"
    )


def _number(value: Any, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "–"


def _cards(summary: dict[str, Any]) -> str:
    fleet, network = summary["fleet"], summary["network"]
    cards = [(_number(fleet["position_rmse_m"], 2) + " m", "fleet position RMSE")]
    bound = summary.get("bound")
    if bound and bound["position_rmse_m"]:
        cards.append((f"{fleet['position_rmse_m'] / bound['position_rmse_m']:.2f} ×", "of the centralized filter's"))
    cards.append((_number(fleet["anees"], 2), "ANEES (ideal 1)"))
    if fleet["target_position_rmse_m"] is not None:
        cards.append((_number(fleet["target_position_rmse_m"], 2) + " m", "target position RMSE"))
    if summary["trials"] > 1:
        cards.append((f"{summary['lost']} of {summary['trials']}", "trials lost"))
    cards.append((f"{network['bytes_per_robot_s']:.0f} B/s", "sent per robot"))
    return (
        "<div class=cards>" + "".join(f"<div class=card><b>{v}</b><span>{n}</span></div>" for v, n in cards) + "</div>"
    )


def _warnings(summary: dict[str, Any]) -> str:
    lines = []
    dead = {name: code for name, code in summary["exit"].items() if code != 0}
    if dead:
        ended = ", ".join(f"{name} (exit {code})" for name, code in dead.items())
        lines.append(f"Agents that ended early: {ended}.")
    if summary["faults"]:
        lines.append("Injected: " + ", ".join(summary["faults"]) + ".")
    if not lines:
        return ""
    return "<section class=warn>" + "".join(f"<div>{html.escape(line)}</div>" for line in lines) + "</section>"


def _table(header: list[str], rows: list[list[str]], total_from: int | None = None) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in header)
    body = ""
    for index, row in enumerate(rows):
        mark = " class=total" if total_from is not None and index >= total_from else ""
        body += f"<tr{mark}>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
    return f"<table><tr>{head}</tr>{body}</table>"


def _row(name: str, entry: dict[str, Any]) -> list[str]:
    return [
        name,
        _number(entry.get("position_rmse_m"), 3),
        _number(entry.get("position_error_max_m"), 2),
        _number(entry.get("heading_rmse_rad"), 3),
        _number(entry.get("anees"), 2),
        _number(entry.get("containment_3sigma"), 3),
    ]


def _robots(summary: dict[str, Any]) -> str:
    header = ["robot", "position RMSE [m]", "max [m]", "heading RMSE [rad]", "ANEES", "inside 3σ"]
    rows = [_row(name, entry) for name, entry in summary["robots"].items()]
    totals = [_row("fleet", summary["fleet"])]
    if summary.get("bound"):
        totals.append(_row("centralized filter", summary["bound"]))
    return _table(header, rows + totals, len(rows))


def _targets(summary: dict[str, Any]) -> str:
    header = [
        "target, tracked by",
        "position RMSE [m]",
        "heading RMSE [rad]",
        "velocity RMSE [m/s]",
        "ANEES",
        "inside 3σ",
    ]
    rows = []
    for target, owners in summary["targets"].items():
        for robot, entry in owners.items():
            rows.append(
                [
                    f"{target}, {robot}",
                    _number(entry["position_rmse_m"], 3),
                    _number(entry.get("heading_rmse_rad"), 3),
                    _number(entry.get("velocity_rmse_mps"), 3),
                    _number(entry["anees"], 2),
                    _number(entry["containment_3sigma"], 3),
                ]
            )
    return _table(header, rows)


def _network(summary: dict[str, Any]) -> str:
    network, pair = summary["network"], summary["network"]["pair"]
    rows = [
        ["messages sent", str(network["sent"])],
        ["delivered (per receiver)", str(network["delivered"])],
        ["lost or out of range (per receiver)", str(network["lost"])],
        ["contacts opened", str(pair["started"])],
        ["contacts used by both sides", str(pair["completed"])],
        ["contacts used by one side", str(pair["one_sided"])],
        ["contacts with unknown correlation", str(pair["fallback"])],
    ]
    rows += [[f"rejected: {name}", str(count)] for name, count in summary["rejected"].items()]
    return _table(["", "count"], rows)


__all__ = ["ReportUnavailable", "write_report"]
