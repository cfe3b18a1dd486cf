"""What robots tell each other of targets that they triangulate: bearings, and predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Bearing:
    """The direction in which a camera sees a target, and from where.

    place      (3,) of the camera [m], ENU, at the instant of the sighting
    place_cov  (3, 3) of its error [m^2]
    direction  (3,) unit vector, ENU
    sigma_rad  deviation of the direction along any axis across it, with what the camera's attitude is unsure of
    age_ns     from the sighting to the report's instant
    """

    target: str
    place: Array
    place_cov: Array
    direction: Array
    sigma_rad: float
    age_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Position and velocity (6,) of a target, ENU, predicted for a report's instant; its cov (6, 6) if that is told."""

    target: str
    mean: Array
    cov: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BearingReport:
    """What one robot tells everybody in reach once per round, at the header's `t_meas_ns`, to triangulate targets."""

    bearings: tuple[Bearing, ...]
    predictions: tuple[Prediction, ...] = ()
