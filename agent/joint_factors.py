"""A robot and its targets as one belief with correlation factors, and what pairs of such beliefs have in common.

The factors are of the joint error y = [own; targets], so what a robot learns of a target goes through its pairs without
covariance intersection (Lyu, Pan, Lv 2019, eq. 18-28, for a longer state). Two things make joint errors of robots
correlated that never met:

    prior   all start with the same belief of a target: P_ab = A_a A_b^T, A = Psi(start..now) [0; chol P_t0]
    noise   all predict the same target: P_ab += sum over time of the responses to its process noise

The noise is white, so an exact sum needs columns per instant. Here the response to each noise component is projected
on that component's mean since the pair's last contact, of unit variance: D <- F D + sqrt(dt) B per prediction, with B
the square root of the noise's covariance, every update multiplies D as it does factors, and P_ab += D_a D_b^T / T after
T seconds. That is exact for a response that does not change; what varies in the response is taken for independent
noise. Both sides know the same contacts, hence D stands beside the Psi of each line, and is told with it.

Numbers but the mean travel in single precision. Of what does not fit into a message, noise is left out first, then the
oldest lines; more targets than `agent.joint_room` has room for are refused. A contact one side of which has told no
noise does not use that the targets are the same ones: their correlation is not known well enough for that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

from agent.belief import CorrelationStack, Part, RobotState, Transition
from agent.estimation.colocalization import Contact, Update, applied, block_diagonal
from agent.estimation.gaussian import (
    clip_canonical_correlations,
    congruence,
    gain,
    is_positive_definite,
    square_root,
    symmetrize,
)
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.observation import AbsoluteModel, RelativeModel, relative_model
from agent.events import Observation
from agent.factor_model import LONGEST, AnySnapshot
from agent.joint_layout import JointLayout
from agent.settings import AgentSettings
from network.messages import (
    MAX_LINES,
    MAX_MESSAGE_BYTES,
    NEVER,
    Epoch,
    JointSnapshot,
    Line,
    Measurement,
    PairRequest,
)
from network.wire import size_bound

Array = NDArray[np.float64]

COMMON = (Part.COMMON, "", NEVER)
"""Block of the prior's columns (n, c), and behind them the noise since the start (n, c)."""

RESIDUAL_FACTOR = 6.0
"""How often the second-order residual of a measurement of a robot or target is charged."""

SAME_TARGET_M2 = 4e-2
"""Variance by which two robots' tracks are taken to be of one target.

Ten contacts a second would average out what factors miss about third robots if the tracks were tied more firmly.
"""

NOTICEABLE = 0.1
"""Second-order residuals below this share of a variance do not count: in hours they would add up to something."""

ROUNDING = 1e-6
"""Share of the variances by which a covariance is lifted that rounding has made indefinite."""


