"""`cofix montecarlo`: going on where it stopped, variants, and trials that fail."""

from __future__ import annotations

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from deploy import montecarlo
from deploy.cli import main, parser, usable_cores
from deploy.status import TrialProgress, duration
from sim.montecarlo import Pace, WorkerDied, Workers
from sim.scenario_file import load
from sim.trial_store import FILE, TrialStore, records

COFIX = (sys.executable, "-P", "-m", "deploy.cli")
SHORT = ["ut-clat", "--duration", "20", "--set", "window_s=[0,20]", "--seed", "5"]


class Desk:
    """A terminal in an empty folder."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys

    def __call__(self, *arguments: str) -> tuple[int, str, str]:
        """Exit status, standard output, standard error of `cofix montecarlo`."""
        self._capsys.readouterr()
        status = main(["montecarlo", *arguments])
        told = self._capsys.readouterr()
        return status, told.out, told.err

    def summary(self, *arguments: str) -> dict[str, Any]:
        """What a run that goes well prints, without what may differ."""
        status, out, err = self(*arguments, "--json")
        assert status == 0, err
        return without_timing(json.loads(out))

    def seeds(self, run: str) -> list[int]:
        """Seeds whose trials are kept, in the order they were finished."""
        return [seed for _, seed, _ in records((self.folder / run / FILE).read_bytes())]


def without_timing(summary: dict[str, Any]) -> dict[str, Any]:
    for one in summary.get("variants", {"": summary}).values():
        assert one.pop("timing")["wall_s"] > 0.0
    return summary


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Desk:
    monkeypatch.chdir(tmp_path)
    # Drawing takes seconds, and has tests of its own.
    monkeypatch.setattr("deploy.runs._report", lambda run_dir, summary: run_dir / "report.html")
    return Desk(tmp_path, capsys)


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, list[str]]]:
    """Comparison pages asked for: where, and of which variants."""
    asked: list[tuple[Path, list[str]]] = []

    def compare(top: Path, planned: list[Any], summaries: dict[str, Any], *, quiet: bool) -> None:
        asked.append((top, [series.name for series in planned if series.name in summaries]))

    monkeypatch.setattr(montecarlo, "_compare", compare)
    return asked


# --- going on ----------------------------------------------------------------------------------------------


def test_results_do_not_depend_on_jobs_or_interruptions(desk: Desk) -> None:
    whole = [*SHORT, "--trials", "5", "--bound"]
    alone = desk.summary(*whole, "--jobs", "1", "--out", "alone")
    assert alone["trials"] == 5
    assert alone["bound"]["position_rmse_m"] > 0.0
    assert desk.summary(*whole, "--jobs", "2", "--out", "together") == alone
    # Interrupted twice: two trials were done, then a third record was cut in the middle.
    few = [*SHORT, "--trials", "2", "--bound", "--out", "pieces"]
    assert desk.summary(*few, "--jobs", "1") != alone
    record = (desk.folder / "alone" / FILE).read_bytes()[:1000]
    with (desk.folder / "pieces" / FILE).open("ab") as file:
        file.write(record)
    assert desk.summary(*whole, "--jobs", "1", "--out", "pieces", "--resume") == alone
    assert sorted(desk.seeds("pieces")[:2]) == [5, 6]
    assert desk.seeds("pieces")[2:] == [7, 8, 9]
    saved = without_timing(json.loads((desk.folder / "pieces" / "summary.json").read_text()))
    assert saved == alone
    tables = [(desk.folder / run / "trials.csv").read_bytes() for run in ("alone", "together", "pieces")]
    assert tables[0] == tables[1] == tables[2]


def test_the_same_command_again_plays_nothing_twice(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    command = [*SHORT, "--trials", "2", "--jobs", "1", "--out", "one"]
    first = desk.summary(*command)
    monkeypatch.setattr("sim.montecarlo.run_trial", lambda *_, **__: pytest.fail("played again"))
    assert desk.summary(*command) == first
    fewer = desk.summary(*SHORT, "--trials", "1", "--out", "one", "--resume")
    assert fewer["trials"] == 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (["--set", "links.loss=0.3"], "links.loss is 0.0 there, 0.3 here"),
        (["--bound"], "bound is false there, true here"),
        (["--seed", "6"], "seed is 5 there, 6 here"),
        (["--vary", "links.loss=0,1"], 'vary is absent there, ["links.loss"] here'),
    ],
)
def test_a_directory_made_with_other_settings_is_refused(desk: Desk, change: list[str], told: str) -> None:
    command = [*SHORT, "--trials", "1", "--jobs", "1", "--out", "one"]
    desk.summary(*command)
    before = {path: path.read_bytes() for path in desk.folder.rglob("*") if path.is_file()}
    for resume in ([], ["--resume"]):
        status, out, err = desk(*command, *change, *resume)
        assert (status, out) == (2, "")
        assert len(err.strip().splitlines()) == 1
        assert told in err
        assert "name a new directory" in err
    assert {path: path.read_bytes() for path in desk.folder.rglob("*") if path.is_file()} == before


def test_trials_of_other_code_are_not_mixed_with_new_ones(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    command = [*SHORT, "--trials", "1", "--jobs", "1", "--out", "one"]
    desk.summary(*command)
    monkeypatch.setattr("sim.provenance._code", lambda: "changed")
    status, _, err = desk(*command)
    assert status == 2
    assert "software.code" in err


def test_resume_says_what_it_needs(desk: Desk) -> None:
    status, _, err = desk(*SHORT, "--trials", "1", "--resume")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "--out DIR" in err
    status, _, err = desk(*SHORT, "--trials", "1", "--resume", "--out", "gone")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "holds no trials" in err
    assert list(desk.folder.iterdir()) == []


def test_a_directory_another_run_writes_to_is_left_alone(desk: Desk) -> None:
    command = [*SHORT, "--trials", "1", "--jobs", "1", "--out", "one"]
    desk.summary(*command)
    with TrialStore(desk.folder / "one"):
        status, _, err = desk(*command, "--resume")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "another run is writing to it" in err


def test_an_interrupted_run_says_how_to_go_on_and_the_line_works(tmp_path: Path) -> None:
    command = [*COFIX, "montecarlo", *SHORT, "--trials", "400", "--jobs", "2", "--json"]
    run = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Whoever starts the tests may ignore interrupts; a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 60.0
        while not list(tmp_path.glob(f"runs/*/{FILE}")) or not _kept(tmp_path):
            assert time.monotonic() < deadline, "no trial was finished"
            assert run.poll() is None, "it ended before its trials were played"
            time.sleep(0.05)
        os.killpg(run.pid, signal.SIGINT)
        out, err = run.communicate(timeout=60)
    finally:
        run.kill()
        run.wait()
    assert (run.returncode, out) == (1, "")
    # On a busy computer lines of progress come first.
    line = err.strip().splitlines()[-1]
    done = _kept(tmp_path)
    assert f"interrupted; {done} of 400 trials are kept; go on with: cofix montecarlo" in line
    (folder,) = (tmp_path / "runs").iterdir()
    with (folder / "trials.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == done
    again = shlex.split(line.partition("go on with: cofix ")[2])
    again[again.index("400")] = "2"
    ended = subprocess.run([*COFIX, *again], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout)["trials"] == 2


def _kept(folder: Path) -> int:
    (path,) = folder.glob(f"runs/*/{FILE}")
    return sum(1 for _ in records(path.read_bytes()))


# --- trials that fail --------------------------------------------------------------------------------------


def test_a_failed_trial_names_its_seed_and_costs_no_other(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    from sim.trial import run_trial

    def sometimes(scenario: Any, seed: int, **options: Any) -> Any:
        if seed == 6:
            raise ZeroDivisionError("nothing\nleft")
        return run_trial(scenario, seed, **options)

    monkeypatch.setattr("sim.montecarlo.run_trial", sometimes)
    command = [*SHORT, "--trials", "3", "--jobs", "1", "--out", "one", "--json"]
    status, out, err = desk(*command)
    assert status == 1
    summary = json.loads(out)
    assert summary["trials"] == 2
    assert list(summary["failed"]) == ["6"]
    assert summary["failed"]["6"].startswith("ZeroDivisionError: nothing left (test_montecarlo.py:")
    (line,) = err.strip().splitlines()
    assert "seed 6 failed: ZeroDivisionError: nothing left" in line
    again = parser().parse_args(shlex.split(line.partition("replay it: cofix ")[2]))
    assert (again.command, again.seed, again.runtime) == ("run", 6, "virtual")
    assert load(again.scenario).duration_s == 20.0
    assert sorted(desk.seeds("one")) == [5, 7]
    # Once it does not fail any more, only that one is played.
    monkeypatch.setattr("sim.montecarlo.run_trial", run_trial)
    healed = desk.summary(*command[:-1], "--resume")
    assert "failed" not in healed
    assert desk.seeds("one") == [5, 7, 6]
    assert healed == desk.summary(*SHORT, "--trials", "3", "--jobs", "1", "--out", "two")


def test_when_every_trial_fails_there_is_no_summary(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> Any:
        raise ValueError

    monkeypatch.setattr("sim.montecarlo.run_trial", never)
    status, out, err = desk(*SHORT, "--trials", "2", "--jobs", "1", "--out", "one", "--json")
    assert (status, out) == (1, "")
    assert "every trial failed" in err
    assert [line.split()[2] for line in err.splitlines() if "replay it" in line] == ["5", "6"]
    assert not (desk.folder / "one" / "summary.json").exists()


def test_a_worker_that_dies_leaves_what_is_done(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def dying(self: Workers, which: int, tasks: Any) -> Iterator[Any]:
        yield next(iter(play(self, which, tasks)))
        raise WorkerDied("a worker process was killed")

    play = Workers.play
    monkeypatch.setattr(Workers, "play", dying)
    command = [*SHORT, "--trials", "3", "--jobs", "1", "--out", "one"]
    status, out, err = desk(*command)
    assert (status, out) == (1, "")
    told = (
        f"a worker process was killed; 1 of 3 trials are kept; go on with: cofix {shlex.join(['montecarlo', *command])}"
    )
    assert err.strip() == f"cofix: {told} --resume"
    monkeypatch.setattr(Workers, "play", play)
    assert desk.summary(*command, "--resume") == desk.summary(*SHORT, "--trials", "3", "--jobs", "1", "--out", "two")


# --- variants ----------------------------------------------------------------------------------------------


def test_each_variant_is_the_run_it_would_be_alone(desk: Desk, compared: list[tuple[Path, list[str]]]) -> None:
    few = [*SHORT, "--trials", "2", "--bound"]
    varied = [*few, "--vary", "links.loss=0,0.5", "--out", "both"]
    whole = desk.summary(*varied, "--jobs", "2")
    assert list(whole["variants"]) == ["loss=0", "loss=0.5"]
    top = desk.folder / "both"
    assert compared == [(top, ["loss=0", "loss=0.5"])]
    assert without_timing(json.loads((top / "variants.json").read_text())) == whole
    for value in ("0", "0.5"):
        alone = desk.summary(*few, "--set", f"links.loss={value}", "--jobs", "1", "--out", f"alone-{value}")
        assert whole["variants"][f"loss={value}"] == alone
        saved = top / f"loss={value}"
        assert without_timing(json.loads((saved / "summary.json").read_text())) == alone
        assert (saved / "trials.csv").read_bytes() == (desk.folder / f"alone-{value}" / "trials.csv").read_bytes()
        # The command beside it makes the same run.
        again = shlex.split((saved / "command.txt").read_text())[2:]
        assert desk.summary(*again, "--jobs", "1", "--out", f"again-{value}") == alone
        # It may go on alone, as what it is.
        assert desk.summary(*few, "--set", f"links.loss={value}", "--out", str(saved), "--resume") == alone


def test_the_centralized_filter_is_played_once_per_seed(
    desk: Desk, compared: list[tuple[Path, list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sim.trial import run_trial

    asked: list[tuple[float, str, bool]] = []

    def noted(scenario: Any, seed: int, *, with_bound: bool, checker: Any) -> Any:
        asked.append((scenario.links.loss, scenario.localization.transform, with_bound))
        return run_trial(scenario, seed, with_bound=with_bound)

    monkeypatch.setattr("sim.montecarlo.run_trial", noted)
    product = ["--vary", "localization.transform=unscented,jacobian", "--vary", "links.loss=0,0.5"]
    whole = desk.summary(*SHORT, "--trials", "1", "--jobs", "1", "--bound", *product, "--out", "four")
    assert asked == [
        (0.0, "unscented", True),
        (0.5, "unscented", False),
        (0.0, "jacobian", True),
        (0.5, "jacobian", False),
    ]
    assert all(one["bound"]["position_rmse_m"] > 0.0 for one in whole["variants"].values())


def test_variants_go_on_and_may_become_more(desk: Desk, compared: list[tuple[Path, list[str]]]) -> None:
    desk.summary(*SHORT, "--trials", "1", "--jobs", "1", "--vary", "links.loss=0,0.5", "--out", "some")
    whole = desk.summary(
        *SHORT, "--trials", "2", "--jobs", "1", "--vary", "links.loss=0,0.5,0.9", "--out", "some", "--resume"
    )
    assert [one["trials"] for one in whole["variants"].values()] == [2, 2, 2]
    assert [desk.seeds(f"some/loss={value}") for value in ("0", "0.5", "0.9")] == [[5, 6]] * 3
    status, _, err = desk(*SHORT, "--trials", "2", "--vary", "links.delay_s=0,1", "--out", "some", "--resume")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "vary is" in err


def test_a_variant_that_is_no_scenario_is_refused_before_anything_is_made(desk: Desk) -> None:
    status, _, err = desk(*SHORT, "--trials", "1", "--vary", "localization.form=safe,bold", "--out", "one")
    assert (status, len(err.splitlines())) == (2, 1)
    assert "'split_joint', 'safe', 'published' or 'joint'" in err
    assert list(desk.folder.iterdir()) == []


# --- what a person sees ------------------------------------------------------------------------------------


def test_all_usable_cores_are_used_unless_told_otherwise() -> None:
    options = parser().parse_args(["montecarlo", "ut-clat", "--trials", "1"])
    assert options.jobs == usable_cores() == len(os.sched_getaffinity(0))


def test_progress_tells_the_lost_the_speed_and_the_time_left() -> None:
    pace = Pace(2)
    progress = TrialProgress(100, pace)
    progress.kept(10, 1)
    assert progress.text() == "1 lost"
    pace.finished(6.0)
    progress.finished(lost=True, failed=False)
    assert progress.text() == "2 lost, 20/min, 4 min left"
    pace.finished(6.0)
    progress.finished(lost=False, failed=True)
    assert progress.text() == "2 lost, 1 failed, 20/min, 4 min left"


def test_without_a_terminal_progress_is_a_line_at_times(capsys: pytest.CaptureFixture[str]) -> None:
    pace = Pace(1)
    with TrialProgress(3, pace) as progress:
        progress.title = "ut-clat"
        progress.LINE_S = 0.0
        pace.finished(200.0)
        progress.finished(lost=False, failed=False)
    assert capsys.readouterr().err == "ut-clat: 1 of 3 trials, 0 lost, 0.3/min, 7 min left\n"


@pytest.mark.parametrize(
    ("seconds", "told"), [(-3.0, "0 s"), (99.4, "99 s"), (100.0, "2 min"), (5940.0, "99 min"), (7380.0, "2 h 03 min")]
)
def test_durations_are_told_in_a_unit_people_read(seconds: float, told: str) -> None:
    assert duration(seconds) == told


def test_a_broken_invariant_fails_the_trial_and_says_how_to_see_it(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    from sim import invariants

    monkeypatch.setattr(invariants, "MAX_PEERS", 0)
    status, _, err = desk(*SHORT, "--trials", "1", "--jobs", "1", "--check", "--out", "broken")
    assert status == 1 and "InvariantBreach: bounds: r" in err
    replay = shlex.split(err.split("replay it: ")[1].splitlines()[0])
    assert "--check" in replay
    assert main([*replay[1:], "--out", "again"]) == 1
    assert desk(*SHORT, "--trials", "1", "--jobs", "1", "--out", "unchecked")[0] == 0
