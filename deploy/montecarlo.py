"""Carries out `cofix montecarlo`: many trials of a scenario or of variants of it, going on where it stopped."""

from __future__ import annotations

import argparse
import json
import shlex
import signal
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agent.config_file import ConfigError
from agent.settings import NS
from deploy.runs import exit_status, load_scenario, new_run_dir, write_results, write_scenario, write_whole
from deploy.status import TrialProgress, print_summary
from sim.metrics import is_lost, trial_figures
from sim.montecarlo import Pace, Task, WorkerDied, Workers, write_trials
from sim.provenance import FILE, differences, provenance, summed_up
from sim.scenario import Scenario
from sim.summary import summarize
from sim.trial import open_world
from sim.trial_store import StoreBusy, TrialStore
from sim.variants import bound_leaders, choices, parse

VARIANTS = "variants.json"


@dataclass(slots=True)
class Series:
    """The trials of one scenario and where they are kept."""

    name: str
    """Of the variant; empty when nothing is varied."""
    scenario: Scenario
    run_dir: Path
    made: dict[str, Any]
    command: list[str]
    simulated_s: float
    failed: dict[int, str] = field(default_factory=dict)


def montecarlo(options: argparse.Namespace) -> int:
    """`cofix montecarlo`."""
    if options.resume and options.out is None:
        raise ConfigError("--resume: name the directory to go on with: --out DIR")
    top, planned = _plan(options)
    started = time.perf_counter()
    try:
        with ExitStack() as stack:
            try:
                stores = [stack.enter_context(TrialStore(series.run_dir)) for series in planned]
            except StoreBusy as busy:
                raise ConfigError(f"--out {busy}: another run is writing to it; wait for its end") from None
            _play(options, planned, stores)
            summaries = _conclude(options, top, planned, stores, started)
    except KeyboardInterrupt:
        return _stopped(options, top, planned, "interrupted")
    except WorkerDied as died:
        return _stopped(options, top, planned, str(died))
    for series in planned:
        for seed, error in series.failed.items():
            print(f"cofix: seed {seed} failed: {error}; replay it: {_replay(series, seed, options)}", file=sys.stderr)
    failed = any(series.failed for series in planned)
    unmet = [exit_status(s.scenario, summaries[s.name]) for s in planned if s.name in summaries]
    return 1 if failed or any(unmet) else 0


# --- what is to be done ------------------------------------------------------------------------------------


def _plan(options: argparse.Namespace) -> tuple[Path, list[Series]]:
    """The run directory and the series in it, made or found there. Raises `ConfigError` before anything is made."""
    scenario = load_scenario(options.scenario, options)
    varied = parse(options.vary, options.set)
    found = [(choice.name, choice.overrides) for choice in choices(varied)] if varied else [("", ())]
    planned = []
    for name, overrides in found:
        own = load_scenario(options.scenario, options, overrides)
        world = open_world(own, options.seed)
        command = ["montecarlo", options.scenario, "--trials", str(options.trials), "--seed", str(options.seed)]
        command += ["--bound"] if options.bound else []
        command += ["--check"] if options.check else []
        command += ["--duration", f"{options.duration:g}"] if options.duration is not None else []
        for override in (*options.set, *overrides):
            command += ["--set", override]
        made = provenance(own, options.seed, options.bound, options.check)
        simulated_s = world.steps * world.step_ns / NS
        planned.append(Series(name, own, Path(), made, command if name else options.arguments, simulated_s))
    whole = provenance(scenario, options.seed, options.bound, options.check)
    if varied:
        whole["vary"] = [item.key for item in varied]
    top = _directory(options, scenario.name, whole)
    for series in planned:
        series.run_dir = top / series.name
        if series.name and series.run_dir.exists():
            _check(series.run_dir, series.made)
    for series in planned:
        if series.name and not (series.run_dir / FILE).exists():
            series.run_dir.mkdir(exist_ok=True)
            write_whole(series.run_dir / FILE, json.dumps(series.made, indent=1) + "\n")
        write_scenario(series.scenario, series.run_dir)
    return top, planned


def _directory(options: argparse.Namespace, name: str, made: dict[str, Any]) -> Path:
    """A new run directory, or one that holds trials of the same provenance."""
    if options.out is not None and (options.out / FILE).exists():
        _check(options.out, made)
        return Path(options.out).resolve()
    if options.resume:
        raise ConfigError(f"--out {options.out}: holds no trials to go on with; leave out --resume to begin")
    top = new_run_dir(options.out, name)
    write_whole(top / FILE, json.dumps(made, indent=1) + "\n")
    return top


def _check(run_dir: Path, made: dict[str, Any]) -> None:
    try:
        there = json.loads((run_dir / FILE).read_text())
    except (OSError, ValueError):
        raise ConfigError(f"--out {run_dir}: {FILE} cannot be read; name a new directory") from None
    lines = differences(there, made)
    if lines:
        raise ConfigError(f"--out {run_dir}: made with other settings: {summed_up(lines)}; name a new directory")


# --- doing it ----------------------------------------------------------------------------------------------