class JointFactors:
    """The form `joint`; see `agent.factor_model.FactorModel` for what each method is given."""

    snapshot_type: type[AnySnapshot] = JointSnapshot

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self.joint = JointLayout(settings)
        self.group: frozenset[str] | None = None
        self.nonlinearity = 0.0
        """Noticeable second-order residuals of measurements of robots and targets so far, as shares of variances, one
        at most each."""

    @property
    def layout(self) -> StateLayout:
        return self.joint.state

    @property
    def noise_columns(self) -> int:
        return self.joint.state.dim - self.joint.own.stop

    def initial(self) -> RobotState:
        mean, cov = self.joint.start()
        n, c = len(mean), self.noise_columns
        common = np.zeros((n, 2 * c))
        if c:
            common[n - c :, :c] = block_diagonal([square_root(cov[block, block]) for block in self.joint.blocks])
        stack = CorrelationStack(np.zeros((n, 0))).changed({COMMON: common})
        return RobotState(self._settings.start_ns, mean, cov, stack)

    # -- own information ------------------------------------------------------------------------------------

    def moved(self, state: RobotState, t_ns: int, delta: Array, cov: Array) -> tuple[RobotState, Transition]:
        dt_s = (t_ns - state.t_ns) * 1e-9
        found = self.joint.moved(state.mean, state.cov, dt_s, delta, cov)
        after = symmetrize(congruence(found.F, state.cov) + found.own_noise + found.target_noise)
        step = Transition(found.F, self._common_noise(state.mean, dt_s) if self.noise_columns else None)
        return RobotState(t_ns, found.mean, after, state.stack.moved(step), state.pairs), step

    def _common_noise(self, mean: Array, dt_s: float) -> Array:
        """sqrt(dt) B (n, c): B is the symmetric root of the targets' process noise, which is alike for all robots."""
        n, c = len(mean), self.noise_columns
        noise = np.zeros((n, c))
        for motion, block in zip(self.joint.motions.values(), self.joint.blocks):
            dim = block.stop - block.start
            Q = motion.drift(mean[block], np.zeros((dim, dim)), dt_s, self._settings.localization.transform).cov
            values, vectors = np.linalg.eigh(Q)
            root = (vectors * np.sqrt(np.maximum(values, 0.0) * dt_s)) @ vectors.T
            noise[block, block.start - (n - c) : block.stop - (n - c)] = root
        return noise

    def absolute(self, state: RobotState, model: AbsoluteModel | RelativeModel, z: Array, R: Array) -> Update | None:
        return self._seen(state, self.joint.own, model, z, R, 1.0)

    def sighting(self, state: RobotState, target: str, event: Observation) -> Update | None:
        """Use a relative measurement of a target; None when the posterior would not be positive definite."""
        model = relative_model(event, self._settings.layout, self.joint.motions[target].layout)
        return self._seen(state, self.joint.with_target(target), model, event.z, event.R, RESIDUAL_FACTOR)

    def _seen(
        self,
        state: RobotState,
        part: slice | list[int],
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        residual_factor: float,
    ) -> Update | None:
        seen = self.joint.seen(state.mean, state.cov, part, model, z, R, residual_factor)
        if residual_factor > 1.0:
            self._note_nonlinearity(seen.residual, R)
        K = gain(state.cov.dot(seen.H.T), seen.S)
        return applied(state.mean, state.cov, self.layout, K, seen.S, seen.nu, seen.nis, seen.H)

    def _note_nonlinearity(self, residual: Array, R: Array) -> None:
        share = float(np.max(residual.diagonal() / R.diagonal()))
        if share > NOTICEABLE:
            self.nonlinearity += min(share, 1.0)

    # -- what is told ---------------------------------------------------------------------------------------

    def snapshot(self, state: RobotState, peer: str) -> JointSnapshot:
        """All that a peer might need, in the precision it is told in."""
        record, c = state.pair(peer), self.noise_columns
        told = JointSnapshot(
            self._settings.layout.name,
            self.joint.models,
            state.mean,
            _single_cov(state.cov),
            record.base,
            lines=tuple(
                Line(epoch, self._told_line(state, (Part.LINE, peer, epoch), epoch.t_meas_ns))
                for epoch in record.lines[-MAX_LINES:]
            ),
            known=record.known,
            anew=record.anew,
            group=self.group,
        )
        if record.base.met:
            factor = state.stack.block((Part.FACTOR, peer, NEVER))
            line = self._told_line(state, (Part.BASE_LINE, peer, NEVER), record.base.t_meas_ns)
            assert factor is not None
            return replace(told, factor=_single(factor), line=line[:, : len(line)], noise=line[:, len(line) :])
        if record.anew or not c:
            return told
        start_ns = self._settings.start_ns
        common = self._told_line(state, COMMON, start_ns, c)
        span_s = (state.t_ns - start_ns) * 1e-9
        return replace(told, prior=common[:, :c], noise=common[:, c:], span_s=span_s)

    def _told_line(
        self, state: RobotState, key: tuple[Part, str, Epoch], since_ns: int, columns: int | None = None
    ) -> Array:
        """A block with its noise columns scaled to unit variance."""
        block = state.stack.block(key)
        assert block is not None
        told = block.copy()
        begin = len(told) if columns is None else columns
        told[:, begin:] /= np.sqrt(max(state.t_ns - since_ns, 1) * 1e-9)
        return _single(told)

    def fitting(
        self, snapshot: AnySnapshot, peer: str, measurements: tuple[Measurement, ...], about: AnySnapshot | None
    ) -> JointSnapshot | None:
        assert isinstance(snapshot, JointSnapshot)
        is_low = self._settings.robot < peer
        if about is not None:
            assert isinstance(about, JointSnapshot)
            snapshot = _answering(snapshot, about.base, is_low)
        elif is_low:
            snapshot = replace(snapshot, line=None)
        while size_bound(PairRequest(LONGEST, measurements, snapshot)) > MAX_MESSAGE_BYTES:
            n = len(snapshot.mean)
            if snapshot.noise is not None or any(line.matrix.shape[1] > n for line in snapshot.lines):
                self._counters["pair.noise_left_out"] += 1
                lines = tuple(Line(line.epoch, line.matrix[:, :n]) for line in snapshot.lines)
                snapshot = replace(snapshot, noise=None, lines=lines)
            elif snapshot.lines:
                self._counters["pair.shortened"] += 1
                snapshot = replace(snapshot, lines=snapshot.lines[1:])
            else:
                return None
        return snapshot

    # -- peers ----------------------------------------------------------------------------------------------

    def usable(self, told: AnySnapshot) -> bool:
        if not isinstance(told, JointSnapshot):
            return False
        layout = STATES.get(told.model)
        if layout is None or layout.heading is None or any(model not in STATES for _, model in told.targets):
            return False
        c = sum(STATES[model].dim for _, model in told.targets)
        n = layout.dim + c
        parts = ((told.factor, self.layout.dim), (told.line, n), (told.noise, c), (told.prior, c))
        return (
            told.mean.shape == (n,)
            and told.cov.shape == (n, n)
            and all(part is None or part.shape == (n, columns) for part, columns in parts)
            and all(line.matrix.shape in ((n, n), (n, n + c)) for line in told.lines)
        )

    def contact(
        self,
        initiator: AnySnapshot,
        responder: AnySnapshot,
        initiator_is_low: bool,
        measurements: Sequence[Measurement],
    ) -> Contact:
        """The relative measurements, and that targets both track are the same ones, with the recovered P_ij."""
        assert isinstance(initiator, JointSnapshot) and isinstance(responder, JointSnapshot)
        P_i, P_j = initiator.cov, responder.cov
        n, m = len(P_i), len(P_j)
        low, high = (initiator, responder) if initiator_is_low else (responder, initiator)
        found = resolve(low, high)
        if found is None:
            return Contact(np.zeros((n, 0)), np.zeros((m, 0)), np.zeros((0, 0)), np.zeros(0), None, 0.0)
        cross, complete = found
        if not initiator_is_low:
            cross = cross.T
        if self._settings.localization.correlation == "ignored":
            cross = np.zeros((n, m))
        joint = np.empty((n + m, n + m))
        joint[:n, :n], joint[:n, n:], joint[n:, :n], joint[n:, n:] = P_i, cross, cross.T, P_j
        if not is_positive_definite(joint):
            # Robots that have only the prior in common correlate perfectly; a thousandth of it is forgotten then.
            self._counters["pair.clipped"] += 1
            cross = clip_canonical_correlations(P_i, cross, P_j)
        if not complete:
            self._counters["pair.targets_unused"] += 1
        same_m2 = SAME_TARGET_M2 if complete else np.inf
        met = self.joint.met(initiator, responder, cross, measurements, RESIDUAL_FACTOR, same_m2)
        self._counters["target.gated"] += len(met.gated)
        m = sum(len(item.z) for item in measurements)
        self._note_nonlinearity(met.residual[:m, :m], block_diagonal([item.R for item in measurements]))
        C_i = P_i.dot(met.H_i.T) + cross.dot(met.H_j.T)
        C_j = cross.T.dot(met.H_i.T) + P_j.dot(met.H_j.T)
        S = symmetrize(met.H_i.dot(C_i) + met.H_j.dot(C_j) + met.R)
        return Contact(C_i, C_j, S, met.nu, cross, met.nis)

    def fused(self, other: AnySnapshot, t_ns: int, state: RobotState) -> RobotState:
        return state


