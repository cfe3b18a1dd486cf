"""A run of real processes that a test plays, disturbs and looks at: statuses while it goes on, figures at its end."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy.agent_files import Host
from deploy.evaluate import collect
from deploy.launch import Launcher, Outcome
from sim.closed_loop import MOTION
from sim.metrics import StateTrace, nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, played_world
from tests.deploy.test_processes import alive

SEED = 3
NEES_LIMIT = 1.7
"""Mean NEES per degree of freedom over a run that no robot exceeds."""


def scenario(duration_s: float, *overrides: str, robots: int = 4) -> Scenario:
    """Robots on circles in reach of each other; robot 1 hears its position. Forms with write-ahead by default."""
    text = (
        "localization.form=safe",
        "localization.pair_interval_s=1.0",
        "localization.pair_timeout_s=1.0",
        "fault_plan.intensity=calm",
    )
    whole = load("fault-plan", [f"duration_s={duration_s}", f"window_s=[2.0, {duration_s}]", *text])
    plain = whole.model_copy(
        update={
            "fault_plan": None,
            "faults": [],
            "robots": whole.robots[:robots],
            "links": whole.links.model_copy(update={"range_m": None}),
        }
    )
    return load_again(plain, overrides)


def load_again(found: Scenario, overrides: tuple[str, ...]) -> Scenario:
    """The scenario with overrides, checked as one that is read from a file."""
    if not overrides:
        return found
    import tempfile

    import tomli_w

    from sim.agents import table

    with tempfile.NamedTemporaryFile("wb", suffix=".toml") as file:
        tomli_w.dump(table(found), file)
        file.flush()
        return load(file.name, list(overrides))


@dataclass
class Played:
    """What became of a run."""

    outcome: Outcome
    statuses: list[tuple[float, dict[str, dict[str, Any]]]]
    """(instant [s], status of every robot) as it went on."""
    t_s: Any
    robots: dict[str, StateTrace]
    scenario: Scenario
    """With the faults there were, those by hand too."""
    notes: dict[str, Any] = field(default_factory=dict)
    ended_by_scene: bool = False

    def last(self, robot: str) -> dict[str, Any]:
        """The last status of a robot."""
        return self.statuses[-1][1][robot]

    def ever(self, robot: str, true: Callable[[dict[str, Any]], Any]) -> bool:
        """Whether a status of a robot was ever so."""
        return any(true(found[robot]) for _, found in self.statuses if found.get(robot))

    def assert_honest(self, *except_for: str) -> None:
        """No robot claims to know more than it does, and all know where they are at the end."""
        for name, trace in self.robots.items():
            if name in except_for:
                continue
            ratio = nees(trace)
            assert np.isfinite(ratio[-1]), f"{name} has no estimate at the end; seed {SEED}"
            mean = float(np.nanmean(ratio))
            assert mean <= NEES_LIMIT, f"{name} is overconfident: ANEES {mean:.2f}; seed {SEED}"


class Live:
    """The run while it goes on, for who disturbs it."""

    def __init__(self, launcher: Launcher) -> None:
        self.launcher = launcher
        self.notes: dict[str, Any] = {}
        self.ended_s: float | None = None
        """When the scene ended the run [s]."""

    async def end(self, after_s: float = 3.0) -> None:
        """All has been seen: end the run in `after_s` of its time, in which all are judged still."""
        await self.until(self.t_s + after_s)
        self.ended_s = self.t_s
        self.launcher.interrupt()

    @property
    def t_s(self) -> float:
        return self.launcher.t_s()

    async def until(self, t_s: float) -> None:
        while self.t_s < t_s:
            await asyncio.sleep(0.02)

    async def wait(self, true: Callable[[], Any], wall_s: float = 20.0) -> float:
        """Until something is so; how long it took [s of wall time]."""
        begin = time.monotonic()
        while not true():
            assert time.monotonic() - begin < wall_s, f"it did not happen in time: {self.told()}"
            await asyncio.sleep(0.05)
        return time.monotonic() - begin

    def told(self) -> dict[str, Any]:
        """Who hears whom, and what was refused or lost, for a failure's reason."""
        parts = ("peers", "duplicates", "clocks", "rejected", "transport")
        found = {name: member.status for name, member in self.launcher.members.items() if name != "world"}
        return {name: {part: status.get(part) for part in parts} for name, status in found.items()}

    def pid(self, robot: str) -> int:
        return self.launcher.members[robot].process.pid

    def status(self, robot: str) -> dict[str, Any]:
        return self.launcher.members[robot].status


Disturb = Callable[[Live], Awaitable[None]]


def play(
    folder: Path,
    found: Scenario,
    speed: float = 1.0,
    disturb: Disturb | None = None,
    hosts: Mapping[str, Host] | None = None,
) -> Played:
    """Play a scenario as processes in `folder`, and see that none of them, and no socket, is left."""
    from deploy.runs import write_scenario

    world = open_world(found, SEED)
    run_dir = folder / "run"
    run_dir.mkdir()
    write_scenario(found, run_dir)
    statuses: list[tuple[float, dict[str, dict[str, Any]]]] = []
    pids: set[int] = set()
    live: list[Live] = []

    def show(launcher: Launcher) -> None:
        statuses.append((launcher.t_s(), {n: dict(m.status) for n, m in launcher.members.items() if n != "world"}))
        pids.update(member.process.pid for member in launcher.members.values())

    async def scene() -> Outcome:
        launcher = Launcher(found, world, SEED, speed, run_dir, hosts)
        live.append(Live(launcher))
        playing = asyncio.ensure_future(launcher.run(show))
        disturbing = asyncio.ensure_future(_begun(live[0], disturb))
        # A scene that fails ends the run; one that goes on is over with the run.
        await asyncio.wait({playing, disturbing}, return_when=asyncio.FIRST_EXCEPTION)
        if disturbing.done() and disturbing.exception() is not None:
            launcher.interrupt()
        outcome = await playing
        disturbing.cancel()
        with suppress(asyncio.CancelledError):
            await disturbing
        return outcome

    before = os.environ.get("TMPDIR")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tempfile.tempdir", str(folder))
        outcome = asyncio.run(scene())
    assert os.environ.get("TMPDIR") == before
    assert not [pid for pid in pids if alive(pid)]
    assert not list(folder.glob("cofix-*")) and not list(folder.rglob("*.sock"))
    there_was = live[0].launcher.played()
    if found.planners():
        world = played_world(found, SEED, run_dir / MOTION)
    trace = collect(there_was, world, run_dir, outcome, False, SEED).trace
    ended_s = live[0].ended_s
    # What is published of an instant follows it by as much as data are waited for.
    rows = len(trace.t_s) if ended_s is None else int((trace.t_s < ended_s - 1.0).sum())
    robots = {
        name: replace(state, truth=state.truth[:rows], mean=state.mean[:rows], cov=state.cov[:rows])
        for name, state in trace.robots.items()
    }
    return Played(outcome, statuses, trace.t_s[:rows], robots, there_was, live[0].notes, ended_s is not None)


async def _begun(live: Live, disturb: Disturb | None) -> None:
    while live.t_s <= 0.0:
        await asyncio.sleep(0.02)
    if disturb is not None:
        await disturb(live)
