"""Many trials: the same results whatever the number of processes."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim.metrics import trial_figures
from sim.montecarlo import run_trials, write_trials
from sim.scenario import load
from sim.summary import NOT_COMPARED, reduce, summarize
from sim.trial import run_trial

MADE = load("ut-clat", ["duration_s=30", "window_s=[0, 30]", "links.loss=0.1"])


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
    broken = MADE.model_copy(update={"world": MADE.world.model_copy(update={"placement": None})})
    for jobs in (1, 2):
        with pytest.raises(KeyError):
            run_trials(broken, 2, jobs, 1, False)


def test_the_table_of_trials_names_the_seed_that_replays_each(tmp_path: Path) -> None:
    rows = [trial_figures(reduced["figures"]) for reduced in run_trials(MADE, 2, 1, 5, False)]
    write_trials(tmp_path / "trials.csv", 5, rows)
    with (tmp_path / "trials.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(row["trial"], row["seed"]) for row in table] == [("0", "5"), ("1", "6")]
    for row, figures in zip(table, rows, strict=True):
        for name, value in figures.items():
            assert value is not None
            assert np.isclose(float(row[name]), value)


def test_no_trials_leave_a_table_without_rows(tmp_path: Path) -> None:
    write_trials(tmp_path / "trials.csv", 5, [])
    assert (tmp_path / "trials.csv").read_text().split() == ["trial,seed"]
