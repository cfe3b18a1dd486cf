"""The MR.CLAM loader: on small folders written here, and on the recorded run where it is at hand."""

from __future__ import annotations

import lzma
import math
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.recordings.recording import Recording, RecordingError
from sim.recordings.utias import load

T0 = 1_248_446_180
NS = 1_000_000_000
HEADER = "# UTIAS Multi-Robot Cooperative Localization and Mapping Dataset\r\n# Time [s]\r\n"
UTIAS7 = os.environ.get("COFIX_UTIAS7", "")


class Folder:
    """A small MR.CLAM folder: two robots, two landmarks; robot 1 drives a circle, robot 2 stands."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: dict[str, str] = {
            "Barcodes": "1 5\n2 14\n3 41\n4 32\n5 23\n6 63\n7 81\n",
            "Landmark_Groundtruth": "6 0.5 -4.25 0.0001 0.0002\n7 3.0 1.0 0.0001 0.0002\n",
            "Robot1_Odometry": "".join(f"{T0 + 1 + k}.000 \t 0.200 \t 0.100 \n" for k in range(20)),
            "Robot1_Measurement": f"{T0 + 8}.123 14 2.0 0.1\n{T0 + 8}.123 81 3.0 -0.2\n{T0 + 9}.5 63 1.0 0.0\n",
            "Robot1_Groundtruth": "".join(f"{T0 + k}.000 {0.2 * k:.3f} 1.0 {3.0 + 0.1 * k:.3f}\n" for k in range(21)),
            "Robot2_Odometry": f"{T0 + 1}.000 0.0 0.0\n{T0 + 25}.000 0.0 0.0\n",
            "Robot2_Measurement": f"{T0 + 10}.250 5 2.1 3.0\n",
            "Robot2_Groundtruth": f"{T0 + 2}.000 4.0 5.0 0.0\n{T0 + 18}.000 4.0 5.0 0.0\n",
        }
        self.compressed: set[str] = set()

    def load(self) -> Recording:
        for name, text in self.files.items():
            data = (HEADER + text.replace("\n", "\r\n")).encode()
            if name in self.compressed:
                (self.path / f"{name}.dat.xz").write_bytes(lzma.compress(data))
            else:
                (self.path / f"{name}.dat").write_bytes(data)
        return load(self.path)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


def test_robots_landmarks_and_the_common_span(folder: Folder) -> None:
    recording = folder.load()
    assert list(recording.robots) == ["r1", "r2"]
    assert recording.left_out == ("r3", "r4", "r5")
    assert recording.counters["robot_files_missing"] == 3
    assert recording.landmarks == {"L6": (0.5, -4.25), "L7": (3.0, 1.0)}
    assert recording.start_ns == (T0 + 2 + 5) * NS
    assert recording.end_ns == (T0 + 18) * NS


def test_barcodes_become_subjects_through_the_folders_own_map(folder: Folder) -> None:
    sightings = folder.load().robots["r1"].sightings
    assert sightings.subject == ("r2", "L7", "L6")
    assert list(sightings.range_m) == [2.0, 3.0, 1.0]
    assert list(sightings.bearing_rad) == [0.1, -0.2, 0.0]
    folder.files["Barcodes"] = "1 5\n2 81\n6 63\n7 14\n"
    assert folder.load().robots["r1"].sightings.subject == ("L7", "r2", "L6")


def test_compressed_and_plain_files_read_alike(folder: Folder, tmp_path: Path) -> None:
    plain = folder.load()
    (tmp_path / "xz").mkdir()
    other = Folder(tmp_path / "xz")
    other.compressed = set(other.files)
    packed = other.load()
    for name in plain.robots:
        one, other_one = plain.robots[name].odometry, packed.robots[name].odometry
        assert one is not None and other_one is not None
        assert np.array_equal(one.pose, other_one.pose)
        assert np.array_equal(plain.robots[name].sightings.t_ns, packed.robots[name].sightings.t_ns)
    assert (plain.start_ns, plain.end_ns) == (packed.start_ns, packed.end_ns)


@settings(deadline=None, max_examples=60)
@given(seconds=st.integers(1_000_000_000, 4_000_000_000), nanos=st.integers(0, NS - 1), digits=st.integers(0, 12))
def test_stamps_are_the_digits_of_the_text(
    tmp_path_factory: pytest.TempPathFactory, seconds: int, nanos: int, digits: int
) -> None:
    fraction = f"{nanos:09d}000"[:digits]
    folder = Folder(tmp_path_factory.mktemp("stamp"))
    folder.files["Robot1_Measurement"] = f"{seconds}{'.' if digits else ''}{fraction} 14 2.0 0.1\n"
    expected = seconds * NS + int(fraction[:9].ljust(9, "0"))
    assert folder.load().robots["r1"].sightings.t_ns[0] == expected


def test_a_float_of_unix_seconds_would_not_have_been_exact() -> None:
    assert int(float(f"{T0}.123456789") * 1e9) != T0 * NS + 123_456_789


def test_unknown_own_and_unplaced_codes_are_dropped_and_counted(folder: Folder) -> None:
    folder.files["Barcodes"] += "8 7\n"
    folder.files["Robot1_Measurement"] += f"{T0 + 11}.0 99 1.0 0.0\n{T0 + 11}.0 5 1.0 0.0\n{T0 + 11}.0 7 1.0 0.0\n"
    recording = folder.load()
    assert recording.robots["r1"].sightings.subject == ("r2", "L7", "L6")
    assert recording.counters["unknown_codes"] == 1
    assert recording.counters["own_codes"] == 1
    assert recording.counters["unknown_landmarks"] == 1


def test_of_repeated_stamps_the_last_command_holds(folder: Folder) -> None:
    folder.files["Robot1_Odometry"] = f"{T0}.0 9.0 0.0\n{T0}.0 0.5 0.0\n{T0 + 20}.0 0.0 0.0\n"
    recording = folder.load()
    assert recording.counters["odometry_stamps_repeated"] == 1
    assert recording.increment("r1", (T0 + 8) * NS, (T0 + 10) * NS) == pytest.approx([1.0, 0.0, 0.0])


def test_lines_out_of_order_are_sorted_and_counted(folder: Folder) -> None:
    folder.files["Robot1_Measurement"] = f"{T0 + 9}.0 63 1.0 0.0\n{T0 + 8}.0 14 2.0 0.1\n"
    recording = folder.load()
    assert recording.robots["r1"].sightings.subject == ("r2", "L6")
    assert list(recording.robots["r1"].sightings.range_m) == [2.0, 1.0]
    assert recording.counters["stamps_out_of_order"] == 1


def test_a_robot_that_saw_nothing_is_a_robot(folder: Folder) -> None:
    folder.files["Robot2_Measurement"] = ""
    sightings = folder.load().robots["r2"].sightings
    assert len(sightings.t_ns) == len(sightings.range_m) == len(sightings.subject) == 0


def test_truth_is_interpolated_through_the_wrap_of_heading(folder: Folder) -> None:
    folder.files["Robot1_Groundtruth"] = f"{T0}.0 0.0 0.0 3.1\n{T0 + 20}.0 2.0 4.0 -3.1\n"
    pose = folder.load().truth_at("r1", (T0 + 15) * NS)
    turned = 3.1 + 0.75 * (2.0 * math.pi - 6.2)
    assert pose == pytest.approx([1.5, 3.0, turned - 2.0 * math.pi])


def test_no_truth_is_invented(folder: Folder) -> None:
    recording = folder.load()
    assert recording.truth_at("r1", T0 * NS)[0] == 0.0
    assert recording.truth_at("r1", (T0 + 20) * NS)[0] == pytest.approx(4.0)
    with pytest.raises(RecordingError, match="no ground truth at"):
        recording.truth_at("r1", T0 * NS - 1)
    with pytest.raises(RecordingError, match="no ground truth at"):
        recording.truth_at("r1", (T0 + 20) * NS + 1)
    with pytest.raises(RecordingError, match="no robot 'r4'; it has r1, r2"):
        recording.truth_at("r4", T0 * NS)


def test_without_truth_the_span_is_the_odometrys(folder: Folder) -> None:
    del folder.files["Robot1_Groundtruth"], folder.files["Robot2_Groundtruth"]
    recording = folder.load()
    assert recording.robots["r1"].truth is None
    assert (recording.start_ns, recording.end_ns) == ((T0 + 6) * NS, (T0 + 20) * NS)
    with pytest.raises(RecordingError, match="no ground truth of r1"):
        recording.truth_at("r1", (T0 + 10) * NS)


def test_an_increment_is_the_arc_of_the_held_command(folder: Folder) -> None:
    dx, dy, dyaw = folder.load().increment("r1", (T0 + 7) * NS + 250_000_000, (T0 + 9) * NS + 750_000_000)
    turn, radius = 0.1 * 2.5, 0.2 / 0.1
    assert (dx, dy, dyaw) == pytest.approx((radius * math.sin(turn), radius * (1.0 - math.cos(turn)), turn))


def test_before_the_first_command_a_robot_stands(folder: Folder) -> None:
    recording = folder.load()
    assert recording.increment("r1", (T0 - 5) * NS, (T0 + 1) * NS) == pytest.approx([0.0, 0.0, 0.0])
    assert recording.increment("r1", (T0 - 5) * NS, (T0 + 2) * NS)[2] == pytest.approx(0.1)


commands = st.lists(
    st.tuples(st.integers(1, 3000), st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)), min_size=1, max_size=12
)


@settings(deadline=None, max_examples=60)
@given(commands=commands, cuts=st.tuples(st.integers(0, 20_000), st.integers(0, 20_000), st.integers(0, 20_000)))
def test_increments_compose_and_match_small_steps(
    tmp_path_factory: pytest.TempPathFactory,
    commands: list[tuple[int, float, float]],
    cuts: tuple[int, int, int],
) -> None:
    folder = Folder(tmp_path_factory.mktemp("arc"))
    at, lines = 0, []
    for step, v, w in commands:
        at += step
        lines.append((at, v, w))
    folder.files["Robot1_Odometry"] = "".join(f"{T0 + t // 1000}.{t % 1000:03d} {v!r} {w!r}\n" for t, v, w in lines)
    recording = folder.load()
    a, b, c = sorted(cuts)
    first, second, whole = (
        recording.increment("r1", T0 * NS + i * 1_000_000, T0 * NS + j * 1_000_000) for i, j in ((a, b), (b, c), (a, c))
    )
    cos, sin = math.cos(first[2]), math.sin(first[2])
    moved = np.array([cos * second[0] - sin * second[1], sin * second[0] + cos * second[1], second[2]])
    composed = first + moved
    assert composed[:2] == pytest.approx(whole[:2], abs=1e-9)
    assert math.remainder(composed[2] - whole[2], 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)

    x = y = heading = 0.0
    edges = sorted({a, c, *(t for t, _, _ in lines if a < t < c)})
    for start, end in pairwise(edges):
        v, w = next(((v, w) for t, v, w in reversed(lines) if t <= start), (0.0, 0.0))
        for _ in range(200):
            dt = (end - start) * 1e-3 / 200
            x, y = x + v * dt * math.cos(heading + w * dt / 2), y + v * dt * math.sin(heading + w * dt / 2)
            heading += w * dt
    assert whole[:2] == pytest.approx([x, y], abs=2e-3)
    assert math.remainder(whole[2] - heading, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        (
            "Robot1_Odometry",
            f"{T0}.0 0.1 0.2\n{T0 + 1}.0 0.1\n",
            r"Robot1_Odometry\.dat, line 4: 2 columns inst",
        ),
        ("Robot1_Odometry", f"{T0}.0 0.1 left\n", r"Robot1_Odometry\.dat, line 3: not a number"),
        ("Robot1_Odometry", f"{T0}.0 0.1 nan\n", r"Robot1_Odometry\.dat, line 3: not a finite number"),
        ("Robot1_Odometry", "", r"Robot1_Odometry\.dat: holds no data"),
        ("Robot2_Measurement", f"{T0}.0 5.5 2.0 0.1\n", r"Robot2_Measurement\.dat, line 3: .* not a whole number"),
        ("Robot2_Measurement", "1.2e9 5 2.0 0.1\n", r"Robot2_Measurement\.dat, line 3: not a time in decimal seconds"),
        ("Robot2_Groundtruth", f"{T0}.0 1.0 2.0\n", r"Robot2_Groundtruth\.dat, line 3: 3 columns instead of 4"),
        ("Landmark_Groundtruth", "6 0.5 -4.25\n", r"Landmark_Groundtruth\.dat, line 3: 3 columns instead of 5"),
        ("Barcodes", "1 5\n2 5\n", r"Barcodes\.dat, line 4: code 5 stands for two subjects"),
    ],
)
def test_a_damaged_file_is_named_with_its_line(folder: Folder, name: str, text: str, says: str) -> None:
    folder.files[name] = text
    with pytest.raises(RecordingError, match=says) as raised:
        folder.load()
    assert "\n" not in str(raised.value)
    assert "fetch it again" in str(raised.value)


def test_a_cut_archive_is_named(folder: Folder) -> None:
    folder.compressed = {"Robot1_Odometry"}
    folder.load()
    path = folder.path / "Robot1_Odometry.dat.xz"
    for keep in (path.stat().st_size // 2, 0):
        path.write_bytes(path.read_bytes()[:keep])
        with pytest.raises(RecordingError, match=r"Robot1_Odometry\.dat\.xz: the compressed file is cut or damaged"):
            load(folder.path)


def test_other_folders_are_refused_with_the_remedy(folder: Folder, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such folder; give the path of an unpacked"):
        load(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"Barcodes\.dat is missing; give the path of an unpacked"):
        load(tmp_path)
    for name in ("Robot1_Odometry", "Robot2_Odometry"):
        del folder.files[name]
    with pytest.raises(RecordingError, match="no robot has both an odometry and a measurement file; give the path"):
        folder.load()


def test_robots_of_different_runs_have_no_common_span(folder: Folder) -> None:
    folder.files["Robot2_Groundtruth"] = f"{T0 + 900}.0 4.0 5.0 0.0\n{T0 + 990}.0 4.0 5.0 0.0\n"
    with pytest.raises(RecordingError, match="no common span of time; take them from one run"):
        folder.load()


@pytest.fixture(scope="session")
def run7() -> Recording:
    if not UTIAS7:
        pytest.skip("COFIX_UTIAS7 does not name the folder of MR.CLAM data set 7")
    return load(UTIAS7)


def test_run_7_has_the_counts_its_files_have(run7: Recording) -> None:
    robots = {name: sum(s[0] == "r" for s in r.sightings.subject) for name, r in run7.robots.items()}
    landmarks = {name: sum(s[0] == "L" for s in r.sightings.subject) for name, r in run7.robots.items()}
    assert robots == {"r1": 650, "r2": 700, "r3": 965, "r4": 555, "r5": 1336}
    assert landmarks == {"r1": 2578, "r2": 3818, "r3": 4425, "r4": 1822, "r5": 3424}
    assert run7.counters["unknown_codes"] == 9
    assert len(run7.landmarks) == 15
    assert 890.0 < (run7.end_ns - run7.start_ns) * 1e-9 < 900.0


def test_run_7_bearings_point_where_truth_says(run7: Recording) -> None:
    """A wrong barcode map, frame or sign of the bearing would scatter these over the whole circle."""
    for name, robot in run7.robots.items():
        misses = []
        for t_ns, subject, bearing in zip(
            robot.sightings.t_ns[::7], robot.sightings.subject[::7], robot.sightings.bearing_rad[::7]
        ):
            if subject[0] == "L" and run7.start_ns <= t_ns <= run7.end_ns:
                x, y, heading = run7.truth_at(name, int(t_ns))
                at = run7.landmarks[subject]
                misses.append(math.remainder(bearing + heading - math.atan2(at[1] - y, at[0] - x), 2.0 * math.pi))
        assert len(misses) > 100
        assert np.median(np.abs(misses)) < 0.03, name


def test_run_7_commands_roughly_follow_the_way_driven(run7: Recording) -> None:
    """The robots drive a little less than commanded."""
    for name in run7.robots:
        driven = commanded = 0.0
        for t in range(run7.start_ns, run7.end_ns - 2 * NS, 2 * NS):
            before, after = run7.truth_at(name, t), run7.truth_at(name, t + 2 * NS)
            driven += math.hypot(*(after - before)[:2])
            commanded += math.hypot(*run7.increment(name, t, t + 2 * NS)[:2])
        assert 0.7 < driven / commanded < 1.05, name
