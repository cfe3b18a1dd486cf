"""`docs/interfaces.md` is complete and true: every option, key, file and figure is named, every block runs."""

from __future__ import annotations

import argparse
import fnmatch
import json
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin

import msgpack
import pytest
import tomli_w
from pydantic import BaseModel

from agent.config import AgentConfig, load_agent_config
from agent.config_parts import CalibrationPart, IntrinsicsPart, LinksPart, SigmaPart
from agent.events import Observation
from agent.motion_parts import ControlNoisePart, ControlPart, OdometryPart
from agent.sensor_input import ABSOLUTE_KINDS, SIZES, decode
from deploy.cli import main, parser
from network.wire_fields import REASONS
from sim.scenario import Scenario, StartPart
from tests.desk_agent import desk_agent

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "interfaces.md").read_text()
COFIX = (sys.executable, "-P", "-m", "deploy.cli")
SHORT = ["--duration", "20", "--set", "window_s=[5,20]"]


def section(title: str) -> str:
    """The text under a heading, up to the next one of its level or above."""
    start = re.search(rf"^(##+) {re.escape(title)}\n", TEXT, re.MULTILINE)
    assert start is not None, title
    end = re.compile(rf"^#{{2,{len(start.group(1))}}} ", re.MULTILINE).search(TEXT, start.end())
    return TEXT[start.end() : end.start() if end is not None else len(TEXT)]


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)


def quoted(text: str) -> set[str]:
    """What stands in backticks."""
    return set(re.findall(r"`([^`\n]+)`", text))


def lines() -> list[str]:
    """The command lines of the document."""
    found = re.findall(r"^    ((?:cofix|python|echo) .*)$", TEXT, re.MULTILINE)
    return [line.split("  #")[0].strip() for line in found]


# --- blocks ------------------------------------------------------------------------------------------------


def test_every_block_has_a_test() -> None:
    kinds = re.findall(r"^```(\w*)\n.*?^```", TEXT, re.MULTILINE | re.DOTALL)
    assert sorted(kinds) == ["json", "python", "python", "toml"]
    fenceless = re.sub(r"^```.*?^```", "", TEXT, flags=re.MULTILINE | re.DOTALL)
    assert [line.split("  #")[0].strip() for line in re.findall(r"^    (\S.*)$", fenceless, re.MULTILINE)] == lines()


def test_the_datagram_is_a_measurement() -> None:
    (block,) = blocks("json")
    event = decode(msgpack.packb(json.loads(block)), 0, {})
    assert isinstance(event, Observation)
    assert (event.of, event.z.tolist()) == ("r2", [4.21])


def test_the_kinds_of_measurements_are_those_there_are() -> None:
    rows = re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", section("Kinds"), re.MULTILINE)
    assert {kind for kind, _ in rows} == set(SIZES)
    for kind, of in rows:
        assert (of == "nil") == (kind in ABSOLUTE_KINDS or kind == "odometry")


def test_python_blocks_work_on_a_real_agent(capfd: pytest.CaptureFixture[str]) -> None:
    send, listen = blocks("python")
    with desk_agent() as agent:
        names: dict[str, Any] = {}
        exec(compile(send.replace("/var/lib/cofix/r1/sensors.sock", str(agent.socket)), "send", "exec"), names)
        names["driver"].close()
        assert "tcp/127.0.0.1:7447" in listen
        code = listen.replace("tcp/127.0.0.1:7447", agent.stream.partition("?")[0])
        told = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False, cwd=ROOT
        )
        agent.stop()
    assert told.returncode == 0, told.stderr
    status = json.loads(told.stdout)
    assert status["robot"] == "r1"
    assert status["x_m"] == pytest.approx(0.5, abs=0.5)
    assert set(status) <= quoted(section("Status and estimate"))


def test_the_configuration_is_one(tmp_path: Path) -> None:
    (block,) = blocks("toml")
    path = tmp_path / "r1.toml"
    path.write_text(block)
    config = load_agent_config(path)
    assert config.identity.robot == "r1"
    assert config.mavlink is not None


# --- keys --------------------------------------------------------------------------------------------------


PARTS: dict[type[BaseModel], str] = {
    SigmaPart: "start_sigma",
    IntrinsicsPart: "intrinsics",
    StartPart: "start",
    ControlPart: "control",
    ControlNoisePart: "noise",
    OdometryPart: "odometry",
    LinksPart: "links",
    CalibrationPart: "calibration",
}
"""Tables that occur in several places and are described once."""


def keys(model: type[BaseModel], path: str = "") -> Iterator[str]:
    """Dotted keys of a file, tables of free names as `<name>`."""
    for name, field in model.model_fields.items():
        below, free = _below(field.annotation)
        whole = f"{path}{name}" + (".<name>" if free else "")
        if below is None or below in PARTS:
            yield whole
        else:
            yield from keys(below, f"{whole}.")


def _below(annotation: Any) -> tuple[type[BaseModel] | None, bool]:
    if get_origin(annotation) is UnionType:
        annotation = next(item for item in get_args(annotation) if item is not type(None))
    free = get_origin(annotation) is dict
    if get_origin(annotation) in (list, dict):
        annotation = get_args(annotation)[-1]
    table = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    return (annotation if table else None), free and table


