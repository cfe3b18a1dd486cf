"""Plots of a run as PNG files. matplotlib is imported here alone, and only when a report is asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sim.metrics import StateTrace, TrialTrace, errors, nees

Array = NDArray[np.float64]
Contacts = list[tuple[float, str, str]]

# Okabe and Ito's palette, distinguishable with any colour vision; its yellow is left out, too pale on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4d4d4d")
DASHES = ("-", (0, (5, 2)), (0, (1, 1)))
INK, SOFT, GREY, PALE = "#3c4250", "#5a6070", "#8a8f98", "#b9bec8"
WIDTH_IN = 10.5
DPI = 150
MAX_PANELS = 12
MAX_PAIRS = 45
MAX_ELLIPSES = 24
MAX_NAMED = 8
NEES_FLOOR = 1e-2

LOOK: Any = {
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#c5c9d0",
    "axes.labelcolor": INK,
    "axes.titlesize": 9.5,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "axes.grid": True,
    "grid.color": "#eceef2",
    "axes.axisbelow": True,
    "legend.frameon": False,
}


class ReportUnavailable(RuntimeError):
    """matplotlib is missing; the message says how to get it."""


def require() -> None:
    """Raises `ReportUnavailable` when there is nothing to plot with."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise ReportUnavailable("plots need matplotlib: pip install 'cofix[report]'") from None


@contextmanager
def _figure(path: Path, height_in: float) -> Iterator[Any]:
    """A figure that is written to `path` at the end; no window system and no global state is touched."""
    require()
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        figure.savefig(path, dpi=DPI, facecolor="white")


def colour(index: int) -> str:
    """Colour of the robot at `index` of the fleet, the same in every plot and table."""
    return PALETTE[index % len(PALETTE)]


def _dash(index: int) -> Any:
    return DASHES[index // len(PALETTE) % len(DASHES)]


def _finite(cov: Array) -> Array:
    return np.where(np.isfinite(cov), cov, 0.0)


def _sigma(cov: Array) -> Array:
    """Standard deviations (K, n), NaN without an estimate."""
    return np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))


def _worst(items: dict[str, StateTrace]) -> list[tuple[int, str, StateTrace]]:
    """(place, name, trace) of at most `MAX_PANELS` entries, those with the largest errors, in the fleet's order."""
    numbered = [(index, name, item) for index, (name, item) in enumerate(items.items())]

    def size(entry: tuple[int, str, StateTrace]) -> float:
        found = errors(entry[2])[:, :2]
        return float(np.sum(found[np.isfinite(found)] ** 2))

    return sorted(sorted(numbered, key=size, reverse=True)[:MAX_PANELS], key=lambda entry: entry[0])


