"""Which contacts of which peers may be used, judged by their innovations: a peer that is wrong is quarantined, and
re-admitted when it is right again.

What is looked at is the normalized innovation squared (NIS) per degree of freedom of a contact's relative
measurements, before any cap. A contact above `gate_nis` is not used, whoever it is with. Of each peer's last `window`
contacts the NIS are summed, each counted as `gate_nis` at most, so that no few outliers decide; at `window *
suspect_nis` the peer is quarantined, after four contacts at least by default. For independent innovations of one degree
of freedom the sum is chi-squared with `window` degrees of freedom, or less: with 8 and 6.0 a contact gives a false
alarm with probability 1e-7. Innovations of a pair that share one error are not independent; at worst, all of them the
same, it is that of one normal variable beyond sqrt(6) sigmas, 1.4e-2 for each such error.

A quarantined peer's contacts are exchanged and evaluated as before, but not used. It is re-admitted after
`readmit_after` contacts in a row none of which exceeds `suspect_nis` and whose mean is half of that at most.

If all peers look wrong, and there are two of them at least, the robot is more likely wrong itself. What its own sensors
have measured is not used then. What peers have measured of it is: it is its own belief that has to give way.

Verdicts are kept across starts with the rest of the state.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

from agent.effects import Alarm
from agent.settings import HealthSettings
from network.peers import MAX_PEERS


@dataclass(frozen=True, slots=True)
class SavedVerdict:
    """What is known of a peer: NIS of its last contacts as they count, and since quarantine began, of consistent ones.

    `since_ns`: instant of the contact that led to the present verdict; None: there has been no other. `nis`: the mean
    that led to the quarantine.
    """

    recent: tuple[float, ...] = ()
    good: tuple[float, ...] = ()
    quarantined: bool = False
    since_ns: int | None = None
    nis: float = 0.0


@dataclass(slots=True)
class _Record:
    recent: deque[float]
    good: deque[float]
    quarantined: bool = False
    since_ns: int | None = None
    nis: float = 0.0
    refusing: bool = field(default=False)


class Health:
    """Verdicts on all peers of one robot, by their ids: of `MAX_PEERS` at most, quarantined ones are forgotten last."""

    def __init__(
        self, settings: HealthSettings, counters: Counter[str], saved: dict[str, SavedVerdict] | None = None
    ) -> None:
        """`saved`: what an earlier life has found out."""
        self._settings, self._counters = settings, counters
        self._records: dict[str, _Record] = {}
        self._alarms: list[Alarm] = []
        for peer, verdict in (saved or {}).items():
            record = self._record(peer)
            record.recent.extend(verdict.recent)
            record.good.extend(verdict.good)
            record.quarantined, record.since_ns, record.nis = verdict.quarantined, verdict.since_ns, verdict.nis

    def _record(self, peer: str) -> _Record:
        if peer not in self._records:
            settings = self._settings
            if len(self._records) >= MAX_PEERS:
                trusted = (name for name, record in self._records.items() if not record.quarantined)
                del self._records[next(trusted, next(iter(self._records)))]
            self._records[peer] = _Record(deque(maxlen=settings.window), deque(maxlen=settings.readmit_after))
        return self._records[peer]

    def usable(self, peer: str, t_ns: int, nis: float, own_observed: bool) -> bool:
        """Count a contact of the instant `t_ns` with its NIS per degree of freedom; whether it may be used.

        `own_observed`: the own sensor measured the peer, not the other way round.
        """
        settings = self._settings
        if not settings.enabled:
            return True
        record = self._record(peer)
        record.recent.append(min(nis, settings.gate_nis))
        if record.quarantined:
            self._reconsider(peer, record, t_ns, nis)
        elif sum(record.recent) >= settings.window * settings.suspect_nis:
            record.quarantined, record.since_ns = True, t_ns
            record.nis = sum(record.recent) / len(record.recent)
            record.good.clear()
            self._counters["health.quarantined"] += 1
            self._alarms.append(Alarm("peer_quarantined", f"{peer}: {self._reason(record)}; {self._until(record)}"))
        if self.own_suspect and not own_observed:
            return True
        if record.quarantined:
            self._counters["pair.quarantined"] += 1
        elif nis > settings.gate_nis:
            self._counters["pair.gated"] += 1
        else:
            return True
        return False

    def _reconsider(self, peer: str, record: _Record, t_ns: int, nis: float) -> None:
        if nis > self._settings.suspect_nis:
            record.good.clear()
            return
        record.good.append(nis)
        enough = len(record.good) == self._settings.readmit_after
        if enough and sum(record.good) <= len(record.good) * self._settings.suspect_nis / 2.0:
            record.quarantined, record.since_ns = False, t_ns
            record.recent.clear()
            record.good.clear()
            self._counters["health.readmitted"] += 1
            self._alarms.append(Alarm("peer_readmitted", peer))

    def answered(self, peer: str, inconsistent: bool) -> None:
        """A peer has answered an own contact; whether it said that it is inconsistent with what it knows."""
        if inconsistent or peer in self._records:
            self._record(peer).refusing = inconsistent

    def trusts(self, peer: str) -> bool:
        """Whether a peer is not quarantined; nobody is where there are no verdicts."""
        return not self._settings.enabled or peer not in self._records or not self._records[peer].quarantined

    @property
    def own_suspect(self) -> bool:
        """Whether all peers met often enough look wrong, two at least."""
        met = [r for r in self._records.values() if r.quarantined or 2 * len(r.recent) >= self._settings.window]
        return len(met) > 1 and all(record.quarantined for record in met)

    def alarms(self) -> list[Alarm]:
        """What has been decided since the last call."""
        found, self._alarms = self._alarms, []
        return found

    def saved(self) -> dict[str, SavedVerdict]:
        """What the next life must know."""
        return {
            peer: SavedVerdict(tuple(r.recent), tuple(r.good), r.quarantined, r.since_ns, r.nis)
            for peer, r in self._records.items()
        }

    def status(self, now_ns: int) -> dict[str, object]:
        """A plain summary for people; `nis` is the mean of the last contacts, each as it is counted.

        `reasons` says in words whose contacts are not used, why and until when.
        """
        peers: dict[str, dict[str, object]] = {}
        for peer, record in self._records.items():
            peers[peer] = {
                "verdict": "quarantined" if record.quarantined else "trusted",
                "nis": sum(record.recent) / max(len(record.recent), 1),
                "contacts": len(record.recent),
                "since_ns": record.since_ns,
            }
            if record.quarantined:
                peers[peer] |= {"reason": self._reason(record), "until": self._until(record)}
        return {"own_sensor_suspect": self.own_suspect, "peers": peers, "reasons": self._reasons(now_ns)}

    def _reasons(self, now_ns: int) -> list[str]:
        found = []
        if self.own_suspect:
            found.append("all peers contradict this robot: its own sensor or belief is wrong, and gives way to theirs")
        for peer, record in self._records.items():
            if record.quarantined:
                for_s = (now_ns - (now_ns if record.since_ns is None else record.since_ns)) * 1e-9
                found.append(f"{peer} is quarantined for {for_s:.0f} s: {self._reason(record)}; {self._until(record)}")
            if record.refusing:
                found.append(f"{peer} does not use contacts of this robot: they contradict what it knows")
        return found

    def _reason(self, record: _Record) -> str:
        return f"mean NIS of its contacts was {record.nis:.1f}, consistent ones have 1"

    def _until(self, record: _Record) -> str:
        settings = self._settings
        return (
            f"until {settings.readmit_after} contacts in a row have a NIS below {settings.suspect_nis:g}"
            f" and {settings.suspect_nis / 2.0:g} on average ({len(record.good)} so far)"
        )
