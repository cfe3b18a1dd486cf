"""A robot and its targets as one belief with a split error covariance, and what happens to it, as pure functions.

The robot's state comes first, the targets' tracks follow in the order they were started in. Noise of the own motion and
sensors is private until it is told; the targets' prior and process noise are the same for every robot that tracks them,
hence shared from the start (see `agent.estimation.split_joint`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.colocalization import Options, sighting_update
from agent.estimation.gaussian import is_positive_definite, symmetrize, wrap_components
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.split_joint import Split, SplitUpdate, update_from_peer, update_own, update_own_recurring
from agent.factor_model import LONGEST
from agent.joint_layout import JointLayout, Met
from agent.joint_tracks import JointState, JointTracks, learnt
from agent.settings import AgentSettings
from agent.tracks import CONTRADICTIONS
from network.messages import (
    MAX_JOINT_DIM,
    MAX_MESSAGE_BYTES,
    MAX_TARGETS,
    Measurement,
    SplitRequest,
    SplitSnapshot,
)
from network.wire import size_bound

Array = NDArray[np.float64]

RESIDUAL_FACTOR = 6.0
"""How often the second-order residual of a measurement of a robot or target is charged.

Where both ends are uncertain, errors of linearization recur with the same sign as long as the geometry stays; white
noise of their size is too little.
"""

RECURRING = 2e-3
"""Share of that residual that may be correlated with the own error in an unknown way: no repetition averages it out."""

SAME_TARGET_M2 = 1e-4
"""Variance by which two robots' tracks are taken to be of one target."""

UNKNOWN_RAD2 = 2.0 * math.pi**2 / 3.0
"""Variance of a heading of which nothing is known, twice that of an error spread evenly over a turn."""

INDIFFERENT_RAD2 = 2.25
"""Variance of a heading from which on it is of no use, and a position is worth more than what is left of it."""

CONTRADICTING = 9.0
"""NIS per degree of freedom of a sighting that does not agree with a track."""

NEGLIGIBLE = 1e-2
"""Residuals below this share of a measurement's variance do not recur noticeably."""


@dataclass(slots=True, eq=False)
class Used:
    """A state after information was used, and the NIS per degree of freedom of that; None if there was none."""

    state: JointState
    nis: float | None


