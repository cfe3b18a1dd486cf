"""What a fleet that triangulates could know if every bearing were in one place at once: the bound of `tracking.kind`.

The published kinds are compared with the centralized pseudo-linear filter they were published beside, ours with one
that knows how noise grows with the distance. Robots' own poses are those they trust (`fixed`), or else those of the
centralized filter, each as unsure as it says.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.bearing_filters import build
from agent.estimation.direction import directed
from agent.estimation.motion import LAYOUTS, StateLayout
from agent.estimation.observation import RelativeModel, absolute_model
from agent.estimation.sights import Sight
from agent.estimation.triangulation import BearingFilter, TrackState
from agent.events import LEVEL, Odometry
from agent.fixed_filter import FixedFilter
from agent.settings import AgentSettings, CoastSettings, LocalizationSettings, nanoseconds
from agent.timeline import OdometryTrack
from agent.triangulator import PRECISE, density
from sim.bound import BoundRunner
from sim.scenario import Scenario
from sim.world import Output, World

Array = NDArray[np.float64]


class BearingBound(BoundRunner):
    """A `BoundRunner` whose targets are triangulated. Data that come late are used as they come."""

    def __init__(self, scenario: Scenario, world: World) -> None:
        alone = scenario.model_copy(update={"targets": []})
        super().__init__(alone, world)
        self._trusting = {
            robot.id: _Trusting(scenario, world, robot.id)
            for robot in scenario.robots
            if scenario.localization_of(robot).kind == "fixed"
        }
        kind = scenario.tracking.kind
        self._models = {robot.id: LAYOUTS[robot.model] for robot in scenario.robots}
        self._period_ns = nanoseconds(scenario.round.period_s)
        self._targets = {}
        for target in scenario.targets:
            options = {"q": density(target.motion(scenario.step_s))} if kind in PRECISE else {}
            self._targets[target.id] = _Target(
                build("central_plus" if kind in PRECISE else "ckf", options), LAYOUTS[target.model]
            )

    def step(self, k: int, outputs: list[Output]) -> None:
        """Use all data of step `k`."""
        if len(self._trusting) < len(self._models):
            super().step(k, [item for item in outputs if item.of is None or not item.of.startswith("target:")])
        for trusting in self._trusting.values():
            trusting.step(k * self._step_ns, outputs)
        for item in outputs:
            if item.of is not None and item.of.startswith("target:"):
                self._saw(item)
        for target in self._targets.values():
            target.close(k * self._step_ns, self._period_ns, self._middle())

    def _saw(self, item: Output) -> None:
        assert item.of is not None
        target, sensor = self._targets[item.of.removeprefix("target:")], self._sensors[item.robot, item.sensor]
        kind, z, R = sensor.reading(item.kind, item.of, item.z, item.R)
        observer = self._models[item.robot]
        model = RelativeModel(kind, observer, sensor.mount, None, target.layout, item.attitude or LEVEL)
        own = self.belief(item.robot)
        found = None if own is None else directed(model, *own, z, R)
        if found is not None:
            sight = Sight(found.place, found.direction, found.sigma_rad, found.place_cov)
            target.sights.append((item.t_ns - sensor.lag_ns, sight))

    def _middle(self) -> Array:
        """Mean (3,) of the robots' places."""
        places = np.zeros((len(self._models), 3))
        for row, (robot, layout) in enumerate(self._models.items()):
            own = self.belief(robot)
            if own is not None:
                places[row, : len(layout.position)] = own[0][list(layout.position)]
        return np.asarray(places.mean(axis=0))

    def belief(self, entity: str) -> tuple[Array, Array] | None:
        """Marginal mean (n,) and covariance (n, n); None of a target that nobody has seen."""
        if entity in self._targets:
            return self._targets[entity].belief()
        if entity in self._trusting:
            return self._trusting[entity].belief()
        return super().belief(entity)


def bound_of(scenario: Scenario, world: World) -> BoundRunner:
    """The centralized filter that goes with a scenario's kind of tracking."""
    triangulated = scenario.tracking.kind not in ("clat", "none")
    return BearingBound(scenario, world) if triangulated else BoundRunner(scenario, world)


class _Trusting:
    """The pose that a robot of kind `fixed` trusts."""

    def __init__(self, scenario: Scenario, world: World, robot: str) -> None:
        part = next(item for item in scenario.robots if item.id == robot)
        mean, cov = world.start_belief(robot)
        settings = AgentSettings(
            robot,
            0,
            mean,
            cov,
            motion=part.motion().settings(),
            localization=LocalizationSettings(kind="fixed"),
            lateness=scenario.lateness_of(part).settings(),
        )
        self._robot, self._layout = robot, settings.layout
        self._filter = FixedFilter(settings, Counter())
        coast = CoastSettings(scenario.coast.speed_mps, scenario.coast.yaw_rate_radps)
        self._odometry = OdometryTrack(coast, 0, Counter())

    def step(self, t_ns: int, outputs: list[Output]) -> None:
        own = [item for item in outputs if item.robot == self._robot and item.of is None]
        for item in own:
            if item.t0_ns is not None:
                event = Odometry(item.t_ns, item.t0_ns, item.t_ns, item.z, item.R)
                self._odometry.add(event, self._filter.t_ns)
        while self._filter.t_ns < t_ns:
            self._filter.advance(*self._odometry.step(self._filter.t_ns, t_ns))
        for item in own:
            found = None if item.t0_ns is not None else absolute_model(item.kind, self._layout, item.z, item.R)
            if found is not None:
                self._filter.absolute(item.t_ns, item.kind, *found)

    def belief(self) -> tuple[Array, Array]:
        estimate = self._filter.estimate()
        return estimate.mean, estimate.cov


@dataclass(slots=True, eq=False)
class _Target:
    """The filter of one target; `sights` since its last step, each with its instant."""

    kind: BearingFilter
    layout: StateLayout
    sights: list[tuple[int, Sight]] = field(default_factory=list)
    state: TrackState | None = None
    t_ns: int = 0

    def close(self, t_ns: int, period_ns: int, middle: Array) -> None:
        """Make the step of the round at `t_ns`, if there is one."""
        if t_ns % period_ns or (self.state is None and not self.sights):
            return
        if self.state is None:
            self.state, self.t_ns = self.kind.start(middle), t_ns - period_ns
        aged = [replace(sight, age_s=max(t_ns - then, 0) * 1e-9) for then, sight in self.sights]
        self.state = self.kind.step(self.state, (t_ns - self.t_ns) * 1e-9, aged, [])
        self.t_ns, self.sights = t_ns, []

    def belief(self) -> tuple[Array, Array] | None:
        return None if self.state is None else self.kind.belief(self.state)
