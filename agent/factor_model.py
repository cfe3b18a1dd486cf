"""What a belief with correlation factors consists of, for the past and the pair protocol, which do not care.

`SeparateModel` keeps the own state apart from the targets (Lyu, Pan, Lv 2019): the factors are of the own state, a
target's belief is fused with the peer's by covariance intersection.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agent.belief import CorrelationStack, PairRecord, Part, RobotState, TargetState, Transition
from agent.estimation.colocalization import Contact, Options, Update, absolute_update, contact
from agent.estimation.gaussian import symmetrize, wrap_components
from agent.estimation.intersection import fuse
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.plausible import agree
from agent.settings import AgentSettings
from agent.tracks import TrackRules, track_ended
from network.messages import (
    MAX_LINES,
    MAX_MESSAGE_BYTES,
    MAX_TARGETS,
    NEVER,
    Belief,
    Epoch,
    JointSnapshot,
    Line,
    Measurement,
    PairRequest,
    Snapshot,
    TargetBelief,
)
from network.wire import size_bound

Array = NDArray[np.float64]
AnySnapshot = Snapshot | JointSnapshot

LONGEST = Epoch(2**62, "r" * 24, 2**53)
"""An epoch that takes as many bytes as any."""


class FactorModel(Protocol):
    """Motion, own measurements, and what is told to peers and learnt from them; n components with factors."""

    @property
    def layout(self) -> StateLayout:
        """Meaning of the components."""
        ...

    @property
    def snapshot_type(self) -> type[AnySnapshot]:
        """What is told to peers, and understood of them."""
        ...

    @property
    def noise_columns(self) -> int:
        """Columns of common noise behind the Psi of every line."""
        ...

    def initial(self) -> RobotState:
        """The state at the start."""
        ...

    def moved(self, state: RobotState, t_ns: int, delta: Array, cov: Array) -> tuple[RobotState, Transition]:
        """The state at a later instant, by an odometry increment (4,) with covariance (4, 4)."""
        ...

    def absolute(self, state: RobotState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Update | None:
        """Use information about the own state alone; None when the posterior would not be positive definite."""
        ...

    def snapshot(self, state: RobotState, peer: str) -> AnySnapshot:
        """The state as it is told to a peer."""
        ...

    def fitting(
        self, snapshot: AnySnapshot, peer: str, measurements: tuple[Measurement, ...], about: AnySnapshot | None
    ) -> AnySnapshot | None:
        """The snapshot without what does not fit into one message, or what a reply to `about` needs not tell.

        None if what must be told does not fit.
        """
        ...

    def usable(self, told: AnySnapshot) -> bool:
        """Whether a peer's snapshot is of this form, of a robot, and of the sizes that the pair's algebra needs."""
        ...

    def contact(
        self,
        initiator: AnySnapshot,
        responder: AnySnapshot,
        initiator_is_low: bool,
        measurements: Sequence[Measurement],
    ) -> Contact:
        """What both sides make of a contact; see `agent.estimation.colocalization.contact`."""
        ...

    def fused(self, other: AnySnapshot, t_ns: int, state: RobotState) -> RobotState:
        """The state with what a peer has told at `t_ns` besides what the factors are of."""
        ...


def moved(settings: AgentSettings, state: RobotState, t_ns: int, delta: Array, cov: Array) -> tuple[RobotState, Array]:
    """State and targets predicted to `t_ns` with an odometry increment; returns (state, F (n, n)).

    Tracks that are over by then are left out.
    """
    localization = settings.localization
    dt_s = (t_ns - state.t_ns) * 1e-9
    own = settings.motion.advance(state.mean, state.cov, delta, cov, dt_s, localization.transform)
    targets = {}
    for target in settings.targets:
        belief = state.targets.get(target.id)
        if belief is not None:
            drifted = target.motion.drift(belief.mean, belief.cov, dt_s, localization.transform)
            if not track_ended(settings.track_end, target.motion.layout, drifted.cov, belief.learnt_ns, t_ns):
                targets[target.id] = replace(belief, mean=drifted.mean, cov=drifted.cov)
    stack = state.stack.left(own.F)
    return RobotState(t_ns, own.mean, own.cov, stack, state.pairs, targets, state.stranger), own.F


class SeparateModel:
    """Own state with factors, targets apart: the forms `safe` and `published`."""

    snapshot_type: type[AnySnapshot] = Snapshot
    noise_columns = 0

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._motions = {target.id: target.motion for target in settings.targets}
        self._rules = TrackRules(settings)
        localization = settings.localization
        self.options = Options(localization.transform, localization.parameters, localization.innovation_cap)

    @property
    def layout(self) -> StateLayout:
        return self._settings.layout

    def initial(self) -> RobotState:
        settings = self._settings
        stack = CorrelationStack(np.zeros((len(settings.mean), 0)))
        start_ns = settings.start_ns
        targets = {
            t.id: TargetState(t.mean, t.cov, start_ns, start_ns) for t in settings.tracked if t.mean is not None
        }
        # Who starts with an error that peers hold too is correlated with all of them, nobody knows how.
        stranger = PairRecord(known=settings.shared is None)
        return RobotState(start_ns, settings.mean, settings.cov, stack, {}, targets, stranger)

    def moved(self, state: RobotState, t_ns: int, delta: Array, cov: Array) -> tuple[RobotState, Transition]:
        after, F = moved(self._settings, state, t_ns, delta, cov)
        return after, Transition(F)

    def absolute(self, state: RobotState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Update | None:
        return absolute_update(state.mean, state.cov, self.layout, model, z, R, self.options)

    def snapshot(self, state: RobotState, peer: str) -> Snapshot:
        record = state.pair(peer)
        n = len(state.mean)
        factor = state.stack.block((Part.FACTOR, peer, NEVER))
        line = state.stack.block((Part.BASE_LINE, peer, NEVER))
        lines = []
        for epoch in record.lines[-MAX_LINES:]:
            block = state.stack.block((Part.LINE, peer, epoch))
            assert block is not None
            lines.append(Line(epoch, block))
        targets = tuple(
            TargetBelief(
                name,
                Belief(self._motions[name].layout.name, target.mean, target.cov),
                max(state.t_ns - target.learnt_ns, 0),
            )
            for name, target in list(state.targets.items())[:MAX_TARGETS]
        )
        return Snapshot(
            Belief(self.layout.name, state.mean, state.cov),
            record.base,
            np.zeros((n, 0)) if factor is None else factor,
            np.eye(n) if line is None else line,
            tuple(lines),
            targets,
            record.known,
        )

    def fitting(
        self, snapshot: AnySnapshot, peer: str, measurements: tuple[Measurement, ...], about: AnySnapshot | None
    ) -> Snapshot:
        """Targets are left out first, then the oldest lines."""
        assert isinstance(snapshot, Snapshot)
        while (snapshot.targets or snapshot.lines) and (
            size_bound(PairRequest(LONGEST, measurements, snapshot)) > MAX_MESSAGE_BYTES
        ):
            self._counters["pair.shortened"] += 1
            if snapshot.targets:
                snapshot = replace(snapshot, targets=snapshot.targets[:-1])
            else:
                snapshot = replace(snapshot, lines=snapshot.lines[1:])
        return snapshot

    def usable(self, told: AnySnapshot) -> bool:
        if not isinstance(told, Snapshot):
            return False
        layout = STATES.get(told.belief.model)
        if layout is None or layout.heading is None:
            return False
        square = (layout.dim, layout.dim)
        return (
            told.belief.cov.shape == square
            and (not told.base.met or told.factor.shape == (layout.dim, self.layout.dim))
            and told.line.shape == square
            and all(line.matrix.shape == square for line in told.lines)
        )

    def contact(
        self,
        initiator: AnySnapshot,
        responder: AnySnapshot,
        initiator_is_low: bool,
        measurements: Sequence[Measurement],
    ) -> Contact:
        assert isinstance(initiator, Snapshot) and isinstance(responder, Snapshot)
        correlated = self._settings.localization.correlation == "factors"
        return contact(initiator, responder, initiator_is_low, measurements, correlated, self.options)

    def fused(self, other: AnySnapshot, t_ns: int, state: RobotState) -> RobotState:
        """Intersect the peer's target beliefs, predicted to the state's instant, with the own ones."""
        assert isinstance(other, Snapshot)
        localization = self._settings.localization
        targets = dict(state.targets)
        for told in other.targets:
            own = targets.get(told.target)
            motion = self._motions.get(told.target)
            if told.target not in self._rules or motion is None or told.belief.model != motion.layout.name:
                self._counters["target.unknown"] += 1
                continue
            mean, cov, learnt_ns = told.belief.mean, told.belief.cov, t_ns - told.age_ns
            if state.t_ns > t_ns:
                drifted = motion.drift(mean, cov, (state.t_ns - t_ns) * 1e-9, localization.transform)
                mean, cov = drifted.mean, drifted.cov
            if own is None:
                if not self._rules.ended(told.target, cov, learnt_ns, state.t_ns):
                    self._counters["track.started"] += 1
                    targets[told.target] = TargetState(mean, cov, state.t_ns, learnt_ns)
                continue
            angles = motion.layout.angles
            if not agree(self._settings.health, own.mean, own.cov, mean, cov, angles):
                self._counters["target.gated"] += 1
                continue
            if localization.correlation == "factors":
                mean, cov, _ = fuse(own.mean, own.cov, mean, cov, angles, localization.fusion_weight)
            else:
                gain = own.cov @ np.linalg.inv(own.cov + cov)
                mean = wrap_components(own.mean + gain @ wrap_components(mean - own.mean, angles), angles)
                cov = symmetrize(own.cov - gain @ own.cov)
            targets[told.target] = TargetState(mean, cov, state.t_ns, max(own.learnt_ns, learnt_ns), own.doubted)
        return replace(state, targets=targets) if targets else state