class JointModel:
    """Motion and measurements of a joint state with a split covariance, with the settings of one robot."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._layouts: dict[tuple[str, ...], JointLayout] = {}
        self._own = slice(0, settings.layout.dim)
        self.tracks = JointTracks(settings)

    def _layout(self, state: JointState) -> JointLayout:
        found = self._layouts.get(state.tracks)
        if found is None:
            found = self._layouts[state.tracks] = JointLayout(self._settings, state.tracks)
        return found

    # -- motion ---------------------------------------------------------------------------------------------

    def moved(self, state: JointState, t_ns: int, delta: Array, delta_cov: Array) -> JointState:
        """The state at `t_ns`: the robot by an odometry increment (4,), (4, 4), the targets by their models.

        Tracks that are over by then are left out.
        """
        dt_s = (t_ns - state.t_ns) * 1e-9
        found = self._layout(state).moved(state.mean, state.cov, dt_s, delta, delta_cov)
        split = self._within_a_turn(state.split.mapped(found.F, found.own_noise, found.target_noise))
        return self.tracks.aged(state.with_belief(found.mean, split, t_ns), dt_s)

    def _within_a_turn(self, split: Split) -> Split:
        """The split with an own heading no less sure than an unknown one, which has nothing to do with the rest.

        The wrapped error of such a heading is within half a turn, and as good as independent of what the unwrapped one
        was correlated with.
        """
        heading = self._settings.layout.heading
        assert heading is not None
        parts = split.private, split.shared
        variance = sum(float(part[heading, heading]) for part in parts)
        if variance <= UNKNOWN_RAD2:
            return split
        found = []
        for part in parts:
            lost, kept = part.copy(), float(part[heading, heading])
            lost[heading, :] = lost[:, heading] = 0.0
            lost[heading, heading] = kept * UNKNOWN_RAD2 / variance
            found.append(lost)
        return Split(*found)

    # -- own measurements -----------------------------------------------------------------------------------

    def absolute(self, state: JointState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Used:
        """Use information about the own state alone."""
        return self._measured(state, model, z, R, self._own, 1.0)

    def sighting(self, state: JointState, target: str, model: RelativeModel, z: Array, R: Array) -> Used:
        """Use a relative measurement of a target, or start its track; a state without one is left alone otherwise."""
        own = state.mean[self._own], state.cov[self._own, self._own]
        if target not in state.tracks:
            start = self.tracks.rules.started(target, model, own, state.t_ns, z, R)
            if start is not None:
                return Used(self.tracks.started(state, target, start, state.t_ns), None)
            beside = self._beside(state, target, model, z, R)
            if beside is not None:
                return beside
            state = self.tracks.joined(state, target)
        else:
            block = self._layout(state).blocks[state.tracks.index(target)]
            track = state.mean[block], state.cov[block, block]
            again = self.tracks.rules.begun_again(target, model, own, track, state.t_ns, z, R)
            if again is not None:
                state = self.tracks.without(state, {target})
                return Used(self.tracks.started(state, target, again, state.t_ns), None)
            if state.doubted.get(target, 0) >= CONTRADICTIONS:
                state = self.tracks.without(state, {target})
                return self._again(state, target, model, z, R)
        used = self._measured(state, model, z, R, self._layout(state).with_target(target), RESIDUAL_FACTOR)
        state = self.tracks.judged(used.state, target, used.nis is None or used.nis <= CONTRADICTING)
        return Used(learnt(state, {target: state.t_ns}), used.nis)

    def _again(self, state: JointState, target: str, model: RelativeModel, z: Array, R: Array) -> Used:
        """Begin a track anew that has been contradicted on end, and is out of `state`: it was on a wrong side."""
        own, rules = (state.mean[self._own], state.cov[self._own, self._own]), self.tracks.rules
        start = rules.started(target, model, own, state.t_ns, z, R)
        if start is not None:
            return Used(self.tracks.started(state, target, start, state.t_ns), None)
        # A range tells how far off the target is, a bearing does not: without a limit in the settings the track ends.
        within_m = float(z[0]) if model.kind == "range" else None
        start = rules.started_vaguely(target, model, own, state.t_ns, z, R, within_m)
        if start is None:
            return Used(state, None)
        return Used(self.tracks.beside(state, target, start.mean, start.cov(own[1])), None)

    def _beside(
        self, state: JointState, target: str, model: RelativeModel, z: Array, R: Array
    ) -> Used | None:
        """Use a sighting that tells no place, of a target without a track in the joint belief; None: it may join that.

        A vague track stays beside the joint belief, whose pose it leaves alone, and so does one that began vaguely.
        """
        own, rules = (state.mean[self._own], state.cov[self._own, self._own]), self.tracks.rules
        known = state.relayed.get(target)
        if known is None:
            start = rules.started_vaguely(target, model, own, state.t_ns, z, R)
            if start is None:
                return Used(state, None)
            return Used(self.tracks.beside(state, target, start.mean, start.cov(own[1])), None)
        track = known.mean, known.cov
        if known.firm and not rules.vague(own, track):
            return None
        localization, layout = self._settings.localization, model.subject
        _, update, nis = sighting_update(
            (*own, self._settings.layout),
            (*track, layout),
            model,
            z,
            R,
            localization.sighting_weight,
            True,
            Options(localization.transform, localization.parameters, localization.innovation_cap),
        )
        if update is not None:
            track = update.mean, update.cov
        return Used(self.tracks.beside(state, target, *track), nis)

    def _measured(
        self,
        state: JointState,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        part: slice | list[int],
        residual_factor: float,
    ) -> Used:
        seen = self._layout(state).seen(state.mean, state.cov, part, model, z, R, residual_factor)
        update: SplitUpdate | None
        if residual_factor > 1.0 and seen.residual.trace() > NEGLIGIBLE * R.trace():
            update = update_own_recurring(state.split, seen.H, seen.noise, RECURRING * symmetrize(seen.residual))
            if update is None:
                return Used(state, seen.nis)
        else:
            update = update_own(state.split, seen.H, seen.noise)
        return Used(self._shifted(state, update.K.dot(seen.nu), update.split), seen.nis)

    def _shifted(self, state: JointState, correction: Array, split: Split) -> JointState:
        """Raises `numpy.linalg.LinAlgError` if the covariance is not positive definite any more."""
        if not is_positive_definite(split.cov):
            raise np.linalg.LinAlgError("covariance is not positive definite")
        mean = wrap_components(state.mean + correction, self._layout(state).state.angles)
        return state.with_belief(mean, split, state.t_ns)

    # -- peers ----------------------------------------------------------------------------------------------

    def snapshot(self, state: JointState, tracks: Sequence[str], relayed: int = 0) -> SplitSnapshot:
        """What a peer is told of the state: the robot, `tracks`, and the first of its relayed tracks."""
        part, ages = list(range(self._own.stop)), []
        layout = self._layout(state)
        for name, block, learnt_ns in zip(state.tracks, layout.blocks, state.learnt_ns):
            if name in tracks:
                part += range(block.start, block.stop)
                ages.append(max(state.t_ns - learnt_ns, 0))
        mean, cov, private = state.mean, state.cov, state.split.private
        if len(part) < len(mean):
            square = np.ix_(part, part)
            mean, cov, private = mean[part], cov[square], private[square]
        return SplitSnapshot(
            self._settings.layout.name,
            tuple(item for item in layout.models if item[0] in tracks),
            mean,
            cov,
            private if private.any() else None,
            tuple(ages),
            self.tracks.told(state)[:relayed],
        )

    def fitting(self, state: JointState, measurements: tuple[Measurement, ...]) -> tuple[SplitSnapshot, int]:
        """What a peer is told of the state beside the measurements, and how many tracks do not fit into the message."""
        tracks, relayed, left_out = list(state.tracks), len(state.relayed), 0
        while True:
            snapshot = self.snapshot(state, tracks, relayed)
            fits = (
                len(snapshot.mean) <= MAX_JOINT_DIM
                and len(tracks) + relayed <= MAX_TARGETS
                and size_bound(SplitRequest(LONGEST, measurements, snapshot)) <= MAX_MESSAGE_BYTES
            )
            if fits or not (tracks or relayed):
                return snapshot, left_out
            if relayed:
                relayed -= 1
            else:
                tracks.pop()
            left_out += 1

    def met(
        self, state: JointState, told: SplitSnapshot, measurements: Sequence[Measurement], own_observed: bool
    ) -> Met:
        """Evaluate the relative measurements of a contact and the common targets; nothing is used of them yet.

        `own_observed`: the own sensor measured the peer, not the other way round.
        """
        layout = self._layout(state)
        own = SplitSnapshot(self._settings.layout.name, layout.models, state.mean, state.cov)
        i, j = (own, told) if own_observed else (told, own)
        return layout.met(i, j, None, measurements, RESIDUAL_FACTOR, SAME_TARGET_M2)

    def from_peer(self, state: JointState, told: SplitSnapshot, met: Met, own_observed: bool, trusted: bool) -> Used:
        """Use a contact as it has been evaluated (see `met`), for the own belief only.

        `trusted`: what the peer calls its private noise is uncorrelated with the own error still. The state is left
        alone if nothing is gained.
        """
        H_own, H_other = (met.H_i, met.H_j) if own_observed else (met.H_j, met.H_i)
        k = len(told.mean)
        private = told.private if trusted and told.private is not None else np.zeros((k, k))
        own, other, recurring = state.split, Split(private, told.cov - private), RECURRING * symmetrize(met.residual)
        if self._settings.localization.correlation == "ignored":
            own, other = (Split(cov, np.zeros_like(cov)) for cov in (state.cov, told.cov))
        heading = self._settings.layout.heading
        lost = heading is not None and state.cov[heading, heading] > INDIFFERENT_RAD2
        indifferent = (heading,) if lost and heading is not None else ()
        update = update_from_peer(own, other, H_own, H_other, met.R, recurring, indifferent)
        if update is not None:
            state = self._shifted(state, update.K.dot(met.nu), update.split)
            ages = zip(told.targets, told.ages_ns)
            state = learnt(state, {name: state.t_ns - age_ns for (name, _), age_ns in ages})
        return Used(self.tracks.heard(state, told), met.nis)
