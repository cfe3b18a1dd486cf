"""The loader of UWB bags: on small bags written here, and on the recorded runs where they are at hand."""

from __future__ import annotations

import lzma
import math
import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from agent.config_file import ConfigError
from sim.metrics import combine
from sim.recordings.calibrate import main, pair_biases
from sim.recordings.recording import RecordingError
from sim.recordings.tiers import load
from sim.scenario_file import load as load_scenario
from sim.summary import reduce
from sim.trial import open_world, run_trial

T0 = 1_678_960_800
S = 1_000_000_000
TIERS = os.environ.get("COFIX_TIERS", "")
BIAS = {("1", "2"): 0.3, ("2", "1"): 0.3, ("1", "3"): 0.5, ("3", "1"): 0.5}


def header(t_ns: int, frame: str) -> bytes:
    name = frame.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<iII", t_ns // S, t_ns % S, len(name)) + name


def pose(t_ns: int, x: float, y: float, heading: float, frame: str = "world") -> bytes:
    start = header(t_ns, frame)
    padding = b"\0" * (-(len(start) - 4) % 8)
    return start + padding + struct.pack("<7d", x, y, 0.16, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2))


def distance(t_ns: int, value: float, frame: str = "") -> bytes:
    start = header(t_ns, frame) + b"\0"
    padding = b"\0" * (-(len(start) - 4) % 4)
    return start + padding + struct.pack("<4f", 0.0, 0.0, 0.0, value)


def write(path: Path, messages: list[tuple[str, bytes]]) -> Path:
    with closing(sqlite3.connect(path)) as bag:
        bag.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
        bag.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        topics = sorted({topic for topic, _ in messages})
        bag.executemany("INSERT INTO topics VALUES (?, ?, '')", list(enumerate(topics, start=1)))
        rows = [(topics.index(topic) + 1, 77 * S + index, data) for index, (topic, data) in enumerate(messages)]
        bag.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
        bag.commit()
    return path


def spots(t_s: float) -> dict[str, tuple[float, float, float]]:
    """r1 and r2 stand, r3 drives east and turns through the half turn."""
    return {"1": (0.0, 0.0, 0.0), "2": (4.0, 0.0, 1.0), "3": (0.2 * t_s, 3.0, 3.0 + 0.02 * t_s)}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    messages = []
    for k in range(301):
        t_ns = T0 * S + k * S // 10
        for name, (x, y, heading) in spots(k / 10).items():
            messages.append((f"/vrpn_client_node/turtlebot{name}/pose", pose(t_ns, x, y, heading)))
        if k % 2 == 0:
            at = spots(k / 10)
            for (one, other), bias in BIAS.items():
                apart = math.dist(at[one][:2], at[other][:2])
                messages.append((f"/uwb/tof/n_{one}/n_{other}/distance", distance(t_ns + 1000, apart + bias)))
            messages.append(("/uwb/tof/n_1/n_8/distance", distance(t_ns, 5.0)))
    return write(tmp_path / "case.db3", messages)


def test_ranges_poses_and_the_common_span(bag: Path) -> None:
    recording = load(bag)
    assert list(recording.robots) == ["r1", "r2", "r3"]
    assert recording.left_out == ("r4", "r5", "r6", "r7")
    assert recording.counters["unplaced_node"] == 151
    assert (recording.start_ns, recording.end_ns) == ((T0 + 1) * S, (T0 + 30) * S)
    sightings = recording.robots["r1"].sightings
    assert sightings.t_ns[0] == T0 * S + 1000
    assert sightings.subject[:4] == ("r2", "r3", "r2", "r3")
    assert sightings.range_m[0] == pytest.approx(4.3, abs=1e-6)
    assert np.isnan(sightings.bearing_rad).all()
    assert recording.truth_at("r3", T0 * S + 8 * S) == pytest.approx([1.6, 3.0, 3.16 - 2.0 * math.pi])


def test_without_odometry_an_increment_is_the_true_motion(bag: Path) -> None:
    recording = load(bag)
    dx, dy, dyaw = recording.increment("r3", (T0 + 2) * S, (T0 + 7) * S)
    heading = 3.04
    assert (dx, dy) == pytest.approx((math.cos(heading), -math.sin(heading)), abs=1e-6)
    assert dyaw == pytest.approx(0.1)
    assert recording.velocity_at("r3", (T0 + 5) * S) == pytest.approx([0.2, 0.0], abs=1e-6)


@pytest.mark.parametrize("frame", ["", "w", "wo", "world", "vicon_1"])
def test_the_length_of_the_frames_name_does_not_matter(tmp_path: Path, frame: str) -> None:
    messages = [("/vrpn_client_node/turtlebot1/pose", pose(T0 * S + k * S, 1.5, -2.5, 0.5, frame)) for k in range(9)]
    messages += [("/uwb/tof/n_1/n_2/distance", distance(T0 * S, 2.25, frame))]
    recording = load(write(tmp_path / "one.db3", messages))
    assert recording.truth_at("r1", (T0 + 2) * S) == pytest.approx([1.5, -2.5, 0.5])
    assert recording.robots["r1"].sightings.range_m == pytest.approx([2.25])


def test_compressed_and_plain_bags_read_alike(bag: Path, tmp_path: Path) -> None:
    packed = tmp_path / "case.db3.xz"
    packed.write_bytes(lzma.compress(bag.read_bytes()))
    one, other = load(bag), load(packed)
    for name in one.robots:
        assert np.array_equal(one.robots[name].sightings.range_m, other.robots[name].sightings.range_m)
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(RecordingError, match="cut or damaged"):
        load(packed)


