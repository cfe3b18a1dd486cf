"""Loader of part 3 of the multi-view drone tracking set (Li et al. 2020, arXiv 2003.04784): cameras that see one drone.

The folder of the part holds `cameras.txt`, `detections/camK.txt` and `rtk.txt`, plain or `.xz`; calibrations are in
the folder `calibration` beside it. Camera K is the robot `camK`, which stands; the drone is the target `t1`, whose
truth is the RTK track in its local east-north-up frame. Pixels are those of an ideal pinhole camera: lens distortion is
taken off, and pixels are made square.

Frames become time by the authors' table and the rate of camera 0. The track has no stamps; instant 0 is its first row.
Its shift from the cameras' clock is found from the data, and so are the poses of the cameras, since the surveyed places
are in another frame. Both are fitted to the truth: they are better than a survey in the field would be.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from network.messages import Mount
from sim.recordings.files import read_text
from sim.recordings.lens import Lens
from sim.recordings.recording import (
    Array,
    Camera,
    Recording,
    RecordingError,
    RobotRecording,
    Sightings,
    Stamps,
    Truth,
)
from sim.recordings.resection import CameraPose, ResectionError, Sighted, Track, clock_shift, pose

TARGET = "t1"
RTK_HZ = 5.0
STEP_NS = round(1e9 / RTK_HZ)
CLOCKS = (
    (1.0, 0.0),
    (1.9982, -2026.04),
    (2.0163, -1102.90),
    (2.3978, -602.21),
    (2.0001, -1922.12),
    (1.1989, -164.85),
)
"""Frame n of camera K is frame alpha n + beta of camera 0, by (alpha, beta): the authors' table of part 3."""
RATE_TOLERANCE = 0.01
REMEDY = "give the path of the folder dataset3 of the drone tracking set, with the folder calibration beside it"
CUT = "the file is cut or altered; fetch it again"
_CAMERA = re.compile(r"cam(\d+)\s*-\s*(\S+)\Z")


def load(path: str | Path) -> Recording:
    """Read a folder. Raises `RecordingError` naming the file (and line) and the remedy."""
    folder = Path(path)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder; {REMEDY}")
    counters: Counter[str] = Counter()
    rows = _rows(_file(folder, "rtk.txt"), comments=1)
    if len(rows) < 2:
        raise RecordingError(f"{_file(folder, 'rtk.txt')}: holds no track; {CUT}")
    track = Track(np.arange(len(rows)) / RTK_HZ, rows)
    models = _models(folder)
    rate_hz = _calibration(folder, models[0])[1]
    seen, left_out = {}, []
    for number, model in enumerate(models):
        if _found(folder / "detections" / f"cam{number}.txt") is None:
            left_out.append(f"cam{number}")
            continue
        lens, fps = _calibration(folder, model)
        _check_rate(folder, number, fps, rate_hz)
        seen[f"cam{number}"] = _seen(folder, number, lens, rate_hz, counters)
    if not seen:
        raise RecordingError(f"{folder}: detections are missing; {REMEDY}")
    try:
        shift_s = clock_shift([item.sighted for item in seen.values()], track)
        poses = {name: pose(item.sighted, track, shift_s) for name, item in seen.items()}
    except ResectionError as error:
        raise RecordingError(f"{folder}: {error}; take all files from one part of the set") from None
    first = min(float(item.sighted.t_s[0]) for item in seen.values()) + shift_s
    last = max(float(item.sighted.t_s[-1]) for item in seen.values()) + shift_s
    start_ns = max(0, math.floor(first * RTK_HZ) * STEP_NS)
    end_ns = min((len(rows) - 1) * STEP_NS, math.ceil(last * RTK_HZ) * STEP_NS)
    robots = {name: _standing(item, poses[name], shift_s, (start_ns, end_ns)) for name, item in seen.items()}
    robots[TARGET] = _flying(rows)
    return Recording(robots, {}, start_ns, end_ns, counters, tuple(left_out))


def _found(path: Path) -> Path | None:
    return next((item for item in (path, path.with_name(f"{path.name}.xz")) if item.exists()), None)


def _file(folder: Path, name: str) -> Path:
    found = _found(folder / name)
    if found is None:
        raise RecordingError(f"{folder}: {name} is missing; {REMEDY}")
    return found


def _rows(path: Path, comments: int) -> Array:
    """Numbers (K, 3) of a file after its first lines. Raises `RecordingError` naming the line."""
    found = []
    for number, line in enumerate(read_text(path).splitlines()[comments:], start=comments + 1):
        fields = line.split()
        if not fields:
            continue
        try:
            row = [float(item) for item in fields]
        except ValueError:
            raise RecordingError(f"{path}, line {number}: not a number; {CUT}") from None
        if len(row) != 3 or not all(math.isfinite(item) for item in row):
            raise RecordingError(f"{path}, line {number}: not three finite numbers; {CUT}")
        found.append(row)
    return np.array(found).reshape(-1, 3)


