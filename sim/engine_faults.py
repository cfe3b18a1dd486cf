"""Faults as the virtual engine plays them: those of processes, clocks and forgers as things that happen."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

from agent.clock_faults import FaultyClock
from agent.fault_parts import (
    AnyFaultPart,
    AnySensorFaultPart,
    ClockDriftPart,
    ClockStepPart,
    CrashPart,
    ForgePart,
    PausePart,
    RestartPart,
)
from agent.settings import nanoseconds
from network.faults import FOREVER_NS, LinkFaults
from network.forgery import Forger
from network.messages import Packet
from sim.faulty_world import FaultyWorld


@dataclass(frozen=True, slots=True)
class Stop:
    """The process ends, by a kill or in good order."""

    in_order: bool = False


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


class Intruder(Protocol):
    """Somebody on the air beside one receiver: hears what is sent to it, and sends it packets; see `Forger`."""

    def seen(self, packet: Packet) -> None: ...

    def next_ns(self, after_ns: int) -> int | None: ...

    def packet(self, t_ns: int) -> Packet | None: ...


@dataclass(frozen=True, slots=True)
class Forged:
    """A forged packet arrives."""

    forger: Intruder


Happening = Stop | Start | Pause | Resume | ClockChange | Forged


class EngineFaults:
    """The faults of one trial by name; more may be added while it is played."""

    def __init__(self, world: FaultyWorld, seed: int) -> None:
        self._world, self._seed = world, seed
        self._faults: dict[str, AnyFaultPart] = {}
        self.links = LinkFaults(seed)
        self._clocks: dict[str, FaultyClock] = {}
        self._forgers: dict[str, list[Intruder]] = {}

    def add(self, name: str, fault: AnyFaultPart) -> None:
        """One more fault. Raises `ValueError` if the name is in use."""
        if name in self._faults:
            raise ValueError(f"there is a fault '{name}' already")
        self._faults[name] = fault
        match fault:
            case _ if isinstance(fault, AnySensorFaultPart):
                self._world.add(name, fault)
            case ClockStepPart() | ClockDriftPart():
                self.clock(fault.robot).add(fault.clock())
            case ForgePart() | CrashPart() | RestartPart() | PausePart():
                pass
            case _:
                self.links.add([fault.fault(name)])

    def end(self, name: str, t_ns: int) -> bool:
        """End a fault of links or sensors; False if there is none of that name that goes on."""
        return self.links.end(name, t_ns) or self._world.end(name, t_ns)

    def clock(self, robot: str) -> FaultyClock:
        """The clock of a robot."""
        return self._clocks.setdefault(robot, FaultyClock())

    def happenings(self, name: str, robots: Iterable[str]) -> Iterator[tuple[int, str, Happening]]:
        """(instant [ns], robot, what happens) by a fault: to processes and clocks, and a forger's first packet."""
        fault = self._faults[name]
        begin, end = fault.span_ns()
        match fault:
            case CrashPart():
                yield begin, fault.robot, Stop()
                if end < FOREVER_NS:
                    yield end, fault.robot, Start(fault.state == "kept")
            case RestartPart():
                yield begin, fault.robot, Stop(in_order=True)
                yield (begin if end == FOREVER_NS else end), fault.robot, Start(True)
            case PausePart():
                yield begin, fault.robot, Pause()
                yield begin + nanoseconds(fault.for_s), fault.robot, Resume()
            case ClockStepPart() | ClockDriftPart():
                for t_ns in (begin, end):
                    if t_ns < FOREVER_NS:
                        yield t_ns, fault.robot, ClockChange()
            case ForgePart():
                forgery = fault.forgery(name)
                for robot in robots:
                    if forgery.reaches(robot):
                        yield from self.intruded(robot, Forger(forgery, self._seed, robot))

    def intruded(self, robot: str, intruder: Intruder) -> Iterator[tuple[int, str, Happening]]:
        """Somebody on the air beside `robot`, and the first packet it sends, as in `happenings`."""
        self._forgers.setdefault(robot, []).append(intruder)
        first = intruder.next_ns(-1)
        if first is not None:
            yield first, robot, Forged(intruder)

    def overheard(self, receiver: str, packet: Packet) -> None:
        """A genuine packet on its way to a receiver, for those who forge others after it."""
        for forger in self._forgers.get(receiver, ()):
            forger.seen(packet)