def test_what_is_no_bag_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such file; give the path of a case4"):
        load(tmp_path / "gone.db3")
    text = tmp_path / "text.db3"
    text.write_text("no bag at all, but long enough to be looked at as one")
    with pytest.raises(RecordingError, match="cannot be read as a bag"):
        load(text)
    with pytest.raises(RecordingError, match="holds no pose of a turtlebot"):
        load(write(tmp_path / "empty.db3", [("/rosout", b"")]))
    cut = [("/vrpn_client_node/turtlebot1/pose", pose(T0 * S, 0.0, 0.0, 0.0)[:40])]
    with pytest.raises(RecordingError, match="turtlebot1/pose is cut"):
        load(write(tmp_path / "cut.db3", cut))


def test_pair_biases_are_found_and_written_as_tables(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    biases = pair_biases(load(bag))
    assert {(r, s): round(pair.bias_m, 3) for r, pairs in biases.items() for s, pair in pairs.items()} == {
        ("r1", "r2"): 0.3,
        ("r1", "r3"): 0.5,
        ("r2", "r1"): 0.3,
        ("r3", "r1"): 0.5,
    }
    assert main([str(bag)]) == 0
    assert "calibration.bias_of = { r2 = 0.300, r3 = 0.500 }" in capsys.readouterr().out
    assert main([str(bag), "--first", "0.5"]) == 1
    assert "no robot ranges with another one" in capsys.readouterr().err
    assert main([str(bag) + ".gone"]) == 2
    assert "no such file" in capsys.readouterr().err


def overrides(path: Path) -> list[str]:
    names = ("r1", "r2", "r3")
    robots = ", ".join(
        f"{{id='{name}', start_sigma={{position_m=0.3, heading_rad=0.1}}, "
        "odometry={along_m_per_sqrt_s=0.02, heading_rad_per_sqrt_s=0.02}, sensors={"
        "uwb={kind='range', of=['peers'], sigma_m=0.05}, pose={sigma_m=0.05, sigma_rad=0.02, rate_hz=0.5}}}"
        for name in names
    )
    return [f"world.path={path}", f"robots=[{robots}]", "window_s=[5, 600]"]


def test_a_bag_is_a_world_and_its_pairs_are_calibrated(bag: Path) -> None:
    plain = overrides(bag)
    pairs = {"r1": "{r2=0.3, r3=0.5}", "r2": "{r1=0.3}", "r3": "{r1=0.5}"}
    known = [f"robots.{r}.sensors.uwb.calibration.bias_of={t}" for r, t in pairs.items()]
    nis = {}
    for label, sets in (("plain", plain), ("known", plain + known)):
        result = run_trial(load_scenario("tiers-uwb", sets), 1, with_bound=True)
        ranges = [own["pair_range"] for own in result.nis.values()]
        nis[label] = sum(total for total, _ in ranges) / sum(count for _, count in ranges)
        assert all("used.pose" in own for own in result.counters.values())
        # Contacts of uncalibrated pairs are hardly used: their innovations tell that something is wrong.
        applied = sum(own.get("pair.applied_initiator", 0) for own in result.counters.values())
        assert applied > 10 if label == "known" else applied < 10
    assert nis["known"] < 1.0 < 3.0 < nis["plain"]


def test_noise_of_made_odometry_and_fixes_is_drawn_from_the_seed(bag: Path) -> None:
    scenario = load_scenario("tiers-uwb", overrides(bag))
    one, again, other = (open_world(scenario, seed) for seed in (1, 1, 2))
    rows = [[item.z.tolist() for item in world.outputs(20)] for world in (one, again, other)]
    assert rows[0] == rows[1] != rows[2]
    poses = [item for item in one.outputs(20) if item.kind == "pose"]
    assert [item.robot for item in poses] == ["r1", "r2", "r3"]


def test_a_range_is_no_bearing(bag: Path) -> None:
    scenario = load_scenario(
        "tiers-uwb",
        [*overrides(bag), "robots.r1.sensors.uwb={kind='bearing', of=['peers'], sigma_rad=0.1}"],
    )
    world = open_world(scenario, 1)
    with pytest.raises(ConfigError, match="does not hold what a sensor of kind 'bearing' measures"):
        _ = [world.outputs(k) for k in range(1, 10)]


def test_the_recorded_run_with_calibrated_pairs_is_honest() -> None:
    if not TIERS:
        pytest.skip("COFIX_TIERS does not name the folder of the TIERS recordings")
    path = next(item for item in sorted(Path(TIERS).glob("case4_test3.db3*")))

    def fleet(*overrides: str, seeds: tuple[int, ...] = (1, 2, 3)) -> dict[str, float]:
        scenario = load_scenario("tiers-uwb", [f"world.path={path}", *overrides])
        reduced = [reduce(scenario, run_trial(scenario, seed))["figures"] for seed in seeds]
        return dict(combine(reduced, scenario.lost_above_m)["fleet"])

    known, unknown = fleet(), fleet("robots.*.sensors.uwb.calibration={}", seeds=(1,))
    alone = fleet("links.loss=1.0", seeds=(1,))
    assert known["anees"] <= 1.7
    assert unknown["anees"] >= 3.0 * known["anees"]
    assert known["position_rmse_m"] <= 0.6 * min(unknown["position_rmse_m"], alone["position_rmse_m"])
