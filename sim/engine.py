"""N agents, a world and their links in one process and in virtual time, deterministic.

Events are ordered by (instant, phase, robot, arrival). Deliveries come first within an instant, so that with zero
delay an exchange of messages completes before the next thing happens; timers come last.
"""

from __future__ import annotations

import heapq
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.effects import RelativeEstimate
from agent.fault_parts import AnyFaultPart
from agent.node import Node, Outgoing, Recorder
from agent.relative_filter import RelativeFilter
from agent.sensor_input import encode
from agent.settings import NS
from network.links import FateRecord, LinkModel, RangeTable
from network.messages import Epoch, Packet
from network.wire import peek_header
from sim.agents import agent_config, autopilot_fix
from sim.bearing_bound import bound_of
from sim.engine_faults import ClockChange, EngineFaults, Forged, Happening, Intruder, Pause, Resume, Start, Stop
from sim.fault_plan import trial_faults
from sim.faulty_world import FaultyWorld
from sim.invariants import InvariantChecker
from sim.label_figures import LabelLog
from sim.lives import LifeSink, Process
from sim.metrics import TrialTrace
from sim.motion_figures import trial_motion
from sim.reach import Reach
from sim.relative_figures import ShownGate
from sim.sampling import MeasurementLog, Sampler
from sim.scenario import Scenario
from sim.world import Output, World

Array = NDArray[np.float64]
FateSink = Callable[[FateRecord], None]

