"""Whom the sensors of a simulated world may see, and a first look at who is too far off for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import LAYOUTS, StateLayout
from agent.estimation.mounting import mount_of
from agent.estimation.observation import RELATIVE_ANGLES, RelativeModel
from sim.scenario import RobotPart, Scenario, SensorPart, sensor_kind

Array = NDArray[np.float64]

MARGIN_M = 1e-3
"""So much further than a sensor's range nobody is looked at; who is in range is decided exactly."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A subject that a robot's sensor may see.

    of        its name in the sensor's data
    model     what a level robot measures of it
    states    its true states (steps + 1, n); None of a landmark
    index     its number among all places
    reach_m   the furthest it may be from the robot
    """

    of: str
    model: RelativeModel
    states: Array | None
    index: int
    reach_m: float

    def joint(self, observer: Array, k: int) -> Array:
        """What the model takes at instant k: the observer's state (m,), followed by the subject's if it has one."""
        return observer if self.states is None else np.concatenate([observer, self.states[k]])


class View(NamedTuple):
    """What a sensor with a field of view may see: mount on the body, angle, and distances (None: however far)."""

    x_m: float
    y_m: float
    yaw_rad: float
    fov_rad: float
    min_range_m: float
    max_range_m: float | None


def views(scenario: Scenario) -> dict[str, list[View]]:
    """The fields of view of each robot's sensors, of robots that have any; not of those that turn."""
    found: dict[str, list[View]] = {}
    for robot in scenario.robots:
        for sensor in robot.sensors.values():
            if sensor.fov_rad is not None and not sensor.gimbal:
                x, y, _, _, _, yaw = mount_of(sensor.mount)
                view = View(x, y, yaw, sensor.fov_rad, sensor.min_range_m, sensor.max_range_m)
                if view not in found.setdefault(robot.id, []):
                    found[robot.id].append(view)
    return found


def sights(
    scenario: Scenario, tracks: dict[str, Array], landmarks: dict[str, tuple[float, ...]]
) -> dict[tuple[str, str], list[Sight]]:
    """What each sensor may see, by robot and sensor, with the true states by mover.

    The places are those of all movers, in the order of the scenario, then those of the landmarks.
    """
    numbers = {name: index for index, name in enumerate((*scenario.movers(), *(f"landmark:{id}" for id in landmarks)))}
    ranging = {robot.id for robot in scenario.robots if _ranges_peers(robot)}
    found: dict[tuple[str, str], list[Sight]] = {}
    for robot in scenario.robots:
        for name, sensor in robot.sensors.items():
            kind, layout = sensor_kind(name, sensor), LAYOUTS[robot.model]
            seen = found[robot.id, name] = []
            if kind not in RELATIVE_ANGLES:
                continue
            mount, intrinsics, most_m = mount_of(sensor.mount), sensor.intrinsics.settings(), reach_m(sensor)
            if "peers" in sensor.of:
                for peer in scenario.robots:
                    shared = kind == "range" and sensor.two_way and peer.id in ranging and peer.id < robot.id
                    if peer.id != robot.id and not shared:
                        model = RelativeModel(kind, layout, mount, None, LAYOUTS[peer.model], intrinsics=intrinsics)
                        seen.append(Sight(peer.id, model, tracks[peer.id], numbers[peer.id], most_m))
            if "landmarks" in sensor.of:
                for id, place in landmarks.items():
                    model = RelativeModel(kind, layout, mount, place, layout, intrinsics=intrinsics)
                    seen.append(Sight(f"landmark:{id}", model, None, numbers[f"landmark:{id}"], most_m))
            if "targets" in sensor.of:
                for target in scenario.targets:
                    model = RelativeModel(kind, layout, mount, None, LAYOUTS[target.model], intrinsics=intrinsics)
                    seen.append(Sight(f"target:{target.id}", model, tracks[target.id], numbers[target.id], most_m))
    return found


def _ranges_peers(robot: RobotPart) -> bool:
    """Whether a robot takes part in two-way ranging; the lower id of such a pair owns the range."""
    return any(
        sensor_kind(name, sensor) == "range" and sensor.two_way and "peers" in sensor.of
        for name, sensor in robot.sensors.items()
    )


def steps_between(sensor: SensorPart, step_s: float) -> int:
    """Steps from one measurement of a sensor to the next."""
    return 1 if sensor.rate_hz is None else max(1, round(1.0 / (sensor.rate_hz * step_s)))


def reach_m(sensor: SensorPart) -> float:
    """How far a subject of a sensor may be from its robot: the lever arm comes on top of the range."""
    if sensor.max_range_m is None:
        return math.inf
    return sensor.max_range_m + math.hypot(*mount_of(sensor.mount)[:3]) + MARGIN_M


def places(states: Array, layout: StateLayout) -> Array:
    """x, y, z (..., 3) of states (..., n); what is planar lies at z = 0."""
    found = np.zeros((*states.shape[:-1], 3))
    found[..., : len(layout.position)] = states[..., : len(layout.position)]
    return found
