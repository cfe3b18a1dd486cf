"""The live table says why nothing happens: whose contacts are not used, why and until when."""

from __future__ import annotations

import io
from collections import Counter
from types import SimpleNamespace
from typing import Any

from rich.console import Console

from agent.autopilot import AutopilotReader
from agent.autopilot_settings import AutopilotSettings
from agent.health import Health
from agent.settings import NS, HealthSettings
from agent.steering_link import SteeringSettings
from deploy.status import LiveTable, _cells, identified, stillness
from sim.scenario_file import load


def test_a_quarantine_is_told_with_its_reason_and_its_end() -> None:
    health = Health(HealthSettings(), Counter())
    for k in range(5):
        health.usable("r1", k * NS, 20.0, own_observed=False)
    status: dict[str, Any] = {"x_m": 1.0, "y_m": 2.0, "sigma_m": 0.3, "lag_s": 0.0, "peers": {"r1": True, "r3": True}}
    told = SimpleNamespace(exit_code=None, status={**status, "health": health.status(13 * NS)})
    plain = SimpleNamespace(exit_code=None, status={**status, "health": Health(HealthSettings(), Counter()).status(0)})
    launcher = SimpleNamespace(members={"r2": told, "r3": plain}, progress=lambda: 0.5, injected=lambda: ["loss 0.5"])
    console = Console(file=io.StringIO(), width=200)
    console.print(LiveTable(load("liar", ["unsafe.accept_stale=true"]), 1.0, quiet=True).table(launcher))  # type: ignore[arg-type]
    assert isinstance(console.file, io.StringIO)
    shown = " ".join(console.file.getvalue().split())
    assert shown.count("r1 (quarantined) r3") == 1
    assert "UNSAFE: accept_stale injected: range_m 60, hysteresis_m 2, loss 0.5" in shown
    assert "r2: r1 is quarantined for 10 s: mean NIS of its contacts was 12.0" in shown
    assert "consistent ones have 1; until 8 contacts in a row" in shown


def test_a_neighbour_whose_clock_is_of_no_use_is_named_with_the_reason() -> None:
    clock = {"offset_s": 2.0, "sigma_s": 0.001, "steps": 0, "unusable": "offset"}
    status = {
        "x_m": 0.0,
        "y_m": 0.0,
        "sigma_m": 0.1,
        "lag_s": 0.0,
        "peers": {"r2": True, "r3": True, "r4": False},
        "clocks": {"r2": clock, "r3": {**clock, "unusable": None}},
    }
    assert _cells(None, status)[1] == "[red]r2 (clock: offset)[/red] r3"


def test_it_is_said_why_a_robot_that_is_to_move_does_not() -> None:
    steering = {"kind": "potential", "neighbours": ["r2"]}
    running: dict[str, Any] = {"x_m": 0.0, "steering": steering, "tracks": {"t1": {}}}
    waiting = {"reasons": [], "steering": {"missing": "waiting to be armed"}}
    assert stillness({**running, "autopilot": waiting}, alone=False) == ["does not move: waiting to be armed"]
    reader = AutopilotReader(AutopilotSettings(odometry_source="none", steering=SteeringSettings()))
    (silent,) = stillness({**running, "autopilot": reader.status()}, alone=False)
    assert silent == "nothing received on the link: is the autopilot on, and the endpoint right?"
    (alone,) = stillness({**running, "steering": {**steering, "neighbours": []}}, alone=False)
    assert "no neighbour has told" in alone
    assert stillness({**running, "steering": {**steering, "neighbours": []}}, alone=True) == []
    (aimless,) = stillness({**running, "tracks": {}}, alone=False)
    assert "no target" in aimless
    assert stillness({**running, "tracks": {}, "steering": {**steering, "kind": "random"}}, alone=False) == []
    assert stillness(running, alone=False) == stillness({"x_m": 0.0}, alone=False) == []


def test_rounds_are_counted_and_those_left_out() -> None:
    status = {"x_m": 0.0, "y_m": 0.0, "sigma_m": 0.1, "lag_s": 0.0, "counters": {"round.closed": 7, "round.skipped": 2}}
    assert _cells(None, status)[5] == "7 (2 skipped)"


def test_how_many_others_are_identified_is_said_of_who_locates_them() -> None:
    status = {"x_m": 0.0, "form_reason": "3 of 4 identified; p2 ambiguous (0.48)", "relatives": {"p1": {}}}
    assert identified(status) == ["3 of 4 identified; p2 ambiguous (0.48)"]
    assert identified({"x_m": 0.0, "form_reason": "no camera: it tells how it moves"}) == []
