"""What one datum, or all measurements of a peer at one instant, mean for the filter of a robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass

from agent.cooperative_filter import AnonymousFilter, Completing, CooperativeFilter, NamingAnonymous
from agent.effects import Effect
from agent.estimation.observation import absolute_model, relative_model, told
from agent.events import Completed, Fix, Observation, Received
from agent.settings import AgentSettings
from agent.timeline import Item, Phase, Timeline


@dataclass(frozen=True, slots=True)
class Instant:
    """A filter whose state is at the instant of the items that are processed, or later if they come late.

    `timeline`: what else waits. `clocks_off`: peers whose clocks are of no use.
    """

    settings: AgentSettings
    filter: CooperativeFilter
    counters: Counter[str]
    timeline: Timeline
    clocks_off: Collection[str]
    now_ns: int

    def process(self, item: Item, effects: list[Effect]) -> None:
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
        elif isinstance(event, Completed):
            assert isinstance(self.filter, Completing)
            self.filter.use(event)
        elif item.phase is Phase.PRIVATE:
            self._landmark(item.t_ns, event)
        elif item.phase is Phase.TARGET:
            assert event.of is not None
            self.filter.sighting(item.t_ns, event.of.removeprefix("target:"), event)
        elif event.of is None:
            # Only a filter that takes them is handed measurements of nobody knows whom.
            if isinstance(self.filter, AnonymousFilter):
                self.filter.anonymous(item.t_ns, event)
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
        while (item := self.timeline.peek()) is not None:
            same = item.t_ns == t_ns and item.phase is Phase.PAIR and item.source == peer
            if not same or not isinstance(item.event, Observation):
                break
            self.timeline.pop()
            events.append(item.event)
        measurements = []
        for found in events:
            two_way = found.kind == "range" and found.sensor not in self.settings.one_way_sensors
            if two_way and peer < self.settings.robot:
                self.counters["pair.not_owner"] += 1
                if isinstance(self.filter, NamingAnonymous):
                    self.filter.unowned(t_ns, peer, told(found))
            else:
                measurements.append(told(found))
        if not measurements:
            return
        if peer in self.clocks_off and self.settings.localization.kind != "replica":
            # Its answer would be of no known instant. Where raw data are told there is nothing to answer.
            self.counters["observation.clock_unusable"] += len(measurements)
            return
        self.filter.measured(peer, t_ns, self.now_ns, tuple(measurements), effects)
