"""Errors of robots and tracks component by component, inside the 3-sigma envelopes they claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.metrics import StateTrace, TrialTrace, Window, components, errors
from sim.plots import PALE, colour, drawing, finite, worst

Array = NDArray[np.float64]

OUTSIDE = "#f1f2f5"
USUAL = 0.97
"""A panel shows this share of the envelope and every error: one wide start must not flatten the rest."""


def label(name: str) -> str:
    """`x_m` as people read it."""
    quantity, _, unit = name.rpartition("_")
    units = {"m": "[m]", "rad": "[rad]", "mps": "[m/s]"}
    return f"{quantity} {units[unit]}" if unit in units else name.replace("_", " ")


def robot_errors(trace: TrialTrace, window: Window, path: Path) -> Path:
    """A row per robot, a column per component of its state."""
    shown = [(name, index, item) for index, name, item in worst(trace.robots)]
    return _grid(trace.t_s, shown, window, path)


def track_errors(trace: TrialTrace, window: Window, path: Path) -> Path:
    """A row per track, in the colour of the robot that keeps it."""
    robots = list(trace.robots)
    tracks = [(target, robot) for target, owners in trace.targets.items() for robot in owners]
    found = worst({f"{target} by {robot}": trace.targets[target][robot] for target, robot in tracks})
    shown = [(name, robots.index(tracks[index][1]), item) for index, name, item in found]
    return _grid(trace.t_s, shown, window, path)


def _grid(t_s: Array, shown: list[tuple[str, int, StateTrace]], window: Window, path: Path) -> Path:
    names = [components(item) for _, _, item in shown]
    columns = max(len(own) for own in names)
    alike = all(own == names[0] for own in names)
    with drawing(path, 1.25 * len(shown) + 0.7) as figure:
        grid = figure.subplots(len(shown), columns, sharex=True, squeeze=False)
        for row, (name, index, item) in enumerate(shown):
            error, sigma = errors(item), np.sqrt(np.maximum(np.diagonal(finite(item.cov), axis1=1, axis2=2), 0.0))
            sigma[~np.isfinite(error)] = np.nan
            for column, axes in enumerate(grid[row]):
                if column >= error.shape[1]:
                    axes.set_visible(False)
                    continue
                _envelope(axes, t_s, error[:, column], 3.0 * sigma[:, column], colour(index), window)
                if row == 0 or not alike:
                    axes.set_title(label(names[row][column]))
            grid[row, 0].set_ylabel(name, color=colour(index), fontweight="bold")
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        figure.align_ylabels(grid[:, 0])
    return path


def _envelope(axes: Any, t_s: Array, error: Array, band: Array, shade: str, window: Window) -> None:
    if window[0] > t_s[0]:
        axes.axvspan(t_s[0], window[0], color=OUTSIDE, lw=0, zorder=0)
    if window[1] < t_s[-1]:
        axes.axvspan(window[1], t_s[-1], color=OUTSIDE, lw=0, zorder=0)
    axes.axhline(0.0, color=PALE, lw=0.6, zorder=1)
    axes.fill_between(t_s, -band, band, color=shade, alpha=0.14, lw=0)
    for side in (-band, band):
        axes.plot(t_s, side, color=shade, lw=0.7, ls=(0, (4, 2)), alpha=0.7)
    axes.plot(t_s, error, color=shade, lw=1.0)
    axes.set_xlim(t_s[0], t_s[-1])
    if np.isfinite(error).any():
        limit = 1.1 * max(float(np.nanquantile(band, USUAL)), float(np.nanmax(np.abs(error))))
        if limit > 0.0:
            axes.set_ylim(-limit, limit)
