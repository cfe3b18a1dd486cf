"""The state of one robot's estimator as an immutable value, so that its past is a list of references.

Correlations live in one matrix with a row per own state component: for every peer a factor sigma (P_ab =
sigma_a sigma_b^T), the identity line Psi of its base contact, and the lines of contacts whose fate is
unknown. Every local operation that maps the own error by A multiplies the whole matrix by A.

If targets are part of the state, every line carries columns of their common process noise since its contact behind its
Psi (see `agent.joint_factors`), and one block stands for what all robots have in common from the start.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from network.messages import NEVER, Epoch

Array = NDArray[np.float64]


class Part(IntEnum):
    """What a block of the correlation stack is."""

    FACTOR = 0
    BASE_LINE = 1
    LINE = 2
    COMMON = 3


BlockKey = tuple[Part, str, Epoch]


@dataclass(frozen=True, slots=True, eq=False)
class Transition:
    """Left factor F (n, n) of a prediction, and what it adds to the noise columns (n, c) of lines, if there are any."""

    F: Array
    noise: Array | None = None

    def of_line(self, line: Array) -> Array:
        """A line (n, n + c) after the prediction."""
        after = np.asarray(self.F @ line)
        if self.noise is not None:
            after[:, len(after) :] += self.noise
        return after


@dataclass(frozen=True, slots=True, eq=False)
class CorrelationStack:
    """Blocks side by side in one matrix (n, columns)."""

    matrix: Array
    blocks: dict[BlockKey, tuple[int, int]] = field(default_factory=dict)

    def left(self, A: Array) -> CorrelationStack:
        """All blocks multiplied by A (n, n) from the left."""
        if not self.blocks:
            return self
        return CorrelationStack(A @ self.matrix, self.blocks)

    def moved(self, step: Transition) -> CorrelationStack:
        """All blocks after a prediction."""
        stack = self.left(step.F)
        if step.noise is not None:
            columns = step.noise.shape[1]
            for (part, _, _), (_, end) in stack.blocks.items():
                if part is not Part.FACTOR:
                    stack.matrix[:, end - columns : end] += step.noise
        return stack

    def block(self, key: BlockKey) -> Array | None:
        span = self.blocks.get(key)
        return None if span is None else self.matrix[:, span[0] : span[1]]

    def changed(self, put: dict[BlockKey, Array], drop: tuple[BlockKey, ...] = ()) -> CorrelationStack:
        """A stack with the blocks `put` added or replaced and `drop` removed."""
        gone = {*drop, *put}
        kept = [(key, self.matrix[:, a:b]) for key, (a, b) in self.blocks.items() if key not in gone]
        parts = [*kept, *put.items()]
        blocks, column = {}, 0
        for key, block in parts:
            blocks[key] = (column, column + block.shape[1])
            column += block.shape[1]
        if not parts:
            return CorrelationStack(np.zeros((self.matrix.shape[0], 0)), {})
        return CorrelationStack(np.concatenate([block for _, block in parts], axis=1), blocks)


@dataclass(frozen=True, slots=True)
class PairRecord:
    """Book-keeping of one pair: the last contact applied, and contacts opened since whose fate is unknown.

    `known` is False when the correlation has been lost and zero may not be assumed yet; the pair's measurements
    are not used until it has begun anew. `anew` tells that it has, and has no contact since.
    """

    base: Epoch = NEVER
    known: bool = True
    lines: tuple[Epoch, ...] = ()
    anew: bool = False


NO_PAIR = PairRecord()


@dataclass(frozen=True, slots=True, eq=False)
class TargetState:
    """Belief of a target at the robot state's instant: mean (n,), cov (n, n), and when it was last changed.

    `learnt_ns`: when something was last learnt of it, by a sighting of whoever told of it. `doubted`: how many own
    sightings on end have contradicted it.
    """

    mean: Array
    cov: Array
    updated_ns: int = 0
    learnt_ns: int = 0
    doubted: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class RobotState:
    """Own belief, target beliefs and correlations at one instant. The dictionaries are never changed.

    `stranger` is the record of a peer that is not in `pairs`.
    """

    t_ns: int
    mean: Array
    cov: Array
    stack: CorrelationStack
    pairs: dict[str, PairRecord] = field(default_factory=dict)
    targets: dict[str, TargetState] = field(default_factory=dict)
    stranger: PairRecord = NO_PAIR

    def updated(self, mean: Array, cov: Array, left: Array) -> RobotState:
        """The state after a local update that maps the error by `left` (n, n)."""
        return RobotState(self.t_ns, mean, cov, self.stack.left(left), self.pairs, self.targets, self.stranger)

    def pair(self, peer: str) -> PairRecord:
        return self.pairs.get(peer, self.stranger)

    def with_line(self, peer: str, epoch: Epoch, line: Array, max_lines: int) -> RobotState:
        """Open the identity line of a contact; beyond `max_lines` the oldest is forgotten."""
        record = self.pair(peer)
        lines = tuple(sorted((*record.lines, epoch)))
        dropped = lines[: max(0, len(lines) - max_lines)]
        stack = self.stack.changed({(Part.LINE, peer, epoch): line}, tuple((Part.LINE, peer, e) for e in dropped))
        kept = replace(record, lines=lines[len(dropped) :])
        return replace(self, stack=stack, pairs={**self.pairs, peer: kept})

    def without_line(self, peer: str, epoch: Epoch) -> RobotState:
        """Forget a contact the peer is known not to have applied."""
        record = self.pair(peer)
        if epoch not in record.lines:
            return self
        kept = replace(record, lines=tuple(e for e in record.lines if e != epoch))
        stack = self.stack.changed({}, ((Part.LINE, peer, epoch),))
        return replace(self, stack=stack, pairs={**self.pairs, peer: kept})

    def with_base(self, peer: str, epoch: Epoch, factor: Array, line: Array) -> RobotState:
        """Make `epoch` the pair's base contact; lines up to it are settled and dropped."""
        record = self.pair(peer)
        settled = tuple((Part.LINE, peer, e) for e in record.lines if e <= epoch)
        stack = self.stack.changed(
            {(Part.FACTOR, peer, NEVER): factor, (Part.BASE_LINE, peer, NEVER): line}, settled
        )
        kept = PairRecord(epoch, True, tuple(e for e in record.lines if e > epoch))
        return replace(self, stack=stack, pairs={**self.pairs, peer: kept})

    def forgotten(self, peer: str, known: bool) -> RobotState:
        """Drop all correlation with a peer; `known` tells whether zero correlation may be assumed."""
        keys = tuple(key for key in self.stack.blocks if key[1] == peer)
        return replace(
            self,
            stack=self.stack.changed({}, keys),
            pairs={**self.pairs, peer: PairRecord(known=known, anew=True)},
        )
