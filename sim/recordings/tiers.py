"""Loader of the UWB recordings of the TIERS lab, Turku (arXiv 2303.17207): rosbag2 files, SQLite with CDR inside.

Seven TurtleBots `r1`-`r7` carry a node each that ranges with all others; the truth is motion capture. Files are plain
`.db3` or `.db3.xz`. Stamps are those of the message headers: the bags were recorded anew from older ones. Node 8 stands
somewhere unknown; its ranges are left out and counted. There is no odometry.
"""

from __future__ import annotations

import lzma
import math
import re
import sqlite3
import struct
import tempfile
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np

from sim.recordings.recording import Recording, RecordingError, RobotRecording, Sightings, Truth, common_span

ROBOTS = range(1, 8)
START_MARGIN_NS = 1_000_000_000
REMEDY = "give the path of a case4_*.db3 file"
_RANGE = re.compile(r"/uwb/tof/n_(\d+)/n_(\d+)/distance\Z")
_POSE = re.compile(r"/vrpn_client_node/turtlebot(\d+)/pose\Z")


def load(path: str | Path) -> Recording:
    """Read a file. Raises `RecordingError` naming the file and the remedy."""
    file = Path(path)
    if not file.is_file():
        raise RecordingError(f"{file}: no such file; {REMEDY}")
    counters: Counter[str] = Counter()
    poses: dict[int, list[tuple[int, float, float, float]]] = {number: [] for number in ROBOTS}
    ranges: dict[int, list[tuple[int, str, float]]] = {number: [] for number in ROBOTS}
    for topic, data in _messages(file):
        try:
            _take(topic, data, poses, ranges, counters)
        except (struct.error, IndexError):
            raise RecordingError(f"{file}: a message of {topic} is cut; fetch it again") from None
    robots = {}
    for number in ROBOTS:
        if poses[number]:
            robots[f"r{number}"] = RobotRecording(None, _sightings(ranges[number]), _truth(poses[number], counters))
    if not robots:
        raise RecordingError(f"{file}: holds no pose of a turtlebot; {REMEDY}")
    start_ns, end_ns = common_span(robots, START_MARGIN_NS)
    if end_ns <= start_ns:
        raise RecordingError(f"{file}: the robots' poses have no common span of time; fetch it again")
    left_out = tuple(f"r{number}" for number in ROBOTS if f"r{number}" not in robots)
    return Recording(robots, {}, start_ns, end_ns, counters, left_out)


def _messages(file: Path) -> list[tuple[str, bytes]]:
    """(topic, serialized message) in order of the bag."""
    try:
        if file.suffix != ".xz":
            return _rows(file)
        with tempfile.NamedTemporaryFile(suffix=".db3") as plain:
            plain.write(lzma.decompress(file.read_bytes()))
            plain.flush()
            return _rows(Path(plain.name))
    except (EOFError, lzma.LZMAError):
        raise RecordingError(f"{file}: the compressed file is cut or damaged; fetch it again") from None
    except (OSError, sqlite3.Error) as error:
        raise RecordingError(f"{file}: cannot be read as a bag ({error.__class__.__name__}); {REMEDY}") from None


def _rows(file: Path) -> list[tuple[str, bytes]]:
    query = "SELECT topics.name, messages.data FROM messages JOIN topics ON topics.id = topic_id ORDER BY messages.id"
    with closing(sqlite3.connect(f"file:{file}?mode=ro&immutable=1", uri=True)) as bag:
        return [(str(name), bytes(data)) for name, data in bag.execute(query)]


def _header(data: bytes) -> tuple[int, int]:
    """Stamp [ns] of a std_msgs/Header after the four bytes of encapsulation, and where it ends in the body."""
    seconds, nanoseconds, length = struct.unpack_from("<iII", data, 4)
    return seconds * 1_000_000_000 + nanoseconds, 12 + length


def _take(
    topic: str,
    data: bytes,
    poses: dict[int, list[tuple[int, float, float, float]]],
    ranges: dict[int, list[tuple[int, str, float]]],
    counters: Counter[str],
) -> None:
    pose = _POSE.match(topic)
    if pose is not None and int(pose[1]) in poses:
        t_ns, end = _header(data)
        # Doubles begin at a multiple of eight bytes of the body.
        x, y, _, qx, qy, qz, qw = struct.unpack_from("<7d", data, 4 + -(-end // 8) * 8)
        heading = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        poses[int(pose[1])].append((t_ns, x, y, heading))
        return
    pair = _RANGE.match(topic)
    if pair is None:
        counters["other_topics"] += 1
        return
    first, second = int(pair[1]), int(pair[2])
    if first not in ranges or second not in ranges:
        counters["unplaced_node"] += 1
        return
    t_ns, end = _header(data)
    # radiation_type, padding to four bytes, field_of_view, min_range, max_range, range
    (distance,) = struct.unpack_from("<f", data, 4 + -(-(end + 1) // 4) * 4 + 12)
    if math.isfinite(distance) and distance > 0.0:
        ranges[first].append((t_ns, f"r{second}", distance))
    else:
        counters["no_distance"] += 1


def _sightings(rows: list[tuple[int, str, float]]) -> Sightings:
    """In order of time; of one stamp and subject the first is kept."""
    kept: dict[tuple[int, str], float] = {}
    for t_ns, subject, distance in sorted(rows, key=lambda row: row[:2]):
        kept.setdefault((t_ns, subject), distance)
    return Sightings(
        np.array([t_ns for t_ns, _ in kept], dtype=np.int64),
        tuple(subject for _, subject in kept),
        np.array(list(kept.values()), dtype=np.float64),
        np.full(len(kept), np.nan),
    )


def _truth(rows: list[tuple[int, float, float, float]], counters: Counter[str]) -> Truth:
    by_stamp = {row[0]: row[1:] for row in sorted(rows)}
    counters["truth_stamps_repeated"] += len(rows) - len(by_stamp)
    pose = np.array(list(by_stamp.values()))
    pose[:, 2] = np.unwrap(pose[:, 2])
    return Truth(np.array(list(by_stamp), dtype=np.int64), pose)
