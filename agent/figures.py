"""Figures of a robot's core: what was counted of its inputs, how its measurements fitted, and what it knows.

NIS: normalized innovation squared, nu' S^-1 nu with the innovation nu and its covariance S.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.effects import Estimate, RelativeEstimate, TrackEstimate

Array = NDArray[np.float64]

MAX_KINDS = 64
"""Kinds of measurements that figures are kept of: fixes, landmarks, sightings and contacts, the last one `other`."""


@dataclass(slots=True)
class NisSum:
    """Sum and number of normalized innovations squared per degree of freedom, for one kind of measurement."""

    total: float = 0.0
    count: int = 0


class Figures:
    """Counters by reason, and sums of NIS by kind of measurement."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.nis: dict[str, NisSum] = {}
        self._kept = False

    def count_nis(self, kind: str, nis: float) -> None:
        """Add the NIS per degree of freedom of one update."""
        if self._kept:
            return
        # A peer says which kinds it has measured at an instant: there are more mixtures than anybody wants figures of.
        if kind not in self.nis and len(self.nis) >= MAX_KINDS - 1:
            kind = "other"
        entry = self.nis.setdefault(kind, NisSum())
        entry.total += nis
        entry.count += 1

    @contextmanager
    def kept(self, kept: bool) -> Iterator[None]:
        """Leave all figures as they are, if `kept`: what is done again was counted the first time."""
        if not kept:
            yield
            return
        counted, self._kept = dict(self.counters), True
        try:
            yield
        finally:
            self._kept = False
            self.counters.clear()
            self.counters.update(counted)


def known(estimate: Estimate) -> dict[str, object]:
    """What a robot that has started knows, for its status: place and tracks [m], their deviations, ages [s], others."""
    return {
        "state": "running",
        "x_m": float(estimate.mean[0]),
        "y_m": float(estimate.mean[1]),
        "sigma_m": _sigma_m(estimate.cov),
        "tracks": {track.target: _track(track, estimate.t_ns) for track in estimate.tracks},
        **({"relatives": {item.peer: _relative(item) for item in estimate.relatives}} if estimate.relatives else {}),
    }


def _relative(found: RelativeEstimate) -> dict[str, float | bool]:
    return {
        "x_m": float(found.mean[0]),
        "y_m": float(found.mean[1]),
        "z_m": float(found.mean[2]),
        "heading_rad": float(found.mean[3]),
        "sigma_m": _sigma_m(found.cov),
        "weight": float(found.weight),
        "ambiguity": float(found.ambiguity),
        "confirmed": bool(found.confirmed),
    }


def _sigma_m(cov: Array) -> float:
    """Standard deviation of x and y, root mean square of both."""
    return float(np.sqrt(max(np.trace(cov[:2, :2]) / 2.0, 0.0)))


def _track(track: TrackEstimate, t_ns: int) -> dict[str, float]:
    found = {"x_m": float(track.mean[0]), "y_m": float(track.mean[1]), "sigma_m": _sigma_m(track.cov)}
    return found if track.learnt_ns is None else {**found, "age_s": max(t_ns - track.learnt_ns, 0) * 1e-9}
