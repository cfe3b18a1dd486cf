"""False bearings: what a camera takes for a robot where there is none."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.stats import poisson

from sim.noise import uniform_rows

Array = NDArray[np.float64]

RARELY = 1e-9
"""Probability of more false bearings in one scan than are drawn."""

HALF_VIEW_RAD = 0.25 * math.pi
"""False bearings are as high and as low as that; the view is as large as `agent.estimation.correspondence` takes it."""


class Clutter:
    """False bearings of one camera: a number of mean `expected` per scan, drawn evenly in azimuth and elevation."""

    def __init__(self, expected: float, seed: int, scans: int, *names: str) -> None:
        most = int(poisson.isf(RARELY, expected)) + 1
        self._expected = expected
        self._draws = uniform_rows(seed, scans, 1 + 2 * most, *names, "clutter")

    def at(self, k: int, fov_rad: float | None = None) -> Array:
        """Directions (m, 2) of scan k: azimuth and elevation [rad]."""
        draws = self._draws[k]
        directions = 2.0 * draws[1:].reshape(-1, 2) - 1.0
        count = min(int(poisson.ppf(draws[0], self._expected)), len(directions))
        half = math.pi if fov_rad is None else min(0.5 * fov_rad, math.pi)
        return np.asarray(directions[:count] * np.array([half, HALF_VIEW_RAD]))
