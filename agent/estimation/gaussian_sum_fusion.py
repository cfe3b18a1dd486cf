"""What other leaders tell of a robot, as measurements of its state (De Silva, Mann, Gosine 2015, eq. 9-12).

Each told hypothesis is matched with each own track as a bearing would be: with weight w_i w_e N(m_e - m; 0, P_i + P_e),
inside a gate. What is told was partly known before: leaders share process noise and have fused before.

subtraction    Y = P_i^-1 + P_e^-1 - P_0^-1, m+ = m + Y^-1 (P_e^-1 (m_e - m) - P_0^-1 (m_0 - m)), with the prior m_0,
               P_0 of the last fusion (eq. 10, 12): removes what the sender knew then, not what both have learnt alike.
               Where Y is not positive definite, a track keeps its own belief
intersection   Y = a P_i^-1 + (1 - a) P_e^-1 with the a of the largest determinant: a bound whatever is shared. Weights
               are shared too: they are (w_i w_e)^(1/2) N, so that who hears its own opinion back is no surer of it
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation import relative_motion
from agent.estimation.gaussian import symmetrize, wrap
from agent.estimation.gaussian_sum import HEAVY, UNPROVEN, Rules, Tracks, gate_limit, joined, normalized
from agent.estimation.gaussian_sum_pruning import pruned

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]
Fusion = Literal["intersection", "subtraction"]

TOLD = 5
"""Hypotheses of a robot that are told."""

LEAST = 1e-3
"""Least weight of a hypothesis that is composed of an own one and a told one."""

SHARES = np.array([0.5, 0.4, 0.6, 0.3, 0.7, 0.2, 0.8, 0.1, 0.9, 0.0, 1.0])
"""Candidates of an intersection's weight; equals keep the first."""
SHARES.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """k hypotheses of one robot relative to the own one: weight (k,), mean (k, L, 4), cov (k, L, 4, 4) and known (k,),
    with layers as of `Tracks`."""

    weight: Array
    mean: Array
    cov: Array
    known: Mask


def seen_back(told: Told, matched: bool) -> Told:
    """What another leader told of the own robot, as hypotheses of that leader (eq. 9)."""
    mean, cov = relative_motion.inverted(told.mean, told.cov, matched)
    return replace(told, mean=mean, cov=cov)


def seen_through(leader: Told, told: Told, matched: bool) -> Told:
    """What a leader told of a robot, by way of own hypotheses of that leader (eq. 11): all pairs of some weight."""
    weight = leader.weight[:, None] * told.weight
    own, other = np.nonzero(weight > LEAST)
    mean, cov = relative_motion.composed(leader.mean[own], leader.cov[own], told.mean[other], told.cov[other], matched)
    return Told(weight[own, other], mean, cov, leader.known[own] & told.known[other])


