"""Carries out `cofix run`: run directory, progress, figures, report, exit status; what `montecarlo` shares with it."""

from __future__ import annotations

import argparse
import asyncio
import csv
import json
import shlex
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w

from agent.config import AgentConfig
from agent.config_file import ConfigError
from agent.lateness_figures import LatenessFigures
from agent.node import Recorder
from agent.recording import RecordingWriter
from agent.settings import NS
from deploy.evaluate import collect, merge_fates, merge_recordings
from deploy.launch import Launcher, LaunchError
from deploy.status import LiveTable, Progress, print_summary
from network.links import FATE_COLUMNS, FateRecord, fate_row
from sim.agents import agent_config, table
from sim.closed_loop import MOTION
from sim.engine import TrialResult
from sim.invariants import InvariantBreach, InvariantChecker
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.sight import views
from sim.store import load_trace, save_trace
from sim.summary import reduce, summarize, unmet
from sim.trial import open_world, played_world, run_trial

DEMO = "demo"


def run(options: argparse.Namespace) -> int:
    """`cofix run`."""
    name = options.scenario or DEMO
    scenario = load_scenario(name, options)
    runtime = options.runtime or ("processes" if name == DEMO else "virtual")
    if runtime == "virtual" and options.speed != 1.0:
        raise ConfigError("--speed is for --runtime processes; virtual time runs as fast as it can")
    if runtime == "processes" and options.check:
        raise ConfigError("--check is for --runtime virtual: it looks into all robots after every event")
    speed = options.speed if name != DEMO or options.speed != 1.0 else DEMO_SPEED
    world = open_world(scenario, options.seed)
    run_dir = new_run_dir(options.out, scenario.name)
    write_scenario(scenario, run_dir)
    started = time.perf_counter()
    exits: dict[str, int] | None = None
    messages: list[str] = []
    lag_max_s = lag_p99_s = 0.0
    if runtime == "virtual":
        try:
            result = _run_virtual(scenario, options, world, run_dir)
        except InvariantBreach as breach:
            print(f"cofix: invariant broken: {breach}", file=sys.stderr)
            return 1
    else:
        launcher = Launcher(scenario, world, options.seed, speed, run_dir)
        live = LiveTable(scenario, speed, quiet=options.json)
        try:
            with live:
                outcome = asyncio.run(launcher.run(live.show))
        except LaunchError as error:
            print(f"cofix: {error}", file=sys.stderr)
            return 1
        if outcome.interrupted:
            print("cofix: interrupted; all processes are stopped", file=sys.stderr)
            return 1
        exits, messages = outcome.exits, outcome.messages
        lag_max_s = max([f["lag_max_s"] for f in (*outcome.figures.values(), outcome.world) if f], default=0.0)
        lags = LatenessFigures()
        for figures in outcome.figures.values():
            if figures:
                lags.heard(round(figures["lag_max_s"] * 1e9), figures["lags"])
        lag_p99_s = lags.percentile_ns(0.99) * 1e-9
        scenario = launcher.played()
        write_scenario(scenario, run_dir)
        world = played_world(scenario, options.seed, run_dir / MOTION)
        result = collect(scenario, world, run_dir, outcome, options.bound, options.seed)
        for figures in outcome.figures.values():
            result.plan_us.extend(figures["plan_us"] if figures else ())
        merge_recordings(scenario, run_dir)
        merge_fates(scenario, run_dir)
    steps = sorted(result.step_us)
    timing = {"wall_s": time.perf_counter() - started, "lag_max_s": lag_max_s, "lag_p99_s": lag_p99_s}
    if steps:
        timing["step_us_median"] = steps[len(steps) // 2]
    if result.plan_us:
        timing["plan_us_median"] = statistics.median(result.plan_us)
    summary = summarize(
        scenario,
        runtime,
        options.seed,
        [reduce(scenario, result)],
        simulated_s=world.steps * world.step_ns / NS,
        timing=timing,
        exits=exits,
    )
    save_trace(run_dir, result.trace, result.contacts, world.landmarks, result.measured, views(scenario), result.gate)
    report = write_results(scenario, run_dir, summary, options.arguments, draw=not options.no_report)
    if options.json:
        print(json.dumps(summary, allow_nan=False))
    else:
        print_summary(summary, run_dir, report)
    for message in messages:
        print(f"cofix: {message}", file=sys.stderr)
    return exit_status(scenario, summary)


DEMO_SPEED = 10.0


def report(options: argparse.Namespace) -> Path:
    """`cofix report`: a run's report again, or the comparison of several runs or of a run's variants.

    Raises `ConfigError` when a directory holds no run.
    """
    directories: list[Path] = options.directories
    if len(directories) == 1:
        (run_dir,) = directories
        variants = _variants(run_dir)
        if options.out is not None:
            raise ConfigError("--out: a single run's report stays in its directory; name several to compare them")
        if not variants:
            return _report(run_dir, _summary(run_dir))
        for _, path in variants:
            _report(path, _summary(path))
        return _compare(variants, run_dir)
    runs = [run for path in directories for run in _variants(path) or [("", path)]]
    named = [(name or path.resolve().name, path) for name, path in runs]
    names = [name for name, _ in named]
    named = [(name if names.count(name) == 1 else str(path), path) for name, path in named]
    for _, path in named:
        _summary(path)  # Before anything is made.
    there = sorted(path.name for path in options.out.iterdir()) if options.out and options.out.is_dir() else []
    again = there == ["comparison.html", "plots"]
    out = options.out.resolve() if again else new_run_dir(options.out, "comparison")
    return _compare(named, out)


def _summary(run_dir: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads((run_dir / "summary.json").read_text())
    except (OSError, ValueError):
        raise ConfigError(f"{run_dir}: no readable summary.json; name the directory of a finished run") from None
    return found


def _variants(run_dir: Path) -> list[tuple[str, Path]]:
    """(name, directory) of the variants a run varied, none if it varied nothing."""
    try:
        names = json.loads((run_dir / "variants.json").read_text())["variants"]
    except (OSError, ValueError, KeyError):
        return []
    return [(name, run_dir / name) for name in names]


def _compare(runs: list[tuple[str, Path]], out: Path) -> Path:
    from sim.comparison import NoRun, write_comparison
    from sim.plots import ReportUnavailable

    title = ", ".join(dict.fromkeys(_summary(path)["scenario"] for _, path in runs))
    try:
        return write_comparison(runs, out, title)
    except (NoRun, ReportUnavailable) as error:
        raise ConfigError(str(error)) from None


def load_scenario(name: str, options: argparse.Namespace, varied: Sequence[str] = ()) -> Scenario:
    """The scenario as the command line wants it, with further overrides."""
    overrides = list(options.set)
    if options.duration is not None:
        overrides.append(f"duration_s={float(options.duration)!r}")
    return load(name, [*overrides, *varied])


def new_run_dir(out: Path | None, name: str) -> Path:
    run_dir = out if out is not None else Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    try:
        if run_dir.exists() and any(run_dir.iterdir()):
            raise ConfigError(f"--out {run_dir}: not empty; name a new directory")
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {run_dir}: cannot be written ({error.strerror})") from None
    return run_dir.resolve()


def write_scenario(scenario: Scenario, run_dir: Path) -> None:
    with (run_dir / "scenario.toml").open("wb") as file:
        tomli_w.dump(table(scenario), file)


def _run_virtual(scenario: Scenario, options: argparse.Namespace, world: Any, run_dir: Path) -> TrialResult:
    configs: dict[str, AgentConfig] = {robot.id: agent_config(scenario, world, robot) for robot in scenario.robots}
    writer = RecordingWriter(run_dir / "recording.mcap")
    (run_dir / "agents").mkdir(exist_ok=True)
    for robot, config in configs.items():
        writer.add_robot(config, 0)
        (run_dir / "agents" / f"{robot}.toml").write_text(tomli_w.dumps(table(config)))

    def recorder(robot: str) -> Recorder:
        return lambda event, effects: writer.record(robot, event, effects)

    with (run_dir / "fates.csv").open("w", newline="") as file, Progress(scenario.name, options.json) as progress:
        fates = csv.writer(file)
        fates.writerow(FATE_COLUMNS)

        replay = shlex.join(["cofix", *options.arguments])
        checker = InvariantChecker(options.seed, replay) if options.check else None

        def log_fate(record: FateRecord) -> None:
            fates.writerow(fate_row(record))

        result = run_trial(
            scenario,
            options.seed,
            with_bound=options.bound,
            recorders={robot: recorder(robot) for robot in configs},
            fate_sink=log_fate,
            progress=progress.update,
            world=world,
            checker=checker,
            life_sink=writer.begin_life,
        )
    writer.close()
    return result


def write_results(
    scenario: Scenario, run_dir: Path, summary: dict[str, Any], command: list[str], *, draw: bool = True
) -> Path | None:
    """`command.txt`, `summary.json` and the report, whose path is returned; None, and why, when it can't be drawn.

    Conditions of the scenario the summary breaks are told too.
    """
    (run_dir / "command.txt").write_text(shlex.join(["cofix", *command]) + "\n")
    write_whole(run_dir / "summary.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    report: Path | None = None
    try:
        report = _report(run_dir, summary) if draw else None
    except ConfigError as error:
        print(f"cofix: no report: {error}", file=sys.stderr)
    for line in unmet(summary, scenario.expect):
        print(f"cofix: expectation not met: {line}", file=sys.stderr)
    return report


def write_whole(path: Path, text: str) -> None:
    """Write a file so that nobody ever finds half of it."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text)
    temporary.replace(path)


def _report(run_dir: Path, summary: dict[str, Any]) -> Path:
    from sim.report import ReportUnavailable, write_report

    try:
        return write_report(run_dir, summary, load_trace(run_dir), summary["scenario"])
    except ReportUnavailable as error:
        raise ConfigError(str(error)) from None


def exit_status(scenario: Scenario, summary: dict[str, Any]) -> int:
    died = any(code != 0 for code in summary["exit"].values())
    return 1 if died or unmet(summary, scenario.expect) else 0
