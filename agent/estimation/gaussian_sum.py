"""Sums of Gaussians of where other robots are, corrected by ranges of known robots and bearings of unknown ones.

Each hypothesis of a robot, a track, is one history of which bearings were its own (De Silva, Mann, Gosine 2015, II-D).
A scan makes of each track its children: the robot was not seen, or it was bearing r. Bearings outside all gates begin
new tracks, for a robot may have been anywhere. Of heights and ranges it is known whose they are.

    not seen:             w (1 - P_D P_G) lambda
    bearing r:            w P_D N(y_r; 0, S) nu_r
    new, from bearing r:  P_B N(h | r sin el, P_zz) nu_r                              (eq. 13)

lambda is the density of bearings that are of nobody [1/rad^2], nu_r what other robots leave of a bearing. Each sensor's
stage is normalized by itself.

Published: lambda is 1, and so is nu; a heading that nothing is known of is one Gaussian of variance 4 pi. Improved: a
fan of eight headings is begun, each of which can be linearized, and a bearing is that of one robot only. With the odds
e_kr that robot k makes bearing r rather than nobody, e_kr = P_D max N / lambda over its tracks of some weight,

    nu_jr = 1 / (1 + sum_k e_kr / (1 - P_D P_G + sum_s e_ks)),   k other than j, s other than r

as one round of sum-product data association (Williams, Lau 2014), but with what the others may be and not with how
likely they are it: weights already hold the scans before, and two robots that each believe the other's place would keep
each other there. Robots that may be in each other's place learn nothing of it from bearings, whoever is not seen.

The tracks of all robots are rows of the same arrays, so that a scan costs the same few calls whatever their number.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from agent.estimation import relative_motion
from agent.estimation.gaussian import wrap
from agent.estimation.relative_sights import (
    Scalar,
    corrected,
    density,
    direction,
    distance,
    height,
    residuals,
    squared,
    turned_to,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

FAN = 8
FAN_RAD = wrap(2.0 * math.pi / FAN * np.arange(FAN, dtype=np.float64))
FAN_RAD.flags.writeable = False
FAN_SIGMA_RAD = 0.47
PUBLISHED_BIRTH = np.array([0.1, 0.1, 0.05, 4.0 * math.pi])
"""Variances of a new track (eq. 13)."""
SERIOUS = 3e-3
"""Only tracks of more weight make a bearing that of their robot rather than another's."""

FADING = 0.95
"""What a scan leaves of misfits: it is two seconds of ten scans each that count."""

UNPROVEN = 47.0
"""Misfit of a track that begins where its robot has others [nat]."""

OUTLIER = 15.0
"""Mahalanobis square of a number beyond which it counts no more against a track."""

HEAVY = 1e-3
"""Only tracks of more weight keep a bearing in their gate from beginning a new one."""


