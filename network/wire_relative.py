"""Wire format of motions and of hypotheses.

A motion is `[span, velocity, cov, height or nil]`, a height `[values, age]` with altitude and variance in double
precision. Hypotheses are `[since, part, parts, [subject, ...]]`, ascending by subject, each `[id, k, data, prior or
nil, known]`: `data` and `prior` hold k rows of weight, mean and covariance, or of mean and covariance.
Velocities, hypotheses and covariances (upper triangles) travel in single precision.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

from network.messages import MAX_MESSAGE_BYTES, Header
from network.relative_messages import (
    MAX_HYPOTHESES,
    MAX_PARTS,
    MAX_SUBJECTS,
    Height,
    HypothesesReport,
    MotionReport,
    SubjectReport,
)
from network.wire_fields import (
    BELIEF_FLOOR,
    FULL,
    SENSOR_FLOOR,
    WireError,
    checked_cov,
    pack_array,
    pack_cov,
    read_array,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_single,
)
from network.wire_round import MAX_SPEED

Array = NDArray[np.float64]

DIM = 4
PACKED = DIM * (DIM + 1) // 2
MAX_SPAN_NS = 10_000_000_000
"""A report that tells of more than that says nothing of how its robot moved."""

SINGLE = 1e-6
"""How far below zero, relative to the largest variance, single precision may take an eigenvalue of noise."""

MAX_WEIGHT = 1.0 + 1e-6
_PAST_HEADER = 96
"""Bytes for what surrounds the subjects of a report: header, kind, stamps and marks."""


# --- motions ----------------------------------------------------------------------------------------------


def pack_motion(report: MotionReport) -> tuple[Any, ...]:
    """The fields of a report. Raises ValueError for arrays of wrong sizes."""
    height = None
    if report.height is not None:
        values = np.array([report.height.altitude_m, report.height.variance_m2])
        height = pack_array(values, (2,)), report.height.age_ns
    velocity = pack_array(report.velocity, (DIM,), "<f4")
    return report.span_ns, velocity, pack_cov(report.cov, DIM, "<f4"), height


def read_motion(raw: Any, header: Header) -> MotionReport:
    """What `pack_motion` made, or `WireError`."""
    span_raw, velocity_raw, cov_raw, height_raw = read_fields(raw, 4)
    span_ns = read_integer(span_raw, MAX_SPAN_NS)
    velocity, cov = read_single(velocity_raw, DIM), read_single(cov_raw, PACKED)[FULL[DIM]]
    if span_ns == 0 or np.abs(velocity).max() > MAX_SPEED:
        raise WireError("out_of_range")
    slack = SINGLE * float(cov.diagonal().max()) + BELIEF_FLOOR
    if cov.diagonal().min() < 0.0 or dpotrf(cov + slack * np.eye(DIM), lower=1)[1] != 0:
        raise WireError("not_positive_definite")
    return MotionReport(span_ns, velocity, cov, None if height_raw is None else _height(height_raw))


def _height(raw: Any) -> Height:
    values_raw, age_raw = read_fields(raw, 2)
    altitude, variance = read_array(values_raw, 2).tolist()
    if variance < SENSOR_FLOOR:
        raise WireError("below_sensor_floor")
    return Height(altitude, variance, read_integer(age_raw, MAX_SPAN_NS))


# --- hypotheses -------------------------------------------------------------------------------------------


def pack_hypotheses(report: HypothesesReport) -> tuple[Any, ...]:
    """The fields of a report. Raises ValueError for arrays of wrong sizes."""
    return report.since_ns, report.part, report.parts, tuple(map(_pack_subject, report.subjects))


def _pack_subject(item: SubjectReport) -> tuple[Any, ...]:
    k, prior = len(item.weights), None
    weights = pack_array(item.weights, (k,), "<f4")
    rows = [
        weights[4 * index : 4 * index + 4] + _pack_gaussian(item.means[index], item.covs[index]) for index in range(k)
    ]
    if item.priors is not None and item.prior_covs is not None:
        prior = b"".join(_pack_gaussian(item.priors[index], item.prior_covs[index]) for index in range(k))
    return item.subject, k, b"".join(rows), prior, item.prior_known


def _pack_gaussian(mean: Array, cov: Array) -> bytes:
    return pack_array(mean, (DIM,), "<f4") + pack_cov(cov, DIM, "<f4")


def read_hypotheses(raw: Any, header: Header) -> HypothesesReport:
    """What `pack_hypotheses` made, or `WireError`."""
    since_raw, part_raw, parts_raw, subjects_raw = read_fields(raw, 4)
    parts = read_integer(parts_raw, MAX_PARTS)
    part = read_integer(part_raw, MAX_PARTS)
    if part >= parts:
        raise WireError("out_of_range")
    subjects = tuple(map(_subject, read_items(subjects_raw, MAX_SUBJECTS)))
    if any(later.subject <= earlier.subject for earlier, later in pairwise(subjects)):
        raise WireError("malformed")
    if any(item.subject == header.source for item in subjects):
        raise WireError("source_mismatch")
    return HypothesesReport(read_integer(since_raw), part, parts, subjects)


def _subject(raw: Any) -> SubjectReport:
    subject, k_raw, data_raw, prior_raw, known_raw = read_fields(raw, 5)
    k = read_integer(k_raw, MAX_HYPOTHESES)
    data = read_single(data_raw, k, 1 + DIM + PACKED)
    weights = data[:, 0]
    if (weights < 0.0).any() or float(weights.sum()) > MAX_WEIGHT:
        raise WireError("out_of_range")
    known = read_items(known_raw, MAX_HYPOTHESES)
    if any(type(item) is not bool for item in known):
        raise WireError("wrong_type")
    if len(known) != (0 if prior_raw is None else k):
        raise WireError("malformed")
    priors = prior_covs = None
    if prior_raw is not None:
        priors, prior_covs = _gaussians(read_single(prior_raw, k, DIM + PACKED))
    means, covs = _gaussians(data[:, 1:])
    return SubjectReport(read_id(subject), weights, means, covs, priors, prior_covs, known)


def _gaussians(rows: Array) -> tuple[Array, Array]:
    """Means (k, 4) and covariances (k, 4, 4) of rows (k, 14)."""
    if len(rows) and np.abs(rows[:, 3]).max() > 2.0 * math.pi:
        raise WireError("out_of_range")
    covs = [checked_cov(row, DIM, BELIEF_FLOOR, "not_positive_definite") for row in rows[:, DIM:]]
    return rows[:, :DIM], np.array(covs).reshape(-1, DIM, DIM)


def sendable(cov: Array) -> bool:
    """Whether a covariance (4, 4) is one in single precision too."""
    with np.errstate(over="ignore", invalid="ignore"):
        single = cov.astype(np.float32).astype(np.float64)
    root, info = dpotrf(single, lower=1)
    return bool(np.isfinite(single).all() and info == 0 and root.diagonal().min() ** 2 >= BELIEF_FLOOR)


def parted(since_ns: int, subjects: list[SubjectReport]) -> list[HypothesesReport]:
    """One report in as few messages as it fits into, none of them too long."""
    groups: list[list[SubjectReport]] = [[]]
    room = MAX_MESSAGE_BYTES - _PAST_HEADER
    for item in subjects:
        size = len(msgpack.packb(_pack_subject(item)))
        if groups[-1] and (size > room or len(groups[-1]) == MAX_SUBJECTS):
            groups.append([])
            room = MAX_MESSAGE_BYTES - _PAST_HEADER
        groups[-1].append(item)
        room -= size
    return [HypothesesReport(since_ns, part, len(groups), tuple(group)) for part, group in enumerate(groups)]
