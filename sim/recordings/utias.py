"""Loader of a UTIAS MR.CLAM folder (Leung et al. 2011): five robots, fifteen landmarks, Vicon ground truth.

Files are plain `.dat` or `.dat.xz`. Stamps become integer nanoseconds exactly, from the digits. The measurement files
hold barcode numbers, whatever their header says; each folder's own Barcodes.dat turns them into subjects. Subjects 1-5
are the robots `r1`-`r5`, 6-20 the landmarks `L6`-`L20`. Stamps are Unix time; the shift to time since the start is
`Recording.start_ns`.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.recordings.files import read_text
from sim.recordings.recording import (
    Array,
    Odometry,
    Recording,
    RecordingError,
    RobotRecording,
    Sightings,
    Stamps,
    Truth,
    common_span,
)

ROBOT_SUBJECTS = range(1, 6)
START_MARGIN_NS = 5_000_000_000
REMEDY = "give the path of an unpacked MR.CLAM data set"
CUT = "the file is cut or altered; fetch it again"
SECONDS = re.compile(r"([0-9]{1,10})(?:\.([0-9]*))?")


def load(path: str | Path) -> Recording:
    """Read a folder. Raises `RecordingError` naming the file (and line) and the remedy."""
    folder = Path(path)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder; {REMEDY}")
    counters: Counter[str] = Counter()
    barcodes = _barcodes(folder)
    places = _table(folder, "Landmark_Groundtruth", 5)
    landmarks = {
        f"L{subject}": (float(row[1]), float(row[2])) for subject, row in zip(_integers(places, 0), places.values)
    }
    robots, left_out = {}, []
    for number in ROBOT_SUBJECTS:
        name = f"r{number}"
        if _find(folder, f"Robot{number}_Odometry") is None or _find(folder, f"Robot{number}_Measurement") is None:
            left_out.append(name)
            continue
        has_truth = _find(folder, f"Robot{number}_Groundtruth") is not None
        robots[name] = RobotRecording(
            _odometry(folder, number, counters),
            _sightings(folder, number, barcodes, landmarks, counters),
            _truth(folder, number, counters) if has_truth else None,
        )
    if not robots:
        raise RecordingError(f"{folder}: no robot has both an odometry and a measurement file; {REMEDY}")
    counters["robot_files_missing"] = len(left_out)
    start_ns, end_ns = common_span(robots, START_MARGIN_NS)
    if end_ns <= start_ns:
        raise RecordingError(f"{folder}: the robots' files have no common span of time; take them from one run")
    return Recording(robots, landmarks, start_ns, end_ns, counters, tuple(left_out))


def _find(folder: Path, name: str) -> Path | None:
    for candidate in (folder / f"{name}.dat", folder / f"{name}.dat.xz"):
        if candidate.exists():
            return candidate
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """A file's data lines: their numbers, the first field as text, and all fields as numbers (K, columns)."""

    path: Path
    lines: list[int]
    first: list[str]
    values: Array

    def wrong(self, row: int, what: str) -> RecordingError:
        return RecordingError(f"{self.path}, line {self.lines[row]}: {what}; {CUT}")


