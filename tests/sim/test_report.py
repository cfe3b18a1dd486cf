"""The report: one page with everything in it, made from a small fleet whose figures are known."""

from __future__ import annotations

import base64
import builtins
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim import availability, plots
from sim.animation import unpack
from sim.metrics import StateTrace, TrialTrace, summarize
from sim.report import ReportUnavailable, write_report
from sim.store import Instants, Stored
from sim.tables import motion

Array = NDArray[np.float64]
PNG = b"\x89PNG\r\n\x1a\n"
SECONDS = 60
LANDMARKS = {"L6": (0.0, 5.0), "L7": (4.0, -3.0)}
CONTACTS = [(5.0, "r1", "r2"), (5.1, "r2", "r1"), (9.0, "r3", "r1")]
MEASURED: Instants = {
    ("r1", "r2"): np.arange(3.0, 20.0),
    ("r1", "target:t1"): np.arange(0.0, 60.0),
    ("r2", "target:t1"): np.arange(30.0, 45.0),
}


def circle(rng: np.random.Generator, radius: float, n: int = 3) -> StateTrace:
    """A round of a circle with an estimate a few centimetres off."""
    angle = np.linspace(0.0, 6.0, SECONDS + 1)
    heading = [angle + np.pi / 2.0] if n == 3 else [-np.sin(angle), np.cos(angle)]
    truth = np.stack([radius * np.cos(angle), radius * np.sin(angle), *heading], axis=1)
    mean = truth + 0.05 * rng.normal(size=truth.shape)
    return StateTrace(truth, mean, np.tile(0.0025 * np.eye(n), (SECONDS + 1, 1, 1)), (2,) if n == 3 else ())


def trial(seed: int, robots: int = 3) -> TrialTrace:
    """Robots on circles tracking one target; the first robot gets to know the target late."""
    rng = np.random.default_rng(seed)
    names = [f"r{index + 1}" for index in range(robots)]
    fleet = {name: circle(rng, 2.0 + index) for index, name in enumerate(names)}
    tracks = {name: circle(rng, 1.0, 4) for name in names}
    tracks["r1"].mean[:20], tracks["r1"].cov[:20] = np.nan, np.nan
    own = {"robots": {name: circle(rng, 2.0) for name in names}, "targets": {"t1": circle(rng, 1.0, 4)}}
    return TrialTrace(np.arange(SECONDS + 1) * 1.0, fleet, {"t1": tracks}, own)


def kept(trace: TrialTrace) -> Stored:
    """The trial with a few contacts and measurements, as a run directory keeps it."""
    return Stored(trace, CONTACTS, LANDMARKS, MEASURED)


def summary_of(traces: list[TrialTrace], **change: Any) -> dict[str, Any]:
    """A whole summary around the traces' figures."""
    figures = summarize(traces, (10.0, 60.0), 8.0)
    pair = {"started": 40, "completed": 36, "one_sided": 2, "fallback": 1, "too_old": 3}
    return {
        "schema": 1,
        "scenario": "circles",
        "runtime": "virtual",
        "seed": 7,
        "trials": len(traces),
        "window_s": [10.0, 60.0],
        "simulated_s": 60.0,
        **figures,
        "network": {
            "sent": 12345,
            "delivered": 23456,
            "lost": 1234,
            "bytes": 3_456_789,
            "bytes_per_robot_s": 321.0,
            "pair": pair,
        },
        "rejected": {"duplicate": 17, "too_old": 4},
        "covariance_repairs": 0,
        "faults": [],
        "exit": dict.fromkeys(traces[0].robots, 0),
        "timing": {"wall_s": 1.0},
        **change,
    }


MOTION = {
    "collisions": 3.0,
    "min_distance_m": 0.87,
    "connected_share": 0.75,
    "speed_mps": 0.42,
    "target_seen_share": 0.31,
    "collision_m": 1.5,
}


