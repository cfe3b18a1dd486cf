"""Many trials of a scenario over processes. Trial i uses seed + i, so `cofix run --seed` replays any of them."""

from __future__ import annotations

import csv
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from sim.scenario import Scenario
from sim.summary import reduce
from sim.trial import run_trial

Progress = Callable[[int, int], None]


def _one(task: tuple[Scenario, int, bool]) -> dict[str, Any]:
    scenario, seed, with_bound = task
    return reduce(scenario, run_trial(scenario, seed, with_bound=with_bound))


def _follow(parent: int) -> None:
    """In a worker: leave interrupts to the parent, and end when it is gone, however it went."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_trials(
    scenario: Scenario, trials: int, jobs: int, seed: int, with_bound: bool, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """Reduced results in the order of the trials, whatever the number of processes."""
    tasks = [(scenario, seed + index, with_bound) for index in range(trials)]
    results = []
    if jobs <= 1 or trials == 1:
        for task in tasks:
            results.append(_one(task))
            if progress is not None:
                progress(len(results), trials)
        return results
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(jobs, trials), mp_context=context, initializer=_follow, initargs=(os.getpid(),)
    ) as pool:
        futures = [pool.submit(_one, task) for task in tasks]
        try:
            for future in futures:
                results.append(future.result())
                if progress is not None:
                    progress(len(results), trials)
        except BaseException:
            # Half-done trials are of no use to anybody; without this the pool would wait for them.
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise
    return results


def write_trials(path: Path, seed: int, summaries: list[dict[str, Any]]) -> None:
    """`trials.csv`: the fleet figures of each trial with the seed that replays it."""
    columns = ["trial", "seed", *sorted(summaries[0])] if summaries else ["trial", "seed"]
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for index, summary in enumerate(summaries):
            writer.writerow([index, seed + index, *(summary[name] for name in columns[2:])])
