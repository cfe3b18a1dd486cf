"""The pure core of one robot: events in, effects out. No socket, clock, thread or randomness.

Own data and requests wait in a timeline and are processed in the order of the instants they refer to, once
those instants have settled and odometry covers them; odometry is cut exactly at each of them. What comes later
than that is used through the history (see `agent.history`) or counted. Nothing from outside raises.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.belief import CorrelationStack, RobotState, TargetState
from agent.effects import Effect, Estimate, Publish, Send, TrackEstimate
from agent.estimation.colocalization import Options, absolute_update, sighting_update
from agent.estimation.motion import StateLayout
from agent.estimation.observation import ABSOLUTE, RELATIVE_ANGLES, AbsoluteModel, RelativeModel
from agent.events import Event, Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.history import History, moved
from agent.pairs import Pairs
from agent.settings import AgentSettings
from agent.timeline import Item, OdometryTrack, Phase, Timeline
from network.messages import Measurement, PairReply, PairRequest, Snapshot

Array = NDArray[np.float64]


@dataclass(slots=True)
class NisSum:
    """Sum and number of normalized innovations squared per degree of freedom, for one kind of measurement."""

    total: float = 0.0
    count: int = 0


class Agent:
    """One robot's estimator. `handle` takes every event, `next_deadline_ns` says when to come back."""

    def __init__(self, settings: AgentSettings) -> None:
        self.settings = settings
        self.counters: Counter[str] = Counter()
        self.nis: dict[str, NisSum] = {}
        self.now_ns = settings.start_ns
        stack = CorrelationStack(np.zeros((len(settings.mean), 0)))
        targets = {t.id: TargetState(t.mean, t.cov) for t in settings.targets if settings.track}
        self.state = RobotState(settings.start_ns, settings.mean, settings.cov, stack, {}, targets)
        self._target_layouts: dict[str, StateLayout] = {t.id: t.motion.layout for t in settings.targets}
        self.history = History(settings, self.state)
        self._timeline = Timeline()
        self._odometry = OdometryTrack(settings.coast, settings.lateness.tolerance_ns, self.counters)
        localization = settings.localization
        self._options = Options(localization.transform, localization.parameters, localization.innovation_cap)
        self._pairs = Pairs(settings, self._options, self.counters, self._count_nis)
        self._published: RobotState | None = None

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
        self._pairs.expire(self.now_ns, effects)
        if self.state is not self._published:
            self._published = self.state
            effects.append(Publish(self.estimate()))
        return effects

    def next_deadline_ns(self) -> int:
        """When `handle` wants a `Tick` at the latest, should nothing else happen."""
        lateness = self.settings.lateness
        deadline = self._pairs.deadline_ns()
        item = self._timeline.peek()
        if item is not None:
            covered = self._covered(item.t_ns)
            wait = lateness.settle_ns if covered else max(lateness.odometry_wait_ns, lateness.settle_ns)
            deadline = min(deadline, item.t_ns + wait)
        end = self._odometry.next_end_ns(self.state.t_ns)
        if end is not None:
            deadline = min(deadline, end + lateness.settle_ns)
        return max(deadline, self.now_ns)

    def estimate(self) -> Estimate:
        """The own belief and the tracks at the state's instant."""
        state = self.state
        tracks = tuple(
            TrackEstimate(name, self._target_layouts[name].name, target.mean, target.cov)
            for name, target in state.targets.items()
        )
        return Estimate(state.t_ns, self.settings.layout.name, state.mean, state.cov, tracks)

    def snapshot(self, peer: str) -> Snapshot:
        """The present state as it would be told to a peer."""
        return self._pairs.snapshot(self.state, peer)

    def status(self) -> dict[str, object]:
        """A plain summary for people: instant, position and its deviation, pairs, counters."""
        state = self.state
        return {
            "t_ns": state.t_ns,
            "x_m": float(state.mean[0]),
            "y_m": float(state.mean[1]),
            "sigma_m": float(np.sqrt(max(np.trace(state.cov[:2, :2]) / 2.0, 0.0))),
            "lag_s": (self.now_ns - state.t_ns) * 1e-9,
            "waiting": len(self._timeline),
            "pairs": {peer: record.base.t_meas_ns for peer, record in state.pairs.items() if record.base.met},
            "counters": dict(self.counters),
        }

    def _take(self, event: Event, effects: list[Effect]) -> None:
        match event:
            case Tick():
                pass
            case Odometry():
                self._odometry.add(event, self.state.t_ns)
            case Fix():
                self._queue(Item(event.t_meas_ns, Phase.PRIVATE, event.sensor, event))
            case Observation():
                self._queue_observation(event)
            case Received():
                self._receive(event, effects)
            case LinkChange():
                self.state = self._pairs.link_changed(event, self.state, self.history)

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
        if isinstance(body, PairRequest):
            instant = body.epoch.t_meas_ns - self._pairs.offset_ns(event)
            self._queue(Item(instant, Phase.PAIR, event.message.header.source, event))
        elif isinstance(body, PairReply):
            self._drain(effects)
            self.state = self._pairs.reply(event.message.header.source, body, self.state, self.history)
        else:
            self.counters["received.unused"] += 1

    # -- time -----------------------------------------------------------------------------------------------

    def _covered(self, t_ns: int) -> bool:
        """Whether the state can be brought to `t_ns` (own clock) with odometry."""
        reach = max(self.state.t_ns, self._odometry.end_ns or 0)
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
            except np.linalg.LinAlgError:
                self.counters["update.failed"] += 1
        while (end := self._odometry.next_end_ns(self.state.t_ns)) is not None:
            waiting = self._timeline.peek()
            if end > settled + lateness.tolerance_ns or (
                waiting is not None and waiting.t_ns < end - lateness.tolerance_ns
            ):
                break
            self._step(end)

    def _advance(self, until_ns: int) -> None:
        while self.state.t_ns < until_ns - self.settings.lateness.tolerance_ns:
            self._step(until_ns)

    def _step(self, until_ns: int) -> None:
        """Move the state one stretch of odometry, or of coasting, towards `until_ns` > its instant."""
        t_ns, delta, cov = self._odometry.step(self.state.t_ns, until_ns)
        self.state, F = moved(self.settings, self.state, t_ns, delta, cov)
        self.history.advanced(self.state, delta, cov, F)

    # -- one instant ----------------------------------------------------------------------------------------

    def _process(self, item: Item, effects: list[Effect]) -> None:
        event = item.event
        if isinstance(event, Received):
            assert isinstance(event.message.body, PairRequest)
            self.state = self._pairs.request(event, item.t_ns, self.state, self.history, effects)
        elif isinstance(event, Fix):
            if event.kind in ABSOLUTE:
                self._absolute(item.t_ns, event.kind, AbsoluteModel(event.kind, self.settings.layout), event)
            else:
                self.counters["fix.unused_kind"] += 1
        elif item.phase is Phase.PRIVATE:
            self._landmark(item.t_ns, event)
        elif item.phase is Phase.TARGET:
            self._sighting(item.t_ns, event)
        else:
            self._contact(item.t_ns, event, effects)

    def _late(self, t_ns: int) -> bool:
        return t_ns < self.state.t_ns - self.settings.lateness.tolerance_ns

    def _absolute(
        self, t_ns: int, kind: str, model: AbsoluteModel | RelativeModel, event: Fix | Observation
    ) -> None:
        late = self._late(t_ns)
        then: RobotState | None = self.state
        if late:
            then = None if self.settings.lateness.kind == "discard" else self.history.cut(t_ns)
        if then is None:
            self.counters["late.dropped"] += 1
            return
        update = absolute_update(then.mean, then.cov, self.settings.layout, model, event.z, event.R, self._options)
        state: RobotState | None = None
        if update is not None and late:
            state = self.history.corrected(then.t_ns, update)
        elif update is not None:
            state = self.state.updated(update.mean, update.cov, update.left)
            self.history.updated(state, update.left)
        if update is None or state is None:
            self.counters["update.not_positive_definite"] += 1
            return
        self.state = state
        if late:
            self.counters["late.compensated"] += 1
        self.counters[f"used.{kind}"] += 1
        self._count_nis(kind, update.nis)

    def _landmark(self, t_ns: int, event: Observation) -> None:
        assert event.of is not None
        position = self.settings.landmarks.get(event.of.removeprefix("landmark:"))
        if position is None:
            self.counters["observation.unknown_landmark"] += 1
            return
        model = RelativeModel(event.kind, self.settings.layout, event.mount, position)
        self._absolute(t_ns, f"landmark_{event.kind}", model, event)

    def _sighting(self, t_ns: int, event: Observation) -> None:
        assert event.of is not None
        name = event.of.removeprefix("target:")
        target = self.state.targets.get(name)
        if target is None:
            self.counters["observation.unknown_target"] += 1
            return
        if self._late(t_ns):
            self.counters["late.target_dropped"] += 1
            return
        localization = self.settings.localization
        layout = self._target_layouts[name]
        own, track, nis = sighting_update(
            (self.state.mean, self.state.cov, self.settings.layout),
            (target.mean, target.cov, layout),
            RelativeModel(event.kind, self.settings.layout, event.mount),
            event.z,
            event.R,
            localization.sighting_weight,
            localization.correlation == "factors",
            self._options,
        )
        self._count_nis(f"target_{event.kind}", nis)
        self.counters["used.sighting_own"] += own is not None
        self.counters["used.sighting_target"] += track is not None
        state = self.state
        if own is not None:
            state = state.updated(own.mean, own.cov, own.left)
        if track is not None:
            belief = TargetState(track.mean, track.cov)
            state = replace(state, targets={**state.targets, name: belief})
        if state is not self.state:
            self.state = state
            self.history.updated(state, None if own is None else own.left)

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
                measurements.append(Measurement(found.kind, found.z, found.R, found.mount))
        if not measurements:
            return
        self.state, request = self._pairs.measured(
            peer, t_ns, self.now_ns, tuple(measurements), self.state, self.history
        )
        if request is not None:
            effects.append(Send(peer, request.epoch.t_meas_ns, request))

    def _count_nis(self, kind: str, nis: float) -> None:
        entry = self.nis.setdefault(kind, NisSum())
        entry.total += nis
        entry.count += 1
