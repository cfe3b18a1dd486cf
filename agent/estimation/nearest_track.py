"""One track per robot that takes the nearest bearing in its gate: what sums of Gaussians are compared with.

It never doubts an association, and begins anew after so many bad scans in a row. Kernels and gates are the published
ones (De Silva, Mann, Gosine 2015): a single Gaussian of an unknown heading is only of use linearized.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian_sum import Rules, Seen, Tracks, begun_tracks, gate_limit, joined, numbered
from agent.estimation.relative_sights import density, direction, distance, height, residuals, squared, turned_to

Rows = NDArray[np.int64]

PATIENCE = 10
"""Bad scans in a row that a track outlives: without a bearing, or with a range outside its gate."""


def scanned(tracks: Tracks, bad: Rows, seen: Seen, rules: Rules) -> tuple[Tracks, Rows]:
    """The tracks, at most one per robot, after one scan, and how many bad scans in a row each robot (n,) has had."""
    rest, tracks = tracks.rows(~seen.present[tracks.of]), tracks.rows(seen.present[tracks.of])
    of = tracks.of
    bad = bad.copy()
    if len(tracks):
        sight = height(tracks.mean[:, 0], tracks.cov[:, 0], seen.heights[of], seen.height_vars[of])
        tracks = numbered(tracks, sight, seen.with_height[of], rules)
        sight = distance(tracks.mean[:, 0], tracks.cov[:, 0], seen.ranges[of], seen.range_vars[of], rules.improved)
        good = (sight.residual**2 <= gate_limit(rules.gate, 1) * sight.gate) | ~seen.with_range[of]
        tracks = numbered(tracks, sight, seen.with_range[of], rules)
        tracks, taken = _nearest(tracks, seen, rules)
        bad[of] = np.where(good & taken, 0, bad[of] + 1)
        lost = bad[of] > PATIENCE
        bad[of[lost]] = 0
        tracks = tracks.rows(~lost)
    return joined(rest, tracks, _begun(tracks, seen, rules)), bad


def _nearest(tracks: Tracks, seen: Seen, rules: Rules) -> tuple[Tracks, NDArray[np.bool_]]:
    """Tracks with the nearest bearing, and whether they had one in the gate."""
    if not len(seen.bearings):
        return tracks, np.zeros(len(tracks), dtype=np.bool_)
    there = direction(tracks.mean[:, 0], tracks.cov[:, 0], seen.bearing_cov, not rules.improved)
    residual = residuals(there.expected, seen.bearings)
    d2 = np.where(seen.possible[tracks.of], squared(residual, there.gate)[0], np.inf)
    nearest = d2.argmin(axis=1)
    rows = np.flatnonzero(d2.min(axis=1) <= gate_limit(rules.gate, 2))
    mean, cov = tracks.mean.copy(), tracks.cov.copy()
    mean[rows, 0], cov[rows, 0] = turned_to(
        mean[rows, 0], cov[rows, 0], there.H[rows], there.S[rows], residual[rows, nearest[rows]]
    )
    taken = np.zeros(len(tracks), dtype=np.bool_)
    taken[rows] = True
    return replace(tracks, mean=mean, cov=cov), taken


def _begun(tracks: Tracks, seen: Seen, rules: Rules) -> Tracks:
    """A track of each robot that has none, from its range and the bearing that fits its height best."""
    free = seen.present & seen.with_range & seen.possible.any(axis=1)
    free[tracks.of] = False
    of = np.flatnonzero(free)
    off = seen.heights[of, None] - seen.ranges[of, None] * np.sin(seen.bearings[:, 1])
    fits = np.where(seen.with_height[of, None], density(off, np.asarray(1.0)), 1.0)
    bearing = np.where(seen.possible[of], fits, -1.0).argmax(axis=1) if len(seen.bearings) else of
    return begun_tracks(of, np.ones(len(of)), bearing, seen, rules)