def fused(tracks: Tracks, told: Told, of: int, rules: Rules, by: Fusion, name: int) -> Tracks:
    """Tracks of one robot, the `of`-th, after what was told of it, pruned; names from `name` on are free."""
    if not len(told.weight):
        return tracks
    if not len(tracks):
        return pruned(_adopted(told, of, rules, name, 0.0), rules, families=False)
    mean, cov = tracks.mean[:, 0], tracks.cov[:, 0]
    apart = told.mean[:, 0] - mean[:, None]
    apart[..., 3] = wrap(apart[..., 3])
    root = np.linalg.cholesky(cov[:, None] + told.cov[:, 0])
    white = np.linalg.solve(root, apart[..., None])[..., 0]
    d2 = (white * white).sum(axis=-1)
    scale = np.prod(np.diagonal(root, axis1=-2, axis2=-1), axis=-1) * (2.0 * math.pi) ** 2
    inside = d2 <= gate_limit(rules.gate, 4)
    weight, other = tracks.weight, told.weight
    if by == "intersection":
        weight, other = np.sqrt(weight), np.sqrt(other)
    found = weight[:, None] * other * np.where(inside, np.exp(-0.5 * d2) / scale, 0.0)
    strange = ~inside[tracks.weight > HEAVY].any(axis=0)
    alone = weight * rules.missed * rules.strangeness
    new = np.where(strange, other * rules.adoption, 0.0)
    total = found.sum() + alone.sum() + new.sum()
    if rules.doubt > 0.0:
        # That another leader does not tell of it refutes no track of weight.
        alone = np.where(tracks.weight > HEAVY, np.maximum(alone, 2.0 * rules.floor * total), alone)
    row, column = np.nonzero(found >= rules.floor * total)
    children = tracks.rows(row)
    if len(row):
        belief = children.mean[:, 0], children.cov[:, 0]
        theirs = Told(told.weight[column], told.mean[column], told.cov[column], told.known[column])
        merge = intersected if by == "intersection" else subtracted
        both_mean, both_cov = merge(*belief, theirs)
        mean, cov = children.mean.copy(), children.cov.copy()
        mean[:, 0], cov[:, 0] = both_mean, both_cov
        children = replace(children, weight=found[row, column], mean=mean, cov=cov)
    adopted = np.flatnonzero(strange)
    fresh = Told(new[adopted], told.mean[adopted], told.cov[adopted], told.known[adopted])
    parts = joined(replace(tracks, weight=alone), children, _adopted(fresh, of, rules, name, UNPROVEN))
    return pruned(replace(parts, weight=normalized(parts.of, parts.weight)), rules, families=False)


def intersected(mean: Array, cov: Array, told: Told) -> tuple[Array, Array]:
    """Beliefs (k, 4), (k, 4, 4) with as many told ones, by covariance intersection (Julier, Uhlmann 1997)."""
    own, other = np.linalg.inv(cov), np.linalg.inv(told.cov[:, 0])
    share = SHARES[:, None, None, None]
    best = SHARES[np.argmax(np.linalg.slogdet(share * own + (1.0 - share) * other)[1], axis=0)][:, None, None]
    new = np.linalg.inv(best * own + (1.0 - best) * other)
    pull = (1.0 - best) * other @ _apart(told.mean[:, 0], mean)[..., None]
    return _shifted(mean, (new @ pull)[..., 0]), symmetrize(new)


def subtracted(mean: Array, cov: Array, told: Told) -> tuple[Array, Array]:
    """Beliefs (k, 4), (k, 4, 4) with as many told ones, less what those knew at the last fusion (eq. 10)."""
    own, other = np.linalg.inv(cov), np.linalg.inv(told.cov[:, 0])
    before = np.where(told.known[:, None, None], np.linalg.inv(told.cov[:, 1]), 0.0)
    Y = symmetrize(own + other - before)
    sound = np.linalg.eigvalsh(Y)[:, 0] > 0.0
    new = np.linalg.inv(np.where(sound[:, None, None], Y, own))
    pull = other @ _apart(told.mean[:, 0], mean)[..., None] - before @ _apart(told.mean[:, 1], mean)[..., None]
    shift = np.where(sound[:, None], (new @ pull)[..., 0], 0.0)
    return _shifted(mean, shift), np.where(sound[:, None, None], symmetrize(new), cov)


def _adopted(told: Told, of: int, rules: Rules, name: int, misfit: float) -> Tracks:
    count = len(told.weight)
    lineage = np.zeros((count, rules.depth), dtype=np.int64)
    lineage[:, -1] = np.arange(name, name + count)
    return Tracks(
        np.full(count, of),
        told.weight,
        told.mean.copy(),
        told.cov.copy(),
        np.zeros(count, dtype=np.bool_),
        lineage,
        np.full(count, misfit),
    )


def _apart(other: Array, mean: Array) -> Array:
    found = other - mean
    found[..., 3] = wrap(found[..., 3])
    return np.asarray(found)


def _shifted(mean: Array, shift: Array) -> Array:
    found = mean + shift
    found[..., 3] = wrap(found[..., 3])
    return np.asarray(found)
