"""The centralized filter on the data of a world: what the fleet could know if nothing ever had to be sent."""

from __future__ import annotations

import contextlib
import copy
from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.centralized import CentralizedFilter
from agent.estimation.observation import RELATIVE_ANGLES, OutOfViewError
from agent.events import LEVEL, Odometry
from agent.sensor_input import SensorConfig
from agent.settings import CoastSettings, nanoseconds
from agent.timeline import OdometryTrack, Phase
from agent.tracks import unseen_mean
from sim.scenario import Scenario, sensor_config
from sim.world import Output, World, order

Array = NDArray[np.float64]


class BoundRunner:
    """Feeds a `CentralizedFilter` step by step, with readings calibrated and odometry cut as in the agents.

    Sensors with a lag speak of instants that are over: data wait until all of an instant are in, and what is shown is
    the filter of the settled past brought up to date with those that are there.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self._settled = _Joint(scenario, world)
        self._shown = self._settled
        self._sensors = {
            (robot.id, name): sensor_config(sensor)
            for robot in scenario.robots
            for name, sensor in world.sensors(robot.id).items()
        }
        self._lag_ns = max((sensor.lag_ns for sensor in self._sensors.values()), default=0)
        self._waiting: list[Output] = []
        self._step_ns = world.step_ns

    def step(self, k: int, outputs: list[Output]) -> None:
        """Use all data of step `k`."""
        for item in outputs:
            if item.kind == "odometry":
                self._settled.reported(item)
            else:
                sensor = self._sensors[item.robot, item.sensor]
                kind, z, R = sensor.reading(item.kind, item.of, item.z, item.R)
                if sensor.lag_ns or kind != item.kind or z is not item.z or R is not item.R:
                    item = replace(item, t_ns=item.t_ns - sensor.lag_ns, kind=kind, z=z, R=R)
                self._waiting.append(item)
        self._waiting.sort(key=order)
        end = k * self._step_ns
        while self._waiting and self._waiting[0].t_ns <= end - self._lag_ns:
            self._settled.use(self._waiting.pop(0), self._sensors)
        # Steps that are over are moved through once, not again with every copy.
        self._settled.move_to((end - max(self._lag_ns, 0)) // self._step_ns * self._step_ns)
        self._shown = self._settled if self._lag_ns <= 0 else self._settled.copy()
        for item in self._waiting:
            if item.t_ns <= end:
                self._shown.use(item, self._sensors)
        self._shown.move_to(end)

    def belief(self, entity: str) -> tuple[Array, Array] | None:
        """Marginal mean (n,) and covariance (n, n); None of a target without a prior that nobody has seen."""
        return self._shown.filter.belief(entity) if entity in self._shown.filter else None


class _Joint:
    """The joint filter and the instants its parts have been brought to."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        robots, targets, unseen = {}, {}, {}
        for robot in scenario.robots:
            robots[robot.id] = (*world.start_belief(robot.id), robot.motion().settings())
        for target in scenario.targets:
            motion = target.motion(scenario.step_s)
            if target.prior:
                targets[target.id] = (*world.start_belief(target.id), motion)
            else:
                cov = target.start_sigma.covariance(target.model, placed=False)
                unseen[target.id] = (unseen_mean(motion.layout, target.control.altitude_m), cov, motion)
        self.filter = CentralizedFilter(
            robots,
            targets,
            world.landmarks,
            transform=scenario.localization.transform or "unscented",
            innovation_cap=scenario.localization.innovation_cap or 0.0,
            unseen=unseen,
            within_m=scenario.tracking.start_within_m,
        )
        coast = CoastSettings(scenario.coast.speed_mps, scenario.coast.yaw_rate_radps)
        self._tracks = {name: OdometryTrack(coast, 0, Counter()) for name in world.robots}
        self._now = dict.fromkeys(world.robots, 0)
        self._targets_ns = 0
        self._pair_interval_ns = nanoseconds(scenario.centralized.pair_interval_s)
        self._met: dict[tuple[str, ...], int] = {}

    def copy(self) -> _Joint:
        other = copy.copy(self)
        other.filter = self.filter.copy()
        other._tracks = {name: track.copy() for name, track in self._tracks.items()}
        other._now, other._met = dict(self._now), dict(self._met)
        return other

    def reported(self, item: Output) -> None:
        """An odometry increment."""
        assert item.t0_ns is not None
        event = Odometry(item.t_ns, item.t0_ns, item.t_ns, item.z, item.R)
        self._tracks[item.robot].add(event, self._now[item.robot])

    def use(self, item: Output, sensors: dict[tuple[str, str], SensorConfig]) -> None:
        """A measurement, not earlier than the one before."""
        if item.of is not None and item.phase is Phase.PAIR and self._thinned(item, item.of):
            return
        if item.of is None and item.kind in RELATIVE_ANGLES:
            # Of whom it is nobody knows, in one place either.
            return
        self._advance(item.robot, item.t_ns)
        if item.of is None:
            self.filter.fix(item.robot, item.kind, item.z, item.R)
            return
        if item.of.startswith("target:"):
            self._drift(item.t_ns)
        elif not item.of.startswith("landmark:"):
            self._advance(item.of, item.t_ns)
        mount, attitude = sensors[item.robot, item.sensor].mount, item.attitude or LEVEL
        with contextlib.suppress(OutOfViewError):
            self.filter.observe(item.robot, item.kind, item.of, item.z, item.R, mount, attitude)

    def _thinned(self, item: Output, peer: str) -> bool:
        """Whether the pair met a moment ago; all measurements of one instant count as one meeting."""
        pair = tuple(sorted((item.robot, peer)))
        last = self._met.get(pair)
        if last is not None and 0 < item.t_ns - last < self._pair_interval_ns:
            return True
        self._met[pair] = item.t_ns
        return False

    def move_to(self, t_ns: int) -> None:
        for robot in self._now:
            self._advance(robot, t_ns)
        self._drift(t_ns)

    def _advance(self, robot: str, t_ns: int) -> None:
        while self._now[robot] < t_ns:
            end, delta, cov = self._tracks[robot].step(self._now[robot], t_ns)
            self.filter.odometry(robot, delta, cov, (end - self._now[robot]) * 1e-9)
            self._now[robot] = end

    def _drift(self, t_ns: int) -> None:
        if t_ns > self._targets_ns:
            self.filter.drift_targets((t_ns - self._targets_ns) * 1e-9)
            self._targets_ns = t_ns
