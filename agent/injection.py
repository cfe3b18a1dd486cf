"""Faults injected at one real receiver, for runs on one computer: what the virtual engine does between robots.

Packets meet their fates here, forged ones are made here, and the clock of the robot is set wrong. Nothing of it exists
with a real autopilot: the configuration refuses it.
"""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from agent.clock_faults import FaultyClock
from agent.config import InjectionPart
from agent.fault_parts import AnyFaultPart, ClockDriftPart, ClockStepPart, ForgePart, made, named
from agent.settings import nanoseconds
from network.forgery import Forger
from network.injected_transport import CallLater, LinkInjector
from network.link_feed import LinkFeed
from network.links import FateRecord, LinkModel, RangeTable, fate_row
from network.messages import Packet


class Injection:
    """One receiver's share of the faults. `true_ns` tells true fleet time, `deliver` takes what arrives."""

    def __init__(
        self,
        robot: str,
        part: InjectionPart,
        true_ns: Callable[[], int],
        call_later: CallLater,
        deliver: Callable[[Packet], None],
    ) -> None:
        self._robot, self._part, self._true_ns = robot, part, true_ns
        self._call_later, self._deliver = call_later, deliver
        self._table = RangeTable()
        self._feed: LinkFeed | None = None
        self._file: Any = None
        self._clocks: dict[str, FaultyClock] = {}
        self._forgers: list[Forger] = []
        self._spans: dict[str, tuple[int, int]] = {}
        self._start_ns = 0
        self.failure: str | None = None
        """Why the fate log is not written any more."""
        log: Callable[[FateRecord], None] | None = None
        if part.fate_log is not None:
            self._file = Path(part.fate_log).open("w", newline="")  # noqa: SIM115
            self._rows = csv.writer(self._file)
            log = self._log_fate
        self.links = LinkModel(part.links.settings(part.seed), self._table.state, log)
        self._injector = LinkInjector(robot, self.links, true_ns, call_later, deliver, self._sent_at)

    def _log_fate(self, record: FateRecord) -> None:
        if self.failure is None:
            try:
                self._rows.writerow(fate_row(record))
            except OSError as error:
                self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = error.strerror or type(error).__name__
        with contextlib.suppress(OSError):
            self._file.close()

    async def open(self) -> None:
        """Learn from the world who hears whom."""
        if self._part.table is not None:
            self._feed = LinkFeed()
            await self._feed.follow(self._part.table, self._table.publish)

    def begin(self, start_ns: int) -> None:
        """The run starts at `start_ns`: from now on its schedule is known in fleet time."""
        self._start_ns = start_ns
        for name, fault in named(self._part.faults).items():
            self.add(name, fault)

    def add(self, name: str, fault: AnyFaultPart) -> None:
        """One more fault of links, clocks or forgers. Raises `ValueError` if the name is in use."""
        if isinstance(fault, ClockStepPart | ClockDriftPart):
            self.clock(fault.robot).add(fault.clock(self._start_ns))
            if fault.robot == self._robot:
                self._spans[name] = fault.span_ns(self._start_ns)
        elif isinstance(fault, ForgePart):
            forgery = fault.forgery(name, self._start_ns)
            if forgery.reaches(self._robot):
                self._spans[name] = fault.span_ns(self._start_ns)
                self._forgers.append(Forger(forgery, self._part.seed, self._robot))
                self._forge(self._forgers[-1], self._true_ns())
        elif fault.level == "link":
            self.links.faults.add([fault.fault(name, self._start_ns)])

    def end(self, name: str, t_ns: int) -> bool:
        """End a fault of links or a forgery; False if there is none of that name that goes on."""
        forging = [forger for forger in self._forgers if forger.forgery.name == name]
        for forger in forging:
            forger.forgery = replace(forger.forgery, end_ns=min(forger.forgery.end_ns, t_ns))
            self._spans[name] = (forger.forgery.begin_ns, forger.forgery.end_ns)
        return self.links.faults.end(name, t_ns) or bool(forging)

    def change(self, message: dict[str, Any]) -> AnyFaultPart | None:
        """Do what the launcher says; the fault that was added, if one was. Messages as in `agent.control`."""
        if "end_fault" in message:
            ended = message["end_fault"]
            self.end(ended["id"], self._start_ns + nanoseconds(ended["at_s"]))
            return None
        fault = made(**message["fault"])
        assert fault.id is not None
        self.add(fault.id, fault)
        return fault

    def clock(self, robot: str) -> FaultyClock:
        """The clock of a robot, this one or a sender."""
        return self._clocks.setdefault(robot, FaultyClock())

    def on_packet(self, packet: Packet) -> None:
        """A packet as it came over the network."""
        for forger in self._forgers:
            forger.seen(packet)
        self._injector.on_packet(packet)

    def _sent_at(self, source: str, t_send_ns: int) -> int:
        """The true instant a sender's stamp stands for."""
        return self.clock(source).origin_ns(t_send_ns)

    def _forge(self, forger: Forger, after_ns: int) -> None:
        following = forger.next_ns(after_ns)
        if following is None:
            return

        def due() -> None:
            packet = forger.packet(following)
            if packet is not None and following < forger.forgery.end_ns:
                self._deliver(packet)
            self._forge(forger, following)

        self._call_later(max(following - self._true_ns(), 0), due)

    def told(self) -> list[str]:
        """Names of the faults that are on now: of links, of the own clock, of those who forge."""
        now_ns = self._true_ns()
        others = [name for name, (begin, end) in self._spans.items() if begin <= now_ns < end]
        return self.links.faults.active(now_ns) + others

    async def close(self) -> None:
        if self._file is not None:
            try:
                self._file.close()
            except OSError as error:
                self._fail(error)
        if self._feed is not None:
            await self._feed.close()
