"""Once per round: what the robot tells its neighbours for their plans, and its own choice of motion.

It waits until the round's corrections are in and neighbours have told what they believe, for a while, and plans with
what there is. The command ends by itself if no other one follows.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import CooperativeFilter
from agent.effects import Broadcast, Effect, Estimate, Steer
from agent.estimation.motion import STATES
from agent.events import LinkChange, Observation, Received
from agent.lookout import Lookout
from agent.pair_clock import PairClocks
from agent.peer_tables import remember
from agent.planning.choice import build_planner
from agent.planning.situation import Member, Situation, TargetView
from agent.rounds import Neighbours, RoundClock, Told
from agent.settings import AgentSettings
from network.messages import Belief, Channel, RoundReport, RoundStage, TargetBelief

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62

LEAST_HELD_NS = 500_000_000
"""A command lasts so long at least: of quick rounds a few may be lost before the vehicle stops."""

SILENT_NS = 60_000_000_000
"""Who flies keeps off the place where another one was heard last for so long: it may hover there."""

FALLBACK_ROUNDS = 5
"""After a plan that took too long, so many are made by the fallback."""


class Pilot:
    """Plans of a robot whose `planning.kind` is not `none`."""

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._planner = build_planner(settings.planning, settings.robot)
        # Who flies has no simpler law, and hardly needs one: it tries nothing out.
        simpler = replace(settings.planning, kind="potential", form="improved")
        flies = settings.planning.kind == "encircle"
        self._fallback = self._planner if flies else build_planner(simpler, settings.robot)
        self._motions = {target.id: target.motion for target in settings.targets}
        self._clocks = PairClocks(settings)
        self._clock = RoundClock(settings.round, settings.start_ns)
        self._neighbours = Neighbours(settings.round)
        self._lookout = Lookout(settings)
        self._placed: dict[str, tuple[int, Member]] = {}
        self._lean = settings.round.lean and settings.localization.kind == "jlatt"
        self._open_ns: int | None = None
        self._simple_until = 0
        self._refused: str | None = None
        self._last = Steer((0.0, 0.0, 0.0), 0.0, settings.start_ns)

    # -- what comes in --------------------------------------------------------------------------------------

    def heard(self, event: Received) -> None:
        """A report of a neighbour, of whichever stage."""
        header, body = event.message.header, event.message.body
        if isinstance(body, RoundReport):
            t_ns = header.t_meas_ns - self._clocks.offset_ns(event)
            if t_ns <= event.t_ns + self._settings.round.period_ns:
                self._neighbours.hear(Told(header.source, t_ns, body))

    def saw(self, peer: str, event: Observation) -> None:
        """An own measurement of a peer."""
        self._lookout.saw(peer, event)

    def link_changed(self, event: LinkChange) -> None:
        """A peer has appeared, perhaps in a new life, or fallen silent."""
        self._neighbours.link_changed(event)

    def obeyed(self, refused: str | None) -> None:
        """What the autopilot says of being steered; None: it obeys."""
        self._refused = refused

    def overran(self, now_ns: int) -> None:
        """A plan took too long."""
        self._counters["plan.overrun"] += 1
        self._simple_until = self._index(now_ns) + FALLBACK_ROUNDS + 1

    # -- rounds ---------------------------------------------------------------------------------------------

    def _index(self, t_ns: int) -> int:
        return (t_ns - self._settings.round.anchor_ns) // self._settings.round.period_ns

    def act(self, now_ns: int, source: CooperativeFilter, effects: list[Effect]) -> None:
        """Tell and plan, if it is time for that."""
        tolerance = self._settings.lateness.tolerance_ns
        due_ns = self._clock.due(source.complete_ns + tolerance)
        if due_ns is not None:
            estimate = source.estimate()
            if self._open_ns is not None and estimate is not None:
                # Neighbours were waited for until the next round: the plan is made with what there is.
                effects.append(self._steer(self._open_ns, estimate))
            self._counters["plan.skipped"] += self._clock.open(due_ns)
            self._open_ns = due_ns
            if estimate is not None and not self._lean:
                effects.append(Broadcast(Channel.BELIEF, estimate.t_ns, self._report(estimate)))
        if self._open_ns is None or not self._ready(now_ns, self._open_ns):
            return
        estimate = source.estimate()
        if estimate is not None:
            effects.append(self._steer(self._open_ns, estimate))
        self._open_ns = None

    def _ready(self, now_ns: int, t_ns: int) -> bool:
        due = now_ns >= t_ns + 2 * self._settings.round.wait_ns
        return due or self._lean or self._neighbours.all_told(RoundStage.POSTERIOR, t_ns)

    def deadline_ns(self) -> int:
        """When a round's waiting is over; a round begins with the filter's."""
        return FAR_FUTURE_NS if self._open_ns is None else self._open_ns + 2 * self._settings.round.wait_ns

    def _report(self, estimate: Estimate) -> RoundReport:
        targets = tuple(
            TargetBelief(
                track.target,
                Belief(track.model, track.mean, track.cov),
                0 if track.learnt_ns is None else max(0, estimate.t_ns - track.learnt_ns),
            )
            for track in sorted(estimate.tracks, key=lambda track: track.target)
        )
        belief = Belief(estimate.model, estimate.mean, estimate.cov)
        return RoundReport(
            RoundStage.POSTERIOR, belief, np.array(self._last.velocity_mps), self._last.yaw_rate_radps, targets
        )

    def _steer(self, t_ns: int, estimate: Estimate) -> Steer:
        index = self._index(t_ns)
        simple = index < self._simple_until
        planner = self._fallback if simple else self._planner
        assert planner is not None
        command = planner.command(self._situation(t_ns, index, estimate))
        round_ = self._settings.round
        until_ns = t_ns + max(2 * (round_.period_ns + round_.wait_ns), LEAST_HELD_NS)
        velocity = command.speed_mps, command.left_mps, command.up_mps
        self._last = Steer(velocity, command.yaw_rate_radps, until_ns)
        self._counters["plan.simple" if simple else "plan.made"] += 1
        return self._last

    # -- what is known --------------------------------------------------------------------------------------

    def _situation(self, t_ns: int, index: int, estimate: Estimate) -> Situation:
        newest: dict[str, Told[RoundReport]] = {}
        for stage in RoundStage:
            for told in self._neighbours.newest(stage, t_ns):
                if told.peer not in newest or told.t_ns >= newest[told.peer].t_ns:
                    newest[told.peer] = told
        self._lookout.place(estimate)
        found = [self._member(told.peer, told.report, t_ns - told.t_ns) for told in newest.values()]
        others = [other for other in found if other is not None]
        if self._settings.planning.kind == "encircle":
            silent = self._silent(t_ns, set(newest))
            for other in others:
                remember(self._placed, other.robot, (newest[other.robot].t_ns, other))
            others += silent
        else:
            others += self._lookout.members(t_ns, set(newest))
        me = self._member(self._settings.robot, self._report(estimate), 0)
        assert me is not None
        dt_s = self._settings.round.period_ns * 1e-9
        return Situation(index, dt_s, me, tuple(sorted(others, key=lambda other: other.robot)))

    def _silent(self, t_ns: int, heard: set[str]) -> list[Member]:
        """Those who have told nothing lately, where they told to be last."""
        return [
            replace(member, targets=(), age_s=(t_ns - told_ns) * 1e-9, silent=True)
            for peer, (told_ns, member) in self._placed.items()
            if peer not in heard and t_ns - told_ns <= SILENT_NS
        ]

    def _member(self, robot: str, report: RoundReport, age_ns: int) -> Member | None:
        """A robot as a planner sees it; None if it has no heading."""
        layout = STATES[report.belief.model]
        if layout.heading is None:
            return None
        pose = [*layout.position[:2], layout.heading]
        views = (self._view(target) for target in report.targets)
        return Member(
            robot,
            report.belief.mean[pose],
            report.belief.cov[np.ix_(pose, pose)],
            float(report.velocity[0]),
            report.yaw_rate,
            tuple(view for view in views if view is not None),
            max(0, age_ns) * 1e-9,
            0.0 if layout.altitude is None else float(report.belief.mean[layout.altitude]),
        )

    def _view(self, told: TargetBelief) -> TargetView | None:
        motion = self._motions.get(told.target)
        if motion is None or motion.layout.name != told.belief.model:
            return None
        return TargetView(told.target, motion, told.belief.mean, told.belief.cov)

    def status(self) -> dict[str, object]:
        """A plain summary for people."""
        return {
            "kind": self._settings.planning.kind,
            "speed_mps": self._last.velocity_mps[0],
            "velocity_mps": list(self._last.velocity_mps),
            "yaw_rate_radps": self._last.yaw_rate_radps,
            "neighbours": [told.peer for told in self._neighbours.newest(RoundStage.POSTERIOR, self._clock.next_ns)],
            "refused": self._refused,
        }
