"""A peer's clock against our own, from four-stamp exchanges as in NTP (RFC 5905, section 8).

The offset found from one exchange is wrong by at most half its round trip, whatever the asymmetry of the
link; so the shortest round trip of the last few is the best witness, less so as it ages.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

KEPT_EXCHANGES = 16
DRIFT_PPM = 50
"""How fast two crystal clocks may part; an exchange's error grows by this with its age."""

MANY_STEPS = 3
STEPS_WITHIN_NS = 60 * 10**9
"""A clock that is set so often is of no use to anybody."""

STEP_NS = 10_000_000
"""Less than that is a crystal that drifts by more than it should."""

SLACK_NS, FAR = 50_000_000, 5.0
"""Offsets up to that many deviations, and this on top, contradict nobody."""

MAX_SPAN_NS = 60 * 10**9
"""An exchange that took longer says nothing."""


@dataclass(frozen=True, slots=True)
class _Exchange:
    offset_ns: int
    round_trip_ns: int
    t1_ns: int

    def error_ns(self, now_ns: int) -> float:
        age_ns = max(0, now_ns - self.t1_ns)
        return self.round_trip_ns / 2 + age_ns * DRIFT_PPM * 1e-6


class PeerClock:
    """Offset (peer's clock minus our own) with its uncertainty."""

    def __init__(self) -> None:
        self._exchanges: deque[_Exchange] = deque(maxlen=KEPT_EXCHANGES)
        self._best: _Exchange | None = None
        self._latest_ns = 0
        self._step_ns: deque[int] = deque(maxlen=MANY_STEPS)
        self.steps = 0
        """How often an exchange contradicted all before it, which only a clock that was set can do."""

    def add(self, t1_ns: int, t2_ns: int, t3_ns: int, t4_ns: int) -> bool:
        """Take one exchange: we sent at t1, the peer received at t2 and sent at t3, we received at t4.

        t1 and t4 are of our clock, t2 and t3 of the peer's. Returns False, and keeps nothing, if they cannot
        be one exchange: negative stamps or times, or longer than MAX_SPAN_NS.
        """
        round_trip_ns = (t4_ns - t1_ns) - (t3_ns - t2_ns)
        if min(t1_ns, t2_ns) < 0 or t3_ns < t2_ns or round_trip_ns < 0 or t4_ns - t1_ns > MAX_SPAN_NS:
            return False
        exchange = _Exchange(((t2_ns - t1_ns) + (t3_ns - t4_ns)) // 2, round_trip_ns, t1_ns)
        best = self._best
        if best is not None:
            # Both errors are bounds: offsets further apart than their sum are of two different clocks.
            apart_ns = abs(exchange.offset_ns - best.offset_ns)
            if apart_ns > exchange.error_ns(t4_ns) + best.error_ns(t4_ns) + 1:
                self._exchanges.clear()
                self.steps += 1
                if apart_ns > STEP_NS:
                    self._step_ns.append(t4_ns)
        self._exchanges.append(exchange)
        # Errors grow alike with time, so that which one is the least does not change with it.
        self._best = min(self._exchanges, key=lambda known: known.error_ns(t4_ns))
        self._latest_ns = t4_ns
        return True

    def at(self, now_ns: int) -> tuple[int, int] | None:
        """(offset, standard deviation) [ns] as known at `now_ns` of our clock; None before an exchange.

        The deviation is that of an error spread evenly over its bound.
        """
        best = self._best
        if best is None:
            return None
        return best.offset_ns, math.ceil(best.error_ns(now_ns) / math.sqrt(3))

    def unusable(self, now_ns: int, prior_ns: int, most_ns: int) -> str | None:
        """Why nothing of the peer's stamps can be made use of at `now_ns`, or None.

        steps      the clock was set `MANY_STEPS` times within `STEPS_WITHIN_NS`
        offset     it is off by far more than `prior_ns`, how well the fleet's clocks agree (1 sigma), allows
        uncertain  what is measured of it and the prior leave a deviation above `most_ns`
        """
        known = self.at(now_ns)
        if known is None:
            return None
        offset_ns, sigma_ns = known
        if len(self._step_ns) == MANY_STEPS and now_ns - self._step_ns[0] < STEPS_WITHIN_NS:
            return "steps"
        if abs(offset_ns) > SLACK_NS + FAR * math.hypot(prior_ns, sigma_ns):
            return "offset"
        if prior_ns and prior_ns * sigma_ns > most_ns * math.hypot(prior_ns, sigma_ns):
            return "uncertain"
        return None

    @property
    def offset_ns(self) -> int | None:
        """Offset at the latest exchange, None before the first."""
        known = self.at(self._latest_ns)
        return None if known is None else known[0]

    @property
    def sigma_ns(self) -> int | None:
        """Standard deviation of the offset at the latest exchange, None before the first."""
        known = self.at(self._latest_ns)
        return None if known is None else known[1]
