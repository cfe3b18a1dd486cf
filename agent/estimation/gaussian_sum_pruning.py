"""What keeps a sum of Gaussians small: light tracks, tracks that say the same, and families that came to nothing
(De Silva, Mann, Gosine 2015, II-D 5)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.gaussian_sum import Rules, Tracks, normalized
from agent.estimation.gaussian_sum_doubt import doubted

Array = NDArray[np.float64]

SAME = 1.0
"""Mahalanobis square up to which a track says the same as a heavier one."""

WIDEST_RAD2 = 1.0
"""Variance of a heading from which on everything is near, and tracks are not merged."""


def pruned(tracks: Tracks, rules: Rules, families: bool) -> Tracks:
    """The tracks worth keeping, heaviest first. families: a scan has passed, so old families are judged."""
    tracks = tracks.rows(tracks.weight >= rules.floor)
    tracks = merged(tracks)
    if rules.doubt > 0.0:
        tracks = doubted(tracks, rules.doubt)
    if families:
        tracks = _without_poor_families(tracks, rules.family)
    if len(tracks) > rules.most:
        tracks = _heaviest(tracks, rules.most)
    return replace(tracks, weight=normalized(tracks.of, tracks.weight)) if len(tracks) else tracks


def merged(tracks: Tracks) -> Tracks:
    """Tracks near a heavier one of the same robot are one with it, of the same moments; heaviest first."""
    tracks = tracks.rows(np.argsort(-tracks.weight, kind="stable"))
    count = len(tracks)
    if count < 2:
        return tracks
    mean, cov = tracks.mean[:, 0], tracks.cov[:, 0]
    apart = mean - mean[:, None]
    apart[..., 3] = wrap(apart[..., 3])
    d2 = ((apart @ np.linalg.inv(cov)) * apart).sum(axis=-1)
    narrow = cov[:, 3, 3] <= WIDEST_RAD2
    near = (d2 < SAME) & (tracks.of[:, None] == tracks.of) & narrow[:, None] & narrow
    near &= np.tri(count, k=-1, dtype=np.bool_).T
    leads = np.flatnonzero(near.any(axis=1))
    if not len(leads):
        return tracks
    root = np.arange(count)
    for lead in leads.tolist():
        if root[lead] == lead:
            root[near[lead] & (root == np.arange(count))] = lead
    return _united(tracks, root)


def _united(tracks: Tracks, root: NDArray[np.int64]) -> Tracks:
    """Moments of groups: root (h,) is the index of the heaviest of each track's group. What is known of the past is of
    those that have one; names and misfit are the heaviest's."""
    heads = np.flatnonzero(root == np.arange(len(root)))
    member = root == heads[:, None]
    mass = member * tracks.weight
    weight = mass.sum(axis=1)
    mean, cov = tracks.mean[heads], tracks.cov[heads]
    known = (member & tracks.known).any(axis=1)
    apart = tracks.mean - tracks.mean[root]
    apart[..., 3] = wrap(apart[..., 3])
    for layer in range(mean.shape[1]):
        share = mass if layer == 0 else np.where(known[:, None], mass * tracks.known, mass)
        share = share / share.sum(axis=1, keepdims=True)
        off = apart[:, layer]
        shift = share @ off
        spread = tracks.cov[:, layer] + off[:, :, None] * off[:, None, :]
        cov[:, layer] = np.tensordot(share, spread, axes=1) - shift[:, :, None] * shift[:, None, :]
        mean[:, layer] += shift
    mean[..., 3] = wrap(mean[..., 3])
    return Tracks(tracks.of[heads], weight, mean, cov, known, tracks.lineage[heads], tracks.misfit[heads])


def _without_poor_families(tracks: Tracks, least: float) -> Tracks:
    """N-scan: tracks of one ancestor N scans ago go if all together weigh too little. Younger tracks stay."""
    oldest = tracks.lineage[:, 0]
    kin = oldest[:, None] == oldest
    kept = (oldest == 0) | (kin @ tracks.weight >= least)
    return tracks if kept.all() else tracks.rows(kept)


def _heaviest(tracks: Tracks, most: int) -> Tracks:
    """At most so many of each robot; tracks come sorted by weight."""
    kept = np.ones(len(tracks), dtype=np.bool_)
    for of in np.flatnonzero(np.bincount(tracks.of) > most).tolist():
        kept[np.flatnonzero(tracks.of == of)[most:]] = False
    return tracks.rows(kept)
