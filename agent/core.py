"""The pure core of one robot: events in, effects out. No socket, clock, thread or randomness.

Own data and requests wait in a timeline and are processed in the order of the instants they refer to, once
those instants have settled and odometry covers them; odometry is cut exactly at each of them. What comes later
than that is handed over all the same: the filter uses it for the instant it belongs to, or counts it; or it is put in
its place by a rewind (`agent.replay`). Nothing from outside raises.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from agent.cooperative_filter import AnonymousFilter, Completing, CooperativeFilter, NamingAnonymous
from agent.effects import Alarm, Effect, Estimate, Publish
from agent.estimation.observation import OutOfViewError
from agent.events import (
    ClockJudged,
    ControlReport,
    Event,
    Fix,
    LinkChange,
    Observation,
    Odometry,
    PlannerOverrun,
    Received,
    Tick,
)
from agent.figures import MAX_KINDS, Figures, known
from agent.forms import build_filter
from agent.health import Health
from agent.instant import Instant
from agent.own_data import placed_observation
from agent.peer_work import PeerWork
from agent.persistence import Persistence, saved_bytes
from agent.pilot import Pilot
from agent.plausible import plausible
from agent.replay import MAX_LOGGED, ReplayLog
from agent.saved_state import decode
from agent.settings import AgentSettings
from agent.timeline import MAX_INCREMENTS, MAX_WAITING, Item, OdometryTrack, Phase, Timeline
from agent.waiting_filter import WaitingFilter
from network.leader_messages import LeaderRequest
from network.messages import PairReply, PairRequest, RoundReport, SplitReply, SplitRequest, StartRequest


class Agent:
    """One robot's estimator. `handle` takes every event, `next_deadline_ns` says when to come back."""

    def __init__(self, settings: AgentSettings, state: bytes | None = None) -> None:
        """`state`: what a `Persist` of an earlier life has kept. Raises `StateError` if that can't be begun with."""
        restored = None if state is None else decode(state, settings)
        if restored is not None:
            settings = restored.settings(settings)
        self.settings = settings
        self.figures = Figures()
        self.counters = self.figures.counters
        self.nis = self.figures.nis
        self.now_ns = settings.start_ns if restored is None else restored.t_ns
        lateness = settings.lateness
        replayed = "replay" in lateness.kinds
        self._timeline = Timeline(by_content=replayed)
        self._odometry = OdometryTrack(settings.coast, settings.lateness.tolerance_ns, self.counters)
        saved = None if restored is None else restored.saved
        self.health = Health(settings.health, self.counters, None if restored is None else restored.verdicts)
        count_nis = self.figures.count_nis
        self.filter: CooperativeFilter = build_filter(settings, self.counters, count_nis, self.health, saved)
        self._log: ReplayLog | None = None
        if replayed:
            self._log = ReplayLog(lateness.horizon_ns, lateness.tolerance_ns, self.filter.t_ns, self.counters)
        self._pilot = Pilot(settings, self.counters) if settings.planning.kind != "none" else None
        self._again_until_ns = self.filter.t_ns
        self._replays = self._replaying()
        self._commit()
        self._persistence = Persistence(self.now_ns)
        self._published: object = None
        self._tracks: tuple[str, ...] = ()
        self._missing: tuple[str, ...] = ()
        self._work = PeerWork()
        self._clocks_off: set[str] = set()
        """Peers whose clocks are of no use; the endpoint keeps only so many peers."""

    # -- events ---------------------------------------------------------------------------------------------

    def handle(self, event: Event) -> list[Effect]:
        """Take one event; returns the effects to be carried out, in order."""
        self.now_ns = max(self.now_ns, event.t_ns)
        effects: list[Effect] = []
        try:
            if self._replays != self._replaying():
                # What another policy has used is not in the log.
                self._drain(effects)
                self._replays = self._replaying()
                self._commit()
            self._take(event, effects)
        except np.linalg.LinAlgError:
            self.counters["update.failed"] += 1
        self._drain(effects)
        # Of the present instant more data may follow, unless it is time itself that is told.
        settled_ns = self.now_ns - self.settings.lateness.settle_ns
        self.filter.settled(settled_ns if isinstance(event, Tick) else settled_ns - 1, effects)
        self.filter.expire(self.now_ns, effects)
        self._hand_on(effects)
        if self._pilot is not None:
            self._pilot.act(self.now_ns, self.filter, effects)
        if self.filter.revision is not self._published:
            self._published = self.filter.revision
            estimate = self.estimate()
            if estimate is not None:
                effects.append(Publish(estimate))
                tracks = tuple(track.target for track in estimate.tracks)
                effects.extend(Alarm("track_ended", target) for target in self._tracks if target not in tracks)
                self._tracks = tracks
        verdicts = self.health.alarms()
        effects.extend(verdicts)
        missing = self.missing()
        if missing != self._missing:
            self._missing = missing
            effects.append(Alarm("waiting", "; ".join(missing)) if missing else Alarm("started"))
        self._persistence.act(self.settings, self.filter, self.health, self.now_ns, effects, bool(verdicts))
        return effects

    def saved(self) -> bytes | None:
        """What is known now, for another life of this robot; None if it begins without."""
        return saved_bytes(self.settings, self.filter, self.health)

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What waits or is kept, and the most there may be of it, by name."""
        log = {} if self._log is None else self._log.sizes()
        waiting = self.filter.sizes() if isinstance(self.filter, Completing | NamingAnonymous) else {}
        return {
            **log,
            **waiting,
            "timeline": (len(self._timeline), MAX_WAITING + (MAX_LOGGED if log else 0)),
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
                self.filter = build_filter(begun, self.counters, self.figures.count_nis, self.health)
                self._again_until_ns = self.filter.t_ns
                self._commit()

    def next_deadline_ns(self) -> int:
        """When `handle` wants a `Tick` at the latest, should nothing else happen."""
        lateness = self.settings.lateness
        deadline = self.filter.deadline_ns()
        if self._pilot is not None:
            deadline = min(deadline, self._pilot.deadline_ns())
        item = self._timeline.peek()
        if item is not None:
            covered = self._covered(item.t_ns)
            wait = lateness.settle_ns if covered else max(lateness.odometry_wait_ns, lateness.settle_ns)
            deadline = min(deadline, item.t_ns + wait)
        end = self._odometry.next_end_ns(self.filter.t_ns)
        if end is not None:
            deadline = min(deadline, end + lateness.settle_ns)
        if self._log is not None and self._log.dirty:
            deadline = min(deadline, self._log.due_ns(self.now_ns))
        return max(deadline, self.now_ns)

    def estimate(self) -> Estimate | None:
        """The own belief and the tracks at the newest instant; None while the robot waits for its start."""
        return self.filter.estimate()

    def status(self) -> dict[str, object]:
        """A plain summary for people: instant, position and its deviation, pairs, counters."""
        estimate = self.filter.estimate()
        form, why = self.filter.form()
        waiting = {"state": "waiting", "missing": list(self.missing())}
        return {
            "t_ns": self.filter.t_ns,
            **(waiting if estimate is None else known(estimate)),
            "lag_s": (self.now_ns - self.filter.t_ns) * 1e-9,
            "form": form,
            "form_reason": why,
            "waiting": len(self._timeline),
            "pairs": {peer: epoch.t_meas_ns for peer, epoch in self.filter.contacts().items()},
            "unsafe": self.settings.unsafe.named(),
            "health": self.health.status(self.now_ns),
            **({} if self._pilot is None else {"steering": self._pilot.status()}),
            "counters": dict(self.counters),
        }

    def _take(self, event: Event, effects: list[Effect]) -> None:
        match event:
            case Tick():
                pass
            case Odometry():
                self._take_odometry(event)
            case Fix():
                self._queue(Item(event.t_meas_ns, Phase.PRIVATE, event.sensor, event))
            case Observation():
                self._queue_observation(event)
            case Received():
                self._receive(event, effects)
            case LinkChange():
                with self._told(effects):
                    self.filter.link_changed(event)
                if self._pilot is not None:
                    self._pilot.link_changed(event)
            case ControlReport(_, refused):
                if self._pilot is not None:
                    self._pilot.obeyed(refused)
            case PlannerOverrun(t_ns):
                if self._pilot is not None:
                    self._pilot.overran(t_ns)
            case ClockJudged(_, peer, reason):
                if reason is None:
                    self._clocks_off.discard(peer)
                else:
                    self._clocks_off.add(peer)

    def _take_odometry(self, event: Odometry) -> None:
        if self._log is None or not self._replays:
            self._odometry.add(event, self.filter.t_ns)
            if self._log is not None:
                self._log.odometry(event)
            return
        since_ns = self._log.odometry(event)
        if since_ns is None:
            return
        if since_ns < self.filter.t_ns - self.settings.lateness.tolerance_ns:
            self._log.moved_late(event, since_ns)
        else:
            self._odometry.put(event)

    def _queue(self, item: Item) -> None:
        log = self._log if self._replays and not isinstance(item.event, Received) else None
        if item.t_ns > self.now_ns + self.settings.lateness.horizon_ns:
            self.counters["input.future"] += 1
        elif log is None or log.take(item, self.filter.t_ns):
            if self._timeline.push(item):
                return
            self.counters["input.overflow"] += 1
            if log is not None:
                log.drop(item)

    def _queue_observation(self, event: Observation) -> None:
        settings = self.settings
        takes_unnamed = settings.relative.leads and isinstance(self.filter, AnonymousFilter)
        item = placed_observation(event, settings.robot, takes_unnamed)
        if isinstance(item, str):
            self.counters[item] += 1
            return
        if self._pilot is not None and event.of is not None and item.phase is Phase.PAIR:
            self._pilot.saw(event.of, event)
        self._queue(item)

    def _receive(self, event: Received, effects: list[Effect]) -> None:
        peer, body = event.message.header.source, event.message.body
        if not plausible(body):
            self.counters["pair.implausible"] += 1
        elif isinstance(body, PairRequest | SplitRequest | StartRequest) or (
            isinstance(body, LeaderRequest) and isinstance(self.filter, Completing)
        ):
            asked_ns = self._asked_ns(event)
            if self._work.allowed(peer, self.now_ns, asked_ns):
                self._queue(Item(asked_ns, Phase.PAIR, peer, event))
            else:
                self.counters["pair.too_much_asked"] += 1
        elif isinstance(body, PairReply | SplitReply):
            self._drain(effects)
            with self._told(effects):
                self.filter.replied(peer, body)
            self._start()
        else:
            self._drain(effects)
            if self._pilot is not None and isinstance(body, RoundReport):
                self._pilot.heard(event)
            with self._told(effects):
                self.filter.heard(event, effects)
            self._complete()

    def _complete(self) -> None:
        """Measurements of a peer that its word has completed are own data of their instants from now on."""
        if isinstance(self.filter, Completing):
            for event in self.filter.completed():
                self._queue(Item(event.t_meas_ns, Phase.PRIVATE, event.sensor, event))

    def _hand_on(self, effects: list[Effect]) -> None:
        """Measurements that have turned out to be of a peer open contacts."""
        if isinstance(self.filter, NamingAnonymous):
            try:
                with self._told(effects):
                    self.filter.hand_on(self.now_ns, self._clocks_off, effects)
            except np.linalg.LinAlgError:
                self.counters["update.failed"] += 1

    def _asked_ns(self, event: Received) -> int:
        """The instant that a peer's request refers to, on the own clock."""
        t_ns, unsafe = self.filter.instant_ns(event), self.settings.unsafe
        gone = t_ns < self.filter.t_ns - self.settings.lateness.horizon_ns
        return max(t_ns, self.filter.t_ns) if unsafe.use_late_as_new or (unsafe.accept_stale and gone) else t_ns

    # -- time -----------------------------------------------------------------------------------------------

    def _covered(self, t_ns: int) -> bool:
        """Whether the state can be brought to `t_ns` (own clock) with odometry."""
        reach = max(self.filter.t_ns, self._odometry.end_ns or 0)
        return t_ns <= reach + self.settings.lateness.tolerance_ns

    def _drain(self, effects: list[Effect]) -> None:
        lateness = self.settings.lateness
        settled = self.now_ns - lateness.settle_ns
        self._rewind()
        while (item := self._timeline.peek()) is not None and item.t_ns <= settled + lateness.tolerance_ns:
            if not self._covered(item.t_ns) and self.now_ns < item.t_ns + lateness.odometry_wait_ns:
                break
            self._timeline.pop()
            try:
                self._advance(item.t_ns)
                self._use(item, effects)
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
        if self._log is not None:
            self._advance(self._again_until_ns)

    def _advance(self, until_ns: int) -> None:
        while self.filter.t_ns < until_ns - self.settings.lateness.tolerance_ns:
            self._step(until_ns)

    def _step(self, until_ns: int) -> None:
        """Move the state one stretch of odometry, or of coasting, towards `until_ns` > its instant."""
        before = self.filter.t_ns
        if self._log is not None:
            self._log.settle(before)
            self._log.mark(before, self.filter.mark(), self._odometry)
        with self.figures.kept(before < self._again_until_ns):
            t_ns, delta, cov = self._odometry.step(before, until_ns)
            self.filter.advance(t_ns, delta, cov)
        self._again_until_ns = max(self._again_until_ns, t_ns)

    def _instant(self) -> Instant:
        return Instant(self.settings, self.filter, self.counters, self._timeline, self._clocks_off, self.now_ns)

    # -- late data ------------------------------------------------------------------------------------------

    def _rewind(self) -> None:
        """Go back to before late data, if there are any: what follows in the timeline leads here again."""
        if self._log is None or not self._log.dirty:
            return
        # If another form is on by now, what was before it is not done again.
        self._log.mark(self.filter.t_ns, self.filter.mark(), self._odometry)
        found = self._log.rewound(self.now_ns, self.filter.t_ns)
        if found is not None:
            mark, items, increments = found
            self.filter.rewind(mark.filter)
            self._odometry.restore(mark.gap_ns, increments)
            for item in items:
                self._timeline.push(item, again=True)

    def _use(self, item: Item, effects: list[Effect]) -> None:
        """Process an item at its instant; what was used before doesn't count again."""
        if isinstance(item.event, Received) or item.phase is Phase.PAIR:
            with self._told(effects):
                self._instant().process(item, effects)
            self._complete()
        elif self._log is None:
            self._instant().process(item, effects)
        else:
            late = item.t_ns < self.filter.t_ns - self.settings.lateness.tolerance_ns
            with self.figures.kept(self._log.used(item, self.filter.t_ns)):
                self._instant().process(item, effects)
            if late:
                self._commit()

    @contextmanager
    def _told(self, effects: list[Effect]) -> Iterator[None]:
        """Whatever peers are told or have told can't be taken back, unless it is nothing of the belief."""
        if isinstance(self.filter, Completing):
            yield
            return
        revision, count = self.filter.revision, len(effects)
        try:
            yield
        finally:
            if self.filter.revision is not revision or len(effects) > count:
                self._commit()

    def _replaying(self) -> bool:
        """Whether late data lead back to their instants now."""
        return self.settings.lateness.kind_at(self.now_ns - self.settings.start_ns) == "replay"

    def _commit(self) -> None:
        """What was used up to now is not to be used again."""
        if self._log is not None:
            self._log.commit(self.filter.t_ns, self.filter.mark(), self._odometry)
