"""The comparison: one page that says what differs between runs and what came of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from sim import plots, series_plots
from sim.comparison import NoRun, write_comparison
from tests.sim.test_report import Page, summary_of, trial


@pytest.fixture(autouse=True)
def _coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "DPI", 40)


def run(folder: Path, seeds: list[int], loss: float, **change: Any) -> Path:
    """A finished run directory."""
    folder.mkdir(parents=True)
    summary = summary_of([trial(seed) for seed in seeds], **change)
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "report.html").write_text("<p>")
    robots = [{"id": name, "localization": {"form": "safe"}} for name in summary["robots"]]
    scenario = {"name": "circles", "links": {"loss": loss}, "robots": robots}
    (folder / "scenario.toml").write_text(tomli_w.dumps(scenario))
    return folder


@pytest.fixture
def two(tmp_path: Path) -> list[tuple[str, Path]]:
    return [("quiet", run(tmp_path / "quiet", [1, 2], 0.0)), ("<lossy>", run(tmp_path / "los|sy", [3, 4], 0.3))]


def test_runs_stand_beside_each_other(tmp_path: Path, two: list[tuple[str, Path]]) -> None:
    path = write_comparison(two, tmp_path / "out", "Circles & <loss>")
    assert path == tmp_path / "out" / "comparison.html"
    page = Page(path)
    assert "Circles & <loss>" in page.text
    assert "2 runs: 2 trials each" in page.text
    assert sorted(page.pictures) == ["Consistency over time", "Position error over time", "Robot by robot"]
    assert page.outside == ["../quiet/report.html", "../los|sy/report.html"]
    first = json.loads((two[0][1] / "summary.json").read_text())
    (header,) = [row for row in page.rows if "lost" in row]
    figures = dict(zip(header, next(row for row in page.rows if row[0] == "quiet")))
    assert figures["lost"] == "0 of 2"
    assert figures["B per robot and s"] == "321"
    row = next(row for row in page.rows if row[0] == "quiet")
    fleet, bound = first["fleet"], first["bound"]
    assert row[1] == f"{fleet['position_rmse_m']:.3f}"
    assert row[2] == f"{fleet['position_rmse_m'] / bound['position_rmse_m']:.2f}"
    assert row[4] == f"{fleet['anees']:.2f}"
    assert row[5] == f"{fleet['target_position_rmse_m']:.3f}"


def test_only_what_differs_is_told(tmp_path: Path, two: list[tuple[str, Path]]) -> None:
    page = Page(write_comparison(two, tmp_path, "loss"))
    assert ["", "links.loss"] in page.rows
    assert ["quiet", "0.0"] in page.rows
    assert ["<lossy>", "0.3"] in page.rows
    twice = Page(write_comparison([two[0], ("again", two[0][1])], tmp_path, "same"))
    assert "Nothing: all settings are equal." in twice.text


def test_extremes_are_of_the_worst_robot(tmp_path: Path, two: list[tuple[str, Path]]) -> None:
    page = Page(write_comparison(two, tmp_path, "loss"))
    robots = json.loads((two[0][1] / "summary.json").read_text())["robots"].values()
    median = max(entry["error_max"]["x_m"] for entry in robots)
    worst = max(entry["error_worst"]["x_m"] for entry in robots)
    assert f"{median:.2f} / {worst:.2f}" in [row[1] for row in page.rows if row[0] == "quiet"]


def test_the_best_is_marked_and_a_tie_is_not(tmp_path: Path, two: list[tuple[str, Path]]) -> None:
    text = write_comparison(two, tmp_path, "loss").read_text(encoding="utf-8")
    rmse = [json.loads((path / "summary.json").read_text())["fleet"]["position_rmse_m"] for _, path in two]
    assert f'<td class="good">{min(rmse):.3f}</td>' in text
    assert f'<td class="good">{max(rmse):.3f}</td>' not in text
    assert '<td class="good">321</td>' not in text


def test_runs_of_different_fleets_without_targets_or_bound_can_be_compared(
    tmp_path: Path, two: list[tuple[str, Path]]
) -> None:
    lone = run(tmp_path / "lone", [5], 0.0)
    summary = json.loads((lone / "summary.json").read_text())
    del summary["bound"], summary["series"]["bound_position_rmse_m"], summary["series"]["bound_target_position_rmse_m"]
    summary["targets"], summary["series"]["target_position_rmse_m"] = {}, {}
    summary["fleet"]["target_position_rmse_m"] = summary["fleet"]["target_anees"] = None
    for entry in summary["robots"].values():
        del entry["error_min"], entry["error_worst"]
    (lone / "summary.json").write_text(json.dumps(summary))
    (lone / "scenario.toml").unlink()
    page = Page(write_comparison([*two, ("lone", lone)], tmp_path, "mixed"))
    assert "1 to 2 trials each" in page.text
    row = next(row for row in page.rows if row[0] == "lone")
    assert row[2] == "–"
    assert row[5:8] == ["–", "–", "–"]


def test_more_runs_than_colours_are_all_in_the_tables(
    tmp_path: Path, two: list[tuple[str, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(series_plots, "MAX_RUNS", 2)
    runs = [*two, ("third|one", two[0][1])]
    page = Page(write_comparison(runs, tmp_path, "many"))
    assert page.text.count("The first 2 of 3 runs.") == 3
    assert [row[0] for row in page.rows if row[-1].isdecimal()][:3] == ["quiet", "<lossy>", "third/one"]


def test_a_directory_without_a_run_is_named(tmp_path: Path, two: list[tuple[str, Path]]) -> None:
    with pytest.raises(NoRun, match=r"gone: no readable summary\.json"):
        write_comparison([*two, ("gone", tmp_path / "gone")], tmp_path / "out", "loss")
    with pytest.raises(NoRun, match="at least one"):
        write_comparison([], tmp_path / "out", "none")
    assert not (tmp_path / "out").exists()
