"""One trial of a scenario in virtual time, and which world a scenario plays in."""

from __future__ import annotations

from collections.abc import Callable

from agent.config_file import ConfigError
from agent.node import Recorder
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