def _table(folder: Path, name: str, columns: int) -> _Table:
    """Raises `RecordingError` for a missing or cut file, a line of other width, and what is not a finite number."""
    path = _find(folder, name)
    if path is None:
        raise RecordingError(f"{folder}: {name}.dat is missing; {REMEDY}")
    lines, first, numbers = [], [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != columns:
            raise RecordingError(f"{path}, line {number}: {len(fields)} columns instead of {columns}; {CUT}")
        try:
            row = [float(item) for item in fields]
        except ValueError:
            raise RecordingError(f"{path}, line {number}: not a number; {CUT}") from None
        lines.append(number)
        first.append(fields[0])
        numbers.append(row)
    table = _Table(path, lines, first, np.array(numbers, dtype=np.float64).reshape(len(numbers), columns))
    bad = np.flatnonzero(~np.isfinite(table.values).all(axis=1))
    if len(bad):
        raise table.wrong(int(bad[0]), "not a finite number")
    return table


def _integers(table: _Table, column: int) -> list[int]:
    values = table.values[:, column]
    bad = np.flatnonzero(values != np.rint(values))
    if len(bad):
        raise table.wrong(int(bad[0]), "a subject or barcode is not a whole number")
    return [int(value) for value in values]


def _barcodes(folder: Path) -> dict[int, int]:
    """Subject of each code."""
    table = _table(folder, "Barcodes", 2)
    found: dict[int, int] = {}
    for row, (subject, code) in enumerate(zip(_integers(table, 0), _integers(table, 1))):
        if code in found:
            raise table.wrong(row, f"code {code} stands for two subjects")
        found[code] = subject
    return found


def _stamped(folder: Path, name: str, columns: int, counters: Counter[str]) -> tuple[Stamps, _Table, NDArray[np.intp]]:
    """Stamps in order of time, the table, and the row of each stamp.

    Digits below a nanosecond are dropped. A float of Unix seconds would be off by a tenth of a microsecond.
    """
    table = _table(folder, name, columns)
    stamps = np.empty(len(table.first), dtype=np.int64)
    for row, text in enumerate(table.first):
        match = SECONDS.fullmatch(text)
        if match is None:
            raise table.wrong(row, "not a time in decimal seconds")
        whole, fraction = match.groups(default="")
        stamps[row] = int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
    counters["stamps_out_of_order"] += int(np.sum(np.diff(stamps) < 0))
    order = np.argsort(stamps, kind="stable")
    return stamps[order], table, order


def _motion(folder: Path, name: str, columns: int, counters: Counter[str], repeated: str) -> tuple[Stamps, Array]:
    """Strictly increasing stamps and the columns beside them; of repeated stamps the last line holds."""
    stamps, table, order = _stamped(folder, name, columns, counters)
    if not len(stamps):
        raise RecordingError(f"{table.path}: holds no data; {CUT}")
    keep = np.append(np.diff(stamps) > 0, True)
    counters[repeated] += int(np.sum(~keep))
    return stamps[keep], table.values[order, 1:][keep]


def _odometry(folder: Path, number: int, counters: Counter[str]) -> Odometry:
    stamps, values = _motion(folder, f"Robot{number}_Odometry", 3, counters, "odometry_stamps_repeated")
    dt = np.diff(stamps) * 1e-9
    turn = values[:-1, 1] * dt
    pose = np.zeros((len(stamps), 3))
    pose[1:, 2] = np.cumsum(turn)
    middle, chord = pose[:-1, 2] + turn / 2.0, values[:-1, 0] * dt * np.sinc(turn / 2.0 / np.pi)
    pose[1:, 0], pose[1:, 1] = np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle))
    return Odometry(stamps, values[:, 0], values[:, 1], pose)


def _sightings(
    folder: Path,
    number: int,
    barcodes: dict[int, int],
    landmarks: dict[str, tuple[float, float]],
    counters: Counter[str],
) -> Sightings:
    stamps, table, order = _stamped(folder, f"Robot{number}_Measurement", 4, counters)
    codes = _integers(table, 1)
    subjects: list[str] = []
    kept: list[int] = []
    for index, row in enumerate(order):
        subject = barcodes.get(codes[row])
        if subject is None:
            counters["unknown_codes"] += 1
        elif subject == number:
            counters["own_codes"] += 1
        elif subject not in ROBOT_SUBJECTS and f"L{subject}" not in landmarks:
            counters["unknown_landmarks"] += 1
        else:
            subjects.append(f"r{subject}" if subject in ROBOT_SUBJECTS else f"L{subject}")
            kept.append(index)
    use = np.array(kept, dtype=np.intp)
    return Sightings(stamps[use], tuple(subjects), table.values[order[use], 2], table.values[order[use], 3])


def _truth(folder: Path, number: int, counters: Counter[str]) -> Truth:
    stamps, pose = _motion(folder, f"Robot{number}_Groundtruth", 4, counters, "truth_stamps_repeated")
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Truth(stamps, pose)
