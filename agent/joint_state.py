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

from agent.estimation.gaussian import is_positive_definite, symmetrize, wrap_components
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.split_joint import Split, SplitUpdate, update_from_peer, update_own, update_own_recurring
from agent.joint_layout import JointLayout
from agent.settings import AgentSettings
from network.messages import Measurement, SplitSnapshot

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

NEGLIGIBLE = 1e-2
"""Residuals below this share of a measurement's variance do not recur noticeably."""


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
    """Motion and measurements of a joint state with a split covariance, with the settings of one robot."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._layout = JointLayout(settings)

    def initial(self) -> JointState:
        """The state at the start: the own error is private, that of the targets' common prior is shared."""
        mean, cov = self._layout.start()
        own = self._layout.own
        private = np.zeros_like(cov)
        private[own, own] = cov[own, own]
        return JointState(self._settings.start_ns, mean, Split(private, cov - private), self._layout.tracks)

    def blocks(self, state: JointState) -> list[slice]:
        """Components of each track, in order."""
        return list(self._layout.blocks)

    # -- motion ---------------------------------------------------------------------------------------------

    def moved(self, state: JointState, t_ns: int, delta: Array, delta_cov: Array) -> JointState:
        """The state at `t_ns`: the robot by an odometry increment (4,), (4, 4), the targets by their models."""
        dt_s = (t_ns - state.t_ns) * 1e-9
        found = self._layout.moved(state.mean, state.cov, dt_s, delta, delta_cov)
        split = state.split.mapped(found.F, found.own_noise, found.target_noise)
        return JointState(t_ns, found.mean, split, state.tracks)

    # -- own measurements -----------------------------------------------------------------------------------

    def absolute(self, state: JointState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Used:
        """Use information about the own state alone."""
        return self._measured(state, model, z, R, self._layout.own, 1.0)

    def sighting(self, state: JointState, target: str, model: RelativeModel, z: Array, R: Array) -> Used:
        """Use a relative measurement of a target of `state.tracks`."""
        return self._measured(state, model, z, R, self._layout.with_target(target), RESIDUAL_FACTOR)

    def _measured(
        self,
        state: JointState,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        part: slice | list[int],
        residual_factor: float,
    ) -> Used:
        seen = self._layout.seen(state.mean, state.cov, part, model, z, R, residual_factor)
        update: SplitUpdate | None
        if residual_factor > 1.0 and seen.residual.trace() > NEGLIGIBLE * R.trace():
            update = update_own_recurring(state.split, seen.H, seen.noise, RECURRING * symmetrize(seen.residual))
            if update is None:
                return Used(state, seen.nis)
        else:
            update = update_own(state.split, seen.H, seen.noise)
        return Used(self._shifted(state, update.K @ seen.nu, update.split), seen.nis)

    def _shifted(self, state: JointState, correction: Array, split: Split) -> JointState:
        """Raises `numpy.linalg.LinAlgError` if the covariance is not positive definite any more."""
        if not is_positive_definite(split.cov):
            raise np.linalg.LinAlgError("covariance is not positive definite")
        mean = wrap_components(state.mean + correction, self._layout.state.angles)
        return replace(state, mean=mean, split=split)

    # -- peers ----------------------------------------------------------------------------------------------

    def snapshot(self, state: JointState, tracks: Sequence[str]) -> SplitSnapshot:
        """What a peer is told of the state: the robot and `tracks`."""
        part = list(range(self._layout.own.stop))
        for name, block in zip(state.tracks, self._layout.blocks):
            if name in tracks:
                part += range(block.start, block.stop)
        square = np.ix_(part, part)
        private = state.split.private[square]
        return SplitSnapshot(
            self._settings.layout.name,
            tuple(item for item in self._layout.models if item[0] in tracks),
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
        own = SplitSnapshot(self._settings.layout.name, self._layout.models, state.mean, state.cov)
        i, j = (own, told) if own_observed else (told, own)
        met = self._layout.met(i, j, None, measurements, RESIDUAL_FACTOR, SAME_TARGET_M2)
        H_own, H_other = (met.H_i, met.H_j) if own_observed else (met.H_j, met.H_i)
        k = len(told.mean)
        private = told.private if trusted and told.private is not None else np.zeros((k, k))
        other, recurring = Split(private, told.cov - private), RECURRING * symmetrize(met.residual)
        update = update_from_peer(state.split, other, H_own, H_other, met.R, recurring)
        if update is None:
            return Used(state, met.nis)
        return Used(self._shifted(state, update.K @ met.nu, update.split), met.nis)
