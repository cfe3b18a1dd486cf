"""What a run leaves for its figures: truth and estimates at sampled instants, and when who was measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.effects import RelativeEstimate
from agent.estimation.gate_test import GateTest
from agent.estimation.motion import LAYOUTS
from agent.settings import NS, nanoseconds
from sim.metrics import StateTrace, TrialTrace
from sim.relative_figures import Pair, RelativeTrace, ShownGate, blank, fill, relative_state
from sim.scenario import Scenario
from sim.world import Output, World

Array = NDArray[np.float64]


class MeasurementLog:
    """When a world offered a relative measurement, by robot and whom it measured."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str], list[int]] = {}

    def add(self, outputs: list[Output]) -> None:
        for item in outputs:
            if item.of is not None:
                times = self._found.setdefault((item.robot, item.of), [])
                if not times or times[-1] != item.t_ns:
                    times.append(item.t_ns)

    def instants(self) -> dict[tuple[str, str], Array]:
        """Ascending times [s] by (robot, of); sensors that measure together count once."""
        return {key: np.unique(times) / NS for key, times in sorted(self._found.items())}


def sample_stride(step_ns: int, sample_ns: int = NS) -> int:
    """Steps between two samples of the figures: every step, but at most once per `sample_ns`."""
    return max(1, -(-sample_ns // step_ns))


class Sampler:
    """Collects truth and estimates at the sampled instants into a `TrialTrace`."""

    def __init__(self, scenario: Scenario, world: World, with_bound: bool) -> None:
        self._world = world
        self._stride = sample_stride(world.step_ns, nanoseconds(scenario.sample_s))
        self._instants = list(range(0, world.steps + 1, self._stride))
        self._layouts = {name: LAYOUTS[part.model] for name, part in scenario.movers().items()}
        self._owned: dict[tuple[str, str], tuple[Array, Array]] = {}
        for robot in world.robots:
            for entity in (robot, *world.targets):
                self._owned[robot, entity] = self._blank(entity)
        self._relatives: dict[Pair, RelativeTrace] = {}
        self.gate: ShownGate | None = None
        self._bound = {name: self._blank(name) for name in (*world.robots, *world.targets)} if with_bound else None

    def _blank(self, entity: str) -> tuple[Array, Array]:
        n, count = self._layouts[entity].dim, len(self._instants)
        return np.full((count, n), np.nan), np.full((count, n, n), np.nan)

    @property
    def stride_ns(self) -> int:
        """Time between two samples."""
        return self._stride * self._world.step_ns

    def row(self, k: int) -> int | None:
        """Index of instant k among the samples, None if it is not sampled."""
        return k // self._stride if k % self._stride == 0 else None

    def put(self, robot: str, entity: str, row: int, mean: Array, cov: Array) -> None:
        means, covs = self._owned[robot, entity]
        means[row], covs[row] = mean, cov

    def put_relatives(self, robot: str, row: int, relatives: tuple[RelativeEstimate, ...]) -> None:
        """Where a robot takes others to be; their instants are since the start."""
        for found in relatives:
            if (robot, found.peer) not in self._relatives:
                self._relatives[robot, found.peer] = blank(len(self._instants))
            trace = self._relatives[robot, found.peer]
            k = round(found.t_ns / self._world.step_ns)
            fill(trace, row, found, (self._instants[row] * self._world.step_ns - found.t_ns) / NS)
            if 0 <= k <= self._world.steps:
                trace.truth[row] = relative_state(self._world.truth(robot, k), self._world.truth(found.peer, k))

    def put_gates(self, robot: str, t_ns: int, tests: dict[str, GateTest]) -> None:
        """How a robot has judged bearings at an instant since the start: kept is the test whose gates are wider
        than linearized ones by most, or the first with several hypotheses."""
        for peer, test in tests.items():
            kept = None if self.gate is None else self.gate.test
            if kept is None or len(kept.weight) == 1 < len(test.weight) or test.wider > 1.05 * kept.wider:
                k = min(max(round(t_ns / self._world.step_ns), 0), self._world.steps)
                truth = relative_state(self._world.truth(robot, k), self._world.truth(peer, k))
                self.gate = ShownGate(t_ns / NS, robot, peer, truth, test)

    def put_bound(self, entity: str, row: int, belief: tuple[Array, Array] | None) -> None:
        """None: there is no belief (yet)."""
        assert self._bound is not None
        if belief is not None:
            self._bound[entity][0][row], self._bound[entity][1][row] = belief

    def trace(self) -> TrialTrace:
        truths = {
            name: np.array([self._world.truth(name, k) for k in self._instants])
            for name in (*self._world.robots, *self._world.targets)
        }

        def state(entity: str, belief: tuple[Array, Array]) -> StateTrace:
            layout, known = self._layouts[entity], truths[entity].shape[1]
            # What nobody knows the truth of (gains of a recorded odometry) has no figures.
            mean, cov = belief[0][:, :known], belief[1][:, :known, :known]
            return StateTrace(truths[entity], mean, cov, layout.angles, layout.position)

        bound = None
        if self._bound is not None:
            bound = {
                "robots": {name: state(name, self._bound[name]) for name in self._world.robots},
                "targets": {name: state(name, self._bound[name]) for name in self._world.targets},
            }
        return TrialTrace(
            t_s=np.array(self._instants) * self._world.step_ns / NS,
            robots={name: state(name, self._owned[name, name]) for name in self._world.robots},
            targets={
                target: {name: state(target, self._owned[name, target]) for name in self._world.robots}
                for target in self._world.targets
            },
            bound=bound,
            relatives=dict(sorted(self._relatives.items())),
        )
