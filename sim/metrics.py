"""Figures of one trial and of many: RMSE, NEES, containment, and what of them goes into `summary.json`.

A trial is reduced to a few sums (`reduce_trial`), which combine in the order of the trials into the same figures
whatever processes made them. NEES is per degree of freedom (ideal 1). An instant without an estimate (NaN) is
left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap

Array = NDArray[np.float64]
Window = tuple[float, float]

MAX_SERIES = 400


@dataclass(frozen=True, slots=True, eq=False)
class StateTrace:
    """Truth (K, n), estimated mean (K, n) and covariance (K, n, n) over K instants; `angles` are wrapped."""

    truth: Array
    mean: Array
    cov: Array
    angles: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TrialTrace:
    """Samples of one trial. `targets` is by target, then by the robot that tracks it.

    `bound`, if given, is {"robots": {id: StateTrace}, "targets": {id: StateTrace}}.
    """

    t_s: Array
    robots: dict[str, StateTrace]
    targets: dict[str, dict[str, StateTrace]]
    bound: dict[str, dict[str, StateTrace]] | None = None


def errors(trace: StateTrace) -> Array:
    """Estimate minus truth (K, n), angles wrapped."""
    error = trace.mean - trace.truth
    for index in trace.angles:
        error[:, index] = wrap(error[:, index])
    return error


def nees(trace: StateTrace) -> Array:
    """Normalized estimation error squared per degree of freedom (K,); NaN where there is no estimate."""
    error = errors(trace)
    values = np.full(len(error), np.nan)
    valid = np.isfinite(error).all(axis=1)
    if valid.any():
        solved = np.linalg.solve(trace.cov[valid], error[valid][..., None])[..., 0]
        values[valid] = np.sum(error[valid] * solved, axis=1) / error.shape[1]
    return values


def _reduced(trace: StateTrace, inside: NDArray[np.bool_]) -> dict[str, Any]:
    """Sums over the window: count, squared errors, NEES, containment, maxima, last error."""
    error, ratio = errors(trace), nees(trace)
    use = inside & np.isfinite(ratio)
    within = error[use]
    sigma = np.sqrt(np.diagonal(trace.cov, axis1=1, axis2=2)[use])
    squared = within[:, 0] ** 2 + within[:, 1] ** 2
    rest = within[:, 2:]
    present = np.flatnonzero(np.isfinite(error[:, 0]))
    return {
        "count": int(use.sum()),
        "position": float(squared.sum()),
        "rest": float(np.sum(rest**2)),
        "heading": bool(trace.angles),
        "nees": float(ratio[use].sum()),
        "inside": float(np.sum(np.abs(within) <= 3.0 * sigma)) / within.shape[1] if len(within) else 0.0,
        "max_position": float(np.sqrt(squared.max())) if len(squared) else None,
        "max": [float(value) for value in np.abs(within).max(axis=0)] if len(within) else None,
        "final": float(np.hypot(*error[present[-1], :2])) if len(present) else None,
        "series": (error[:, 0] ** 2 + error[:, 1] ** 2).astype(np.float64),
        "nees_series": ratio,
    }


def reduce_trial(trace: TrialTrace, window_s: Window) -> dict[str, Any]:
    """What is kept of a trial."""
    inside = (trace.t_s >= window_s[0] - 1e-9) & (trace.t_s <= window_s[1] + 1e-9)
    stride = max(1, -(-len(trace.t_s) // MAX_SERIES))

    def state(item: StateTrace) -> dict[str, Any]:
        found = _reduced(item, inside)
        found["series"], found["nees_series"] = found["series"][::stride], found["nees_series"][::stride]
        return found

    return {
        "t_s": trace.t_s[::stride],
        "robots": {name: state(item) for name, item in trace.robots.items()},
        "targets": {
            target: {name: state(item) for name, item in owners.items()} for target, owners in trace.targets.items()
        },
        "bound": None
        if trace.bound is None
        else {group: {name: state(item) for name, item in items.items()} for group, items in trace.bound.items()},
    }


def _beliefs(reduced: dict[str, Any]) -> list[dict[str, Any]]:
    return [
        *reduced["robots"].values(),
        *(item for owners in reduced["targets"].values() for item in owners.values()),
    ]


def _rmse(items: Sequence[dict[str, Any]], key: str = "position") -> float | None:
    count = sum(item["count"] for item in items)
    return float(np.sqrt(sum(item[key] for item in items) / count)) if count else None


def _mean(items: Sequence[dict[str, Any]], key: str) -> float | None:
    count = sum(item["count"] for item in items)
    return float(sum(item[key] for item in items) / count) if count else None


def is_lost(items: Sequence[dict[str, Any]], lost_above_m: float) -> bool:
    """Whether any of a trial's beliefs has a position RMSE above the limit, or no estimate at all."""
    return any(item["count"] == 0 or np.sqrt(item["position"] / item["count"]) > lost_above_m for item in items)


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _entity(items: Sequence[dict[str, Any]], robot: bool) -> dict[str, Any]:
    """Figures of one robot, or of one robot's track of one target, over trials."""
    heading = bool(items) and items[0]["heading"]
    figures: dict[str, Any] = {"position_rmse_m": _rmse(items)}
    if heading:
        figures["heading_rmse_rad"] = _rmse(items, "rest")
    elif not robot:
        figures["velocity_rmse_mps"] = _rmse(items, "rest")
    if robot:
        figures["position_error_max_m"] = max(
            (i["max_position"] for i in items if i["max_position"] is not None), default=None
        )
        figures["final_position_error_m"] = _median([item["final"] for item in items])
    figures["anees"] = _mean(items, "nees")
    figures["containment_3sigma"] = _mean(items, "inside")
    if robot:
        names = ("x_m", "y_m", "heading_rad")
        figures["error_max"] = {
            name: _median([item["max"][index] for item in items if item["max"] is not None])
            for index, name in enumerate(names)
            if heading or index < 2
        }
    return figures


