"""What a person sees in the terminal: progress, the live table of a run, the summary at its end."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table
from rich.text import Text

from sim.montecarlo import Pace
from sim.scenario import Scenario

if TYPE_CHECKING:
    from deploy.launch import Launcher


LIVE_TEXT = ("agent", "process", "neighbours")
LIVE_NUMBERS = ("x [m]", "y [m]", "sigma [m]", "contacts", "rejected", "lag [s]")
BY_ROUNDS = {"contacts": "rounds"}
"""Columns of a fleet that localizes itself by rounds: there are no contacts of pairs."""


class Shown:
    """A bar that is on the screen within a `with`."""

    _bar: Bar

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()


class Progress(Shown):
    """A bar with the time left, on standard error; `quiet` shows nothing."""

    def __init__(self, title: str, quiet: bool) -> None:
        self._bar = Bar(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=quiet,
            transient=True,
        )
        self._task = self._bar.add_task(title, total=None)

    def update(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)


class TrialProgress(Shown):
    """Trials done, lost and failed, speed and time left, on standard error: a bar in a terminal, else some lines."""

    LINE_S = 30.0

    def __init__(self, total: int, pace: Pace) -> None:
        self._total, self._pace = total, pace
        self.title = ""
        self.done = self.lost = self.failed = 0
        self._told_s = time.monotonic()
        self._ends_s: float | None = None
        self._terminal = sys.stderr.isatty()
        self._bar = Bar(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            _Told(self),
            console=Console(stderr=True),
            disable=not self._terminal,
            transient=True,
        )
        self._task = self._bar.add_task("", total=total)

    def kept(self, done: int, lost: int) -> None:
        """Trials of an earlier run."""
        self.done, self.lost = self.done + done, self.lost + lost
        self._bar.update(self._task, description=self.title, completed=self.done)

    def finished(self, *, lost: bool, failed: bool) -> None:
        """One more trial; the pace knows it already."""
        self.done, self.lost, self.failed = self.done + 1, self.lost + lost, self.failed + failed
        now = time.monotonic()
        left_s = self._pace.left_s(self._total - self.done)
        self._ends_s = None if left_s is None else now + left_s
        self._bar.update(self._task, description=self.title, completed=self.done)
        if not self._terminal and now - self._told_s >= self.LINE_S:
            self._told_s = now
            print(f"{self.title}: {self.done} of {self._total} trials, {self.text()}", file=sys.stderr, flush=True)

    def text(self) -> str:
        """What stands beside the bar."""
        parts = [f"{self.lost} lost"]
        if self.failed:
            parts.append(f"{self.failed} failed")
        speed = self._pace.per_minute()
        if speed is not None:
            parts.append(f"{speed:.0f}/min" if speed >= 10.0 else f"{speed:.1f}/min")
        if self._ends_s is not None:
            parts.append(f"{duration(self._ends_s - time.monotonic())} left")
        return ", ".join(parts)


class _Told(ProgressColumn):
    """The words beside the bar of trials; asked for again and again, so the time left counts down."""

    def __init__(self, progress: TrialProgress) -> None:
        super().__init__()
        self._progress = progress

    def render(self, task: Any) -> Text:
        return Text(self._progress.text())


def duration(seconds: float) -> str:
    """Wall time for people: seconds, minutes or hours."""
    whole = max(0, round(seconds))
    if whole < 100:
        return f"{whole} s"
    minutes = round(whole / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


class LiveTable:
    """One row per agent while a run of processes goes on."""

    def __init__(self, scenario: Scenario, speed: float, quiet: bool) -> None:
        self._scenario, self._speed = scenario, speed
        self._live = None if quiet else Live(console=Console(stderr=True), refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveTable:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, launcher: Launcher) -> None:
        """Draw the present state."""
        if self._live is not None:
            self._live.update(self.table(launcher))

    def table(self, launcher: Launcher) -> Table:
        """The present state as a table."""
        played = launcher.progress() * self._scenario.duration_s
        title = f"{self._scenario.name}  {played:.0f} / {self._scenario.duration_s:.0f} s  at {self._speed:g} x"
        links = self._scenario.links.model_dump(exclude_defaults=True)
        injected = ", ".join([*(f"{name} {value:g}" for name, value in links.items()), *launcher.injected()])
        unsafe = self._scenario.unsafe.settings().named()
        notes = [f"UNSAFE: {', '.join(unsafe)}"] if unsafe else []
        notes += [f"injected: {injected}"] if injected else []
        for name, running in sorted(launcher.members.items()):
            notes += [f"{name}: {reason}" for reason in running.status.get("health", {}).get("reasons", [])]
            notes += [f"{name}: hears {peer} and is not heard by it" for peer in running.status.get("unheard_by", [])]
            notes += [f"{name}: {told}" for told in identified(running.status)]
            notes += [f"{name}: {reason}" for reason in stillness(running.status, alone=len(launcher.members) <= 2)]
        table = Table(
            title=title,
            title_justify="left",
            caption=escape("\n".join(notes)) if notes else None,
            caption_justify="left",
        )
        for name in LIVE_TEXT:
            table.add_column(escape(name))
        renamed = BY_ROUNDS if self._scenario.localization.kind == "jlatt" else {}
        for name in LIVE_NUMBERS:
            table.add_column(escape(renamed.get(name, name)), justify="right")
        for robot in self._scenario.robots:
            member = launcher.members.get(robot.id)
            if member is None:
                continue
            table.add_row(robot.id, *_cells(member.exit_code, member.status))
        return table


def identified(status: dict[str, Any]) -> list[str]:
    """How many others a robot that locates them has identified, and who is ambiguous; nothing for another one."""
    return [str(status["form_reason"])] if status.get("relatives") else []


def stillness(status: dict[str, Any], *, alone: bool) -> list[str]:
    """Why a robot that chooses its motion does not move, or plans with less than it could; nothing for another one.

    `alone`: there is nobody that it could hear.
    """
    steering = status.get("steering")
    if steering is None or "x_m" not in status:
        return []
    autopilot = status.get("autopilot", {})
    reasons = list(autopilot.get("reasons", []))
    missing = (autopilot.get("steering") or {}).get("missing")
    if missing and not reasons:
        reasons.append(f"does not move: {missing}")
    if not steering["neighbours"] and not alone:
        reasons.append("plans alone: no neighbour has told of the last rounds")
    if steering["kind"] != "random" and not status.get("tracks"):
        reasons.append("knows of no target: it keeps clear of others, and goes nowhere")
    return reasons


def _cells(exit_code: int | None, status: dict[str, Any]) -> list[str]:
    """A row of the live table after the agent's name."""
    blank = [""] * (len(LIVE_TEXT) + len(LIVE_NUMBERS) - 2)
    if exit_code is not None:
        return [f"[red]ended ({exit_code})[/red]", *blank]
    if "x_m" not in status:
        return ["waiting" if status.get("missing") else "starting", "; ".join(status.get("missing", [])), *blank[1:]]
    counters = status.get("counters", {})
    used = ("pair.applied_initiator", "pair.applied_responder", "round.closed")
    contacts = str(sum(counters.get(name, 0) for name in used))
    if counters.get("round.skipped"):
        contacts += f" ({counters['round.skipped']} skipped)"
    judged = status.get("health", {}).get("peers", {})
    unused = {peer: "quarantined" for peer, found in judged.items() if found["verdict"] == "quarantined"}
    clocks = status.get("clocks", {})
    unused |= {peer: f"clock: {clock['unusable']}" for peer, clock in clocks.items() if clock["unusable"]}
    peers = " ".join(
        f"[red]{peer} ({unused[peer]})[/red]" if peer in unused else peer
        for peer, up in sorted(status.get("peers", {}).items())
        if up
    )
    return [
        "running",
        peers or "none heard",
        f"{status['x_m']:.2f}",
        f"{status['y_m']:.2f}",
        f"{status['sigma_m']:.2f}",
        contacts,
        str(sum(status.get("rejected", {}).values())),
        f"{status['lag_s']:.2f}",
    ]


