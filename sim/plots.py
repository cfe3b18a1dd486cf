"""Plots of a run. matplotlib is imported here alone, and only when a report is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.metrics import TrialTrace, errors, nees

Array = NDArray[np.float64]
Contacts = list[tuple[float, str, str]]

# Okabe and Ito's palette: distinguishable with any colour vision.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
GREY = "#8a8f98"


class ReportUnavailable(RuntimeError):
    """matplotlib is missing; the message says how to get it."""


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError:
        raise ReportUnavailable("plots need matplotlib: pip install 'cofix[report]'") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    pyplot.rcParams.update(
        {
            "font.size": 9.5,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.edgecolor": "#c5c9d0",
            "axes.labelcolor": "#3c4250",
            "xtick.color": "#5a6070",
            "ytick.color": "#5a6070",
            "axes.grid": True,
            "grid.color": "#eceef2",
            "axes.axisbelow": True,
            "legend.frameon": False,
            "figure.dpi": 110,
        }
    )
    return pyplot


def colour(index: int) -> str:
    return PALETTE[index % len(PALETTE)]


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path, bbox_inches="tight", facecolor="white")
    _pyplot().close(figure)
    return path


def _ellipse(axes: Any, mean: Array, cov: Array, shade: str) -> None:
    values, vectors = np.linalg.eigh(cov[:2, :2])
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    ring = vectors @ (3.0 * np.sqrt(np.clip(values, 0.0, None))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    axes.plot(mean[0] + ring[0], mean[1] + ring[1], color=shade, lw=0.6, alpha=0.55)


def trajectories(trace: TrialTrace, landmarks: dict[str, tuple[float, float]], path: Path) -> Path:
    """True and estimated paths with 3-sigma ellipses now and then."""
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(7.6, 6.6))
    if landmarks:
        points = np.array(list(landmarks.values()))
        axes.scatter(points[:, 0], points[:, 1], marker="^", s=26, color=GREY, label="landmark", zorder=3)
    for index, (name, item) in enumerate(trace.robots.items()):
        shade = colour(index)
        axes.plot(item.truth[:, 0], item.truth[:, 1], color="#b9bec8", lw=0.9, zorder=1)
        axes.plot(item.mean[:, 0], item.mean[:, 1], color=shade, lw=1.0, label=name, zorder=2)
        axes.scatter(*item.truth[0, :2], color=shade, s=22, zorder=4)
        seen = np.flatnonzero(np.isfinite(item.mean[:, 0]))
        for row in seen[:: max(1, len(seen) // 24)]:
            _ellipse(axes, item.mean[row], item.cov[row], shade)
    for owners in trace.targets.values():
        first = next(iter(owners.values()))
        axes.plot(first.truth[:, 0], first.truth[:, 1], color="black", lw=1.2, ls="--", label="target")
        for index, item in enumerate(owners.values()):
            axes.plot(item.mean[:, 0], item.mean[:, 1], color=colour(index), lw=0.6, alpha=0.7)
    axes.plot([], [], color="#b9bec8", label="truth")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east [m]", ylabel="north [m]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _save(figure, path)


def error_bands(trace: TrialTrace, path: Path) -> Path:
    """Errors of each robot inside their 3-sigma bands."""
    plt = _pyplot()
    rows = len(trace.robots)
    figure, grid = plt.subplots(rows, 3, figsize=(10.5, 1.55 * rows + 0.6), sharex=True, squeeze=False)
    for index, (name, item) in enumerate(trace.robots.items()):
        error = errors(item)
        sigma = 3.0 * np.sqrt(np.diagonal(item.cov, axis1=1, axis2=2))
        for column, label in enumerate(("x [m]", "y [m]", "heading [rad]")[: error.shape[1]]):
            axes = grid[index, column]
            axes.fill_between(trace.t_s, -sigma[:, column], sigma[:, column], color=colour(index), alpha=0.16, lw=0)
            axes.plot(trace.t_s, error[:, column], color=colour(index), lw=0.8)
            if index == 0:
                axes.set_title(f"error in {label}", fontsize=9.5, color="#3c4250")
        grid[index, 0].set_ylabel(name, rotation=0, ha="right", va="center")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.tight_layout(pad=0.5)
    return _save(figure, path)


def target_bands(trace: TrialTrace, path: Path) -> Path:
    """Position error of each robot's track of each target, beside its 3-sigma bound."""
    plt = _pyplot()
    pairs = [(target, robot, item) for target, own in trace.targets.items() for robot, item in own.items()]
    columns = 2
    rows = -(-len(pairs) // columns)
    figure, grid = plt.subplots(rows, columns, figsize=(10.5, 1.6 * rows + 0.6), sharex=True, squeeze=False)
    for axes in grid.flat[len(pairs) :]:
        axes.set_visible(False)
    for index, (target, robot, item) in enumerate(pairs):
        axes = grid.flat[index]
        error = errors(item)
        bound = 3.0 * np.sqrt(np.linalg.eigvalsh(_finite(item.cov)[:, :2, :2])[:, -1])
        axes.fill_between(trace.t_s, 0.0, bound, color=colour(index), alpha=0.16, lw=0)
        axes.plot(trace.t_s, np.hypot(error[:, 0], error[:, 1]), color=colour(index), lw=0.9)
        axes.set_title(f"{target} as tracked by {robot}", fontsize=9.5, color="#3c4250", loc="left")
        axes.set_ylabel("error [m]")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    figure.tight_layout(pad=0.5)
    return _save(figure, path)


def _finite(cov: Array) -> Array:
    return np.where(np.isfinite(cov), cov, 0.0)


def consistency(trace: TrialTrace, path: Path) -> Path:
    """NEES per degree of freedom of each robot over time, with the 95 % band of one sample."""
    from scipy.stats import chi2

    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(10.5, 3.0))
    dof = next(iter(trace.robots.values())).truth.shape[1]
    low, high = chi2.ppf([0.025, 0.975], dof) / dof
    axes.axhspan(low, high, color="#eef3f8", zorder=0, label="95 % of samples")
    axes.axhline(1.0, color=GREY, lw=0.8)
    for index, (name, item) in enumerate(trace.robots.items()):
        axes.plot(trace.t_s, np.clip(nees(item), 1e-3, None), color=colour(index), lw=0.8, label=name)
    axes.set_yscale("log")
    axes.set(xlabel="time [s]", ylabel="NEES per dof")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _save(figure, path)