def fleet_figures(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures pooled over robots, targets and trials."""
    robots = [item for trial in trials for item in trial["robots"].values()]
    tracks = [item for trial in trials for item in _tracks(trial)]
    return {
        "position_rmse_m": _rmse(robots),
        "heading_rmse_rad": _rmse(robots, "rest"),
        "anees": _mean(robots, "nees"),
        "target_position_rmse_m": _rmse(tracks),
        "target_anees": _mean(tracks, "nees"),
    }


def _tracks(trial: dict[str, Any]) -> list[dict[str, Any]]:
    """Target beliefs of a trial; the bound has one per target, the fleet one per target and robot."""
    tracks = []
    for item in trial["targets"].values():
        tracks += [item] if "count" in item else list(item.values())
    return tracks


def trial_figures(reduced: dict[str, Any]) -> dict[str, Any]:
    """One trial as a row: fleet figures and each robot's position RMSE and NEES."""
    row = fleet_figures([reduced])
    for name, item in reduced["robots"].items():
        row[f"{name}_position_rmse_m"] = _rmse([item])
        row[f"{name}_nees"] = _mean([item], "nees")
    return row


def combine(trials: Sequence[dict[str, Any]], lost_above_m: float) -> dict[str, Any]:
    """The part of a summary that comes from estimates, over reduced trials in order.

    `robots`, `targets`, `fleet` and `bound` are over converged trials, `all` over all of them, `median` is the
    median over all trials of each trial's figure. If every trial is lost the figures are over all trials. The
    bound is a filter too: its own lost trials are left out of its figures and counted in `bound.lost`.
    """
    converged = [trial for trial in trials if not is_lost(_beliefs(trial), lost_above_m)]
    used = converged or list(trials)
    first = trials[0]
    summary: dict[str, Any] = {
        "lost": len(trials) - len(converged),
        "robots": {name: _entity([trial["robots"][name] for trial in used], True) for name in first["robots"]},
        "targets": {
            target: {name: _entity([trial["targets"][target][name] for trial in used], False) for name in owners}
            for target, owners in first["targets"].items()
        },
        "fleet": fleet_figures(used),
        "all": fleet_figures(trials),
    }
    single = [fleet_figures([trial]) for trial in trials]
    summary["median"] = {key: _median([figures[key] for figures in single]) for key in single[0]}
    if first["bound"] is not None:
        bounds = [trial["bound"] for trial in used]
        kept = [
            bound
            for bound in bounds
            if not is_lost([*bound["robots"].values(), *bound["targets"].values()], lost_above_m)
        ] or bounds
        summary["bound"] = {
            **fleet_figures(kept),
            "lost": len(bounds) - len(kept),
            "robots": {name: _entity([bound["robots"][name] for bound in kept], True) for name in first["robots"]},
            "targets": {name: _entity([bound["targets"][name] for bound in kept], False) for name in first["targets"]},
        }
    summary["series"] = _series(used)
    return summary


def _series(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """RMSE and ANEES over time; null where no trial has an estimate."""

    def over(pick: Any, root: bool) -> list[float | None]:
        stack = np.array([pick(trial) for trial in trials])
        valid = np.isfinite(stack)
        count = valid.sum(axis=0)
        total = np.where(valid, stack, 0.0).sum(axis=0)
        mean = np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)
        values = np.sqrt(mean) if root else mean
        return [float(value) if np.isfinite(value) else None for value in values]

    first = trials[0]
    series: dict[str, Any] = {
        "t_s": [float(value) for value in first["t_s"]],
        "position_rmse_m": {n: over(lambda t, n=n: t["robots"][n]["series"], True) for n in first["robots"]},
        "anees": {n: over(lambda t, n=n: t["robots"][n]["nees_series"], False) for n in first["robots"]},
        "target_position_rmse_m": {
            target: {n: over(lambda t, n=n, k=target: t["targets"][k][n]["series"], True) for n in owners}
            for target, owners in first["targets"].items()
        },
    }
    if first["bound"] is not None:
        series["bound_position_rmse_m"] = {
            n: over(lambda t, n=n: t["bound"]["robots"][n]["series"], True) for n in first["robots"]
        }
    return series
