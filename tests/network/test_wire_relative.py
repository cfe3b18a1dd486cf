"""Reports of motions and hypotheses: what breaks a rule is not told, and what is told fits into messages."""

from __future__ import annotations

import dataclasses
from typing import Any

import msgpack
import numpy as np
import pytest

from agent.plausible import plausible
from network.messages import MAX_MESSAGE_BYTES, Header
from network.relative_messages import Height, HypothesesReport, MotionReport, SubjectReport
from network.wire import decode, encode
from network.wire_fields import MAX_INT, WireError
from network.wire_relative import parted, sendable
from tests.network.test_wire import HEADER, example_hypotheses, example_motion

FIRST = example_hypotheses().subjects[0]
WORST = Header("r" * 24, MAX_INT, MAX_INT, MAX_INT, MAX_INT, MAX_INT)


def moved_with(**changes: Any) -> MotionReport:
    return dataclasses.replace(example_motion(), **changes)


def told_with(**changes: Any) -> HypothesesReport:
    return dataclasses.replace(example_hypotheses(), subjects=(dataclasses.replace(FIRST, **changes),))


def subject(name: str, k: int = 5, prior: bool = False) -> SubjectReport:
    covs = np.tile(np.eye(4), (k, 1, 1))
    told = SubjectReport(name, np.full(k, 1.0 / k), np.ones((k, 4)), covs)
    return dataclasses.replace(told, priors=told.means, prior_covs=covs, prior_known=(True,) * k) if prior else told


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (moved_with(span_ns=0), "out_of_range"),
        (moved_with(span_ns=11_000_000_000), "out_of_range"),
        (moved_with(velocity=np.array([2e3, 0.0, 0.0, 0.0])), "out_of_range"),
        (moved_with(velocity=np.full(4, np.nan)), "non_finite"),
        (moved_with(cov=np.diag([1.0, 1.0, 1.0, -1.0])), "not_positive_definite"),
        (moved_with(height=Height(0.0, 0.0)), "below_sensor_floor"),
        (moved_with(height=Height(np.inf, 1.0)), "non_finite"),
        (moved_with(height=Height(0.0, 1.0, -1)), "out_of_range"),
        (told_with(subject="P"), "bad_id"),
        (told_with(subject="r1"), "source_mismatch"),
        (told_with(weights=np.array([0.75, 0.5])), "out_of_range"),
        (told_with(weights=np.array([0.75, -0.5])), "out_of_range"),
        (told_with(means=np.full((2, 4), 7.0)), "out_of_range"),
        (told_with(covs=-FIRST.covs), "not_positive_definite"),
        (told_with(prior_covs=-FIRST.covs), "not_positive_definite"),
        (told_with(prior_known=(True,)), "malformed"),
        (told_with(prior_known=(1, 0)), "wrong_type"),
        (told_with(priors=None, prior_covs=None), "malformed"),
        (dataclasses.replace(example_hypotheses(), part=2), "out_of_range"),
        (dataclasses.replace(example_hypotheses(), subjects=(FIRST, FIRST)), "malformed"),
        (HypothesesReport(0, 0, 1, (subject("p1", 6),)), "out_of_range"),
    ],
)
def test_what_breaks_a_rule_is_not_told(report: MotionReport | HypothesesReport, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        encode(HEADER, report)


def test_arrays_of_wrong_sizes_are_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="belongs"):
        encode(HEADER, moved_with(velocity=np.zeros(3)))
    with pytest.raises(ValueError, match="belongs"):
        encode(HEADER, told_with(means=np.zeros((2, 3))))


def test_rows_that_are_cut_short_are_refused() -> None:
    head, kind, (since, part, parts, subjects) = msgpack.unpackb(encode(HEADER, example_hypotheses()), use_list=False)
    (name, k, data, prior, known), other = subjects
    for cut in ((name, k, data[:-4], prior, known), (name, k + 1, data, prior, known)):
        payload = msgpack.packb((head, kind, (since, part, parts, (cut, other))))
        with pytest.raises(WireError, match="malformed"):
            decode(payload, "r1")


def test_a_robot_that_knows_its_motion_exactly_may_say_so() -> None:
    body = decode(encode(HEADER, moved_with(cov=np.zeros((4, 4)))), "r1").body
    assert isinstance(body, MotionReport) and not body.cov.any()


def test_noise_that_single_precision_makes_a_little_negative_is_noise() -> None:
    root = np.random.default_rng(1).normal(size=(4, 2))
    assert decode(encode(HEADER, moved_with(cov=root @ root.T)), "r1")


@pytest.mark.parametrize("prior", [False, True])
@pytest.mark.parametrize("count", [1, 4, 15])
def test_a_report_is_told_in_messages_that_are_short_enough(count: int, prior: bool) -> None:
    told = [subject(f"p{index:023d}", prior=prior) for index in range(count)]
    reports = parted(MAX_INT, told)
    assert [item.subject for report in reports for item in report.subjects] == [item.subject for item in told]
    assert [(report.part, report.parts) for report in reports] == [(i, len(reports)) for i in range(len(reports))]
    sizes = [len(encode(WORST, report)) for report in reports]
    assert max(sizes) <= MAX_MESSAGE_BYTES
    assert len(reports) <= (count if prior else -(-count // 3))


def test_nothing_to_tell_is_told_too() -> None:
    (report,) = parted(0, [])
    assert report.subjects == () and decode(encode(HEADER, report), "r1")


def test_what_single_precision_cannot_hold_is_found_out_before() -> None:
    assert sendable(np.diag([1e-6, 1e-6, 1e-6, 1e-4]))
    wide = np.array([1.0, 1.0 - 1e-9, 0.0, 0.0])
    assert not sendable(np.outer(wide, wide) + 1e-12 * np.eye(4))
    assert not sendable(np.diag([1e-30, 1.0, 1.0, 1.0]))
    assert not sendable(np.diag([1e60, 1.0, 1.0, 1.0]))


@pytest.mark.parametrize(
    ("report", "possible"),
    [
        (example_motion(), True),
        (example_hypotheses(), True),
        (moved_with(height=Height(1e8, 1.0)), False),
        (told_with(means=np.array([[1e8, 0.0, 0.0, 0.0]] * 2)), False),
        (told_with(covs=np.array([1e-16 * np.eye(4)] * 2)), False),
        (told_with(priors=np.array([[1e8, 0.0, 0.0, 0.0]] * 2)), False),
    ],
)
def test_no_honest_robot_tells_such_numbers(report: MotionReport | HypothesesReport, possible: bool) -> None:
    assert plausible(report) is possible
