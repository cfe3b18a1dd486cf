"""The direction in which a camera sees something, as the fleet's frame has it, with all that it is unsure of.

Bearings of a planar robot are of the plane it drives in: what it sees is taken to be at its own altitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.mounting import rotation
from agent.estimation.observation import RelativeModel

Array = NDArray[np.float64]

DIRECTED = ("bearing", "bearing3", "pixel")
"""Kinds of measurement that tell a direction and no distance."""


WIDEST_RAD, FINEST_RAD = 0.5, 1e-5
"""A direction less sure than that is none, for its cone is no plane across it; nobody knows one better than this."""


@dataclass(frozen=True, slots=True, eq=False)
class Directed:
    """A unit vector `direction` (3,) from `place` (3,) [m], ENU.

    place_cov (3, 3) is that of the place; sigma_rad the largest deviation of the direction along any axis across it.
    """

    place: Array
    place_cov: Array
    direction: Array
    sigma_rad: float


def directed(model: RelativeModel, mean: Array, cov: Array, z: Array, R: Array) -> Directed | None:
    """Where and in which direction a robot of belief (n,), (n, n) has measured z (m,), R (m, m).

    None for kinds that are none of `DIRECTED`, or a robot without a heading, or one that hardly knows it.
    """
    observer = model.observer
    if model.kind not in DIRECTED or observer.heading is None:
        return None
    ray, by_z = _ray(model.kind, z)
    level = rotation(*model.attitude, 0.0)
    turn = rotation(0.0, 0.0, float(mean[observer.heading])) @ level
    to_world = turn @ rotation(*model.mount[3:])
    direction, lever = to_world @ ray, turn @ np.array(model.mount[:3])
    axis = np.array([0.0, 0.0, 1.0])
    heading_variance = float(cov[observer.heading, observer.heading])
    by_heading = np.cross(axis, direction)
    found = to_world @ by_z
    spread = found @ R @ found.T + heading_variance * np.outer(by_heading, by_heading)
    place, place_cov = np.zeros(3), np.zeros((3, 3))
    sitting = list(observer.position)
    moved = np.zeros((3, len(mean)))
    moved[range(len(sitting)), sitting] = 1.0
    moved[:, observer.heading] += np.cross(axis, lever)
    place[: len(sitting)] = mean[sitting]
    place_cov = moved @ cov @ moved.T
    sigma = math.sqrt(max(float(np.linalg.eigvalsh(spread)[-1]), (2.0 * FINEST_RAD) ** 2))
    if not sigma <= WIDEST_RAD:
        return None
    return Directed(place + lever, 0.5 * (place_cov + place_cov.T), direction, sigma)


def _ray(kind: str, z: Array) -> tuple[Array, Array]:
    """Unit vector (3,) in the sensor's axes, and its derivative (3, m) by z."""
    if kind == "pixel":
        ray = np.array([1.0, -z[0], -z[1]])
        length = float(np.linalg.norm(ray))
        ray /= length
        return ray, (np.eye(3) - np.outer(ray, ray))[:, 1:] * (-1.0 / length)
    azimuth, elevation = float(z[0]), float(z[1]) if kind == "bearing3" else 0.0
    (ca, ce), (sa, se) = np.cos([azimuth, elevation]), np.sin([azimuth, elevation])
    ray = np.array([ce * ca, ce * sa, se])
    by_azimuth, by_elevation = np.array([-ce * sa, ce * ca, 0.0]), np.array([-se * ca, -se * sa, ce])
    if kind == "bearing":
        return ray, by_azimuth[:, None]
    return ray, np.column_stack([by_azimuth, by_elevation])
