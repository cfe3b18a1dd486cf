"""N agents, a world and their links in one process and in virtual time, deterministic.

Events are ordered by (instant, phase, robot, arrival). Deliveries come first within an instant, so that with zero
delay an exchange of messages completes before the next thing happens; timers come last.
"""

from __future__ import annotations

import hashlib
import heapq
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import LAYOUTS
from agent.node import Node, Outgoing, Recorder, rejected
from agent.sensor_input import encode
from agent.settings import NS
from network.links import FateRecord, LinkModel, RangeTable
from network.messages import Epoch, Packet
from network.wire import peek_header
from sim.agents import agent_config
from sim.bound import BoundRunner
from sim.metrics import StateTrace, TrialTrace
from sim.reach import Reach
from sim.scenario import Scenario
from sim.world import Output, World

Array = NDArray[np.float64]
FateSink = Callable[[FateRecord], None]

SOFTWARE = "cofix-0.1.0"
DELIVERY, TIMER = -1, 99


def network_figures(traffic: Counter[str], counters: dict[str, dict[str, int]]) -> dict[str, Any]:
    """Traffic and pair exchange of a trial, summed over the fleet."""
    total: Counter[str] = Counter()
    for own in counters.values():
        total.update(own)
    answered, applied = total["pair.applied_initiator"], total["pair.applied_responder"]
    figures: dict[str, Any] = {name: traffic[name] for name in ("sent", "delivered", "lost", "bytes")}
    figures["pair"] = {
        "started": total["pair.started"],
        "completed": answered,
        "one_sided": max(0, applied - answered),
        "fallback": total["pair.fallback"],
        "too_old": total["pair.too_old"],
    }
    return figures


@dataclass(slots=True)
class TrialResult:
    """Everything a trial leaves behind."""

    trace: TrialTrace
    contacts: list[tuple[float, str, str]]
    network: dict[str, Any]
    rejected: dict[str, int]
    nis: dict[str, dict[str, tuple[float, int]]]
    counters: dict[str, dict[str, int]]
    step_us: list[float] = field(default_factory=list)
    measured: dict[tuple[str, str], Array] = field(default_factory=dict)
    """Instants [s] at which a robot measured somebody, by (robot, of)."""


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


