"""A robot and its targets as one belief with a split error covariance, and what happens to it, as pure functions.

The robot's state comes first, the targets' follow in a fixed order. Noise of the own motion and sensors is private
until it is told; the targets' prior and process noise are the same for every robot that tracks them, hence shared from
the start (see `agent.estimation.split_joint`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.colocalization import StackedModel
from agent.estimation.gaussian import is_positive_definite, quadratic_form, symmetrize, wrap_components
from agent.estimation.motion import STATES
from agent.estimation.observation import AbsoluteModel, RelativeModel, relative_model
from agent.estimation.split_joint import Split, update_from_peer, update_own
from agent.estimation.unscented import observe
from agent.settings import AgentSettings
from network.messages import Measurement, SplitSnapshot

Array = NDArray[np.float64]

RESIDUAL_FACTOR = 6.0
"""How often the second-order residual of a measurement of a robot or target is charged.

Where both ends are uncertain, errors of linearization recur with the same sign as long as the geometry stays; white
noise of their size is too little.
"""

SAME_TARGET_M2 = 1e-4
"""Variance by which two robots' tracks are taken to be of one target."""


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """mean (n,) and split covariance (n, n) of the robot followed by `tracks`, at `t_ns`."""

    t_ns: int
    mean: Array
    split: Split
    tracks: tuple[str, ...]

    @property
    def cov(self) -> Array:
        return self.split.cov


@dataclass(frozen=True, slots=True, eq=False)
class Used:
    """A state after information was used, and the NIS per degree of freedom of that."""

    state: JointState
    nis: float


