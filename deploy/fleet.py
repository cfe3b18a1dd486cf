"""A fleet for tests: what can be done to it and asked of it in every runtime, and the one in virtual time."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError
from agent.fault_parts import AnyFaultPart, made
from sim.engine import VirtualEngine
from sim.invariants import InvariantChecker
from sim.metrics import StateTrace, TrialTrace, nees
from sim.scenario import Scenario
from sim.scenario_checks import check_schedule
from sim.trial import open_world

Array = NDArray[np.float64]

LIMIT = 1.7
"""Mean NEES per degree of freedom that no robot exceeds, whatever happens to the fleet."""


class Link:
    """The link between two robots, both ways; setting a value changes it from now on."""

    def __init__(self, fleet: Fleet, a: str, b: str) -> None:
        self._fleet, self._ends = fleet, (a, b)

    @property
    def loss(self) -> float:
        """Probability that a packet is lost."""
        return self._get("loss")

    @loss.setter
    def loss(self, share: float) -> None:
        self._set("loss", "share", share)

    @property
    def duplicate(self) -> float:
        """Probability that a packet arrives twice."""
        return self._get("duplicate")

    @duplicate.setter
    def duplicate(self, share: float) -> None:
        self._set("duplicate", "share", share)

    @property
    def delay_s(self) -> float:
        """How late packets are."""
        return self._get("delay")

    @delay_s.setter
    def delay_s(self, delay_s: float) -> None:
        self._set("delay", "delay_s", delay_s)

    def _get(self, kind: str) -> float:
        return self._fleet.links.get((*self._ends, kind), ("", 0.0))[1]

    def _set(self, kind: str, key: str, value: float) -> None:
        links, here, (a, b) = self._fleet.links, (*self._ends, kind), self._ends
        before = links.pop(here, None)
        # A value that is refused changes nothing.
        try:
            if value:
                found = self._fleet.inject(kind, sources=[a], destinations=[b], **{key: float(value)})
                links[here] = (found, value)
        except ConfigError:
            if before is not None:
                links[here] = before
            raise
        if before is not None:
            self._fleet.end(before[0])


class Fleet(ABC):
    """A fleet that is being played; times are those of the scenario, in seconds since its start."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.scenario, self.seed = scenario, seed
        self.robots = tuple(robot.id for robot in scenario.robots)
        self.links: dict[tuple[str, str, str], tuple[str, float]] = {}
        self._injected = 0
        self._cuts: list[str] = []

    # -- what a runtime does --------------------------------------------------------------------------------

    @property
    @abstractmethod
    def t_s(self) -> float:
        """Time played, in seconds of the scenario."""

    @abstractmethod
    def run_until(self, t_s: float) -> None:
        """Play on until this instant, or the end of the scenario."""

    def run_for(self, seconds: float) -> None:
        """Play on for so long."""
        self.run_until(self.t_s + seconds)

    @abstractmethod
    def traces(self) -> tuple[Array, dict[str, StateTrace]]:
        """Instants [s] played so far, and truth and estimate of every robot at them."""

    @abstractmethod
    def status(self, robot: str) -> dict[str, Any]:
        """What a robot says of itself, its instants from the start of the run; empty while it is down."""

    @abstractmethod
    def _inject(self, name: str, fault: AnyFaultPart) -> None: ...

    @abstractmethod
    def end(self, name: str) -> bool:
        """End a fault of links or sensors; False if there is none of that name that goes on."""

    # -- faults ---------------------------------------------------------------------------------------------

    def inject(self, kind: str, *, for_s: float | None = None, **keys: Any) -> str:
        """A fault from now on, by the keys of `[[faults]]`; returns its name. Raises `ConfigError`."""
        lasting = {} if for_s is None else {"for_s": float(for_s)}
        fault = made(kind=kind, at_s=self.t_s, **lasting, **keys)
        check_schedule(self.scenario, [fault])
        self._injected += 1
        name = f"test-{self._injected}-{kind}"
        self._inject(name, fault)
        return name

    def partition(self, *groups: list[str], for_s: float | None = None) -> str:
        """No packet between robots of different groups until `heal`, or for so long."""
        self._cuts.append(self.inject("partition", groups=list(groups), for_s=for_s))
        return self._cuts[-1]

    def isolate(self, robot: str, for_s: float | None = None) -> str:
        """No packet to or from a robot until `heal`, or for so long."""
        self._cuts.append(self.inject("isolate", robot=robot, for_s=for_s))
        return self._cuts[-1]

    def heal(self) -> None:
        """End all partitions and isolations."""
        for name in self._cuts:
            self.end(name)
        self._cuts.clear()

    def link(self, a: str, b: str) -> Link:
        """The link between two robots. Raises `KeyError` for a robot that is not there."""
        for name in (a, b):
            if name not in self.robots:
                raise KeyError(f"no robot '{name}'; there are: {', '.join(self.robots)}")
        return Link(self, *sorted((a, b)))

    def kill(self, robot: str, for_s: float | None = None, state: str = "kept") -> str:
        """Kill a robot's agent; it starts again after `for_s`, with its state file "kept" or "lost"."""
        return self.inject("crash", robot=robot, for_s=for_s, state=state)

    def restart(self, robot: str) -> str:
        """Stop a robot's agent in good order and start it again."""
        return self.inject("restart", robot=robot)

    def pause(self, robot: str, for_s: float) -> str:
        """Let a robot's agent stand still for so long."""
        return self.inject("pause", robot=robot, for_s=for_s)

    # -- what became of it ----------------------------------------------------------------------------------

    def error_m(self, robot: str) -> float:
        """Distance [m] between a robot's newest estimate and the truth; NaN while it has none."""
        _, found = self.traces()
        trace = found[robot]
        axes = list(trace.position)
        return float(np.linalg.norm(trace.mean[-1, axes] - trace.truth[-1, axes]))

    def anees(self, robot: str, since_s: float = 0.0, until_s: float = np.inf) -> float:
        """Mean NEES per degree of freedom of a robot over a span; NaN if it had no estimate."""
        return mean_nees(self.traces(), robot, since_s, until_s)

    def assert_consistent(self, limit: float = LIMIT, since_s: float = 0.0) -> None:
        """No robot claims to know more than it does: its mean NEES per degree of freedom is at most `limit`.

        Nothing is known of a robot that had no estimate all the time, which fails too.
        """
        traces = self.traces()
        for robot in self.robots:
            anees = mean_nees(traces, robot, since_s)
            assert np.isfinite(anees), f"{robot} had no estimate between {since_s:g} and {self.t_s:g} s"
            assert anees <= limit, (
                f"{robot} is overconfident: ANEES {anees:.2f} is above {limit:g} after {self.t_s:g} s; replay it with "
                f"seed {self.seed} of scenario '{self.scenario.name}'"
            )


