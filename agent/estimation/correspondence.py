"""Which bearing is of whom, and where everybody is: what one leader believes of all robots around it.

Leaders measure ranges and heights of known robots and bearings of nobody knows whom. Of each other robot a leader keeps
a sum of Gaussians, one per history of associations (De Silva, Mann, Gosine 2015). The state of robot j relative to i
is x = (x, y, z, th) (4,), m and rad: its place in the body frame of i (FLU), and its heading less that of i.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation import nearest_track
from agent.estimation.bearing_labels import certain_labels
from agent.estimation.gate_test import GateTest, gate_test
from agent.estimation.gaussian_sum import Rules, Seen, Tracks, joined, moved, named_numbers, no_tracks, sighted
from agent.estimation.gaussian_sum_doubt import distinct
from agent.estimation.gaussian_sum_fusion import TOLD, Fusion, Told, fused, seen_back, seen_through
from agent.estimation.gaussian_sum_pruning import pruned
from agent.estimation.relative_motion import stepped

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]
Form = Literal["improved", "published"]

OUTWEIGHED = 2.0
"""How many times as much another hypothesis must weigh to be believed instead."""

CONFIRMED, CONFIRMED_RAD, CONFIRMED_S = 0.95, 0.3, 2.0
"""A robot is confirmed whose hypothesis has weighed so much, with a heading of this deviation, for so long."""

DOUBTED = 0.5
"""Bearings of a robot that was confirmed are given its name until its best hypothesis weighs less than that."""

LEAST_CLUTTER = 0.1
"""False bearings per scan that are expected even of a sensor that is said to have none."""

DOUBT = 0.2
"""Share of the weight that all modes but the heaviest keep while they are not refuted."""

STRANGENESS = 1.0
"""Density of wrong hypotheses that another leader may tell [1/(m^3 rad)]."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """How a robot moves over one step, as it measured: velocity (4,) is vx, vy, vz [m/s] in its body frame (FLU) and
    yaw rate [rad/s]; cov (4, 4) of it."""

    velocity: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What a leader sensed at one instant, all in its body frame.

    bearings (m, 2)     azimuth and elevation [rad], of nobody knows whom
    bearing_cov (2, 2)  of each [rad^2]
    ranges              peer -> range [m] and variance [m^2]; a missing key is a missed range
    heights             peer -> height of the peer above the own [m] and variance [m^2]
    """

    bearings: Array
    bearing_cov: Array
    ranges: Mapping[str, tuple[float, float]]
    heights: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What is told of one target: best first, at most five.

    weights (k,), means (k, 4), covs (k, 4, 4). Where fusion subtracts what was known before, also priors (k, 4) and
    prior_covs (k, 4, 4), the beliefs of the last fusion moved to the present, and prior_known (k,), False of younger
    tracks.
    """

    weights: Array
    means: Array
    covs: Array
    priors: Array | None = None
    prior_covs: Array | None = None
    prior_known: Mask | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Dominant:
    """The hypothesis that is believed: mean (4,), cov (4, 4) and its weight; `ambiguity`, the weight of the second
    distinct mode; the number of tracks; whether it has been as good as certain for a while."""

    mean: Array
    cov: Array
    weight: float
    ambiguity: float
    tracks: int
    confirmed: bool


@dataclass(frozen=True, slots=True)
class CorrespondenceSettings:
    """How a leader tells robots apart.

    detection   probability that a robot in view is seen, P_D
    clutter     expected false bearings per scan
    birth       probability of a new track, P_B; None: of the form
    gate        probability that a right measurement is inside a gate, P_G; None: of the form
    view_rad2   solid angle of the view, azimuth times elevation [rad^2]
    fusion      of what other leaders tell; None: of the form
    """

    kind: Literal["gaussian_sum", "nearest"] = "gaussian_sum"
    form: Form = "improved"
    detection: float = 0.95
    clutter: float = 1.0
    birth: float | None = None
    gate: float | None = None
    view_rad2: float = 2.0 * math.pi * 0.5 * math.pi
    fusion: Fusion | None = None

    def __post_init__(self) -> None:
        """Raises ValueError for a number that is none of its kind."""
        for key in ("detection", "birth", "gate"):
            value = getattr(self, key)
            if value is not None and not 0.0 < value <= 1.0 - (key == "gate") * np.finfo(float).eps:
                raise ValueError(f"{key}: {value} is no probability: give more than 0, at most 1 (a gate less than 1)")
        if not (math.isfinite(self.clutter) and self.clutter >= 0.0):
            raise ValueError(f"clutter: {self.clutter} is no number of bearings: give 0 or more")
        if not (math.isfinite(self.view_rad2) and self.view_rad2 > 0.0):
            raise ValueError(f"view_rad2: {self.view_rad2} is no solid angle: give azimuth times elevation [rad^2]")


class Correspondence:
    """All sums of one leader, `robot`, of the robots `peers`.

    A round of fusion is any number of `fuse`, then `fused`; leaders tell what they believed before it. A broadcast may
    be fused once only. `rejected` counts what was told and cannot be a belief.
    """

    def __init__(self, settings: CorrespondenceSettings, peers: Sequence[str], robot: str) -> None:
        self.settings = settings
        self.robot = robot
        self.peers = tuple(peers)
        self.rejected: Counter[str] = Counter()
        self._index = {peer: index for index, peer in enumerate(self.peers)}
        self._fusion = _fusion(settings)
        self._rules = _rules(settings)
        self._tracks = no_tracks(self._rules)
        self._name = 1
        self._believed = np.zeros(len(self.peers), dtype=np.int64)
        self._sure_s = np.zeros(len(self.peers))
        self._found = np.zeros(len(self.peers), dtype=np.bool_)
        self._bad = np.zeros(len(self.peers), dtype=np.int64)
        self._snapshot: Tracks | None = None
        self._tested: tuple[Tracks, Seen] | None = None

    def advance(self, own: BodyMotion, peers: Mapping[str, BodyMotion], dt_s: float) -> None:
        """All sums dt_s later. Every peer's motion must be there: of one that was not heard, a guess with its doubt.

        Raises ValueError for a peer that is missing.
        """
        missing = [peer for peer in self.peers if peer not in peers]
        if missing:
            raise ValueError(
                f"peers: no motion of {missing[0]}: give one with a covariance that says how doubtful it is"
            )
        velocities = np.array([peers[peer].velocity for peer in self.peers]).reshape(-1, 4)
        covs = np.array([peers[peer].cov for peer in self.peers]).reshape(-1, 4, 4)
        self._tracks = moved(self._tracks, own.velocity, own.cov, velocities, covs, dt_s, self._rules)
        self._snapshot = None
        self._sure_s = np.where(np.bincount(self._tracks.of, minlength=len(self.peers)) > 0, self._sure_s + dt_s, 0.0)

    def scan(self, scan: Scan, labels: Mapping[str, int] | None = None) -> dict[str, int]:
        """Direct fusion of one scan; peers that have neither a range nor a height in it are untouched.

        labels: where identities are known, peer -> index into the bearings; a missing peer was not seen. Returns which
        bearing is beyond doubt that of whom, in the same way, by what was believed before the bearings.
        """
        found: dict[str, int] = {}
        seen = self._seen(scan, labels)
        self._tested = self._tracks, seen
        if self.settings.kind == "nearest":
            self._tracks, self._bad = nearest_track.scanned(self._tracks, self._bad, seen, self._rules)
        else:
            tracks = named_numbers(self._tracks, seen, self._rules)
            self._found |= self._sure_s >= CONFIRMED_S
            named = certain_labels(tracks, seen, self._rules, self._found)
            found = {self.peers[of]: row for of, row in named.items()}
            tracks, self._name = sighted(tracks, seen, self._rules, self._name)
            self._tracks = pruned(tracks, self._rules, families=True)
        self._snapshot = None
        self._settle(self._tracks.lineage[:, -2])
        return found

    def gate_test(self, peer: str) -> GateTest | None:
        """How the bearings of the last scan were judged for `peer`; None if there was nothing to judge."""
        if self._tested is None:
            return None
        return gate_test(*self._tested, self._rules, self._index[peer])

    def told(self, peer: str) -> Hypotheses:
        """What the others are told of `peer`; changes nothing."""
        own = _best(self._tracks, self._index[peer])
        if self._fusion == "intersection":
            return Hypotheses(own.weight, own.mean[:, 0], own.cov[:, 0])
        return Hypotheses(own.weight, own.mean[:, 0], own.cov[:, 0], own.mean[:, 1], own.cov[:, 1], own.known)

    def fuse(self, leader: str, told: Mapping[str, Hypotheses]) -> None:
        """What `leader` told, in its own frame and carried to the present: mutual fusion of what it says of this robot,
        indirect fusion of the rest."""
        if self._snapshot is None:
            self._snapshot = self._tracks
        for of, hypotheses in told.items():
            sound = self._sound(hypotheses)
            if of == self.robot and leader in self._index:
                self._take(self._index[leader], seen_back(sound, self._rules.improved))
            elif of in self._index and leader in self._index and of != leader:
                own = _best(self._snapshot, self._index[leader])
                self._take(self._index[of], seen_through(own, sound, self._rules.improved))
            else:
                self.rejected["unknown_robot"] += 1

    def fused(self) -> None:
        """The end of a round of fusion: what is believed now is what the next round subtracts."""
        self._snapshot = None
        tracks = self._tracks
        if self._rules.layers == 2:
            mean, cov = tracks.mean.copy(), tracks.cov.copy()
            mean[:, 1], cov[:, 1] = mean[:, 0], cov[:, 0]
            self._tracks = replace(tracks, mean=mean, cov=cov, known=np.ones(len(tracks), dtype=np.bool_))

    def dominant(self, peer: str) -> Dominant | None:
        """The hypothesis of `peer` that is believed, None before there is any."""
        index = self._index[peer]
        tracks = self._tracks.rows(self._tracks.of == index)
        if not len(tracks):
            return None
        first = int(np.argmax(tracks.lineage[:, -1] == self._believed[index]))
        mean, cov = tracks.mean[:, 0], tracks.cov[:, 0]
        return Dominant(
            mean[first],
            cov[first],
            float(tracks.weight[first]),
            float(np.max(tracks.weight, where=distinct(mean, cov, mean[first], cov[first]), initial=0.0)),
            len(tracks),
            bool(self._sure_s[index] >= CONFIRMED_S),
        )

    def _take(self, index: int, told: Told) -> None:
        mine = self._tracks.of == index
        own = fused(self._tracks.rows(mine), told, index, self._rules, self._fusion, self._name)
        self._name += len(told.weight)
        if self.settings.kind == "nearest":
            own = replace(own.rows(np.argsort(-own.weight)[:1]), weight=np.ones(min(len(own), 1)))
        self._tracks = joined(self._tracks.rows(~mine), own)
        self._settle(self._tracks.lineage[:, -1])

    def _settle(self, parent: Rows) -> None:
        """Which hypothesis is believed: a child of the one that was, until another weighs more than twice as much."""
        tracks = self._tracks
        for index in range(len(self.peers)):
            rows = np.flatnonzero(tracks.of == index)
            if not len(rows):
                self._sure_s[index], self._found[index] = 0.0, False
                continue
            weight = tracks.weight[rows]
            best = int(weight.argmax())
            heirs = weight * (parent[rows] == self._believed[index])
            heir = int(heirs.argmax())
            if heirs[heir] > 0.0 and weight[best] <= OUTWEIGHED * weight[heir]:
                best = heir
            self._believed[index] = tracks.lineage[rows[best], -1]
            if weight[best] < CONFIRMED or tracks.cov[rows[best], 0, 3, 3] > CONFIRMED_RAD**2:
                self._sure_s[index] = 0.0
            self._found[index] &= weight[best] >= DOUBTED

    def _seen(self, scan: Scan, labels: Mapping[str, int] | None) -> Seen:
        n, m = len(self.peers), len(scan.bearings)
        numbers = np.zeros((2, 2, n))
        numbers[:, 1] = 1.0
        there = np.zeros((2, n), dtype=np.bool_)
        for row, told in enumerate((scan.heights, scan.ranges)):
            for peer, pair in told.items():
                if peer in self._index:
                    numbers[row, :, self._index[peer]] = pair
                    there[row, self._index[peer]] = True
        possible = np.full((n, m), labels is None)
        for peer, row in (labels or {}).items():
            if peer in self._index:
                possible[self._index[peer], row] = True
        (h, h_var), (r, r_var) = numbers
        bearings = np.asarray(scan.bearings, dtype=np.float64).reshape(-1, 2)
        present = np.asarray(there.any(axis=0))
        return Seen(
            h, h_var, there[0], r, r_var, there[1], present, bearings, scan.bearing_cov, possible, labels is not None
        )

    def _sound(self, told: Hypotheses) -> Told:
        """What of it can be a belief."""
        mean, cov, known = told.means[:, None], told.covs[:, None], np.zeros(len(told.weights), dtype=np.bool_)
        if self._rules.layers == 2:
            if told.priors is not None and told.prior_covs is not None and told.prior_known is not None:
                mean = np.stack([told.means, told.priors], axis=1)
                cov = np.stack([told.covs, told.prior_covs], axis=1)
                known = told.prior_known
            else:
                mean, cov = np.repeat(mean, 2, axis=1), np.repeat(cov, 2, axis=1)
        finite = np.isfinite(mean).all(axis=(1, 2)) & np.isfinite(cov).all(axis=(1, 2, 3))
        finite &= (told.weights > 0.0) & (told.weights <= 1.0 + 1e-6)
        sane = finite.copy()
        sane[finite] = (np.linalg.eigvalsh(cov[finite])[..., 0] > 0.0).all(axis=1)
        if not sane.all():
            self.rejected["no_belief"] += int((~sane).sum())
        return Told(told.weights[sane], mean[sane], cov[sane], known[sane])


def carry(told: Hypotheses, of: BodyMotion, peer: BodyMotion, dt_s: float, form: Form = "improved") -> Hypotheses:
    """What the leader that moves as `of` told of the robot that moves as `peer`, dt_s later."""
    rules = form == "improved"
    means, covs = stepped(told.means, told.covs, of.velocity, of.cov, peer.velocity, peer.cov, dt_s, rules)
    if told.priors is None or told.prior_covs is None:
        return replace(told, means=means, covs=covs)
    priors, prior_covs = stepped(
        told.priors, told.prior_covs, of.velocity, of.cov, peer.velocity, peer.cov, dt_s, rules
    )
    return replace(told, means=means, covs=covs, priors=priors, prior_covs=prior_covs)


def _best(tracks: Tracks, index: int) -> Told:
    """The heaviest tracks of one robot."""
    rows = np.flatnonzero(tracks.of == index)
    rows = rows[np.argsort(-tracks.weight[rows], kind="stable")[:TOLD]]
    return Told(tracks.weight[rows], tracks.mean[rows], tracks.cov[rows], tracks.known[rows])


def _fusion(settings: CorrespondenceSettings) -> Fusion:
    if settings.fusion is not None:
        return settings.fusion
    return "intersection" if settings.form == "improved" else "subtraction"


def _rules(settings: CorrespondenceSettings) -> Rules:
    """Published: the printed numbers. Improved: weights of one unit, so that the rest may be pruned late.

    What is told outside all gates begins a track only where there is none if published: with the printed weight of a
    new track, and headings that the inverse linearizes, a leader would forget at each fusion what it knows.
    """
    single = settings.kind == "nearest"
    improved = settings.form == "improved" and not single
    tuned = improved or single
    birth = settings.birth if settings.birth is not None else (0.005 if tuned else 0.5)
    gate = settings.gate if settings.gate is not None else (0.999 if tuned else 0.95)
    return Rules(
        detection=settings.detection,
        gate=gate,
        birth=birth / settings.view_rad2 if improved else birth,
        clutter=max(settings.clutter, LEAST_CLUTTER) / settings.view_rad2 if improved else 1.0,
        anywhere=settings.detection / settings.view_rad2,
        strangeness=STRANGENESS if improved else 1.0,
        adoption=birth * STRANGENESS if improved else 0.0,
        improved=improved,
        floor=1e-5 if improved else 1e-4,
        depth=20 if improved else 10,
        family=1e-3 if improved else 1e-2,
        doubt=DOUBT if improved else 0.0,
        layers=2 if _fusion(settings) == "subtraction" else 1,
    )
