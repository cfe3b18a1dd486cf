"""How late timers are, over a whole run, in little memory."""

from __future__ import annotations

from collections import Counter

BIN_NS = 1_000_000
LAST_BIN = 60_000


class LatenessFigures:
    """The largest lag and its percentiles, to the millisecond."""

    def __init__(self) -> None:
        self.max_ns = 0
        self._bins: Counter[int] = Counter()

    def add(self, lag_ns: int) -> None:
        """Count one timer that came `lag_ns` late; early ones count as on time."""
        lag_ns = max(lag_ns, 0)
        self.max_ns = max(self.max_ns, lag_ns)
        self._bins[min(lag_ns // BIN_NS, LAST_BIN)] += 1

    def told(self) -> list[list[int]]:
        """The figures as plain numbers: [[bin, count], ...]; see `heard`."""
        return [[index, count] for index, count in sorted(self._bins.items())]

    def heard(self, max_ns: int, told: list[list[int]]) -> None:
        """Add the figures of another process."""
        self.max_ns = max(self.max_ns, max_ns)
        for index, count in told:
            self._bins[index] += count

    def percentile_ns(self, share: float) -> int:
        """The lag that `share` of all timers do not exceed, rounded up to a millisecond; 0 without timers."""
        left = share * self._bins.total()
        for index in sorted(self._bins):
            left -= self._bins[index]
            if left <= 0.0:
                return min((index + 1) * BIN_NS, self.max_ns)
        return self.max_ns