def mean_nees(
    traces: tuple[Array, dict[str, StateTrace]], robot: str, since_s: float = 0.0, until_s: float = np.inf
) -> float:
    """Mean NEES per degree of freedom of a robot over a span; NaN if it had no estimate."""
    t_s, found = traces
    during = (t_s >= since_s) & (t_s <= until_s)
    ratio = nees(found[robot])[during]
    ratio = ratio[np.isfinite(ratio)]
    return float(ratio.mean()) if len(ratio) else float("nan")


def until(trace: TrialTrace, t_s: float) -> tuple[Array, dict[str, StateTrace]]:
    """The instants of a trace up to `t_s`, and the robots at them."""
    known = int(np.searchsorted(trace.t_s, t_s, side="right"))
    cut = {
        name: StateTrace(state.truth[:known], state.mean[:known], state.cov[:known], state.angles, state.position)
        for name, state in trace.robots.items()
    }
    return trace.t_s[:known], cut


class VirtualFleet(Fleet):
    """In virtual time: deterministic, and faster than real time."""

    def __init__(self, scenario: Scenario, seed: int, check: bool = False) -> None:
        super().__init__(scenario, seed)
        checker = InvariantChecker(seed) if check else None
        self._engine = VirtualEngine(scenario, open_world(scenario, seed), seed, checker=checker)

    @property
    def t_s(self) -> float:
        return self._engine.t_s

    def run_until(self, t_s: float) -> None:
        while self.t_s < t_s - 0.5 * self.scenario.step_s and self._engine.step():
            pass

    def traces(self) -> tuple[Array, dict[str, StateTrace]]:
        return until(self._engine.result().trace, self.t_s)

    def status(self, robot: str) -> dict[str, Any]:
        node = self._engine.nodes.get(robot)
        return {} if node is None else node.status()

    def _inject(self, name: str, fault: AnyFaultPart) -> None:
        self._engine.inject(name, fault)

    def end(self, name: str) -> bool:
        return self._engine.end_fault(name)
