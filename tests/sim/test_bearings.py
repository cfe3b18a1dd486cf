"""The comparison of filters that triangulate: `python -m benchmarks.bearings`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.bearings import breaks, main, noises, row
from sim.scenario_file import load

SHORT = ("--set", "duration_s=1.5", "--set", "window_s=[1.0, 1.5]")


def test_a_sweep_has_a_row_for_each_filter_and_a_column_for_each_noise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--trials", "1", "--jobs", "1", "--kinds", "icf_plus", "--out", str(tmp_path)]
    assert main([*arguments, "--noise", "0.01", "0.2", *SHORT]) == 0
    heads, _, bound, ours = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("|")
    ]
    assert heads == ["filter", "0.01 rad", "0.2 rad"]
    assert (bound[0], ours[0]) == ("`central_plus`", "`icf_plus`")
    for column, sigma in enumerate(("0.01", "0.2"), start=1):
        summary = json.loads((tmp_path / f"stt-noise-{sigma}-icf_plus-1-1" / "summary.json").read_text())
        for line, which in ((bound, "bound"), (ours, "fleet")):
            figures = summary[which]
            told = f"{figures['target_position_rmse_m']:.2f} / {figures['target_velocity_rmse_mps']:.2f}"
            assert line[column] == told
    fine, coarse = (float(cell.partition(" / ")[0]) for cell in ours[1:])
    assert fine < 0.5 * coarse


def test_columns_are_scenarios_of_their_own() -> None:
    columns = breaks() | noises([0.05])
    made = {name: load(scenario, changes) for name, (scenario, _, changes) in columns.items()}
    assert len({scenario.model_dump_json() for scenario in made.values()}) == len(columns) == 7
    assert made["isolated"].links.loss == 1.0 and made["0.3 s late"].links.delay_s == 0.3
    assert made["0.05 rad"].robots[3].sensors["camera"].sigma_rad == 0.05
    assert all(scenario.window_s == [10.0, 20.0] for scenario in made.values())


def test_what_is_told_from_ten_seconds_on_is_the_tail() -> None:
    series: dict[str, Any] = {"t_s": [0.0, 10.0, 20.0], "target_position_rmse_m": {"t1": {"c1": [5.0, 3.0, None]}}}
    fleet = {"target_velocity_rmse_mps": 1.0, "target_anees": 0.5}
    summary = {
        "trials": 2,
        "series": series,
        "fleet": fleet,
        "median": {"target_position_rmse_m": 4.0},
        "network": {"bytes_per_robot_s": 100.0},
        "timing": {"step_us_median": 7.0},
    }
    found = row(summary)
    assert found.tail_m == 3.0 and found.all_m == pytest.approx(17.0**0.5) and found.median_m == 4.0
