"""Loader of a UTIAS MR.CLAM folder (Leung et al. 2011): five robots, fifteen landmarks, Vicon ground truth.

Files are plain `.dat` or `.dat.xz`. Stamps become integer nanoseconds exactly. The measurement files hold barcode
numbers, whatever their header says; each folder's own Barcodes.dat turns them into subjects. Subjects 1-5 are the
robots `r1`-`r5`, 6-20 the landmarks `L6`-`L20`.
"""

from __future__ import annotations

import lzma
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import between

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

ROBOT_SUBJECTS = range(1, 6)
START_MARGIN_NS = 5_000_000_000


class RecordingError(ValueError):
    """A recording that cannot be used; one line names the file and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Commanded velocities, held until the next stamp: t_ns (K,), v_mps (K,), w_radps (K,).

    `pose` (K, 3) is their exact integral from the first stamp.
    """

    t_ns: Stamps
    v_mps: Array
    w_radps: Array
    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Camera sightings: t_ns (K,), subject ids, range_m (K,) as recorded, bearing_rad (K,) left positive."""

    t_ns: Stamps
    subject: tuple[str, ...]
    range_m: Array
    bearing_rad: Array


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Motion capture: t_ns (K,), pose (K, 3) with heading unwrapped."""

    t_ns: Stamps
    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecording:
    """One robot's files; truth is None where the folder has none."""

    odometry: Odometry
    sightings: Sightings
    truth: Truth | None


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A whole folder. [start_ns, end_ns] is the span all robots have in common."""

    robots: dict[str, RobotRecording]
    landmarks: dict[str, tuple[float, float]]
    start_ns: int
    end_ns: int
    counters: Counter[str] = field(default_factory=Counter)

    def truth_at(self, robot: str, t_ns: int) -> Array:
        """True pose (3,) interpolated linearly, heading wrapped. Raises `RecordingError` without truth."""
        truth = self.robots[robot].truth
        if truth is None:
            raise RecordingError(f"the recording has no ground truth of {robot}")
        at = float(t_ns - int(truth.t_ns[0]))
        base = (truth.t_ns - truth.t_ns[0]).astype(np.float64)
        pose = np.array([np.interp(at, base, truth.pose[:, column]) for column in range(3)])
        pose[2] = wrap(pose[2])
        return pose

    def increment(self, robot: str, t0_ns: int, t1_ns: int) -> Array:
        """Odometry (dx, dy, dyaw) over [t0, t1] in the body frame at t0, from held commands."""
        odometry = self.robots[robot].odometry
        return between(_integrated(odometry, t0_ns), _integrated(odometry, t1_ns))


def load(path: str | Path) -> Recording:
    """Read a folder. Raises `RecordingError` naming the file (and line) and the remedy."""
    folder = Path(path)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder; give the path of an unpacked MR.CLAM data set")
    counters: Counter[str] = Counter()
    barcodes = {int(code): int(subject) for subject, code in _rows(folder, "Barcodes", 2)}
    landmarks = {f"L{int(row[0])}": (row[1], row[2]) for row in _numbers(folder, "Landmark_Groundtruth", 5)}
    robots = {}
    for number in ROBOT_SUBJECTS:
        if _find(folder, f"Robot{number}_Odometry") is None or _find(folder, f"Robot{number}_Measurement") is None:
            counters["robot_files_missing"] += 1
            continue
        has_truth = _find(folder, f"Robot{number}_Groundtruth") is not None
        robots[f"r{number}"] = RobotRecording(
            _odometry(folder, number, counters),
            _sightings(folder, number, barcodes, counters),
            _truth(folder, number) if has_truth else None,
        )
    if not robots:
        raise RecordingError(f"{folder}: no Robot*_Odometry.dat; give the path of an unpacked MR.CLAM data set")
    start_ns, end_ns = _span(robots)
    if end_ns <= start_ns:
        raise RecordingError(f"{folder}: the robots' files have no common span of time")
    return Recording(robots, landmarks, start_ns, end_ns, counters)


def _span(robots: dict[str, RobotRecording]) -> tuple[int, int]:
    stamps = [(r.truth.t_ns if r.truth is not None else r.odometry.t_ns) for r in robots.values()]
    return max(int(t[0]) for t in stamps) + START_MARGIN_NS, min(int(t[-1]) for t in stamps)


def _find(folder: Path, name: str) -> Path | None:
    for candidate in (folder / f"{name}.dat", folder / f"{name}.dat.xz"):
        if candidate.exists():
            return candidate
    return None


def _rows(folder: Path, name: str, columns: int) -> Iterator[tuple[str, ...]]:
    """Fields of each line. Raises `RecordingError` for a missing or cut file or a short line."""
    path = _find(folder, name)
    if path is None:
        raise RecordingError(f"{folder}: {name}.dat is missing; give the path of an unpacked MR.CLAM data set")
    try:
        raw = path.read_bytes()
        text = (lzma.decompress(raw) if path.suffix == ".xz" else raw).decode()
    except (EOFError, lzma.LZMAError):
        raise RecordingError(f"{path}: the compressed file is cut or damaged; fetch it again") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read ({error.__class__.__name__})") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        fields = tuple(line.split())
        if len(fields) != columns:
            raise RecordingError(
                f"{path}, line {number}: {len(fields)} columns instead of {columns}; the file is cut or altered"
            )
        for item in fields:
            if not _is_number(item):
                raise RecordingError(f"{path}, line {number}: not a number; the file is cut or altered")
        yield fields


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _numbers(folder: Path, name: str, columns: int) -> list[list[float]]:
    return [[float(item) for item in row] for row in _rows(folder, name, columns)]


def _nanoseconds(text: str) -> int:
    """Decimal seconds as integer nanoseconds, digit by digit: a float would lose a tenth of a microsecond."""
    whole, _, fraction = text.partition(".")
    if not whole.isdigit() or (fraction and not fraction.isdigit()):
        return round(float(text) * 1_000_000_000)
    return int(whole) * 1_000_000_000 + int(fraction[:9].ljust(9, "0") or "0")


def _stamped(folder: Path, name: str, columns: int) -> tuple[Stamps, list[tuple[str, ...]]]:
    rows = list(_rows(folder, name, columns))
    if not rows:
        raise RecordingError(f"{folder}: {name}.dat holds no data")
    stamps = np.array([_nanoseconds(row[0]) for row in rows], dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    return stamps[order], [rows[index] for index in order]


def _odometry(folder: Path, number: int, counters: Counter[str]) -> Odometry:
    stamps, rows = _stamped(folder, f"Robot{number}_Odometry", 3)
    values = np.array([[float(row[1]), float(row[2])] for row in rows])
    # Of repeated stamps the last command holds.
    keep = np.append(np.diff(stamps) > 0, True)
    counters["odometry_stamps_repeated"] += int(np.sum(~keep))
    stamps, values = stamps[keep], values[keep]
    dt = np.diff(stamps) * 1e-9
    turn = values[:-1, 1] * dt
    pose = np.zeros((len(stamps), 3))
    pose[1:, 2] = np.cumsum(turn)
    middle, chord = pose[:-1, 2] + turn / 2.0, values[:-1, 0] * dt * np.sinc(turn / 2.0 / np.pi)
    pose[1:, 0], pose[1:, 1] = np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle))
    return Odometry(stamps, values[:, 0], values[:, 1], pose)


def _arc(pose: Array, v: float, w: float, dt: float) -> Array:
    """Pose after driving an arc for dt seconds."""
    turn = w * dt
    chord = v * dt * float(np.sinc(turn / 2.0 / np.pi))
    middle = pose[2] + turn / 2.0
    return np.array([pose[0] + chord * np.cos(middle), pose[1] + chord * np.sin(middle), pose[2] + turn])


def _integrated(odometry: Odometry, t_ns: int) -> Array:
    index = int(np.searchsorted(odometry.t_ns, t_ns, side="right")) - 1
    if index < 0:
        return np.asarray(odometry.pose[0])
    dt = (t_ns - int(odometry.t_ns[index])) * 1e-9
    return _arc(odometry.pose[index], float(odometry.v_mps[index]), float(odometry.w_radps[index]), dt)


def _sightings(folder: Path, number: int, barcodes: dict[int, int], counters: Counter[str]) -> Sightings:
    stamps, rows = _stamped(folder, f"Robot{number}_Measurement", 4)
    subjects, kept = [], []
    for index, row in enumerate(rows):
        subject = barcodes.get(int(float(row[1])))
        if subject is None:
            counters["unknown_codes"] += 1
        elif subject == number:
            counters["own_codes"] += 1
        else:
            subjects.append(f"r{subject}" if subject in ROBOT_SUBJECTS else f"L{subject}")
            kept.append(index)
    return Sightings(
        stamps[kept],
        tuple(subjects),
        np.array([float(rows[index][2]) for index in kept]),
        np.array([float(rows[index][3]) for index in kept]),
    )


def _truth(folder: Path, number: int) -> Truth:
    stamps, rows = _stamped(folder, f"Robot{number}_Groundtruth", 4)
    pose = np.array([[float(item) for item in row[1:]] for row in rows])
    pose[:, 2] = np.unwrap(pose[:, 2])
    keep = np.append(np.diff(stamps) > 0, True)
    return Truth(stamps[keep], pose[keep])
