"""Mounts of sensors: rotations, how a mount is stated, and what it is on a level body."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.mounting import levelled, mount_of, placed, planar_mount, rotation
from network.messages import NO_MOUNT, Mount

HEADING = st.floats(-3.14, 3.14)
DOWN: Mount = (0.0, 0.0, 0.0, 0.0, math.pi / 2.0, 0.0)
"""A sensor that looks straight down."""


@given(HEADING, HEADING, HEADING)
def test_a_rotation_is_one(roll: float, pitch: float, yaw: float) -> None:
    turn = rotation(roll, pitch, yaw)
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1.0)
    assert np.allclose(turn, rotation(0.0, 0.0, yaw) @ rotation(0.0, pitch, 0.0) @ rotation(roll, 0.0, 0.0))


def test_a_mount_is_stated_in_the_plane_or_in_space() -> None:
    assert mount_of([1.0, 2.0, 0.5]) == (1.0, 2.0, 0.0, 0.0, 0.0, 0.5)
    assert mount_of([1.0, 2.0, 3.0, 0.1, 0.2, 0.5]) == (1.0, 2.0, 3.0, 0.1, 0.2, 0.5)


def test_on_a_level_body_a_mount_is_what_it_is() -> None:
    mount: Mount = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    assert levelled(mount, (0.0, 0.0)) is mount
    straight = levelled(DOWN, (0.0, 0.0))
    assert straight == DOWN
    back = levelled(levelled(DOWN, (0.0, 0.3)), (0.0, -0.3))
    assert np.allclose(rotation(*back[3:]), rotation(*DOWN[3:]), atol=1e-5)


def test_a_sensor_is_moved_by_its_turn_and_apart_by_its_lever_arm() -> None:
    here, turned, ahead = (
        placed(mount, (0.0, 0.0), 2) for mount in (NO_MOUNT, planar_mount(0.0, 0.0, 0.5), planar_mount(0.3, 0.0, 0.0))
    )
    assert (here.moved, here.apart) == (False, False)
    assert (turned.moved, turned.apart) == (True, False)
    assert (ahead.moved, ahead.apart) == (True, True)
    assert placed(NO_MOUNT, (0.1, 0.0), 3).moved


def test_a_placed_sensor_is_shared_and_not_to_be_written_to() -> None:
    found = placed(NO_MOUNT, (0.0, 0.0), 2)
    assert placed(NO_MOUNT, (0.0, 0.0), 2) is found
    with pytest.raises(ValueError, match="read-only"):
        found.turn[0, 0] = 2.0