def named(title: str) -> set[str]:
    """Keys of the tables of a section: `part.a`, `b` in one cell are `part.a` and `part.b`."""
    found = set()
    for cell in re.findall(r"^\| (`.*?`) \|", section(title), re.MULTILINE):
        prefix = ""
        for item in re.findall(r"`([^`]+)`", cell):
            prefix = item.rpartition(".")[0] if "." in item else prefix
            found.add(item if "." in item or not prefix else f"{prefix}.{item}")
    return found


def named_for_both() -> set[str]:
    return named("Keys of both files") | named("Protections that can be switched off")


def test_every_key_of_an_agents_file_is_described() -> None:
    assert named_for_both() | named("Keys of an agent's file") >= set(keys(AgentConfig))


def test_every_key_of_a_scenario_is_described() -> None:
    assert named_for_both() | named("Keys of a scenario") >= set(keys(Scenario))


def test_every_key_of_a_part_is_described_and_no_other() -> None:
    there = {key for part, name in PARTS.items() for key in keys(part, f"{name}.")}
    assert named("Parts") == there


def test_no_key_is_described_that_does_not_exist() -> None:
    there = set(keys(AgentConfig)) | set(keys(Scenario)) | {"extends"}
    told = named("Keys of both files") | named("Keys of an agent's file") | named("Keys of a scenario")
    assert sorted(told - there) == []


def test_every_reason_of_the_wire_format_is_named() -> None:
    assert set(REASONS) <= quoted(section("What is refused"))


# --- the command line --------------------------------------------------------------------------------------


def commands() -> dict[str, argparse.ArgumentParser]:
    (actions,) = [item for item in parser()._actions if isinstance(item, argparse._SubParsersAction)]
    return dict(actions.choices)


def test_every_command_and_option_is_described_and_no_other() -> None:
    told = section("Command line")
    for name, command in commands().items():
        rows = re.findall(rf"^\| `cofix {name}\b(.*)$", told, re.MULTILINE)
        assert rows, name
        described = set(re.findall(r"`(--[a-z-]+)", " ".join(rows)))
        there = {text for action in command._actions for text in action.option_strings if text.startswith("--")}
        assert described == there - {"--help"}, name
    assert set(re.findall(r"^\| `cofix (\w+)", told, re.MULTILINE)) == set(commands())


def test_the_command_lines_work_in_the_order_they_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # Drawing takes seconds, and has tests of its own.
    monkeypatch.setattr("deploy.runs._report", lambda run_dir, summary: run_dir / "report.html")
    monkeypatch.setattr("deploy.montecarlo._compare", lambda *_, **__: None)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    with desk_agent() as agent:
        for line in lines():
            words = shlex.split(line.replace("/var/lib/cofix/r1/sensors.sock", str(agent.socket)))
            if words[0] != "cofix":
                done = subprocess.run(
                    line.replace("/var/lib/cofix/r1/sensors.sock", str(agent.socket)).replace(
                        "python ", f"{sys.executable} "
                    ),
                    shell=True,
                    capture_output=True,
                    text=True,
                    timeout=60,
                    check=False,
                )
                assert done.returncode == 0, f"{line}: {done.stderr}"
                assert "sent" in done.stderr
            elif words[1] in ("agent", "sitl"):
                _starts(line, words[1:], agent.state_dir.parent)
            else:
                more = SHORT if words[1] in ("run", "montecarlo") else []
                assert main([*words[1:], *more]) == 0, f"{line}: {capsys.readouterr().err}"
        agent.stop()
    one = sorted(str(path.relative_to("runs/one")) for path in Path("runs/one").rglob("*") if path.is_file())
    many = sorted(str(path.relative_to("runs/many")) for path in Path("runs/many").rglob("*") if path.is_file())
    patterns = [item.replace("<id>", "*") for item in quoted(section("Run directory"))]
    for name in (*one, *many):
        inner = name.partition("/")[2] if "=" in name.partition("/")[0] else name
        assert any(fnmatch.fnmatch(inner, pattern) for pattern in patterns), f"{name} is not described"
    assert "trials.csv" in many
    for run in ("one", "many"):
        summary = json.loads(Path("runs", run, "summary.json").read_text())
        assert set(summary) <= quoted(section("summary.json")), run


def _starts(line: str, words: list[str], folder: Path) -> None:
    """A command that runs until it is told to stop."""
    data: dict[str, Any] = {}
    if words[0] == "agent":
        # The block is for a robot: another place for its files, and no autopilot.
        data = tomllib.loads(blocks("toml")[0])
        del data["mavlink"]
        data["zenoh"] = {"listen": []}
        data["state_dir"] = str(folder / "s")
        (folder / words[1]).write_text(tomli_w.dumps(data))
    run = subprocess.Popen([*COFIX, *words], cwd=folder, stderr=subprocess.PIPE, text=True)
    try:
        if words[0] == "agent":
            deadline = time.monotonic() + 30.0
            while not Path(data["state_dir"], "sensors.sock").exists():
                assert run.poll() is None, f"{line}: {run.communicate()[1]}"
                assert time.monotonic() < deadline, f"{line}: did not start"
                time.sleep(0.05)
        else:
            assert run.stderr is not None
            assert "stop it with Ctrl-C" in run.stderr.readline()
        time.sleep(0.5)
        run.send_signal(signal.SIGINT)
        assert run.wait(timeout=30) == 0, f"{line}: {run.communicate()[1]}"
    finally:
        run.kill()
        run.communicate()
