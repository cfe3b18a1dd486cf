"""The loader of a drone seen by cameras: on a small set written here, and on the recorded one where it is at hand."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError
from agent.estimation.motion import CONSTANT_VELOCITY_3D, SPATIAL
from agent.estimation.observation import RelativeModel
from agent.timeline import Phase
from benchmarks.drone_cameras import located, main, views
from sim.agents import agent_config
from sim.recordings.drone_cameras import CLOCKS, STEP_NS, load
from sim.recordings.recording import Recording, RecordingError
from sim.scenario import Scenario
from sim.scenario_file import load as load_scenario
from sim.trial import open_world, run_trial
from sim.world import Output, World, order
from tests.sim.drone_set import BUILT, HIDDEN_S, track, write
from tests.sim.test_resection import flown

DRONES = os.environ.get("COFIX_DRONES", "")
S = 1_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("set"))


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    return load(folder)


# --- what is read -----------------------------------------------------------------------------------------


def test_cameras_stand_where_they_saw_the_track_from(recording: Recording) -> None:
    assert list(recording.robots) == ["cam0", "cam3", "cam5", "t1"]
    assert recording.left_out == ("cam1", "cam2", "cam4")
    for built in BUILT:
        pose = recording.truth_at(f"cam{built.number}", recording.start_ns)
        np.testing.assert_array_equal(pose, recording.truth_at(f"cam{built.number}", recording.end_ns))
        np.testing.assert_allclose(pose[:3], built.pose.centre, atol=0.05)
        forward = built.pose.turn[2]
        assert pose[3] == pytest.approx(math.atan2(forward[1], forward[0]), abs=1e-3)
        camera = recording.robots[f"cam{built.number}"].camera
        assert camera is not None
        assert camera.mount[:3] == (0.0, 0.0, 0.0) and camera.mount[5] == 0.0
        # Noses up, and turned by 0.05 rad about where they look.
        assert camera.mount[4] == pytest.approx(-math.asin(forward[2]), abs=1e-3)
        assert abs(camera.mount[3]) == pytest.approx(0.05, abs=2e-3)


def test_pixels_are_those_an_agent_expects(recording: Recording) -> None:
    """Of the true drone, through mount, intrinsics and pose as they are told, at each frame's own instant."""
    for built in BUILT:
        name = f"cam{built.number}"
        robot = recording.robots[name]
        assert robot.camera is not None and robot.sightings.pixel is not None
        model = RelativeModel(
            "pixel", SPATIAL, robot.camera.mount, None, CONSTANT_VELOCITY_3D, intrinsics=robot.camera.intrinsics
        )
        own = recording.truth_at(name, recording.start_ns)
        places = flown(robot.sightings.t_ns * 1e-9)
        states = np.column_stack([np.tile(own, (len(places), 1)), places, np.zeros_like(places)])
        off = model.h(states) - robot.sightings.pixel
        assert np.sqrt(np.mean(off**2)) < 0.6, name
        assert np.max(np.abs(np.mean(off, axis=0))) < 0.1, name


def test_stamps_are_on_one_clock_that_begins_with_the_track(recording: Recording) -> None:
    for built in BUILT:
        sightings = recording.robots[f"cam{built.number}"].sightings
        period_s = CLOCKS[built.number][0] / 59.94006
        gaps = np.diff(sightings.t_ns) * 1e-9
        assert np.median(gaps) == pytest.approx(period_s, abs=1e-6)
        frames = (sightings.t_ns * 1e-9 - built.t_s(np.zeros(1))) / period_s
        np.testing.assert_allclose(frames, np.rint(frames), atol=0.1)
        assert not np.any((sightings.t_ns > HIDDEN_S[0] * S + STEP_NS) & (sightings.t_ns < HIDDEN_S[1] * S - STEP_NS))
    assert recording.start_ns % STEP_NS == 0
    # Camera 3 has its first frame when that of camera 0 is 10 s away.
    assert recording.start_ns * 1e-9 == pytest.approx(2.2, abs=0.3)


