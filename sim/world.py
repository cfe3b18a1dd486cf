"""A simulated world: true motion of robots and targets, and what their sensors say of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from agent.effects import Steer
from agent.estimation.gain_motion import reported
from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.motion import LAYOUTS, PLANAR, SPATIAL, UNICYCLE_GAINS
from agent.estimation.observation import RELATIVE_ANGLES, AbsoluteModel, OutOfViewError
from agent.settings import NS, nanoseconds
from agent.timeline import Phase
from sim.arcs import flown
from sim.closed_loop import ClosedLoop, Motion, planar_of
from sim.clutter import Clutter
from sim.course import driven_along
from sim.directions import DRAWS, anywhere, direction_covariance, direction_of, disturbed, vector
from sim.gimbal import Gimbal, level_turned
from sim.motion import driven
from sim.noise import generator, normal_rows, uniform_rows
from sim.placement import draw_phases, draw_spread, spread_pose
from sim.scenario import RobotPart, Scenario, SensorPart, TargetPart, sensor_kind
from sim.sensor_noise import absolute_noise, control_odometry, relative_noise
from sim.sight import places, sights, steps_between
from sim.steering import steered

Array = NDArray[np.float64]


@dataclass(slots=True, eq=False)
class Output:
    """One sensor datum at `t_ns` since the start; odometry covers [t0_ns, t_ns].

    `attitude` is the roll and pitch [rad] the robot tells with it; None: level. It reaches the robot `late_ns` after
    `t_ns`. `truly`: whom a camera has seen that does not tell, which nobody is told; "" of nobody.
    """

    t_ns: int
    phase: Phase
    robot: str
    sensor: str
    kind: str
    of: str | None
    z: Array
    R: Array
    t0_ns: int | None = None
    attitude: tuple[float, float] | None = None
    late_ns: int = 0
    truly: str | None = None


class World(Protocol):
    """What an engine needs of a world, simulated or recorded. Instant k is k steps after the start.

    In a world of `closed_loop` robots move as they are told: truth is there up to the instant whose `outputs` were
    asked for last, NaN of what is not played. They are asked for once, in order, after all commands before them.
    """

    robots: tuple[str, ...]
    targets: tuple[str, ...]
    landmarks: dict[str, tuple[float, ...]]
    steps: int
    step_ns: int
    seed: int
    closed_loop: bool

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        """Initial mean (n,) and covariance (n, n) given to the estimators."""
        ...

    def truth(self, entity: str, k: int) -> Array:
        """True state (n,) at instant k."""
        ...

    def place(self, entity: str, k: int) -> Array:
        """True x, y, z (3,) at instant k; what is planar lies at z = 0."""
        ...

    def sensors(self, robot: str) -> dict[str, SensorPart]:
        """The sensors of a robot as they are: a recorded camera has its own mount and intrinsics."""
        ...

    def outputs(self, k: int) -> list[Output]:
        """All data with instants in (k - 1, k], in order of (instant, phase, robot, subject)."""
        ...

    def steer(self, robot: str, t_ns: int, steer: Steer) -> None:
        """A robot is told to move from `t_ns` on, until `steer.until_ns`, both since the start.

        Raises `ValueError` for a robot that does not choose its motion.
        """
        ...


def order(output: Output) -> tuple[int, int, str, str]:
    """Sorting key of data: instant, phase, robot, subject."""
    return (output.t_ns, int(output.phase), output.robot, output.of or "")


def phase_of(of: str | None) -> Phase:
    """When, within an instant, a datum about `of` is used."""
    if of is None or of.startswith("landmark:"):
        return Phase.PRIVATE
    return Phase.TARGET if of.startswith("target:") else Phase.PAIR


class SimulatedWorld:
    """Truth and sensors of a `[world] kind = "simulated"` scenario for one seed.

    Controls are held over a step and carry white noise; odometry reports the commanded motion, so that
    truth = odometry (+) noise with the covariance the odometry states. Robots with planning drive by commands that are
    given while the world is played, the others in the same world by their constant controls.
    """

    def __init__(self, scenario: Scenario, seed: int, *, played: bool = False) -> None:
        """`played`: `motion` of robots with planning is filled in afterwards, and the loop is not closed."""
        self._scenario, self.seed = scenario, seed
        self.robots = tuple(robot.id for robot in scenario.robots)
        self.targets = tuple(target.id for target in scenario.targets)
        self.landmarks = {item.id: item.place() for item in scenario.landmarks}
        self.step_ns = nanoseconds(scenario.step_s)
        self.steps = round(scenario.duration_s * NS) // self.step_ns
        phases = draw_phases(scenario, seed)
        self._tracks: dict[str, Array] = {}
        self._commands: dict[str, Array] = {}
        for target in scenario.targets:
            self._tracks[target.id] = driven(scenario, target, start_pose(target, phases, seed), seed, self.steps)
        spread = draw_spread(scenario, seed)
        starts = {
            robot.id: spread[robot.id] if robot.id in spread else start_pose(robot, phases, seed)
            for robot in scenario.robots
        }
        self._flown: dict[str, Array] = {}
        if scenario.world.steering is not None:
            around = self._tracks[scenario.targets[0].id]
            tracks, commands = steered(scenario, scenario.world.steering, starts, around, seed, self.steps)
            self._tracks |= tracks
            self._commands |= commands
        else:
            for robot in scenario.robots:
                if robot.arc is None:
                    self._tracks[robot.id] = driven(scenario, robot, starts[robot.id], seed, self.steps)
                    continue
                self._tracks[robot.id], self._flown[robot.id] = flown(
                    robot.arc, starts[robot.id], scenario.step_s, self.steps, seed, robot.id
                )
        self.motion = Motion()
        for robot in scenario.planners():
            states = self.motion.states[robot.id] = self._tracks[robot.id]
            states[1:, slice(None) if robot.vehicle.flies else planar_of(robot)] = np.nan
            self.motion.moved[robot.id] = np.full((self.steps, 4), np.nan)
        self.closed_loop = bool(self.motion.states) and not played
        self._loop = ClosedLoop(scenario, self.motion, seed, self.step_ns) if self.closed_loop else None
        movers = scenario.movers()
        self._index = {name: index for index, name in enumerate(movers)}
        self._layouts = {name: LAYOUTS[part.model] for name, part in movers.items()}
        self._places = np.stack([places(self._tracks[name], layout) for name, layout in self._layouts.items()])
        self._fixed = np.array([(*point, 0.0)[:3] for point in self.landmarks.values()]).reshape(-1, 3)
        self._driven = {
            robot.id: driven_along(
                robot.course, starts[robot.id], robot.control.speed_mps, self.step_ns, self.steps
            )[1]
            for robot in scenario.robots
            if robot.course is not None
        }
        self._odometry_noise = {robot.id: control_odometry(robot, scenario.step_s) for robot in scenario.robots}
        self._sights = sights(scenario, self._tracks, self.landmarks)
        self._tilt = {
            robot.id: robot.tilt_rad * normal_rows(seed, self.steps + 1, 2, robot.id, "attitude")
            for robot in scenario.robots
            if robot.tilt_rad > 0.0
        }
        self._sensor_noise: dict[tuple[str, str, str], Array] = {}
        self._chances: dict[tuple[str, str, str], Array] = {}
        self._clutter = {
            (robot.id, name): Clutter(sensor.clutter, seed, self.steps + 1, robot.id, name)
            for robot in scenario.robots
            for name, sensor in robot.sensors.items()
            if sensor.clutter > 0.0
        }
        self._labelled = {robot.id for robot in scenario.robots if scenario.correspondence_of(robot).kind == "known"}
        self._gimbals = {
            (robot.id, name): Gimbal(sensor.fov_rad or 2.0 * np.pi, self._heading(robot.id, 0))
            for robot in scenario.robots
            for name, sensor in robot.sensors.items()
            if sensor.gimbal
        }

    def truth(self, entity: str, k: int) -> Array:
        return np.asarray(self._tracks[entity][k])

    def place(self, entity: str, k: int) -> Array:
        return np.asarray(self._places[self._index[entity], k])

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        part = self._scenario.movers()[entity]
        return start_belief(part, self._tracks[entity][0], self.seed)

    def sensors(self, robot: str) -> dict[str, SensorPart]:
        return next(part.sensors for part in self._scenario.robots if part.id == robot)

    def steer(self, robot: str, t_ns: int, steer: Steer) -> None:
        if self._loop is None:
            raise ValueError(f"{robot} cannot be steered: no robot of {self._scenario.name} has a planning.kind")
        self._loop.steer(robot, t_ns, steer)

    def locate(self) -> None:
        """Take over places from `motion` after it was filled in."""
        for name, states in self.motion.states.items():
            self._places[self._index[name]] = places(states, self._layouts[name])

    def outputs(self, k: int) -> list[Output]:
        if self._loop is not None:
            self._loop.play(k)
            for name, states in self.motion.states.items():
                self._places[self._index[name], k] = places(states[k], self._layouts[name])
        found: list[Output] = []
        there = np.concatenate([self._places[:, k], self._fixed])
        gaps = np.linalg.norm(there[:, None] - there, axis=-1).tolist()
        for robot in self._scenario.robots:
            found.append(self._odometry(robot, k))
            for name, sensor in robot.sensors.items():
                if k % steps_between(sensor, self._scenario.step_s) == 0:
                    found.extend(self._sense(robot, name, sensor, k, gaps[self._index[robot.id]]))
        found.sort(key=order)
        return found

    def _odometry(self, robot: RobotPart, k: int) -> Output:
        dt = self._scenario.step_s
        control = robot.control
        speed, yaw_rate = control.speed_mps, control.yaw_rate_radps
        if robot.id in self._commands:
            speed, yaw_rate = self._commands[robot.id][k - 1]
        delta = dt * np.array([speed, 0.0, control.climb_mps, yaw_rate])
        if robot.id in self.motion.moved:
            delta = self.motion.moved[robot.id][k - 1].copy()
        noise = self._odometry_noise[robot.id]
        if robot.id in self._driven:
            delta = np.zeros(4)
            delta[list(PLANAR)] = self._driven[robot.id][k - 1]
            off = np.sqrt(np.diagonal(noise.covariance(delta, dt)))
            delta += off * self._noise(robot.id, "odometry", "", k, 4)
        if LAYOUTS[robot.model] is UNICYCLE_GAINS:
            delta[[0, 1, 3]] = reported(self._tracks[robot.id][k - 1], delta[[0, 1, 3]])
        if robot.id in self._flown:
            delta = self._flown[robot.id][k - 1].copy()
        delta = noise.calibrated(delta)
        t_ns = k * self.step_ns
        cov = noise.covariance(delta, dt)
        if robot.id in self._flown:
            delta += np.sqrt(np.diagonal(cov)) * self._noise(robot.id, "odometry", "", k, 4)
        return Output(t_ns, Phase.PREDICT, robot.id, "odometry", "odometry", None, delta, cov, t_ns - self.step_ns)

    def _noise(self, robot: str, sensor: str, of: str, k: int, size: int) -> Array:
        key = (robot, sensor, of)
        if key not in self._sensor_noise:
            self._sensor_noise[key] = normal_rows(self.seed, self.steps + 1, size, *key)
        return np.asarray(self._sensor_noise[key][k])

    def _lasting(self, robot: str, sensor: str, k: int, size: int, correlation_s: float) -> Array:
        """Standard normal errors (size,) of instant k that last for a time, each as likely as the next."""
        if correlation_s == 0.0:
            return self._noise(robot, sensor, "", k, size)
        key = (robot, sensor, "lasting")
        if key not in self._sensor_noise:
            keep = np.exp(-self._scenario.step_s / correlation_s)
            rows = normal_rows(self.seed, self.steps + 1, size, robot, sensor, "")
            rows[1:] *= np.sqrt(1.0 - keep**2)
            self._sensor_noise[key] = lfilter([1.0], [1.0, -keep], rows, axis=0)
        return np.asarray(self._sensor_noise[key][k])

    def _chance(self, robot: str, name: str, sensor: SensorPart, of: str, k: int) -> Array | None:
        """Uniform numbers (4,) on which it depends whether and where a subject is detected; None: where it is."""
        if sensor.detects == 1.0 and sensor.false_share == 0.0:
            return None
        key = (robot, name, of)
        if key not in self._chances:
            self._chances[key] = uniform_rows(self.seed, self.steps + 1, 4, *key, "detected")
        return np.asarray(self._chances[key][k])

    def _sense(self, robot: RobotPart, name: str, sensor: SensorPart, k: int, gaps: list[float]) -> list[Output]:
        """What a sensor measures at instant k; `gaps`: how far all places are from its robot."""
        kind, state, t_ns = sensor_kind(name, sensor), self._tracks[robot.id][k], k * self.step_ns
        layout = LAYOUTS[robot.model]
        if kind not in RELATIVE_ANGLES:
            R = absolute_noise(kind, sensor, layout is SPATIAL)
            fix = AbsoluteModel(kind, layout, len(R))
            error = self._lasting(robot.id, name, k, len(R), sensor.correlation_s)
            z = fix.h(state) + np.sqrt(np.diagonal(R)) * error
            return [Output(t_ns, Phase.PRIVATE, robot.id, name, kind, None, wrap_components(z, fix.angles), R)]
        outputs = []
        attitude = self._attitude(robot.id, k)
        gimbal, place = self._gimbals.get((robot.id, name)), self._places[self._index[robot.id], k]
        if gimbal is not None:
            gimbal.turn(t_ns)
        for sight in self._sights[robot.id, name]:
            if gaps[sight.index] > sight.reach_m:
                continue
            model = sight.model if attitude is None else replace(sight.model, attitude=attitude)
            of, joint = sight.of, sight.joint(state, k)
            distance = model.distance(joint)
            if distance < sensor.min_range_m or (sensor.max_range_m is not None and distance > sensor.max_range_m):
                continue
            if gimbal is not None:
                if not gimbal.sees(self._places[sight.index, k] - place):
                    continue
            elif sensor.fov_rad is not None:
                (azimuth,) = replace(model, kind="bearing").h(joint)
                if abs(azimuth) > 0.5 * sensor.fov_rad:
                    continue
            try:
                clean = model.h(joint)
            except OutOfViewError:
                continue
            if kind == "pixel" and model.intrinsics is not None and not model.intrinsics.shows(clean):
                continue
            chance = self._chance(robot.id, name, sensor, of, k)
            if chance is not None and chance[0] >= sensor.detects:
                continue
            R, turned = relative_noise(kind, sensor, distance), sensor.noise in DRAWS
            draws = self._noise(robot.id, name, of, k, DRAWS[sensor.noise] if turned else len(R))
            if turned:
                z = disturbed(sensor.noise, clean, sensor.sigma_rad or 0.0, draws)
            else:
                z = clean + np.sqrt(np.diagonal(R)) * draws
            if chance is not None and chance[1] < sensor.false_share:
                if gimbal is None:
                    z = anywhere(len(z), chance[2:], sensor.fov_rad)
                else:
                    z = direction_of(level_turned(-self._heading(robot.id, k), gimbal.anywhere(chance[2:])))
            if gimbal is not None:
                gimbal.saw(level_turned(self._heading(robot.id, k), vector(z)))
            if turned:
                R = direction_covariance(sensor.noise, z, sensor.sigma_rad or 0.0)
            wrap_components(z, model.angles)
            if kind in ("range", "range_bearing"):
                z[0] = max(z[0] + sensor.bias_of.get(of, sensor.bias_m), 0.0)
            secret = sensor.anonymous and robot.id not in self._labelled
            told, truly = (None, of) if secret else (of, None)
            outputs.append(Output(t_ns, phase_of(of), robot.id, name, kind, told, z, R, attitude=attitude, truly=truly))
        if (robot.id, name) in self._clutter:
            for z in self._clutter[robot.id, name].at(k, sensor.fov_rad):
                R = direction_covariance(sensor.noise, z, sensor.sigma_rad or 0.0)
                R = R if sensor.noise in DRAWS else relative_noise(kind, sensor, 0.0)
                outputs.append(Output(t_ns, Phase.PAIR, robot.id, name, kind, None, z, R, attitude=attitude, truly=""))
        if sensor.anonymous:
            # Nothing of the order in which robots are listed may tell who they are.
            outputs.sort(key=lambda item: float(item.z[0]))
        return outputs

    def _heading(self, robot: str, k: int) -> float:
        heading = self._layouts[robot].heading
        assert heading is not None
        return float(self._tracks[robot][k, heading])

    def _attitude(self, robot: str, k: int) -> tuple[float, float] | None:
        """Roll and pitch [rad], within what is told of them; None: level."""
        if robot not in self._tilt:
            return None
        roll, pitch = np.clip(self._tilt[robot][k], -1.5, 1.5).tolist()
        return roll, pitch


def start_belief(part: RobotPart | TargetPart, truth: Array, seed: int) -> tuple[Array, Array]:
    """Initial belief: the truth and its stated error, or else a draw from its covariance, as that of all gains is.

    A truth that is shorter than the state leaves gains of an odometry open: they are 1, as far as is known.
    """
    cov, known = part.start_sigma.covariance(part.model), len(truth)
    error = np.sqrt(np.diagonal(cov)[:known]) * generator(seed, part.id, "start").standard_normal(known)
    if part.start.error is not None:
        error[: len(part.start.error)] = part.start.error
    mean = np.append(truth + error, np.ones(len(cov) - known))
    return wrap_components(mean, LAYOUTS[part.model].angles), cov


def start_pose(robot: RobotPart | TargetPart, phases: dict[str, float], seed: int) -> Array:
    """True start of a robot; on a circle it heads along the tangent, counter-clockwise, at its commanded altitude."""
    if robot.start.circle is None:
        assert robot.start.pose is not None
        return spread_pose(robot, seed, ("place",))
    phase, circle = phases[robot.id], robot.start.circle
    x = circle.center_m[0] + circle.radius_m * np.cos(phase)
    y = circle.center_m[1] + circle.radius_m * np.sin(phase)
    altitude = [robot.control.altitude_m] if LAYOUTS[robot.model] is SPATIAL else []
    return np.array([x, y, *altitude, float(wrap(np.array(phase + np.pi / 2.0)))])
