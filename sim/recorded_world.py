"""A recorded world: odometry and sightings of real robots, played at their own stamps."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.settings import NS, nanoseconds
from agent.timeline import Phase
from sim.recordings.utias import Recording, load
from sim.scenario import RobotPart, Scenario, SensorPart, sensor_kind
from sim.world import Output, control_odometry, drawn_belief, order, phase_of, relative_noise

Array = NDArray[np.float64]


@lru_cache(maxsize=1)
def _read(path: str, stamp_ns: int) -> Recording:
    """The recording as it was at `stamp_ns`; many trials read it once."""
    return load(path)


def _stamp_ns(path: str) -> int:
    """When anything in the folder was last changed; 0 without it."""
    folder = Path(path)
    files = [folder, *folder.iterdir()] if folder.is_dir() else []
    return max((item.stat().st_mtime_ns for item in files), default=0)


class RecordedWorld:
    """A UTIAS MR.CLAM recording as a `World`. Instant 0 is the start of the span all robots have in common.

    Odometry is integrated from the commanded velocities over each step; sightings keep their stamps, and each
    robot uses those its sensors name (`of`), with the covariance the sensor states.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        path = scenario.world.path
        assert path is not None
        self._recording: Recording = _read(path, _stamp_ns(path))
        self._scenario, self._seed = scenario, seed
        missing = [robot.id for robot in scenario.robots if robot.id not in self._recording.robots]
        if missing:
            raise ConfigError(
                f"{path}: the recording has no odometry of robot {missing[0]}; remove it from the scenario's robots"
            )
        unknown = [r.id for r in scenario.robots if self._recording.robots[r.id].truth is None]
        if unknown:
            raise ConfigError(f"{path}: the recording has no ground truth of robot {unknown[0]}, which a run needs")
        self.robots = tuple(robot.id for robot in scenario.robots)
        self.targets: tuple[str, ...] = ()
        self.landmarks = dict(self._recording.landmarks)
        self.step_ns = nanoseconds(scenario.step_s)
        self._start_ns = self._recording.start_ns
        span = min(round(scenario.duration_s * NS), self._recording.end_ns - self._start_ns)
        self.steps = int(span // self.step_ns)

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        part = next(robot for robot in self._scenario.robots if robot.id == entity)
        return drawn_belief(self.truth(entity, 0), part.start_sigma.covariance(part.model), self._seed, entity)

    def truth(self, entity: str, k: int) -> Array:
        return np.array(self._recording.truth_at(entity, self._start_ns + k * self.step_ns))

    def outputs(self, k: int) -> list[Output]:
        found: list[Output] = []
        for robot in self._scenario.robots:
            found.append(self._odometry(robot, k))
            found.extend(self._sightings(robot, k))
        found.sort(key=order)
        return found

    def _odometry(self, robot: RobotPart, k: int) -> Output:
        t1_ns = k * self.step_ns
        t0_ns = t1_ns - self.step_ns
        dx, dy, dyaw = self._recording.increment(robot.id, self._start_ns + t0_ns, self._start_ns + t1_ns)
        noise = control_odometry(robot, self._scenario.step_s)
        delta = noise.calibrated(np.array([dx, dy, 0.0, dyaw]))
        cov = noise.covariance(delta, self.step_ns * 1e-9)
        return Output(t1_ns, Phase.PREDICT, robot.id, "odometry", "odometry", None, delta, cov, t0_ns)

    def _sightings(self, robot: RobotPart, k: int) -> list[Output]:
        sightings = self._recording.robots[robot.id].sightings
        until = self._start_ns + k * self.step_ns
        low = int(np.searchsorted(sightings.t_ns, until - self.step_ns, side="right"))
        high = int(np.searchsorted(sightings.t_ns, until, side="right"))
        outputs = []
        for index in range(low, high):
            subject = sightings.subject[index]
            peer = subject in self._recording.robots
            of = subject if peer else f"landmark:{subject}"
            if peer and subject not in self.robots:
                continue
            for name, sensor in robot.sensors.items():
                if ("peers" if peer else "landmarks") not in sensor.of:
                    continue
                z, R = self._measured(
                    name, sensor, float(sightings.range_m[index]), float(sightings.bearing_rad[index])
                )
                t_ns = int(sightings.t_ns[index]) - self._start_ns
                outputs.append(Output(t_ns, phase_of(of), robot.id, name, sensor_kind(name, sensor), of, z, R))
        return outputs

    @staticmethod
    def _measured(name: str, sensor: SensorPart, range_m: float, bearing_rad: float) -> tuple[Array, Array]:
        kind = sensor_kind(name, sensor)
        full = {"range": [range_m], "bearing": [bearing_rad], "range_bearing": [range_m, bearing_rad]}
        return np.array(full[kind]), relative_noise(kind, sensor, range_m)
