"""A robot that locates others relative to its own body (kind `relative`).

Its own pose is what it is told and what its odometry says, as of the kind `fixed`. Every robot tells how it moves, and
its altitude; those with a camera make of it, of ranges and of bearings where all others are (`agent.relative_leader`).
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark
from agent.effects import Effect, Estimate
from agent.estimation.gate_test import GateTest
from agent.estimation.mounting import in_body
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.events import LEVEL, LinkChange, Observation, Received
from agent.fixed_filter import FAR_FUTURE_NS, FixedFilter
from agent.pair_clock import PairClocks
from agent.peer_tables import Lives
from agent.relative_leader import Leader, Sight
from agent.relative_reports import MotionTeller, altitude_of, identified, take_report
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings
from network.messages import Body, Epoch, Measurement
from network.relative_messages import HypothesesReport, MotionReport

Array = NDArray[np.float64]


class RelativeFilter:
    """The kind `relative`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(self, settings: AgentSettings, counters: Counter[str], saved: SavedSplit | None = None) -> None:
        self._settings, self._counters = settings, counters
        self._own = FixedFilter(settings, counters, saved)
        self._clocks = PairClocks(settings)
        self._lives = Lives()
        self._leader: Leader | None = None
        if settings.relative.leads:
            self._leader = Leader(settings, self._own.t_ns, counters)
        self._teller = MotionTeller(settings, self._own.t_ns, counters)
        self._revision = object()
        self._of: tuple[object, object] = (None, None)
        self._estimate: Estimate | None = None

    def gate_tests(self) -> tuple[int, dict[str, GateTest]]:
        """How the last scan's bearings were judged, by peer, and the instant it has been processed to (own clock)."""
        if self._leader is None:
            return self.t_ns, {}
        judge = self._leader.correspondence
        tests = {peer: test for peer in judge.peers if (test := judge.gate_test(peer)) is not None}
        return self._leader.t_ns, tests

    @property
    def t_ns(self) -> int:
        return self._own.t_ns

    @property
    def complete_ns(self) -> int:
        return self._own.t_ns

    @property
    def revision(self) -> object:
        now = self._own.revision, None if self._leader is None else self._leader.revision
        if self._of[0] is not now[0] or self._of[1] is not now[1]:
            self._of, self._revision, self._estimate = now, object(), None
        return self._revision

    def estimate(self) -> Estimate:
        assert self.revision is self._revision
        if self._estimate is None:
            own = self._own.estimate()
            relatives = () if self._leader is None else self._leader.relatives()
            self._estimate = Estimate(own.t_ns, own.model, own.mean, own.cov, (), relatives)
        return self._estimate

    def form(self) -> tuple[str, str]:
        """How many others are identified, and who is ambiguous."""
        relative = self._settings.relative
        kind = "known" if relative.known else relative.correspondence.kind
        if self._leader is None:
            return f"relative, {kind}", "no camera: it tells how it moves"
        return f"relative, {kind}", identified(self._leader, len(relative.peers))

    def contacts(self) -> dict[str, Epoch]:
        """There are no contacts of pairs."""
        return {}

    def saved(self) -> SavedSplit:
        """Where others are is found out anew: they have moved on while the robot was down."""
        return self._own.saved()

    def mark(self) -> FilterMark | None:
        return self._own.mark()

    def rewind(self, mark: FilterMark) -> None:
        self._own.rewind(mark)

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        t0_ns = self._own.t_ns
        self._own.advance(t_ns, delta, cov)
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
        self._own.absolute(t_ns, kind, model, z, R, landmark)
        altitude = altitude_of(t_ns, self._settings.layout, model, z, R)
        if altitude is None:
            return
        self._teller.risen(altitude)
        if self._leader is not None:
            self._leader.altitude(self._settings.robot, altitude)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self._counters["relative.unused"] += 1

    def anonymous(self, t_ns: int, event: Observation) -> None:
        """The camera has seen somebody."""
        if self._leader is None or event.kind != "bearing3":
            self._counters["relative.unused"] += 1
        elif self._settings.relative.known:
            self._counters["relative.no_identity"] += 1
        else:
            direction = in_body(event.z, event.mount, event.attitude)
            self._leader.saw(t_ns, Sight(direction, event.R, None))

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        """Ranges have names. A name that a bearing has counts where all of them do."""
        for item in measurements:
            if self._leader is not None and item.kind == "range":
                self._leader.ranged(t_ns, peer, float(item.z[0]), float(item.R[0, 0]))
            elif self._leader is not None and item.kind == "bearing3":
                of = peer if self._settings.relative.known else None
                self._leader.saw(t_ns, Sight(in_body(item.z, item.mount, LEVEL), item.R, of))
            else:
                self._counters["relative.unused"] += 1

    # -- peers ----------------------------------------------------------------------------------------------

    def heard(self, event: Received, effects: list[Effect]) -> None:
        if not isinstance(event.message.body, MotionReport | HypothesesReport):
            self._counters["received.unused"] += 1
        elif self._leader is not None:
            t_ns = event.message.header.t_meas_ns - self._clocks.offset_ns(event)
            take_report(self._leader, event, t_ns, self._settings, self._counters)

    def link_changed(self, event: LinkChange) -> None:
        if self._lives.begun(event) and self._leader is not None:
            self._leader.reborn(event.peer)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        self._teller.tell(until_ns, effects)
        if self._leader is not None:
            self._leader.settled(until_ns)

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        if self._leader is not None:
            self._leader.act(now_ns, effects)

    def deadline_ns(self) -> int:
        leader_ns = FAR_FUTURE_NS if self._leader is None else self._leader.deadline_ns(FAR_FUTURE_NS)
        return min(leader_ns, self._teller.deadline_ns(FAR_FUTURE_NS))

    def instant_ns(self, event: Received) -> int:
        return self._own.instant_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._own.requested(event, t_ns, effects)

    def replied(self, peer: str, body: Body) -> None:
        self._own.replied(peer, body)