def test_truth_is_the_track(recording: Recording) -> None:
    np.testing.assert_allclose(recording.truth_at("t1", 20 * S)[:3], track()[100], atol=1e-12)
    middle = recording.truth_at("t1", 20 * S + STEP_NS // 2)[:3]
    np.testing.assert_allclose(middle, 0.5 * (track()[100] + track()[101]), atol=1e-9)
    speed = (flown(np.array([20.25])) - flown(np.array([19.75])))[0] / 0.5
    np.testing.assert_allclose(recording.velocity_at("t1", 20 * S), speed, atol=0.05)
    with pytest.raises(RecordingError, match="no ground truth at"):
        recording.truth_at("t1", 61 * S)


def test_compressed_and_plain_files_read_alike(recording: Recording, tmp_path: Path) -> None:
    packed = load(write(tmp_path, packed=True))
    for name, robot in recording.robots.items():
        np.testing.assert_array_equal(robot.sightings.t_ns, packed.robots[name].sightings.t_ns)
    np.testing.assert_array_equal(packed.truth_at("cam0", 5 * S), recording.truth_at("cam0", 5 * S))


def test_a_frame_that_is_there_twice_counts_once(tmp_path: Path) -> None:
    folder = write(tmp_path)
    path = folder / "detections" / "cam3.txt"
    lines = path.read_text().splitlines()
    lines.insert(501, lines[500].split()[0] + " 100.0 100.0")
    path.write_text("\n".join(lines) + "\n")
    recording = load(folder)
    assert recording.counters["frames_repeated"] == 1
    assert np.all(np.diff(recording.robots["cam3"].sightings.t_ns) > 0)


# --- what is refused --------------------------------------------------------------------------------------


def changed(folder: Path, name: str, old: str, new: str) -> None:
    path = folder / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("name", "old", "new", "complaint"),
    [
        ("detections/cam0.txt", "2.000000 ", "2.000000 x ", "cam0.txt, line 3: not a number"),
        ("detections/cam0.txt", "2.000000 ", "2.000000 1 ", "cam0.txt, line 3: not three finite numbers"),
        ("rtk.txt", "12.0", "nan 12.0", "line 2: not three finite numbers"),
        ("cameras.txt", "cam1 - phone", "phone", r"cameras.txt: not lines 'camK - MODEL'"),
        ("cameras.txt", "cam1 - phone\n", "", r"cameras.txt: not lines 'camK - MODEL'"),
        ("cameras.txt", "cam0 - wide", "cam0 - none", "none.json is missing"),
        ("../calibration/wide.json", "874.0", '"x"', "wide.json: not a camera's calibration"),
        ("../calibration/wide.json", "K-matrix", "K", "wide.json: not a camera's calibration"),
        ("../calibration/long.json", "50.0", "25.0", "cam5 has 25 frames/s and not 50, as in part 3"),
    ],
)
def test_files_that_are_wrong_are_named(
    tmp_path: Path, folder: Path, name: str, old: str, new: str, complaint: str
) -> None:
    shutil.copytree(folder.parent, tmp_path / "copy")
    place = tmp_path / "copy" / folder.name
    if name == "rtk.txt":
        old = (place / name).read_text().splitlines()[1]
        new = new.partition(" ")[0] + " " + old.partition(" ")[2]
    changed(place, name, old, new)
    with pytest.raises(RecordingError, match=complaint):
        load(place)