def _ellipse(axes: Any, mean: Array, cov: Array, shade: str) -> None:
    values, vectors = np.linalg.eigh(_finite(cov[:2, :2]))
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    ring = vectors @ (3.0 * np.sqrt(np.clip(values, 0.0, None))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    x, y = mean[0] + ring[0], mean[1] + ring[1]
    axes.fill(x, y, color=shade, alpha=0.07, lw=0)
    axes.plot(x, y, color=shade, lw=0.6, alpha=0.45)


def _ellipses(axes: Any, item: StateTrace, shade: str) -> None:
    seen = np.flatnonzero(np.isfinite(item.mean).all(axis=1))
    for row in seen[:: max(1, -(-len(seen) // MAX_ELLIPSES))]:
        _ellipse(axes, item.mean[row], item.cov[row], shade)


def trajectories(trace: TrialTrace, landmarks: dict[str, tuple[float, float]], path: Path) -> Path:
    """True and estimated paths with 3-sigma ellipses now and then; a target's ellipses are its first tracker's."""
    with _figure(path, 7.2) as figure:
        axes = figure.subplots()
        for name, (x, y) in landmarks.items():
            axes.plot(x, y, marker="^", ms=6, color=GREY, lw=0, zorder=3)
            if len(landmarks) <= MAX_NAMED:
                axes.annotate(name, (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7.5, color=GREY)
        for index, (name, item) in enumerate(trace.robots.items()):
            shade = colour(index)
            _ellipses(axes, item, shade)
            axes.plot(item.truth[:, 0], item.truth[:, 1], color="#9aa0ab", lw=0.8, zorder=2)
            axes.plot(item.mean[:, 0], item.mean[:, 1], color=shade, ls=_dash(index), lw=1.1, label=name, zorder=2.5)
            axes.plot(*item.truth[0, :2], marker="o", ms=7, mfc="white", mec=shade, mew=1.8, lw=0, zorder=4)
            axes.plot(*item.truth[-1, :2], marker="o", ms=6, color=shade, lw=0, zorder=4)
        for target, owners in trace.targets.items():
            first = next(iter(owners.values()))
            _ellipses(axes, first, "#222222")
            for index, item in enumerate(owners.values()):
                axes.plot(item.mean[:, 0], item.mean[:, 1], color=colour(index), ls=_dash(index), lw=0.7, alpha=0.8)
            axes.plot(first.truth[:, 0], first.truth[:, 1], color="#222222", lw=1.1, ls=(0, (4, 2)), zorder=3)
            axes.plot(*first.truth[-1, :2], marker="*", ms=12, color="#222222", mec="white", lw=0, zorder=5)
            axes.annotate(target, first.truth[-1, :2], xytext=(8, 4), textcoords="offset points", color="#222222")
        axes.plot([], [], color="#9aa0ab", lw=0.8, label="truth")
        axes.plot([], [], marker="o", ms=7, mfc="white", mec=GREY, mew=1.8, lw=0, label="start")
        axes.plot([], [], marker="o", ms=6, color=GREY, lw=0, label="end")
        if trace.targets:
            axes.plot([], [], marker="*", ms=11, color="#222222", lw=1.1, ls=(0, (4, 2)), label="target, truth")
        if landmarks:
            axes.plot([], [], marker="^", ms=6, color=GREY, lw=0, label="landmark")
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel="east [m]", ylabel="north [m]")
        figure.legend(loc="outside right upper")
    return path


def error_bands(trace: TrialTrace, path: Path) -> Path:
    """Errors of each robot in x, y and heading (or velocity) inside the 3-sigma band it claims."""
    shown = _worst(trace.robots)
    columns = max(item.truth.shape[1] for _, _, item in shown)
    with _figure(path, 1.35 * len(shown) + 0.6) as figure:
        grid = figure.subplots(len(shown), columns, sharex=True, squeeze=False)
        for row, (index, name, item) in enumerate(shown):
            error, sigma = errors(item), 3.0 * _sigma(item.cov)
            labels = ("x [m]", "y [m]", "heading [rad]") if item.angles else ("x [m]", "y [m]", "vx [m/s]", "vy [m/s]")
            for column in range(columns):
                axes = grid[row, column]
                if column >= error.shape[1]:
                    axes.set_visible(False)
                    continue
                band = sigma[:, column]
                axes.fill_between(trace.t_s, -band, band, color=colour(index), alpha=0.16, lw=0)
                axes.plot(trace.t_s, error[:, column], color=colour(index), lw=0.8)
                axes.axhline(0.0, color=PALE, lw=0.6, zorder=0)
                axes.set_title(f"{name}: {labels[column]}" if column < len(labels) else name)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
    return path


def target_bands(trace: TrialTrace, path: Path) -> Path:
    """Position error of each robot's track of each target, under the 3-sigma bound it claims."""
    tracks = {(target, robot): item for target, owners in trace.targets.items() for robot, item in owners.items()}
    robots = list(trace.robots)
    shown = _worst({f"{target} as tracked by {robot}": item for (target, robot), item in tracks.items()})
    owner = [robot for _, robot in tracks]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    with _figure(path, 1.6 * rows + 0.5) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for place, axes in enumerate(grid.flat):
            if place >= len(shown):
                axes.set_visible(False)
                continue
            index, name, item = shown[place]
            shade, error = colour(robots.index(owner[index])), errors(item)
            bound = 3.0 * np.sqrt(np.maximum(np.linalg.eigvalsh(_finite(item.cov)[:, :2, :2])[:, -1], 0.0))
            bound[~np.isfinite(item.mean[:, 0])] = np.nan
            axes.fill_between(trace.t_s, 0.0, bound, color=shade, alpha=0.16, lw=0)
            axes.plot(trace.t_s, np.hypot(error[:, 0], error[:, 1]), color=shade, lw=1.0)
            axes.set_title(name)
            if place % columns == 0:
                axes.set_ylabel("error [m]")
            if place + columns >= len(shown):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
        grid[0, 0].set_ylim(bottom=0.0)
    return path


def consistency(trace: TrialTrace, path: Path) -> Path:
    """NEES per degree of freedom of each robot over time, with the band that holds 95 % of an honest filter's."""
    shown = _worst(trace.robots)
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    with _figure(path, 1.5 * rows + 0.5) as figure:
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
        for place, axes in enumerate(grid.flat):
            if place >= len(shown):
                axes.set_visible(False)
                continue
            index, name, item = shown[place]
            dof = item.truth.shape[1]
            low, high = chi2.ppf([0.025, 0.975], dof) / dof
            axes.axhspan(low, high, color="#e9eff6", lw=0, zorder=0)
            axes.axhline(1.0, color=GREY, lw=0.8, zorder=1)
            axes.plot(trace.t_s, np.maximum(nees(item), NEES_FLOOR), color=colour(index), lw=0.8)
            axes.set_title(name)
            axes.set_yscale("log")
            if place % columns == 0:
                axes.set_ylabel("NEES per dof")
            if place + columns >= len(shown):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
        grid[0, 0].set_ylim(bottom=NEES_FLOOR)
    return path


def contact_times(contacts: Contacts, end_s: float, path: Path) -> Path:
    """When a side of a pair used a contact, a row per pair with their number; the busiest pairs if there are many."""
    times: dict[tuple[str, str], list[float]] = {}
    for t_s, a, b in contacts:
        times.setdefault((min(a, b), max(a, b)), []).append(t_s)
    pairs = sorted(sorted(times, key=lambda pair: (-len(times[pair]), pair))[:MAX_PAIRS])
    with _figure(path, 0.3 * len(pairs) + 0.8) as figure:
        axes = figure.subplots()
        for row, pair in enumerate(pairs):
            axes.vlines(times[pair], row - 0.32, row + 0.32, color=PALETTE[0], lw=0.7, alpha=0.75)
        axes.set_yticks(range(len(pairs)), [f"{a} – {b}   {len(times[a, b])}" for a, b in pairs])
        axes.set_xlim(0.0, end_s)
        axes.set_ylim(len(pairs) - 0.4, -0.6)
        axes.set_xlabel("time [s]")
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
    return path


def rmse_over_time(series: dict[str, Any], path: Path) -> Path:
    """Position RMSE over trials: each robot, and each target as the fleet tracks it; centralized filter dotted."""
    bound = series.get("bound_position_rmse_m", {})
    targets = series.get("target_position_rmse_m", {})
    with _figure(path, 3.4 if not targets else 5.8) as figure:
        panels = figure.subplots(2 if targets else 1, 1, sharex=True, squeeze=False)[:, 0]
        for index, (name, values) in enumerate(series["position_rmse_m"].items()):
            panels[0].plot(series["t_s"], _numbers(values), color=colour(index), ls=_dash(index), lw=1.2, label=name)
            if name in bound:
                panels[0].plot(series["t_s"], _numbers(bound[name]), color=colour(index), lw=0.9, ls=":")
        if bound:
            panels[0].plot([], [], color=GREY, ls=":", label="centralized")
        panels[0].set_ylabel("robots, RMSE [m]")
        robots = list(series["position_rmse_m"])
        for place, (_, owners) in enumerate(targets.items()):
            for name, values in owners.items():
                index = robots.index(name)
                panels[1].plot(series["t_s"], _numbers(values), color=colour(index), ls=DASHES[place % 3], lw=1.0)
        if targets:
            panels[1].set_ylabel("tracks, RMSE [m]")
        for axes in panels:
            axes.set_ylim(bottom=0.0)
        panels[-1].set_xlabel("time [s]")
        figure.legend(loc="outside right upper")
    return path


def _numbers(values: list[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
