"""The autopilot's boot clock in fleet time, from MAVLink TIMESYNC round trips.

A request carries the own clock (ts1, tc1 = 0); the answer mirrors it and adds the autopilot's time since boot (tc1).
Of the recent answers the one with the shortest round trip is believed; its error is at most half that round trip
(the rule of NTP's clock filter, RFC 5905 section 10). A boot clock that runs backwards is a reboot; answers that
disagree by more than their error bounds, several times running, are a step of the own clock.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

MS = 1_000_000
BOOT_MS_WRAP = 1 << 32
MAX_BOOT_NS = 1 << 60
UNIX_USEC = 10**15
"""A `time_usec` from here on is microseconds since 1970, below it since boot (common.xml)."""


@dataclass(frozen=True, slots=True)
class TimeSyncSettings:
    """All times in ns of fleet time."""

    samples: int = 64
    converged_samples: int = 10
    fast_interval_ns: int = 100 * MS
    slow_interval_ns: int = 1000 * MS
    request_timeout_ns: int = 2000 * MS
    reboot_step_ns: int = 1000 * MS
    future_ns: int = 1000 * MS
    max_age_ns: int = 10_000 * MS
    drift_slack_ns: int = 5 * MS
    disagreements: int = 5


@dataclass(frozen=True, slots=True)
class Sample:
    """One round trip: fleet time = boot time + offset_ns, within rtt_ns / 2."""

    rtt_ns: int
    offset_ns: int


class TimeSync:
    """Requests, answers and stamps; `epoch` grows with every reboot or step, and nothing may span two epochs."""

    def __init__(self, settings: TimeSyncSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._samples: deque[Sample] = deque(maxlen=settings.samples)
        self._outstanding: deque[int] = deque(maxlen=32)
        self._best: Sample | None = None
        self._latest_boot_ns = 0
        self._disagreed = 0
        self.epoch = 0
        self.next_request_ns = 0

    @property
    def best(self) -> Sample | None:
        """The sample in use; None before the first answer."""
        return self._best

    @property
    def samples(self) -> int:
        return len(self._samples)

    def request(self, now_ns: int) -> int:
        """Begin a round trip: the ts1 to send. The first interval is short until the offset is settled."""
        settings = self._settings
        settled = len(self._samples) >= settings.converged_samples and self._disagreed == 0
        self.next_request_ns = now_ns + (settings.slow_interval_ns if settled else settings.fast_interval_ns)
        self._outstanding.append(now_ns)
        return now_ns

    def answer(self, now_ns: int, tc1_ns: int, ts1_ns: int) -> None:
        """The autopilot's answer to the request `ts1_ns`."""
        if ts1_ns not in self._outstanding:
            self._counters["mavlink.timesync_unmatched"] += 1
            return
        self._outstanding.remove(ts1_ns)
        rtt = now_ns - ts1_ns
        if not 0 <= rtt <= self._settings.request_timeout_ns or not 0 < tc1_ns < MAX_BOOT_NS:
            self._counters["mavlink.timesync_bad"] += 1
            return
        if tc1_ns < self._latest_boot_ns - self._settings.reboot_step_ns:
            self._forget("mavlink.reboot")
        sample = Sample(rtt, ts1_ns + rtt // 2 - tc1_ns)
        if self._best is not None and self._disagrees(sample, self._best):
            self._counters["mavlink.timesync_disagrees"] += 1
            self._disagreed += 1
            if self._disagreed < self._settings.disagreements:
                return
            self._forget("mavlink.clock_step")
        self._disagreed = 0
        self._latest_boot_ns = max(self._latest_boot_ns, tc1_ns)
        self._samples.append(sample)
        self._best = min(self._samples, key=lambda item: item.rtt_ns)

    def _disagrees(self, sample: Sample, best: Sample) -> bool:
        bound = (sample.rtt_ns + best.rtt_ns) // 2 + self._settings.drift_slack_ns
        return abs(sample.offset_ns - best.offset_ns) > bound

    def stamp(self, now_ns: int, boot_ns: int) -> int | None:
        """Fleet time of an instant of the boot clock; None, counted, when it is unknown or implausible."""
        if self._best is None:
            self._counters["mavlink.no_timesync"] += 1
            return None
        fleet_ns = boot_ns + self._best.offset_ns
        if fleet_ns > now_ns + self._settings.future_ns:
            self._counters["mavlink.stamp_future"] += 1
            return None
        if boot_ns < self._latest_boot_ns - self._settings.reboot_step_ns:
            self._forget("mavlink.reboot")
            return None
        self._latest_boot_ns = max(self._latest_boot_ns, boot_ns)
        if fleet_ns < now_ns - self._settings.max_age_ns:
            self._counters["mavlink.stamp_old"] += 1
            return None
        return fleet_ns

    def boot_ms(self, now_ns: int, time_boot_ms: int) -> int:
        """`time_boot_ms` in ns since boot, its wrap after 49.7 days undone."""
        wraps = 0
        if self._best is not None:
            expected_ms = (now_ns - self._best.offset_ns) // MS
            wraps = max(0, round((expected_ms - time_boot_ms) / BOOT_MS_WRAP))
        return (time_boot_ms + wraps * BOOT_MS_WRAP) * MS

    def boot_usec(self, time_usec: int) -> int | None:
        """`time_usec` in ns since boot; None, counted, when it counts from 1970."""
        if time_usec >= UNIX_USEC:
            self._counters["mavlink.unix_time"] += 1
            return None
        return time_usec * 1000

    def step(self) -> None:
        """The own clock was set: nothing known of the offset holds any longer."""
        self._forget("mavlink.clock_step")

    def _forget(self, reason: str) -> None:
        self._counters[reason] += 1
        self.epoch += 1
        self._samples.clear()
        self._outstanding.clear()
        self._best = None
        self._latest_boot_ns = 0
        self._disagreed = 0
        self.next_request_ns = 0
