"""The comparison of planners: `python -m benchmarks.active`."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from benchmarks.active import CASES, LOST_M, Plan, curve, main, row, table
from sim import plots
from sim.scenario_file import load

SHORT_S = 3.0


@pytest.fixture(autouse=True)
def _coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "DPI", 40)


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_case_is_played_beside_its_bound_and_pictured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--trials", "1", "--duration", str(SHORT_S), "--at", "0", "3", "--out", str(tmp_path)]
    assert main([*arguments, "--cases", "ajlatt"]) == 0
    head, _, line = capsys.readouterr().out.strip().splitlines()
    found = dict(zip(cells(head), cells(line), strict=False))
    assert found["case"] == "ajlatt" and found["lost"] == "0 of 1"
    summary = json.loads((tmp_path / "ajlatt-1-1" / "summary.json").read_text())
    bound = summary["bound"]
    assert cells(line)[5] == f"{bound['target_position_rmse_m']:.2f} ({bound['target_anees']:.2f})"
    assert cells(line)[9] == f"{bound['position_rmse_m']:.2f} ({bound['anees']:.2f})"
    assert summary["simulated_s"] == SHORT_S == summary["window_s"][1]
    made = {path.name for path in tmp_path.glob("*.png")}
    assert {"potentials.png", "rmse-trace.png", "ajlatt-snapshots.png", "ajlatt-distances.png"} <= made
    # What is finished is not played again.
    trials = (tmp_path / "ajlatt-1-1" / "trials.bin").read_bytes()
    assert main([*arguments, "--cases", "ajlatt"]) == 0
    assert (tmp_path / "ajlatt-1-1" / "trials.bin").read_bytes() == trials


def test_loss_and_delay_are_those_of_the_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.active.LOSSES", (0.0, 1.0))
    monkeypatch.setattr("benchmarks.active.DELAYS", (1,))
    rows = curve(Plan(1, 1, 1, SHORT_S, tmp_path))
    assert list(rows) == ["0 % lost", "100 % lost", "rounds late: 1"]
    assert all(found.target_bound is None for found in rows.values())
    robots = [found.robots_m for found in rows.values()]
    assert len(set(robots)) == 3, "they differ"
    network = {
        path.name: json.loads((path / "summary.json").read_text())["network"] for path in tmp_path.iterdir()
    }
    assert network["ajlatt-links.loss=0.0-1-1"]["delivered"] > 0
    assert network["ajlatt-links.loss=1.0-1-1"]["delivered"] == 0


def test_every_case_is_a_scenario_and_weighs_as_it_says() -> None:
    assert len(CASES) == 11
    for name, case in CASES.items():
        scenario = load(case.scenario, list(case.overrides))
        rule = name.partition(" ")[2] or "split_ci"
        assert scenario.localization.weights == rule
        assert scenario.planning.weights == rule


def made_up(**change: Any) -> dict[str, Any]:
    fleet = {"position_rmse_m": 0.5, "anees": 0.4, "target_position_rmse_m": 0.75, "target_anees": 0.2}
    motion = {"collisions": 1.5, "min_distance_m": 1.25, "connected_share": 0.9, "target_seen_share": 0.3}
    return {"trials": 3, "all": fleet, "median": fleet, "motion": motion, "timing": {}} | change


def test_a_trial_is_lost_by_its_own_tracks_and_a_row_is_whole_without_a_bound() -> None:
    found = row(made_up(), [LOST_M + 0.1, 0.3, LOST_M - 0.1])
    assert found.lost == 1 and found.target_bound is None and math.isnan(found.plan_us)
    head, rule, line = table({"x": found}, "case").splitlines()
    assert len(cells(head)) == len(cells(rule)) == len(cells(line)) == 13
