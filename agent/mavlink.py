"""The asyncio shell of the autopilot's link: sockets, serial line and timers around `agent.autopilot`."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import termios
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from typing import Any

from agent.autopilot import AutopilotReader, Output
from agent.effects import Steer
from agent.fleet_clock import FleetClock
from agent.mavlink_endpoint import Endpoint, MavlinkError, parse_endpoint

MIN_WAIT_S = 0.0005
MAX_WAIT_S = 1.0
FIRST_PAUSE_S, LAST_PAUSE_S = 0.2, 5.0
CONNECT_TIMEOUT_S = 5.0
REACHED_TRIES, REACHED_PAUSE_S = 50, 0.1
ADDRESS_SILENT_S = 5.0
MAX_UNSENT_BYTES = 32_768
READ_BYTES = 4096


class Timer:
    """Calls back at a deadline in fleet time; rearming replaces."""

    def __init__(self, clock: FleetClock, callback: Callable[[], None]) -> None:
        self._clock, self._callback = clock, callback
        self._handle: asyncio.TimerHandle | None = None

    def arm(self, deadline_ns: int) -> None:
        self.cancel()
        wait_s = self._clock.wall_s(deadline_ns - self._clock.now_ns())
        # At most a second, so that a clock that is set is noticed; at least a little, so that nothing spins.
        wait_s = min(max(wait_s, MIN_WAIT_S), MAX_WAIT_S)
        self._handle = asyncio.get_running_loop().call_later(wait_s, self._callback)

    def cancel(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None


class UdpLine(asyncio.DatagramProtocol):
    """Datagrams. `receive` says whether a datagram came from the vehicle; `udpin` learns the address by that."""

    def __init__(
        self, endpoint: Endpoint, receive: Callable[[bytes], bool], counters: Counter[str] | None = None
    ) -> None:
        self._endpoint, self._receive = endpoint, receive
        self._counters = Counter() if counters is None else counters
        # Any: the type stubs leave out the size of the write buffer.
        self._transport: Any = None
        self._peer: Any = None
        self._heard_s = 0.0

    @property
    def connected(self) -> bool:
        return self._transport is not None and (self._endpoint.kind == "udpout" or self._peer is not None)

    async def start(self) -> None:
        """Raises `MavlinkError` when the port is taken or the host is unknown."""
        loop = asyncio.get_running_loop()
        address = (self._endpoint.place, self._endpoint.number)
        key = "local_addr" if self._endpoint.kind == "udpin" else "remote_addr"
        try:
            arguments: dict[str, Any] = {key: address}
            self._transport, _ = await loop.create_datagram_endpoint(lambda: self, **arguments)
        except OSError as error:
            raise MavlinkError(_explain(self._endpoint, error)) from error

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None
            await asyncio.sleep(0)

    def send(self, data: bytes) -> None:
        """One frame, one datagram; dropped and counted while the vehicle's address is not known."""
        if self._transport is None or not self.connected:
            self._counters["link.not_connected"] += 1
        elif self._transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            self._counters["link.send_dropped"] += 1
        else:
            self._transport.sendto(data, self._peer)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        if self._endpoint.kind == "udpout":
            self._receive(data)
            return
        now_s = asyncio.get_running_loop().time()
        if self._peer is not None and addr != self._peer:
            if now_s - self._heard_s < ADDRESS_SILENT_S:
                self._counters["link.other_address"] += 1
                return
            # A vehicle that comes back may do so from another port.
            self._peer = None
        known = self._peer
        if known is None:
            # Known before the datagram is read, so that it can be answered.
            self._peer = addr
        if self._receive(data):
            self._heard_s = now_s
        elif known is None:
            self._peer = None

    def error_received(self, exc: Exception) -> None:
        # Nobody listens at the other end, yet.
        self._counters["link.refused"] += 1