def _answering(own: JointSnapshot, base: Epoch, is_low: bool) -> JointSnapshot:
    """What the peer needs whose last applied contact is `base`, see `resolve`."""
    if own.base == base:
        return replace(own, line=None, lines=()) if is_low else replace(own, factor=None, lines=())
    if own.base > base:
        return replace(own, line=None, lines=())
    lines = tuple(line for line in own.lines if line.epoch == base)
    return replace(own, factor=None, line=None, noise=None, prior=None, lines=lines)


def resolve(low: JointSnapshot, high: JointSnapshot) -> tuple[Array, bool] | None:
    """P_ab (n_a, n_b) at a contact from both snapshots, and whether it has the targets' common noise.

    `low` is the robot with the lower id. None: the correlation can't be recovered, as in
    `agent.estimation.colocalization.resolve_cross`.
    """
    if not low.known or not high.known:
        return None
    n, m = len(low.mean), len(high.mean)
    if low.base == high.base == NEVER:
        if low.anew or high.anew:
            return np.zeros((n, m)), True
        cross = _common(low, high, low.prior, high.prior)
        longer = max(low.span_s, high.span_s)
        scale = np.sqrt(min(low.span_s, high.span_s) / longer) if longer > 0.0 else 1.0
        cross, complete = _with_noise(cross, low, high, low.noise, high.noise, scale)
        alone = not low.targets or not high.targets
        return cross, complete and (alone or (low.prior is not None and high.prior is not None))
    if low.base == high.base:
        if low.factor is None or high.line is None:
            return None
        return _with_noise(low.factor @ high.line.T, low, high, low.noise, high.noise)
    if low.base > high.base:
        line = next((line.matrix for line in high.lines if line.epoch == low.base), None)
        if line is None or low.factor is None:
            return None
        return _with_noise(low.factor @ line[:, :m].T, low, high, low.noise, _noise_of(line))
    line = next((line.matrix for line in low.lines if line.epoch == high.base), None)
    if line is None or high.factor is None:
        return None
    return _with_noise(line[:, :n] @ high.factor.T, low, high, _noise_of(line), high.noise)


