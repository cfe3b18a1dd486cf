"""Fixtures for tests of your own fleet: play it, break it, look at it.

A test's module needs `from deploy.testing import FleetMaker, fleet`:

    def test_a_partition_is_survived(fleet: FleetMaker) -> None:
        robots = fleet("ut-clat-quadrotors")
        robots.run_for(20.0)
        robots.partition(["r1"], ["r2", "r3"])
        robots.run_for(20.0)
        robots.heal()
        robots.run_for(20.0)
        robots.assert_consistent()

The same in real processes: `fleet("ut-clat-quadrotors", runtime="processes")`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agent.config_file import ConfigError
from deploy.fleet import Fleet, VirtualFleet
from deploy.process_fleet import ProcessFleet
from sim.scenario import Scenario
from sim.scenario_file import load

FleetMaker = Callable[..., Fleet]
"""(scenario, overrides as of `--set`, seed=1, runtime="virtual", speed=1.0, check=False) -> the fleet, at its start."""

RUNTIMES = ("virtual", "processes")


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[FleetMaker]:
    """Makes fleets: `fleet("ut-clat", "links.loss=0.3", seed=2)`.

    With `runtime="processes"` the robots are processes of their own, which start at once and play `speed` times as fast
    as real time; their files and logs are in the test's `tmp_path`, and they are ended with the test. With `check=True`
    `sim.invariants` looks into every robot after every event, in virtual time only.
    """
    made: list[ProcessFleet] = []

    def make(
        scenario: str | Scenario,
        *overrides: str,
        seed: int = 1,
        runtime: str = "virtual",
        speed: float = 1.0,
        check: bool = False,
    ) -> Fleet:
        if runtime not in RUNTIMES:
            raise ConfigError(f"runtime = '{runtime}' is none of {', '.join(RUNTIMES)}")
        found = load(scenario, list(overrides)) if isinstance(scenario, str) else scenario
        if runtime == "virtual":
            if speed != 1.0:
                raise ConfigError("speed is for runtime='processes'; virtual time runs as fast as it can")
            return VirtualFleet(found, seed, check)
        if check:
            raise ConfigError("check is for runtime='virtual': nobody can look into processes after every event")
        made.append(ProcessFleet(found, seed, speed, tmp_path / f"fleet-{len(made) + 1}"))
        made[-1].start()
        return made[-1]

    try:
        yield make
    finally:
        for robots in made:
            robots.close()
