"""A recorded world: odometry and sightings of real robots, played at their own stamps."""

from __future__ import annotations

from dataclasses import astuple
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.calibration import Calibration, corrected
from agent.config_file import ConfigError
from agent.config_parts import IntrinsicsPart
from agent.effects import Steer
from agent.estimation.gaussian import wrap_components
from agent.estimation.motion import SPATIAL, UNICYCLE
from agent.estimation.observation import ABSOLUTE, RELATIVE_ANGLES, AbsoluteModel
from agent.settings import NS, nanoseconds
from agent.timeline import Phase
from sim.noise import normal_rows
from sim.recordings import LOADERS
from sim.recordings.recording import Recording, Sightings
from sim.scenario import SPATIAL_FORMATS, RobotPart, Scenario, SensorPart, sensor_kind
from sim.sensor_noise import absolute_noise, control_odometry, relative_noise
from sim.world import Output, order, phase_of, start_belief

Array = NDArray[np.float64]


@lru_cache(maxsize=2)
def _read(format_: str, path: str, stamp_ns: int) -> Recording:
    """The recording as it was at `stamp_ns`; many trials read it once."""
    return LOADERS[format_](path)


def _stamp_ns(path: str) -> int:
    """When the file, or anything in the folder, was last changed; 0 without it."""
    place = Path(path)
    files = [place, *place.iterdir()] if place.is_dir() else [place]
    return max((item.stat().st_mtime_ns for item in files if item.exists()), default=0)


