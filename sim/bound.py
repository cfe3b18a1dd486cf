"""The centralized filter on the data of a world: what the fleet could know if nothing ever had to be sent."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.config_parts import target_motion
from agent.estimation.motion import LAYOUTS, RobotMotion
from agent.events import Odometry
from agent.settings import CoastSettings
from agent.timeline import OdometryTrack
from sim.centralized import CentralizedFilter
from sim.scenario import Scenario
from sim.world import Output, World

Array = NDArray[np.float64]


class BoundRunner:
    """Feeds a `CentralizedFilter` step by step; odometry is cut at measurements as in the agents."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        robots, targets = {}, {}
        for robot in scenario.robots:
            robots[robot.id] = (*world.start_belief(robot.id), RobotMotion(LAYOUTS[robot.model]))
        for target in scenario.targets:
            motion = target_motion(target.model, target.control, target.noise, scenario.step_s, target.damping_s)
            targets[target.id] = (*world.start_belief(target.id), motion)
        self._filter = CentralizedFilter(
            robots,
            targets,
            world.landmarks,
            transform=scenario.localization.transform,
            innovation_cap=scenario.localization.innovation_cap,
        )
        self._mounts = {
            (robot.id, name): (sensor.mount[0], sensor.mount[1], sensor.mount[2])
            for robot in scenario.robots
            for name, sensor in robot.sensors.items()
        }
        coast = CoastSettings(scenario.coast.speed_mps, scenario.coast.yaw_rate_radps)
        self._tracks = {name: OdometryTrack(coast, 0, Counter()) for name in world.robots}
        self._now = dict.fromkeys(world.robots, 0)
        self._targets_ns = 0
        self._step_ns = world.step_ns

    def step(self, k: int, outputs: list[Output]) -> None:
        """Use all data of step `k`."""
        for item in outputs:
            if item.kind == "odometry" and item.t0_ns is not None:
                event = Odometry(item.t_ns, item.t0_ns, item.t_ns, item.z, item.R)
                self._tracks[item.robot].add(event, self._now[item.robot])
        for item in outputs:
            if item.kind == "odometry":
                continue
            self._advance(item.robot, item.t_ns)
            if item.of is None:
                self._filter.fix(item.robot, item.kind, item.z, item.R)
                continue
            if item.of.startswith("target:"):
                self._drift(item.t_ns)
            elif not item.of.startswith("landmark:"):
                self._advance(item.of, item.t_ns)
            mount = self._mounts[item.robot, item.sensor]
            self._filter.observe(item.robot, item.kind, item.of, item.z, item.R, mount)
        for robot in self._now:
            self._advance(robot, k * self._step_ns)
        self._drift(k * self._step_ns)

    def belief(self, entity: str) -> tuple[Array, Array]:
        """Marginal mean (n,) and covariance (n, n)."""
        return self._filter.belief(entity)

    def _advance(self, robot: str, t_ns: int) -> None:
        while self._now[robot] < t_ns:
            end, delta, cov = self._tracks[robot].step(self._now[robot], t_ns)
            self._filter.odometry(robot, delta, cov, (end - self._now[robot]) * 1e-9)
            self._now[robot] = end

    def _drift(self, t_ns: int) -> None:
        if t_ns > self._targets_ns:
            self._filter.drift_targets((t_ns - self._targets_ns) * 1e-9)
            self._targets_ns = t_ns
