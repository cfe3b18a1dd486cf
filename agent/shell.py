"""The asyncio shell of one robot: sockets, clocks and files around the pure node.

It opens the transport, the autopilot's link and the sensor socket, hands everything that comes in to the node
with the fleet time, and carries out what comes back. Nothing of the estimation is decided here.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import secrets
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgpack

from agent.autopilot import AutopilotReader
from agent.config import AgentConfig
from agent.config_file import ConfigError
from agent.control import ControlLine
from agent.effects import Alarm
from agent.events import ControlReport, Event, PlannerOverrun
from agent.fleet_clock import FleetClock
from agent.injection import Injection
from agent.live_recording import LiveRecording
from agent.mavlink import MavlinkLink
from agent.node import Node, Outgoing, rejected
from agent.node_timer import NodeTimer
from agent.plan_timer import PlanTimer
from agent.publications import Publications
from agent.sensor_socket import SensorSocket
from agent.settings import nanoseconds
from agent.state_file import StateFile
from agent.state_keeper import Start, StateKeeper, start, succeed
from network.messages import Channel, Packet
from network.zenoh_session import ZenohSettings
from network.zenoh_transport import ZenohTransport

log = logging.getLogger("cofix.agent")

SOFTWARE = "cofix-0.1.0"
STATUS_INTERVAL_S = 0.5


class AgentShell:
    """Runs one agent until it is told to stop."""

    def __init__(self, config: AgentConfig) -> None:
        self.config = config
        self.robot = config.identity.robot
        self._state_dir = Path(config.state_dir)
        self._clock = FleetClock()
        self._node: Node | None = None
        self._transport: ZenohTransport | None = None
        self._mavlink: MavlinkLink | None = None
        self._reader: AutopilotReader | None = None
        self._injection: Injection | None = None
        self._recording: LiveRecording | None = None
        self._control: ControlLine | None = None
        self._hearing: asyncio.Task[None] | None = None
        self._sensors = SensorSocket(self._state_dir, self.on_sensor)
        self._receive: Any = None
        self._timer = NodeTimer(lambda: self._clock, self._on_timer)
        self._start_ns = 0
        overrun_ns = config.settings(0).planning.overrun_ns
        self._plans = PlanTimer(round(overrun_ns / config.clock.speed), time.perf_counter_ns)
        self._publications = Publications()
        self._stop = asyncio.Event()
        self.counters: Counter[str] = Counter()
        self._file = StateFile(self._state_dir, self.robot, config.state.sync)
        self._keeper: StateKeeper | None = None

    async def run(self) -> None:
        """Start, work, stop. Raises ConfigError, TransportError, MavlinkError or OSError when it cannot start."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._stop.set)
        try:
            await self._open()
            if self._control is not None:
                self._control.say({"ready": self.robot})
            if not await self._started():
                return
            await self._begin()
            await self._work()
        finally:
            await self._close()

    # -- start ----------------------------------------------------------------------------------------------

    async def _open(self) -> None:
        config = self.config
        try:
            self._state_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not self._file.claim():
                raise ConfigError(
                    f"state_dir {self._state_dir} is in use: an agent runs with it already; stop that one, or choose "
                    "another state_dir if this is another robot"
                )
            self._found = self._file.read()
            if not os.access(self._state_dir, os.W_OK):
                raise PermissionError(errno.EACCES, "permission denied")
        except OSError as error:
            raise ConfigError(f"state_dir {self._state_dir} cannot be written: {error.strerror}") from None
        for switch in config.unsafe.settings().named():
            log.warning("UNSAFE: unsafe.%s turns a protection off: estimates may claim more than they know", switch)
        if config.control_socket is not None:
            self._control = ControlLine(self.robot)
            await self._control.connect(config.control_socket)
        if config.zenoh.insecure_lan:
            log.warning("zenoh.insecure_lan: messages to peers are neither encrypted nor authenticated")
        self._boot_id = secrets.randbits(53)
        settings = ZenohSettings(
            fleet=config.identity.fleet,
            robot=self.robot,
            boot_id=self._boot_id,
            listen=tuple(config.zenoh.listen),
            connect=tuple((peer.id, tuple(peer.endpoints)) for peer in config.zenoh.peers),
            lease_ms=config.zenoh.lease_ms,
        )
        self._receive = self._on_packet
        if config.injection is not None:
            loop = asyncio.get_running_loop()
            self._injection = Injection(
                self.robot,
                config.injection,
                lambda: self._clock.true_ns(),
                lambda wait_ns, call: loop.call_later(self._clock.wall_s(wait_ns), call),
                self._on_packet,
            )
            await self._injection.open()
        self._transport = ZenohTransport(settings, lambda packet: self._receive(packet))
        await self._transport.start()
        await self._sensors.open()

    async def _started(self) -> bool:
        """Wait at the barrier and set the clock; False when stopped before the start."""
        clock = self.config.clock
        if clock.source == "system":
            return True
        if self._control is None or self._control.started is None:
            raise ConfigError("clock.source = 'run' needs control_socket: the launcher starts the clock")
        stop = asyncio.ensure_future(self._stop.wait())
        waits: set[asyncio.Future[Any]] = {self._control.started, stop}
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        stop.cancel()
        if self._stop.is_set() or self._control.started.cancelled() or not self._control.started.done():
            return False
        begin = self._control.started.result()
        self._clock = FleetClock(begin["t0_ns"], begin["monotonic0_ns"], clock.speed)
        if self._injection is not None:
            self._injection.begin(begin["t0_ns"])
            own = self._injection.clock(self.robot)
            self._clock = replace(self._clock, faulty=own)
            for message in begin.get("changes", []):
                self._injection.change(message)
            for t_ns in own.changes():
                self._rearm_at(t_ns)
        self._hearing = asyncio.create_task(self._hear(self._control))
        return True

    async def _hear(self, control: ControlLine) -> None:
        """Faults that are added to a run that goes on."""
        while True:
            message = await control.changes.get()
            if self._injection is None:
                continue
            fault = self._injection.change(message)
            if fault is not None and fault.level == "clock":
                for t_ns in self._injection.clock(self.robot).changes():
                    self._rearm_at(t_ns)

    def _rearm_at(self, t_ns: int) -> None:
        """The own clock changes at the true instant `t_ns`: what was due by it is due at another time."""
        wait_s = self._clock.wall_s(t_ns - self._clock.true_ns())
        if wait_s > 0.0:
            asyncio.get_running_loop().call_later(wait_s, self._arm_anew)

    def _arm_anew(self) -> None:
        if self._node is not None:
            self._timer.cancel()
            self._arm()

    async def _begin(self) -> None:
        config = self.config
        start_ns = self._clock.t0_ns if config.clock.source == "run" else self._clock.now_ns()
        self._start_ns = start_ns
        begin = self._restored(start_ns)
        if config.recording is not None:
            self._recording = LiveRecording(Path(config.recording), config, start_ns)
            if begin.again or begin.state is not None:
                self._recording.begin_life(start_ns, begin.state)
        if self._injection is not None:
            # What was heard before had no schedule yet, and nobody to hear it.
            self._receive = self._injection.on_packet
        self._node = self._living(begin)
        if config.mavlink is not None:
            self._reader = AutopilotReader(config.mavlink.settings(list(config.origin)))
            self._mavlink = MavlinkLink(config.mavlink.endpoint, self._reader, self._clock, self.on_event)
            await self._mavlink.start()
            await self._mavlink.reached()
        self._arm()

    def _living(self, begin: Start) -> Node:
        config = self.config
        return Node(
            begin.settings,
            config.network.settings(config.lateness, config.unsafe.settings()),
            boot_id=self._boot_id,
            incarnation=begin.incarnation,
            software=SOFTWARE,
            sensors=config.sensor_configs(),
            recorder=self._recording.record if self._recording is not None else None,
            state=begin.state,
        )

    def _succeed(self, incarnation: int) -> None:
        """Go on in a new life."""
        assert self._node is not None and self._keeper is not None
        before = self._node
        begin = succeed(self.config.settings(self._start_ns), before.agent.saved(), incarnation)
        self._boot_id = secrets.randbits(53)
        self._keeper.succeed(begin)
        if self._recording is not None:
            self._recording.begin_life(self._clock.now_ns(), begin.state)
        self._node = self._living(begin)
        self._node.count_on(before)
        self._node.endpoint.counters["lives_given_up"] += 1
        log.warning("new_life: peers hold the last one to be over; a new one begins, no correlation is kept")

    def _restored(self, start_ns: int) -> Start:
        """How to begin, with the state file if it can be used; the life has begun on disk when this returns."""
        config = self.config
        run_ns = start_ns if config.clock.source == "run" else None
        # A run's clock starts a little after the barrier.
        now_ns, max_age_ns = max(self._clock.now_ns(), start_ns), nanoseconds(config.state.max_age_s)
        settings, first = config.settings(start_ns), config.identity.incarnation
        begin, reason = start(self._found, settings, now_ns, max_age_ns, run_ns, time.time_ns(), first)
        self._keeper = StateKeeper(self._file, begin.incarnation, self.counters)
        self._keeper.begin(begin, reason, self._found.refused)
        return begin

    # -- work -----------------------------------------------------------------------------------------------

    async def _work(self) -> None:
        waits = [asyncio.ensure_future(self._stop.wait())]
        if self._control is not None:
            waits.append(asyncio.ensure_future(self._control.stopped.wait()))
        while not any(wait.done() for wait in waits):
            await asyncio.wait(waits, timeout=STATUS_INTERVAL_S, return_when=asyncio.FIRST_COMPLETED)
            status = self.status()
            # Before the status is told: who has heard it can read all that led to it.
            if self._recording is not None:
                self._recording.flush()
            if self._control is not None:
                self._control.say({"status": status})
            if self._transport is not None:
                self._transport.publish(Channel.STATUS, msgpack.packb(status))
        for wait in waits:
            wait.cancel()

    def on_sensor(self, data: bytes) -> None:
        """A datagram on the sensor socket."""
        if self._node is not None:
            self._take(partial(self._node.on_sensor, self._clock.now_ns(), data))

    def on_event(self, event: Event) -> None:
        """An event of the autopilot's reader."""
        if isinstance(event, ControlReport):
            log.warning("steering: %s", event.refused or "the vehicle obeys")
        if self._node is not None:
            self._take(partial(self._node.on_event, event))

    def _on_packet(self, packet: Packet) -> None:
        if self._node is not None:
            self._take(partial(self._node.on_packet, self._clock.now_ns(), packet))

    def _on_timer(self, now_ns: int) -> None:
        assert self._node is not None
        self._take(partial(self._node.on_tick, now_ns))

    def _take(self, call: Callable[[], Outgoing]) -> None:
        """Let the node take something, carry out what comes of it, and tell it if that took too long."""
        out, overran = self._plans.timed(call)
        self._carry_out(out)
        if overran:
            self.on_event(PlannerOverrun(self._clock.now_ns()))

    def _carry_out(self, out: Outgoing) -> None:
        assert self._transport is not None and self._keeper is not None
        safe = out.persist is None or self._keeper.keep(out.persist)
        for packet in out.packets:
            if safe or packet.channel != Channel.PAIR:
                self._transport.send(packet)
            else:
                self.counters["state.held_back"] += 1
        for alarm in (*out.alarms, *self._troubles()):
            self._publications.warn(alarm)
        if out.steer is not None and self._mavlink is not None:
            self._mavlink.steer(out.steer)
        if out.next_life is not None:
            self._succeed(out.next_life)
        if out.estimates and (estimate := self._publications.estimate(out.estimates[-1])) is not None:
            self._transport.publish(Channel.ESTIMATE, estimate)
        self._arm()

    def _arm(self) -> None:
        """Set the timer to the node's next deadline."""
        assert self._node is not None
        # A run's clock reaches its start some time after the barrier; nothing is said to peers before that.
        self._timer.arm(max(self._node.next_deadline_ns(), self._start_ns))

    def status(self) -> dict[str, Any]:
        """What a person wants to know, as plain values."""
        if self._node is None:
            return {"robot": self.robot, "state": "waiting for the start"}
        status = self._node.status()
        status["state_file"] = dict(self.counters)
        status["troubles"] = {trouble.reason: trouble.detail for trouble in self._troubles()}
        status["silence_max_s"] = {peer.peer: peer.silence_max_ns * 1e-9 for peer in self._node.endpoint.peers()}
        if self._transport is not None:
            status["transport"] = dict(self._transport.counters)
        status["lag_max_s"] = self._timer.lags.max_ns * 1e-9
        injection = self.config.injection
        status["injected"] = injection.links.model_dump(exclude_defaults=True) if injection is not None else {}
        if self._injection is not None and (faults := self._injection.told()):
            status["injected"]["faults"] = faults
        if self._reader is not None:
            status["autopilot"] = self._reader.status()
        return status

    def _troubles(self) -> list[Alarm]:
        """What is wrong on this computer, as long as it is so."""
        found = self._keeper.alarms() if self._keeper is not None else []
        for name, file in (("recording", self._recording), ("fate_log", self._injection)):
            if file is not None and file.failure is not None:
                found.append(Alarm(f"{name}.failed", file.failure))
        return found

    def figures(self) -> dict[str, Any]:
        """What the launcher needs for the summary."""
        assert self._node is not None and self._transport is not None
        agent = self._node.agent
        return {
            "counters": dict(agent.counters),
            "rejected": rejected(self._node),
            "nis": {kind: [entry.total, entry.count] for kind, entry in agent.nis.items()},
            "endpoint": dict(self._node.endpoint.counters),
            "transport": dict(self._transport.counters),
            "autopilot": dict(self._reader.counters) if self._reader is not None else {},
            "lag_max_s": self._timer.lags.max_ns * 1e-9,
            "lags": self._timer.lags.told(),
            "plan_us": self._plans.told(),
        }

    # -- end ------------------------------------------------------------------------------------------------

    async def _close(self) -> None:
        self._timer.cancel()
        if self._hearing is not None:
            self._hearing.cancel()
        figures = self.figures() if self._node is not None else None
        state = self._node.agent.saved() if self._node is not None else None
        self._node = None
        self._receive = _ignore
        if self._mavlink is not None:
            await self._mavlink.close()
        self._sensors.close()
        if self._recording is not None:
            self._recording.close()
        if self._keeper is not None:
            await self._keeper.close(state)
        self._file.release()
        if self._control is not None:
            if figures is not None:
                self._control.say({"done": figures})
            await self._control.close()
        for opened in (self._injection, self._transport):
            if opened is not None:
                with contextlib.suppress(TimeoutError):
                    await opened.close()


def _ignore(packet: Packet) -> None:
    """Takes the packets that still arrive while the shell closes."""
