"""One trial of a scenario in virtual time, and which world a scenario plays in."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from agent.config_file import ConfigError
from agent.node import Recorder
from sim.closed_loop import read_motion
from sim.engine import FateSink, TrialResult, VirtualEngine
from sim.invariants import InvariantChecker
from sim.lives import LifeSink
from sim.recorded_world import RecordedWorld
from sim.recordings.recording import RecordingError
from sim.scenario import Scenario
from sim.world import SimulatedWorld, World


def open_world(scenario: Scenario, seed: int) -> World:
    """The world of a scenario for one seed. Raises `ConfigError` when it can't be had."""
    if scenario.world.kind == "simulated":
        return SimulatedWorld(scenario, seed)
    try:
        return RecordedWorld(scenario, seed)
    except RecordingError as error:
        raise ConfigError(f"{scenario.name}: world.path: {error}") from None


def played_world(scenario: Scenario, seed: int, motion: Path) -> World:
    """The world of a run that another process has played, as far as it goes.

    `motion` is its file of where robots went that choose their motion. Raises `ConfigError` when it can't be had.
    """
    if not scenario.planners():
        return open_world(scenario, seed)
    world = SimulatedWorld(scenario, seed, played=True)
    try:
        read_motion(motion, world.motion)
    except OSError as error:
        raise ConfigError(f"{motion}: where the robots went cannot be read ({error.strerror})") from None
    world.locate()
    return world


def run_trial(
    scenario: Scenario,
    seed: int,
    *,
    with_bound: bool = False,
    recorders: dict[str, Recorder] | None = None,
    fate_sink: FateSink | None = None,
    progress: Callable[[int, int], None] | None = None,
    world: World | None = None,
    checker: InvariantChecker | None = None,
    life_sink: LifeSink | None = None,
) -> TrialResult:
    """Play one trial; equal arguments give equal results. Raises `InvariantBreach` if a `checker` finds one."""
    world = world if world is not None else open_world(scenario, seed)
    engine = VirtualEngine(
        scenario,
        world,
        seed,
        with_bound=with_bound,
        recorders=recorders,
        fate_sink=fate_sink,
        checker=checker,
        life_sink=life_sink,
    )
    return engine.run(progress)
