"""Figures over time, over the trials of a run and over several runs in one picture."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sim.motion_figures import distances
from sim.plots import DASHES, GREY, MAX_PAIRS, MAX_PANELS, PALE, colour, dash, drawing, logarithmic

Array = NDArray[np.float64]
Runs = list[tuple[str, dict[str, Any]]]
"""(name, `series` of its summary)."""

MAX_RUNS = 21
"""More lines than this in one picture cannot be told apart."""
MAX_LETTERS = 34
BAND = "#e9eff6"


def numbers(values: list[float | None]) -> Array:
    """NaN for null."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def pooled(lines: Iterable[list[float | None]], *, root: bool) -> Array:
    """Mean over lines at each instant, of what there is; with `root` the root of the mean of squares."""
    stack = np.array([numbers(line) for line in lines])
    stack = stack**2 if root else stack
    there = np.isfinite(stack)
    count = there.sum(axis=0)
    total = np.where(there, stack, 0.0).sum(axis=0)
    mean: Array = np.divide(total, count, out=np.full(stack.shape[1], np.nan), where=count > 0)
    return np.asarray(np.sqrt(mean)) if root else mean


def rmse_over_time(series: dict[str, Any], path: Path) -> Path:
    """Position RMSE over trials: each robot, and each target as the fleet tracks it; centralized filter dotted."""
    t_s, robots = series["t_s"], list(series["position_rmse_m"])
    bound, bound_targets = series.get("bound_position_rmse_m", {}), series.get("bound_target_position_rmse_m", {})
    targets = series.get("target_position_rmse_m", {})
    with drawing(path, 3.4 if not targets else 5.8) as figure:
        panels = figure.subplots(2 if targets else 1, 1, sharex=True, squeeze=False)[:, 0]
        for index, (name, values) in enumerate(series["position_rmse_m"].items()):
            panels[0].plot(t_s, numbers(values), color=colour(index), ls=dash(index), lw=1.2, label=name)
            if name in bound:
                panels[0].plot(t_s, numbers(bound[name]), color=colour(index), lw=0.9, ls=":")
        if bound:
            panels[0].plot([], [], color=GREY, ls=":", label="centralized")
        panels[0].set_ylabel("robots, RMSE [m]")
        for place, (target, owners) in enumerate(targets.items()):
            for name, values in owners.items():
                style = DASHES[place % len(DASHES)]
                panels[1].plot(t_s, numbers(values), color=colour(robots.index(name)), ls=style, lw=1.0)
            if target in bound_targets:
                panels[1].plot(t_s, numbers(bound_targets[target]), color=GREY, ls=":", lw=1.1)
        if targets:
            panels[1].set_ylabel("tracks, RMSE [m]")
        for axes in panels:
            axes.set_ylim(bottom=0.0)
            axes.set_xlim(t_s[0], t_s[-1])
        panels[-1].set_xlabel("time [s]")
        figure.legend(loc="outside right upper")
    return path


def anees_over_time(series: dict[str, Any], dof: int | None, trials: int, path: Path) -> Path:
    """NEES per degree of freedom of each robot, averaged over trials.

    With `dof`, the size of all states, the band that holds 95 % of such averages if the filter is honest.
    """
    with drawing(path, 3.2) as figure:
        axes = figure.subplots()
        if dof is not None:
            low, high = chi2.ppf([0.025, 0.975], dof * trials) / (dof * trials)
            axes.axhspan(low, high, color=BAND, lw=0, zorder=0)
        axes.axhline(1.0, color=GREY, lw=0.8, zorder=1)
        for index, (name, values) in enumerate(series["anees"].items()):
            axes.plot(series["t_s"], numbers(values), color=colour(index), ls=dash(index), lw=1.1, label=name)
        logarithmic(axes, between=True)
        axes.set_xlim(series["t_s"][0], series["t_s"][-1])
        axes.set(xlabel="time [s]", ylabel="ANEES")
        figure.legend(loc="outside right upper")
    return path


def pair_distances(t_s: Array, places: Array, collision_m: float, path: Path) -> Path:
    """Distances of pairs of robots at places (K, n, 2 or 3): the nearest pair's bold, collisions shaded.

    Of many pairs those `MAX_PAIRS` that come nearest.
    """
    gaps = distances(places)[:, *np.triu_indices(places.shape[1], 1)]
    gaps = gaps[:, np.argsort(gaps.min(axis=0), kind="stable")[:MAX_PAIRS]]
    with drawing(path, 3.4) as figure:
        axes = figure.subplots()
        axes.axhspan(0.0, collision_m, color="#fbe3d6", lw=0, zorder=0)
        axes.plot(t_s, gaps, color=PALE, lw=0.7, zorder=1)
        axes.plot(t_s, gaps.min(axis=1), color=colour(0), lw=1.4, zorder=2, label="nearest pair")
        axes.plot([], [], color=PALE, lw=0.7, label="each pair")
        axes.fill_between([], [], color="#fbe3d6", label="collision")
        axes.set_xlim(t_s[0], t_s[-1])
        axes.set_ylim(bottom=0.0)
        axes.set(xlabel="time [s]", ylabel="distance [m]")
        figure.legend(loc="outside right upper")
    return path


# --- several runs ------------------------------------------------------------------------------------------


def _tracks(series: dict[str, Any]) -> list[list[float | None]]:
    return [line for owners in series.get("target_position_rmse_m", {}).values() for line in owners.values()]


def _end(runs: Runs) -> float:
    return max(float(series["t_s"][-1]) for _, series in runs)


