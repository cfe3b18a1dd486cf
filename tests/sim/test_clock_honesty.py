"""Two robots whose clocks differ and drift, over links that are slow, uneven and lopsided: what they claim is true.

One robot hears its position, the other lives on ranges to it. A range is used at the instant it was taken, on two
clocks, so that an offset that is not known costs metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

import network.clock
from agent.fault_parts import made
from network.clock import PeerClock
from sim.engine import VirtualEngine
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world
from tests.sizes import sized

SEEDS = range(1, sized(2, 40) + 1)
OFFSET_S, DRIFT_PPM = 0.7, 40.0
DELAY_S, TAIL_S, MORE_ONE_WAY_S = 0.03, 0.03, 0.06
SETTLED_S, DURATION_S = 5.0, 60.0
HONEST = 1.15


def duo() -> Scenario:
    scenario = load(
        "fault-plan",
        [
            f"duration_s={DURATION_S}",
            f"window_s=[{SETTLED_S}, {DURATION_S}]",
            f"links.delay_s={DELAY_S}",
            f"links.delay_tail_s={TAIL_S}",
            "lateness.clock_sigma_s=1.0",
        ],
    )
    robots = [
        robot.model_copy(update={"control": robot.control.model_copy(update={"speed_mps": 2.0, "yaw_rate_radps": 0.2})})
        for robot in scenario.robots[:2]
    ]
    faults = [
        made(kind="clock_step", robot="r2", offset_s=OFFSET_S),
        made(kind="clock_drift", robot="r2", ppm=DRIFT_PPM),
        made(kind="delay", delay_s=MORE_ONE_WAY_S, sources=["r1"], destinations=["r2"], both_ways=False),
    ]
    return scenario.model_copy(update={"robots": robots, "targets": [], "faults": faults, "fault_plan": None})


@dataclass(frozen=True)
class Played:
    """What came of the seeds: squared errors over claimed variances."""

    offset: NDArray[np.float64]
    position: NDArray[np.float64]


def played() -> Played:
    offsets: list[float] = []
    positions: list[float] = []
    for seed in SEEDS:
        scenario = duo()
        engine = VirtualEngine(scenario, open_world(scenario, seed), seed)
        while engine.step():
            if engine.t_s < SETTLED_S:
                continue
            ahead_s = OFFSET_S + DRIFT_PPM * 1e-6 * engine.t_s
            for robot, true_s in (("r1", ahead_s), ("r2", -ahead_s)):
                (peer,) = engine.nodes[robot].endpoint.peers()
                assert peer.clock_unusable is None and peer.offset_ns is not None and peer.offset_sigma_ns
                offsets.append(((peer.offset_ns * 1e-9 - true_s) / (peer.offset_sigma_ns * 1e-9)) ** 2)
        trace = engine.result().trace
        ratio = nees(trace.robots["r2"])[trace.t_s >= SETTLED_S]
        assert np.isfinite(ratio).all()
        positions += ratio.tolist()
    return Played(np.array(offsets), np.array(positions))


def assert_honest(found: Played) -> None:
    assert found.offset.mean() <= HONEST, f"offset: {found.offset.mean():.2f}"
    # Spread evenly over its bound, an error never exceeds the root of three deviations.
    assert found.offset.max() <= 3.05, f"offset: {found.offset.max():.2f} at worst"
    assert found.position.mean() <= HONEST, f"position: {found.position.mean():.2f}"


def test_offset_and_position_are_as_sure_as_is_claimed() -> None:
    found = played()
    assert_honest(found)
    assert found.offset.mean() > 0.01 and found.position.mean() > 0.1


def test_without_the_measured_offset_the_position_is_not_honest(monkeypatch: pytest.MonkeyPatch) -> None:
    def claimed_alone(self: PeerClock, now_ns: int) -> tuple[int, int] | None:
        known = measured(self, now_ns)
        return None if known is None else (0, known[1])

    measured = network.clock.PeerClock.at
    monkeypatch.setattr(network.clock.PeerClock, "at", claimed_alone)
    found = played()
    with pytest.raises(AssertionError, match="offset"):
        assert_honest(found)
    assert found.position.mean() > 2.0 * HONEST
