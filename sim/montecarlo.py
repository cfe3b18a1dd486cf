"""Many trials of a scenario over processes. Trial i uses seed + i, so `cofix run --seed` replays any of them."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
import statistics
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from sim.invariants import InvariantChecker
from sim.scenario import Scenario
from sim.summary import reduce
from sim.trial import run_trial

Progress = Callable[[int, int], None]
Task = tuple[int, bool]
"""Seed, and whether the centralized filter runs too."""

PACE_TRIALS = 64
"""Time left follows from so many trials, the last ones."""


class TrialError(RuntimeError):
    """A trial could not be finished."""


class WorkerDied(RuntimeError):
    """A worker process ended without a word, killed for its memory for instance."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A trial that came to its end: reduced, or what it raised in one line."""

    seed: int
    seconds: float
    reduced: dict[str, Any] | None = None
    error: str = ""


_scenarios: list[Scenario] = []
"""In a worker: what the trials are of; sent once, not with every trial."""
_checked: list[bool] = []


def _begin(scenarios: list[Scenario], check: bool, parent: int) -> None:
    """In a worker: leave interrupts to the parent, and end when it is gone, however it went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _scenarios.extend(scenarios)
    _checked.append(check)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _at_worker(which: int, task: Task) -> Finished:
    return _one(_scenarios[which], task, _checked[-1])


def _one(scenario: Scenario, task: Task, check: bool) -> Finished:
    seed, with_bound = task
    started = time.perf_counter()
    checker = InvariantChecker(seed) if check else None
    try:
        reduced = reduce(scenario, run_trial(scenario, seed, with_bound=with_bound, checker=checker))
    except Exception as error:
        return Finished(seed, time.perf_counter() - started, error=_told(error))
    # One figure per trial is enough for the summary; thousands of steps would only be carried about.
    for key in ("step_us", "plan_us"):
        reduced[key] = [statistics.median(reduced[key])] if reduced[key] else []
    return Finished(seed, time.perf_counter() - started, reduced)


def _told(error: Exception) -> str:
    """An exception in one line, with the place it came from."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
    return f"{text} ({Path(place.filename).name}:{place.lineno})"


class Workers:
    """Processes that play trials of any of `scenarios`; with one job everything happens in this process.

    With `check` a trial that breaks an invariant fails.
    """

    def __init__(self, scenarios: list[Scenario], jobs: int, check: bool = False) -> None:
        self._scenarios, self.jobs, self._check = scenarios, jobs, check
        self._pool: ProcessPoolExecutor | None = None
        self._others = multiprocessing.active_children()

    def play(self, which: int, tasks: Iterable[Task]) -> Iterator[Finished]:
        """Trials of scenario number `which`, each as soon as it is finished. Raises `WorkerDied`.

        No more tasks are handed out than keep the workers busy, so that results never pile up.
        """
        if self.jobs <= 1:
            for task in tasks:
                yield _one(self._scenarios[which], task, self._check)
            return
        waiting = list(reversed(list(tasks)))
        pending: list[Future[Finished]] = []
        try:
            while True:
                while waiting and len(pending) < 2 * self.jobs:
                    pending.append(self._submit(which, waiting.pop()))
                if not pending:
                    return
                wait(pending, return_when=FIRST_COMPLETED)
                done = [future for future in pending if future.done()]
                pending = [future for future in pending if future not in done]
                for future in done:
                    yield future.result()
        except BrokenProcessPool:
            raise WorkerDied("a worker process was killed; fewer --jobs need less memory") from None

    def _submit(self, which: int, task: Task) -> Future[Finished]:
        # A worker inherits what is blocked here, so an interrupt while it starts does not reach it either.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(
                    self.jobs,
                    mp_context=multiprocessing.get_context("spawn"),
                    initializer=_begin,
                    initargs=(self._scenarios, self._check, os.getpid()),
                )
            return self._pool.submit(_at_worker, which, task)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is None:
            return
        if kind is not None:
            # Half-done trials are of no use to anybody; without this the pool would wait for them.
            for worker in multiprocessing.active_children():
                if worker not in self._others:
                    worker.terminate()
        self._pool.shutdown(cancel_futures=True)


class Pace:
    """Speed, and the time left by the median of how long the last trials took, which stragglers don't move."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._seconds: deque[float] = deque(maxlen=PACE_TRIALS)

    def finished(self, seconds: float) -> None:
        """A trial took so long."""
        self._seconds.append(seconds)

    def left_s(self, remaining: int) -> float | None:
        """Wall time for `remaining` trials, None before the first is finished."""
        if not self._seconds or not remaining:
            return None if remaining else 0.0
        return statistics.median(self._seconds) * max(remaining / self._jobs, 1.0)

    def per_minute(self) -> float | None:
        """Trials per minute, None before the first is finished."""
        return 60.0 * self._jobs / statistics.fmean(self._seconds) if self._seconds else None


def run_trials(
    scenario: Scenario, trials: int, jobs: int, seed: int, with_bound: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Reduced results in the order of the trials, whatever the number of processes. Raises `TrialError`."""
    found: dict[int, dict[str, Any]] = {}
    with Workers([scenario], min(jobs, trials)) as workers:
        for item in workers.play(0, [(seed + index, with_bound) for index in range(trials)]):
            if item.reduced is None:
                raise TrialError(f"{scenario.name}: seed {item.seed}: {item.error}")
            found[item.seed] = item.reduced
            if progress is not None:
                progress(len(found), trials)
    return [found[seed + index] for index in range(trials)]


def write_trials(path: Path, first: int, rows: dict[int, dict[str, Any]]) -> None:
    """`trials.csv`: the figures of each trial, by the seed that replays it; the first trial has seed `first`."""
    columns = ["trial", "seed", *(sorted(next(iter(rows.values()))) if rows else [])]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for seed, row in rows.items():
            writer.writerow([seed - first, seed, *(row[name] for name in columns[2:])])
