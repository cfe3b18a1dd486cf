"""Plots of a run as PNG files. matplotlib is imported here alone, and only when a report is asked for."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from sim.metrics import StateTrace, TrialTrace, nees, position_errors

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
def drawing(path: Path, height_in: float) -> Iterator[Any]:
    """A figure that is written to `path` at the end; no window system and no global state is touched."""
    require()
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from PIL import Image

    with matplotlib.rc_context(LOOK):
        figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        whole = io.BytesIO()
        figure.savefig(whole, dpi=DPI, facecolor="white")
    with Image.open(whole) as image:
        _reduced(image.convert("RGB")).save(path, optimize=True)


def _reduced(image: Any) -> Any:
    """The picture in 256 colours, a third of its size: white and the robots' colours exact, all else nearly."""
    from PIL import Image

    exact = [(255, 255, 255), *(tuple(int(code[k : k + 2], 16) for k in (1, 3, 5)) for code in PALETTE)]
    free = 256 - len(exact)
    found = image.quantize(free, dither=Image.Dither.NONE)
    shades, places = np.asarray(image), np.array(found)
    for place, shade in enumerate(exact):
        places[(shades == shade).all(axis=2)] = free + place
    reduced = Image.fromarray(places)
    palette = found.getpalette()[: 3 * free]
    reduced.putpalette([*palette, *[0] * (3 * free - len(palette)), *(value for shade in exact for value in shade)])
    return reduced


def colour(index: int) -> str:
    """Colour of the robot at `index` of the fleet, the same in every plot and table."""
    return PALETTE[index % len(PALETTE)]


def dash(index: int) -> Any:
    """Line style of the robot at `index`: another one for each round of the palette."""
    return DASHES[index // len(PALETTE) % len(DASHES)]


def finite(cov: Array) -> Array:
    """Zero where there is nothing."""
    return np.where(np.isfinite(cov), cov, 0.0)


def logarithmic(axes: Any, *, between: bool = False) -> None:
    """A logarithmic y axis with plain numbers, with `between` also at 2 and 5 times the powers of ten."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if between and f"{value:e}"[0] in "25" else "")


def sideways(item: StateTrace, states: Array) -> tuple[Array, Array]:
    """x and y (K,) of states (K, n)."""
    return states[:, item.position[0]], states[:, item.position[1]]


def worst(items: dict[str, StateTrace]) -> list[tuple[int, str, StateTrace]]:
    """(place, name, trace) of at most `MAX_PANELS` entries, those with the largest errors, in the fleet's order."""
    numbered = [(index, name, item) for index, (name, item) in enumerate(items.items())]

    def size(entry: tuple[int, str, StateTrace]) -> float:
        found = position_errors(entry[2])
        return float(np.sum(found[np.isfinite(found)] ** 2))

    return sorted(sorted(numbered, key=size, reverse=True)[:MAX_PANELS], key=lambda entry: entry[0])


def _ellipse(axes: Any, mean: Array, cov: Array, shade: str) -> None:
    """3-sigma ellipse of a horizontal position (2,), (2, 2)."""
    values, vectors = np.linalg.eigh(finite(cov))
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    ring = vectors @ (3.0 * np.sqrt(np.clip(values, 0.0, None))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    x, y = mean[0] + ring[0], mean[1] + ring[1]
    axes.fill(x, y, color=shade, alpha=0.07, lw=0)
    axes.plot(x, y, color=shade, lw=0.6, alpha=0.45)


def _ellipses(axes: Any, item: StateTrace, shade: str) -> None:
    plane = list(item.position[:2])
    seen = np.flatnonzero(np.isfinite(item.mean).all(axis=1))
    for row in seen[:: max(1, -(-len(seen) // MAX_ELLIPSES))]:
        _ellipse(axes, item.mean[row, plane], item.cov[row][np.ix_(plane, plane)], shade)


def trajectories(trace: TrialTrace, landmarks: dict[str, tuple[float, float]], path: Path) -> Path:
    """True and estimated paths with 3-sigma ellipses now and then; a target's ellipses are its first tracker's."""
    with drawing(path, 7.2) as figure:
        axes = figure.subplots()
        for name, (x, y) in landmarks.items():
            axes.plot(x, y, marker="^", ms=6, color=GREY, lw=0, zorder=3)
            if len(landmarks) <= MAX_NAMED:
                axes.annotate(name, (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7.5, color=GREY)
        for index, (name, item) in enumerate(trace.robots.items()):
            shade = colour(index)
            _ellipses(axes, item, shade)
            east, north = sideways(item, item.truth)
            axes.plot(east, north, color="#9aa0ab", lw=0.8, zorder=2)
            axes.plot(*sideways(item, item.mean), color=shade, ls=dash(index), lw=1.1, label=name, zorder=2.5)
            axes.plot(east[0], north[0], marker="o", ms=7, mfc="white", mec=shade, mew=1.8, lw=0, zorder=4)
            axes.plot(east[-1], north[-1], marker="o", ms=6, color=shade, lw=0, zorder=4)
        for target, owners in trace.targets.items():
            first = next(iter(owners.values()))
            _ellipses(axes, first, "#222222")
            for index, item in enumerate(owners.values()):
                axes.plot(*sideways(item, item.mean), color=colour(index), ls=dash(index), lw=0.7, alpha=0.8)
            east, north = sideways(first, first.truth)
            axes.plot(east, north, color="#222222", lw=1.1, ls=(0, (4, 2)), zorder=3)
            axes.plot(east[-1], north[-1], marker="*", ms=12, color="#222222", mec="white", lw=0, zorder=5)
            end = (east[-1], north[-1])
            axes.annotate(target, end, xytext=(8, 4), textcoords="offset points", color="#222222")
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


def consistency(trace: TrialTrace, path: Path) -> Path:
    """NEES per degree of freedom of each robot over time, with the band that holds 95 % of an honest filter's."""
    shown = worst(trace.robots)
    columns = 2 if len(shown) in (2, 4) else min(3, len(shown))
    rows = -(-len(shown) // columns)
    with drawing(path, 1.5 * rows + 0.5) as figure:
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
            logarithmic(axes)
            axes.set_xlim(trace.t_s[0], trace.t_s[-1])
            if place % columns == 0:
                axes.set_ylabel("NEES per dof")
            if place + columns >= len(shown):
                axes.set_xlabel("time [s]")
                axes.tick_params(labelbottom=True)
        grid[0, 0].set_ylim(bottom=NEES_FLOOR)
    return path
