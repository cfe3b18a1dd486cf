"""Figures of where robots take each other to be, relative to their own bodies.

A hypothesis is right if its place is within `RIGHT_M` of the true one, in space. Truth is that of the instant it tells
of: what came late is no error. NEES is per degree of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from agent.effects import RelativeEstimate
from agent.estimation.gate_test import GateTest
from agent.estimation.gaussian import is_positive_definite, quadratic_form, wrap

Array = NDArray[np.float64]

RIGHT_M = 0.5
HOLDS_S = 2.0
"""A robot counts as identified from the first instant on after which it is right for so long."""

AMBIGUOUS = 0.2
"""A second hypothesis that is as probable makes a robot ambiguous."""

MIDDLE = float(chi2.median(4)) / 4.0
"""Median of the NEES of an honest filter."""

MAX_SHARES = 200

Pair = tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class RelativeTrace:
    """What one robot made of another one over K instants, NaN where nothing.

    truth (K, 4), mean (K, 4), cov (K, 4, 4): x, y, z, heading in the body frame of the first; weight, ambiguity, tracks
    and confirmed (K,) as of `agent.effects.RelativeEstimate`; lag_s (K,) from the instant told of to the present.
    """

    truth: Array
    mean: Array
    cov: Array
    weight: Array
    ambiguity: Array
    tracks: Array
    confirmed: Array
    lag_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class ShownGate:
    """How a robot has judged bearings of a peer at t_s; truth (4,): x, y, z, heading in the body frame of the robot."""

    t_s: float
    robot: str
    peer: str
    truth: Array
    test: GateTest


def blank(count: int) -> RelativeTrace:
    """A trace of `count` instants at which nothing is known."""
    rows = [np.full(count, np.nan) for _ in range(5)]
    return RelativeTrace(
        np.full((count, 4), np.nan), np.full((count, 4), np.nan), np.full((count, 4, 4), np.nan), *rows
    )


def fill(trace: RelativeTrace, row: int, found: RelativeEstimate, lag_s: float) -> None:
    """Put what is believed at an instant; its truth is left to whoever knows it."""
    trace.mean[row], trace.cov[row] = found.mean, found.cov
    trace.weight[row], trace.ambiguity[row] = found.weight, found.ambiguity
    trace.tracks[row], trace.confirmed[row], trace.lag_s[row] = found.tracks, found.confirmed, lag_s


def relative_state(own: Array, other: Array) -> Array:
    """x, y, z, heading (..., 4) of another robot in the body frame of one, of poses (..., 4) in a common frame."""
    away = other[..., :3] - own[..., :3]
    cos, sin = np.cos(own[..., 3]), np.sin(own[..., 3])
    ahead, left = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    return np.stack([ahead, left, away[..., 2], wrap(other[..., 3] - own[..., 3])], axis=-1)


def place_errors(trace: RelativeTrace) -> Array:
    """Distance (K,) of the believed and the true place."""
    return np.asarray(np.linalg.norm(trace.mean[:, :3] - trace.truth[:, :3], axis=-1))


def heading_errors(trace: RelativeTrace) -> Array:
    """(K,), absolute."""
    return np.asarray(np.abs(wrap(trace.mean[:, 3] - trace.truth[:, 3])))


def right(trace: RelativeTrace) -> NDArray[np.bool_]:
    """At which instants (K,) the place is right; where nothing is known it is not."""
    found: NDArray[np.bool_] = np.asarray(place_errors(trace) <= RIGHT_M)
    return found


def identified_s(t_s: Array, good: NDArray[np.bool_]) -> float | None:
    """The first instant [s] from which on it is right (K,) for `HOLDS_S`; None: never."""
    for row in np.flatnonzero(good):
        inside = (t_s >= t_s[row]) & (t_s <= t_s[row] + HOLDS_S + 1e-9)
        if t_s[-1] >= t_s[row] + HOLDS_S - 1e-9 and good[inside].all():
            return float(t_s[row])
    return None


def nees(trace: RelativeTrace) -> Array:
    """(K,), NaN where there is no hypothesis."""
    error = trace.mean - trace.truth
    error[:, 3] = wrap(error[:, 3])
    values = np.full(len(error), np.nan)
    rows = [row for row in np.flatnonzero(np.isfinite(error).all(axis=1)) if is_positive_definite(trace.cov[row])]
    if rows:
        values[rows] = quadratic_form(error[rows], trace.cov[rows]) / 4.0
    return values


def reduce_relatives(t_s: Array, traces: dict[Pair, RelativeTrace], inside: NDArray[np.bool_]) -> dict[str, Any] | None:
    """What is kept of a trial, `inside` (K,) the window; None if nobody locates anybody so."""
    if not traces:
        return None
    good = np.array([right(trace) for trace in traces.values()])

    def within(values: list[Array]) -> Array:
        found = np.concatenate([item[inside] for item in values])
        return np.asarray(found[np.isfinite(found)])

    items = list(traces.values())
    ambiguity = within([item.ambiguity for item in items])
    stride = max(1, -(-len(t_s) // MAX_SHARES))
    return {
        "t_s": t_s[::stride].astype(np.float64),
        "right": good.mean(axis=0)[::stride],
        "right_share": float(good[:, inside].mean()) if inside.any() else None,
        "identified_s": [identified_s(t_s, row) for row in good],
        "tracks": within([item.tracks for item in items]),
        "position": within([place_errors(item) for item in items]),
        "heading": within([heading_errors(item) for item in items]),
        "nees": within([nees(item) for item in items]),
        "ambiguous": [int((ambiguity >= AMBIGUOUS).sum()), len(ambiguity)],
        "lag_s": within([item.lag_s for item in items]),
    }


def combine_relatives(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over pairs and trials, in the order of the trials.

    `identified_share` is the share of pairs that are right at each instant [s]; `time_to_identify_s` is over pairs,
    null where that many are never identified. Errors and the rest are of the window. `anees_median` is the median NEES
    over that of an honest filter: a mean would only show the wrong hypotheses.
    """
    share = np.mean([trial["right"] for trial in trials], axis=0)
    times = np.array([np.inf if t is None else t for trial in trials for t in trial["identified_s"]])

    def pooled(key: str) -> Array:
        return np.concatenate([trial[key] for trial in trials])

    position, heading, ratio = pooled("position"), pooled("heading"), pooled("nees")
    ambiguous, known = (sum(trial["ambiguous"][index] for trial in trials) for index in (0, 1))
    return {
        "identified_share": [[float(t), float(value)] for t, value in zip(trials[0]["t_s"], share)],
        "time_to_identify_s": {"median": _quantile(times, 0.5), "p90": _quantile(times, 0.9)},
        "never_identified_share": float(np.isinf(times).mean()),
        "tracks_mean": _over(pooled("tracks"), np.mean),
        "position_rmse_m": _over(position**2, np.mean, root=True),
        "position_error_median_m": _over(position, np.median),
        "heading_rmse_rad": _over(heading**2, np.mean, root=True),
        "heading_error_median_rad": _over(heading, np.median),
        "anees_median": _over(ratio / MIDDLE, np.median),
        "ambiguous_share": ambiguous / known if known else None,
        "lag_median_s": _over(pooled("lag_s"), np.median),
    }


def trial_row(reduced: dict[str, Any]) -> dict[str, float | None]:
    """One trial's columns."""
    return {
        "relative_right_share": reduced["right_share"],
        "relative_position_rmse_m": _over(reduced["position"] ** 2, np.mean, root=True),
        "relative_position_error_median_m": _over(reduced["position"], np.median),
    }


def _over(values: Array, how: Any, *, root: bool = False) -> float | None:
    if not len(values):
        return None
    found = float(how(values))
    return float(np.sqrt(found)) if root else found


def _quantile(times: Array, share: float) -> float | None:
    """A time that so many do not exceed; None if they are never over."""
    found = float(np.quantile(times, share, method="lower"))
    return found if np.isfinite(found) else None