FAULT, DELIVERY, TIMER = -2, -1, 99


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
    motion: dict[str, float | None]
    step_us: list[float] = field(default_factory=list)
    plan_us: list[float] = field(default_factory=list)
    """Time of each event that ended in a command to a vehicle."""
    measured: dict[tuple[str, str], Array] = field(default_factory=dict)
    """Instants [s] at which a robot measured somebody, by (robot, of)."""
    gate: ShownGate | None = None


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
        checker: InvariantChecker | None = None,
        life_sink: LifeSink | None = None,
    ) -> None:
        self._checker = checker
        world = FaultyWorld(world, seed, {robot.id: autopilot_fix(robot) for robot in scenario.robots})
        self._scenario, self._world = scenario, world
        self._faults = EngineFaults(world, seed)
        self._heap: list[tuple[int, int, str, int, str, Any]] = []
        self._pushed = 0
        self._now = self._k = 0
        self._timers: dict[str, int] = {}
        self._ticked: dict[str, int] = {}
        self._processes = {
            robot.id: Process(
                robot.id,
                agent_config(scenario, world, robot),
                seed,
                (recorders or {}).get(robot.id),
                self._faults.clock(robot.id),
                life_sink,
            )
            for robot in scenario.robots
        }
        self._range = RangeTable()
        links = scenario.links.settings(seed)
        self._reach = Reach(world, links) if links.limited else None
        self._links = LinkModel(links, self._range.state, fate_sink, self._faults.links)
        self._sampler = Sampler(scenario, world, with_bound)
        self._bound = bound_of(scenario, world) if with_bound else None
        self.contacts: list[tuple[float, str, str]] = []
        self._measured = MeasurementLog()
        self._labels = LabelLog()
        self._applied: dict[str, int] = {}
        self._bases: dict[tuple[str, str], Epoch] = {}
        self._traffic: Counter[str] = Counter()
        self.step_us: list[float] = []
        self.plan_us: list[float] = []
        for name, fault in trial_faults(scenario, seed).items():
            self.inject(name, fault)

    @property
    def nodes(self) -> dict[str, Node]:
        """The robots that are up, by id."""
        return {name: process.node for name, process in self._processes.items() if process.node is not None}

    def run(self, progress: Callable[[int, int], None] | None = None) -> TrialResult:
        """Play the whole scenario, or what is left of it."""
        while self.step():
            if progress is not None:
                progress(self._k, self._world.steps)
        return self.result()

    @property
    def t_s(self) -> float:
        """Time played."""
        return self._k * self._world.step_ns / NS

    def step(self) -> bool:
        """Play one step of the world; False if there is none left."""
        if self._k == 0:
            self._begin()
        if self._k >= self._world.steps:
            return False
        self._k += 1
        started = time.perf_counter()
        if self._world.closed_loop:
            # What is told to vehicles before an instant decides where they are then.
            self._pass(self._k * self._world.step_ns - 1)
        outputs = self._world.outputs(self._k)
        self._measured.add(outputs)
        self._labels.add(outputs)
        for item in outputs:
            self._push(item.t_ns + item.late_ns, int(item.phase), item.robot, item)
        self._play(self._k)
        self.step_us.append((time.perf_counter() - started) * 1e6 / len(self._processes))
        if self._bound is not None:
            self._bound.step(self._k, outputs)
        self._sample(self._k)
        return True

    def _begin(self) -> None:
        self._publish_range(0)
        for robot in self._processes:
            self._arm(robot)
        self._sample(0)

    def inject(self, name: str, fault: AnyFaultPart) -> None:
        """One more fault, its times from the start of the run. Raises `ValueError` if the name is in use."""
        self._faults.add(name, fault)
        for t_ns, robot, what in self._faults.happenings(name, self._processes):
            self._push(max(t_ns, self._now), FAULT, robot, what)

    def intrude(self, robot: str, intruder: Intruder) -> None:
        """Have somebody on the air beside a robot, who hears what is sent to it and sends it packets."""
        for t_ns, receiver, what in self._faults.intruded(robot, intruder):
            self._push(max(t_ns, self._now), FAULT, receiver, what)

    def end_fault(self, name: str) -> bool:
        """End a fault of links or sensors now; False if there is none of that name that goes on."""
        return self._faults.end(name, self._now)

    def _play(self, k: int) -> None:
        """Everything up to and including instant k. Who hears whom follows the positions at each instant."""
        end = k * self._world.step_ns
        self._pass(end - 1)
        self._publish_range(k)
        self._now = end
        self._pass(end)

    def _pass(self, end: int) -> None:
        """Everything that happens until `end`, and then."""
        while self._heap and self._heap[0][0] <= end:
            t_ns, phase, _, _, robot, what = heapq.heappop(self._heap)
            self._now = t_ns
            process = self._processes[robot]
            if phase == FAULT:
                self._happen(process, what)
            elif isinstance(what, Output):
                self._sensed(process, what)
            elif isinstance(what, Packet):
                self._arrived(process, what)
            elif self._timers.get(robot) == t_ns:
                del self._timers[robot]
                self._ticked[robot] = t_ns
                if process.node is not None and process.runs:
                    self._handled(process, "a timer", process.node.on_tick, process.clock.local_ns(t_ns))
            self._note_contacts(process)

    def _sensed(self, process: Process, item: Output) -> None:
        """A datum reaches its robot, stamped by the robot's clock."""
        if process.node is None or not process.runs:
            process.keep_datum(item)
            return
        local_ns = process.clock.local_ns
        payload = encode(
            local_ns(item.t_ns),
            item.kind,
            item.z,
            item.R,
            of=item.of,
            sensor=item.sensor,
            t0_ns=None if item.t0_ns is None else local_ns(item.t0_ns),
            attitude=item.attitude,
        )
        what = f"{item.kind} of {item.of or 'itself'} by {item.sensor}"
        self._handled(process, what, process.node.on_sensor, local_ns(self._now), payload)

    def _arrived(self, process: Process, packet: Packet) -> None:
        if process.node is None or not process.runs:
            process.keep_packet(packet)
            return
        what = f"a packet of {packet.source} on {packet.channel}"
        self._handled(process, what, process.node.on_packet, process.clock.local_ns(self._now), packet)

    def _happen(self, process: Process, what: Happening) -> None:
        """A fault of a process or clock, or a forged packet."""
        match what:
            case Stop(in_order):
                process.stop(in_order)
            case Start(keep_state):
                process.start(self._now, keep_state)
                self._applied.pop(process.robot, None)
            case Pause():
                process.pause()
            case Resume():
                waiting = process.resume()
                for item in waiting.data:
                    self._sensed(process, item)
                for packet in waiting.packets:
                    self._arrived(process, packet)
            case Forged(forger):
                forged = forger.packet(self._now)
                if forged is not None:
                    self._arrived(process, forged)
                following = forger.next_ns(self._now)
                if following is not None:
                    self._push(following, FAULT, process.robot, what)
            case ClockChange():
                pass
        self._arm(process.robot)

    def _note_contacts(self, process: Process) -> None:
        """Pairs whose base contact is a new one since the last look."""
        if process.node is None:
            return
        agent, robot = process.node.agent, process.robot
        applied = agent.counters["pair.applied_initiator"] + agent.counters["pair.applied_responder"]
        if applied == self._applied.get(robot, 0):
            return
        self._applied[robot] = applied
        for peer, epoch in sorted(agent.filter.contacts().items()):
            if epoch != self._bases.get((robot, peer)):
                self._bases[robot, peer] = epoch
                self.contacts.append((self._now / NS, robot, peer))

    def _handled(self, process: Process, event: str, handle: Callable[..., Outgoing], *what: Any) -> None:
        """An event reaches a robot that is up, and what it makes of it is carried out."""
        assert process.node is not None
        started = time.perf_counter()
        out = handle(*what)
        if out.steer is not None:
            self.plan_us.append((time.perf_counter() - started) * 1e6)
            # Its own clock is the vehicle's: one that stops sending commands stops when the last one ends.
            until_ns = process.clock.true_ns(out.steer.until_ns, self._now)
            self._world.steer(process.robot, self._now, replace(out.steer, until_ns=until_ns))
        self._carry_out(process.node, event, out)

    def _carry_out(self, node: Node, event: str, out: Outgoing) -> None:
        """What a robot makes of an event."""
        if self._checker is not None:
            self._checker.after(node, self._now, event, out)
        if out.persist is not None:
            self._processes[node.robot].keep(out.persist)
        for named in out.named:
            self._labels.judge(node.robot, named)
        for packet in out.packets:
            self._transmit(packet)
        if out.next_life is not None:
            self._processes[node.robot].succeed(self._now, out.next_life)
            self._applied.pop(node.robot, None)
        self._arm(node.robot)

    def _transmit(self, packet: Packet) -> None:
        header = peek_header(packet.payload)
        assert header is not None
        self._traffic["sent"] += 1
        self._traffic["bytes"] += len(packet.payload)
        receivers = [packet.destination] if packet.destination is not None else list(self._processes)
        for receiver in receivers:
            if receiver is None or receiver == packet.source or receiver not in self._processes:
                continue
            arrivals = self._links.carry(packet, header, receiver, self._now)
            self._traffic["delivered" if arrivals else "lost"] += 1
            self._faults.overheard(receiver, packet)
            for delay, arriving in arrivals:
                self._push(self._now + delay, DELIVERY, receiver, arriving)

    def _push(self, t_ns: int, phase: int, robot: str, what: Any) -> None:
        self._pushed += 1
        rank = "" if phase == DELIVERY else robot
        heapq.heappush(self._heap, (t_ns, phase, rank, self._pushed, robot, what))

    def _arm(self, robot: str) -> None:
        process = self._processes[robot]
        if process.node is None or not process.runs:
            self._timers.pop(robot, None)
            return
        # A timer may end the present instant, but each instant ends once.
        earliest = self._now + 1 if self._ticked.get(robot) == self._now else self._now
        deadline = process.clock.true_ns(process.node.next_deadline_ns(), earliest)
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
        for robot, process in self._processes.items():
            # What does not run tells nobody anything.
            estimate = process.node.agent.estimate() if process.node is not None and process.runs else None
            if estimate is None:
                continue
            self._sampler.put(robot, robot, row, estimate.mean, estimate.cov)
            for track in estimate.tracks:
                self._sampler.put(robot, track.target, row, track.mean, track.cov)
            self._sampler.put_relatives(robot, row, self._since_start(process, estimate.relatives))
            if process.node is not None and isinstance(process.node.agent.filter, RelativeFilter):
                t_ns, tests = process.node.agent.filter.gate_tests()
                self._sampler.put_gates(robot, process.clock.origin_ns(t_ns), tests)
        if self._bound is not None:
            for entity in (*self._world.robots, *self._world.targets):
                self._sampler.put_bound(entity, row, self._bound.belief(entity))

    def _since_start(
        self, process: Process, relatives: tuple[RelativeEstimate, ...]
    ) -> tuple[RelativeEstimate, ...]:
        """The same with instants of the true clock."""
        origin_ns = process.clock.origin_ns
        return tuple(replace(found, t_ns=origin_ns(found.t_ns)) for found in relatives)

    def result(self) -> TrialResult:
        """Figures of what has been played."""
        refused: Counter[str] = Counter()
        for process in self._processes.values():
            refused.update(process.rejected())
        counters = {name: process.counters() for name, process in self._processes.items()}
        measured = self._measured.instants()
        return TrialResult(
            replace(self._sampler.trace(), labels=self._labels.figures()),
            self.contacts,
            network_figures(self._traffic, counters),
            dict(sorted(refused.items())),
            {name: process.nis() for name, process in self._processes.items()},
            counters,
            trial_motion(self._scenario, self._world, measured, self._k),
            self.step_us,
            self.plan_us,
            measured,
            self._sampler.gate,
        )