class Page(HTMLParser):
    """What a reader sees: texts, pictures, rows of tables; and whatever would be fetched from elsewhere."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.pictures: dict[str, bytes] = {}
        self.outside: list[str] = []
        self.rows: list[list[str]] = []
        self.words: list[str] = []
        self.scripts: list[str] = []
        self._open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        self.close()
        assert not self._open, f"unclosed: {self._open}"
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag not in ("meta", "img", "br", "input"):
            self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
        for key in ("src", "href"):
            value = given.get(key) or ""
            if value.startswith("data:image/png;base64,"):
                self.pictures[given.get("alt") or ""] = base64.b64decode(value.partition(",")[2], validate=True)
            elif value:
                self.outside.append(value)
        if tag in ("link", "iframe"):
            self.outside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "style":
            if "url(" in data or "@import" in data:
                self.outside.append(data)
            return
        if self._open and self._open[-1] == "script":
            self.outside += re.findall(r"\w*://\S*|fetch\(|XMLHttpRequest|import\(", data)
            self.scripts.append(data)
            return
        self.words.append(data)
        if {"td", "th"} & set(self._open):
            self.rows[-1][-1] += data

    def row(self, first: str) -> list[str]:
        found = [row for row in self.rows if row and row[0] == first]
        assert len(found) == 1, f"{first}: {len(found)} rows"
        return found[0]


@pytest.fixture(scope="module", autouse=True)
def _coarse_pictures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plots, "DPI", 50)
        yield


@pytest.fixture(scope="module")
def one_trial(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any], Page]:
    """Report of a single trial with everything to show."""
    run_dir = tmp_path_factory.mktemp("run")
    (run_dir / "command.txt").write_text("cofix run circles --seed 7 --set 'name=\"<b>\"'\n")
    trace = trial(1)
    summary = summary_of([trace])
    path = write_report(run_dir, summary, kept(trace), "Circles & <targets>")
    assert path == run_dir / "report.html"
    return run_dir, summary, Page(path)


def test_the_page_stands_alone_with_all_pictures_inside(one_trial: tuple[Path, dict[str, Any], Page]) -> None:
    run_dir, _, page = one_trial
    assert page.outside == []
    files = sorted(file.name for file in (run_dir / "plots").iterdir())
    assert files == ["contacts.png", "errors.png", "nees.png", "sightings.png", "targets.png", "trajectories.png"]
    embedded = sorted(page.pictures.values())
    assert embedded == sorted((run_dir / "plots" / name).read_bytes() for name in files)
    assert all(data.startswith(PNG) and len(data) > 1_000 for data in embedded)


def test_the_page_says_what_the_summary_says(one_trial: tuple[Path, dict[str, Any], Page]) -> None:
    _, summary, page = one_trial
    fleet, bound = summary["fleet"], summary["bound"]
    assert f"{fleet['position_rmse_m']:.2f} m fleet position RMSE" in page.text
    assert f"{fleet['position_rmse_m'] / bound['position_rmse_m']:.2f} × the centralized filter's RMSE" in page.text
    assert f"{fleet['anees']:.2f} ANEES, ideal 1 consistent" in page.text
    assert "12,345 messages" in page.text
    assert "321 B sent per robot and second" in page.text
    for name, entry in summary["robots"].items():
        row = next(row for row in page.rows if row and row[0] == name)
        assert row[1] == f"{entry['position_rmse_m']:.3f}"
        assert row[4] == f"{entry['heading_rmse_rad']:.3f}"
        assert row[5] == f"{entry['anees']:.2f}"
    assert page.row("fleet")[1] == f"{fleet['position_rmse_m']:.3f}"
    assert page.row("centralized filter")[1] == f"{bound['position_rmse_m']:.3f}"
    track = summary["targets"]["t1"]["r2"]
    assert page.row("t1 by r2")[1:3] == [f"{track['position_rmse_m']:.3f}", f"{track['velocity_rmse_mps']:.3f}"]
    assert page.row("duplicate") == ["duplicate", "17"]
    assert page.row("bytes sent") == ["bytes sent", "3.5 MB", "321 B"]
    assert page.row("messages sent") == ["messages sent", "12,345", f"{12345 / (60.0 * 3):.3f}"]
    assert page.row("contacts used by both sides") == ["contacts used by both sides", "36", "0.200"]


def test_extremes_stand_side_by_side_as_smallest_and_largest(one_trial: tuple[Path, dict[str, Any], Page]) -> None:
    _, summary, page = one_trial
    (line,) = [index for index, row in enumerate(page.rows) if row == ["", "own state", "track of t1"]]
    assert page.rows[line + 1] == ["", "x [m]", "y [m]", "heading [rad]", "x [m]", "y [m]", "vx [m/s]", "vy [m/s]"]
    own, track = summary["robots"]["r2"], summary["targets"]["t1"]["r2"]
    row = page.rows[line + 3]
    assert row[0] == "r2"
    assert row[3] == f"{own['error_min']['heading_rad']:.2f} / {own['error_max']['heading_rad']:.2f}"
    assert row[4] == f"{track['error_min']['x_m']:.2f} / {track['error_max']['x_m']:.2f}"


def test_over_trials_extremes_are_the_median_and_the_worst(tmp_path: Path) -> None:
    summary = summary_of([trial(seed) for seed in range(3)])
    page = Page(write_report(tmp_path, summary, None, "circles"))
    own = summary["robots"]["r1"]
    assert own["error_worst"]["x_m"] > own["error_max"]["x_m"]
    assert f"{own['error_max']['x_m']:.2f} / {own['error_worst']['x_m']:.2f}" in [
        row[1] for row in page.rows if row[1:]
    ]


def test_innovations_far_from_one_are_flagged(tmp_path: Path) -> None:
    summary = summary_of([trial(1)])
    summary["robots"]["r1"]["nis"] = {"pair_range": 1.1, "pose": 2.5}
    summary["robots"]["r2"]["nis"] = {"pair_range": 0.2}
    page = Page(write_report(tmp_path, summary, None, "circles"))
    assert ["r1", "1.10", "2.50 ▲"] in page.rows
    assert ["r2", "0.20 ▽", "–"] in page.rows
    assert ["ideal", "1", "1"] in page.rows
    assert '<td class="warn">2.50 ▲</td>' in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_player_has_the_trial(one_trial: tuple[Path, dict[str, Any], Page]) -> None:
    _, _, page = one_trial
    data, script = page.scripts
    film = json.loads(data)
    assert [robot["name"] for robot in film["robots"]] == ["r1", "r2", "r3"]
    truth = trial(1).robots["r2"].truth
    np.testing.assert_allclose(unpack(film["robots"][1]["channels"]["X"]), truth[:, 0], atol=1e-3)
    assert "getContext" in script


def test_names_and_the_command_are_shown_not_interpreted(one_trial: tuple[Path, dict[str, Any], Page]) -> None:
    run_dir, _, page = one_trial
    assert "Circles & <targets>" in page.text
    assert "cofix run circles --seed 7 --set 'name=\"<b>\"'" in page.text
    assert '<b>"' not in (run_dir / "report.html").read_text(encoding="utf-8")


def test_a_quiet_run_has_no_warnings_and_an_ill_one_says_why(
    tmp_path: Path, one_trial: tuple[Path, dict[str, Any], Page]
) -> None:
    assert "ended early" not in one_trial[2].text
    assert not any("exit" in row for row in one_trial[2].rows)
    assert "Injected" not in one_trial[2].text
    trace = trial(1)
    trace.robots["r2"].mean[:, 0] += 20.0
    ill = summary_of([trace], exit={"r1": 0, "r2": -9, "r3": 0}, faults=["loss 0.3"], covariance_unusable=2)
    page = Page(write_report(tmp_path, ill, None, "ill"))
    assert "Agents that ended early: r2 (exit -9)." in page.text
    assert "-9" in [row[-1] for row in page.rows if row and row[0] == "r2"]
    assert "Injected: loss 0.3." in page.text
    assert "this trial counts as lost" in page.text
    assert "2 estimates had no positive definite covariance" in page.text
    assert "overconfident" in page.text


def test_many_trials_show_errors_over_time_and_who_was_lost(tmp_path: Path) -> None:
    traces = [trial(seed) for seed in range(4)]
    traces[2].robots["r1"].mean[:, 1] += 30.0
    page = Page(write_report(tmp_path, summary_of(traces), None, "circles"))
    assert sorted(file.name for file in (tmp_path / "plots").iterdir()) == ["anees.png", "rmse.png"]
    assert list(page.pictures) == ["Position error over time", "Consistency over time"]
    assert page.scripts == []
    assert "averages of 3 trials of an honest filter" in page.text
    assert "1 of 4 trials lost" in page.text
    assert page.row("fleet, median trial")
    assert float(page.row("fleet, lost trials included")[1]) > float(page.row("fleet")[1])


def test_a_run_without_targets_bound_or_contacts_is_a_shorter_page(tmp_path: Path) -> None:
    full = trial(1)
    trace = TrialTrace(full.t_s, full.robots, {})
    page = Page(write_report(tmp_path, summary_of([trace], rejected={}), Stored(trace, [], {}), "alone"))
    assert sorted(page.pictures) == [
        "Consistency",
        "Localization errors inside their claimed bounds",
        "Where they went",
    ]
    assert "centralized filter" not in {row[0] for row in page.rows if row}
    assert "No message was refused." in page.text


def test_robots_that_never_had_an_estimate_do_not_stop_the_report(tmp_path: Path) -> None:
    trace = trial(1)
    for states in (trace.robots, trace.targets["t1"]):
        states["r3"].mean[:], states["r3"].cov[:] = np.nan, np.nan
    page = Page(write_report(tmp_path, summary_of([trace]), kept(trace), "silent"))
    assert "–" in [row[1] for row in page.rows if row and row[0] == "r3"]
    assert len(page.pictures) == 6


def test_a_flying_robot_shows_its_altitude_and_what_else_it_estimates(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    truth = np.cumsum(rng.normal(size=(SECONDS + 1, 5)), axis=0)
    cov = np.tile(0.01 * np.eye(5), (SECONDS + 1, 1, 1))
    drone = StateTrace(truth, truth + 0.1 * rng.normal(size=truth.shape), cov, (3,), (0, 1, 2))
    trace = TrialTrace(trial(1).t_s, {"drone": drone, **trial(1).robots}, {})
    summary = summary_of([trace])
    page = Page(write_report(tmp_path, summary, Stored(trace, [], {}), "mixed"))
    assert ["", "x [m]", "y [m]", "z [m]", "heading [rad]", "parameter 1"] in page.rows
    largest = summary["robots"]["drone"]["error_max"]
    (row,) = [row for row in page.rows if row[0] == "drone" and row[1].count("/")]
    assert row[3].endswith(f"/ {largest['z_m']:.2f}")
    assert [row[3] for row in page.rows if row[0] == "r1" and row[1].count("/")] == ["–"]


def test_a_big_fleet_is_cut_to_what_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "MAX_PANELS", 2)
    monkeypatch.setattr(availability, "MAX_ROWS", 3)
    trace = trial(1, robots=9)
    contacts = [(1.0, f"r{a}", f"r{b}") for a in range(1, 10) for b in range(1, a)]
    page = Page(write_report(tmp_path, summary_of([trace]), Stored(trace, contacts, {}), "swarm"))
    assert page.text.count("The 2 with the largest errors of 9.") == 3
    heights = {name: int.from_bytes(data[20:24], "big") / plots.DPI for name, data in page.pictures.items()}
    assert heights["Localization errors inside their claimed bounds"] < 3.5
    assert heights["Who could measure whom, and contacts"] < 2.0
    named = [row[0] for row in page.rows if re.fullmatch(r"r\d+", row[0])]
    assert named[:9] == [f"r{k}" for k in range(1, 10)]


def test_writing_it_again_replaces_it(tmp_path: Path) -> None:
    trace = trial(1)
    for title in ("first", "second"):
        write_report(tmp_path, summary_of([trace]), None, title)
    assert "second" in Page(tmp_path / "report.html").text


def test_without_matplotlib_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name.partition(".")[0] == "matplotlib":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ReportUnavailable, match=r"pip install 'cofix\[report\]'"):
        write_report(tmp_path, summary_of([trial(1)]), None, "none")
    assert list(tmp_path.iterdir()) == []


def least_gap(palette: tuple[str, ...]) -> float:
    """Smallest distance of two colours as seen with deuteranopia (Vienot, Brettel, Mollon 1999)."""
    codes = [[int(code[k : k + 2], 16) / 255.0 for k in (1, 3, 5)] for code in palette]
    sight = np.array([[0.29275, 0.70725, -0.02978], [0.29275, 0.70725, -0.02978], [-0.02233, 0.02233, 1.0]])
    seen = np.clip(np.array(codes) ** 2.2 @ sight.T, 0.0, 1.0) ** (1.0 / 2.2)
    return min(float(np.linalg.norm(a - b)) for k, a in enumerate(seen) for b in seen[k + 1 :])


def test_colours_are_told_apart_by_anyone() -> None:
    assert least_gap(plots.PALETTE) > 0.18
    assert least_gap(("#2ca02c", "#d62728")) < 0.18
    assert len({plots.colour(index) for index in range(len(plots.PALETTE))}) == len(plots.PALETTE)


def test_motion_is_told_and_distances_are_drawn(tmp_path: Path) -> None:
    trace = trial(1)
    page = Page(write_report(tmp_path, summary_of([trace], motion=MOTION), kept(trace), "moving"))
    assert ["3", "0.87", "75 %", "31 %", "0.42"] in page.rows
    assert "nearer than 1.5 m" in page.text
    assert page.pictures["How far robots were from each other"].startswith(PNG)


def test_a_formation_is_told_where_there_is_one() -> None:
    formation = {"formation_error": 0.046, "formation_kept_share": 0.984, "target_min_distance_m": 10.59}
    for found, told in ((MOTION | formation, True), (MOTION, False)):
        text = motion({"motion": found, "trials": 1})
        assert ("formation kept" in text) is told
        assert all((value in text) is told for value in (">5 %<", ">98 %<", ">10.59<"))


def test_motion_nobody_knows_is_left_out(tmp_path: Path) -> None:
    trace = trial(1)
    unknown = {**dict.fromkeys(MOTION), "collision_m": 1.5}
    page = Page(write_report(tmp_path, summary_of([trace], motion=unknown), kept(trace), "moving"))
    assert "Motion" not in page.text
    assert "How far robots were from each other" not in page.pictures