class RecordedWorld:
    """A recording as a `World`. Instant 0 is the start of the span all its robots have in common.

    Odometry is integrated over each step from the commanded velocities of `odometry.lag_s` ago; where none was
    recorded it is the true motion with drawn noise. Sightings keep their stamps, and each robot uses those its sensors
    name (`of`), with the covariance the sensor states; fixes are drawn around the truth. Mount and intrinsics of a
    camera are the recording's. Where the recording has no truth, truth is NaN. A target is a robot of the recording
    that takes part in nothing; its true velocity is that of its true places over half a second.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        path = scenario.world.path
        assert path is not None
        self._recording = _read(scenario.world.format, path, _stamp_ns(path))
        self._scenario, self.seed = scenario, seed
        self.closed_loop = False
        self.robots = tuple(robot.id for robot in scenario.robots)
        self.targets = tuple(target.id for target in scenario.targets)
        self.landmarks: dict[str, tuple[float, ...]] = dict(self._recording.landmarks.items())
        self._spatial = scenario.world.format in SPATIAL_FORMATS
        self.step_ns = nanoseconds(scenario.step_s)
        self._start_ns = self._recording.start_ns
        self._check(path)
        span = min(round(scenario.duration_s * NS), self._recording.end_ns - self._start_ns)
        self.steps = int(span // self.step_ns)
        self._noise: dict[tuple[str, str], Array] = {}
        self._sensors = {robot.id: self._completed(robot) for robot in scenario.robots}
        self._calibrations = {
            (robot.id, name): sensor.calibration.settings()
            for robot in scenario.robots
            for name, sensor in robot.sensors.items()
        }
        self._used = {
            (robot.id, name): _spaced(self._recording.robots[robot.id].sightings, self._start_ns, sensor.rate_hz)
            for robot in scenario.robots
            for name, sensor in robot.sensors.items()
            if sensor_kind(name, sensor) in RELATIVE_ANGLES
        }

    def _check(self, path: str) -> None:
        """Raises `ConfigError` for what the recording does not hold."""
        for name in (*self.robots, *self.targets):
            if name not in self._recording.robots:
                raise ConfigError(
                    f"{path}: the recording has no data of robot {name}; there are: {', '.join(self._recording.robots)}"
                )
        for robot in self._scenario.robots:
            recorded = self._recording.robots[robot.id]
            for name, sensor in robot.sensors.items():
                stated = sensor.mount != SensorPart().mount or sensor.intrinsics != SensorPart().intrinsics
                if recorded.camera is not None and sensor_kind(name, sensor) == "pixel" and stated:
                    raise ConfigError(
                        f"{path}: mount and intrinsics of a camera are those of the recording; remove them from "
                        f"robots.{robot.id}.sensors.{name}"
                    )
            if recorded.truth is not None:
                continue
            if recorded.odometry is None:
                raise ConfigError(f"{path}: the recording has neither odometry nor ground truth of robot {robot.id}")
            if robot.start.pose is None:
                raise ConfigError(
                    f"{path}: the recording has no ground truth of robot {robot.id}: say where it starts, "
                    f"--set 'robots.{robot.id}.start.pose=[X, Y, HEADING]', and how sure that is with start_sigma"
                )
            fixes = [name for name, sensor in robot.sensors.items() if sensor_kind(name, sensor) in ABSOLUTE]
            if fixes:
                raise ConfigError(
                    f"{path}: the recording has no ground truth of robot {robot.id} to make fixes of; remove "
                    f"robots.{robot.id}.sensors.{fixes[0]}"
                )
        for target in self._scenario.targets:
            pose = target.start.pose
            if self._recording.robots[target.id].truth is None and (pose is None or len(pose) != 4):
                raise ConfigError(
                    f"{path}: the recording has no ground truth of {target.id}: set targets.{target.id}.start.pose to "
                    "x, y and velocity"
                )

    def _completed(self, robot: RobotPart) -> dict[str, SensorPart]:
        """The sensors of a robot, with what the recording tells of its camera."""
        camera, found = self._recording.robots[robot.id].camera, dict(robot.sensors)
        for name, sensor in robot.sensors.items():
            if camera is not None and sensor_kind(name, sensor) == "pixel":
                focal_px, (u, v), (width, height) = astuple(camera.intrinsics)
                intrinsics = IntrinsicsPart(focal_px=focal_px, size_px=[width, height], center_px=[u, v])
                found[name] = sensor.model_copy(update={"mount": list(camera.mount), "intrinsics": intrinsics})
        return found

    def sensors(self, robot: str) -> dict[str, SensorPart]:
        return self._sensors[robot]

    def _known(self, entity: str) -> bool:
        return self._recording.robots[entity].truth is not None

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        part = self._scenario.movers()[entity]
        if self._known(entity):
            return start_belief(part, self.truth(entity, 0), self.seed)
        assert part.start.pose is not None
        cov = part.start_sigma.covariance(part.model)
        return np.append(part.start.pose, np.ones(len(cov) - len(part.start.pose))), cov

    def truth(self, entity: str, k: int) -> Array:
        """Pose (3,) or (4,) of a robot, position and velocity (4,) or (6,) of a target.

        NaN where nobody measured it.
        """
        t_ns = self._start_ns + k * self.step_ns
        if not self._known(entity):
            return np.full(4 if entity in self.targets else 3, np.nan)
        pose = self._recording.truth_at(entity, t_ns)
        if entity in self.targets:
            return np.append(pose[:-1], self._recording.velocity_at(entity, t_ns))
        return pose

    def place(self, entity: str, k: int) -> Array:
        truth = self.truth(entity, k)
        return np.append(truth[:2], truth[2] if self._spatial else 0.0)

    def steer(self, robot: str, t_ns: int, steer: Steer) -> None:
        raise ValueError(f"{robot} cannot be steered: it has moved as it was recorded")

    def outputs(self, k: int) -> list[Output]:
        found: list[Output] = []
        for robot in self._scenario.robots:
            found.append(self._odometry(robot, k))
            found.extend(self._sightings(robot, k))
            found.extend(self._fixes(robot, k))
        found.sort(key=order)
        return found

    def _drawn(self, robot: str, name: str, size: int, k: int) -> Array:
        """Standard normal numbers (size,) of a robot's sensor for instant k."""
        if (robot, name) not in self._noise:
            self._noise[robot, name] = normal_rows(self.seed, self.steps + 1, size, robot, name)
        return np.asarray(self._noise[robot, name][k])

    def _odometry(self, robot: RobotPart, k: int) -> Output:
        noise, dt_s = control_odometry(robot, self._scenario.step_s), self._scenario.step_s
        t1_ns = k * self.step_ns
        t0_ns = t1_ns - self.step_ns
        lag_ns = nanoseconds(noise.lag_s)
        begin, end = self._start_ns + t0_ns - lag_ns, self._start_ns + t1_ns - lag_ns
        if self._recording.robots[robot.id].odometry is None:
            dx, dy, dyaw = self._recording.increment(robot.id, self._start_ns + t0_ns, self._start_ns + t1_ns)
            true = np.array([dx, dy, 0.0, dyaw])
            cov = noise.covariance(true, dt_s)
            delta = true + np.sqrt(np.diagonal(cov)) * self._drawn(robot.id, "odometry", 4, k)
        else:
            dx, dy, dyaw = self._recording.increment(robot.id, begin, end)
            delta = noise.calibrated(np.array([dx, dy, 0.0, dyaw]))
            cov = noise.covariance(delta, dt_s)
        return Output(t1_ns, Phase.PREDICT, robot.id, "odometry", "odometry", None, delta, cov, t0_ns)

    def _sightings(self, robot: RobotPart, k: int) -> list[Output]:
        sightings = self._recording.robots[robot.id].sightings
        until = self._start_ns + k * self.step_ns
        low = int(np.searchsorted(sightings.t_ns, until - self.step_ns, side="right"))
        high = int(np.searchsorted(sightings.t_ns, until, side="right"))
        outputs = []
        for index in range(low, high):
            what, of = self._named(sightings.subject[index])
            if of is None:
                continue
            range_m, bearing_rad = float(sightings.range_m[index]), float(sightings.bearing_rad[index])
            for name, sensor in robot.sensors.items():
                if what not in sensor.of or not self._used[robot.id, name][index]:
                    continue
                if sensor.max_range_m is not None and range_m > sensor.max_range_m:
                    continue
                kind = sensor_kind(name, sensor)
                # A two-way range is measured by both; the lower id uses its own.
                if what == "peers" and kind == "range" and sensor.two_way and of < robot.id:
                    continue
                if kind == "pixel" and sightings.pixel is not None:
                    z, R = sightings.pixel[index].copy(), relative_noise(kind, sensor, 0.0)
                else:
                    calibration = self._calibrations[robot.id, name]
                    z, R = self._measured(kind, of, sensor, calibration, range_m, bearing_rad)
                t_ns = int(sightings.t_ns[index]) - self._start_ns
                outputs.append(Output(t_ns, phase_of(of), robot.id, name, kind, of, z, R))
        return outputs

    def _named(self, subject: str) -> tuple[str, str | None]:
        """What a subject of the recording is in this scenario, and its name; None: nothing."""
        if subject in self.targets:
            return "targets", f"target:{subject}"
        if subject in self._recording.robots:
            return "peers", subject if subject in self.robots else None
        return "landmarks", f"landmark:{subject}" if subject in self.landmarks else None

    @staticmethod
    def _measured(
        kind: str, of: str, sensor: SensorPart, calibration: Calibration, range_m: float, bearing_rad: float
    ) -> tuple[Array, Array]:
        """The reading as recorded, with the covariance its sensor states at the calibrated distance."""
        full = {"range": [range_m], "bearing": [bearing_rad], "range_bearing": [range_m, bearing_rad]}
        z = np.array(full.get(kind, [np.nan]))
        if not np.all(np.isfinite(z)):
            raise ConfigError(f"the recording does not hold what a sensor of kind '{kind}' measures; take another kind")
        polar = "range" if np.isnan(bearing_rad) else "range_bearing"
        distance = corrected(polar, of, np.array(full[polar]), calibration)[0]
        return z, relative_noise(kind, sensor, float(distance))

    def _fixes(self, robot: RobotPart, k: int) -> list[Output]:
        outputs = []
        for name, sensor in robot.sensors.items():
            kind = sensor_kind(name, sensor)
            every = 1 if sensor.rate_hz is None else max(1, round(NS / (sensor.rate_hz * self.step_ns)))
            if kind in RELATIVE_ANGLES or k % every:
                continue
            R = absolute_noise(kind, sensor, self._spatial)
            fix = AbsoluteModel(kind, SPATIAL if self._spatial else UNICYCLE, len(R))
            z = fix.h(self.truth(robot.id, k)) + np.sqrt(np.diagonal(R)) * self._drawn(robot.id, name, len(R), k)
            t_ns = k * self.step_ns
            outputs.append(Output(t_ns, Phase.PRIVATE, robot.id, name, kind, None, wrap_components(z, fix.angles), R))
        return outputs


def _spaced(sightings: Sightings, start_ns: int, rate_hz: float | None) -> NDArray[np.bool_]:
    """Which sightings (K,) a sensor uses: all, or of each subject the first one in every period of its rate."""
    used = np.ones(len(sightings.t_ns), dtype=bool)
    if rate_hz is None:
        return used
    period_ns, last = round(NS / rate_hz), dict[str, int]()
    for index, slot in enumerate(((sightings.t_ns - start_ns) // period_ns).tolist()):
        used[index] = last.get(sightings.subject[index]) != slot
        last[sightings.subject[index]] = slot
    return used
