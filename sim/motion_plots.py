"""Pictures of robots that choose their motion: what distances cost them, and where they looked at some instants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.planning.optimal import (
    LEAST_M,
    MOST_UNSURE_M,
    PUBLISHED_LEAST_M,
    PUBLISHED_TARGET_MOST_M,
    SENSOR_MARGIN_M,
    spacing_cost,
)
from agent.planning.potential import PotentialLaw
from sim.metrics import TrialTrace
from sim.plots import GREY, PALE, colour, drawing, sideways
from sim.sight import View

Array = NDArray[np.float64]

TARGET = "#222222"
COLUMNS = 2
MARGIN_M = 3.0
"""Around who is furthest off the middle of a snapshot."""
HIGHEST = 60.0
"""Costs above this are off the picture: they rise without end."""


def potentials(sensor_range_m: float, path: Path) -> Path:
    """The push g over the distance (Su 2022, eq. 3.4), and the cost J (eq. 3.8), as printed and improved.

    Of J the target's upper bound follows from how far the sensor reaches.
    """
    law = PotentialLaw()
    with drawing(path, 4.6) as figure:
        push, cost = figure.subplots(1, 2)
        _push(push, law)
        _costs(cost, law.radio_range_m, sensor_range_m)
        for axes, side, ncols in ((push, "left", 1), (cost, "right", 2)):
            figure.legend(*axes.get_legend_handles_labels(), loc=f"outside lower {side}", ncols=ncols)
    return path


def _push(axes: Any, law: PotentialLaw) -> None:
    d = np.linspace(0.01, 1.1 * law.radio_range_m, 1200)
    capped = law.push(np.stack([d, np.zeros_like(d)], axis=-1))[:, 0]
    above = d > law.closest_m
    near = above & (d < law.apart_m)
    printed = np.where(near, 20.0 * (d - law.apart_m) / np.where(near, d - law.closest_m, 1.0), capped)
    axes.axhline(0.0, color=GREY, lw=0.8, zorder=1)
    axes.plot(d, capped, color=colour(0), lw=2.2, label="radial, capped")
    name = f"as printed: without end at {law.closest_m:g} m"
    axes.plot(d[above], printed[above], color=colour(1), lw=1.4, ls=(0, (5, 2)), label=name)
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.7)
    axes.set_ylim(-5000.0, 1.5)
    axes.set_yticks([-1000.0, -100.0, -10.0, -1.0, 0.0, 1.0])
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlim(0.0, d[-1])
    axes.set(title="push g: below 0 apart, above 0 together", xlabel="distance [m]")


def _costs(axes: Any, radio_range_m: float, sensor_range_m: float) -> None:
    d = np.linspace(0.01, 1.1 * radio_range_m, 1200)
    near, far = LEAST_M, LEAST_M + MOST_UNSURE_M
    seen = sensor_range_m - SENSOR_MARGIN_M
    axes.axvline(sensor_range_m, color=PALE, lw=1.0, zorder=1)
    axes.annotate(
        "the sensor\nends",
        (sensor_range_m, 0.98 * HIGHEST),
        xytext=(4, 0),
        textcoords="offset points",
        fontsize=8,
        color=GREY,
        va="top",
    )
    for least, most, shade, style, name in (
        (near, seen, colour(0), "-", "target, improved"),
        (PUBLISHED_LEAST_M, PUBLISHED_TARGET_MOST_M, colour(1), (0, (5, 2)), "target, published"),
        (near, radio_range_m, colour(2), "-", "neighbour, improved"),
        (PUBLISHED_LEAST_M, radio_range_m, colour(3), (0, (1, 1)), "neighbour, published"),
    ):
        axes.plot(d, spacing_cost(d, least, most), color=shade, ls=style, lw=1.6, label=name)
    axes.fill_between(
        d,
        np.minimum(spacing_cost(d, near, seen), HIGHEST),
        np.minimum(spacing_cost(d, far, seen), HIGHEST),
        where=d < 0.5 * (far + seen),
        color=colour(0),
        alpha=0.18,
        lw=0,
        label="improved, places unsure",
    )
    axes.set_ylim(-1.0, HIGHEST)
    axes.set_xlim(0.0, d[-1])
    axes.set(title="cost J of a distance", xlabel="distance [m]")


def snapshots(trace: TrialTrace, views: dict[str, list[View]], at_s: Sequence[float], path: Path) -> Path:
    """Where robots were and looked at instants [s] after the start, a panel each, all of one scale.

    Fields of view of `views` by robot, true paths until then, targets (stars) and where robots believe them to be
    (dots of their colour). Instants after the end are those of the end.
    """
    rows = [int(np.argmin(np.abs(trace.t_s - moment))) for moment in at_s]
    seen = [np.array(_everybody(trace, row)) for row in rows]
    middles = [0.5 * (places.min(axis=0) + places.max(axis=0)) for places in seen]
    half_m = MARGIN_M + max(float(np.abs(places - middle).max()) for places, middle in zip(seen, middles, strict=True))
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    with drawing(path, (9.8 / columns + 0.35) * lines) as figure:
        grid = figure.subplots(lines, columns, squeeze=False)
        for axes in grid.flat[len(rows) :]:
            axes.set_visible(False)
        for axes, row, middle in zip(grid.flat, rows, middles, strict=False):
            _snapshot(axes, trace, views, row, half_m)
            axes.set_xlim(middle[0] - half_m, middle[0] + half_m)
            axes.set_ylim(middle[1] - half_m, middle[1] + half_m)
            axes.set_aspect("equal")
            axes.locator_params(nbins=5, integer=True)
            axes.set_title(f"{trace.t_s[row]:g} s")
            axes.set_xlabel("east [m]")
        for axes in grid[:, 0]:
            axes.set_ylabel("north [m]")
    return path


def _everybody(trace: TrialTrace, row: int) -> list[tuple[float, float]]:
    """True places on the ground of robots and targets at a sample."""
    items = [*trace.robots.values(), *(next(iter(owners.values())) for owners in trace.targets.values())]
    return [(item.truth.item(row, item.position[0]), item.truth.item(row, item.position[1])) for item in items]


def _snapshot(axes: Any, trace: TrialTrace, views: dict[str, list[View]], row: int, half_m: float) -> None:
    from matplotlib.patches import Wedge

    for index, (name, item) in enumerate(trace.robots.items()):
        shade, (x, y) = colour(index), (line[: row + 1] for line in sideways(item, item.truth))
        heading = item.truth.item(row, item.angles[0]) if item.angles else 0.0
        for view in views.get(name, []):
            cos, sin = np.cos(heading), np.sin(heading)
            centre = (x[-1] + cos * view.x_m - sin * view.y_m, y[-1] + sin * view.x_m + cos * view.y_m)
            reach = 4.0 * half_m if view.max_range_m is None else view.max_range_m
            begin, end = np.degrees(heading + view.yaw_rad + 0.5 * view.fov_rad * np.array([-1.0, 1.0]))
            wedge = Wedge(centre, reach, begin, end, width=reach - view.min_range_m, color=shade, alpha=0.13, lw=0)
            axes.add_patch(wedge)
        axes.plot(x, y, color=shade, lw=0.8)
        ahead = (3, 0, np.degrees(heading) - 90.0)
        axes.plot(x[-1], y[-1], marker=ahead, ms=9, color=shade, mec="white", lw=0, zorder=4)
    for owners in trace.targets.values():
        first = next(iter(owners.values()))
        x, y = (line[: row + 1] for line in sideways(first, first.truth))
        axes.plot(x, y, color=TARGET, lw=0.8, ls=(0, (4, 2)))
        axes.plot(x[-1], y[-1], marker="*", ms=11, color=TARGET, mec="white", lw=0, zorder=3)
        for index, item in enumerate(owners.values()):
            believed = [line[row] for line in sideways(item, item.mean)]
            axes.plot(*believed, marker="o", ms=4, color=colour(index), mec="white", mew=0.5, lw=0, zorder=5)