@dataclass(frozen=True, slots=True)
class Rules:
    """How sums are formed and pruned.

    detection, gate, birth   P_D, P_G, and the weight of a new track beside a sum of 1
    clutter, anywhere        lambda, and density of the bearing of a robot without tracks [1/rad^2]
    strangeness, adoption    of told hypotheses: density of those of no track [1/(m^3 rad)], weight of a new track
    improved                 exact moments, second order and fans; else linearized, with the modified gate
    floor, depth, family     least weight of a track; scans after which families are judged; their least weight
    doubt                    weight that modes beside the heaviest keep until they are refuted
    most                     tracks of one robot
    layers                   2 if a track also keeps what it was at the last fusion, else 1
    """

    detection: float
    gate: float
    birth: float
    clutter: float
    anywhere: float
    strangeness: float
    adoption: float
    improved: bool
    floor: float
    depth: int
    family: float
    doubt: float = 0.0
    most: int = 30
    layers: int = 1

    @property
    def missed(self) -> float:
        """Probability that a measurement is not there, or outside the gate."""
        return 1.0 - self.detection * self.gate


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """h tracks of all robots.

    of (h,)                index of the robot
    weight (h,)            sums to 1 over the tracks of a robot
    mean (h, L, 4), cov (h, L, 4, 4)   layer 0 is the belief; layer 1 that of the last fusion, moved to the present
    known (h,)             whether layer 1 tells anything; not of tracks begun since
    lineage (h, N)         names of its ancestors in the last N scans, itself last; 0 before its beginning
    misfit (h,)            how much worse than a right one it has fitted of late [nat]; its weight is not in it
    """

    of: Rows
    weight: Array
    mean: Array
    cov: Array
    known: Mask
    lineage: Rows
    misfit: Array

    def __len__(self) -> int:
        return len(self.weight)

    def rows(self, which: Mask | Rows) -> Tracks:
        return Tracks(
            self.of[which],
            self.weight[which],
            self.mean[which],
            self.cov[which],
            self.known[which],
            self.lineage[which],
            self.misfit[which],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One scan of a leader with n peers; what is missing may be any number.

    heights, ranges (n,) with variances (n,) and whether there is one (n,); present (n,) whose tracks take part;
    bearings (m, 2), bearing_cov (2, 2); possible (n, m) which bearing may be of whom; certain: it is known of whom.
    """

    heights: Array
    height_vars: Array
    with_height: Mask
    ranges: Array
    range_vars: Array
    with_range: Mask
    present: Mask
    bearings: Array
    bearing_cov: Array
    possible: Mask
    certain: bool


def no_tracks(rules: Rules) -> Tracks:
    return Tracks(
        np.empty(0, dtype=np.int64),
        np.empty(0),
        np.empty((0, rules.layers, 4)),
        np.empty((0, rules.layers, 4, 4)),
        np.empty(0, dtype=np.bool_),
        np.empty((0, rules.depth), dtype=np.int64),
        np.empty(0),
    )


def joined(*parts: Tracks) -> Tracks:
    return Tracks(
        np.concatenate([part.of for part in parts]),
        np.concatenate([part.weight for part in parts]),
        np.concatenate([part.mean for part in parts]),
        np.concatenate([part.cov for part in parts]),
        np.concatenate([part.known for part in parts]),
        np.concatenate([part.lineage for part in parts]),
        np.concatenate([part.misfit for part in parts]),
    )


def normalized(of: Rows, weight: Array) -> Array:
    """Weights (h,) that sum to 1 for each robot."""
    sums = np.bincount(of, weight)
    return np.asarray(weight / sums[of])


def moved(
    tracks: Tracks, own: Array, own_cov: Array, peers: Array, peer_covs: Array, dt: float, rules: Rules
) -> Tracks:
    """All tracks dt [s] later: own (4,), peers (n, 4) velocities in each one's body frame, with covariances."""
    if not len(tracks):
        return tracks
    mean, cov = relative_motion.stepped(
        tracks.mean,
        tracks.cov,
        own,
        own_cov,
        peers[tracks.of][:, None],
        peer_covs[tracks.of][:, None],
        dt,
        rules.improved,
    )
    return replace(tracks, mean=mean, cov=cov)


@lru_cache(maxsize=64)
def gate_limit(probability: float, dof: int) -> float:
    """Mahalanobis square of a gate that holds a right measurement with a probability."""
    return float(chi2.ppf(probability, dof))


def scanned(tracks: Tracks, seen: Seen, rules: Rules, name: int) -> tuple[Tracks, int]:
    """All tracks after one scan, not pruned, and the next free name, from the first free `name` on (direct fusion)."""
    return sighted(named_numbers(tracks, seen, rules), seen, rules, name)


def named_numbers(tracks: Tracks, seen: Seen, rules: Rules) -> Tracks:
    """All tracks after the heights and ranges of one scan, of which it is known whose they are."""
    rest = tracks.rows(~seen.present[tracks.of])
    tracks = tracks.rows(seen.present[tracks.of])
    if len(tracks):
        tracks = replace(tracks, misfit=FADING * tracks.misfit)
        measured = height(tracks.mean[:, 0], tracks.cov[:, 0], seen.heights[tracks.of], seen.height_vars[tracks.of])
        tracks = numbered(tracks, measured, seen.with_height[tracks.of], rules)
        measured = distance(
            tracks.mean[:, 0], tracks.cov[:, 0], seen.ranges[tracks.of], seen.range_vars[tracks.of], rules.improved
        )
        tracks = numbered(tracks, measured, seen.with_range[tracks.of], rules)
    return joined(rest, tracks)


def sighted(tracks: Tracks, seen: Seen, rules: Rules, name: int) -> tuple[Tracks, int]:
    """All tracks after the bearings of one scan whose numbers are in, and the next free name."""
    if not len(seen.bearings):
        return _renamed(tracks, name)
    rest = tracks.rows(~seen.present[tracks.of])
    tracks = tracks.rows(seen.present[tracks.of])
    count = len(tracks)
    there = direction(tracks.mean[:, 0], tracks.cov[:, 0], seen.bearing_cov, not rules.improved)
    residual = residuals(there.expected, seen.bearings)
    d2, likely = squared(residual, there.gate)
    inside = (d2 <= gate_limit(rules.gate, 2)) & seen.possible[tracks.of]
    likely = rules.detection * np.where(inside, likely, 0.0)
    left = _left_over(tracks, likely, seen, rules)
    found = tracks.weight[:, None] * likely * left[tracks.of]
    unseen = tracks.weight * rules.missed * rules.clutter
    if seen.certain:
        unseen = np.where(inside.any(axis=1), 0.0, unseen)
    fresh, which, from_bearing = _begun(tracks, seen, inside, left, rules)

    row, column = np.nonzero(found)
    of = np.concatenate([tracks.of, tracks.of[row], which])
    weight = normalized(of, np.concatenate([unseen, found[row, column], fresh]))
    still, taken, begun = np.split(weight, [count, count + len(row)])
    if rules.doubt > 0.0:
        # Not to be seen once is far more evidence than who may be in whose place can know.
        still = np.where(tracks.weight > HEAVY, np.maximum(still, rules.floor), still)
    kept = taken >= rules.floor
    row, column = row[kept], column[kept]
    mean, cov = tracks.mean[row], tracks.cov[row]
    mean[:, 0], cov[:, 0] = turned_to(mean[:, 0], cov[:, 0], there.H[row], there.S[row], residual[row, column])
    missed, hit = surprise(rules)
    misfit = tracks.misfit[row] + hit + 0.5 * d2[row, column] - 1.0
    parts = [
        rest,
        replace(tracks, weight=still, misfit=tracks.misfit + missed).rows(still >= rules.floor),
        replace(tracks.rows(row), weight=taken[kept], mean=mean, cov=cov, misfit=misfit),
    ]
    kept = begun >= rules.floor * (FAN if rules.improved else 1)
    if kept.any():
        new = begun_tracks(which[kept], begun[kept], from_bearing[kept], seen, rules)
        late = np.bincount(tracks.of, minlength=len(seen.present))[new.of] > 0
        parts.append(replace(new, misfit=np.where(late, UNPROVEN, 0.0)))
    return _renamed(joined(*parts), name)


def numbered(tracks: Tracks, measured: Scalar, used: Mask, rules: Rules) -> Tracks:
    """Tracks after a number that is known to be of their robot; outside its gate a track stays, with less weight."""
    if not used.any():
        return tracks
    d2 = measured.residual**2 / measured.gate
    inside = used & (d2 <= gate_limit(rules.gate, 1))
    weight = tracks.weight * np.where(inside, rules.detection * density(measured.residual, measured.gate), rules.missed)
    weight = normalized(tracks.of, np.where(used, weight, tracks.weight))
    new_mean, new_cov = corrected(tracks.mean[:, 0], tracks.cov[:, 0], measured)
    mean, cov = tracks.mean.copy(), tracks.cov.copy()
    mean[:, 0] = np.where(inside[:, None], new_mean, mean[:, 0])
    cov[:, 0] = np.where(inside[:, None, None], new_cov, cov[:, 0])
    misfit = tracks.misfit + np.where(used, 0.5 * np.minimum(d2, OUTLIER) - 0.5, 0.0)
    return replace(tracks, weight=weight, mean=mean, cov=cov, misfit=misfit)


def surprise(rules: Rules) -> tuple[float, float]:
    """How surprising it is that a robot is not seen, and that it is, less what is expected [nat]."""
    missed, seen = -math.log(rules.missed), -math.log(1.0 - rules.missed)
    expected = rules.missed * missed + (1.0 - rules.missed) * seen
    return missed - expected, seen - expected


def _left_over(tracks: Tracks, likely: Array, seen: Seen, rules: Rules) -> Array:
    """nu (n, m), from the densities (h, m) with which tracks make bearings."""
    if seen.certain or not rules.improved:
        return np.ones(seen.possible.shape)
    best = np.zeros(seen.possible.shape)
    serious = tracks.weight > SERIOUS
    np.maximum.at(best, tracks.of[serious], likely[serious])
    best[np.bincount(tracks.of, minlength=len(best)) == 0] = rules.anywhere
    odds = best / rules.clutter
    taken = odds / (rules.missed + odds.sum(axis=1, keepdims=True) - odds)
    return np.asarray(1.0 / (1.0 + taken.sum(axis=0) - taken))


def _begun(tracks: Tracks, seen: Seen, inside: Mask, left: Array, rules: Rules) -> tuple[Array, Rows, Rows]:
    """Weights, robots and bearings of new tracks (eq. 13): of bearings outside the gates of all tracks of weight."""
    claimed = np.zeros(seen.possible.shape, dtype=np.bool_)
    heavy = tracks.weight > HEAVY
    np.logical_or.at(claimed, tracks.of[heavy], inside[heavy])
    of, bearing = np.nonzero(~claimed & seen.possible & (seen.with_range & seen.present)[:, None])
    r, el = seen.ranges[of], seen.bearings[bearing, 1]
    if rules.improved:
        variance = (r * np.cos(el)) ** 2 * seen.bearing_cov[1, 1] + np.sin(el) ** 2 * seen.range_vars[of]
    else:
        variance = np.full(len(of), PUBLISHED_BIRTH[2])
    variance = variance + seen.height_vars[of] * rules.improved
    fits = np.where(seen.with_height[of], density(seen.heights[of] - r * np.sin(el), variance), 1.0)
    return rules.birth * fits * left[of, bearing], of, bearing


def begun_tracks(of: Rows, weight: Array, bearing: Rows, seen: Seen, rules: Rules) -> Tracks:
    """Tracks begun from ranges and bearings (eq. 13). Improved: a fan of each, with the doubt that its place has."""
    r, (az, el) = seen.ranges[of], seen.bearings[bearing].T
    sa, ca, se, ce = np.sin(az), np.cos(az), np.sin(el), np.cos(el)
    mean, cov = np.zeros((len(of), 4)), np.zeros((len(of), 4, 4))
    mean[:, :3] = np.stack([r * ce * ca, r * ce * sa, r * se], axis=-1)
    if rules.improved:
        J = np.empty((len(of), 3, 3))
        J[:, :, 0] = mean[:, :3] / r[:, None]
        J[:, 0, 1], J[:, 1, 1], J[:, 2, 1] = -r * ce * sa, r * ce * ca, 0.0
        J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = -r * se * ca, -r * se * sa, r * ce
        noise = np.zeros((len(of), 3, 3))
        noise[:, 0, 0] = seen.range_vars[of]
        noise[:, 1:, 1:] = seen.bearing_cov
        cov[:, :3, :3] = J @ noise @ J.swapaxes(-1, -2)
        cov[:, 3, 3] = FAN_SIGMA_RAD**2
        known = seen.with_height[of]
        fitted = corrected(mean, cov, height(mean, cov, seen.heights[of], seen.height_vars[of]))
        mean, cov = np.where(known[:, None], fitted[0], mean), np.where(known[:, None, None], fitted[1], cov)
        headings = np.tile(FAN_RAD, len(of))
        of, weight = np.repeat(of, FAN), np.repeat(weight / FAN, FAN)
        mean, cov = np.repeat(mean, FAN, axis=0), np.repeat(cov, FAN, axis=0)
        mean[:, 3] = headings
    else:
        cov[:, range(4), range(4)] = PUBLISHED_BIRTH
    layers = (len(of), rules.layers)
    return Tracks(
        of,
        weight,
        np.broadcast_to(mean[:, None], (*layers, 4)).copy(),
        np.broadcast_to(cov[:, None], (*layers, 4, 4)).copy(),
        np.zeros(len(of), dtype=np.bool_),
        np.zeros((len(of), rules.depth), dtype=np.int64),
        np.zeros(len(of)),
    )


def _renamed(tracks: Tracks, name: int) -> tuple[Tracks, int]:
    """Tracks with one more name each, and the next free name."""
    new = np.empty_like(tracks.lineage)
    new[:, :-1] = tracks.lineage[:, 1:]
    new[:, -1] = np.arange(name, name + len(tracks))
    return replace(tracks, lineage=new), name + len(tracks)