def _play(options: argparse.Namespace, planned: list[Series], stores: list[TrialStore]) -> None:
    """Play every trial that is not kept yet."""
    seeds = range(options.seed, options.seed + options.trials)
    kept = [store.trials() for store in stores]
    leaders = bound_leaders([series.scenario for series in planned])
    missing = sum(seed not in trials for trials in kept for seed in seeds)
    jobs = max(1, min(options.jobs, missing))
    pace = Pace(jobs)
    with (
        TrialProgress(len(planned) * options.trials, pace) as progress,
        Workers([series.scenario for series in planned], jobs, options.check) as workers,
    ):
        for index, (series, store) in enumerate(zip(planned, stores, strict=True)):
            progress.title = series.name or series.scenario.name
            limit = series.scenario.lost_above_m
            own = [trial for seed, trial in kept[index].items() if seed in seeds]
            progress.kept(len(own), sum(is_lost(trial["figures"], limit) for trial in own))
            # Where a variant does not change the centralized filter it has been played already.
            led = stores[leaders[index]].trials() if options.bound and leaders[index] != index else {}
            tasks: list[Task] = [(s, options.bound and s not in led) for s in seeds if s not in kept[index]]
            for item in workers.play(index, tasks):
                pace.finished(item.seconds)
                if item.reduced is None:
                    series.failed[item.seed] = item.error
                    progress.finished(lost=False, failed=True)
                    continue
                if item.seed in led:
                    item.reduced["figures"]["bound"] = led[item.seed]["figures"]["bound"]
                store.append(item.seed, item.reduced)
                progress.finished(lost=is_lost(item.reduced["figures"], limit), failed=False)
            series.failed = dict(sorted(series.failed.items()))


def _conclude(
    options: argparse.Namespace, top: Path, planned: list[Series], stores: list[TrialStore], started: float
) -> dict[str, dict[str, Any]]:
    """Tables, summaries, reports and what is printed; summaries by the names of the variants."""
    summaries: dict[str, dict[str, Any]] = {}
    reports: dict[str, Path | None] = {}
    for series, store in zip(planned, stores, strict=True):
        kept = store.trials()
        trials = {seed: kept[seed] for seed in range(options.seed, options.seed + options.trials) if seed in kept}
        _table(series, options.seed, trials)
        if not trials:
            print(f"cofix: {series.name or series.scenario.name}: every trial failed; no summary", file=sys.stderr)
            continue
        steps = sorted(step for trial in trials.values() for step in trial["step_us"])
        timing = {"wall_s": time.perf_counter() - started}
        if steps:
            timing["step_us_median"] = steps[len(steps) // 2]
        if plans := [median for trial in trials.values() for median in trial["plan_us"]]:
            timing["plan_us_median"] = statistics.median(plans)
        summary = summarize(
            series.scenario,
            "virtual",
            options.seed,
            list(trials.values()),
            simulated_s=series.simulated_s,
            timing=timing,
        )
        if series.failed:
            summary["failed"] = {str(seed): error for seed, error in series.failed.items()}
        reports[series.name] = write_results(
            series.scenario, series.run_dir, summary, series.command, draw=not options.no_report
        )
        summaries[series.name] = summary
        if not options.json:
            print_summary(summary, series.run_dir, reports[series.name])
    if not planned[0].name:
        if options.json and summaries:
            print(json.dumps(summaries[""], allow_nan=False))
        return summaries
    whole = json.dumps({"variants": summaries}, allow_nan=False)
    write_whole(top / VARIANTS, whole + "\n")
    if options.json:
        print(whole)
    if summaries:
        _compare(top, planned, summaries, quiet=options.json)
    return summaries


def _compare(top: Path, planned: list[Series], summaries: dict[str, dict[str, Any]], *, quiet: bool) -> None:
    from sim.comparison import write_comparison
    from sim.plots import ReportUnavailable

    runs = [(series.name, series.run_dir) for series in planned if series.name in summaries]
    try:
        page = write_comparison(runs, top, planned[0].scenario.name)
    except ReportUnavailable as error:
        print(f"cofix: no comparison: {error}", file=sys.stderr)
        return
    if not quiet:
        print(f"comparison: {page}")


def _table(series: Series, first: int, trials: dict[int, dict[str, Any]]) -> None:
    rows = {seed: trial_figures(trial["figures"]) | trial["motion"] for seed, trial in trials.items()}
    write_trials(series.run_dir / "trials.csv", first, rows)


# --- when it does not come to its end ----------------------------------------------------------------------


def _stopped(options: argparse.Namespace, top: Path, planned: list[Series], why: str) -> int:
    """Leave a table of what is done, and say how to go on."""
    done = 0
    with _undisturbed():
        for series in planned:
            with TrialStore(series.run_dir) as store:
                trials = store.trials()
                _table(series, options.seed, trials)
                done += sum(options.seed <= seed < options.seed + options.trials for seed in trials)
    command = ["cofix", *options.arguments]
    command += [] if options.out is not None else ["--out", str(top)]
    command += [] if options.resume else ["--resume"]
    total = len(planned) * options.trials
    print(f"cofix: {why}; {done} of {total} trials are kept; go on with: {shlex.join(command)}", file=sys.stderr)
    return 1


@contextmanager
def _undisturbed() -> Iterator[None]:
    """A second interrupt must not spoil the answer to the first."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _replay(series: Series, seed: int, options: argparse.Namespace) -> str:
    """The command that plays one trial alone."""
    scenario = str(series.run_dir / "scenario.toml")
    command = ["cofix", "run", scenario, "--runtime", "virtual", "--seed", str(seed)]
    flags = [*(["--bound"] if options.bound else []), *(["--check"] if options.check else [])]
    return shlex.join([*command, *flags])
