"""When a measurement was there to be had, and when a contact made use of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.plots import PALETTE, Contacts, colour, drawing
from sim.store import Instants

Array = NDArray[np.float64]
Spell = tuple[float, float]

MAX_ROWS = 45
MAX_IDLE = 15
FINEST = 1000.0
"""A gap shorter than this part of the run is not visible, hence none."""
HAD = "#bcd7ea"


@dataclass(slots=True)
class Row:
    """One line of the picture: spells with a measurement [s], and instants something was made of it [s]."""

    spells: list[Spell] = field(default_factory=list)
    used: list[float] = field(default_factory=list)

    def share(self, end_s: float) -> float:
        """Part of the run in which there was a measurement."""
        return sum(end - start for start, end in self.spells) / end_s if end_s > 0.0 else 0.0


def spells(times: Array, gap_s: float) -> list[Spell]:
    """First and last instants of the stretches of ascending `times` without a gap above `gap_s`."""
    if not len(times):
        return []
    cuts = np.flatnonzero(np.diff(times) > gap_s)
    starts, ends = times[np.r_[0, cuts + 1]], times[np.r_[cuts, len(times) - 1]]
    return list(zip(starts.tolist(), ends.tolist()))


def usual_gap(times: Sequence[Array], end_s: float) -> float:
    """Longest gap between measurements that still counts as "all the time": one and a half periods."""
    gaps = [np.diff(item) for item in times if len(item) > 1]
    period = float(np.median(np.concatenate(gaps))) if gaps else 0.0
    return max(1.5 * period + 1e-6, end_s / FINEST)


def pair_rows(
    measured: Instants, contacts: Contacts, robots: Sequence[str], end_s: float
) -> dict[tuple[str, str], Row]:
    """By pair of robots, whichever of them measures; and the contacts either side applied.

    In a small fleet pairs that never met have a row too. Empty if nobody ever met.
    """
    times: dict[tuple[str, str], list[Array]] = {}
    for (robot, of), instants in measured.items():
        if ":" not in of:
            times.setdefault((min(robot, of), max(robot, of)), []).append(instants)
    gap_s = usual_gap([item for items in times.values() for item in items], end_s)
    rows = {pair: Row(spells(np.unique(np.concatenate(items)), gap_s)) for pair, items in times.items()}
    for t_s, a, b in contacts:
        rows.setdefault((min(a, b), max(a, b)), Row()).used.append(t_s)
    every = list(combinations(sorted(robots), 2))
    if rows and len(every) <= MAX_IDLE:
        rows = {pair: Row() for pair in every} | rows
    return dict(sorted(rows.items()))


def sighting_rows(
    measured: Instants, robots: Sequence[str], targets: Sequence[str], end_s: float
) -> dict[tuple[str, str], Row]:
    """By (robot, target), in a small fleet also those that never saw it; a robot's landmarks are one row together."""
    times: dict[tuple[str, str], list[Array]] = {}
    for (robot, of), instants in measured.items():
        kind, colon, name = of.partition(":")
        if colon:
            times.setdefault((robot, name if kind == "target" else "landmarks"), []).append(instants)
    gap_s = usual_gap([item for items in times.values() for item in items], end_s)
    rows = {key: Row(spells(np.unique(np.concatenate(items)), gap_s)) for key, items in sorted(times.items())}
    every = [(robot, target) for target in targets for robot in robots]
    return {key: Row() for key in every} | rows if rows and len(every) <= MAX_IDLE else rows


def pair_availability(rows: dict[tuple[str, str], Row], end_s: float, path: Path) -> Path:
    """A row per pair: a bar while one could measure the other, a tick for each contact applied.

    The busiest pairs if there are many.
    """
    busy = sorted(rows, key=lambda pair: (-len(rows[pair].used), -rows[pair].share(end_s), pair))[:MAX_ROWS]
    lines = {
        f"{a} – {b}": (rows[a, b], f"{rows[a, b].share(end_s):.0%}  ·  {len(rows[a, b].used):,}", HAD)
        for a, b in sorted(busy)
    }
    return _draw(lines, end_s, path)


def target_availability(rows: dict[tuple[str, str], Row], robots: list[str], end_s: float, path: Path) -> Path:
    """A row per robot and target: a bar while the target could be measured."""
    shown = sorted(rows, key=lambda key: (-rows[key].share(end_s), key))[:MAX_ROWS]
    lines = {
        f"{robot} → {of}": (rows[robot, of], f"{rows[robot, of].share(end_s):.0%}", colour(robots.index(robot)))
        for robot, of in sorted(shown, key=lambda key: (key[1], robots.index(key[0])))
    }
    return _draw(lines, end_s, path)


def _draw(lines: dict[str, tuple[Row, str, str]], end_s: float, path: Path) -> Path:
    with drawing(path, 0.27 * len(lines) + 0.75) as figure:
        axes = figure.subplots()
        thinnest = end_s / FINEST
        for place, (row, _, shade) in enumerate(lines.values()):
            bars = [(start, max(end - start, thinnest)) for start, end in row.spells]
            axes.broken_barh(bars, (place - 0.36, 0.72), color=shade, lw=0)
            if row.used:
                axes.vlines(row.used, place - 0.2, place + 0.2, color=PALETTE[0], lw=0.7)
        axes.set_yticks(range(len(lines)), list(lines))
        right = axes.secondary_yaxis("right")
        right.set_yticks(range(len(lines)), [note for _, note, _ in lines.values()])
        for axis in (axes, right):
            axis.tick_params(axis="y", length=0)
        for side in ("left", "right"):
            axes.spines[side].set_visible(False)
        right.spines["right"].set_visible(False)
        axes.set_xlim(0.0, end_s)
        axes.set_ylim(len(lines) - 0.4, -0.6)
        axes.set_xlabel("time [s]")
        axes.grid(axis="y", visible=False)
    return path