def _noise_of(line: Array) -> Array | None:
    n, columns = line.shape
    return line[:, n:] if columns > n else None


def _with_noise(
    cross: Array, low: JointSnapshot, high: JointSnapshot, a: Array | None, b: Array | None, scale: float = 1.0
) -> tuple[Array, bool]:
    if not low.targets or not high.targets:
        return cross, True
    return cross + scale * _common(low, high, a, b), a is not None and b is not None


def _common(low: JointSnapshot, high: JointSnapshot, a: Array | None, b: Array | None) -> Array:
    """a b^T over the columns of targets that both have with the same model; zero if a side has told none."""
    if a is None or b is None:
        return np.zeros((len(low.mean), len(high.mean)))
    mine, theirs = _columns(low), _columns(high)
    both = [target for target in low.targets if target in theirs]
    return np.asarray(
        a[:, [i for target in both for i in mine[target]]] @ b[:, [i for target in both for i in theirs[target]]].T
    )


def _columns(told: JointSnapshot) -> dict[tuple[str, str], range]:
    """Columns of common noise and prior by target."""
    found, begin = {}, 0
    for target in told.targets:
        end = begin + STATES[target[1]].dim
        found[target] = range(begin, end)
        begin = end
    return found


def _single(array: Array) -> Array:
    """Rounded to what the wire carries, so that both sides of a contact compute with the same numbers."""
    return array.astype(np.float32).astype(np.float64)


def _single_cov(cov: Array) -> Array:
    rounded = _single(cov)
    root, info = dpotrf(rounded, lower=1)
    if info == 0 and root.diagonal().min() ** 2 > 1e-16:
        return rounded
    return _single(cov + ROUNDING * np.diag(cov.diagonal()))
