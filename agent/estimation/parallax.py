"""Whether bearings of several observers cross, so that they tell a place and not only a line."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from agent.estimation.sights import Sight, projection

NOISE_SHARE = 3.0
"""Noise bends bearings of one place apart by 2 sigma^2 on average; that is no crossing."""


def crosses(sights: Iterable[Sight], parallax_rad: float) -> bool:
    """Whether sights of the same instant, one of each observer, cross by `parallax_rad` [rad].

    The smallest eigenvalue of the mean of P_g is sin^2(angle / 2) for two bearings; what noise adds does not count.
    """
    found = list(sights)
    if len(found) < 2:
        return False
    directions = np.array([item.direction / np.linalg.norm(item.direction) for item in found])
    least = float(np.linalg.eigvalsh(projection(directions).mean(axis=0))[0])
    noise = float(np.mean([float(item.sigma_rad) ** 2 for item in found]))
    return least >= math.sin(0.5 * parallax_rad) ** 2 + NOISE_SHARE * noise