def test_files_that_are_missing_are_named(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(RecordingError, match="no such folder; give the path of the folder dataset3"):
        load(tmp_path / "gone")
    shutil.copytree(folder.parent, tmp_path / "copy")
    place = tmp_path / "copy" / folder.name
    shutil.rmtree(place / "detections")
    with pytest.raises(RecordingError, match="detections are missing"):
        load(place)
    (place / "rtk.txt").unlink()
    with pytest.raises(RecordingError, match=r"rtk\.txt is missing"):
        load(place)


def test_a_track_of_another_flight_is_refused(tmp_path: Path) -> None:
    folder = write(tmp_path)
    rows = np.random.default_rng(1).permutation(track())
    (folder / "rtk.txt").write_text("# mixed up\n" + "".join(f"{x} {y} {z}\n" for x, y, z in rows))
    with pytest.raises(RecordingError, match="take all files from one part"):
        load(folder)


# --- the world --------------------------------------------------------------------------------------------


def scenario(folder: Path, *overrides: str) -> Scenario:
    return load_scenario(
        "drone-cameras", [f"world.path={folder}", 'world.robots=["cam0", "cam3", "cam5"]', "duration_s=20", *overrides]
    )


def everything(world: World) -> list[Output]:
    return [item for k in range(1, world.steps + 1) for item in world.outputs(k)]


def test_each_camera_gives_pixels_of_the_drone_with_the_noise_of_its_sensor(folder: Path, recording: Recording) -> None:
    every = "robots.*.sensors.camera.rate_hz=1000"
    world = open_world(scenario(folder, every, "robots.cam3.sensors.camera.sigma_px=2.5"), 1)
    items = everything(world)
    assert items == sorted(items, key=order)
    for name in ("cam0", "cam3", "cam5"):
        sightings = recording.robots[name].sightings
        assert sightings.pixel is not None
        own = [item for item in items if item.robot == name and item.of is not None]
        first = int(np.searchsorted(sightings.t_ns, recording.start_ns, side="right"))
        assert {(item.kind, item.of, item.phase) for item in own} == {("pixel", "target:t1", Phase.TARGET)}
        assert [item.t_ns + recording.start_ns for item in own] == sightings.t_ns[first : first + len(own)].tolist()
        np.testing.assert_array_equal(own[0].z, sightings.pixel[first])
        assert own[-1].t_ns > 19 * S
    noise = {item.robot: item.R for item in items if item.of is not None}
    np.testing.assert_array_equal(noise["cam3"], np.diag([6.25, 6.25]))


def test_a_camera_uses_no_more_frames_than_its_rate(folder: Path) -> None:
    items = everything(open_world(scenario(folder, "robots.cam0.sensors.camera.rate_hz=2"), 1))
    stamps = {name: [item.t_ns for item in items if item.robot == name and item.of] for name in ("cam0", "cam3")}
    assert 15 <= len(stamps["cam0"]) <= 40 < len(stamps["cam3"]) <= 200
    assert len({t_ns // (S // 2) for t_ns in stamps["cam0"]}) == len(stamps["cam0"])


def test_agents_are_told_mount_intrinsics_and_pose(folder: Path, recording: Recording) -> None:
    made = scenario(folder)
    world = open_world(made, 1)
    for robot in made.robots:
        config, camera = agent_config(made, world, robot), recording.robots[robot.id].camera
        assert camera is not None
        sensor = config.sensor_configs()["camera"]
        assert sensor.mount == camera.mount
        assert sensor.intrinsics == camera.intrinsics
        assert config.initial.mean == recording.truth_at(robot.id, recording.start_ns).tolist()
    np.testing.assert_allclose(world.place("cam0", 6), recording.truth_at("cam0", 5 * S)[:3])
    np.testing.assert_allclose(world.truth("t1", 10)[:3], recording.truth_at("t1", recording.start_ns + S)[:3])
    assert world.truth("t1", 10).shape == (6,)


def test_it_is_played_and_the_joint_filter_follows_the_drone(folder: Path, recording: Recording) -> None:
    result = run_trial(scenario(folder), 1, with_bound=True)
    assert result.trace.bound is not None
    bound = result.trace.bound["targets"]["t1"]
    off = np.linalg.norm((bound.mean - bound.truth)[:, :3], axis=1)
    several = located(recording).cameras[np.rint(5.0 * result.trace.t_s).astype(int)] >= 2
    assert np.sum(several) > 50
    # The first bearings that cross tell the place, not yet the velocity.
    found = several & (result.trace.t_s > 1.0 + result.trace.t_s[several][0])
    assert np.max(off[found]) < 0.6, off
    for track_of in result.trace.targets["t1"].values():
        away = np.linalg.norm((track_of.mean - track_of.truth)[:, :3], axis=1)
        assert np.max(away[found]) < 0.6, away


def test_standing_robots_have_no_motion_and_fixes_have_an_altitude(folder: Path) -> None:
    made = scenario(folder, "robots.cam0.sensors.place={kind='pose', sigma_m=0.5, sigma_rad=0.1, sigma_z_m=0.01}")
    items = [item for item in everything(open_world(made, 1)) if item.robot == "cam0"]
    moved = [item for item in items if item.kind == "odometry"]
    assert all(not item.z.any() and not item.R.any() for item in moved)
    fixes = [item for item in items if item.kind == "pose"]
    np.testing.assert_allclose(np.mean([item.z for item in fixes], axis=0)[2], BUILT[0].pose.centre[2], atol=0.05)
    np.testing.assert_allclose(np.diagonal(fixes[0].R), [0.25, 0.25, 1e-4, 0.01])


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("robots.cam0.model=unicycle", r"has no altitude, and recordings of format 'drone_cameras' are in space"),
        ("targets.t1.model=constant_velocity", "take 'damped_velocity_3d' or 'constant_velocity_3d'"),
        ("targets.t1.model=quadrotor", "needs what nobody knows of a recorded target"),
        ("robots.cam0.sensors.camera.mount=[0.0, 0.0, 0.0, 0.0, 0.1, 0.0]", "remove them from robots.cam0.sensors"),
        ("robots.cam0.sensors.camera.intrinsics.focal_px=700", "remove them from robots.cam0.sensors.camera"),
        ("robots.cam0.sensors.camera={kind='bearing3', of=['targets'], sigma_rad=0.1}", "take another kind"),
    ],
)
def test_what_does_not_go_with_it_is_refused_with_the_remedy(folder: Path, override: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        everything(open_world(scenario(folder, *with_others(override)), 1))


def with_others(override: str) -> tuple[str, ...]:
    """With what else another model takes."""
    if "unicycle" in override:
        return (override, "robots.cam0.start={}")
    if "quadrotor" in override:
        more = ("targets.t1.start_sigma.heading_rad=1.0", "targets.t1.noise.altitude_m=1.0", "tracking.kind=clat")
        return (override, *more)
    if "constant_velocity" in override:
        return (override, "tracking.kind=clat")
    return (override,)


# --- without a filter -------------------------------------------------------------------------------------


def test_places_nearest_to_the_rays_are_on_the_track(recording: Recording) -> None:
    """0.3 px at 60 m and 1000 px of focal length are 2 cm; what the fit and interpolation add is less."""
    places = located(recording)
    several = places.cameras >= 2
    assert np.sum(several) > 150 and np.sum(places.cameras == 3) > 50
    assert np.isnan(places.error_m[~several]).all()
    assert np.sqrt(np.mean(places.error_m[several] ** 2)) < 0.08
    for name, camera in views(recording).items():
        off = (camera.predicted - camera.pixel)[np.isfinite(camera.pixel[:, 0])]
        assert np.sqrt(np.mean(off**2)) < 1.0, name


def test_the_table_is_printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder)]) == 0
    printed = capsys.readouterr().out
    assert all(f"| {name} |" in printed for name in ("cam0", "cam3", "cam5", "2 or more", "3"))
    shorter = ["--set", 'world.robots=["cam0", "cam3", "cam5"]', "--set", "duration_s=20"]
    assert main([str(folder), "--filter", *shorter]) == 0
    printed = capsys.readouterr().out.partition("Centralized filter")[2]
    (row,) = [line for line in printed.splitlines() if line.startswith("| 2 or more")]
    assert float(row.split("|")[3]) < 0.35
    assert main([str(folder), "--tracks", *shorter]) == 0
    assert "have a track; ANEES there" in capsys.readouterr().out
    assert main([str(folder), "--filter", *shorter, "--set", "step_s=0.3"]) == 2
    assert "leave it at 0.1" in capsys.readouterr().err
    assert main([str(folder / "gone")]) == 2
    assert "no such folder" in capsys.readouterr().err


def test_the_recorded_set_is_as_good_as_it_was_found_to_be() -> None:
    if not DRONES:
        pytest.skip("COFIX_DRONES does not name the folder dataset3 of the drone tracking set")
    recording = load(DRONES)
    places = located(recording)
    several = places.cameras >= 2
    assert np.sum(several) == pytest.approx(2730, abs=10)
    assert np.sqrt(np.mean(places.error_m[several] ** 2)) <= 0.43
    assert np.median(places.error_m[several]) <= 0.19
    medians: dict[str, Any] = {}
    for name, camera in views(recording).items():
        off = (camera.predicted - camera.pixel)[np.isfinite(camera.pixel[:, 0])]
        medians[name] = float(np.median(np.linalg.norm(off, axis=1)))
    assert medians["cam4"] <= 1.5 and medians["cam1"] <= 14.0 and len(medians) == 6, medians
