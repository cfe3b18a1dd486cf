"""Weights that claim no more than scans can know: what has not been refuted keeps a share.

Two hypotheses that both fit as a right one would, as of robots that mirror each other, differ by noise alone: by which
of them the measured velocities happen to suit, and by who is not seen. The log ratio of their weights is then a random
walk of some 2 nat per scan, and the weight of one drifts to 1 though nothing was learnt. Weighing pairs of robots
jointly would leave what is due to velocities; evidence that fades, a power of 0.9 of each weight, bounds the walk too
late: measured, one of a mirrored pair was still claimed to be certain three times in four.

So weights alone refute nothing. Each track keeps a misfit, what it has fitted worse than a right one would,

    c <- a c + sum over its measurements of (d^2 - dof) / 2, and of how much rarer than expected its being seen is

which for a right track is about zero, whatever the others' are, with a deviation of some 5 nat for the memory of
1 / (1 - a) scans, and which grows for a wrong one until the track is refuted. Modes other than the heaviest that are
not refuted keep a share of the weight, all of them together. A track begun beside others has yet to prove itself: it
begins refuted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import quadratic_form, wrap
from agent.estimation.gaussian_sum import Tracks, normalized

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DISTINCT = 13.28
"""Mahalanobis square from which on two hypotheses are two modes: 99 % of four degrees of freedom."""

REFUTED = 35.0
"""Misfit from which on a track is refuted [nat]: seven deviations of a right one's, whose distribution has a tail."""


def distinct(mean: Array, cov: Array, other_mean: Array, other_cov: Array) -> Mask:
    """Whether beliefs (..., 4), (..., 4, 4) are another mode than others."""
    apart = mean - other_mean
    apart[..., 3] = wrap(apart[..., 3])
    return np.asarray(quadratic_form(apart, cov + other_cov) > DISTINCT)


def doubted(tracks: Tracks, doubt: float) -> Tracks:
    """Tracks, heaviest first. Modes that are not refuted, if there are any, weigh together at least as a share `doubt`
    of themselves and the heaviest track, in proportion to what they have."""
    if not len(tracks):
        return tracks
    weight = normalized(tracks.of, tracks.weight)
    robots, first = np.unique(tracks.of, return_index=True)
    head = first[np.searchsorted(robots, tracks.of)]
    mean, cov = tracks.mean[:, 0], tracks.cov[:, 0]
    other = (tracks.misfit < REFUTED) & distinct(mean, cov, mean[head], cov[head])
    theirs = np.bincount(tracks.of, weight * other)[tracks.of]
    due = doubt / (1.0 - doubt) * weight[head]
    raised = other & (theirs < due)
    if not raised.any():
        return replace(tracks, weight=weight)
    weight = normalized(tracks.of, weight * np.where(raised, due / np.where(raised, theirs, 1.0), 1.0))
    order = np.argsort(-weight, kind="stable")
    return replace(tracks, weight=weight).rows(order)