def contact_times(contacts: Contacts, end_s: float, path: Path) -> Path:
    """When each pair's contacts were applied."""
    plt = _pyplot()
    pairs = sorted({tuple(sorted((a, b))) for _, a, b in contacts})
    figure, axes = plt.subplots(figsize=(10.5, 0.32 * max(len(pairs), 1) + 0.9))
    for row, pair in enumerate(pairs):
        times = [t for t, a, b in contacts if tuple(sorted((a, b))) == pair]
        axes.vlines(times, row - 0.32, row + 0.32, color=colour(row), lw=0.7)
    axes.set_yticks(range(len(pairs)), [f"{a} - {b}" for a, b in pairs])
    axes.set_xlim(0.0, end_s)
    axes.set_ylim(len(pairs) - 0.4, -0.6)
    axes.set_xlabel("time [s]")
    axes.grid(axis="y", visible=False)
    return _save(figure, path)


def rmse_over_time(series: dict[str, Any], path: Path) -> Path:
    """Position RMSE over trials of each robot, with the centralized bound dashed."""
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(10.5, 3.2))
    for index, (name, values) in enumerate(series["position_rmse_m"].items()):
        axes.plot(series["t_s"], _numbers(values), color=colour(index), lw=1.1, label=name)
        bound = series.get("bound_position_rmse_m", {}).get(name)
        if bound is not None:
            axes.plot(series["t_s"], _numbers(bound), color=colour(index), lw=0.9, ls=":")
    if "bound_position_rmse_m" in series:
        axes.plot([], [], color=GREY, ls=":", label="centralized")
    axes.set(xlabel="time [s]", ylabel="position RMSE [m]")
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return _save(figure, path)


def _numbers(values: list[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values])
