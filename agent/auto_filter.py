"""The form `auto`: correlation factors while so few robots have met that they are exact, no factors beyond that.

Factors of a pair cannot know what a third robot's contacts did to the correlation. Among three robots little is missed
and the form `joint` is honest and the more accurate one; among more it claims too much, and `split_joint` takes over,
for good. What counts is the group: the robots whose errors may be correlated with the own one through any chain of
contacts. It travels with every belief of the form `joint`. Measurements far from linear, ranges of a robot that hardly
knows where it is for instance, make factors overconfident in any group, and are a reason to hand over as well.

Hand-over: the joint belief of robot and targets stays as it is, and all of its covariance counts as shared, correlated
with every other robot's in an unknown way. So nothing is counted twice, whatever the peers know of it. Instants before
the hand-over cannot be returned to. A robot that has handed over refuses requests of the form `joint`; the refusal, and
its own requests, make its peers hand over too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import CooperativeFilter, FilterMark
from agent.effects import Effect, Estimate
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.split_joint import Split
from agent.events import LinkChange, Observation, Received
from agent.health import Health
from agent.joint_filter import JointFilter
from agent.joint_room import has_room
from agent.joint_tracks import JointState
from agent.peer_tables import remember
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings, TrackEnd
from agent.split_filter import SplitFilter
from network.messages import (
    MAX_GROUP,
    Body,
    Epoch,
    JointSnapshot,
    Measurement,
    PairReply,
    PairRequest,
    ReplyStatus,
    SplitRequest,
)

Array = NDArray[np.float64]
CountNis = Callable[[str, float], None]

MAX_NONLINEARITY = 3.0
"""Measurements whose second-order residual is as large as their noise, in number, after which factors are given up.

Such errors recur, and every chain of contacts brings them back as if they were new information. One or two happen to
anybody who starts far from the truth; where they matter there are dozens.
"""


class AutoFilter:
    """The form `auto`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False
    """Factors are not saved, hence nothing that peers rely on."""

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: CountNis,
        saved: SavedSplit | None = None,
        *,
        health: Health | None = None,
    ) -> None:
        """`saved`: what to begin with; the form is `split_joint` then."""
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        self._health = health = health or Health(settings.health, counters)
        self._joint: JointFilter | None = None
        self._active: CooperativeFilter
        self._lives: dict[str, LinkChange] = {}
        followed = [(target.id, target.motion.layout) for target in settings.tracked]
        if saved is not None:
            self._active = SplitFilter(settings, counters, count_nis, saved, health=health)
            self._why = "started from saved state"
        elif settings.found_out:
            self._active = SplitFilter(settings, counters, count_nis, health=health)
            self._why = "the robot has not started with the others"
        elif settings.track_end != TrackEnd() or any(target.mean is None for target in settings.tracked):
            self._active = SplitFilter(settings, counters, count_nis, health=health)
            self._why = "tracks start or end"
        elif has_room(settings.layout, followed):
            self._active = self._joint = JointFilter(settings, counters, count_nis, health=health)
            self._joint.group = frozenset((settings.robot,))
            self._why = f"at most {MAX_GROUP} robots have met"
        else:
            self._active = SplitFilter(settings, counters, count_nis, health=health)
            self._why = "factors of robot and targets do not fit into a message"

    @property
    def active(self) -> CooperativeFilter:
        """The filter of the form that is on."""
        return self._active

    @property
    def t_ns(self) -> int:
        return self._active.t_ns

    @property
    def complete_ns(self) -> int:
        return self.t_ns

    @property
    def revision(self) -> object:
        return self._active.revision

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        self._active.advance(t_ns, delta, cov)

    def estimate(self) -> Estimate | None:
        return self._active.estimate()

    def contacts(self) -> dict[str, Epoch]:
        return self._active.contacts()

    def form(self) -> tuple[str, str]:
        return self._active.form()[0], self._why

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        self._active.absolute(t_ns, kind, model, z, R, landmark)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self._active.sighting(t_ns, target, event)
        self._check_linearity()

    def mark(self) -> FilterMark | None:
        kept = self._active.mark()
        return None if kept is None else FilterMark(self, (self._joint, self._active, self._why, kept))

    def rewind(self, mark: FilterMark) -> None:
        """A hand-over because of what was measured is taken back with it."""
        kept = cast("tuple[JointFilter | None, CooperativeFilter, str, FilterMark]", mark.kept)
        self._joint, self._active, self._why, before = kept
        self._active.rewind(before)

    # -- which form is on -----------------------------------------------------------------------------------

    def _meets(self, others: frozenset[str] | None) -> None:
        """Errors of `others` are about to become correlated with the own one: hand over if they are too many."""
        if self._joint is None:
            return
        if others is None or self._joint.group is None:
            self._hand_over("a peer does not count whom it has met")
            return
        group = self._joint.group | others
        if len(group) > MAX_GROUP:
            self._hand_over(f"errors of {', '.join(sorted(group))} would be correlated")
        else:
            self._joint.group = group

    def _check_linearity(self) -> None:
        if self._joint is not None and self._joint.nonlinearity > MAX_NONLINEARITY:
            self._hand_over("measurements keep being far from linear")

    def _hand_over(self, why: str) -> None:
        assert self._joint is not None
        start = self._without_factors(self._joint)
        split = SplitFilter(self._settings, self._counters, self._count_nis, start, health=self._health)
        for event in self._lives.values():
            split.link_changed(event)
        self._joint, self._active, self._why = None, split, why
        self._counters["form.handed_over"] += 1

    def _without_factors(self, joint: JointFilter) -> SavedSplit:
        """The joint belief, all of it shared."""
        state = joint.state
        tracks = tuple(track.target for track in joint.estimate().tracks)
        split_cov = Split(np.zeros_like(state.cov), state.cov)
        # When something was last learnt of a track is not kept with factors: not before the start is what is known.
        learnt_ns = (self._settings.start_ns,) * len(tracks)
        return SavedSplit(JointState(state.t_ns, state.mean, split_cov, tracks, learnt_ns), joint.contacts())

    def saved(self) -> SavedSplit:
        if self._joint is not None:
            return self._without_factors(self._joint)
        assert isinstance(self._active, SplitFilter)
        return self._active.saved()

    # -- peers ----------------------------------------------------------------------------------------------

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        self._meets(frozenset((peer,)))
        self._active.measured(peer, t_ns, now_ns, measurements, effects)

    def instant_ns(self, event: Received) -> int:
        return self._active.instant_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        peer, body = event.message.header.source, event.message.body
        if self._joint is not None and isinstance(body, SplitRequest):
            self._hand_over(f"{peer} keeps no factors")
        elif isinstance(body, PairRequest) and isinstance(body.snapshot, JointSnapshot):
            self._meets(body.snapshot.group)
        self._active.requested(event, t_ns, effects)
        self._check_linearity()

    def replied(self, peer: str, body: Body) -> None:
        if self._joint is not None and isinstance(body, PairReply):
            if body.status is ReplyStatus.OTHER_FORM:
                self._hand_over(f"{peer} keeps no factors")
            elif isinstance(body.snapshot, JointSnapshot):
                self._meets(body.snapshot.group)
        self._active.replied(peer, body)
        self._check_linearity()

    def heard(self, event: Received, effects: list[Effect]) -> None:
        self._active.heard(event, effects)

    def link_changed(self, event: LinkChange) -> None:
        remember(self._lives, event.peer, event, self._active.contacts())
        self._active.link_changed(event)

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        self._active.settled(until_ns, effects)

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        self._active.expire(now_ns, effects)

    def deadline_ns(self) -> int:
        return self._active.deadline_ns()
