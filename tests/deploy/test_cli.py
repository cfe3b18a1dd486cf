"""The command line: wrong use costs one line and nothing else; right use gives figures that can be trusted."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from deploy.cli import main

SHORT = ["ut-clat", "--runtime", "virtual", "--duration", "30", "--set", "window_s=[0,30]"]


class Desk:
    """A terminal in an empty folder."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        """Exit status, standard output, standard error."""
        self._capsys.readouterr()
        status = main(list(arguments))
        told = self._capsys.readouterr()
        return status, told.out, told.err


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Desk:
    monkeypatch.chdir(tmp_path)
    return Desk(tmp_path, capsys)


def summary(text: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(text)
    assert found.pop("timing")["wall_s"] > 0.0
    return found


# --- wrong use --------------------------------------------------------------------------------------------

WRONG: list[tuple[list[str], str]] = [
    ([], "COMMAND"),
    (["fly"], "'fly'"),
    (["run", "utclat"], "did you mean 'ut-clat'?"),
    (["run", "gone.toml"], "gone.toml: no such file"),
    (["run", "."], "a TOML file is needed"),
    (["run", "ut-clat", "--set", "links.los=0.3"], "did you mean 'loss'?"),
    (["run", "ut-clat", "--set", "links.loss"], "KEY=VALUE"),
    (["run", "ut-clat", "--set", "robots.r9.id=r2"], "there are: r1, r2, r3, r4"),
    (["run", "ut-clat", "--set", "robots.r2.sensors.range.sigma_cm=5"], "did you mean 'sigma_m'?"),
    (["run", "ut-clat", "--set", "robots.r2.localization.form=bad"], "'split_joint', 'safe', 'published' or 'joint'"),
    (["run", "ut-clat", "--duration", "100"], "window_s starts at 200 s"),
    (["run", "ut-clat", "--duration", "-1"], "--duration"),
    (["run", "ut-clat", "--duration", "nan"], "--duration"),
    (["run", "ut-clat", "--duration", "soon"], "must be a number"),
    (["run", "ut-clat", "--seed", "x"], "--seed"),
    (["run", "ut-clat", "--seed", "-1"], "seed"),
    (["run", "ut-clat", "--seed", str(2**64)], "seed"),
    (["run", "ut-clat", "--runtime", "magic"], "'virtual'"),
    (["run", "ut-clat", "--speed", "0"], "--speed"),
    (["run", "ut-clat", "--runtime", "virtual", "--speed", "5"], "--speed is for --runtime processes"),
    (["run", "ut-clat", "--colour"], "--colour"),
    (["run", "utias-all"], "world.path"),
    (["run", "utias-all", "--set", "world.path=nowhere"], "no such folder"),
    (["run", "ut-clat", "--set", "world.placement.contact_range_m=0.1"], "contact_range_m"),
    (["montecarlo", "ut-clat"], "--trials"),
    (["montecarlo", "ut-clat", "--trials", "0"], "--trials"),
    (["montecarlo", "ut-clat", "--trials", "1.5"], "whole number"),
    (["montecarlo", "ut-clat", "--trials", "2", "--jobs", "0"], "--jobs"),
    (["montecarlo", "ut-clat", "--trials", "2", "--seed", "-1"], "seed"),
    (["agent", "gone.toml"], "gone.toml: no such file"),
    (["replay", "gone.mcap"], "gone.mcap: no such file"),
    (["report", "gone"], "no readable summary.json"),
    (["report", "gone", "lost"], "gone: no readable summary.json"),
    (["report", "gone", "--out", "new"], "stays in its directory"),
    (["report"], "DIR"),
]


@pytest.mark.parametrize(("arguments", "remedy"), WRONG, ids=[" ".join(arguments) for arguments, _ in WRONG])
def test_wrong_use_is_answered_with_one_line_and_nothing_is_made(desk: Desk, arguments: list[str], remedy: str) -> None:
    status, out, err = desk(*arguments)
    assert status == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert remedy in err
    assert list(desk.folder.iterdir()) == []


def test_a_directory_that_holds_something_is_left_alone(desk: Desk) -> None:
    (desk.folder / "old").mkdir()
    (desk.folder / "old" / "thesis.txt").write_text("precious")
    status, out, err = desk("run", *SHORT, "--out", "old")
    assert (status, out) == (2, "")
    assert "old: not empty; name a new directory" in err
    assert len(err.strip().splitlines()) == 1
    assert [path.name for path in desk.folder.rglob("*")] == ["old", "thesis.txt"]


def test_an_output_that_is_a_file_is_refused(desk: Desk) -> None:
    (desk.folder / "file").write_text("x")
    for out_path in ("file", "file/below"):
        status, _, err = desk("run", *SHORT, "--out", out_path)
        assert status == 2
        assert f"--out {out_path}: cannot be written" in err
        assert len(err.strip().splitlines()) == 1


def test_help_is_not_an_error(desk: Desk) -> None:
    status, out, err = desk("--help")
    assert (status, err) == (0, "")
    for command in ("run", "montecarlo", "agent", "sitl", "replay", "report"):
        assert command in out


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes seconds, and has tests of its own."""
    monkeypatch.setattr("deploy.runs._report", lambda run_dir, summary: run_dir / "report.html")


# --- a run ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_report")
def test_json_alone_goes_to_standard_output_and_equal_runs_are_equal(desk: Desk) -> None:
    status, out, _ = desk("run", *SHORT, "--json", "--out", "one")
    assert status == 0
    first = summary(out)
    assert (first["scenario"], first["runtime"], first["simulated_s"], first["seed"]) == ("ut-clat", "virtual", 30.0, 1)
    assert json.loads((desk.folder / "one" / "summary.json").read_text()) == json.loads(out)
    _, again, _ = desk("run", *SHORT, "--json", "--out", "two")
    assert summary(again) == first
    for name in ("fates.csv", "recording.mcap", "scenario.toml"):
        assert (desk.folder / "one" / name).read_bytes() == (desk.folder / "two" / name).read_bytes()
    _, other, _ = desk("run", *SHORT, "--json", "--out", "three", "--seed", "2")
    assert summary(other)["robots"] != first["robots"]


