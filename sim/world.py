"""A simulated world: true motion of robots and targets, and what their sensors say of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.estimation.gain_motion import reported
from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.motion import LAYOUTS, UNICYCLE_GAINS, compose, velocity_step
from agent.estimation.observation import RELATIVE_ANGLES, RelativeModel
from agent.estimation.odometry import OdometryNoise
from agent.settings import NS, nanoseconds
from agent.timeline import Phase
from sim.noise import generator, normal_rows
from sim.scenario import RobotPart, Scenario, SensorPart, TargetPart, sensor_kind

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Output:
    """One sensor datum at `t_ns` since the start; odometry covers [t0_ns, t_ns]."""

    t_ns: int
    phase: Phase
    robot: str
    sensor: str
    kind: str
    of: str | None
    z: Array
    R: Array
    t0_ns: int | None = None


class World(Protocol):
    """What an engine needs of a world, simulated or recorded. Instant k is k steps after the start."""

    robots: tuple[str, ...]
    targets: tuple[str, ...]
    landmarks: dict[str, tuple[float, float]]
    steps: int
    step_ns: int

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        """Initial mean (n,) and covariance (n, n) given to the estimators."""
        ...

    def truth(self, entity: str, k: int) -> Array:
        """True state (n,) at instant k."""
        ...

    def outputs(self, k: int) -> list[Output]:
        """All data with instants in (k - 1, k], in order of (instant, phase, robot, subject)."""
        ...


def control_odometry(robot: RobotPart, step_s: float) -> OdometryNoise:
    """The odometry noise a robot's estimator assumes: stated, or that of its control noise."""
    if robot.odometry is not None:
        return robot.odometry.noise()
    root = float(np.sqrt(step_s))
    return OdometryNoise(
        along_m_per_sqrt_s=robot.noise.speed_mps * root,
        vertical_m_per_sqrt_s=0.0,
        heading_rad_per_sqrt_s=robot.noise.yaw_rate_radps * root,
    )


def order(output: Output) -> tuple[int, int, str, str]:
    """Sorting key of data: instant, phase, robot, subject."""
    return (output.t_ns, int(output.phase), output.robot, output.of or "")


def phase_of(of: str | None) -> Phase:
    """When, within an instant, a datum about `of` is used."""
    if of is None or of.startswith("landmark:"):
        return Phase.PRIVATE
    return Phase.TARGET if of.startswith("target:") else Phase.PAIR


def relative_noise(kind: str, sensor: SensorPart, distance_m: float) -> Array:
    """R (m, m) of a relative measurement at a distance."""
    sigma_m = (sensor.sigma_m or 0.0) + sensor.sigma_m_per_m * distance_m
    sigma_rad = sensor.sigma_rad or 0.0
    diagonal = {
        "range": [sigma_m],
        "bearing": [sigma_rad],
        "range_bearing": [sigma_m, sigma_rad],
        "vector": [sigma_m, sigma_m],
    }[kind]
    return np.diag(np.square(diagonal))


def absolute_noise(kind: str, sensor: SensorPart) -> Array:
    """R (m, m) of an absolute fix."""
    m, rad = sensor.sigma_m or 0.0, sensor.sigma_rad or 0.0
    return np.diag(np.square({"position": [m, m], "pose": [m, m, rad], "heading": [rad]}[kind]))


