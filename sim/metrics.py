"""Figures of one trial and of many: RMSE, NEES, containment, and what of them goes into `summary.json`.

A trial is reduced to a few sums (`reduce_trial`). `combine` adds them up in the order of the trials, so the figures are
the same to the last bit whatever processes made them. NEES is per degree of freedom (ideal 1). An instant without an
estimate (NaN) is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import is_positive_definite, quadratic_form, wrap
from sim.label_figures import combine_labels
from sim.relative_figures import Pair, RelativeTrace, combine_relatives, reduce_relatives, trial_row

Array = NDArray[np.float64]
Window = tuple[float, float]

MAX_SERIES = 400
RECENT_S = 2.0
"""A track has figures of its own within this time after a sighting."""


@dataclass(frozen=True, slots=True, eq=False)
class StateTrace:
    """Truth (K, n), estimated mean (K, n) and covariance (K, n, n) over K instants.

    `angles` are wrapped, the first is the heading; `position` is where x, y and perhaps z sit. What else there is are
    velocities in a state without heading, and parameters of the robot's odometry in one with it.
    """

    truth: Array
    mean: Array
    cov: Array
    angles: tuple[int, ...]
    position: tuple[int, ...] = (0, 1)


@dataclass(frozen=True, slots=True, eq=False)
class TrialTrace:
    """Samples of one trial. `targets` is by target, then by the robot that tracks it.

    `bound`, if given, is {"robots": {id: StateTrace}, "targets": {id: StateTrace}}. `relatives`: what a robot made of
    another one, by both; `labels`: how often robots were right about whom a camera saw that does not tell.
    """

    t_s: Array
    robots: dict[str, StateTrace]
    targets: dict[str, dict[str, StateTrace]]
    bound: dict[str, dict[str, StateTrace]] | None = None
    relatives: dict[Pair, RelativeTrace] = field(default_factory=dict)
    labels: dict[str, int] | None = None


def components(trace: StateTrace) -> list[str]:
    """Name of each component of the state, with its unit where it has one: `x_m`, `heading_rad`, `vx_mps`."""
    found, others = [], 0
    for index in range(trace.truth.shape[1]):
        if index in trace.position:
            found.append(f"{'xyz'[trace.position.index(index)]}_m")
        elif index in trace.angles:
            found.append("heading_rad")
        else:
            order, axis = divmod(others, len(trace.position))
            moving = f"v{'xyz'[axis]}_mps" if order == 0 else f"a{'xyz'[axis]}_mps2"
            found.append(f"parameter_{others + 1}" if trace.angles else moving)
            others += 1
    return found


def errors(trace: StateTrace) -> Array:
    """Estimate minus truth (K, n), angles wrapped."""
    error = trace.mean - trace.truth
    for index in trace.angles:
        error[:, index] = wrap(error[:, index])
    return error


def position_errors(trace: StateTrace) -> Array:
    """Distance of estimate and truth (K,), over all components of the position."""
    error = trace.mean[:, list(trace.position)] - trace.truth[:, list(trace.position)]
    return np.asarray(np.sqrt(np.sum(error**2, axis=1)))


def nees(trace: StateTrace) -> Array:
    """Normalized estimation error squared per degree of freedom, e' P^-1 e / n (K,).

    NaN where there is no estimate, and where a covariance is not positive definite: no distance is measured with it.
    """
    error = errors(trace)
    values = np.full(len(error), np.nan)
    rows = np.flatnonzero(np.isfinite(error).all(axis=1))
    rows = rows[_positive_definite(trace.cov[rows])]
    if len(rows):
        values[rows] = quadratic_form(error[rows], trace.cov[rows]) / error.shape[1]
    return values


def _positive_definite(cov: Array) -> NDArray[np.bool_]:
    """Which of the matrices (K, n, n) are finite and positive definite."""
    usable: NDArray[np.bool_] = np.asarray(np.isfinite(cov).all(axis=(1, 2)))
    try:
        np.linalg.cholesky(cov[usable])
    except np.linalg.LinAlgError:
        usable[usable] = [is_positive_definite(matrix) for matrix in cov[usable]]
    return usable


def _reduced(trace: StateTrace, t_s: Array, inside: NDArray[np.bool_], stride: int) -> dict[str, Any]:
    """Counts and sums over the window, extremes, last error, and every `stride`-th sample for the series.

    `heading` and `velocity` are sums of squares, None for a state that has no such components.
    """
    error, ratio = errors(trace), nees(trace)
    squared = np.sum(error[:, list(trace.position)] ** 2, axis=1)
    seen = np.isfinite(error).all(axis=1)
    estimated = np.isfinite(trace.mean).all(axis=1)
    use = inside & seen
    within = error[use]
    sigma = np.sqrt(np.maximum(np.diagonal(trace.cov, axis1=1, axis2=2)[use], 0.0))
    names = components(trace)
    velocity = [index for index, name in enumerate(names) if name.endswith("_mps")]
    usable = use & np.isfinite(ratio)
    present = np.flatnonzero(seen)
    return {
        "names": names,
        "known": bool(np.isfinite(trace.truth).any()),
        "count": int(use.sum()),
        "window": int(inside.sum()),
        "estimated": int((inside & estimated).sum()),
        "started": float(t_s[estimated][0]) if estimated.any() else None,
        "position": float(squared[use].sum()),
        "heading": float(np.sum(within[:, list(trace.angles)] ** 2)) if trace.angles else None,
        "velocity": float(np.sum(within[:, velocity] ** 2)) if velocity else None,
        "nees_count": int(usable.sum()),
        "nees": float(ratio[usable].sum()),
        "inside": float(np.sum(np.abs(within) <= 3.0 * sigma)) / error.shape[1],
        "max_position": float(np.sqrt(squared[use].max())) if len(within) else None,
        "min": [float(value) for value in np.abs(within).min(axis=0)] if len(within) else None,
        "max": [float(value) for value in np.abs(within).max(axis=0)] if len(within) else None,
        "final": float(np.sqrt(squared[present[-1]])) if len(present) else None,
        "series": np.where(seen, squared, np.nan)[::stride],
        "nees_series": ratio[::stride],
    }


def _recent(trace: StateTrace, t_s: Array, inside: NDArray[np.bool_], sightings: Sequence[Array]) -> dict[str, Any]:
    """Count, sum of squares and largest of the position errors in the window within `RECENT_S` after a sighting [s]."""
    times = np.sort(np.concatenate([[-np.inf], *sightings]))
    last = times[np.searchsorted(times, t_s + 1e-9, side="right") - 1]
    error = position_errors(trace)[inside & (t_s - last <= RECENT_S + 1e-9)]
    error = error[np.isfinite(error)]
    return {
        "count": len(error),
        "position": float(np.sum(error**2)),
        "max_position": float(error.max()) if len(error) else None,
    }


def reduce_trial(
    trace: TrialTrace, window_s: Window, measured: dict[tuple[str, str], Array] | None = None
) -> dict[str, Any]:
    """What is kept of a trial: sums over the window, and series of at most `MAX_SERIES` instants.

    `measured` has the instants [s] at which a robot measured somebody, by (robot, of): a track's figures shortly after
    a sighting are of sightings by its own robot, those of the bound of anybody's.
    """
    inside = (trace.t_s >= window_s[0] - 1e-9) & (trace.t_s <= window_s[1] + 1e-9)
    stride = max(1, -(-len(trace.t_s) // MAX_SERIES))

    def states(items: dict[str, StateTrace], *, ratios: bool = False) -> dict[str, Any]:
        found = {name: _reduced(item, trace.t_s, inside, stride) for name, item in items.items()}
        if not ratios:
            for entry in found.values():
                del entry["nees_series"]
        return found

    reduced: dict[str, Any] = {
        "t_s": trace.t_s[::stride],
        "robots": states(trace.robots, ratios=True),
        "targets": {target: states(owners) for target, owners in trace.targets.items()},
        "bound": None if trace.bound is None else {group: states(items) for group, items in trace.bound.items()},
    }
    relative = reduce_relatives(trace.t_s, trace.relatives, inside)
    if relative is not None:
        reduced["relative"] = relative
        if trace.labels is not None:
            relative["labels"] = trace.labels
    for target, owners in trace.targets.items() if measured is not None else ():
        seen = {robot: times for (robot, of), times in (measured or {}).items() if of == f"target:{target}"}
        for robot, track in owners.items():
            mine = [seen[robot]] if robot in seen else []
            reduced["targets"][target][robot]["recent"] = _recent(track, trace.t_s, inside, mine)
        if trace.bound is not None:
            best = trace.bound["targets"][target]
            reduced["bound"]["targets"][target]["recent"] = _recent(best, trace.t_s, inside, list(seen.values()))
    return reduced


def summarize(traces: Sequence[TrialTrace], window_s: Window, lost_above_m: float) -> dict[str, Any]:
    """Figures of trials at hand as a whole; `reduce_trial` and `combine` in one."""
    return combine([reduce_trial(trace, window_s) for trace in traces], lost_above_m)


def _tracks(reduced: dict[str, Any]) -> list[dict[str, Any]]:
    """Target beliefs of a trial; the bound has one per target, the fleet one per target and robot."""
    tracks = []
    for item in reduced["targets"].values():
        tracks += [item] if "count" in item else list(item.values())
    return tracks


def _ratio(items: Sequence[dict[str, Any]], key: str, count: str = "count") -> float | None:
    """Sum of `key` over the samples of those that have it, None without samples."""
    known = [item for item in items if item[key] is not None]
    total = sum(item[count] for item in known)
    return float(sum(item[key] for item in known) / total) if total else None


def _rmse(items: Sequence[dict[str, Any]], key: str = "position") -> float | None:
    mean = _ratio(items, key)
    return None if mean is None else float(np.sqrt(mean))


def _anees(items: Sequence[dict[str, Any]]) -> float | None:
    return _ratio(items, "nees", "nees_count")


def is_lost(reduced: dict[str, Any], lost_above_m: float) -> bool:
    """Whether a belief's position RMSE over the window is above the limit, or a robot has no estimate in it.

    A robot whose truth nobody knows is not lost, as far as can be told. A target nobody has told a robot of is no
    belief, hence not a lost one.
    """
    robots = list(reduced["robots"].values())
    return any(item["known"] and item["count"] == 0 for item in robots) or any(
        item["position"] > lost_above_m**2 * item["count"] for item in [*robots, *_tracks(reduced)]
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _largest(values: Sequence[float | None]) -> float | None:
    return max((value for value in values if value is not None), default=None)


def _entity(items: Sequence[dict[str, Any]], robot: bool) -> dict[str, Any]:
    """Figures of one robot, or of one robot's track of one target, over trials.

    RMSE, `anees` and `containment_3sigma` (the share of components within three of their standard deviations) are
    over all samples of all trials, `position_error_max_m` is the largest of all; `final_position_error_m` is the median
    over trials of the last error. Of each component's absolute error, `error_min` and `error_max` are medians over
    trials of the smallest and largest in a trial, `error_worst` is the largest of all. `dof` is the size of the state.
    `started_s` is the median over trials of the first instant with an estimate, `known_share` the share of the window
    that has one. `position_rmse_2s_m` and `error_max_2s_m` of a track are of instants shortly after a sighting of its
    target.
    """
    names = items[0]["names"]
    figures: dict[str, Any] = {"dof": len(names), "position_rmse_m": _rmse(items)}
    for key, name in (("heading", "heading_rmse_rad"), ("velocity", "velocity_rmse_mps")):
        if items[0][key] is not None:
            figures[name] = _rmse(items, key)
    if robot:
        figures["position_error_max_m"] = _largest([item["max_position"] for item in items])
        figures["final_position_error_m"] = _median([item["final"] for item in items])
    if "recent" in items[0]:
        recent = [item["recent"] for item in items]
        figures["position_rmse_2s_m"] = _rmse(recent)
        figures["error_max_2s_m"] = _largest([item["max_position"] for item in recent])
    figures["started_s"] = _median([item["started"] for item in items])
    figures["known_share"] = sum(item["estimated"] for item in items) / max(sum(item["window"] for item in items), 1)
    figures["anees"] = _anees(items)
    figures["containment_3sigma"] = _ratio(items, "inside")
    for key, of, over in (
        ("error_min", "min", _median),
        ("error_max", "max", _median),
        ("error_worst", "max", _largest),
    ):
        figures[key] = {
            name: over([item[of][index] for item in items if item[of] is not None]) for index, name in enumerate(names)
        }
    return figures


def fleet_figures(trials: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures pooled over robots, targets and trials."""
    robots = [item for trial in trials for item in trial["robots"].values()]
    tracks = [item for trial in trials for item in _tracks(trial)]
    return {
        "position_rmse_m": _rmse(robots),
        "heading_rmse_rad": _rmse(robots, "heading"),
        "anees": _anees(robots),
        "target_position_rmse_m": _rmse(tracks),
        "target_velocity_rmse_mps": _rmse(tracks, "velocity"),
        "target_anees": _anees(tracks),
    }