def print_summary(summary: dict[str, Any], run_dir: Path, report: Path | None) -> None:
    """The figures a person asks for first, on standard output."""
    console = Console()
    trials = summary["trials"]
    head = f"{summary['scenario']}, {summary['runtime']}, seed {summary['seed']}"
    if trials > 1:
        head += f", {trials} trials, {summary['lost']} lost"
    table = Table(title=head, title_justify="left")
    columns = ("robot", "RMSE [m]", "max [m]", "heading RMSE [rad]", "ANEES", "inside 3σ")
    for name in columns:
        table.add_column(escape(name), justify="left" if name == "robot" else "right")
    for robot, entry in summary["robots"].items():
        table.add_row(
            robot,
            _number(entry["position_rmse_m"], 3),
            _number(entry["position_error_max_m"], 2),
            _number(entry.get("heading_rmse_rad"), 3),
            _number(entry["anees"], 2),
            _number(entry["containment_3sigma"], 3),
        )
    fleet = summary["fleet"]
    table.add_section()
    table.add_row(
        "fleet",
        _number(fleet["position_rmse_m"], 3),
        "",
        _number(fleet.get("heading_rmse_rad"), 3),
        _number(fleet["anees"], 2),
        "",
    )
    bound = summary.get("bound")
    if bound:
        table.add_row(
            "centralized",
            _number(bound["position_rmse_m"], 3),
            "",
            _number(bound.get("heading_rmse_rad"), 3),
            _number(bound["anees"], 2),
            "",
        )
    console.print(table)
    if fleet.get("target_position_rmse_m") is not None:
        console.print(
            f"targets: position RMSE {_number(fleet['target_position_rmse_m'], 3)} m, "
            f"ANEES {_number(fleet.get('target_anees'), 2)}"
        )
    relative = summary.get("relative")
    if relative is not None:
        console.print(
            f"relative: {_number(100.0 * relative['identified_share'][-1][1], 0)} % identified at the end, half "
            f"after {_number(relative['time_to_identify_s']['median'], 1)} s; position RMSE "
            f"{_number(relative['position_rmse_m'], 2)} m (median {_number(relative['position_error_median_m'], 2)}), "
            f"ANEES {_number(relative['anees_median'], 2)}"
        )
    network = summary["network"]
    pair = network["pair"]
    console.print(
        f"network: {network['sent']} messages, {network['bytes_per_robot_s']:.0f} B/s and robot, "
        f"{pair['completed']} of {pair['started']} contacts completed, {pair['one_sided']} one-sided"
    )
    if summary["rejected"]:
        console.print("rejected: " + ", ".join(f"{name} {count}" for name, count in summary["rejected"].items()))
    if summary["faults"]:
        console.print("injected: " + ", ".join(summary["faults"]))
    if summary["unsafe"]:
        console.print("[red]UNSAFE: protections are off: " + ", ".join(summary["unsafe"]) + "[/red]")
    if report is not None:
        console.print(f"report: {report}", soft_wrap=True)
    console.print(f"run directory: {run_dir}", soft_wrap=True)


def _number(value: Any, digits: int) -> str:
    return f"{value:.{digits}f}" if isinstance(value, (int, float)) else "-"
