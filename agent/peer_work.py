"""How much work a peer may cause: a request for an instant of the past has all that came after it done again.

Each peer has an allowance, in seconds of the past. A request takes what lies between its instant and now, and a little
for itself; time refills the allowance. Sensors that measure a peer fifty times a second stay within it, ten times a
second even if every message is late by a second and more, and so does all that a clogged link delivers at once. What
is beyond is not answered, as if it had been lost.
"""

from __future__ import annotations

from dataclasses import dataclass

from agent.peer_tables import remember
from agent.settings import NS

PER_S = 20.0
"""Seconds of the past that a peer may have done again in each second."""

MOST = 256.0
"""What may be left over of the past: fifty requests for instants five seconds ago."""

EACH = 0.1
"""What a request takes besides, however new it is."""


@dataclass(slots=True)
class _Left:
    seconds: float
    t_ns: int


class PeerWork:
    """The allowances of all peers, by their ids; those asked by longest ago are forgotten first."""

    def __init__(self) -> None:
        self._left: dict[str, _Left] = {}

    def allowed(self, peer: str, now_ns: int, t_ns: int) -> bool:
        """Whether a peer may ask for the instant `t_ns` now; what that takes is gone then."""
        left = self._left.get(peer) or _Left(MOST, now_ns)
        seconds = min(MOST, left.seconds + PER_S * (now_ns - left.t_ns) / NS)
        takes = EACH + max(now_ns - t_ns, 0) / NS
        found = takes <= seconds
        remember(self._left, peer, _Left(seconds - takes if found else seconds, now_ns))
        return found
