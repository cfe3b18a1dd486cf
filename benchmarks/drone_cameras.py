"""How well a recorded drone can be located by cameras, without a filter: `python -m benchmarks.drone_cameras FOLDER`.

At every row of the truth (5 Hz) the pixels of each camera are interpolated to its instant. Printed are the reprojection
errors of the truth, and errors of the places that lie nearest to the rays of all cameras that see the drone then, in
the sense of least squares, where two or more do. Poses and clock were fitted to the same truth (see
`sim.recordings.drone_cameras`), so that this is a figure of the data, not of a method; a tracker has to be better.
With `--filter`, errors of the centralized filter of the scenario `drone-cameras` are printed beside (a minute), with
`--tracks` those of the tracks that the cameras of that scenario tell, with the mean NEES of their places (minutes).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.estimation.mounting import rotation
from sim.bearing_bound import bound_of
from sim.recordings.drone_cameras import STEP_NS, TARGET, load
from sim.recordings.recording import Recording, RecordingError
from sim.scenario_file import load as load_scenario
from sim.trial import open_world, run_trial

Array = NDArray[np.float64]

MAX_GAP_NS = 150_000_000
"""Pixels are interpolated between frames that are no further apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What a camera saw at E instants: pixels (E, 2), NaN where it did not; rays (E, 3) in ENU from its place (3,)."""

    pixel: Array
    predicted: Array
    ray: Array
    place: Array


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """At E instants: how many cameras saw the drone (E,), and how far the place found is off [m] (E,), else NaN."""

    cameras: NDArray[np.int64]
    error_m: Array


def instants(recording: Recording) -> NDArray[np.int64]:
    """Stamps (E,) of the truth within the recording's span."""
    return np.arange(recording.start_ns, recording.end_ns + 1, STEP_NS, dtype=np.int64)


def views(recording: Recording) -> dict[str, Views]:
    """By camera, at the instants of the truth."""
    at = instants(recording)
    truth = np.array([recording.truth_at(TARGET, int(t_ns))[:3] for t_ns in at])
    found = {}
    for name, robot in recording.robots.items():
        if robot.camera is None or robot.sightings.pixel is None:
            continue
        t_ns, pixel = robot.sightings.t_ns, robot.sightings.pixel
        after = np.clip(np.searchsorted(t_ns, at), 1, len(t_ns) - 1)
        gap = t_ns[after] - t_ns[after - 1]
        share = (at - t_ns[after - 1]) / gap
        usable = (share >= 0.0) & (share <= 1.0) & (gap <= MAX_GAP_NS)
        seen = pixel[after - 1] + share[:, None] * (pixel[after] - pixel[after - 1])
        seen[~usable] = np.nan
        pose = recording.truth_at(name, recording.start_ns)
        axes = rotation(0.0, 0.0, float(pose[3])) @ rotation(*robot.camera.mount[3:])
        intrinsics = robot.camera.intrinsics
        center = np.array(intrinsics.center_px)
        plane = (seen - center) / intrinsics.focal_px
        ray = np.column_stack([np.ones(len(at)), -plane]) @ axes.T
        inside = (truth - pose[:3]) @ axes
        predicted = center - intrinsics.focal_px * inside[:, 1:] / inside[:, :1]
        found[name] = Views(seen, predicted, ray / np.linalg.norm(ray, axis=1, keepdims=True), pose[:3])
    return found


def located(recording: Recording) -> Located:
    """The drone by least squares of the distances to all rays, where two cameras or more see it."""
    seen = list(views(recording).values())
    at = instants(recording)
    information, pull, cameras = np.zeros((len(at), 3, 3)), np.zeros((len(at), 3)), np.zeros(len(at), dtype=np.int64)
    for camera in seen:
        usable = np.isfinite(camera.ray[:, 0])
        across = np.eye(3) - camera.ray[usable, :, None] * camera.ray[usable, None, :]
        information[usable] += across
        pull[usable] += across @ camera.place
        cameras[usable] += 1
    error, several = np.full(len(at), np.nan), cameras >= 2
    place = np.linalg.solve(information[several], pull[several][..., None])[..., 0]
    truth = np.array([recording.truth_at(TARGET, int(t_ns))[:3] for t_ns in at[several]])
    error[several] = np.linalg.norm(place - truth, axis=1)
    return Located(cameras, error)


