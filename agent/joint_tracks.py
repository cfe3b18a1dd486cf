"""The tracks of a joint state: which there are, how they begin, end and are handed on, as pure functions.

A robot has a target in its joint state when both have a prior in common or when it has seen the target itself, since
only then it knows how the track's error depends on its own. What only peers have told of a target is a relayed track: a
belief beside the joint state, whose correlation with it is unknown; it says where the target is, and leaves the own
pose alone. So is what began with a range or a bearing alone, until a sighting tells the place.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import symmetrize
from agent.estimation.intersection import fuse
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.split_joint import Split
from agent.estimation.track_start import TrackStart
from agent.plausible import agree
from agent.settings import AgentSettings
from agent.tracks import MUCH_BETTER, TrackRules
from network.messages import Belief, SplitSnapshot, TargetBelief

Array = NDArray[np.float64]

OWN_WEIGHT = 10.0 / 11.0
"""What of the bound on an unknown correlation goes to the own belief when a relayed track joins it.

The shared part of the own covariance grows by a tenth then, and the track's elevenfold, once.
"""


@dataclass(frozen=True, slots=True, eq=False)
class RelayedTrack:
    """Belief (d,), (d, d) of a target, and when something was last learnt of it, by whoever saw it.

    `firm`: it is out of somebody's joint belief, as far as is known, and may become a part of the own one. What began
    with a range or a bearing alone is not: a Gaussian may settle on a wrong side of what it was, and would then draw
    the own pose along.
    """

    mean: Array
    cov: Array
    learnt_ns: int
    firm: bool


@dataclass(frozen=True, slots=True, eq=False)
class JointState:
    """mean (n,) and split covariance (n, n) of the robot followed by `tracks`, at `t_ns`; and relayed tracks.

    `learnt_ns`: when something was last learnt of each track, by a sighting of whoever told of it. `doubted`: how many
    own sightings on end have contradicted a track, where any has. The dictionaries are never changed.
    """

    t_ns: int
    mean: Array
    split: Split
    tracks: tuple[str, ...]
    learnt_ns: tuple[int, ...]
    relayed: dict[str, RelayedTrack] = field(default_factory=dict)
    doubted: dict[str, int] = field(default_factory=dict)

    @property
    def cov(self) -> Array:
        return self.split.cov

    def with_belief(self, mean: Array, split: Split, t_ns: int) -> JointState:
        """The state with another joint belief of the same tracks."""
        return JointState(t_ns, mean, split, self.tracks, self.learnt_ns, self.relayed, self.doubted)


class JointTracks:
    """What the settings of one robot say of the tracks of its joint state."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._motions = {target.id: target.motion for target in settings.targets}
        self._own = settings.layout.dim
        self.rules = TrackRules(settings)
        self._blocks: dict[tuple[str, ...], tuple[slice, ...]] = {}

    def blocks(self, state: JointState) -> tuple[slice, ...]:
        """Components of each track, in order."""
        if state.tracks not in self._blocks:
            ends = list(accumulate((self._motions[name].layout.dim for name in state.tracks), initial=self._own))
            self._blocks[state.tracks] = tuple(slice(begin, end) for begin, end in pairwise(ends))
        return self._blocks[state.tracks]

    def initial(self) -> JointState:
        """The state at the start: the own error is private, that of the targets' common prior is shared.

        An own error that peers hold too may be correlated with the prior: the target is a relayed track then.
        """
        settings = self._settings
        shared = settings.shared if settings.shared is not None else np.zeros_like(settings.cov)
        state = JointState(settings.start_ns, settings.mean, Split(settings.cov - shared, shared), (), ())
        for target in settings.tracked:
            if target.mean is not None and settings.shared is None:
                state = self._independent(state, target.id, target.mean, target.cov, settings.start_ns)
            elif target.mean is not None:
                relayed = RelayedTrack(target.mean, target.cov, settings.start_ns, firm=True)
                state = replace(state, relayed={**state.relayed, target.id: relayed})
        return state

    def _independent(self, state: JointState, target: str, mean: Array, cov: Array, learnt_ns: int) -> JointState:
        """The state with a track whose error has nothing to do with that of the others, and is shared."""
        start = TrackStart(mean, np.zeros((len(mean), len(state.mean))), np.zeros_like(cov), cov)
        return self.started(state, target, start, learnt_ns)

    def started(self, state: JointState, target: str, start: TrackStart, learnt_ns: int) -> JointState:
        """The state with one more track, whose error is `start.G` (d, k) times that of the first k, plus noise.

        What was relayed of the target so far is forgotten.
        """
        n, d, k = len(state.mean), len(start.mean), start.G.shape[1]
        A = np.eye(n + d, n)
        A[n:, :k] = start.G
        private, shared = np.zeros((n + d, n + d)), np.zeros((n + d, n + d))
        private[n:, n:], shared[n:, n:] = start.measured, start.common
        return JointState(
            state.t_ns,
            np.concatenate([state.mean, start.mean]),
            state.split.mapped(A, private, shared),
            (*state.tracks, target),
            (*state.learnt_ns, learnt_ns),
            {name: track for name, track in state.relayed.items() if name != target},
            state.doubted,
        )

    def beside(self, state: JointState, target: str, mean: Array, cov: Array) -> JointState:
        """The state with something learnt now of a target that the joint belief has no track of."""
        known = state.relayed.get(target)
        firm = known is not None and known.firm
        return replace(state, relayed={**state.relayed, target: RelayedTrack(mean, cov, state.t_ns, firm)})

    def without(self, state: JointState, gone: set[str]) -> JointState:
        """The state without these tracks of the joint belief."""
        rows = list(range(self._own))
        for name, block in zip(state.tracks, self.blocks(state)):
            if name not in gone:
                rows += range(block.start, block.stop)
        square = np.ix_(rows, rows)
        kept = [index for index, name in enumerate(state.tracks) if name not in gone]
        return replace(
            state,
            mean=state.mean[rows],
            split=Split(state.split.private[square], state.split.shared[square]),
            tracks=tuple(state.tracks[index] for index in kept),
            learnt_ns=tuple(state.learnt_ns[index] for index in kept),
            doubted={name: count for name, count in state.doubted.items() if name not in gone},
        )

    def judged(self, state: JointState, target: str, agrees: bool) -> JointState:
        """The state after an own sighting agreed with the track of a target, or contradicted it."""
        if agrees and target not in state.doubted:
            return state
        doubted = {name: count for name, count in state.doubted.items() if name != target}
        if not agrees:
            doubted[target] = state.doubted.get(target, 0) + 1
        return replace(state, doubted=doubted)

    def aged(self, state: JointState, dt_s: float) -> JointState:
        """A joint belief that has been moved by `dt_s` to `t_ns`: relayed tracks follow, and those that are over go."""
        cov = state.cov if state.tracks else None
        gone = {
            name
            for name, learnt_ns, block in zip(state.tracks, state.learnt_ns, self.blocks(state))
            if cov is not None and self.rules.ended(name, cov[block, block], learnt_ns, state.t_ns)
        }
        if gone:
            state = self.without(state, gone)
        if not state.relayed:
            return state
        relayed = {}
        for name, track in state.relayed.items():
            moved = self._motions[name].drift(track.mean, track.cov, dt_s, self._settings.localization.transform)
            if not self.rules.ended(name, moved.cov, track.learnt_ns, state.t_ns):
                relayed[name] = replace(track, mean=moved.mean, cov=moved.cov)
        return replace(state, relayed=relayed)

    # -- peers ----------------------------------------------------------------------------------------------

    def told(self, state: JointState) -> tuple[TargetBelief, ...]:
        """Relayed tracks as they are handed on."""
        return tuple(
            TargetBelief(
                name, Belief(self.rules.model(name), track.mean, track.cov), max(state.t_ns - track.learnt_ns, 0)
            )
            for name, track in state.relayed.items()
        )

    def heard(self, state: JointState, told: SplitSnapshot) -> JointState:
        """The state with what a peer has told of targets that the joint belief knows nothing of, or much less."""
        for name, model, track in self._tracks_of(state, told):
            state = self._relayed(state, name, model, track)
        return state

    def _tracks_of(self, state: JointState, told: SplitSnapshot) -> list[tuple[str, str, RelayedTrack]]:
        """(target, model, track) of all that a peer has told of targets that the joint belief may take as relayed."""
        begin, found = STATES[told.model].dim, []
        for (name, model), age_ns in zip(told.targets, told.ages_ns):
            block = slice(begin, begin + STATES[model].dim)
            begin = block.stop
            if name not in state.tracks:
                track = RelayedTrack(told.mean[block], told.cov[block, block], state.t_ns - age_ns, firm=True)
                found.append((name, model, track))
        for item in told.relayed:
            belief = item.belief
            track = RelayedTrack(belief.mean, belief.cov, state.t_ns - item.age_ns, firm=False)
            found.append((item.target, belief.model, track))
        return found

    def contradicted(self, state: JointState, told: SplitSnapshot) -> list[str]:
        """Targets of which a peer has told what the own belief of them, in a relayed track or beside one, gates out."""
        tracks = self._tracks_of(state, told)
        return [name for name, model, track in tracks if not self._agrees(state, name, model, track)]

    def _agrees(self, state: JointState, target: str, model: str, told: RelayedTrack) -> bool:
        """Whether what a peer has told of a target can be right beside what is known of it."""
        if target not in self.rules or self.rules.model(target) != model:
            return True
        known: RelayedTrack | None = state.relayed.get(target)
        if target in state.tracks:
            block = self.blocks(state)[state.tracks.index(target)]
            mean, cov = state.mean[block], state.cov[block, block]
        elif known is not None:
            mean, cov = known.mean, known.cov
        else:
            return True
        return agree(self._settings.health, mean, cov, told.mean, told.cov, self._motions[target].layout.angles)

    def _relayed(self, state: JointState, target: str, model: str, told: RelayedTrack) -> JointState:
        if target not in self.rules or self.rules.model(target) != model:
            return state
        if not self._agrees(state, target, model, told):
            return state
        if self.rules.ended(target, told.cov, told.learnt_ns, state.t_ns):
            return state
        layout = self._motions[target].layout
        if target in state.tracks:
            index = state.tracks.index(target)
            block = self.blocks(state)[index]
            newer = told.learnt_ns > state.learnt_ns[index]
            if not newer or not _much_better(told.cov, state.cov[block, block], layout):
                return state
            state = self.without(state, {target})
        known = state.relayed.get(target)
        if known is not None and known.firm is told.firm:
            weight = self._settings.localization.fusion_weight
            mean, cov, _ = fuse(known.mean, known.cov, told.mean, told.cov, layout.angles, weight)
            told = RelayedTrack(mean, cov, max(told.learnt_ns, known.learnt_ns), told.firm)
        elif known is not None:
            # What may be on a wrong side is not mixed with what is not.
            firm, loose = (told, known) if told.firm else (known, told)
            told = loose if _much_better(loose.cov, firm.cov, layout) else firm
        return replace(state, relayed={**state.relayed, target: told})

    def joined(self, state: JointState, target: str) -> JointState:
        """The state with a relayed track made a part of the joint belief, since the robot itself sees the target.

        How their shared errors are correlated is unknown: both are inflated, blk(A / w, B / (1 - w)).
        """
        track, shared = state.relayed[target], state.split.shared
        correlated = bool(shared.any())
        if correlated:
            state = replace(state, split=Split(state.split.private, shared / OWN_WEIGHT))
        cov = track.cov / (1.0 - OWN_WEIGHT) if correlated else track.cov
        return self._independent(state, target, track.mean, symmetrize(cov), track.learnt_ns)


def learnt(state: JointState, at_ns: dict[str, int]) -> JointState:
    """The state with something learnt of tracks at these instants."""
    found = tuple(max(before, at_ns.get(name, before)) for name, before in zip(state.tracks, state.learnt_ns))
    return state if found == state.learnt_ns else replace(state, learnt_ns=found)


def _much_better(cov: Array, other: Array, layout: StateLayout) -> bool:
    """Whether a track's position variance is so much smaller than another's that it takes its place."""
    place = list(layout.position)
    return float(np.sum(cov.diagonal()[place])) < MUCH_BETTER * float(np.sum(other.diagonal()[place]))
