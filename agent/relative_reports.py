"""What robots tell each other so that those with a camera find out where all are: how they moved, how high they are.

A robot tells its own odometry in stretches, once all data of them are in; what others tell of motion and hypotheses is
handed to the leader of the robot, if it has a camera.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.effects import Broadcast, Effect
from agent.estimation.correspondence import Hypotheses
from agent.estimation.motion import StateLayout
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.reckoning import extended
from agent.events import Received
from agent.peer_motion import Stretch
from agent.relative_leader import Altitude, Leader, body_motion
from agent.settings import AgentSettings
from network.messages import Channel
from network.relative_messages import Height, HypothesesReport, MotionReport

Array = NDArray[np.float64]

TELL_NS = 40_000_000
"""Motions are told in stretches of at least that, which is each step of an odometry of 20 Hz."""

MAX_TOLD_NS = 5_000_000_000
"""Of a longer stretch nothing is told: it was coasted over."""

AMBIGUOUS = 0.2
"""A second hypothesis as probable as that is made known to people."""


class MotionTeller:
    """Own motions and altitudes from `start_ns` on, until they are told."""

    def __init__(self, settings: AgentSettings, start_ns: int, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._told_ns = start_ns
        self._untold: list[tuple[int, Array, Array]] = []
        self._altitude: Altitude | None = None

    def moved(self, t_ns: int, delta: Array, cov: Array) -> None:
        """The robot has moved on to `t_ns` by an increment (4,), (4, 4)."""
        self._untold.append((t_ns, delta, cov))

    def risen(self, altitude: Altitude) -> bool:
        """The robot has measured its altitude; whether that is the newest."""
        newest = self._altitude is None or altitude.t_ns > self._altitude.t_ns
        if newest:
            self._altitude = altitude
        return newest

    def tell(self, until_ns: int, effects: list[Effect]) -> None:
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

    def deadline_ns(self, never_ns: int) -> int:
        """When `tell` has something to do next."""
        for t_ns, _, _ in self._untold:
            if t_ns - self._told_ns >= TELL_NS:
                return t_ns + self._settings.lateness.settle_ns
        return never_ns


def altitude_of(
    t_ns: int, layout: StateLayout, model: AbsoluteModel | RelativeModel, z: Array, R: Array
) -> Altitude | None:
    """What absolute information tells of the altitude; None if nothing."""
    if not isinstance(model, AbsoluteModel) or layout.altitude is None or layout.altitude not in model.components:
        return None
    row = list(model.components).index(layout.altitude)
    return Altitude(t_ns, float(z[row]), float(R[row, row]))


def take_report(
    leader: Leader, event: Received, t_ns: int, settings: AgentSettings, counters: Counter[str]
) -> None:
    """A leader has heard a motion or hypotheses of a peer, which are of the instant `t_ns` of the own clock."""
    header, body = event.message.header, event.message.body
    assert isinstance(body, MotionReport | HypothesesReport)
    if not leader.knows(header.source):
        counters["motion.stranger" if isinstance(body, MotionReport) else "hypotheses.stranger"] += 1
    elif t_ns > event.t_ns + settings.round.period_ns:
        counters["round.future"] += 1
    elif isinstance(body, HypothesesReport):
        leader.told.hear(header.source, header.t_meas_ns, t_ns, body.part, body.parts, hypotheses_of(body))
    else:
        height, altitude = body.height, None
        if height is not None:
            altitude = Altitude(t_ns - height.age_ns, height.altitude_m, height.variance_m2)
        leader.heard_motion(header.source, Stretch(t_ns - body.span_ns, t_ns, body.velocity, body.cov), altitude)


def identified(leader: Leader, count: int) -> str:
    """How many of `count` others a leader has identified, and who is ambiguous, for people."""
    found = leader.relatives()
    unsure = "".join(
        f"; {item.peer} ambiguous ({item.ambiguity:.2f})" for item in found if item.ambiguity >= AMBIGUOUS
    )
    unsure += "".join(f"; {peer} not heard" for peer in leader.unheard())
    return f"{sum(item.confirmed for item in found)} of {count} identified{unsure}"


def hypotheses_of(report: HypothesesReport) -> dict[str, Hypotheses]:
    """What a report says of each robot."""
    return {
        item.subject: Hypotheses(
            item.weights,
            item.means,
            item.covs,
            item.priors,
            item.prior_covs,
            None if item.priors is None else np.array(item.prior_known, dtype=bool),
        )
        for item in report.subjects
        if len(item.weights)
    }