class StreamLine(ABC):
    """A byte stream that is opened again whenever it breaks; subclasses open, write and release it."""

    def __init__(
        self, endpoint: Endpoint, receive: Callable[[bytes], bool], opened: Callable[[], None], counters: Counter[str]
    ) -> None:
        self._endpoint, self._receive, self._opened, self._counters = endpoint, receive, opened, counters
        self._task: asyncio.Task[None] | None = None
        self._lost = asyncio.Event()
        self.connected = False

    async def start(self) -> None:
        self._task = asyncio.create_task(self._run())

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
            self._task = None

    async def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while True:
            self._lost.clear()
            try:
                await self._open()
                self.connected = True
                self._opened()
                pause_s = FIRST_PAUSE_S
                await self._lost.wait()
                self._counters["link.lost"] += 1
            except (OSError, TimeoutError, termios.error):
                self._counters["link.open_failed"] += 1
            finally:
                self.connected = False
                self._release()
            await asyncio.sleep(pause_s)
            pause_s = min(2.0 * pause_s, LAST_PAUSE_S)

    def send(self, data: bytes) -> None:
        """Dropped as a whole, and counted, when the stream is down or does not keep up."""
        if not self.connected:
            self._counters["link.not_connected"] += 1
        elif self._unsent() > MAX_UNSENT_BYTES:
            self._counters["link.send_dropped"] += 1
        else:
            self._write(data)

    @abstractmethod
    async def _open(self) -> None: ...

    @abstractmethod
    def _release(self) -> None: ...

    @abstractmethod
    def _unsent(self) -> int: ...

    @abstractmethod
    def _write(self, data: bytes) -> None: ...


class TcpLine(StreamLine, asyncio.Protocol):
    """A TCP client."""

    _transport: asyncio.Transport | None = None

    async def _open(self) -> None:
        loop = asyncio.get_running_loop()
        connecting = loop.create_connection(lambda: self, self._endpoint.place, self._endpoint.number)
        self._transport, _ = await asyncio.wait_for(connecting, CONNECT_TIMEOUT_S)

    def data_received(self, data: bytes) -> None:
        self._receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._lost.set()

    def _release(self) -> None:
        if self._transport is not None:
            self._transport.abort()
            self._transport = None

    def _unsent(self) -> int:
        return self._transport.get_write_buffer_size() if self._transport is not None else 0

    def _write(self, data: bytes) -> None:
        if self._transport is not None:
            self._transport.write(data)


class SerialLine(StreamLine):
    """A serial device in raw mode, without flow control."""

    _fd: int | None = None
    _outbox = bytearray()

    async def _open(self) -> None:
        self._outbox = bytearray()
        self._fd = os.open(self._endpoint.place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        _make_raw(self._fd, self._endpoint.number)
        asyncio.get_running_loop().add_reader(self._fd, self._readable)

    def _readable(self) -> None:
        assert self._fd is not None
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._receive(data)
        else:
            self._release()
            self._lost.set()

    def _release(self) -> None:
        if self._fd is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._fd)
            loop.remove_writer(self._fd)
            os.close(self._fd)
            self._fd = None

    def _unsent(self) -> int:
        return len(self._outbox)

    def _write(self, data: bytes) -> None:
        self._outbox += data
        self._writable()

    def _writable(self) -> None:
        if self._fd is None:
            return
        try:
            del self._outbox[: os.write(self._fd, self._outbox)]
        except BlockingIOError:
            pass
        except OSError:
            self._release()
            self._lost.set()
            return
        loop = asyncio.get_running_loop()
        if self._outbox:
            loop.add_writer(self._fd, self._writable)
        else:
            loop.remove_writer(self._fd)


