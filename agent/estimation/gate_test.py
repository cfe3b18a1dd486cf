"""The gate test of one robot at one scan, as it was: for pictures (De Silva, Mann, Gosine 2015, fig. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian_sum import Rules, Seen, Tracks, gate_limit, named_numbers
from agent.estimation.relative_sights import direction

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GateTest:
    """Bearings (m, 2) of a scan, azimuth and elevation [rad], and what h hypotheses of a robot expected.

    weight (h,), expected (h, 2); spread (h, 2, 2) of the bearing, linearized, and gate (h, 2, 2), by which bearings
    are judged, which is wider where the form modifies it; inside is where the Mahalanobis square is at most `limit`.
    """

    bearings: Array
    weight: Array
    expected: Array
    spread: Array
    gate: Array
    limit: float

    @property
    def wider(self) -> float:
        """How many times as large as linearization says the variances of a gate are, at most."""
        sizes = np.trace(self.gate, axis1=1, axis2=2) / np.trace(self.spread, axis1=1, axis2=2)
        return float(sizes.max())


def gate_test(tracks: Tracks, seen: Seen, rules: Rules, index: int) -> GateTest | None:
    """Of the robot `index`, with the tracks before the scan; None if there were none, or nothing was seen."""
    own = tracks.rows(tracks.of == index)
    if not len(own) or not len(seen.bearings):
        return None
    own = named_numbers(own, seen, rules)
    there = direction(own.mean[:, 0], own.cov[:, 0], seen.bearing_cov, not rules.improved)
    return GateTest(seen.bearings, own.weight, there.expected, there.S, there.gate, gate_limit(rules.gate, 2))