class JointModel:
    """Motion and measurements of a joint state, with the settings of one robot."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._motions = {target.id: target.motion for target in settings.targets}
        localization = settings.localization
        self._transform, self._parameters = localization.transform, localization.parameters
        self._cap = localization.innovation_cap
        self._own = slice(0, settings.layout.dim)

    def initial(self) -> JointState:
        """The state at the start: the own error is private, that of the targets' common prior is shared."""
        settings = self._settings
        targets = settings.targets if settings.track else ()
        mean = np.concatenate([settings.mean, *(target.mean for target in targets)])
        state = JointState(settings.start_ns, mean, Split(np.empty(0), np.empty(0)), tuple(t.id for t in targets))
        private, shared = np.zeros((len(mean), len(mean))), np.zeros((len(mean), len(mean)))
        private[self._own, self._own] = settings.cov
        for target, block in zip(targets, self.blocks(state)):
            shared[block, block] = target.cov
        return replace(state, split=Split(private, shared))

    def blocks(self, state: JointState) -> list[slice]:
        """Components of each track, in order."""
        begin, found = self._own.stop, []
        for name in state.tracks:
            end = begin + self._motions[name].layout.dim
            found.append(slice(begin, end))
            begin = end
        return found

    def angles(self, state: JointState) -> tuple[int, ...]:
        """Components that are angles."""
        found = list(self._settings.layout.angles)
        for name, block in zip(state.tracks, self.blocks(state)):
            found += [block.start + index for index in self._motions[name].layout.angles]
        return tuple(found)

    # -- motion ---------------------------------------------------------------------------------------------

    def moved(self, state: JointState, t_ns: int, delta: Array, delta_cov: Array) -> JointState:
        """The state at `t_ns`: the robot by an odometry increment (4,), (4, 4), the targets by their models."""
        cov, own = state.cov, self._own
        dt_s = (t_ns - state.t_ns) * 1e-9
        n = len(state.mean)
        mean, F = np.empty(n), np.zeros((n, n))
        private, shared = np.zeros((n, n)), np.zeros((n, n))
        found = self._settings.motion.advance(
            state.mean[own], cov[own, own], delta, delta_cov, dt_s, self._transform
        )
        mean[own], F[own, own] = found.mean, found.F
        private[own, own] = found.cov - found.F @ cov[own, own] @ found.F.T
        for name, block in zip(state.tracks, self.blocks(state)):
            found = self._motions[name].drift(state.mean[block], cov[block, block], dt_s, self._transform)
            mean[block], F[block, block] = found.mean, found.F
            shared[block, block] = found.cov - found.F @ cov[block, block] @ found.F.T
        return JointState(t_ns, mean, state.split.mapped(F, private, shared), state.tracks)

    # -- own measurements -----------------------------------------------------------------------------------

    def absolute(self, state: JointState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Used:
        """Use information about the own state alone."""
        return self._measured(state, model, z, R, self._own, 1.0)

    def sighting(self, state: JointState, target: str, model: RelativeModel, z: Array, R: Array) -> Used:
        """Use a relative measurement of a target of `state.tracks`."""
        block = self.blocks(state)[state.tracks.index(target)]
        # The first track follows the own state.
        part: slice | list[int] = slice(0, block.stop)
        if block.start != self._own.stop:
            part = [*range(self._own.stop), *range(block.start, block.stop)]
        return self._measured(state, model, z, R, part, RESIDUAL_FACTOR)

    def _measured(
        self,
        state: JointState,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        part: slice | list[int],
        residual_factor: float,
    ) -> Used:
        cov = state.cov
        square = (part, part) if isinstance(part, slice) else np.ix_(part, part)
        predicted = observe(
            model.h,
            model.jacobian,
            state.mean[part],
            cov[square],
            model.angles,
            self._transform,
            self._parameters,
        )
        innovation = wrap_components(z - predicted.z, model.angles)
        noise = symmetrize(R + residual_factor * predicted.residual)
        H = np.zeros((len(z), len(state.mean)))
        H[:, part] = predicted.H
        S = H @ cov @ H.T + noise
        noise, nis = self._capped(innovation, S, noise)
        update = update_own(state.split, H, noise)
        return Used(self._shifted(state, update.K @ innovation, update.split), nis)

    def _capped(self, innovation: Array, S: Array, noise: Array) -> tuple[Array, float]:
        """Noise inflated until the NIS per degree of freedom is at most the cap; and the NIS before that."""
        nis = float(quadratic_form(innovation, S)) / len(innovation)
        return (noise + S * (nis / self._cap - 1.0) if 0.0 < self._cap < nis else noise), nis

    def _shifted(self, state: JointState, correction: Array, split: Split) -> JointState:
        """Raises `numpy.linalg.LinAlgError` if the covariance is not positive definite any more."""
        if not is_positive_definite(split.cov):
            raise np.linalg.LinAlgError("covariance is not positive definite")
        return replace(state, mean=wrap_components(state.mean + correction, self.angles(state)), split=split)

    # -- peers ----------------------------------------------------------------------------------------------

    def snapshot(self, state: JointState, tracks: Sequence[str]) -> SplitSnapshot:
        """What a peer is told of the state: the robot and `tracks`."""
        part = list(range(self._own.stop))
        for name, block in zip(state.tracks, self.blocks(state)):
            if name in tracks:
                part += range(block.start, block.stop)
        square = np.ix_(part, part)
        private = state.split.private[square]
        models = tuple((name, self._motions[name].layout.name) for name in state.tracks if name in tracks)
        return SplitSnapshot(
            self._settings.layout.name,
            models,
            state.mean[part],
            state.cov[square],
            private if private.any() else None,
        )

    def from_peer(
        self,
        state: JointState,
        told: SplitSnapshot,
        measurements: Sequence[Measurement],
        own_observed: bool,
        trusted: bool,
    ) -> Used:
        """Use the relative measurements of a contact and the common targets, for the own belief only.

        `own_observed`: the own sensor measured the peer, not the other way round. `trusted`: what the peer calls its
        private noise is uncorrelated with the own error still. The state is left alone if nothing is gained.
        """
        own, other = self._own, slice(0, STATES[told.model].dim)
        n, k = len(state.mean), len(told.mean)
        cov = state.cov
        layouts = (self._settings.layout, STATES[told.model])
        observer, subject = layouts if own_observed else layouts[::-1]
        models = [relative_model(item, observer, subject) for item in measurements]
        model = models[0] if len(models) == 1 else StackedModel(models, [len(item.z) for item in measurements])
        own_pose, other_pose = (state.mean[own], cov[own, own]), (told.mean[other], told.cov[other, other])
        (mean_a, cov_a), (mean_b, cov_b) = (own_pose, other_pose) if own_observed else (other_pose, own_pose)
        both = np.zeros((len(mean_a) + len(mean_b),) * 2)
        both[: len(mean_a), : len(mean_a)], both[len(mean_a) :, len(mean_a) :] = cov_a, cov_b
        predicted = observe(
            model.h,
            model.jacobian,
            np.concatenate([mean_a, mean_b]),
            both,
            model.angles,
            self._transform,
            self._parameters,
        )
        z = np.concatenate([item.z for item in measurements])
        m = len(z)
        rows = [wrap_components(z - predicted.z, model.angles)]
        H_first, H_second = predicted.H[:, : len(mean_a)], predicted.H[:, len(mean_a) :]
        H_own_pose, H_other_pose = (H_first, H_second) if own_observed else (H_second, H_first)
        noise = _block_diagonal([item.R for item in measurements]) + RESIDUAL_FACTOR * predicted.residual
        common = self._common(state, told)
        size = m + sum(block.stop - block.start for block, _ in common)
        H_own, H_other, R = np.zeros((size, n)), np.zeros((size, k)), np.zeros((size, size))
        H_own[:m, own], H_other[:m, other] = H_own_pose, H_other_pose
        S = H_own_pose @ own_pose[1] @ H_own_pose.T + H_other_pose @ other_pose[1] @ H_other_pose.T + noise
        R[:m, :m], nis = self._capped(rows[0], S, symmetrize(noise))
        row = m
        for block, theirs in common:
            dim = block.stop - block.start
            here = slice(row, row + dim)
            H_own[here, block], H_other[here, theirs] = np.eye(dim), -np.eye(dim)
            angles = tuple(index - block.start for index in self.angles(state) if block.start <= index < block.stop)
            rows.append(wrap_components(told.mean[theirs] - state.mean[block], angles))
            same = SAME_TARGET_M2 * np.eye(dim)
            S = cov[block, block] + told.cov[theirs, theirs] + same
            R[here, here], _ = self._capped(rows[-1], S, same)
            row += dim
        private = told.private if trusted and told.private is not None else np.zeros((k, k))
        update = update_from_peer(state.split, Split(private, told.cov - private), H_own, H_other, R)
        if update is None:
            return Used(state, nis)
        return Used(self._shifted(state, update.K @ np.concatenate(rows), update.split), nis)

    def _common(self, state: JointState, told: SplitSnapshot) -> list[tuple[slice, slice]]:
        """Components of the targets that both track with the same model: (own, theirs)."""
        mine = dict(zip(state.tracks, self.blocks(state)))
        found, begin = [], STATES[told.model].dim
        for name, model in told.targets:
            end = begin + STATES[model].dim
            if name in mine and self._motions[name].layout.name == model:
                found.append((mine[name], slice(begin, end)))
            begin = end
        return found


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    if len(blocks) == 1:
        return blocks[0]
    size = sum(len(block) for block in blocks)
    R, row = np.zeros((size, size)), 0
    for block in blocks:
        R[row : row + len(block), row : row + len(block)] = block
        row += len(block)
    return R