def trial_figures(reduced: dict[str, Any]) -> dict[str, Any]:
    """One trial as a row: fleet figures, each robot's position RMSE and NEES, and what all robots make of each target.
    """
    row = fleet_figures([reduced])
    if row["target_velocity_rmse_mps"] is None:
        # Targets whose state has no velocity.
        del row["target_velocity_rmse_mps"]
    for name, item in reduced["robots"].items():
        row[f"{name}_position_rmse_m"] = _rmse([item])
        row[f"{name}_nees"] = _anees([item])
    for name, owners in reduced["targets"].items():
        row[f"{name}_position_rmse_m"] = _rmse(list(owners.values()))
        if any(item["velocity"] is not None for item in owners.values()):
            row[f"{name}_velocity_rmse_mps"] = _rmse(list(owners.values()), "velocity")
    if "relative" in reduced:
        row |= trial_row(reduced["relative"])
    return row


def combine(trials: Sequence[dict[str, Any]], lost_above_m: float) -> dict[str, Any]:
    """The part of a summary that comes from estimates, over reduced trials in order.

    `robots`, `targets`, `fleet` and `bound` are over converged trials, `all` over all of them, `median` is the
    median over all trials of each trial's figure. If every trial is lost the figures are over all trials. The
    bound is a filter too: its own lost trials are left out of its figures and counted in `bound.lost`.
    `covariance_unusable` counts estimates in the window whose covariance is not positive definite, over all trials:
    they have no NEES. Raises `ValueError` without trials.
    """
    if not trials:
        raise ValueError("no trials to combine; give at least one")
    converged = [trial for trial in trials if not is_lost(trial, lost_above_m)]
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
        "covariance_unusable": sum(
            item["count"] - item["nees_count"]
            for trial in trials
            for item in [*trial["robots"].values(), *_tracks(trial)]
        ),
    }
    single = [fleet_figures([trial]) for trial in trials]
    summary["median"] = {key: _median([figures[key] for figures in single]) for key in single[0]}
    if first["bound"] is not None:
        bounds = [trial["bound"] for trial in used]
        held = [bound for bound in bounds if not is_lost(bound, lost_above_m)]
        kept = held or bounds
        summary["bound"] = {
            **fleet_figures(kept),
            "lost": len(bounds) - len(held),
            "robots": {name: _entity([bound["robots"][name] for bound in kept], True) for name in first["robots"]},
            "targets": {name: _entity([bound["targets"][name] for bound in kept], False) for name in first["targets"]},
        }
    if "relative" in first:
        summary["relative"] = combine_relatives([trial["relative"] for trial in trials if "relative" in trial])
        labels = [trial["relative"]["labels"] for trial in trials if "labels" in trial.get("relative", {})]
        if labels:
            summary["relative"]["labels"] = combine_labels(labels)
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
        series["bound_target_position_rmse_m"] = {
            n: over(lambda t, n=n: t["bound"]["targets"][n]["series"], True) for n in first["targets"]
        }
    return series
