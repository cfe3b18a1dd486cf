"""Many trials: the same results whatever the number of processes; what fails does not take the others with it."""

from __future__ import annotations

import csv
import json
import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.metrics import trial_figures
from sim.montecarlo import Pace, TrialError, WorkerDied, Workers, run_trials, write_trials
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.summary import NOT_COMPARED, reduce, summarize
from sim.trial import run_trial

MADE = load("ut-clat", ["duration_s=30", "window_s=[0, 30]", "links.loss=0.1"])


def broken() -> Scenario:
    return MADE.model_copy(update={"world": MADE.world.model_copy(update={"placement": None})})


def summary(reduced: list[dict[str, Any]]) -> str:
    whole = summarize(MADE, "virtual", 5, reduced, simulated_s=30.0, timing={"wall_s": 0.0})
    del whole[NOT_COMPARED]
    return json.dumps(whole, allow_nan=False)


def test_one_process_and_two_give_equal_summaries() -> None:
    told: list[tuple[int, int]] = []
    alone = run_trials(MADE, 3, 1, 5, True)
    together = run_trials(MADE, 3, 2, 5, True, lambda done, of: told.append((done, of)))
    assert summary(alone) == summary(together)
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_trial_i_is_the_run_of_seed_plus_i() -> None:
    for index, reduced in enumerate(run_trials(MADE, 2, 1, 7, False)):
        single = reduce(MADE, run_trial(MADE, 7 + index))
        assert summary([reduced]) == summary([single])
    one, other = run_trials(MADE, 2, 1, 7, False)
    assert summary([one]) != summary([other])


def test_a_failure_of_a_trial_is_not_swallowed() -> None:
    for jobs in (1, 2):
        with pytest.raises(TrialError, match=r"seed \d: KeyError: .*\.py:\d"):
            run_trials(broken(), 2, jobs, 1, False)


@pytest.mark.parametrize("jobs", [1, 2])
def test_workers_play_any_of_their_scenarios_and_outlive_a_failure(jobs: int) -> None:
    with Workers([broken(), MADE], jobs) as workers:
        failed = {item.seed: item for item in workers.play(0, [(5, False), (6, False)])}
        played = {item.seed: item for item in workers.play(1, [(5, False), (6, False), (7, False)])}
    assert sorted(failed) == [5, 6]
    assert all(item.reduced is None and item.error.startswith("KeyError") for item in failed.values())
    assert sorted(played) == [5, 6, 7]
    for seed, item in played.items():
        assert item.reduced is not None
        assert item.seconds > 0.0
        assert summary([item.reduced]) == summary([reduce(MADE, run_trial(MADE, seed))])
    assert multiprocessing.active_children() == []


def test_leaving_in_the_middle_ends_the_workers() -> None:
    def leave() -> None:
        with Workers([MADE], 2) as workers:
            for _ in workers.play(0, [(seed, False) for seed in range(1, 100)]):
                raise InterruptedError

    with pytest.raises(InterruptedError):
        leave()
    assert multiprocessing.active_children() == []


def test_a_worker_that_is_killed_is_told_and_takes_the_others_with_it() -> None:
    def play() -> None:
        with Workers([MADE], 2) as workers:
            for _ in workers.play(0, [(seed, False) for seed in range(1, 100)]):
                worker = multiprocessing.active_children()[0]
                assert worker.pid is not None
                os.kill(worker.pid, signal.SIGKILL)

    with pytest.raises(WorkerDied, match="fewer --jobs"):
        play()
    assert multiprocessing.active_children() == []


# --- time left --------------------------------------------------------------------------------------------


def test_nothing_is_said_of_the_time_left_before_a_trial_is_finished() -> None:
    pace = Pace(2)
    assert pace.left_s(10) is None
    assert pace.left_s(0) == 0.0
    assert pace.per_minute() is None


@given(st.floats(0.01, 100.0), st.integers(1, 8), st.integers(1, 1000))
def test_equal_trials_take_their_share_of_the_workers(seconds: float, jobs: int, remaining: int) -> None:
    pace = Pace(jobs)
    for _ in range(5):
        pace.finished(seconds)
    assert pace.left_s(remaining) == pytest.approx(seconds * max(1.0, remaining / jobs))
    assert pace.per_minute() == pytest.approx(60.0 * jobs / seconds)


def test_a_straggler_does_not_move_the_time_left() -> None:
    pace = Pace(1)
    for seconds in (1.0, 1.0, 500.0, 1.0, 1.0):
        pace.finished(seconds)
    assert pace.left_s(10) == 10.0


# --- the table --------------------------------------------------------------------------------------------


def test_the_table_of_trials_names_the_seed_that_replays_each(tmp_path: Path) -> None:
    rows = {5 + i: trial_figures(reduced["figures"]) for i, reduced in enumerate(run_trials(MADE, 3, 1, 5, False))}
    del rows[6]
    write_trials(tmp_path / "trials.csv", 5, rows)
    with (tmp_path / "trials.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(row["trial"], row["seed"]) for row in table] == [("0", "5"), ("2", "7")]
    for row, figures in zip(table, rows.values(), strict=True):
        for name, value in figures.items():
            assert value is not None
            assert np.isclose(float(row[name]), value)


def test_no_trials_leave_a_table_without_rows(tmp_path: Path) -> None:
    write_trials(tmp_path / "trials.csv", 5, {})
    assert (tmp_path / "trials.csv").read_text().split() == ["trial,seed"]