def sample_stride(step_ns: int) -> int:
    """Steps between two samples of the figures: every step, but at most once per second."""
    return max(1, -(-NS // step_ns))


class Sampler:
    """Collects truth and estimates at the sampled instants into a `TrialTrace`."""

    def __init__(self, scenario: Scenario, world: World, with_bound: bool) -> None:
        self._world = world
        self._stride = sample_stride(world.step_ns)
        self._instants = list(range(0, world.steps + 1, self._stride))
        self._layouts = {name: LAYOUTS[part.model] for name, part in scenario.movers().items()}
        self._owned: dict[tuple[str, str], tuple[Array, Array]] = {}
        for robot in world.robots:
            for entity in (robot, *world.targets):
                self._owned[robot, entity] = self._blank(entity)
        self._bound = {name: self._blank(name) for name in (*world.robots, *world.targets)} if with_bound else None

    def _blank(self, entity: str) -> tuple[Array, Array]:
        n, count = self._layouts[entity].dim, len(self._instants)
        return np.full((count, n), np.nan), np.full((count, n, n), np.nan)

    def row(self, k: int) -> int | None:
        """Index of instant k among the samples, None if it is not sampled."""
        return k // self._stride if k % self._stride == 0 else None

    def put(self, robot: str, entity: str, row: int, mean: Array, cov: Array) -> None:
        means, covs = self._owned[robot, entity]
        means[row], covs[row] = mean, cov

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
        )


class VirtualEngine:
    """One trial in virtual time."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        seed: int,
        *,
        with_bound: bool = False,
        recorders: dict[str, Recorder] | None = None,
        fate_sink: FateSink | None = None,
    ) -> None:
        self._scenario, self._world = scenario, world
        self._heap: list[tuple[int, int, str, int, str, Any]] = []
        self._pushed = 0
        self._now = 0
        self._nodes: dict[str, Node] = {}
        self._timers: dict[str, int] = {}
        self._ticked: dict[str, int] = {}
        for robot in scenario.robots:
            config = agent_config(scenario, world, robot)
            boot = hashlib.blake2b(f"{seed}/{robot.id}".encode(), digest_size=7).digest()
            self._nodes[robot.id] = Node(
                config.settings(0),
                config.network.settings(config.lateness.horizon_s),
                boot_id=int.from_bytes(boot, "little"),
                incarnation=1,
                software=SOFTWARE,
                sensors=config.sensor_configs(),
                recorder=(recorders or {}).get(robot.id),
            )
        self._range = RangeTable()
        links = scenario.links
        self._reach = None if links.range_m is None else Reach(world, links.range_m, links.hysteresis_m)
        self._links = LinkModel(scenario.links.settings(seed), self._range.state, fate_sink)
        self._sampler = Sampler(scenario, world, with_bound)
        self._bound = BoundRunner(scenario, world) if with_bound else None
        self.contacts: list[tuple[float, str, str]] = []
        self._measured = MeasurementLog()
        self._applied: dict[str, int] = {}
        self._bases: dict[tuple[str, str], Epoch] = {}
        self._traffic: Counter[str] = Counter()
        self.step_us: list[float] = []

    def run(self, progress: Callable[[int, int], None] | None = None) -> TrialResult:
        """Play the whole scenario."""
        self._publish_range(0)
        for robot in self._nodes:
            self._arm(robot)
        self._sample(0)
        for k in range(1, self._world.steps + 1):
            started = time.perf_counter()
            outputs = self._world.outputs(k)
            self._measured.add(outputs)
            for item in outputs:
                self._push(item.t_ns, int(item.phase), item.robot, item)
            self._play(k)
            self.step_us.append((time.perf_counter() - started) * 1e6 / len(self._nodes))
            if self._bound is not None:
                self._bound.step(k, outputs)
            self._sample(k)
            if progress is not None:
                progress(k, self._world.steps)
        return self._result()

    def _play(self, k: int) -> None:
        """Everything up to and including instant k. Who hears whom follows the positions at each instant."""
        end = k * self._world.step_ns
        while self._heap and self._heap[0][0] <= end:
            t_ns, _, _, _, robot, what = heapq.heappop(self._heap)
            if t_ns == end and self._now < end:
                self._publish_range(k)
            self._now = t_ns
            node = self._nodes[robot]
            if isinstance(what, Output):
                payload = encode(
                    t_ns,
                    what.kind,
                    what.z,
                    what.R,
                    of=what.of,
                    sensor=what.sensor,
                    t0_ns=what.t0_ns,
                    attitude=what.attitude,
                )
                self._carry_out(robot, node.on_sensor(t_ns, payload))
            elif isinstance(what, Packet):
                self._carry_out(robot, node.on_packet(t_ns, what))
            elif self._timers.get(robot) == t_ns:
                del self._timers[robot]
                self._ticked[robot] = t_ns
                self._carry_out(robot, node.on_tick(t_ns))
            self._note_contacts(robot, node)
        if self._now < end:
            self._publish_range(k)
            self._now = end

    def _note_contacts(self, robot: str, node: Node) -> None:
        """Pairs whose base contact is a new one since the last look."""
        counters = node.agent.counters
        applied = counters["pair.applied_initiator"] + counters["pair.applied_responder"]
        if applied == self._applied.get(robot, 0):
            return
        self._applied[robot] = applied
        for peer, epoch in sorted(node.agent.filter.contacts().items()):
            if epoch != self._bases.get((robot, peer)):
                self._bases[robot, peer] = epoch
                self.contacts.append((self._now / NS, robot, peer))

    def _carry_out(self, robot: str, out: Outgoing) -> None:
        for packet in out.packets:
            self._transmit(packet)
        self._arm(robot)

    def _transmit(self, packet: Packet) -> None:
        header = peek_header(packet.payload)
        assert header is not None
        self._traffic["sent"] += 1
        self._traffic["bytes"] += len(packet.payload)
        receivers = [packet.destination] if packet.destination is not None else list(self._nodes)
        for receiver in receivers:
            if receiver is None or receiver == packet.source or receiver not in self._nodes:
                continue
            arrivals = self._links.carry(packet, header, receiver, self._now)
            self._traffic["delivered" if arrivals else "lost"] += 1
            for delay, arriving in arrivals:
                self._push(self._now + delay, DELIVERY, receiver, arriving)

    def _push(self, t_ns: int, phase: int, robot: str, what: Any) -> None:
        self._pushed += 1
        rank = "" if phase == DELIVERY else robot
        heapq.heappush(self._heap, (t_ns, phase, rank, self._pushed, robot, what))

    def _arm(self, robot: str) -> None:
        # A timer may end the present instant, but each instant ends once.
        earliest = self._now + 1 if self._ticked.get(robot) == self._now else self._now
        deadline = max(self._nodes[robot].next_deadline_ns(), earliest)
        if self._timers.get(robot) == deadline:
            return
        self._timers[robot] = deadline
        self._push(deadline, TIMER, robot, None)

    def _publish_range(self, k: int) -> None:
        if self._reach is not None:
            self._range.publish(k * self._world.step_ns, self._reach.at(k))

    def _sample(self, k: int) -> None:
        row = self._sampler.row(k)
        if row is None:
            return
        for robot, node in self._nodes.items():
            estimate = node.agent.estimate()
            if estimate is None:
                continue
            self._sampler.put(robot, robot, row, estimate.mean, estimate.cov)
            for track in estimate.tracks:
                self._sampler.put(robot, track.target, row, track.mean, track.cov)
        if self._bound is not None:
            for entity in (*self._world.robots, *self._world.targets):
                self._sampler.put_bound(entity, row, self._bound.belief(entity))

    def _result(self) -> TrialResult:
        refused: Counter[str] = Counter()
        for node in self._nodes.values():
            refused.update(rejected(node))
        counters = {name: dict(sorted(node.agent.counters.items())) for name, node in self._nodes.items()}
        nis = {
            name: {kind: (entry.total, entry.count) for kind, entry in sorted(node.agent.nis.items())}
            for name, node in self._nodes.items()
        }
        network = network_figures(self._traffic, counters)
        return TrialResult(
            self._sampler.trace(),
            self.contacts,
            network,
            dict(sorted(refused.items())),
            nis,
            counters,
            self.step_us,
            self._measured.instants(),
        )
