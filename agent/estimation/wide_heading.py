"""Measurements of robots that hardly know where they head, in a form that is linear in the heading.

A vector or a pixel turns with the body, and no Gaussian describes where something is seen by who may head anywhere:
sigma points of the heading lie turns apart. The same measurement as an azimuth about the vertical, and a distance or an
elevation, follows the heading one to one; see `agent.estimation.unscented.Turning`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.mounting import levelled, rotation
from agent.estimation.observation import AbsoluteModel, OutOfViewError, RelativeModel
from agent.events import LEVEL
from network.messages import Mount

Array = NDArray[np.float64]

WIDE_RAD = 0.4
"""Deviation of a heading from which on measurements are told by angles."""

VAGUE_RAD = 0.5
"""Largest deviation of an azimuth that is still one: straight above or below, directions have none."""


def by_angles(
    model: RelativeModel | AbsoluteModel, z: Array, R: Array, cov: Array
) -> tuple[RelativeModel | AbsoluteModel, Array, Array]:
    """A measurement z (m,), R (m, m), as it is used by an observer of covariance `cov` (n, n) or of a stacked one.

    Raises `OutOfViewError` if it tells no azimuth, which is all it could tell.
    """
    if not isinstance(model, RelativeModel) or model.kind not in ("vector", "pixel"):
        return model, z, R
    heading = model.observer.heading
    if heading is None or cov[heading, heading] <= WIDE_RAD**2:
        return model, z, R
    mount = levelled(model.mount, model.attitude)
    return _vector(model, mount, z, R) if model.kind == "vector" else _pixel(model, mount, z, R)


def _vector(model: RelativeModel, mount: Mount, z: Array, R: Array) -> tuple[RelativeModel, Array, Array]:
    """A place in the sensor's frame as range and bearing from the sensor, its axes turned into the body's."""
    turn = rotation(0.0, 0.0, mount[5])[:2, :2]
    x, y = (turn @ z).tolist()
    r = max(math.hypot(x, y), 1e-3)
    J = np.array([[x / r, y / r], [-y / r**2, x / r**2]]) @ turn
    return _turned(model, mount, "range_bearing", np.array([r, math.atan2(y, x)]), J @ R @ J.T, 1)


def _pixel(model: RelativeModel, mount: Mount, z: Array, R: Array) -> tuple[RelativeModel, Array, Array]:
    """A pixel as azimuth and elevation on the levelled body."""
    if model.intrinsics is not None:
        z, R = model.intrinsics.normalized(z, R)
    turn = rotation(*mount[3:])
    x, y, up = (turn @ np.array([1.0, -z[0], -z[1]])).tolist()
    level, whole = math.hypot(x, y), x**2 + y**2 + up**2
    if level < 1e-6 * math.sqrt(whole):
        raise OutOfViewError("straight above or below there is no azimuth")
    gradient = np.array(
        [
            [-y / level**2, x / level**2, 0.0],
            [-up * x / (level * whole), -up * y / (level * whole), level / whole],
        ]
    )
    J = -gradient @ turn[:, 1:]
    return _turned(model, mount, "bearing3", np.array([math.atan2(y, x), math.atan2(up, level)]), J @ R @ J.T, 0)


def _turned(
    model: RelativeModel, mount: Mount, kind: str, z: Array, R: Array, azimuth: int
) -> tuple[RelativeModel, Array, Array]:
    if R[azimuth, azimuth] > VAGUE_RAD**2:
        raise OutOfViewError("straight above or below there is no azimuth")
    upright = (mount[0], mount[1], mount[2], 0.0, 0.0, 0.0)
    return replace(model, kind=kind, mount=upright, attitude=LEVEL, intrinsics=None), z, R
