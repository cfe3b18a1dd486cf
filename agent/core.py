"""The pure core of one robot: events in, effects out. No socket, clock, thread or randomness.

Own data and requests wait in a timeline and are processed in the order of the instants they refer to, once
those instants have settled and odometry covers them; odometry is cut exactly at each of them. What comes later
than that is handed over all the same: the filter uses it for the instant it belongs to, or counts it. Nothing from
outside raises.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import CooperativeFilter
from agent.effects import Alarm, Effect, Estimate, Persist, Publish, Send, TrackEstimate
from agent.estimation.observation import RELATIVE_ANGLES, OutOfViewError, absolute_model, relative_model, told
from agent.events import Event, Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.forms import build_filter
from agent.saved_state import decode, encode
from agent.settings import AgentSettings
from agent.timeline import MAX_INCREMENTS, MAX_WAITING, Item, OdometryTrack, Phase, Timeline
from agent.waiting_filter import WaitingFilter
from network.messages import PairReply, PairRequest, SplitReply, SplitRequest, StartRequest

Array = NDArray[np.float64]

MAX_KINDS = 64
"""Kinds of measurements that figures are kept of: kinds of fixes, landmarks, sightings and contacts, the last of them `other`."""


@dataclass(slots=True)
class NisSum:
    """Sum and number of normalized innovations squared per degree of freedom, for one kind of measurement."""

    total: float = 0.0
    count: int = 0


class Agent:
    """One robot's estimator. `handle` takes every event, `next_deadline_ns` says when to come back."""

    def __init__(self, settings: AgentSettings, state: bytes | None = None) -> None:
        """`state`: what a `Persist` of an earlier life has kept. Raises `StateError` if that can't be begun with."""
        restored = None if state is None else decode(state, settings)
        if restored is not None:
            settings = restored.settings(settings)
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self.nis: dict[str, NisSum] = {}
        self.now_ns = settings.start_ns if restored is None else restored.t_ns
        self._timeline = Timeline()
        self._odometry = OdometryTrack(settings.coast, settings.lateness.tolerance_ns, self.counters)
        saved = None if restored is None else restored.saved
        self.filter: CooperativeFilter = build_filter(settings, self.counters, self._count_nis, saved)
        self._persisted: object = None
        self._persist_due_ns = self.now_ns
        self._published: object = None
        self._tracks: tuple[str, ...] = ()
        self._missing: tuple[str, ...] = ()

    # -- events ---------------------------------------------------------------------------------------------

    def handle(self, event: Event) -> list[Effect]:
        """Take one event; returns the effects to be carried out, in order."""
        self.now_ns = max(self.now_ns, event.t_ns)
        effects: list[Effect] = []
        try:
            self._take(event, effects)
        except np.linalg.LinAlgError:
            self.counters["update.failed"] += 1
        self._drain(effects)
        # Of the present instant more data may follow, unless it is time itself that is told.
        settled_ns = self.now_ns - self.settings.lateness.settle_ns
        self.filter.settled(settled_ns if isinstance(event, Tick) else settled_ns - 1, effects)
        self.filter.expire(self.now_ns, effects)
        if self.filter.revision is not self._published:
            self._published = self.filter.revision
            estimate = self.estimate()
            if estimate is not None:
                effects.append(Publish(estimate))
                self._tell_ends(tuple(track.target for track in estimate.tracks), effects)
        missing = self.missing()
        if missing != self._missing:
            self._missing = missing
            effects.append(Alarm("waiting", "; ".join(missing)) if missing else Alarm("started"))
        self._persist(effects)
        return effects

    def _persist(self, effects: list[Effect]) -> None:
        """Have the state kept: before messages that it must not be older than, and from time to time."""
        first = next((index for index, effect in enumerate(effects) if isinstance(effect, Send)), None)
        ahead = first is not None and self.filter.keeps_factors
        due = self.now_ns >= self._persist_due_ns and self.filter.revision is not self._persisted
        if not ahead and not due:
            return
        payload = self.saved()
        if payload is None:
            return
        self._persisted, self._persist_due_ns = self.filter.revision, self.now_ns + self.settings.persist_ns
        effects.insert(first if ahead and first is not None else len(effects), Persist(payload, ahead))

    def saved(self) -> bytes | None:
        """What is known now, for another life of this robot; None if it begins without."""
        saved = self.filter.saved()
        return None if saved is None else encode(self.settings, saved)

    def _tell_ends(self, tracks: tuple[str, ...], effects: list[Effect]) -> None:
        if tracks != self._tracks:
            effects.extend(Alarm("track_ended", target) for target in self._tracks if target not in tracks)
            self._tracks = tracks

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What waits or is kept, and the most there may be of it, by name."""
        return {
            "timeline": (len(self._timeline), MAX_WAITING),
            "odometry": (len(self._odometry), MAX_INCREMENTS),
            "figures": (len(self.nis), MAX_KINDS),
        }

    def missing(self) -> tuple[str, ...]:
        """What the robot waits for before it starts, in words; nothing once it has."""
        return self.filter.missing() if isinstance(self.filter, WaitingFilter) else ()

    def _start(self) -> None:
        """Start if the robot has found out where it is."""
        if isinstance(self.filter, WaitingFilter):
            begun = self.filter.begun()
            if begun is not None:
                self.settings = begun
                self.filter = build_filter(begun, self.counters, self._count_nis)

    def next_deadline_ns(self) -> int:
        """When `handle` wants a `Tick` at the latest, should nothing else happen."""
        lateness = self.settings.lateness
        deadline = self.filter.deadline_ns()
        item = self._timeline.peek()
        if item is not None:
            covered = self._covered(item.t_ns)
            wait = lateness.settle_ns if covered else max(lateness.odometry_wait_ns, lateness.settle_ns)
            deadline = min(deadline, item.t_ns + wait)
        end = self._odometry.next_end_ns(self.filter.t_ns)
        if end is not None:
            deadline = min(deadline, end + lateness.settle_ns)
        return max(deadline, self.now_ns)

    def estimate(self) -> Estimate | None:
        """The own belief and the tracks at the newest instant; None while the robot waits for its start."""
        return self.filter.estimate()

    def status(self) -> dict[str, object]:
        """A plain summary for people: instant, position and its deviation, pairs, counters."""
        estimate = self.filter.estimate()
        form, why = self.filter.form()
        known: dict[str, object] = {"state": "waiting", "missing": list(self.missing())}
        if estimate is not None:
            known = {
                "state": "running",
                "x_m": float(estimate.mean[0]),
                "y_m": float(estimate.mean[1]),
                "sigma_m": _sigma_m(estimate.cov),
                "tracks": {track.target: _track_status(track, estimate.t_ns) for track in estimate.tracks},
            }
        return {
            "t_ns": self.filter.t_ns,
            **known,
            "lag_s": (self.now_ns - self.filter.t_ns) * 1e-9,
            "form": form,
            "form_reason": why,
            "waiting": len(self._timeline),
            "pairs": {peer: epoch.t_meas_ns for peer, epoch in self.filter.contacts().items()},
            "counters": dict(self.counters),
        }

    def _take(self, event: Event, effects: list[Effect]) -> None:
        match event:
            case Tick():
                pass
            case Odometry():
                self._odometry.add(event, self.filter.t_ns)
            case Fix():
                self._queue(Item(event.t_meas_ns, Phase.PRIVATE, event.sensor, event))
            case Observation():
                self._queue_observation(event)
            case Received():
                self._receive(event, effects)
            case LinkChange():
                self.filter.link_changed(event)

    def _queue(self, item: Item) -> None:
        if item.t_ns > self.now_ns + self.settings.lateness.horizon_ns:
            self.counters["input.future"] += 1
        elif not self._timeline.push(item):
            self.counters["input.overflow"] += 1

    def _queue_observation(self, event: Observation) -> None:
        if event.kind not in RELATIVE_ANGLES:
            self.counters["observation.unknown_kind"] += 1
        elif event.of is None:
            self.counters["observation.no_identity"] += 1
        elif event.of.startswith("landmark:"):
            self._queue(Item(event.t_meas_ns, Phase.PRIVATE, event.of, event))
        elif event.of.startswith("target:"):
            self._queue(Item(event.t_meas_ns, Phase.TARGET, event.of, event))
        elif event.of == self.settings.robot:
            self.counters["observation.of_self"] += 1
        else:
            self._queue(Item(event.t_meas_ns, Phase.PAIR, event.of, event))

    def _receive(self, event: Received, effects: list[Effect]) -> None:
        body = event.message.body
        if isinstance(body, PairRequest | SplitRequest | StartRequest):
            self._queue(Item(self.filter.instant_ns(event), Phase.PAIR, event.message.header.source, event))
        elif isinstance(body, PairReply | SplitReply):
            self._drain(effects)
            self.filter.replied(event.message.header.source, body)
            self._start()
        else:
            self._drain(effects)
            self.filter.heard(event, effects)

    # -- time -----------------------------------------------------------------------------------------------

    def _covered(self, t_ns: int) -> bool:
        """Whether the state can be brought to `t_ns` (own clock) with odometry."""
        reach = max(self.filter.t_ns, self._odometry.end_ns or 0)
        return t_ns <= reach + self.settings.lateness.tolerance_ns

    def _drain(self, effects: list[Effect]) -> None:
        lateness = self.settings.lateness
        settled = self.now_ns - lateness.settle_ns
        while (item := self._timeline.peek()) is not None and item.t_ns <= settled + lateness.tolerance_ns:
            if not self._covered(item.t_ns) and self.now_ns < item.t_ns + lateness.odometry_wait_ns:
                break
            self._timeline.pop()
            try:
                self._advance(item.t_ns)
                self._process(item, effects)
                self._start()
            except OutOfViewError:
                self.counters["observation.out_of_view"] += 1
            except np.linalg.LinAlgError:
                self.counters["update.failed"] += 1
        while (end := self._odometry.next_end_ns(self.filter.t_ns)) is not None:
            waiting = self._timeline.peek()
            if end > settled + lateness.tolerance_ns or (
                waiting is not None and waiting.t_ns < end - lateness.tolerance_ns
            ):
                break
            self._step(end)

    def _advance(self, until_ns: int) -> None:
        while self.filter.t_ns < until_ns - self.settings.lateness.tolerance_ns:
            self._step(until_ns)

    def _step(self, until_ns: int) -> None:
        """Move the state one stretch of odometry, or of coasting, towards `until_ns` > its instant."""
        t_ns, delta, cov = self._odometry.step(self.filter.t_ns, until_ns)
        self.filter.advance(t_ns, delta, cov)

    # -- one instant ----------------------------------------------------------------------------------------

    def _process(self, item: Item, effects: list[Effect]) -> None:
        event = item.event
        if isinstance(event, Received):
            started_by_peer = self.settings.shared is not None
            if started_by_peer and item.t_ns <= self.settings.start_ns + self.settings.lateness.tolerance_ns:
                # The belief at the start may have come of this very contact, told once more.
                self.counters["start.told_again"] += 1
                return
            self.filter.requested(event, item.t_ns, effects)
        elif isinstance(event, Fix):
            fix = absolute_model(event.kind, self.settings.layout, event.z, event.R)
            if fix is not None:
                self.filter.absolute(item.t_ns, event.kind, *fix)
            else:
                self.counters["fix.unused_kind"] += 1
        elif item.phase is Phase.PRIVATE:
            self._landmark(item.t_ns, event)
        elif item.phase is Phase.TARGET:
            assert event.of is not None
            self.filter.sighting(item.t_ns, event.of.removeprefix("target:"), event)
        else:
            self._contact(item.t_ns, event, effects)

    def _landmark(self, t_ns: int, event: Observation) -> None:
        assert event.of is not None
        landmark = event.of.removeprefix("landmark:")
        position = self.settings.landmarks.get(landmark)
        if position is None:
            self.counters["observation.unknown_landmark"] += 1
            return
        model = relative_model(event, self.settings.layout, landmark=position)
        self.filter.absolute(t_ns, f"landmark_{event.kind}", model, event.z, event.R, landmark)

    def _contact(self, t_ns: int, event: Observation, effects: list[Effect]) -> None:
        """Open a contact for a measurement of a peer, with all measurements of that peer at this instant.

        A two-way range is known to both robots: the lower id uses it.
        """
        assert event.of is not None
        peer = event.of
        events = [event]
        while (item := self._timeline.peek()) is not None:
            same = item.t_ns == t_ns and item.phase is Phase.PAIR and item.source == peer
            if not same or not isinstance(item.event, Observation):
                break
            self._timeline.pop()
            events.append(item.event)
        measurements = []
        for found in events:
            two_way = found.kind == "range" and found.sensor not in self.settings.one_way_sensors
            if two_way and peer < self.settings.robot:
                self.counters["pair.not_owner"] += 1
            else:
                measurements.append(told(found))
        if not measurements:
            return
        self.filter.measured(peer, t_ns, self.now_ns, tuple(measurements), effects)

    def _count_nis(self, kind: str, nis: float) -> None:
        # A peer says which kinds it has measured at an instant: there are more mixtures than anybody wants figures of.
        if kind not in self.nis and len(self.nis) >= MAX_KINDS - 1:
            kind = "other"
        entry = self.nis.setdefault(kind, NisSum())
        entry.total += nis
        entry.count += 1


def _sigma_m(cov: Array) -> float:
    """Standard deviation of x and y, root mean square of both."""
    return float(np.sqrt(max(np.trace(cov[:2, :2]) / 2.0, 0.0)))


def _track_status(track: TrackEstimate, t_ns: int) -> dict[str, float]:
    found = {"x_m": float(track.mean[0]), "y_m": float(track.mean[1]), "sigma_m": _sigma_m(track.cov)}
    return found if track.learnt_ns is None else {**found, "age_s": max(t_ns - track.learnt_ns, 0) * 1e-9}
