"""A robot's state followed by those of its targets: what a component means, how the whole moves, and what is measured.

Means and covariances go in, innovations with their Jacobians come out; how errors of robots are correlated, and hence
what gain an innovation gets, is a matter of the form of localization that uses this.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agent.estimation.colocalization import block_diagonal, stacked
from agent.estimation.gaussian import congruence, identity, quadratic_form, symmetrize, wrap_components
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.unscented import observe
from agent.estimation.wide_heading import by_angles
from agent.settings import AgentSettings
from network.messages import Measurement

Array = NDArray[np.float64]


@dataclass(slots=True, eq=False)
class Moved:
    """Prediction of a joint belief: mean (n,), F (n, n), and P gains beyond F P F^T: own and target noise (n, n)."""

    mean: Array
    F: Array
    own_noise: Array
    target_noise: Array


@dataclass(slots=True, eq=False)
class Innovation:
    """nu (m,) = H e + v of the joint error e (n,): H (m, n), noise of v (m, m) with residuals, S, NIS per dof.

    Noise and S are inflated to the cap already, the NIS is from before that. `residual` (m, m) is the second-order one.
    """

    nu: Array
    H: Array
    noise: Array
    S: Array
    nis: float
    residual: Array


class JointBelief(Protocol):
    """A robot and targets (id, model) as one belief: mean (n,), cov (n, n)."""

    @property
    def model(self) -> str: ...
    @property
    def targets(self) -> tuple[tuple[str, str], ...]: ...
    @property
    def mean(self) -> Array: ...
    @property
    def cov(self) -> Array: ...


@dataclass(slots=True, eq=False)
class Met:
    """nu (m,) = H_i e_i + H_j e_j + v of two joint errors, v of covariance R (m, m), the measurements' NIS per dof.

    `residual` (m, m) is the second-order one of the measurements, zero for the rest. `gated` are targets both track,
    in places that cannot both be right: nothing is used of that.
    """

    nu: Array
    H_i: Array
    H_j: Array
    R: Array
    nis: float
    residual: Array
    gated: tuple[str, ...] = ()


class JointLayout:
    """The joint state of one robot and of `tracks`, in their order; by default those of all targets it may track."""

    def __init__(self, settings: AgentSettings, tracks: tuple[str, ...] | None = None) -> None:
        known = {target.id: target for target in settings.tracked}
        targets = [known[name] for name in (known if tracks is None else tracks)]
        localization = settings.localization
        self._settings = settings
        self._transform, self._parameters = localization.transform, localization.parameters
        self._cap = localization.innovation_cap
        self._gate = settings.health.gate_nis if settings.health.enabled else None
        self.motions = {target.id: target.motion for target in targets}
        self.tracks = tuple(self.motions)
        self.own = slice(0, settings.layout.dim)
        found, begin = [], self.own.stop
        angles = list(settings.layout.angles)
        for target in targets:
            layout = target.motion.layout
            found.append(slice(begin, begin + layout.dim))
            angles += [begin + index for index in layout.angles]
            begin += layout.dim
        self.blocks = tuple(found)
        self.state = StateLayout("joint", begin, tuple(angles), settings.layout.heading, settings.layout.position)
        self.models = tuple((name, motion.layout.name) for name, motion in self.motions.items())

    def start(self) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) at the start; every target has a prior."""
        settings = self._settings
        priors = [(target.mean, target.cov) for target in settings.tracked if target.mean is not None]
        mean = np.concatenate([settings.mean, *(mean for mean, _ in priors)])
        return mean, block_diagonal([settings.cov, *(cov for _, cov in priors)])

    def moved(self, mean: Array, cov: Array, dt_s: float, delta: Array, delta_cov: Array) -> Moved:
        """The robot by an odometry increment (4,), (4, 4), the targets by their models over `dt_s`."""
        n, own = len(mean), self.own
        after, F = np.empty(n), np.zeros((n, n))
        own_noise, target_noise = np.zeros((n, n)), np.zeros((n, n))
        found = self._settings.motion.advance(mean[own], cov[own, own], delta, delta_cov, dt_s, self._transform)
        after[own], F[own, own] = found.mean, found.F
        own_noise[own, own] = found.cov - congruence(found.F, cov[own, own])
        for motion, block in zip(self.motions.values(), self.blocks):
            found = motion.drift(mean[block], cov[block, block], dt_s, self._transform)
            after[block], F[block, block] = found.mean, found.F
            target_noise[block, block] = found.cov - congruence(found.F, cov[block, block])
        return Moved(after, F, own_noise, target_noise)

    # -- own measurements -----------------------------------------------------------------------------------

    def with_target(self, target: str) -> slice | list[int]:
        """Components of the robot and one target."""
        block = self.blocks[self.tracks.index(target)]
        # The first track follows the own state.
        if block.start == self.own.stop:
            return slice(0, block.stop)
        return [*range(self.own.stop), *range(block.start, block.stop)]

    def seen(
        self,
        mean: Array,
        cov: Array,
        part: slice | list[int],
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        residual_factor: float,
    ) -> Innovation:
        """An own measurement of the components `part`; the second-order residual is charged `residual_factor` times."""
        square = (part, part) if isinstance(part, slice) else np.ix_(part, part)
        model, z, R = by_angles(model, z, R, cov)
        predicted = observe(
            model.h,
            model.jacobian,
            mean[part],
            cov[square],
            model.angles,
            self._transform,
            self._parameters,
            model.turning,
        )
        nu = wrap_components(z - predicted.z, model.angles)
        noise = symmetrize(R + residual_factor * predicted.residual)
        H = np.zeros((len(z), len(mean)))
        H[:, part] = predicted.H
        S = congruence(H, cov) + noise
        noise, S, nis = self._capped(nu, S, noise)
        return Innovation(nu, H, noise, S, nis, predicted.residual)

    def _capped(self, nu: Array, S: Array, noise: Array) -> tuple[Array, Array, float]:
        """Noise and S inflated until the NIS per degree of freedom is at most the cap; and the NIS before that."""
        nis = float(quadratic_form(nu, S)) / len(nu)
        if not 0.0 < self._cap < nis:
            return noise, S, nis
        more = S * (nis / self._cap - 1.0)
        return noise + more, S + more, nis

    # -- peers ----------------------------------------------------------------------------------------------

    def common(self, told: JointBelief) -> list[tuple[slice, slice]]:
        """Components of the targets that both track with the same model: (own, theirs)."""
        mine = dict(zip(self.models, self.blocks))
        return [(mine[target], theirs) for target, theirs in _targets(told) if target in mine]

    def met(
        self,
        i: JointBelief,
        j: JointBelief,
        cross: Array | None,
        measurements: Sequence[Measurement],
        residual_factor: float,
        same_m2: float,
    ) -> Met:
        """Relative measurements of j by i, and that the targets both track are the same ones.

        cross (n_i, n_j) is P_ij, None for zero. `same_m2` is the variance by which two tracks are taken to be of one
        target; infinite, the targets are left out.
        """
        observer, subject = STATES[i.model], STATES[j.model]
        model, z, own_R = stacked(measurements, observer, subject, i.cov)
        a, b = observer.dim, subject.dim
        both = np.zeros((a + b, a + b))
        both[:a, :a], both[a:, a:] = i.cov[:a, :a], j.cov[:b, :b]
        if cross is not None:
            both[:a, a:] = cross[:a, :b]
            both[a:, :a] = cross[:a, :b].T
        predicted = observe(
            model.h,
            model.jacobian,
            np.concatenate([i.mean[:a], j.mean[:b]]),
            both,
            model.angles,
            self._transform,
            self._parameters,
            model.turning,
        )
        m = len(z)
        rows = [wrap_components(z - predicted.z, model.angles)]
        theirs = dict(_targets(j)) if math.isfinite(same_m2) else {}
        both_track = [(block, theirs[target], target) for target, block in _targets(i) if target in theirs]
        shared, gated = [], []
        for mine, other, (name, kind) in both_track:
            nu = wrap_components(j.mean[other] - i.mean[mine], STATES[kind].angles)
            noise = same_m2 * identity(len(nu))
            S = i.cov[mine, mine] + j.cov[other, other] + noise
            if cross is not None:
                S = S - cross[mine, other] - cross[mine, other].T
            noise, _, apart = self._capped(nu, S, noise)
            if self._gate is not None and not apart <= self._gate:
                gated.append(name)
            else:
                shared.append((mine, other, nu, noise))
        size = m + sum(len(nu) for _, _, nu, _ in shared)
        H_i, H_j, R = np.zeros((size, len(i.mean))), np.zeros((size, len(j.mean))), np.zeros((size, size))
        H_i[:m, :a], H_j[:m, :b] = predicted.H[:, :a], predicted.H[:, a:]
        noise = symmetrize(own_R + residual_factor * predicted.residual)
        R[:m, :m], _, nis = self._capped(rows[0], congruence(predicted.H, both) + noise, noise)
        row = m
        for mine, other, nu, noise in shared:
            here = slice(row, row + len(nu))
            H_i[here, mine], H_j[here, other] = identity(len(nu)), -identity(len(nu))
            rows.append(nu)
            R[here, here] = noise
            row += len(nu)
        residual = np.zeros((size, size))
        residual[:m, :m] = predicted.residual
        return Met(np.concatenate(rows), H_i, H_j, R, nis, residual, tuple(gated))


def _targets(belief: JointBelief) -> list[tuple[tuple[str, str], slice]]:
    """Targets (id, model) of a belief with their components."""
    found, begin = [], STATES[belief.model].dim
    for target in belief.targets:
        end = begin + STATES[target[1]].dim
        found.append((target, slice(begin, end)))
        begin = end
    return found
