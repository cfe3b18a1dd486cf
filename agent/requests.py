"""Asking an autopilot for the messages that are used, and watching whether they come."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

NS = 1_000_000_000
ANSWER_WAIT_NS = NS // 2
RETRY_NS = 3 * NS
REFUSED_RETRY_NS = 30 * NS
CHECK_NS = NS
SILENT_INTERVALS = 3
SILENT_NS = 2 * NS
SMOOTHING = 0.1
MAX_NAMES = 64


def command_long(vehicle: tuple[int, int], number: int, *parameters: float) -> Any:
    """COMMAND_LONG to (system, component); parameters that are not given are 0."""
    filled = [*parameters, *[0.0] * (7 - len(parameters))]
    return dialect.MAVLink_command_long_message(*vehicle, number, 0, *filled)


@dataclass(slots=True)
class Wanted:
    """A message to ask for by SET_MESSAGE_INTERVAL every `interval_ns` of fleet time."""

    name: str
    message_id: int
    interval_ns: int
    next_ns: int = 0
    asked: bool = False
    refused: bool = False


@dataclass(slots=True)
class Arrival:
    """How often a message arrives: its count, last instant and smoothed interval [ns]."""

    count: int
    last_ns: int
    interval_ns: float = 0.0


class MessageRequests:
    """One request at a time, because COMMAND_ACK does not say which message it speaks of."""

    def __init__(self, wanted: list[Wanted], counters: Counter[str]) -> None:
        self._wanted, self._counters = wanted, counters
        self._arrivals: dict[str, Arrival] = {}
        self._pending: Wanted | None = None
        self._pending_until_ns = 0

    def restart(self) -> None:
        """The autopilot rebooted, or time was set: everything is asked for again."""
        self._pending = None
        self._arrivals.clear()
        for wanted in self._wanted:
            wanted.next_ns, wanted.asked, wanted.refused = 0, False, False

    def arrived(self, now_ns: int, message_id: int, name: str) -> None:
        """A message of the autopilot."""
        arrival = self._arrivals.get(name)
        if arrival is None:
            if len(self._arrivals) < MAX_NAMES or any(item.message_id == message_id for item in self._wanted):
                self._arrivals[name] = Arrival(1, now_ns)
            return
        passed = now_ns - arrival.last_ns
        arrival.interval_ns += (SMOOTHING if arrival.count > 1 else 1.0) * (passed - arrival.interval_ns)
        arrival.count += 1
        arrival.last_ns = now_ns

    def due(self, now_ns: int) -> Wanted | None:
        """The request to send now, if any."""
        if self._pending is not None:
            if now_ns < self._pending_until_ns:
                return None
            self._counters["mavlink.request_unanswered"] += 1
            self._pending = None
        for wanted in self._wanted:
            if now_ns < wanted.next_ns:
                continue
            if wanted.asked and self._comes(wanted, now_ns):
                wanted.next_ns = now_ns + CHECK_NS
                continue
            wanted.asked = True
            wanted.next_ns = now_ns + RETRY_NS
            self._pending, self._pending_until_ns = wanted, now_ns + ANSWER_WAIT_NS
            return wanted
        return None

    def answered(self, now_ns: int, result: int) -> None:
        """COMMAND_ACK of a SET_MESSAGE_INTERVAL."""
        wanted = self._pending
        if wanted is None or result == dialect.MAV_RESULT_IN_PROGRESS:
            return
        self._pending = None
        wanted.refused = result not in (dialect.MAV_RESULT_ACCEPTED, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
        if wanted.refused:
            self._counters["mavlink.request_refused"] += 1
            wanted.next_ns = now_ns + REFUSED_RETRY_NS

    def next_deadline_ns(self) -> int:
        if self._pending is not None:
            return self._pending_until_ns
        return min((wanted.next_ns for wanted in self._wanted), default=2**63 - 1)

    def _comes(self, wanted: Wanted, now_ns: int) -> bool:
        """Whether a message arrives, and at least at half the rate asked for."""
        arrival = self._arrivals.get(wanted.name)
        if arrival is None or now_ns - arrival.last_ns > max(SILENT_INTERVALS * wanted.interval_ns, SILENT_NS):
            return False
        return arrival.interval_ns <= 2 * max(wanted.interval_ns, 1)

    def rates(self, now_ns: int) -> dict[str, dict[str, Any]]:
        """Per message: how many, age [s] and rate [Hz] (None until two have come)."""
        return {
            name: {
                "count": arrival.count,
                "age_s": round((now_ns - arrival.last_ns) * 1e-9, 3),
                "rate_hz": round(1e9 / arrival.interval_ns, 2) if arrival.interval_ns > 0 else None,
            }
            for name, arrival in sorted(self._arrivals.items())
        }

    def reasons(self, now_ns: int) -> list[str]:
        """Why wanted messages do not come."""
        found = []
        for wanted in self._wanted:
            arrival = self._arrivals.get(wanted.name)
            silence = max(SILENT_INTERVALS * wanted.interval_ns, SILENT_NS)
            if arrival is not None and now_ns - arrival.last_ns <= silence:
                continue
            if wanted.refused:
                found.append(f"the autopilot refuses to send {wanted.name}: choose another source")
            elif wanted.asked:
                found.append(f"{wanted.name} does not arrive although it was asked for")
        return found