@pytest.mark.usefixtures("no_report")
def test_a_run_leaves_what_is_needed_to_repeat_and_replay_it(desk: Desk) -> None:
    status, out, err = desk("run", *SHORT, "--out", "one", "--bound", "--set", "robots.r2.localization.form=published")
    assert status == 0
    assert "ut-clat" in out + err
    folder = desk.folder / "one"
    assert tomllib.loads((folder / "agents" / "r2.toml").read_text())["localization"]["form"] == "published"
    first = summary((folder / "summary.json").read_text())
    assert first["bound"]["position_rmse_m"] > 0.0
    # The resolved scenario is a scenario.
    _, again, _ = desk("run", "one/scenario.toml", "--runtime", "virtual", "--bound", "--json", "--out", "two")
    assert summary(again) == first
    status, out, _ = desk("replay", "one/recording.mcap")
    assert status == 0
    assert [line.split(":")[0] for line in out.splitlines()] == ["r1", "r2", "r3", "r4"]
    assert all(line.endswith("all equal") for line in out.splitlines())
    status, out, _ = desk("replay", "one/recording.mcap", "--robot", "r3")
    assert (status, out.count("\n"), out[:3]) == (0, 1, "r3:")
    status, out, err = desk("replay", "one/recording.mcap", "--robot", "r9")
    assert (status, out) == (2, "")
    assert "no robot 'r9'; it holds r1, r2, r3, r4" in err


@pytest.mark.usefixtures("no_report")
def test_without_out_the_run_goes_to_a_new_directory_under_runs(desk: Desk) -> None:
    status, _, _ = desk("run", *SHORT, "--json")
    assert status == 0
    (folder,) = (desk.folder / "runs").iterdir()
    assert folder.name.startswith("ut-clat-")
    assert (folder / "summary.json").exists()


@pytest.mark.usefixtures("no_report")
def test_a_run_that_breaks_its_own_expectations_says_which(desk: Desk) -> None:
    limits = ["--set", 'expect={"fleet.position_rmse_m" = {max = 0.0001}, "trials" = {min = 1}}']
    status, out, err = desk("run", *SHORT, "--json", *limits, "--out", "one")
    assert status == 1
    assert summary(out)["trials"] == 1
    assert "expectation not met: fleet.position_rmse_m" in err
    assert "is above 0.0001" in err


@pytest.mark.usefixtures("no_report")
def test_many_trials_leave_a_table_and_a_summary(desk: Desk) -> None:
    some = ["ut-clat", "--duration", "20", "--set", "window_s=[0,20]", "--trials", "2", "--jobs", "1"]
    status, out, _ = desk("montecarlo", *some, "--json", "--out", "many", "--seed", "5")
    assert status == 0
    assert (summary(out)["trials"], summary(out)["seed"]) == (2, 5)
    rows = (desk.folder / "many" / "trials.csv").read_text().splitlines()
    assert [row.split(",")[:2] for row in rows[1:]] == [["0", "5"], ["1", "6"]]


@pytest.mark.usefixtures("no_report")
def test_runs_are_compared_on_one_page_that_can_be_written_again(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    compared: list[tuple[list[str], Path, str]] = []

    def note(runs: list[tuple[str, Path]], out_dir: Path, title: str) -> Path:
        compared.append(([name for name, _ in runs], out_dir, title))
        (out_dir / "plots").mkdir(exist_ok=True)
        (out_dir / "comparison.html").write_text(title)
        return out_dir / "comparison.html"

    monkeypatch.setattr("sim.comparison.write_comparison", note)
    short = ["ut-clat", "--duration", "5", "--set", "window_s=[0,5]"]
    for name in ("one", "two", "more/one"):
        assert desk("run", *short, "--out", name)[0] == 0
    vary = ["--vary", "links.loss=0,0.3", "--trials", "1", "--jobs", "1", "--out", "varied"]
    assert desk("montecarlo", *short, *vary)[0] == 0
    compared.clear()
    for _ in range(2):
        status, out, _ = desk("report", "one", "two", "more/one", "varied", "--out", "new")
        assert (status, json.loads(out)) == (0, {"report": str(desk.folder / "new" / "comparison.html")})
    assert compared[0] == (["one", "two", "more/one", "loss=0", "loss=0.3"], desk.folder / "new", "ut-clat")
    for taken in ("more", "varied"):
        status, _, err = desk("report", "one", "two", "--out", taken)
        assert status == 2
        assert f"{taken}: not empty" in err
    status, out, _ = desk("report", "varied")
    assert (status, json.loads(out)) == (0, {"report": "varied/comparison.html"})
    assert compared[-1] == (["loss=0", "loss=0.3"], Path("varied"), "ut-clat")
    assert desk("report", "one", "two")[0] == 0
    assert compared[-1][1].name.startswith("comparison-")


def test_a_run_has_a_report_that_can_be_written_again(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.plots.DPI", 50)
    short = ["ut-clat", "--duration", "5", "--set", "window_s=[0,5]"]
    status, out, err = desk("run", *short, "--out", "one")
    assert status == 0
    report = desk.folder / "one" / "report.html"
    assert "ut-clat" in report.read_text()
    assert str(report) in out + err
    report.unlink()
    status, out, _ = desk("report", "one")
    assert status == 0
    assert json.loads(out) == {"report": "one/report.html"}
    assert report.exists()
