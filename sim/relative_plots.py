"""Pictures of where robots take each other to be, relative to their own bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.plots import GREY, PALE, colour, drawing, logarithmic
from sim.relative_figures import RIGHT_M, Pair, RelativeTrace, ShownGate, heading_errors, place_errors, right

Array = NDArray[np.float64]

MAX_LEADERS = 4
"""Robots that a picture shows."""

LEAST_M = 0.01
"""Smaller errors are drawn as that."""


def _by_leader(traces: dict[Pair, RelativeTrace]) -> dict[str, dict[str, RelativeTrace]]:
    found: dict[str, dict[str, RelativeTrace]] = {}
    for (leader, peer), trace in traces.items():
        found.setdefault(leader, {})[peer] = trace
    return dict(list(found.items())[:MAX_LEADERS])


def _colours(traces: dict[Pair, RelativeTrace]) -> dict[str, str]:
    names = sorted({name for pair in traces for name in pair})
    return {name: colour(index) for index, name in enumerate(names)}


def frames(traces: dict[Pair, RelativeTrace], path: Path) -> Path:
    """In the body frame of each leader, seen from above: true ways of the others, and where they are taken to be.

    As De Silva, Mann, Gosine 2015, fig. 4; what is wrong is a cross.
    """
    leaders, shades = _by_leader(traces), _colours(traces)
    columns = min(2, len(leaders))
    rows = -(-len(leaders) // columns)
    with drawing(path, 5.2 * rows) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, (leader, peers) in zip(grid.flat, leaders.items()):
            axes.plot(0.0, 0.0, marker=">", ms=9, color=shades[leader], lw=0, zorder=4)
            for peer, trace in peers.items():
                good = right(trace)
                known = np.isfinite(trace.mean[:, 0])
                axes.plot(trace.truth[:, 0], trace.truth[:, 1], color=PALE, lw=1.6, zorder=1)
                axes.plot(*trace.mean[good, :2].T, marker=".", ms=3.5, lw=0, color=shades[peer], label=peer, zorder=3)
                wrong = known & ~good
                axes.plot(*trace.mean[wrong, :2].T, marker="x", ms=4.0, lw=0, color=shades[peer], alpha=0.6, zorder=2)
            axes.plot([], [], color=PALE, lw=1.6, label="truth")
            axes.plot([], [], marker="x", ms=4.0, lw=0, color=GREY, label="wrong")
            axes.set_title(f"in the frame of {leader}")
            axes.set_aspect("equal", adjustable="datalim")
            axes.set(xlabel="forward [m]", ylabel="left [m]")
            axes.legend(loc="best", fontsize=8)
        for axes in list(grid.flat)[len(leaders) :]:
            axes.set_visible(False)
    return path


def gate(shown: ShownGate, path: Path) -> Path:
    """Bearings of one scan, and what the hypotheses of one robot expected, with their gates.

    As De Silva, Mann, Gosine 2015, fig. 3: the spread that linearization says, and the gate that is used, wider
    where a heading is wide and the form is the published one.
    """
    test, angles = shown.test, np.linspace(0.0, 2.0 * np.pi, 90)
    x, y, z = shown.truth[:3]
    true = np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    with drawing(path, 5.0) as figure:
        axes = figure.subplots()
        for expected, spread, used, weight in zip(test.expected, test.spread, test.gate, test.weight, strict=True):
            for cov, line, shade in ((used, "-", colour(0)), (spread, ":", colour(1))):
                root = np.linalg.cholesky(test.limit * cov)
                edge = np.degrees(expected + (root @ np.stack([np.cos(angles), np.sin(angles)])).T)
                axes.plot(*edge.T, color=shade, lw=1.1, ls=line, alpha=0.35 + 0.65 * float(weight))
            axes.plot(*np.degrees(expected), marker="o", ms=3 + 6 * float(weight), color=colour(0), lw=0)
        axes.plot(*np.degrees(test.bearings).T, marker="x", ms=7, mew=1.6, color=colour(6), lw=0, label="bearing")
        axes.plot(*true, marker="*", ms=11, color=colour(2), lw=0, zorder=4, label=f"true direction of {shown.peer}")
        axes.plot([], [], marker="o", ms=5, color=colour(0), lw=0, label="expected, larger if it weighs more")
        axes.plot([], [], color=colour(0), lw=1.1, label="gate")
        axes.plot([], [], color=colour(1), lw=1.1, ls=":", label="linearized")
        axes.set_title(f"{shown.robot} looks for {shown.peer} at {shown.t_s:.2f} s")
        axes.set(xlabel="azimuth [deg]", ylabel="elevation [deg]", xlim=(-190.0, 190.0), ylim=(-65.0, 65.0))
        axes.legend(loc="upper right", fontsize=8)
    return path


def over_time(t_s: Array, traces: dict[Pair, RelativeTrace], path: Path) -> Path:
    """Hypotheses, errors of place and heading of the one believed, and how ambiguous it is, over time, by leader.

    As De Silva, Mann, Gosine 2015, fig. 5. Below the dashed line a place is right.
    """
    leaders, shades = _by_leader(traces), _colours(traces)
    with drawing(path, 8.4) as figure:
        grid = figure.subplots(4, len(leaders), sharex=True, sharey="row", squeeze=False)
        for column, (leader, peers) in enumerate(leaders.items()):
            tracks, places, headings, doubts = grid[:, column]
            for peer, trace in peers.items():
                tracks.plot(t_s, trace.tracks, color=shades[peer], lw=0.9, drawstyle="steps-post", label=peer)
                places.plot(t_s, np.maximum(place_errors(trace), LEAST_M), color=shades[peer], lw=0.9)
                headings.plot(t_s, np.degrees(heading_errors(trace)), color=shades[peer], lw=0.9)
                doubts.plot(t_s, trace.ambiguity, color=shades[peer], lw=0.9)
            places.axhline(RIGHT_M, color=GREY, lw=0.8, ls="--")
            logarithmic(places)
            tracks.set_title(f"{leader} of the others")
            tracks.legend(loc="upper right", fontsize=8, ncols=2)
            doubts.set_ylim(0.0, 0.55)
            doubts.set_xlim(t_s[0], t_s[-1])
            doubts.set_xlabel("time [s]")
        for axes, label in zip(grid[:, 0], ("hypotheses", "place, error [m]", "heading, error [deg]", "ambiguity")):
            axes.set_ylabel(label)
    return path


def shares(identified: list[list[float]], path: Path) -> Path:
    """Share of robots that are identified over time, of all trials."""
    t_s, share = np.array(identified).T
    with drawing(path, 2.8) as figure:
        axes = figure.subplots()
        axes.plot(t_s, 100.0 * share, color=colour(0), lw=1.3)
        axes.set_ylim(0.0, 103.0)
        axes.set_xlim(t_s[0], t_s[-1])
        axes.set(xlabel="time [s]", ylabel="identified [%]")
    return path
