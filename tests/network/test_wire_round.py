"""Reports of rounds: what breaks a rule is our own mistake on the way out, and refused on the way in."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from agent.plausible import plausible
from network.messages import Correction, RoundReport, RoundStage
from network.wire import encode
from tests.network.test_wire import HEADER, example_round

SEEN = example_round().corrections[0]


def report_with(**changes: Any) -> RoundReport:
    return dataclasses.replace(example_round(), **changes)


def seen_with(**changes: Any) -> RoundReport:
    return report_with(corrections=(dataclasses.replace(SEEN, **changes),))


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (report_with(stage=RoundStage.POSTERIOR), "malformed"),
        (report_with(targets=example_round().targets[::-1]), "malformed"),
        (report_with(corrections=(SEEN, SEEN)), "malformed"),
        (report_with(velocity=np.array([0.0, 2e3, 0.0])), "out_of_range"),
        (report_with(yaw_rate=-2e3), "out_of_range"),
        (report_with(yaw_rate=np.nan), "non_finite"),
        (seen_with(target="T"), "bad_id"),
        (seen_with(place=np.zeros(4), sensor=np.eye(4), pose=np.eye(4)), "malformed"),
        (seen_with(sensor=1e-12 * np.eye(2)), "below_sensor_floor"),
        (seen_with(pose=np.diag([1.0, -1.0])), "not_positive_definite"),
    ],
)
def test_what_breaks_a_rule_is_not_told(report: RoundReport, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        encode(HEADER, report)


def test_a_pose_that_is_known_exactly_adds_nothing() -> None:
    encode(HEADER, seen_with(pose=np.zeros((2, 2))))


def test_who_tells_what_cannot_be_is_not_heard() -> None:
    assert plausible(example_round())
    far = Correction("t1", np.array([2e6, 0.0]), SEEN.sensor, SEEN.pose)
    assert not plausible(report_with(corrections=(far,)))
    belief = dataclasses.replace(example_round().belief, mean=np.array([0.0, 2e6, 0.0]))
    assert not plausible(report_with(belief=belief))
