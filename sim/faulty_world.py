"""A world whose sensors and autopilots have faults. Truth is what it was; only what is told of it changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.effects import Steer
from agent.estimation.observation import RELATIVE_ANGLES
from agent.fault_parts import AnySensorFaultPart, BiasPart, DropoutPart, OutliersPart, SensorDelayPart, SilencePart
from agent.settings import nanoseconds
from network.faults import exponential_ns
from sim.noise import generator
from sim.scenario import SensorPart
from sim.world import Output, World

Array = NDArray[np.float64]

ODOMETRY = "odometry"


class FaultyWorld:
    """`world` with the sensor faults that are added; draws are keyed by (seed, fault, robot, sensor, subject, instant).

    `from_autopilot` names, by robot, the sensor whose fixes come from the autopilot, if any.
    """

    def __init__(
        self,
        world: World,
        seed: int,
        from_autopilot: dict[str, str | None],
        drop_silenced: bool = True,
    ) -> None:
        self._world, self.seed = world, seed
        self._faults: list[tuple[str, AnySensorFaultPart, tuple[int, int]]] = []
        self._from_autopilot = from_autopilot
        self._drop_silenced = drop_silenced
        self.robots, self.targets, self.landmarks = world.robots, world.targets, world.landmarks
        self.steps, self.step_ns = world.steps, world.step_ns
        self.closed_loop = world.closed_loop

    def add(self, name: str, fault: AnySensorFaultPart) -> None:
        """One more fault, with its times from the start of the run."""
        self._faults.append((name, fault, fault.span_ns()))

    def end(self, name: str, t_ns: int) -> bool:
        """End a fault; False if there is none of that name that goes on."""
        for index, (known, fault, (begin, end)) in enumerate(self._faults):
            if known == name and end > t_ns:
                self._faults[index] = (known, fault, (min(begin, t_ns), t_ns))
                return True
        return False

    def start_belief(self, entity: str) -> tuple[Array, Array]:
        return self._world.start_belief(entity)

    def sensors(self, robot: str) -> dict[str, SensorPart]:
        return self._world.sensors(robot)

    def truth(self, entity: str, k: int) -> Array:
        return self._world.truth(entity, k)

    def place(self, entity: str, k: int) -> Array:
        return self._world.place(entity, k)

    def steer(self, robot: str, t_ns: int, steer: Steer) -> None:
        self._world.steer(robot, t_ns, steer)

    def outputs(self, k: int) -> list[Output]:
        """What is left of the data, faults applied in the order they are stated."""
        if not self._faults:
            return self._world.outputs(k)
        found: list[Output] = []
        for item in self._world.outputs(k):
            told = self._told(item)
            if told is not None:
                found.append(told)
        return found

    def silenced(self, robot: str, t_ns: int) -> bool:
        """Whether the autopilot of a robot says nothing at an instant."""
        return any(
            isinstance(fault, SilencePart) and fault.robot == robot and begin <= t_ns < end
            for _, fault, (begin, end) in self._faults
        )

    def _told(self, item: Output) -> Output | None:
        for name, fault, (begin, end) in self._faults:
            if fault.robot != item.robot or not begin <= item.t_ns < end:
                continue
            if isinstance(fault, SilencePart):
                if self._drop_silenced and self._of_autopilot(item):
                    return None
                continue
            if item.kind == ODOMETRY or fault.sensor not in (None, item.sensor) or fault.of not in (None, item.of):
                continue
            changed = self._changed(name, fault, item)
            if changed is None:
                return None
            item = changed
        return item

    def _of_autopilot(self, item: Output) -> bool:
        return item.kind == ODOMETRY or (item.of is None and item.sensor == self._from_autopilot.get(item.robot))

    def _changed(
        self, name: str, fault: DropoutPart | OutliersPart | BiasPart | SensorDelayPart, item: Output
    ) -> Output | None:
        if isinstance(fault, BiasPart):
            z = item.z.copy()
            z[0] += fault.bias
            return replace(item, z=_possible(item.kind, z))
        of = item.of or ""
        if item.of is None and item.kind in RELATIVE_ANGLES:
            # Several of one instant have no name: what is measured tells them apart.
            of = item.z.tobytes().hex()
        draw = generator(self.seed, name, item.robot, item.sensor, of, str(item.t_ns))
        if isinstance(fault, SensorDelayPart):
            tail_ns = exponential_ns(nanoseconds(fault.tail_s), draw.random())
            return replace(item, late_ns=item.late_ns + nanoseconds(fault.delay_s) + tail_ns)
        if draw.random() >= fault.share:
            return item
        if isinstance(fault, DropoutPart):
            return None
        off = fault.sigmas * np.sqrt(np.diagonal(item.R)) * draw.uniform(-1.0, 1.0, len(item.z))
        return replace(item, z=_possible(item.kind, item.z + off))


def _possible(kind: str, z: Array) -> Array:
    """No sensor tells a negative distance."""
    if kind in ("range", "range_bearing") and kind in RELATIVE_ANGLES:
        z[0] = max(z[0], 0.0)
    return z
