"""What the documents tell people to type works."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from benchmarks import active
from deploy.cli import parser
from sim.scenario_file import bundled, load
from tests.sizes import THOROUGH

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
PLACEHOLDERS = {"NAME-TIME": "demo-1", "CONFIG": "r1.toml", "FOLDER_OF_MRCLAM_Dataset7": "folder"}


def commands(document: Path) -> list[str]:
    """Lines of indented blocks that start with `cofix`, without comments."""
    found = []
    for line in document.read_text().splitlines():
        match = re.match(r"    (cofix .*)", line)
        if match:
            found.append(match.group(1).split("  #")[0].strip())
    return found


ALL = [(document.name, line) for document in DOCUMENTS for line in commands(document)]


@pytest.mark.parametrize(("document", "line"), ALL)
def test_commands_are_understood(document: str, line: str) -> None:
    for name, value in PLACEHOLDERS.items():
        line = line.replace(name, value)
    options = parser().parse_args(shlex.split(line)[1:])
    if getattr(options, "scenario", None) is not None:
        load(options.scenario, options.set)


def test_commands_that_compare_planners_are_understood() -> None:
    told = [line for path in DOCUMENTS for line in re.findall(r"python -m benchmarks\.active(.*)", path.read_text())]
    assert len(told) >= 3
    for line in told:
        active.parser().parse_args(shlex.split(re.split(r"  #|`", line)[0]))


def test_the_readme_shows_commands() -> None:
    assert len(commands(ROOT / "README.md")) >= 8


def test_the_readme_names_every_scenario_and_no_other() -> None:
    rows = re.findall(r"^\| `([a-z0-9-]+)` \|", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert sorted({row for row in rows if row in bundled()}) == bundled()


def test_a_readme_run_works_as_written_but_shorter(tmp_path: Path) -> None:
    line = next(i for i in commands(ROOT / "README.md") if i.startswith("cofix run") and "links.loss" in i)
    arguments = [*shlex.split(line)[1:], "--duration", "20", "--set", "window_s=[5, 20]"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "deploy.cli", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs").iterdir()
    told = re.findall(r"^\| `([\w./<>{}-]+)`", (ROOT / "docs" / "interfaces.md").read_text(), re.MULTILINE)
    for name in ("scenario.toml", "summary.json", "report.html", "recording.mcap", "trace.npz", "fates.csv"):
        assert name in told
        assert (run / name).exists()


PROMISES = (
    ("What holds then, in numbers", "After a restart a robot goes on"),
    ("What is promised of planners and rounds", "## Measured"),
)
"""Words before and after what README promises."""


def promises() -> list[str]:
    """What README promises under faults and of robots that choose their motion, item by item."""
    text = (ROOT / "README.md").read_text()
    parts = [text[text.index(begin) : text.index(end)] for begin, end in PROMISES]
    return [item for part in parts for item in re.findall(r"^- .*(?:\n  .*)*", part, re.MULTILINE)]


@pytest.mark.parametrize("promise", promises(), ids=lambda promise: promise[2:30])
def test_a_promise_has_a_number_and_a_test_that_exists(promise: str) -> None:
    links = re.findall(r"\[(\w+)\]\(([\w/.]+)#(\w+)\)", promise)
    assert links, "no test is linked"
    assert re.search(r"\d|bit", re.sub(r"\[.*?\]\(.*?\)", "", promise)), "no number"
    for label, path, name in links:
        assert label == name
        assert re.search(rf"^def {name}\(", (ROOT / path).read_text(), re.MULTILINE), f"{path} has no {name}"


def test_the_readme_s_test_of_a_fleet_passes(tmp_path: Path) -> None:
    """In virtual time; both runtimes are in tests/examples."""
    text = (ROOT / "README.md").read_text()
    (block,) = re.findall(r"^    import pytest\n(?:(?:    .*)?\n)*", text, re.MULTILINE)
    (tmp_path / "test_own.py").write_text(textwrap.dedent(block))
    which = [] if THOROUGH else ["-k", "virtual"]
    done = subprocess.run(
        [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", *which, "test_own.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert ("2 passed" if THOROUGH else "1 passed") in done.stdout


def test_the_map_names_files_that_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    for floor, files in re.findall(r"^\| `(network|agent|sim|deploy)/([\w.]+)`", text, re.MULTILINE):
        assert (ROOT / floor / files).exists(), f"{floor}/{files}"
