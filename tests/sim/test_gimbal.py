"""A camera on a gimbal keeps what it sees in the image, finds it again, and imagines things only in the image."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.settings import NS
from sim.directions import direction_of, vector
from sim.gimbal import LOST_NS, SCAN_RADPS, Gimbal, level_turned
from sim.scenario import SensorPart
from sim.scenario_checks import check_sensor

Array = NDArray[np.float64]
FOV = math.radians(82.9)
FRAME_NS = NS // 20


def toward(azimuth: float, elevation: float = -0.6) -> Array:
    return vector(np.array([azimuth, elevation]))


def test_it_sees_a_cone() -> None:
    gimbal = Gimbal(FOV, 0.5)
    gimbal.turn(0)
    axis = direction_of(gimbal.axis)
    assert axis == pytest.approx([0.5, -math.pi / 6.0])
    for off, seen in ((0.49 * FOV, True), (0.51 * FOV, False)):
        assert gimbal.sees(7.0 * vector(axis + np.array([0.0, off]))) is seen
        assert gimbal.sees(0.1 * vector(axis - np.array([0.0, off]))) is seen


@pytest.mark.parametrize("azimuth", np.linspace(-3.0, 3.0, 7).tolist())
def test_looking_around_it_finds_what_there_is_and_keeps_it(azimuth: float) -> None:
    gimbal, first, t_ns = Gimbal(FOV, 0.0), None, 0
    for k in range(400):
        t_ns = k * FRAME_NS
        there = toward(azimuth + 0.4 * max(0.0, t_ns / NS - 6.0))
        gimbal.turn(t_ns)
        if gimbal.sees(there):
            first = k if first is None else first
            gimbal.saw(there)
        else:
            assert first is None, f"it was lost at frame {k}"
    assert first is not None and first * FRAME_NS <= 2.0 * math.pi / SCAN_RADPS * NS
    assert gimbal.axis @ there > math.cos(0.1)


def test_something_false_does_not_lose_what_is_seen() -> None:
    rng, gimbal, there = np.random.default_rng(4), Gimbal(FOV, 0.0), toward(0.3)
    missed = 0
    for k in range(2000):
        gimbal.turn(k * FRAME_NS)
        seen = gimbal.sees(there)
        missed += not seen
        if seen:
            gimbal.saw(gimbal.anywhere(rng.random(2)) if rng.random() < 0.2 else there)
    assert missed < 20, missed


def test_it_waits_where_it_saw_something_and_then_looks_around() -> None:
    gimbal = Gimbal(FOV, 0.0)
    gimbal.turn(0)
    gimbal.saw(toward(0.2))
    axis = gimbal.axis
    gimbal.turn(LOST_NS)
    np.testing.assert_array_equal(gimbal.axis, axis)
    gimbal.turn(LOST_NS + FRAME_NS)
    assert gimbal.axis @ axis < 1.0 - 1e-4
    gimbal.turn(FRAME_NS)
    assert direction_of(gimbal.axis)[0] == pytest.approx(SCAN_RADPS * FRAME_NS / NS), "a run that begins again"


def test_what_is_imagined_lies_evenly_in_the_image() -> None:
    rng, gimbal = np.random.default_rng(1), Gimbal(1.0, 2.0)
    gimbal.turn(0)
    found = np.array([gimbal.anywhere(rng.random(2)) for _ in range(4000)])
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
    along = found @ gimbal.axis
    assert along.min() >= math.cos(0.5) - 1e-12
    assert along.mean() == pytest.approx(0.5 * (1.0 + math.cos(0.5)), abs=0.002), "even over the sphere"
    assert np.linalg.norm(found.mean(axis=0) / along.mean() - gimbal.axis) < 0.02


def test_a_direction_of_the_body_over_the_ground() -> None:
    np.testing.assert_allclose(level_turned(0.7, vector(np.array([0.4, -0.3]))), vector(np.array([1.1, -0.3])))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"fov_rad": None}, "state fov_rad"),
        ({"of": ["targets", "peers"]}, r'of = \["targets"\]'),
        ({"mount": [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]}, "no angles in mount"),
        ({"kind": "bearing"}, "gimbal is of kind bearing3"),
    ],
)
def test_what_makes_no_sense_is_refused(changed: dict[str, Any], words: str) -> None:
    usual = {"kind": "bearing3", "of": ["targets"], "sigma_rad": 0.02, "fov_rad": 1.4, "gimbal": True}
    check_sensor("here", "camera", SensorPart.model_validate(usual))
    with pytest.raises(ConfigError, match=words):
        check_sensor("here", "camera", SensorPart.model_validate(usual | changed))