def _models(folder: Path) -> list[str]:
    """The model of each camera, in their order."""
    path = _file(folder, "cameras.txt")
    matches = [_CAMERA.match(line.strip()) for line in read_text(path).splitlines() if line.strip()]
    models = [match[2] for match in matches if match is not None]
    numbers = [int(match[1]) for match in matches if match is not None]
    if len(models) != len(matches) or numbers != list(range(len(numbers))) or not 0 < len(numbers) <= len(CLOCKS):
        raise RecordingError(f"{path}: not lines 'camK - MODEL' of cameras 0 to {len(CLOCKS) - 1} in order; {REMEDY}")
    return models


def _calibration(folder: Path, model: str) -> tuple[Lens, float]:
    """Lens and frame rate [Hz] of a camera; its file bears the model's name, or that and a number."""
    place = folder.absolute().parent / "calibration"
    files = {item.stem: item for item in sorted(place.rglob("*.json"))}
    path = files.get(model) or next((item for stem, item in files.items() if stem.startswith(f"{model}_")), None)
    if path is None:
        raise RecordingError(f"{place}: {model}.json is missing; {REMEDY}")
    try:
        data = json.loads(read_text(path))
        matrix, distortion = np.array(data["K-matrix"], dtype=np.float64), [float(item) for item in data["distCoeff"]]
        width, height = (float(item) for item in data["resolution"])
        fps = float(data["fps"])
        if matrix.shape != (3, 3) or len(distortion) not in (4, 5) or min(matrix[0, 0], matrix[1, 1], fps) <= 0.0:
            raise ValueError("of another form")
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not a camera's calibration ({error}); {CUT}") from None
    k1, k2, p1, p2, k3 = [*distortion, 0.0][:5]
    lens = Lens(
        (float(matrix[0, 0]), float(matrix[1, 1])),
        (float(matrix[0, 2]), float(matrix[1, 2])),
        (width, height),
        (k1, k2, p1, p2, k3),
    )
    return lens, fps


def _check_rate(folder: Path, number: int, fps: float, reference_hz: float) -> None:
    """The table of clocks has to be that of the cameras at hand. Raises `RecordingError`."""
    alpha = CLOCKS[number][0]
    if abs(reference_hz / fps / alpha - 1.0) > RATE_TOLERANCE:
        raise RecordingError(
            f"{folder}: cam{number} has {fps:g} frames/s and not {reference_hz / alpha:.4g}, as in part 3; {REMEDY}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What a camera saw on the cameras' common clock, as points at unit distance and as ideal pixels (K, 2)."""

    lens: Lens
    sighted: Sighted
    pixel: Array


def _seen(folder: Path, number: int, lens: Lens, rate_hz: float, counters: Counter[str]) -> _Seen:
    """Of a frame that is there twice the first line holds; a pixel 0, 0 stands for none."""
    path = _file(folder, f"detections/cam{number}.txt")
    rows = _rows(path, comments=1)
    rows = rows[np.any(rows[:, 1:] != 0.0, axis=1)]
    _, first = np.unique(rows[:, 0], return_index=True)
    counters["frames_repeated"] += len(rows) - len(first)
    rows = rows[first]
    plane = lens.plane(rows[:, 1:])
    usable = np.isfinite(plane[:, 0])
    counters["pixels_out_of_the_lens"] += int(np.sum(~usable))
    if not np.any(usable):
        raise RecordingError(f"{path}: the drone is in no frame; {CUT}")
    alpha, beta = CLOCKS[number]
    t_s = (alpha * rows[usable, 0] + beta) / rate_hz
    return _Seen(lens, Sighted(t_s, plane[usable]), lens.undistorted(rows[usable, 1:]))


def _standing(seen: _Seen, posed: CameraPose, shift_s: float, span_ns: tuple[int, int]) -> RobotRecording:
    """A camera that stands: its heading is where it looks, roll and pitch are those of its mount."""
    t_ns = np.rint((seen.sighted.t_s + shift_s) * 1e9).astype(np.int64)
    nothing = np.full(len(t_ns), np.nan)
    heading, mount = _mounted(posed)
    place = np.array([*posed.centre, heading])
    truth = Truth(np.array(span_ns, dtype=np.int64), np.stack([place, place]))
    sightings = Sightings(t_ns, (TARGET,) * len(t_ns), nothing, nothing, seen.pixel)
    return RobotRecording(None, sightings, truth, Camera(mount, seen.lens.ideal()))


def _mounted(posed: CameraPose) -> tuple[float, Mount]:
    """Heading [rad] of a camera and its mount on a level robot that heads the same way."""
    right, down, forward = posed.turn
    heading = math.atan2(forward[1], forward[0])
    pitch = math.atan2(-forward[2], math.hypot(forward[0], forward[1]))
    roll = math.atan2(-right[2], -down[2])
    return heading, (0.0, 0.0, 0.0, roll, pitch, 0.0)


def _flying(rows: Array) -> RobotRecording:
    """The drone, which sends nothing."""
    t_ns: Stamps = np.arange(len(rows), dtype=np.int64) * STEP_NS
    nothing = Sightings(np.empty(0, dtype=np.int64), (), np.empty(0), np.empty(0))
    return RobotRecording(None, nothing, Truth(t_ns, np.column_stack([rows, np.zeros(len(rows))])))