class SimulatedWorld:
    """Truth and sensors of a `[world] kind = "simulated"` scenario for one seed.

    Controls are held over a step and carry white noise; odometry reports the commanded motion, so that
    truth = odometry (+) noise with the covariance the odometry states.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self._scenario, self._seed = scenario, seed
        self.robots = tuple(robot.id for robot in scenario.robots)
        self.targets = tuple(target.id for target in scenario.targets)
        self.landmarks = {item.id: (item.position[0], item.position[1]) for item in scenario.landmarks}
        self.step_ns = nanoseconds(scenario.step_s)
        self.steps = round(scenario.duration_s * NS) // self.step_ns
        phases = draw_phases(scenario, seed)
        self._tracks: dict[str, Array] = {}
        for robot in scenario.robots:
            self._tracks[robot.id] = self._drive(robot, start_pose(robot, phases))
        for target in scenario.targets:
            assert target.start.pose is not None
            self._tracks[target.id] = self._drive(target, np.array(target.start.pose))
        self._sensor_noise: dict[tuple[str, str, str], Array] = {}

    def _drive(self, mover: RobotPart | TargetPart, start: Array) -> Array:
        """True states (steps + 1, n)."""
        layout = LAYOUTS[mover.model]
        size = layout.dim if layout.heading is None else 3
        if len(start) != size:
            raise ConfigError(f"{self._scenario.name}: {mover.id}.start.pose needs {size} numbers for '{mover.model}'")
        dt = self._scenario.step_s
        noise = normal_rows(self._seed, self.steps, 2, mover.id, "control")
        track = np.zeros((self.steps + 1, layout.dim))
        track[0] = [*start, *[1.0] * (layout.dim - size)]
        if layout.heading is None:
            assert isinstance(mover, TargetPart)
            F, Q = velocity_step(layout, dt, mover.damping_s)
            root = np.linalg.cholesky(Q[np.ix_((0, 2), (0, 2))]) * mover.noise.acceleration_mps2 * np.sqrt(dt)
            more = normal_rows(self._seed, self.steps, 2, mover.id, "acceleration")
            for k in range(self.steps):
                track[k + 1] = F @ track[k]
                for axis in (0, 1):
                    track[k + 1, [axis, axis + 2]] += root @ np.array([noise[k, axis], more[k, axis]])
            return track
        control = np.array([mover.control.speed_mps, mover.control.yaw_rate_radps])
        sigma = np.array([mover.noise.speed_mps, mover.noise.yaw_rate_radps])
        moves = dt * (control + sigma * noise)
        for k in range(self.steps):
            track[k + 1, :3] = compose(track[k, :3], np.array([moves[k, 0], 0.0, moves[k, 1]]))
        track[:, 2] = wrap(track[:, 2])
        if layout is UNICYCLE_GAINS:
            assert isinstance(mover, RobotPart)
            walk = mover.gain_walk_per_sqrt_s * np.sqrt(dt)
            steps = normal_rows(self._seed, self.steps, 2, mover.id, "gains")
            track[1:, 3:] += walk * np.cumsum(steps, axis=0) + 1.0
        return track

    def truth(self, entity: str, k: int) -> Array:
        return np.asarray(self._tracks[entity][k])

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        part = self._scenario.movers()[entity]
        cov = part.start_sigma.covariance(part.model)
        return drawn_belief(self._tracks[entity][0], cov, self._seed, entity, LAYOUTS[part.model].angles)

    def outputs(self, k: int) -> list[Output]:
        found: list[Output] = []
        for robot in self._scenario.robots:
            found.append(self._odometry(robot, k))
            for name, sensor in robot.sensors.items():
                if k % self._every(sensor) == 0:
                    found.extend(self._sense(robot, name, sensor, k))
        found.sort(key=order)
        return found

    def _every(self, sensor: SensorPart) -> int:
        if sensor.rate_hz is None:
            return 1
        return max(1, round(1.0 / (sensor.rate_hz * self._scenario.step_s)))

    def _odometry(self, robot: RobotPart, k: int) -> Output:
        dt = self._scenario.step_s
        delta = np.array([robot.control.speed_mps * dt, 0.0, 0.0, robot.control.yaw_rate_radps * dt])
        noise = control_odometry(robot, dt)
        if LAYOUTS[robot.model] is UNICYCLE_GAINS:
            delta[[0, 1, 3]] = reported(self._tracks[robot.id][k - 1], delta[[0, 1, 3]])
        delta = noise.calibrated(delta)
        t_ns = k * self.step_ns
        cov = noise.covariance(delta, dt)
        return Output(t_ns, Phase.PREDICT, robot.id, "odometry", "odometry", None, delta, cov, t_ns - self.step_ns)

    def _noise(self, robot: str, sensor: str, of: str, k: int, size: int) -> Array:
        key = (robot, sensor, of)
        if key not in self._sensor_noise:
            self._sensor_noise[key] = normal_rows(self._seed, self.steps + 1, size, *key)
        return np.asarray(self._sensor_noise[key][k])

    def _sense(self, robot: RobotPart, name: str, sensor: SensorPart, k: int) -> list[Output]:
        kind, state, t_ns = sensor_kind(name, sensor), self._tracks[robot.id][k], k * self.step_ns
        if kind not in RELATIVE_ANGLES:
            R = absolute_noise(kind, sensor)
            clean = {"position": state[:2], "pose": state, "heading": state[2:]}[kind]
            z = clean + np.sqrt(np.diagonal(R)) * self._noise(robot.id, name, "", k, len(R))
            if kind != "position":
                z[-1] = wrap(z[-1])
            return [Output(t_ns, Phase.PRIVATE, robot.id, name, kind, None, z, R)]
        outputs = []
        for of, position in self._subjects(robot, sensor, kind, k):
            model = RelativeModel(kind, LAYOUTS[robot.model], (sensor.mount[0], sensor.mount[1], sensor.mount[2]))
            joint = np.concatenate([state, position])
            distance = float(RelativeModel("range", LAYOUTS[robot.model], model.mount).h(joint)[0])
            if sensor.max_range_m is not None and distance > sensor.max_range_m:
                continue
            R = relative_noise(kind, sensor, distance)
            z = model.h(joint) + np.sqrt(np.diagonal(R)) * self._noise(robot.id, name, of, k, len(R))
            for index in model.angles:
                z[index] = wrap(z[index])
            if kind in ("range", "range_bearing"):
                z[0] = max(z[0], 0.0)
            outputs.append(Output(t_ns, phase_of(of), robot.id, name, kind, of, z, R))
        return outputs

    def _subjects(self, robot: RobotPart, sensor: SensorPart, kind: str, k: int) -> list[tuple[str, Array]]:
        subjects: list[tuple[str, Array]] = []
        if "peers" in sensor.of:
            for peer in self._scenario.robots:
                shared = kind == "range" and sensor.two_way and _ranges_peers(peer) and peer.id < robot.id
                if peer.id != robot.id and not shared:
                    subjects.append((peer.id, self._tracks[peer.id][k, :2]))
        if "landmarks" in sensor.of:
            subjects += [(f"landmark:{name}", np.array(point)) for name, point in self.landmarks.items()]
        if "targets" in sensor.of:
            subjects += [(f"target:{name}", self._tracks[name][k, :2]) for name in self.targets]
        return subjects


def _ranges_peers(robot: RobotPart) -> bool:
    """Whether a robot takes part in two-way ranging; the lower id of such a pair owns the range."""
    return any(
        sensor_kind(name, sensor) == "range" and sensor.two_way and "peers" in sensor.of
        for name, sensor in robot.sensors.items()
    )


def drawn_belief(truth: Array, cov: Array, seed: int, entity: str, angles: tuple[int, ...]) -> tuple[Array, Array]:
    """Initial belief: truth plus a draw from its covariance; `angles` are wrapped.

    A truth that is shorter than the state leaves gains of an odometry open: they are 1, as far as is known.
    """
    known, n = len(truth), len(cov)
    draw = generator(seed, entity, "start").standard_normal(known)
    mean = np.append(truth + np.sqrt(np.diagonal(cov)[:known]) * draw, np.ones(n - known))
    return wrap_components(mean, angles), cov


def start_pose(robot: RobotPart, phases: dict[str, float]) -> Array:
    """True start of a robot; on a circle it heads along the tangent, counter-clockwise."""
    if robot.start.circle is None:
        assert robot.start.pose is not None
        return np.array(robot.start.pose)
    phase, circle = phases[robot.id], robot.start.circle
    x = circle.center_m[0] + circle.radius_m * np.cos(phase)
    y = circle.center_m[1] + circle.radius_m * np.sin(phase)
    return np.array([x, y, float(wrap(np.array(phase + np.pi / 2.0)))])


def draw_phases(scenario: Scenario, seed: int) -> dict[str, float]:
    """Phases of all robots on circles, redrawn until the contact graph over a lap is connected.

    Raises `ConfigError` when no draw within `max_draws` passes.
    """
    circling = [robot for robot in scenario.robots if robot.start.circle is not None]
    placement = scenario.world.placement
    if not circling or placement is None:
        return {}
    rng = generator(seed, "world", "placement")
    for _ in range(placement.max_draws):
        phases = dict(zip((r.id for r in circling), rng.uniform(-np.pi, np.pi, len(circling)).tolist()))
        if _connected(circling, phases, placement.contact_range_m, placement.reaches):
            return phases
    raise ConfigError(
        f"{scenario.name}: no placement in {placement.max_draws} draws connects all robots with "
        f"'{placement.reaches}'; enlarge world.placement.contact_range_m or move the circles"
    )


def _connected(robots: list[RobotPart], phases: dict[str, float], contact_range_m: float, root: str) -> bool:
    turn = np.linspace(0.0, 2.0 * np.pi, 169)
    paths = {}
    for robot in robots:
        circle = robot.start.circle
        assert circle is not None
        angle = phases[robot.id] + turn
        paths[robot.id] = np.array(circle.center_m) + circle.radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    reached, frontier = [root], [root]
    while frontier:
        here = frontier.pop()
        for other, path in paths.items():
            gap = np.min(np.linalg.norm(paths[here] - path, axis=1))
            if other not in reached and gap <= contact_range_m:
                reached.append(other)
                frontier.append(other)
    return len(reached) == len(paths)
