"""A robot that locates others relative to its own body (kind `relative`).

Its own pose is what it is told and what its odometry says, as of the kind `fixed`. Every robot tells how it moves, and
its altitude; those with a camera make of it, of ranges and of bearings where all others are (`agent.relative_leader`).
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark
from agent.effects import Broadcast, Effect, Estimate
from agent.estimation.gate_test import GateTest
from agent.estimation.mounting import rotation
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.reckoning import extended
from agent.events import LEVEL, LinkChange, Observation, Received
from agent.fixed_filter import FAR_FUTURE_NS, FixedFilter
from agent.pair_clock import PairClocks
from agent.peer_motion import Stretch
from agent.peer_tables import remember
from agent.relative_leader import Altitude, Leader, body_motion, heard
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings
from network.messages import Body, Channel, Epoch, Measurement
from network.relative_messages import Height, HypothesesReport, MotionReport

Array = NDArray[np.float64]

TELL_NS = 40_000_000
"""Motions are told in stretches of at least that, which is each step of an odometry of 20 Hz."""

MAX_TOLD_NS = 5_000_000_000
"""Of a longer stretch nothing is told: it was coasted over."""

AMBIGUOUS = 0.2
"""A second hypothesis as probable as that is made known to people."""


class RelativeFilter:
    """The kind `relative`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def gate_tests(self) -> tuple[int, dict[str, GateTest]]:
        """How the last scan's bearings were judged, by peer, and the instant it has been processed to (own clock)."""
        if self._leader is None:
            return self.t_ns, {}
        judge = self._leader.correspondence
        tests = {peer: test for peer in judge.peers if (test := judge.gate_test(peer)) is not None}
        return self._leader.t_ns, tests

    def __init__(self, settings: AgentSettings, counters: Counter[str], saved: SavedSplit | None = None) -> None:
        self._settings, self._counters = settings, counters
        self._own = FixedFilter(settings, counters, saved)
        self._clocks = PairClocks(settings)
        self._lives: dict[str, tuple[int, int]] = {}
        self._leader: Leader | None = None
        if settings.relative.leads:
            self._leader = Leader(settings, self._own.t_ns, counters)
        self._told_ns = self._own.t_ns
        self._untold: list[tuple[int, Array, Array]] = []
        self._altitude: Altitude | None = None
        self._revision = object()
        self._of: tuple[object, object] = (None, None)
        self._estimate: Estimate | None = None

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
        found = self.estimate().relatives
        unsure = "".join(
            f"; {item.peer} ambiguous ({item.ambiguity:.2f})" for item in found if item.ambiguity >= AMBIGUOUS
        )
        unsure += "".join(f"; {peer} not heard" for peer in self._leader.unheard())
        confirmed = sum(item.confirmed for item in found)
        return f"relative, {kind}", f"{confirmed} of {len(relative.peers)} identified{unsure}"

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
        self._untold.append((t_ns, delta, cov))
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
        up = self._settings.layout.altitude
        if not isinstance(model, AbsoluteModel) or up is None or up not in model.components:
            return
        row = list(model.components).index(up)
        altitude = Altitude(t_ns, float(z[row]), float(R[row, row]))
        if self._altitude is None or altitude.t_ns > self._altitude.t_ns:
            self._altitude = altitude
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
            self._saw(self._leader, t_ns, event, event.attitude, None)

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        """Ranges have names. A name that a bearing has counts where all of them do."""
        for item in measurements:
            if self._leader is not None and item.kind == "range":
                self._leader.ranged(t_ns, peer, float(item.z[0]), float(item.R[0, 0]))
            elif self._leader is not None and item.kind == "bearing3":
                of = peer if self._settings.relative.known else None
                self._saw(self._leader, t_ns, item, LEVEL, of)
            else:
                self._counters["relative.unused"] += 1

    @staticmethod
    def _saw(
        leader: Leader,
        t_ns: int,
        found: Observation | Measurement,
        attitude: tuple[float, float],
        of: str | None,
    ) -> None:
        """`attitude`: roll and pitch of the body; a measurement for a peer is as if it were level."""
        _, _, _, *turns = found.mount
        z = found.z
        if any(turns) or attitude != LEVEL:
            (cos_az, cos_el), (sin_az, sin_el) = np.cos(z), np.sin(z)
            ray = np.array([cos_el * cos_az, cos_el * sin_az, sin_el])
            x, y, up = rotation(*attitude, 0.0) @ rotation(*turns) @ ray
            z = np.array([np.arctan2(y, x), np.arctan2(up, np.hypot(x, y))])
        leader.saw(t_ns, z, found.R, of)

    # -- peers ----------------------------------------------------------------------------------------------

    def heard(self, event: Received, effects: list[Effect]) -> None:
        header, body = event.message.header, event.message.body
        leader = self._leader
        if not isinstance(body, MotionReport | HypothesesReport):
            self._counters["received.unused"] += 1
            return
        if leader is None:
            return
        if not leader.knows(header.source):
            self._counters["motion.stranger" if isinstance(body, MotionReport) else "hypotheses.stranger"] += 1
            return
        t_ns = header.t_meas_ns - self._clocks.offset_ns(event)
        if t_ns > event.t_ns + self._settings.round.period_ns:
            self._counters["round.future"] += 1
        elif isinstance(body, HypothesesReport):
            leader.told.hear(header.source, header.t_meas_ns, t_ns, body.part, body.parts, heard(body))
        else:
            height = body.height
            altitude = None
            if height is not None:
                altitude = Altitude(t_ns - height.age_ns, height.altitude_m, height.variance_m2)
            stretch = Stretch(t_ns - body.span_ns, t_ns, body.velocity, body.cov)
            leader.heard_motion(header.source, stretch, altitude)

    def link_changed(self, event: LinkChange) -> None:
        life = event.incarnation, event.boot_id
        if not event.up or self._lives.get(event.peer) == life:
            return
        known = event.peer in self._lives
        remember(self._lives, event.peer, life)
        if known and self._leader is not None:
            self._leader.reborn(event.peer)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        self._tell(until_ns, effects)
        if self._leader is not None:
            self._leader.settled(until_ns)

    def _tell(self, until_ns: int, effects: list[Effect]) -> None:
        """How the robot has moved up to an instant all data of which are in."""
        total, total_cov, used = np.zeros(4), np.zeros((4, 4)), 0
        for index, (t_ns, delta, cov) in enumerate(self._untold):
            if t_ns > until_ns:
                break
            total, total_cov = extended(total, total_cov, delta, cov) if index > used else (delta, cov)
            if t_ns - self._told_ns >= TELL_NS:
                self._tell_stretch(t_ns, total, total_cov, effects)
                used = index + 1
        del self._untold[:used]

    def _tell_stretch(self, t_ns: int, delta: Array, cov: Array, effects: list[Effect]) -> None:
        span_ns, self._told_ns = t_ns - self._told_ns, t_ns
        if span_ns > MAX_TOLD_NS:
            self._counters["motion.untold"] += 1
            return
        height, altitude = None, self._altitude
        if altitude is not None and t_ns - span_ns < altitude.t_ns <= t_ns:
            height = Height(altitude.value, altitude.variance, t_ns - altitude.t_ns)
        motion = body_motion(span_ns, delta, cov)
        effects.append(Broadcast(Channel.BELIEF, t_ns, MotionReport(span_ns, motion.velocity, motion.cov, height)))

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        if self._leader is not None:
            self._leader.act(now_ns, effects)

    def deadline_ns(self) -> int:
        deadline = FAR_FUTURE_NS if self._leader is None else self._leader.deadline_ns(FAR_FUTURE_NS)
        for t_ns, _, _ in self._untold:
            if t_ns - self._told_ns >= TELL_NS:
                return min(deadline, t_ns + self._settings.lateness.settle_ns)
        return deadline

    def instant_ns(self, event: Received) -> int:
        return self._own.instant_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._own.requested(event, t_ns, effects)

    def replied(self, peer: str, body: Body) -> None:
        self._own.replied(peer, body)