def filtered(folder: str, overrides: Sequence[str] = ()) -> Array:
    """Errors [m] (E,) of the centralized filter of the scenario `drone-cameras` at the instants of the truth."""
    scenario = load_scenario("drone-cameras", [f"world.path={folder}", *overrides])
    world = open_world(scenario, 1)
    if STEP_NS % world.step_ns:
        raise ConfigError(f"step_s = {world.step_ns * 1e-9:g} does not divide that of the truth; leave it at 0.1")
    runner, stride = bound_of(scenario, world), STEP_NS // world.step_ns
    errors = np.full(world.steps // stride + 1, np.nan)
    for k in range(1, world.steps + 1):
        runner.step(k, world.outputs(k))
        if k % stride == 0 and (belief := runner.belief(TARGET)) is not None:
            errors[k // stride] = np.linalg.norm(belief[0][:3] - world.place(TARGET, k))
    return errors


def told(folder: str, overrides: Sequence[str] = ()) -> tuple[Array, Array]:
    """Errors [m] and NEES per degree of freedom of the place, (cameras, E), of what each camera tells of the drone."""
    scenario = load_scenario("drone-cameras", [f"world.path={folder}", *overrides])
    tracks = run_trial(scenario, 1).trace.targets[TARGET].values()
    away = np.array([(track.mean - track.truth)[:, :3] for track in tracks])
    covs = np.array([track.cov[:, :3, :3] for track in tracks])
    scaled = (away[..., None, :] @ np.linalg.solve(covs, away[..., None]))[..., 0, 0] / 3.0
    return np.linalg.norm(away, axis=-1), scaled


def table(recording: Recording) -> str:
    """Reprojection errors of each camera, and errors of the places, as text."""
    lines = ["| camera | instants | rmse [px] | median [px] | mean [px], right and down |", "|" + "---|" * 5]
    for name, camera in views(recording).items():
        off = (camera.predicted - camera.pixel)[np.isfinite(camera.pixel[:, 0])]
        figures = (np.sqrt(np.mean(off**2, axis=0)), np.median(np.abs(off), axis=0), np.mean(off, axis=0))
        lines.append(f"| {name} | {len(off)} | " + " | ".join(f"{x:.2f}, {y:.2f}" for x, y in figures) + " |")
    places = located(recording)
    return "\n".join([*lines, "", errors_table(places.cameras, places.error_m)])


def errors_table(cameras: NDArray[np.int64], error_m: Array) -> str:
    """Errors (E,) by how many cameras (E,) saw the drone, as text; NaN are left out."""
    lines = ["| cameras | instants | rmse [m] | median [m] | 95 % [m] | largest [m] |", "|" + "---|" * 6]
    cases = [("2 or more", cameras >= 2), *((str(n), cameras == n) for n in range(int(cameras.max()) + 1))]
    for what, use in cases:
        error = error_m[use & np.isfinite(error_m)]
        if len(error):
            rmse, (middle, most_m, largest) = np.sqrt(np.mean(error**2)), np.quantile(error, [0.5, 0.95, 1.0])
            lines.append(f"| {what} | {len(error)} | {rmse:.3f} | {middle:.3f} | {most_m:.3f} | {largest:.3f} |")
        else:
            lines.append(f"| {what} | {np.sum(use)} | - | - | - | - |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drone_cameras", description=__doc__)
    parser.add_argument("folder", help="dataset3 of the drone tracking set, with the folder calibration beside it")
    parser.add_argument("--filter", action="store_true", help="with errors of the centralized filter")
    parser.add_argument("--tracks", action="store_true", help="with errors of what cameras tell each other")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of its scenario")
    options = parser.parse_args(arguments)
    try:
        recording = load(options.folder)
        print(table(recording))
        if options.filter:
            error_m = filtered(options.folder, options.set)
            print("\nCentralized filter\n\n" + errors_table(located(recording).cameras[: len(error_m)], error_m))
        if options.tracks:
            error_m, scaled = told(options.folder, options.set)
            cameras = np.broadcast_to(located(recording).cameras[: error_m.shape[1]], error_m.shape)
            print("\nTracks of all cameras\n\n" + errors_table(cameras.ravel(), error_m.ravel()))
            known, several = np.isfinite(error_m), cameras >= 2
            share, anees = known[several].mean(), scaled[known & several].mean()
            print(f"\n{share:.3f} of the instants with two cameras have a track; ANEES there {anees:.2f}")
    except (RecordingError, ConfigError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