def _bounds(runs: Runs, key: str) -> list[tuple[int | None, list[float], Array]]:
    """(run, times, RMSE) of the centralized filters, equal ones once, under the first run that has it.

    If all are equal the run is None: it is nobody's own.
    """
    found: list[tuple[int | None, list[float], Array]] = []
    for index, (_, series) in enumerate(runs):
        if series.get(key):
            t_s, line = series["t_s"], pooled(series[key].values(), root=True)
            if not any(t_s == times and np.allclose(line, other, equal_nan=True) for _, times, other in found):
                found.append((index, t_s, line))
    return found if len(found) > 1 else [(None, t_s, line) for _, t_s, line in found]


def _legend(figure: Any, axes: Any, runs: Runs, bounds: bool) -> None:
    """Every run above the panels, whether or not it has a line in `axes`."""
    styles = [(colour(index), dash(index), shortened(name)) for index, (name, _) in enumerate(runs)]
    styles += [(GREY, ":", "centralized")] if bounds else []
    marks = [axes.plot([], [], color=shade, ls=style, label=name)[0] for shade, style, name in styles]
    longest = max(len(name) for _, _, name in styles)
    figure.legend(handles=marks, loc="outside upper left", ncols=max(1, min(len(marks), 130 // (longest + 8))))


def shortened(name: str) -> str:
    """What fits into a legend."""
    return name if len(name) <= MAX_LETTERS else f"{name[: MAX_LETTERS - 1]}…"


def _line(axes: Any, index: int, t_s: list[float], values: Array) -> None:
    axes.plot(t_s, values, color=colour(index), ls=dash(index), lw=1.3)


def _bound_line(axes: Any, index: int | None, t_s: list[float], values: Array) -> None:
    axes.plot(t_s, values, color=GREY if index is None else colour(index), ls=":", lw=1.2)


def fleet_rmse(runs: Runs, path: Path, *, narrow: bool = False) -> Path:
    """Position RMSE over time of each run's fleet, and of its tracks; the centralized filter dotted.

    With `narrow` the axes of errors are logarithmic, so that runs of very different errors fit into one picture.
    """
    tracked = any(_tracks(series) for _, series in runs)
    own, of_targets = _bounds(runs, "bound_position_rmse_m"), _bounds(runs, "bound_target_position_rmse_m")
    end_s = _end(runs)
    with drawing(path, 6.2 if tracked else 3.8) as figure:
        panels = figure.subplots(2 if tracked else 1, 1, sharex=True, squeeze=False)[:, 0]
        for index, (_, series) in enumerate(runs):
            _line(panels[0], index, series["t_s"], pooled(series["position_rmse_m"].values(), root=True))
            if _tracks(series):
                _line(panels[1], index, series["t_s"], pooled(_tracks(series), root=True))
        for axes, bounds in zip(panels, (own, of_targets)):
            for bound in bounds:
                _bound_line(axes, *bound)
        panels[0].set_ylabel("robots, RMSE [m]")
        if tracked:
            panels[1].set_ylabel("tracks, RMSE [m]")
        for axes in panels:
            if narrow:
                logarithmic(axes, between=True)
            else:
                axes.set_ylim(bottom=0.0)
            axes.set_xlim(0.0, end_s)
        panels[-1].set_xlabel("time [s]")
        _legend(figure, panels[0], runs, bool(own))
    return path


def each_rmse(runs: Runs, path: Path) -> Path:
    """Position RMSE over time, a panel per robot and per track that any run has, a line per run."""
    panels: dict[str, list[tuple[int, list[float], list[float | None]]]] = {}
    for robots_first in (True, False):
        for index, (_, series) in enumerate(runs):
            named = dict(series["position_rmse_m"])
            if not robots_first:
                tracks = series.get("target_position_rmse_m", {})
                named = {f"{t} by {name}": line for t, owners in tracks.items() for name, line in owners.items()}
            for name, line in named.items():
                panels.setdefault(name, []).append((index, series["t_s"], line))
    shown = dict(list(panels.items())[:MAX_PANELS])
    columns = min(4, len(shown))
    rows = -(-len(shown) // columns)
    end_s = _end(runs)
    with drawing(path, 1.7 * rows + 0.9) as figure:
        grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
        for axes in grid.flat[len(shown) :]:
            axes.set_visible(False)
        for place, (axes, (name, lines)) in enumerate(zip(grid.flat, shown.items())):
            for index, t_s, line in lines:
                _line(axes, index, t_s, numbers(line))
            axes.set_title(name)
            axes.set_ylim(bottom=0.0)
            axes.set_xlim(0.0, end_s)
            if place % columns == 0:
                axes.set_ylabel("RMSE [m]")
            if place + columns >= len(shown):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
        _legend(figure, grid[0, 0], runs, False)
    return path


def fleet_anees(runs: Runs, path: Path) -> Path:
    """NEES per degree of freedom over time, averaged over the robots and trials of each run."""
    end_s = _end(runs)
    with drawing(path, 3.6) as figure:
        axes = figure.subplots()
        axes.axhline(1.0, color=GREY, lw=0.8, zorder=1)
        for index, (_, series) in enumerate(runs):
            _line(axes, index, series["t_s"], pooled(series["anees"].values(), root=False))
        logarithmic(axes, between=True)
        axes.set_xlim(0.0, end_s)
        axes.set(xlabel="time [s]", ylabel="ANEES")
        _legend(figure, axes, runs, False)
    return path
