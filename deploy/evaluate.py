"""Figures of a run of processes: the agents' own recordings held against the truth afterwards."""

from __future__ import annotations

import contextlib
import csv
from collections import Counter
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from agent.effects import Effect, Publish, Send
from agent.events import Event, Received
from agent.fault_parts import AnySensorFaultPart
from agent.recording import RecordingError, merge, read_boundary, unpack
from deploy.agent_files import life_files
from deploy.instants import Clocks, InstantEstimates, Measured
from deploy.launch import Outcome
from network.links import FATE_COLUMNS
from network.messages import PairReply, ReplyStatus
from sim.agents import autopilot_fix
from sim.bearing_bound import bound_of
from sim.engine import TrialResult, network_figures
from sim.fault_plan import trial_faults
from sim.faulty_world import FaultyWorld
from sim.metrics import TrialTrace
from sim.motion_figures import trial_motion
from sim.sampling import MeasurementLog, Sampler
from sim.scenario import Scenario
from sim.world import World


def collect(
    scenario: Scenario, world: World, run_dir: Path, outcome: Outcome, with_bound: bool, seed: int = 1
) -> TrialResult:
    """A `TrialResult` as the virtual engine gives it, from recordings and what the agents said at their end."""
    sensed = FaultyWorld(world, seed, {robot.id: autopilot_fix(robot) for robot in scenario.robots})
    for name, fault in trial_faults(scenario, seed).items():
        if isinstance(fault, AnySensorFaultPart):
            sensed.add(name, fault)
    sampler, contacts = _sampled(scenario, world, run_dir, outcome.t0_ns, seed, with_bound)
    counters: dict[str, dict[str, int]] = {}
    nis: dict[str, dict[str, tuple[float, int]]] = {}
    rejected: Counter[str] = Counter()
    traffic: Counter[str] = Counter()
    for robot in world.robots:
        figures: dict[str, Any] = outcome.figures.get(robot, {})
        counters[robot] = figures.get("counters", {})
        nis[robot] = {kind: (total, count) for kind, (total, count) in figures.get("nis", {}).items()}
        rejected.update(figures.get("rejected", {}))
        traffic["sent"] += figures.get("endpoint", {}).get("sent", 0)
        traffic["bytes"] += figures.get("endpoint", {}).get("sent_bytes", 0)
    for row in _fates(scenario, run_dir):
        gone = row["in_range"] == "0" or row["lost"] == "1"
        traffic["lost" if gone else "delivered"] += 1
    runner = bound_of(scenario, world) if with_bound else None
    measured = MeasurementLog()
    for k in range(world.steps + 1):
        outputs = sensed.outputs(k) if k else []
        measured.add(outputs)
        if runner is not None:
            if k:
                runner.step(k, outputs)
            row_index = sampler.row(k)
            if row_index is not None:
                for entity in (*world.robots, *world.targets):
                    sampler.put_bound(entity, row_index, runner.belief(entity))
    instants = measured.instants()
    return TrialResult(
        sampler.trace(),
        contacts,
        network_figures(traffic, counters),
        dict(sorted(rejected.items())),
        nis,
        counters,
        trial_motion(scenario, world, instants, world.steps),
        measured=instants,
    )


def trace_of(scenario: Scenario, world: World, run_dir: Path, t0_ns: int, seed: int) -> TrialTrace:
    """Truth and estimates at sampled instants, as far as recordings tell; the run may go on."""
    return _sampled(scenario, world, run_dir, t0_ns, seed, with_bound=False)[0].trace()


def _sampled(
    scenario: Scenario, world: World, run_dir: Path, t0_ns: int, seed: int, with_bound: bool
) -> tuple[Sampler, list[tuple[float, str, str]]]:
    """Estimates at sampled instants, and the contacts in order."""
    if world.closed_loop:
        raise ValueError("nobody but the run's world knows where its robots went: take `sim.trial.played_world`")
    clocks = Clocks(scenario, seed, t0_ns)
    measured = Measured(scenario, clocks)
    sampler = Sampler(scenario, world, with_bound)
    contacts: list[tuple[float, str, str]] = []
    for robot in world.robots:
        paths = life_files(run_dir, robot, "mcap")
        _sample(sampler, world, robot, paths, clocks, measured, t0_ns, contacts)
    return sampler, sorted(contacts)


def _sample(
    sampler: Sampler,
    world: World,
    robot: str,
    paths: list[Path],
    clocks: Clocks,
    measured: Measured,
    t0_ns: int,
    contacts: list[tuple[float, str, str]],
) -> None:
    """The estimate that stands for each sampled instant, and the contacts the robot applied."""
    clock, rows = clocks(robot), InstantEstimates(sampler, world, robot)
    with contextlib.suppress(RecordingError):
        for path in paths:
            born = False
            for event, packed in read_boundary(path, robot, unfinished=True):
                if not born:
                    rows.begin(clock.origin_ns(event.t_ns) - t0_ns)
                    born = True
                found_ns = measured.at_ns(robot, event)
                if found_ns is not None:
                    rows.measured(found_ns - t0_ns)
                made = [unpack(data) for data in packed]
                for peer in _contacts(event, made):
                    contacts.append(((event.t_ns - t0_ns) * 1e-9, robot, peer))
                for effect in made:
                    if isinstance(effect, Publish):
                        estimate = effect.estimate
                        relatives = tuple(
                            replace(found, t_ns=clock.origin_ns(found.t_ns) - t0_ns) for found in estimate.relatives
                        )
                        t_ns = clock.origin_ns(estimate.t_ns) - t0_ns
                        rows.published(replace(estimate, t_ns=t_ns, relatives=relatives))
            rows.end()


def _contacts(event: Event, effects: list[Effect]) -> list[str]:
    """Peers whose contact was used here: requests answered with OK (perhaps later), and accepted replies."""
    peers = [
        effect.peer
        for effect in effects
        if isinstance(effect, Send) and isinstance(effect.body, PairReply) and effect.body.status is ReplyStatus.OK
    ]
    if isinstance(event, Received):
        body, used = event.message.body, any(isinstance(effect, Publish) for effect in effects)
        if isinstance(body, PairReply) and body.status is ReplyStatus.OK and used:
            peers.append(event.message.header.source)
    return peers


def _fates(scenario: Scenario, run_dir: Path) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = []
    for robot in scenario.robots:
        for path in life_files(run_dir, robot.id, "fates.csv"):
            with path.open(newline="") as file:
                rows += [dict(zip(FATE_COLUMNS, row)) for row in csv.reader(file) if len(row) == len(FATE_COLUMNS)]
    return rows


def merge_fates(scenario: Scenario, run_dir: Path) -> None:
    """One `fates.csv` for the run, in place of one per receiver."""
    rows = _fates(scenario, run_dir)
    rows.sort(
        key=lambda row: (int(row["t_send_ns"]), row["source"], row["destination"], row["channel"], int(row["seq"]))
    )
    with (run_dir / "fates.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, FATE_COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    for robot in scenario.robots:
        for path in life_files(run_dir, robot.id, "fates.csv"):
            path.unlink()


def merge_recordings(scenario: Scenario, run_dir: Path) -> None:
    """One `recording.mcap` for the run; an agent that was killed leaves what it had written."""
    paths = {robot.id: life_files(run_dir, robot.id, "mcap") for robot in scenario.robots}
    merge({robot: lives for robot, lives in paths.items() if lives}, run_dir / "recording.mcap")
    for path in chain.from_iterable(paths.values()):
        path.unlink()
