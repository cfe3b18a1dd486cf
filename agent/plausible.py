"""What no honest peer tells: numbers that are well-formed and finite, and cannot be of a robot or target.

The wire format bounds every number by what arithmetic bears. Here are bounds of what can be so: a fleet's frame is a
plane, which is tangent to the Earth for some kilometres only, and nobody knows where he is to parts of a micrometre.
What lies within is judged by the own belief: `agree`, and `agent.health` for relative measurements.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import quadratic_form, wrap_components
from agent.estimation.motion import STATES
from agent.settings import HealthSettings
from network.bearing_messages import BearingReport
from network.leader_messages import LeaderReport
from network.messages import (
    Body,
    JointSnapshot,
    PairReply,
    PairRequest,
    RoundReport,
    Snapshot,
    SplitReply,
    SplitRequest,
    SplitSnapshot,
)
from network.relative_messages import HypothesesReport, MotionReport

Array = NDArray[np.float64]

FARTHEST = 1e6
"""Largest magnitude of any component: a thousand kilometres from the fleet's origin, far beyond any tangent plane."""

SUREST = 1e-14
"""Smallest variance [m^2, rad^2] of a place or heading: a tenth of a micrometre, or of a microradian."""


def plausible(body: Body) -> bool:
    """Whether what a peer tells of itself and of targets can be so; of a body without beliefs it always can."""
    if isinstance(body, RoundReport):
        return _round_possible(body)
    if isinstance(body, BearingReport):
        return _bearings_possible(body)
    if isinstance(body, LeaderReport):
        return bool(np.abs(body.place).max() <= FARTHEST and body.cov.diagonal().min() >= SUREST)
    if isinstance(body, MotionReport):
        return body.height is None or abs(body.height.altitude_m) <= FARTHEST
    if isinstance(body, HypothesesReport):
        return _hypotheses_possible(body)
    if not isinstance(body, PairRequest | PairReply | SplitRequest | SplitReply) or body.snapshot is None:
        return True
    return all(_possible(*part) for part in _beliefs(body.snapshot))


def _round_possible(report: RoundReport) -> bool:
    beliefs = (report.belief, *(target.belief for target in report.targets))
    corrections = ((item.place, (item.sensor + item.pose).diagonal()) for item in report.corrections)
    return all(_possible(belief.model, belief.mean, belief.cov.diagonal()) for belief in beliefs) and all(
        np.abs(place).max() <= FARTHEST and variances.min() >= SUREST for place, variances in corrections
    )


def _bearings_possible(report: BearingReport) -> bool:
    variances = (item.cov.diagonal()[:3] for item in report.predictions if item.cov is not None)
    numbers = [item.place for item in report.bearings] + [item.mean for item in report.predictions]
    return all(np.abs(found).max() <= FARTHEST for found in numbers) and all(
        found.min() >= SUREST for found in variances
    )


def _hypotheses_possible(report: HypothesesReport) -> bool:
    for item in report.subjects:
        for means, covs in ((item.means, item.covs), (item.priors, item.prior_covs)):
            if means is None or covs is None or not len(means):
                continue
            if np.abs(means).max() > FARTHEST or covs.diagonal(axis1=1, axis2=2).min() < SUREST:
                return False
    return True


def _beliefs(told: Snapshot | JointSnapshot | SplitSnapshot) -> Iterator[tuple[str, Array, Array]]:
    """(model, mean (d,), variances (d,)) of the robot and of each target."""
    if isinstance(told, Snapshot):
        yield told.belief.model, told.belief.mean, told.belief.cov.diagonal()
    else:
        variances, begin = told.cov.diagonal(), 0
        for model in (told.model, *(model for _, model in told.targets)):
            end = begin + (STATES[model].dim if model in STATES else 0)
            yield model, told.mean[begin:end], variances[begin:end]
            begin = end
    apart = told.targets if isinstance(told, Snapshot) else () if isinstance(told, JointSnapshot) else told.relayed
    for target in apart:
        yield target.belief.model, target.belief.mean, target.belief.cov.diagonal()


def _possible(model: str, mean: Array, variances: Array) -> bool:
    layout = STATES.get(model)
    if layout is None or not len(mean) == len(variances) == layout.dim:
        # Nothing is known of such a state; what it is good for is judged by the form.
        return True
    sure = list(layout.position) + ([] if layout.heading is None else [layout.heading])
    return bool(np.abs(mean).max() <= FARTHEST and variances[sure].min() >= SUREST)


def agree(
    settings: HealthSettings, mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array, angles: tuple[int, ...]
) -> bool:
    """Whether two beliefs (d,), (d, d) of one target can both be right, by the gate of contacts.

    Raises `numpy.linalg.LinAlgError` if the covariances can't be inverted.
    """
    if not settings.enabled:
        return True
    apart = wrap_components(mean_b - mean_a, angles)
    return float(quadratic_form(apart, cov_a + cov_b)) <= settings.gate_nis * len(apart)
