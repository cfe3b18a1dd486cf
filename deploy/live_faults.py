"""The faults of a run of processes while it goes on: those of its schedule, and those injected by hand.

`cofix fault` asks over a local Unix socket in the run's private folder, one JSON line per request:

    {"inject": {"kind": ..., key: value, ...}}, {"end": NAME}, {"list": true}

and gets one line back: {"done": what, in words}, {"faults": [...]} or {"error": why}.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.config import InjectionPart
from agent.config_file import ConfigError, validate
from agent.fault_parts import AnyFaultPart
from agent.fault_words import told
from agent.settings import nanoseconds
from sim.agents import table
from sim.fault_plan import trial_faults
from sim.scenario import Scenario
from sim.scenario_checks import check_schedule

SHORTEST_S = 0.001
"""What a fault that is ended before it began is said to have lasted: a schedule knows no shorter one."""


class LiveFaults:
    """Faults by name. `soon_s` tells the earliest instant [s since the start] by which all processes know of a new one;
    `tell` sends a message to all of them, `strike` plays a fault of a process."""

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        soon_s: Callable[[], float],
        tell: Callable[[dict[str, Any]], None],
        strike: Callable[[str, AnyFaultPart], None],
    ) -> None:
        self._scenario, self._soon_s, self._tell, self._strike = scenario, soon_s, tell, strike
        self.faults = trial_faults(scenario, seed)
        self.changes: list[dict[str, Any]] = []
        """What was told to the processes, for those that start later."""
        self._over: dict[str, asyncio.Event] = {}
        self._server: asyncio.Server | None = None

    async def serve(self, path: Path) -> None:
        """Listen for requests of this user."""
        self._server = await asyncio.start_unix_server(self._serve, path=str(path))
        path.chmod(0o600)

    def close(self) -> None:
        if self._server is not None:
            self._server.close()

    def played(self) -> Scenario:
        """The scenario with the faults as they were, stated one by one if anything was done by hand."""
        if not self.changes:
            return self._scenario
        faults = [fault.model_copy(update={"id": name}) for name, fault in self.faults.items()]
        return self._scenario.model_copy(update={"faults": faults, "fault_plan": None})

    def active(self, t_s: float) -> list[str]:
        """Names of the faults at an instant."""
        t_ns = nanoseconds(t_s)
        spans = {name: fault.span_ns() for name, fault in self.faults.items()}
        return [name for name, (begin, end) in spans.items() if begin <= t_ns < end]

    def over(self, name: str) -> asyncio.Event:
        """Set once a fault is ended by hand."""
        return self._over.setdefault(name, asyncio.Event())

    def inject(self, keys: dict[str, Any]) -> str:
        """A fault by the keys of `[[faults]]`, by default from now on; returns its name. Raises `ConfigError`."""
        soon_s = round(self._soon_s(), 3)
        name = keys.get("id") or self._new_name(str(keys.get("kind")))
        entry = {"at_s": soon_s, **keys, "id": name}
        (fault,) = validate(InjectionPart, {"seed": 0, "faults": [entry]}, "fault").faults
        if name in self.faults:
            raise ConfigError(f"fault: id '{name}' is used already; ids must differ")
        if fault.at_s < soon_s:
            raise ConfigError(f"fault: at_s = {fault.at_s:g} is over; the run is at {soon_s:g} s, leave at_s out")
        check_schedule(self._scenario, [fault])
        self.faults[name] = fault
        self._changed({"fault": table(fault)})
        if fault.level == "process":
            self._strike(name, fault)
        return name

    def end(self, name: str) -> None:
        """End a fault now. Raises `ConfigError` if there is none of that name that goes on, or it cannot be ended."""
        at_s = round(self._soon_s(), 3)
        fault = self.faults.get(name)
        if fault is None or fault.span_ns()[1] <= nanoseconds(at_s):
            on = ", ".join(self.active(at_s)) or "none"
            raise ConfigError(f"fault: there is no '{name}' that goes on; there are: {on}")
        if fault.level == "clock":
            raise ConfigError(f"fault: '{name}' cannot be ended: a clock that was set stays so; inject another one")
        lasted_s = max(round(at_s - fault.at_s, 3), SHORTEST_S)
        self.faults[name] = fault.model_copy(update={"for_s": lasted_s})
        self.over(name).set()
        self._changed({"end_fault": {"id": name, "at_s": at_s}})

    def _changed(self, message: dict[str, Any]) -> None:
        self.changes.append(message)
        self._tell(message)

    def _new_name(self, kind: str) -> str:
        number = len(self.faults) + 1
        while f"{kind}-{number}" in self.faults:
            number += 1
        return f"{kind}-{number}"

    # -- requests -------------------------------------------------------------------------------------------

    def answer(self, request: Any) -> dict[str, Any]:
        """The answer to one request."""
        try:
            match request:
                case {"inject": dict(keys)}:
                    name = self.inject(keys)
                    return {"done": f"{name}: {told(name, self.faults[name])}"}
                case {"end": str(name)}:
                    self.end(name)
                    return {"done": f"{name} is ended"}
                case {"list": True}:
                    on = self.active(self._soon_s())
                    return {"faults": [[name, name in on, told(name, fault)] for name, fault in self.faults.items()]}
        except ConfigError as error:
            return {"error": str(error)}
        return {"error": "fault: inject, end or list is needed"}

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, ValueError):
            while line := await reader.readline():
                try:
                    answer = self.answer(json.loads(line))
                except json.JSONDecodeError:
                    answer = {"error": "fault: a request is one line of JSON"}
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()
        writer.close()
