"""Faults as the virtual engine plays them: those of processes, clocks and forgers as things that happen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from agent.clock_faults import FaultyClock
from agent.fault_parts import (
    AnyFaultPart,
    AnySensorFaultPart,
    BiasPart,
    ClockDriftPart,
    ClockStepPart,
    CrashPart,
    DropoutPart,
    ForgePart,
    OutliersPart,
    PausePart,
    RestartPart,
    SilencePart,
)
from agent.settings import nanoseconds
from network.faults import FOREVER_NS, LinkFaults
from network.forgery import Forger
from network.messages import Packet


@dataclass(frozen=True, slots=True)
class Stop:
    """The process ends."""


@dataclass(frozen=True, slots=True)
class Start:
    """The process starts again, with its state file or without."""

    keep_state: bool


@dataclass(frozen=True, slots=True)
class Pause:
    """The process stands still."""


@dataclass(frozen=True, slots=True)
class Resume:
    """The process goes on."""


@dataclass(frozen=True, slots=True)
class ClockChange:
    """The clock steps or changes its rate: timers are due at other instants."""


@dataclass(frozen=True, slots=True)
class Forged:
    """A forged packet arrives."""

    forger: Forger


Happening = Stop | Start | Pause | Resume | ClockChange | Forged


class EngineFaults:
    """The faults of one trial by name."""

    def __init__(self, faults: dict[str, AnyFaultPart], seed: int) -> None:
        self._seed = seed
        self._faults = faults
        self.links = LinkFaults(seed)
        self.sensors: dict[str, AnySensorFaultPart] = {}
        self._clocks: dict[str, FaultyClock] = {}
        self._forgers: dict[str, list[Forger]] = {}
        for name, fault in faults.items():
            match fault:
                case DropoutPart() | OutliersPart() | BiasPart() | SilencePart():
                    self.sensors[name] = fault
                case ClockStepPart() | ClockDriftPart():
                    self.clock(fault.robot).add(fault.clock())
                case ForgePart() | CrashPart() | RestartPart() | PausePart():
                    pass
                case _:
                    self.links.add([fault.fault(name)])

    def clock(self, robot: str) -> FaultyClock:
        """The clock of a robot."""
        return self._clocks.setdefault(robot, FaultyClock())

    def happenings(self, robots: Iterable[str]) -> Iterator[tuple[int, str, Happening]]:
        """(instant [ns], robot, what happens) to processes and clocks, and the first packet of every forger."""
        for name, fault in self._faults.items():
            begin, end = fault.span_ns()
            match fault:
                case CrashPart():
                    yield begin, fault.robot, Stop()
                    if end < FOREVER_NS:
                        yield end, fault.robot, Start(fault.state == "kept")
                case RestartPart():
                    yield begin, fault.robot, Stop()
                    yield (begin if end == FOREVER_NS else end), fault.robot, Start(True)
                case PausePart():
                    yield begin, fault.robot, Pause()
                    yield begin + nanoseconds(fault.for_s), fault.robot, Resume()
                case ForgePart():
                    forgery = fault.forgery(name)
                    for robot in robots:
                        if forgery.reaches(robot):
                            forger = Forger(forgery, self._seed, robot)
                            self._forgers.setdefault(robot, []).append(forger)
                            first = forger.next_ns(-1)
                            if first is not None:
                                yield first, robot, Forged(forger)
                case _:
                    pass
        for robot, clock in self._clocks.items():
            for t_ns in clock.changes():
                yield t_ns, robot, ClockChange()

    def overheard(self, receiver: str, packet: Packet) -> None:
        """A genuine packet on its way to a receiver, for those who forge others after it."""
        for forger in self._forgers.get(receiver, ()):
            forger.seen(packet)
