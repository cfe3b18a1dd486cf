"""Who is too far off to be looked at closer: nobody whom the sensor would see."""

from __future__ import annotations

import math

import pytest

from sim import sight
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.world import Output, SimulatedWorld

SEED = 4


def equipped(mount: list[float]) -> Scenario:
    """Robots that meet often, whose ranging antennas sit at the end of a boom."""
    short = ["duration_s=200.0", "window_s=[0.0, 200.0]"]
    places = [f"robots.r{number}.sensors.range.mount={mount}" for number in (1, 2, 3, 4)]
    return load("ut-clat", [*short, *places, "robots.r2.sensors.range.max_range_m=6.0"])


def told(world: SimulatedWorld) -> list[tuple[int, str, str, str | None, bytes]]:
    outputs: list[Output] = [item for k in range(1, world.steps + 1) for item in world.outputs(k)]
    return [(item.t_ns, item.robot, item.sensor, item.of, item.z.tobytes()) for item in outputs]


@pytest.mark.parametrize("mount", [[0.0, 0.0, 0.0], [3.0, -1.0, 0.4]])
def test_the_first_look_leaves_out_nobody_in_range(mount: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = equipped(mount)
    looked = told(SimulatedWorld(scenario, SEED))
    monkeypatch.setattr(sight, "reach_m", lambda sensor: math.inf)
    assert looked == told(SimulatedWorld(scenario, SEED)), f"seed {SEED}"
    # There are pairs on either side of the border.
    ranges = sum(of is not None and sensor == "range" for _, _, sensor, of, _ in looked)
    assert 50 < ranges < 6 * 200


def test_the_reach_is_the_range_and_the_lever_arm() -> None:
    (first, *_) = equipped([3.0, 4.0, 0.0]).robots
    assert sight.reach_m(first.sensors["range"]) == pytest.approx(15.0, abs=2.0 * sight.MARGIN_M)
    free = first.sensors["range"].model_copy(update={"max_range_m": None})
    assert sight.reach_m(free) == math.inf
