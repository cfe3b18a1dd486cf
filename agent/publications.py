"""What an agent tells people while it runs: estimates for displays, at a bounded rate, and alarms in its log."""

from __future__ import annotations

import logging
import time

import msgpack

from agent.effects import Alarm, Estimate

log = logging.getLogger("cofix.agent")

PUBLISH_INTERVAL_S = 0.1
ALARM_INTERVAL_S = 60.0


class Publications:
    """Keeps estimates and equal alarms apart by their intervals of wall time."""

    def __init__(self) -> None:
        self._published_s = 0.0
        self._warned_s: dict[Alarm, float] = {}

    def estimate(self, estimate: Estimate) -> bytes | None:
        """The bytes for the `estimate` key; None while the last one is too recent."""
        wall = time.monotonic()
        if wall - self._published_s < PUBLISH_INTERVAL_S:
            return None
        self._published_s = wall
        return estimate_bytes(estimate)

    def warn(self, alarm: Alarm) -> None:
        """Log an alarm, an equal one once per window."""
        wall = time.monotonic()
        if wall - self._warned_s.get(alarm, -ALARM_INTERVAL_S) >= ALARM_INTERVAL_S:
            self._warned_s = {known: at for known, at in self._warned_s.items() if wall - at < ALARM_INTERVAL_S}
            self._warned_s[alarm] = wall
            log.warning("%s", f"{alarm.reason}: {alarm.detail}" if alarm.detail else alarm.reason)


def estimate_bytes(estimate: Estimate) -> bytes:
    """An estimate for the `estimate` key: msgpack, arrays as lists."""
    data: bytes = msgpack.packb(
        {
            "t_ns": estimate.t_ns,
            "model": estimate.model,
            "mean": estimate.mean.tolist(),
            "cov": estimate.cov.tolist(),
            "tracks": {track.target: [track.mean.tolist(), track.cov.tolist()] for track in estimate.tracks},
            "relatives": {
                found.peer: {
                    "t_ns": found.t_ns,
                    "mean": found.mean.tolist(),
                    "cov": found.cov.tolist(),
                    "weight": float(found.weight),
                    "ambiguity": float(found.ambiguity),
                    "tracks": int(found.tracks),
                    "confirmed": bool(found.confirmed),
                }
                for found in estimate.relatives
            },
        }
    )
    return data
