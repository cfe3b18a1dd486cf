#!/usr/bin/env python3
"""A sensor driver to copy: UWB ranges, a line each, to a robot's local sensor socket.

    python uwb_driver.py /var/lib/cofix/r1/sensors.sock --device /dev/ttyUSB0
    other_program | python uwb_driver.py /var/lib/cofix/r1/sensors.sock
    python uwb_driver.py /var/lib/cofix/r1/sensors.sock --simulate r2 --count 100

A line is `t_ns,peer,range_m`: the instant of the measurement in nanoseconds since the Unix epoch (left empty: when the
line arrives), a robot's id or `landmark:ID` for an anchor, and the distance in metres. Empty lines and lines that start
with `#` are skipped. Needs nothing of cofix: Python and the package msgpack.

Exit status: 0 at the end of the lines, 1 if not one measurement could be delivered, 2 wrong use.
"""

from __future__ import annotations

import argparse
import errno
import math
import os
import random
import re
import select
import signal
import socket
import sys
import termios
import time
import tty
from collections.abc import Iterator

import msgpack

SUBJECT = re.compile(r"(?:landmark:[A-Za-z0-9_.-]{1,32}|target:[a-z0-9-]{1,24}|[a-z0-9-]{1,24})\Z")
BUSY_S = 0.1
MAX_LINE = 200


class DriverError(Exception):
    """Something the user has to change; the message is one line that says what."""


def measurement(line: str, sigma_m: float, sensor: str, now_ns: int) -> bytes:
    """The datagram for one line. Raises `ValueError` for a line that is not a measurement."""
    stamp, peer, distance = (part.strip() for part in line.split(","))
    t_ns = int(stamp) if stamp else now_ns
    range_m = float(distance)
    if not SUBJECT.match(peer) or t_ns < 0 or not 0.0 <= range_m < math.inf:
        raise ValueError(line)
    data: dict[str, object] = {"t_ns": t_ns, "kind": "range", "of": peer, "z": [range_m], "R": [[sigma_m**2]]}
    if sensor:
        data["sensor"] = sensor
    packed: bytes = msgpack.packb(data)
    return packed


class SensorSocket:
    """The way into the agent. It may be restarted at any time: then the socket is another one of the same name."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._socket: socket.socket | None = None
        self._connect()

    def send(self, datagram: bytes) -> bool:
        """Whether the agent was handed the datagram. A full queue or an agent that is away costs this one only."""
        try:
            if self._socket is None:
                self._connect()
            assert self._socket is not None
            self._socket.send(datagram)
        except (OSError, DriverError):
            self.close()
            return False
        return True

    def _connect(self) -> None:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        connection.settimeout(BUSY_S)
        try:
            connection.connect(self._path)
        except OSError as error:
            connection.close()
            raise DriverError(f"{self._path}: {self._remedy(error)}") from None
        self._socket = connection

    @staticmethod
    def _remedy(error: OSError) -> str:
        if error.errno == errno.ENOENT:
            return "no such socket; start the agent, or name sensors.sock in its state_dir"
        if error.errno == errno.ECONNREFUSED:
            return "nobody listens; start the agent"
        if error.errno == errno.EACCES:
            return "not permitted; run the driver as the user of the agent"
        if error.errno in (errno.ENOTSOCK, errno.EPROTOTYPE):
            return "not a datagram socket; name sensors.sock in the agent's state_dir"
        return error.strerror or "cannot be opened"

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


# --- where lines come from ---------------------------------------------------------------------------------


def serial_lines(device: str, baud: int) -> Iterator[str]:
    """Lines of a serial device until it is gone."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise DriverError(f"--baud {baud}: not a speed this computer knows; 115200 is usual")
    try:
        port = os.open(device, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise DriverError(f"--device {device}: {error.strerror}") from None
    try:
        try:
            tty.setraw(port)
            settings = termios.tcgetattr(port)
            settings[4] = settings[5] = speed
            termios.tcsetattr(port, termios.TCSANOW, settings)
        except termios.error:
            raise DriverError(f"--device {device}: not a serial device") from None
        rest = b""
        while True:
            select.select([port], [], [])
            try:
                data = os.read(port, 4096)
            except BlockingIOError:
                continue
            except OSError:
                return
            if not data:
                return
            *lines, rest = (rest + data).split(b"\n")
            rest = rest[-MAX_LINE:]
            for line in lines:
                yield line.decode("ascii", "replace")
    finally:
        os.close(port)


def simulated_lines(peer: str, count: int | None, rate_hz: float, sigma_m: float) -> Iterator[str]:
    """Ranges of somebody who comes and goes, between 3 and 7 m."""
    start = time.monotonic()
    number = 0
    while count is None or number < count:
        time.sleep(max(0.0, start + number / rate_hz - time.monotonic()))
        true_m = 5.0 + 2.0 * math.sin(0.2 * (time.monotonic() - start))
        yield f"{time.time_ns()},{peer},{max(0.0, random.gauss(true_m, sigma_m)):.3f}"
        number += 1


# --- the command line --------------------------------------------------------------------------------------


def drive(options: argparse.Namespace) -> int:
    """Hand on line after line; exit status."""
    if options.device is not None:
        lines: Iterator[str] = serial_lines(options.device, options.baud)
    elif options.simulate is not None:
        lines = simulated_lines(options.simulate, options.count, options.rate_hz, options.sigma_m)
    else:
        lines = iter(sys.stdin)
    way_in = SensorSocket(options.socket)
    sent = missed = refused = 0
    try:
        for line in lines:
            text = line.strip()
            if not text or text.startswith("#"):
                continue
            try:
                datagram = measurement(text, options.sigma_m, options.sensor, time.time_ns())
            except (ValueError, OverflowError):
                refused += 1
                continue
            if way_in.send(datagram):
                sent += 1
            else:
                missed += 1
    except KeyboardInterrupt:
        pass
    finally:
        way_in.close()
    print(f"uwb_driver: {sent} measurements sent", file=sys.stderr)
    if missed:
        print(f"uwb_driver: {missed} not delivered: the agent was away or too busy", file=sys.stderr)
    if refused:
        print(f"uwb_driver: {refused} lines were not t_ns,peer,range_m", file=sys.stderr)
    return 1 if (missed or refused) and not sent else 0


def positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"must be above zero, not {text}")
    return value


def main() -> int:
    parser = argparse.ArgumentParser(description="UWB ranges to a robot's local sensor socket.")
    parser.add_argument("socket", help="sensors.sock in the agent's state_dir")
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--device", help="read a serial device instead of standard input")
    source.add_argument("--simulate", metavar="PEER", help="make up ranges to PEER")
    parser.add_argument("--baud", type=int, default=115200, help="of the device (default 115200)")
    parser.add_argument("--count", type=int, help="stop after so many made-up ranges")
    parser.add_argument("--rate-hz", type=positive, default=10.0, help="of made-up ranges (default 10)")
    parser.add_argument("--sigma-m", type=positive, default=0.1, help="standard deviation of a range (default 0.1)")
    parser.add_argument("--sensor", default="", help="the sensor's name in the agent's configuration, for its mount")
    options = parser.parse_args()
    if options.simulate is not None and not SUBJECT.match(options.simulate):
        parser.error(f"--simulate {options.simulate}: not a robot's id or landmark:ID")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return drive(options)
    except DriverError as error:
        print(f"uwb_driver: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
