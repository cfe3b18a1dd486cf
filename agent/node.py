"""One robot without its I/O: endpoint, sensor input and core together. Every shell runs exactly this."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from agent.core import Agent
from agent.effects import Alarm, Broadcast, Effect, Estimate, Named, Persist, Publish, Send, Steer
from agent.events import ClockJudged, Event, LinkChange, Received, Tick
from agent.figures import NisSum
from agent.sensor_input import SensorConfig, SensorError, decode
from agent.settings import AgentSettings
from network.endpoint import ClockChange, Delivery, Endpoint, EndpointSettings, PeerChange, PeerDoubled
from network.messages import Packet
from network.wire import OversizeError

Recorder = Callable[[Event, list[Effect]], None]


@dataclass(slots=True)
class Outgoing:
    """What a shell has to carry out: a state to keep first, then packets to send, and estimates to show.

    `named` are measurements that came without a name and have one now.

    `steer` is the newest command to the vehicle, which replaces the one before.
    `persist` is the newest state, and `ahead` if a packet must not leave before one is kept that is as new.
    """

    packets: list[Packet] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)
    alarms: list[Alarm] = field(default_factory=list)
    named: list[Named] = field(default_factory=list)
    persist: Persist | None = None
    steer: Steer | None = None
    next_life: int | None = None
    """A new life is due, of this incarnation, see `network.own_life`."""


class Node:
    """Bytes and times in, bytes and estimates out; deterministic."""

    def __init__(
        self,
        settings: AgentSettings,
        endpoint: EndpointSettings,
        *,
        boot_id: int,
        incarnation: int,
        software: str,
        sensors: dict[str, SensorConfig] | None = None,
        recorder: Recorder | None = None,
        state: bytes | None = None,
    ) -> None:
        """`state`: what to begin with, of a `Persist`. Raises `StateError` if that is impossible."""
        self.robot = settings.robot
        self.agent = Agent(settings, state)
        self.endpoint = Endpoint(
            robot=settings.robot, boot_id=boot_id, incarnation=incarnation, settings=endpoint, software=software
        )
        self.counters: Counter[str] = Counter()
        self._now_ns = 0
        self._sensors = sensors or {}
        self._recorder = recorder

    def on_event(self, event: Event) -> Outgoing:
        """An event made elsewhere (the autopilot reader, for instance)."""
        out = Outgoing()
        self._handle(event, out)
        return out

    def on_sensor(self, now_ns: int, payload: bytes) -> Outgoing:
        """A sensor datagram."""
        out = Outgoing()
        try:
            event = decode(payload, now_ns, self._sensors)
        except SensorError as error:
            self.counters[f"sensor.{error.reason}"] += 1
            return out
        self._handle(event, out)
        return out

    def on_packet(self, now_ns: int, packet: Packet) -> Outgoing:
        """A packet from the network."""
        out = Outgoing()
        self._now_ns = now_ns
        for item in self.endpoint.receive(now_ns, packet):
            if isinstance(item, ClockChange):
                out.alarms.append(_clock_alarm(item))
                self._handle(ClockJudged(now_ns, item.peer, item.reason), out)
            elif isinstance(item, PeerDoubled):
                out.alarms.append(Alarm("duplicate_robot", f"{item.peer}: {DOUBLED}"))
            elif isinstance(item, Delivery):
                self._handle(Received(now_ns, item.message, item.offset_ns, item.offset_sigma_ns), out)
            else:
                self._handle(_link_change(now_ns, item), out)
        return out

    def on_tick(self, now_ns: int) -> Outgoing:
        """Time has passed."""
        out = Outgoing()
        self._now_ns = now_ns
        packets, changes = self.endpoint.tick(now_ns)
        out.packets.extend(packets)
        for change in changes:
            self._handle(_link_change(now_ns, change), out)
        if self.agent.next_deadline_ns() <= now_ns:
            self._handle(Tick(now_ns), out)
        out.next_life = self.endpoint.own_life.next_incarnation(now_ns)
        return out

    def count_on(self, before: Node) -> None:
        """Add what was counted in the life before, in the same process."""
        for mine, theirs in (
            (self.counters, before.counters),
            (self.agent.counters, before.agent.counters),
            (self.endpoint.counters, before.endpoint.counters),
        ):
            mine.update(theirs)
        for kind, entry in before.agent.nis.items():
            total = self.agent.nis.setdefault(kind, NisSum())
            total.total += entry.total
            total.count += entry.count

    def next_deadline_ns(self) -> int:
        return min(self.endpoint.next_deadline_ns(), self.agent.next_deadline_ns())

    def status(self) -> dict[str, Any]:
        """What a person wants to know, as plain values."""
        peers = self.endpoint.peers(self._now_ns)
        clocks = {
            peer.peer: {
                "offset_s": peer.offset_ns * 1e-9,
                "sigma_s": peer.offset_sigma_ns * 1e-9,
                "steps": peer.clock_steps,
                "unusable": peer.clock_unusable,
            }
            for peer in peers
            if peer.offset_ns is not None and peer.offset_sigma_ns is not None
        }
        doubled = [self.robot] if self.endpoint.own_life.doubled(self._now_ns) else []
        return {
            "robot": self.robot,
            "incarnation": self.endpoint.incarnation,
            **self.agent.status(),
            "peers": {peer.peer: peer.up for peer in peers},
            "clocks": clocks,
            "duplicates": sorted(doubled + [peer.peer for peer in peers if peer.doubled]),
            "unheard_by": [peer.peer for peer in peers if not peer.hears_us],
            "rejected": rejected(self),
        }

    def _handle(self, event: Event, out: Outgoing) -> None:
        effects = self.agent.handle(event)
        if self._recorder is not None:
            self._recorder(event, effects)
        for effect in effects:
            match effect:
                case Send(peer, t_meas_ns, body):
                    self._transmit(lambda: self.endpoint.send(event.t_ns, peer, t_meas_ns, body), out)
                case Broadcast(channel, t_meas_ns, body):
                    self._transmit(lambda: self.endpoint.broadcast(event.t_ns, channel, t_meas_ns, body), out)
                case Publish(estimate):
                    out.estimates.append(estimate)
                case Alarm():
                    out.alarms.append(effect)
                case Named():
                    out.named.append(effect)
                case Steer():
                    out.steer = effect
                case Persist(payload):
                    before = out.persist is not None and out.persist.ahead
                    out.persist = Persist(payload, True) if before else effect

    def _transmit(self, make: Callable[[], Packet], out: Outgoing) -> None:
        """A message that cannot be told (too large, or degenerate numbers) is counted, never fatal."""
        try:
            out.packets.append(make())
        except OversizeError:
            self.counters["send.oversize"] += 1
        except ValueError:
            self.counters["send.degenerate"] += 1


DOUBLED = "two processes send under this id; stop one of them"
CLOCK_REASONS = {
    "steps": "it is set again and again",
    "offset": "it is off by far more than lateness.clock_sigma_s allows; set the clock, or enlarge that",
    "uncertain": "its offset is known less well than lateness.max_clock_sigma_s",
}


def _clock_alarm(change: ClockChange) -> Alarm:
    if change.reason is None:
        return Alarm("clock_usable", change.peer)
    return Alarm("clock_unusable", f"{change.peer}: {CLOCK_REASONS[change.reason]}")


def _link_change(now_ns: int, change: PeerChange) -> LinkChange:
    return LinkChange(now_ns, change.peer, change.up, change.incarnation, change.boot_id)


REFUSED = (
    "observation.",
    "late.dropped",
    "late.target",
    "late.too_old",
    "late.odometry_too_old",
    "late.odometry_unused",
    "input.",
    "odometry.out",
    "fix.",
)
"""How counters of what the core has not used begin."""


def rejected(node: Node) -> dict[str, int]:
    """All counters of things refused, by reason, sorted."""
    reasons: Counter[str] = Counter()
    for name, count in node.endpoint.counters.items():
        if name.startswith("rejected."):
            reasons[name.removeprefix("rejected.")] += count
    for name, count in node.counters.items():
        reasons[name] += count
    for name, count in node.agent.counters.items():
        if name.startswith(REFUSED):
            reasons[name] += count
    return dict(sorted(reasons.items()))
