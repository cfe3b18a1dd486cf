"""One trial as a moving picture: its samples packed into the page, and a player that draws them."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.availability import FINEST, spells, usual_gap
from sim.metrics import StateTrace, position_errors
from sim.page import section
from sim.plots import colour, finite
from sim.store import Stored

Array = NDArray[np.float64]

MAX_FRAMES = 400
MAX_NUMBERS = 500_000
"""Two bytes each, a third more as text."""
NOTHING = -32768
STEPS = 65_000
PLAYED_S = 30.0
"""A trial is played in about so many seconds."""
SPEEDS = (0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
SCRIPT = Path(__file__).with_name("player.js")


def player(stored: Stored) -> str:
    """A section with a canvas, its controls, the data and the script."""
    data = json.dumps(film(stored), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    body = f"""<div class="player" id="player">
<div class="stage"><canvas></canvas><button type="button" class="big" aria-label="play">▶</button></div>
<div class="bar"><button type="button" class="play" aria-label="play or pause">▶</button>
<input type="range" class="time" min="0" max="1000" value="0" step="1" aria-label="time">
<span class="clock"></span><select class="speed" aria-label="speed"></select></div>
<div class="bar"><label><input type="checkbox" class="ellipses" checked> 3σ</label>
<label><input type="checkbox" class="paths" checked> true paths</label>
<label><input type="checkbox" class="links" checked> measurements and contacts</label>
<label{"" if stored.views else " hidden"}><input type="checkbox" class="views" checked> fields of view</label></div>
<div class="tall"><table class="now"></table></div>
<script type="application/json">{data}</script>
<script>{SCRIPT.read_text(encoding="utf-8")}</script></div>"""
    words = "Filled: where a robot believes to be, with its 3σ ellipse. Hollow: where it is."
    if stored.trace.targets:
        words += " Star: the target; small dots: what each robot believes of it."
    if stored.views:
        words += " Sectors: what a robot's sensors may see."
    words += " Thin lines: someone can be measured. Flashes: a contact is used."
    return section("The trial", body, words)


def film(stored: Stored) -> dict[str, Any]:
    """What the player draws: frames of all states as packed numbers, spells of measurements, instants of contacts."""
    trace = stored.trace
    tracks = [(target, robot) for target, owners in trace.targets.items() for robot in owners]
    states: list[StateTrace] = [*trace.robots.values(), *(trace.targets[target][robot] for target, robot in tracks)]
    count = max(2, min(MAX_FRAMES, MAX_NUMBERS // (10 * max(1, len(states)))))
    frames = np.unique(np.linspace(0, len(trace.t_s) - 1, count).round().astype(int))
    end_s = float(trace.t_s[-1])
    speed = min(SPEEDS, key=lambda speed: abs(np.log(speed * PLAYED_S / max(end_s, 1e-9))))
    gap_s = usual_gap(list(stored.measured.values()), end_s)
    contacts: dict[tuple[str, str], list[float]] = {}
    for t_s, a, b in stored.contacts:
        contacts.setdefault((min(a, b), max(a, b)), []).append(t_s)
    return {
        "t": [round(float(value), 3) for value in trace.t_s[frames]],
        "speeds": [item for item in SPEEDS if speed / 10.0 <= item <= speed * 10.0],
        "speed": speed,
        "robots": [
            {"name": name, "colour": colour(index), "views": stored.views.get(name, []), **_frames(item, frames)}
            for index, (name, item) in enumerate(trace.robots.items())
        ],
        "targets": [
            {
                "name": target,
                "tracks": [
                    {
                        "robot": list(trace.robots).index(robot),
                        **_frames(item, frames, truth=robot == next(iter(owners))),
                    }
                    for robot, item in owners.items()
                ],
            }
            for target, owners in trace.targets.items()
        ],
        "landmarks": [{"name": name, "at": [x, y]} for name, (x, y) in stored.landmarks.items()],
        "seen": [
            {"robot": robot, "of": of, "spells": _rounded(spells(times, max(gap_s, end_s / FINEST)))}
            for (robot, of), times in stored.measured.items()
        ],
        "contacts": [
            {"pair": pair, "t": sorted({round(t_s, 2) for t_s in times})} for pair, times in sorted(contacts.items())
        ],
    }


def _rounded(found: list[tuple[float, float]]) -> list[list[float]]:
    return [[round(start, 2), round(end, 2)] for start, end in found]


def _frames(item: StateTrace, frames: NDArray[np.int64], *, truth: bool = True) -> dict[str, Any]:
    """Channels by name: estimate x, y, h(eading), z; truth X, Y, H; semiaxes a, b and angle p of the ellipse; error e.

    The ellipse and its error bound are of 3 sigma; a robot's truth is left out where another state carries it.
    """
    plane = list(item.position[:2])
    mean, real = item.mean[frames], item.truth[frames]
    values, vectors = np.linalg.eigh(finite(item.cov[frames][:, plane][:, :, plane]))
    axes = 3.0 * np.sqrt(np.clip(values, 0.0, None))
    axes[~np.isfinite(mean[:, plane]).all(axis=1)] = np.nan
    channels = {"x": mean[:, plane[0]], "y": mean[:, plane[1]]}
    channels |= {"a": axes[:, 1], "b": axes[:, 0], "p": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])}
    channels["e"] = position_errors(item)[frames]
    if truth:
        channels |= {"X": real[:, plane[0]], "Y": real[:, plane[1]]}
    if item.angles:
        channels["h"] = _wrapped(mean[:, item.angles[0]])
        if truth:
            channels["H"] = _wrapped(real[:, item.angles[0]])
    if len(item.position) > 2:
        channels["z"] = mean[:, item.position[2]]
    return {"channels": {name: pack(values) for name, values in channels.items()}}


def _wrapped(angle: Array) -> Array:
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def pack(values: Array) -> list[Any]:
    """[lowest, step, base64 of little-endian int16]: a number is lowest + step * (code + 32500), -32768 is none."""
    there = np.isfinite(values)
    low, high = (float(values[there].min()), float(values[there].max())) if there.any() else (0.0, 0.0)
    step = (high - low) / STEPS or 1.0
    codes = np.full(len(values), NOTHING, dtype="<i2")
    codes[there] = np.round((values[there] - low) / step).astype(np.int64) - STEPS // 2
    return [float(f"{low:.7g}"), float(f"{step:.7g}"), base64.b64encode(codes.tobytes()).decode()]


def unpack(packed: list[Any]) -> Array:
    """The numbers (K,) of `pack`, NaN for none; the player does the same."""
    low, step, text = packed
    codes = np.frombuffer(base64.b64decode(text), dtype="<i2").astype(np.float64)
    return np.where(codes == NOTHING, np.nan, low + step * (codes + STEPS // 2))
