"""`report.html`: one file with pictures inside, to look at and to send around."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sim import availability, error_plots, plots, relative_plots, series_plots, tables
from sim.animation import player
from sim.page import cards, number, page, picture, section, size, verdict
from sim.plots import ReportUnavailable
from sim.relative_figures import RIGHT_M
from sim.store import Stored

Pictures = dict[str, tuple[str, str, Path]]


def write_report(run_dir: Path, summary: dict[str, Any], stored: Stored | None, title: str) -> Path:
    """Write `report.html` and `plots/*.png` into `run_dir`; the page needs no other file.

    `stored` is one trial as it was kept, None if none was. The command that reproduces the run is read from
    `command.txt`. Raises `ReportUnavailable` without matplotlib.
    """
    plots.require()
    folder = run_dir / "plots"
    folder.mkdir(exist_ok=True)
    path = run_dir / "report.html"
    path.write_text(_page(run_dir, summary, stored, _pictures(folder, summary, stored), title), encoding="utf-8")
    return path


def _pictures(folder: Path, summary: dict[str, Any], stored: Stored | None) -> Pictures:
    """(heading, what it shows, file) by name, in the order of the page."""
    found: Pictures = {}

    def add(name: str, heading: str, text: str, draw: Callable[[Path], Path]) -> None:
        found[name] = (heading, text, draw(folder / f"{name}.png"))

    if summary["trials"] > 1:
        _over_trials(summary, add)
    if stored is not None:
        _of_one_trial(stored, (summary["window_s"][0], summary["window_s"][1]), add)
        _of_motion(stored, summary.get("motion", {}), add)
        _of_relatives(stored, add)
    if "relative" in summary:
        share = summary["relative"]["identified_share"]
        text = f"Share of robots whose believed place is within {RIGHT_M:g} m of the true one."
        add("identified", "Who is identified", text, lambda path: relative_plots.shares(share, path))
    return found


Add = Callable[[str, str, str, Callable[[Path], Path]], None]


def _over_trials(summary: dict[str, Any], add: Add) -> None:
    series = summary["series"]
    text = "Root mean square over the converged trials"
    if "bound" in summary:
        text += "; dotted, the centralized filter on the same data"
    add("rmse", "Position error over time", text + ".", lambda path: series_plots.rmse_over_time(series, path))
    sizes = {entry.get("dof") for entry in summary["robots"].values()}
    dof = sizes.pop() if len(sizes) == 1 else None
    kept = summary["trials"] - summary["lost"] or summary["trials"]
    text = "NEES per degree of freedom, averaged over the converged trials. 1 is honest, above is overconfident"
    text += f"; the band holds 95 % of the averages of {kept} trials of an honest filter." if dof is not None else "."
    add("anees", "Consistency over time", text, lambda path: series_plots.anees_over_time(series, dof, kept, path))


def _of_one_trial(stored: Stored, window: tuple[float, float], add: Add) -> None:
    trace, end_s = stored.trace, float(stored.trace.t_s[-1])
    add(
        "trajectories",
        "Where they went",
        "Estimated paths in colour over the true ones in grey, with 3σ ellipses now and then.",
        lambda path: plots.trajectories(trace, stored.landmarks, path),
    )
    white = "" if window[0] <= 0.0 and window[1] >= end_s else " Figures are over the part on white."
    add(
        "errors",
        "Localization errors inside their claimed bounds",
        "Error of each robot's own estimate by component, and the ±3σ envelope it claims."
        f"{white}{_shown(len(trace.robots))}",
        lambda path: error_plots.robot_errors(trace, window, path),
    )
    if trace.targets:
        count = sum(len(owners) for owners in trace.targets.values())
        add(
            "targets",
            "Tracking errors inside their claimed bounds",
            f"Error of each robot's track of a target by component, and the ±3σ envelope it claims.{_shown(count)}",
            lambda path: error_plots.track_errors(trace, window, path),
        )
    add(
        "nees",
        "Consistency",
        "Normalized estimation error squared per degree of freedom. 1 is honest, far above is overconfident; the "
        f"band holds 95 % of an honest filter's samples.{_shown(len(trace.robots))}",
        lambda path: plots.consistency(trace, path),
    )
    pairs = availability.pair_rows(stored.measured, stored.contacts, list(trace.robots), end_s)
    if pairs:
        add(
            "contacts",
            "Who could measure whom, and contacts",
            "Pale, while one of a pair could measure the other; a tick for each time a side used a contact. At the "
            "right the share of time with a measurement, and the number of ticks.",
            lambda path: availability.pair_availability(pairs, end_s, path),
        )
    seen = availability.sighting_rows(stored.measured, list(trace.robots), list(trace.targets), end_s)
    if seen:
        add(
            "sightings",
            "Who could see targets" if trace.targets else "Who could see landmarks",
            "A bar while a robot could measure; at the right the share of time.",
            lambda path: availability.target_availability(seen, list(trace.robots), end_s, path),
        )


def _of_motion(stored: Stored, motion: dict[str, Any], add: Add) -> None:
    if motion.get("min_distance_m") is None:
        return
    limit_m, states = motion["collision_m"], list(stored.trace.robots.values())
    places = np.stack([item.truth[:, list(item.position[:2])] for item in states], axis=1)
    add(
        "distances",
        "How far robots were from each other",
        f"True distances of all pairs on the ground; below {limit_m:g} m it is a collision.",
        lambda path: series_plots.pair_distances(stored.trace.t_s, places, limit_m, path),
    )


def _of_relatives(stored: Stored, add: Add) -> None:
    traces, t_s = stored.trace.relatives, stored.trace.t_s
    if not traces:
        return
    add(
        "frames",
        "Where leaders take the others to be",
        "Seen from above in the body frame of each leader, which looks to the right: true ways, and the hypothesis "
        "that is believed.",
        lambda path: relative_plots.frames(traces, path),
    )
    shown = stored.gate
    if shown is not None:
        add(
            "gate",
            "Which bearings may be whose",
            "One scan of a leader, and what its hypotheses of one robot expected: bearings inside a gate may be that "
            "robot's.",
            lambda path: relative_plots.gate(shown, path),
        )
    add(
        "hypotheses",
        "Hypotheses and their errors",
        "How many hypotheses there are of each robot, how far off the believed one is, and the probability of the "
        "second one that is elsewhere.",
        lambda path: relative_plots.over_time(t_s, traces, path),
    )


def _shown(count: int) -> str:
    return f" The {plots.MAX_PANELS} with the largest errors of {count}." if count > plots.MAX_PANELS else ""


def _page(run_dir: Path, summary: dict[str, Any], stored: Stored | None, pictures: Pictures, title: str) -> str:
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
    if stored is not None:
        blocks.append(player(stored))
    first = [name for name in ("trajectories", "rmse") if name in pictures][:1]
    blocks += [picture(*pictures[name]) for name in first]
    blocks.append(section("Robots", tables.robots(summary)))
    if summary["targets"]:
        blocks.append(section("Targets", tables.targets(summary)))
    blocks.append(tables.extremes(summary))
    blocks.append(tables.motion(summary))
    blocks += [picture(*item) for name, item in pictures.items() if name not in first]
    blocks.append(tables.innovations(summary))
    blocks.append(
        f'<div class="two">{section("Messages", tables.network(summary))}'
        f"{section('Rejected', tables.rejected(summary))}</div>"
    )
    command = run_dir / "command.txt"
    if command.exists():
        line = html.escape(command.read_text(encoding="utf-8", errors="replace").strip())
        blocks.append(section("Run it again", f"<pre>{line}</pre>"))
    blocks.append(FOOTER)
    return page(title, blocks)


FOOTER = (
    "<footer>RMSE: root mean square error. ANEES: mean of e′P⁻¹e per degree of freedom, 1 when errors are as large "
    "as claimed. Inside 3σ: share of components within three of their claimed standard deviations. Centralized "
    "filter: one filter that has every measurement at once, on the same data.</footer>"
)


def _runtime(summary: dict[str, Any]) -> str:
    return {"virtual": "Virtual time", "processes": "One process per robot"}.get(
        summary["runtime"], html.escape(str(summary["runtime"]))
    )


def _cards(summary: dict[str, Any]) -> str:
    fleet, network, bound = summary["fleet"], summary["network"], summary.get("bound")
    items = [(number(fleet["position_rmse_m"], 2), "m", "fleet position RMSE", "")]
    if bound and bound["position_rmse_m"] and fleet["position_rmse_m"] is not None:
        share = fleet["position_rmse_m"] / bound["position_rmse_m"]
        items.append((f"{share:.2f}", "×", "the centralized filter's RMSE", ""))
    word, mark = verdict(fleet["anees"])
    items.append((number(fleet["anees"], 2), "", "ANEES, ideal 1", f'<em class="{mark}">{word}</em>' if word else ""))
    if fleet["target_position_rmse_m"] is not None:
        items.append((number(fleet["target_position_rmse_m"], 2), "m", "target position RMSE", ""))
    if summary["trials"] > 1:
        items.append((str(summary["lost"]), f"of {summary['trials']}", "trials lost", ""))
    items.append((f"{network['sent']:,}", "", "messages", ""))
    items.append((*size(network["bytes_per_robot_s"]), "sent per robot and second", ""))
    return cards(items)


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


__all__ = ["ReportUnavailable", "write_report"]
