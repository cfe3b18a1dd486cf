"""A robot whose camera does not tell whom it sees: it finds out, and hands bearings with a name on to its own filter.

`own` localizes in the global frame by contacts of pairs (kind `clat`). Beside it sums of hypotheses of where all others
are relative to the own body (`agent.relative_leader`) find out which bearing is whose. What is beyond doubt
(`agent.estimation.bearing_labels`) is used as a measurement of that peer, at its own instant; nothing else of the sums
is. A range of a peer waits for the bearings of its instant, so that one contact uses both: it is used once, as a
measurement of the own filter, and in the sums tells robots apart only.

A robot without a camera tells how it moves, and uses what it measures at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import CooperativeFilter, FilterMark
from agent.effects import Effect, Estimate, Named
from agent.estimation.motion import split_increment
from agent.estimation.mounting import in_body
from agent.estimation.observation import AbsoluteModel, RelativeModel, told
from agent.events import LinkChange, Observation, Received
from agent.pair_clock import PairClocks
from agent.peer_tables import Lives
from agent.relative_leader import Leader, Sight
from agent.relative_reports import MotionTeller, altitude_of, identified, take_report
from agent.saved_state import Saved
from agent.settings import AgentSettings
from network.messages import Body, Epoch, Measurement
from network.relative_messages import HypothesesReport, MotionReport

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62

MAX_HELD = 512
"""Instants and peers whose ranges wait for bearings."""


class NamingFilter:
    """See `agent.cooperative_filter` for what each method is given."""

    def __init__(self, own: CooperativeFilter, settings: AgentSettings, counters: Counter[str]) -> None:
        self.own = own
        self._settings, self._counters = settings, counters
        self._clocks = PairClocks(settings)
        self._lives = Lives()
        self._teller = MotionTeller(settings, own.t_ns, counters)
        self._leader = Leader(settings, own.t_ns, counters) if settings.relative.leads else None
        self._moved_ns = own.t_ns
        self._held: dict[tuple[int, str], list[Measurement]] = {}
        self._revision = object()
        self._of: tuple[object, object] = (None, None)
        self._estimate: Estimate | None = None

    @property
    def keeps_factors(self) -> bool:
        return self.own.keeps_factors

    @property
    def t_ns(self) -> int:
        return self.own.t_ns

    @property
    def complete_ns(self) -> int:
        return self.own.complete_ns

    @property
    def revision(self) -> object:
        now = self.own.revision, None if self._leader is None else self._leader.revision
        if self._of[0] is not now[0] or self._of[1] is not now[1]:
            self._of, self._revision, self._estimate = now, object(), None
        return self._revision

    def estimate(self) -> Estimate | None:
        assert self.revision is self._revision
        if self._estimate is None:
            own = self.own.estimate()
            if own is None or self._leader is None:
                return own
            self._estimate = replace(own, relatives=self._leader.relatives())
        return self._estimate

    def form(self) -> tuple[str, str]:
        form, why = self.own.form()
        if self._leader is None:
            return form, f"{why}; no camera: it tells how it moves"
        return form, f"{why}; {identified(self._leader, len(self._settings.relative.peers))}"

    def saved(self) -> Saved | None:
        """Who is who is found out anew: all have moved on while the robot was down."""
        return self.own.saved()

    def sizes(self) -> dict[str, tuple[int, int]]:
        return {"ranges": (len(self._held), MAX_HELD)}

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        t0_ns = self.own.t_ns
        self.own.advance(t_ns, delta, cov)
        # What is done again after a rewind was told before, and is in the sums.
        if t_ns <= self._moved_ns:
            return
        if t0_ns < self._moved_ns:
            _, _, delta, cov = split_increment(delta, cov, (self._moved_ns - t0_ns) / (t_ns - t0_ns))
            t0_ns = self._moved_ns
        self._moved_ns = t_ns
        self._teller.moved(t_ns, delta, cov)
        if self._leader is not None:
            self._leader.moved(t0_ns, t_ns, delta, cov)

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        self.own.absolute(t_ns, kind, model, z, R, landmark)
        altitude = altitude_of(t_ns, self._settings.layout, model, z, R)
        if altitude is not None and self._teller.risen(altitude) and self._leader is not None:
            self._leader.altitude(self._settings.robot, altitude)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self.own.sighting(t_ns, target, event)

    def anonymous(self, t_ns: int, event: Observation) -> None:
        if self._leader is None or event.kind != "bearing3":
            self._counters["relative.unused"] += 1
            return
        direction = in_body(event.z, event.mount, event.attitude)
        self._leader.saw(t_ns, Sight(direction, event.R, None, event))

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        leader = self._leader
        if leader is None or not leader.knows(peer):
            self.own.measured(peer, t_ns, now_ns, measurements, effects)
            return
        for item in measurements:
            if item.kind == "range":
                leader.ranged(t_ns, peer, float(item.z[0]), float(item.R[0, 0]))
        if len(self._held) >= MAX_HELD:
            self._counters["naming.overflow"] += 1
            self._use(min(self._held), now_ns, effects)
        self._held.setdefault((t_ns, peer), []).extend(measurements)

    def unowned(self, t_ns: int, peer: str, measurement: Measurement) -> None:
        """A two-way range that the peer uses tells robots apart here too."""
        if self._leader is not None:
            self._leader.ranged(t_ns, peer, float(measurement.z[0]), float(measurement.R[0, 0]))

    # -- peers ----------------------------------------------------------------------------------------------

    def hand_on(self, now_ns: int, unusable: Container[str], effects: list[Effect]) -> None:
        """Open contacts for bearings whose names are known, and for ranges that need wait for none any more.

        `unusable`: peers whose clocks are off.
        """
        leader = self._leader
        if leader is None:
            return
        for peer, event in leader.take_named():
            if peer in unusable:
                self._counters["observation.clock_unusable"] += 1
                continue
            self._counters["naming.named"] += 1
            self._held.setdefault((event.t_meas_ns, peer), []).append(told(event))
            effects.append(Named(peer, event.t_meas_ns, event.sensor, event.z))
        until_ns = leader.t_ns + self._settings.lateness.tolerance_ns
        for key in sorted(key for key in self._held if key[0] <= until_ns):
            self._use(key, now_ns, effects)

    def _use(self, key: tuple[int, str], now_ns: int, effects: list[Effect]) -> None:
        t_ns, peer = key
        self.own.measured(peer, t_ns, now_ns, tuple(self._held.pop(key)), effects)

    def heard(self, event: Received, effects: list[Effect]) -> None:
        if not isinstance(event.message.body, MotionReport | HypothesesReport):
            self.own.heard(event, effects)
        elif self._leader is not None:
            t_ns = event.message.header.t_meas_ns - self._clocks.offset_ns(event)
            take_report(self._leader, event, t_ns, self._settings, self._counters)

    def link_changed(self, event: LinkChange) -> None:
        self.own.link_changed(event)
        if self._lives.begun(event) and self._leader is not None:
            self._leader.reborn(event.peer)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        self.own.settled(until_ns, effects)
        self._teller.tell(until_ns, effects)
        if self._leader is not None:
            self._leader.settled(until_ns)

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        self.own.expire(now_ns, effects)
        if self._leader is not None:
            self._leader.act(now_ns, effects)

    def deadline_ns(self) -> int:
        deadline = min(self.own.deadline_ns(), self._teller.deadline_ns(FAR_FUTURE_NS))
        return deadline if self._leader is None else min(deadline, self._leader.deadline_ns(FAR_FUTURE_NS))

    # -- what the own filter does ---------------------------------------------------------------------------

    def instant_ns(self, event: Received) -> int:
        return self.own.instant_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self.own.requested(event, t_ns, effects)

    def replied(self, peer: str, body: Body) -> None:
        self.own.replied(peer, body)

    def contacts(self) -> dict[str, Epoch]:
        return self.own.contacts()

    def mark(self) -> FilterMark | None:
        return self.own.mark()

    def rewind(self, mark: FilterMark) -> None:
        self.own.rewind(mark)