def _make_raw(fd: int, baud: int) -> None:
    """8 data bits, no parity, one stop bit; no echo, no translation, no flow control (cfmakeraw)."""
    speed = getattr(termios, f"B{baud}")
    _, _, cflag, _, _, _, control = termios.tcgetattr(fd)
    cflag &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB | getattr(termios, "CRTSCTS", 0))
    cflag |= termios.CS8 | termios.CREAD | termios.CLOCAL
    control[termios.VMIN], control[termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, [0, 0, cflag, 0, speed, speed, control])
    termios.tcflush(fd, termios.TCIFLUSH)


def _explain(endpoint: Endpoint, error: OSError) -> str:
    where = f"MAVLink endpoint '{endpoint.text}'"
    if error.errno == errno.EADDRINUSE:
        return f"{where}: the port is already in use; stop the other program or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"{where}: '{endpoint.place}' is not an address of this computer"
    return f"{where} cannot be opened: {error.strerror or error.__class__.__name__}"


class MavlinkLink:
    """Feeds a reader from an endpoint, hands its events to `emit`, and sends what it wants to say."""

    def __init__(
        self, endpoint: str, reader: AutopilotReader, clock: FleetClock, emit: Callable[[Output], None]
    ) -> None:
        """Raises `MavlinkEndpointError` (a ValueError) for a wrong endpoint."""
        self._endpoint = parse_endpoint(endpoint)
        self._reader, self._clock, self._emit = reader, clock, emit
        self._timer = Timer(clock, self._serve)
        self._line: UdpLine | StreamLine
        match self._endpoint.kind:
            case "tcp":
                self._line = TcpLine(self._endpoint, self._on_stream, self._on_opened, reader.counters)
            case "serial":
                self._line = SerialLine(self._endpoint, self._on_stream, self._on_opened, reader.counters)
            case _:
                self._line = UdpLine(self._endpoint, self._on_datagram, reader.counters)

    @property
    def connected(self) -> bool:
        """Whether there is somebody to speak to."""
        return self._line.connected

    async def start(self) -> None:
        """Open the link. Raises `MavlinkError` for a socket; streams are retried in the background instead."""
        await self._line.start()
        self._serve()

    async def reached(self) -> None:
        """A stream must be there at the start, for a wrong address must not go unnoticed; later it is redialled.

        Raises `MavlinkError` if it is not.
        """
        if self._endpoint.kind in ("udpin", "udpout"):
            return
        for _ in range(REACHED_TRIES):
            if self.connected:
                return
            await asyncio.sleep(REACHED_PAUSE_S)
        text = self._endpoint.text
        raise MavlinkError(f"mavlink.endpoint {text}: nothing answers; start the autopilot or correct the endpoint")

    async def close(self) -> None:
        """A vehicle that is steered is told to stand still first."""
        self._timer.cancel()
        for frame in self._reader.parting(self._clock.now_ns()):
            self._line.send(frame)
        await self._line.close()

    def steer(self, steer: Steer) -> None:
        """Have the vehicle move so from now on."""
        self._reader.steer(steer)
        self._serve()

    def _on_opened(self) -> None:
        self._reader.new_stream()
        self._serve()

    def _on_datagram(self, data: bytes) -> bool:
        return self._taken(self._reader.datagram, data)

    def _on_stream(self, data: bytes) -> bool:
        return self._taken(self._reader.stream, data)

    def _taken(self, take: Callable[[int, bytes], list[Output]], data: bytes) -> bool:
        """True when the data came from the vehicle."""
        before = self._reader.messages
        for event in take(self._clock.now_ns(), data):
            self._emit(event)
        if self._reader.messages == before:
            return False
        self._serve()
        return True

    def _serve(self) -> None:
        """Send what is due, and set the timer. Nothing is asked of the reader while nobody hears it."""
        now_ns = self._clock.now_ns()
        if not self._line.connected:
            self._timer.arm(now_ns + int(1e9 * self._clock.speed))
            return
        for frame in self._reader.outgoing(now_ns):
            self._line.send(frame)
        for report in self._reader.reports(now_ns):
            self._emit(report)
        self._timer.arm(self._reader.next_deadline_ns())
