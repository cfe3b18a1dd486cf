"""What is known of a sensor's systematic errors, taken off every reading before it is used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Form = Literal["polar", "vector", "range", "bearing"]
"""How a range with a bearing is used: as it is, as x, y in the sensor's frame, or one of the two alone."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of a sensor: a distance reads scale x distance + bias, a bearing reads bearing + bias.

    bias_m     of every range; `bias_of` has that of a subject (`r2`, `landmark:a1`) in its place
    scale      of ranges
    depth      the range is the depth along the sensor's forward axis, distance x cos(bearing)
    bias_rad   of bearings
    """

    bias_m: float = 0.0
    bias_of: dict[str, float] = field(default_factory=dict)
    scale: float = 1.0
    depth: bool = False
    bias_rad: float = 0.0


NO_CALIBRATION = Calibration()
MIN_DEPTH_COSINE = 0.05
"""Bearings further from the axis than this (87 degrees) do not tell a distance from a depth."""


def corrected(kind: str, of: str | None, z: Array, calibration: Calibration) -> Array:
    """A reading (m,) of a kind without the errors of its sensor; a distance does not become negative."""
    if calibration is NO_CALIBRATION:
        return z
    found = np.array(z, dtype=np.float64)
    if kind == "bearing":
        found[0] -= calibration.bias_rad
    elif kind == "range_bearing":
        found[1] -= calibration.bias_rad
    if kind in ("range", "range_bearing"):
        bias = calibration.bias_of.get(of, calibration.bias_m) if of is not None else calibration.bias_m
        scale = calibration.scale
        if calibration.depth and kind == "range_bearing":
            scale *= max(float(np.cos(found[1])), MIN_DEPTH_COSINE)
        found[0] = max((found[0] - bias) / scale, 0.0)
    return found


def formed(kind: str, z: Array, R: Array, form: Form) -> tuple[str, Array, Array]:
    """A reading z (m,), R (m, m) in the form it is used in; only a `range_bearing` has more than one.

    The vector's covariance is that of the polar reading to first order.
    """
    if kind != "range_bearing" or form == "polar":
        return kind, z, R
    if form == "range":
        return "range", z[:1], R[:1, :1]
    if form == "bearing":
        return "bearing", z[1:], R[1:, 1:]
    distance, cos, sin = float(z[0]), float(np.cos(z[1])), float(np.sin(z[1]))
    # At the sensor itself a bearing tells nothing, and its noise would vanish.
    reach = max(distance, 1e-3)
    J = np.array([[cos, -reach * sin], [sin, reach * cos]])
    turned = J @ R @ J.T
    return "vector", np.array([distance * cos, distance * sin]), 0.5 * (turned + turned.T)
