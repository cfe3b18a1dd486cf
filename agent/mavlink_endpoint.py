"""Where an autopilot is reached, in MAVLink's usual notation.

    udpin:HOST:PORT    listen; the vehicle's address is learnt from its first HEARTBEAT, all others are ignored
    udpout:HOST:PORT   send to HOST:PORT and hear only it
    tcp:HOST:PORT      connect, again and again with growing pauses
    serial:DEVICE:BAUD open a serial line, likewise
"""

from __future__ import annotations

import termios
from dataclasses import dataclass

FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class MavlinkError(Exception):
    """The link cannot be opened; one line that says what to change."""


class MavlinkEndpointError(MavlinkError, ValueError):
    """The text of an endpoint is wrong."""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed endpoint: `number` is a port, or the baud rate of a serial line."""

    text: str
    kind: str
    place: str
    number: int

    @property
    def is_loopback(self) -> bool:
        """Whether the other end can only be on this computer."""
        return self.kind != "serial" and (self.place in ("localhost", "::1") or self.place.startswith("127."))


def parse_endpoint(text: str) -> Endpoint:
    """Raises `MavlinkEndpointError` (a ValueError) that names the text and the valid forms."""
    kind, _, rest = text.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not place or not (number.isascii() and number.isdigit()):
        raise MavlinkEndpointError(f"MAVLink endpoint '{text}' is not one of {FORMS}")
    value = int(number)
    if kind == "serial":
        if not hasattr(termios, f"B{value}") or value == 0:
            raise MavlinkEndpointError(f"MAVLink endpoint '{text}': {value} is not a baud rate of this system")
    elif not 0 < value < 65536:
        raise MavlinkEndpointError(f"MAVLink endpoint '{text}': the port must be from 1 to 65535")
    return Endpoint(text, kind, place.strip("[]"), value)
