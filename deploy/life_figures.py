"""What an agent says of itself at the end of each of its lives, as one."""

from __future__ import annotations

from collections import Counter
from typing import Any


def summed(lives: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of an agent over its lives: counts add up, the largest lag counts."""
    total = dict(lives[0])
    for figures in lives[1:]:
        for key in ("counters", "rejected", "endpoint", "transport", "autopilot"):
            total[key] = dict(Counter(total[key]) + Counter(figures[key]))
        nis = {kind: list(entry) for kind, entry in total["nis"].items()}
        for kind, (value, count) in figures["nis"].items():
            entry = nis.setdefault(kind, [0.0, 0])
            entry[0], entry[1] = entry[0] + value, entry[1] + count
        total["nis"] = nis
        total["lag_max_s"] = max(total["lag_max_s"], figures["lag_max_s"])
        for key in ("lags", "plan_us"):
            total[key] = total[key] + figures[key]
    return total
