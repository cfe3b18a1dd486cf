"""Courses are where they should be at every instant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.estimation.motion import LAYOUTS
from sim.course import CoursePart, followed

Array = NDArray[np.float64]
STEP_NS = 100_000_000
SPACE = LAYOUTS["constant_velocity_3d"]


def course(**parts: Any) -> CoursePart:
    return CoursePart.model_validate(parts)


def flown(made: CoursePart, start: list[float], steps: int, step_ns: int = STEP_NS) -> Array:
    return followed(made, SPACE, np.array(start), step_ns, steps)


def test_the_published_circle() -> None:
    """From (15, 0, 0) at (0, 5, 0) m/s, around in 20 s; each velocity carries to the place it is stated with."""
    track = flown(course(kind="circle"), [15.0, 0.0, 0.0, 0.0, 5.0, 0.0], 200)
    turned = 2.0 * math.pi * np.arange(201) / 200
    np.testing.assert_allclose(track[:, 3:5], 5.0 * np.stack([-np.sin(turned), np.cos(turned)], axis=1), atol=1e-12)
    np.testing.assert_allclose(track[1:, :3], track[:-1, :3] + 0.1 * track[1:, 3:], atol=1e-12)
    np.testing.assert_allclose(track[200], track[0], atol=1e-12)
    centre, radius = track[:200, :2].mean(axis=0), 0.25 / math.sin(math.pi / 200)
    np.testing.assert_allclose(np.linalg.norm(track[:, :2] - centre, axis=1), radius, atol=1e-9)
    assert radius == pytest.approx(15.9, abs=0.05)
    assert centre[0] == pytest.approx(15.0 - radius, abs=0.01)
    assert not track[:, [2, 5]].any()


def test_the_published_square() -> None:
    """From (20, 20, 5) at (0, -4, 0) m/s, clockwise with sides of 20 m."""
    track = flown(course(kind="square"), [20.0, 20.0, 5.0, 0.0, -4.0, 0.0], 210)
    corners = [[20.0, 20.0], [20.0, 0.0], [0.0, 0.0], [0.0, 20.0], [20.0, 20.0]]
    np.testing.assert_allclose(track[[0, 50, 100, 150, 200], :2], corners, atol=1e-9)
    legs = [[0.0, -4.0], [-4.0, 0.0], [0.0, 4.0], [4.0, 0.0], [0.0, -4.0]]
    np.testing.assert_allclose(track[[50, 51, 101, 151, 201], 3:5], legs, atol=1e-12)
    np.testing.assert_allclose(track[[1, 100, 150, 200, 210], 3:5], legs, atol=1e-12)
    assert (track[:, 2] == 5.0).all()


def test_the_side_can_be_chosen() -> None:
    right, left = (
        flown(course(kind="circle", side=side, lap_s=8.0), [0.0, 0.0, 3.0, 2.0, 0.0, 0.5], 80)
        for side in ("right", "left")
    )
    np.testing.assert_allclose(right[:, 1], -left[:, 1], atol=1e-12)
    assert left[20, 1] > 1.0
    np.testing.assert_allclose(left[:, 2], 3.0 + 0.05 * np.arange(81), atol=1e-12)
    square = flown(course(kind="square", side="left", turn_every_s=2.0), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 30)
    np.testing.assert_allclose(square[30, :2], [2.0, 1.0], atol=1e-12)


def test_pieces_follow_each_other_again_and_again() -> None:
    """A stadium: straight for 3 s, a half circle in 2 s."""
    pieces = [{"for_s": 3.0}, {"for_s": 2.0, "turn_radps": 0.5 * math.pi}]
    track = flown(course(kind="pieces", pieces=pieces), [1.0, 2.0, 3.0, 2.0, 0.0, 0.0], 200)
    np.testing.assert_allclose(track[[30, 50, 80, 100], 3], [2.0, -2.0, -2.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(track[100:], track[:101], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(track[:, 3:5], axis=1), 2.0, atol=1e-12)


def test_a_turn_that_is_due_within_a_step_is_seen_after_it() -> None:
    track = flown(course(kind="square", turn_every_s=0.25, side="left"), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0], 6)
    np.testing.assert_allclose(track[[3, 4, 6], 3:5], [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]], atol=1e-12)


def test_a_planar_target_follows_it_too() -> None:
    track = followed(course(kind="circle"), LAYOUTS["constant_velocity"], np.array([1.0, 0.0, 0.0, 1.0]), STEP_NS, 200)
    np.testing.assert_allclose(track[200], track[0], atol=1e-12)


@pytest.mark.parametrize(
    ("parts", "model", "words"),
    [
        ({"kind": "circle"}, "unicycle", "'unicycle' does not move by a velocity alone"),
        ({"kind": "circle"}, "constant_acceleration", "take 'constant_velocity_3d'"),
        ({"kind": "circle", "turn_every_s": 4.0}, "constant_velocity", "course.turn_every_s is not of kind 'circle'"),
        ({"kind": "square", "lap_s": 4.0}, "constant_velocity", "course.lap_s is not of kind 'square'"),
        ({"kind": "pieces", "side": "left"}, "constant_velocity", "course.side is not of kind 'pieces'"),
        ({"kind": "square", "pieces": [{"for_s": 1.0}]}, "constant_velocity", "course.pieces is not of kind 'square'"),
        ({"kind": "pieces"}, "constant_velocity", "course.pieces is missing"),
    ],
)
def test_what_makes_no_sense_is_refused_by_its_key(parts: dict[str, Any], model: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        course(**parts).check(model)
