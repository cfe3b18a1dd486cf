"""The closed loop in virtual time: commands that robots choose on what they know decide where they are next."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Effect, Steer
from agent.events import Event, Observation, Odometry
from agent.settings import NS
from sim.engine import TrialResult, VirtualEngine
from sim.invariants import InvariantChecker
from sim.scenario import Scenario
from sim.summary import reduce, summarize
from sim.world import SimulatedWorld
from tests.sim.steered import scenario

Array = NDArray[np.float64]
HELD_NS = 3 * NS // 2


class Steered:
    """Robots r1 and r2 head for the origin as they believe it to be, told anew with every event of a kind.

    What they would choose themselves does not count.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, on: type = Odometry, held_ns: int = HELD_NS) -> None:
        self.speed = 0.3
        plain = Agent.handle

        def handle(agent: Agent, event: Event) -> list[Effect]:
            effects = [effect for effect in plain(agent, event) if not isinstance(effect, Steer)]
            estimate = agent.estimate()
            if isinstance(event, on) and agent.settings.robot in ("r1", "r2") and estimate is not None:
                x, y, heading = estimate.mean
                turn = float(np.angle(-complex(x, y) * np.exp(-1j * heading)))
                effects = [*effects, Steer((self.speed, 0.0, 0.0), turn, event.t_ns + held_ns)]
            return effects

        monkeypatch.setattr(Agent, "handle", handle)

    @staticmethod
    def play(made: Scenario, seed: int = 3) -> tuple[SimulatedWorld, TrialResult]:
        world = SimulatedWorld(made, seed)
        return world, VirtualEngine(made, world, seed, checker=InvariantChecker(seed)).run()


def track(world: SimulatedWorld, robot: str) -> Array:
    return np.array([world.truth(robot, k) for k in range(world.steps + 1)])


def ways(world: SimulatedWorld, robot: str) -> Array:
    """Metres of each step, by index of its end; nothing at the start."""
    places = track(world, robot)[:, :2]
    return np.append(0.0, np.linalg.norm(np.diff(places, axis=0), axis=1))


def faulty(*faults: dict[str, Any], **change: Any) -> Scenario:
    return scenario({}, {"faults": list(faults), "duration_s": 30.0, "window_s": [0.0, 30.0]}, **change)


def test_robots_go_where_they_believe_the_origin_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scenario()
    _, result = Steered(monkeypatch).play(made)
    for robot in ("r1", "r2"):
        mean = result.trace.robots[robot].mean[-30:]
        assert np.linalg.norm(mean[:, :2], axis=1).max() < 1.0
    assert len(result.plan_us) == 2 * 100
    summary = summarize(made, "virtual", 3, [reduce(made, result)], simulated_s=100.0, timing={})
    assert summary["motion"]["speed_mps"] == pytest.approx(0.3, rel=0.05)


def test_a_run_repeated_is_equal_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    harsh = scenario(whole={"links": {"loss": 0.2, "delay_s": 0.1, "delay_tail_s": 0.3}})
    steered = Steered(monkeypatch)
    summaries = []
    for _ in range(2):
        world, result = steered.play(harsh, 5)
        summaries.append(summarize(harsh, "virtual", 5, [reduce(harsh, result)], simulated_s=100.0, timing={}))
        summaries[-1]["truth"] = track(world, "r1").tolist()
    assert summaries[0] == summaries[1]


def test_a_command_moves_the_vehicle_from_its_instant_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one comes with the odometry of the first step."""
    world, _ = Steered(monkeypatch).play(faulty())
    np.testing.assert_allclose(ways(world, "r1")[1:4], [0.0, 0.3, 0.3], rtol=0.02)


def test_a_command_within_a_step_counts_from_then_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranges come 0.2 s late here, so that is when robot r1 is told, for half a second each time."""
    late = {"kind": "sensor_delay", "robot": "r1", "delay_s": 0.2}
    world, _ = Steered(monkeypatch, Observation, NS // 2).play(faulty(late))
    np.testing.assert_allclose(ways(world, "r1")[2:], 0.15, rtol=0.05)


@pytest.mark.parametrize(
    "fault",
    [{"kind": "crash", "robot": "r1", "at_s": 9.7}, {"kind": "pause", "robot": "r1", "at_s": 9.7, "for_s": 9.0}],
    ids=("crash", "pause"),
)
def test_the_vehicle_of_a_robot_that_is_down_stops_when_its_command_expires(
    monkeypatch: pytest.MonkeyPatch, fault: dict[str, Any]
) -> None:
    world, _ = Steered(monkeypatch).play(faulty(fault))
    moved = ways(world, "r1")
    # The last one is told at 9 s, and held until 10.5 s.
    np.testing.assert_allclose(moved[9:12], [0.3, 0.3, 0.15], rtol=0.02)
    np.testing.assert_allclose(moved[12:18], 0.0, atol=1e-12)
    if fault["kind"] == "pause":
        np.testing.assert_allclose(moved[20:], 0.3, rtol=0.02)
    np.testing.assert_allclose(ways(world, "r2")[5:], 0.3, rtol=0.02)


def test_the_end_of_a_command_is_meant_by_the_clock_of_its_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead = {"kind": "clock_step", "robot": "r1", "offset_s": 100.0}
    world, _ = Steered(monkeypatch, held_ns=NS // 4).play(faulty(ahead))
    np.testing.assert_allclose(ways(world, "r1")[2:], 0.25 * 0.3, rtol=0.02)


def test_limits_of_the_vehicle_hold_in_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    steered = Steered(monkeypatch)
    steered.speed = 10.0
    limits = {"max_speed_mps": 0.6, "max_turn_radps": 0.1, "max_acceleration_mps2": 0.2}
    world, _ = steered.play(faulty(vehicle=limits))
    assert ways(world, "r1").max() == pytest.approx(0.6, rel=1e-3)
    np.testing.assert_allclose(ways(world, "r1")[2:5], [0.1, 0.3, 0.5], rtol=0.01)
    turned = np.diff(np.unwrap(track(world, "r1")[:, 2]))
    assert np.abs(turned).max() <= 0.1 + 1e-9
