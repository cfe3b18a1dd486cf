"""Which bearing of a scan is beyond doubt that of whom, by sums of Gaussians of where all robots are.

A bearing r of which nobody knows whose it is counts as that of robot j if j was as good as certain for a while, r is
the only bearing in the gates of the tracks of j and in none of another robot's, tracks of nearly all the weight of j
have it in their gates, and

    p = s / (s + lambda' (1 - P_D P_G)),   s = P_D sum_h w_h N(y_r; 0, S_h)

is near 1: the probability that j makes r rather than that j is not seen and r is of nobody. lambda' is the density of
false bearings and of the bearings of robots nothing is known of. Tracks of next to no weight don't count.

The tracks are those before the bearings of the scan. So the noise of a bearing is hardly known to what decides about
it: what is cut off are its tails beyond the gate and where clutter is as likely, which makes the rest less spread than
is stated, never more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian_sum import HEAVY, Rules, Seen, Tracks, gate_limit
from agent.estimation.relative_sights import direction, residuals, squared

Mask = NDArray[np.bool_]

CERTAIN = 0.99
"""Least probability against clutter."""

AGREED = 0.95
"""Least weight of a robot's tracks that have the bearing in their gates."""


def certain_labels(tracks: Tracks, seen: Seen, rules: Rules, sure: Mask) -> dict[int, int]:
    """Robot -> bearing, by indices; `sure` (n,) who was as good as certain for a while."""
    if seen.certain or not len(seen.bearings) or not sure.any():
        return {}
    tracks = tracks.rows(tracks.weight > HEAVY)
    n = len(seen.present)
    there = direction(tracks.mean[:, 0], tracks.cov[:, 0], seen.bearing_cov, not rules.improved)
    d2, likely = squared(residuals(there.expected, seen.bearings), there.gate)
    inside = d2 <= gate_limit(rules.gate, 2)
    reached = np.zeros((n, len(seen.bearings)), dtype=np.bool_)
    np.logical_or.at(reached, tracks.of, inside)
    made = np.zeros((n, len(seen.bearings)))
    np.add.at(made, tracks.of, rules.detection * tracks.weight[:, None] * likely)
    unknown = int((np.bincount(tracks.of, minlength=n) == 0).sum())
    others = rules.missed * (rules.clutter + unknown * rules.anywhere)
    alone = reached & (reached.sum(axis=0) == 1) & (reached.sum(axis=1, keepdims=True) == 1)
    agreed = np.zeros((n, len(seen.bearings)))
    np.add.at(agreed, tracks.of, tracks.weight[:, None] * inside)
    certain = (made >= CERTAIN * (made + others)) & (agreed >= AGREED)
    robots, bearings = np.nonzero(alone & sure[:, None] & certain)
    return dict(zip(robots.tolist(), bearings.tolist()))
