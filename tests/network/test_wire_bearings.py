"""Reports of bearings: what breaks a rule is our own mistake on the way out, and refused on the way in."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from agent.plausible import plausible
from network.bearing_messages import BearingReport, Prediction
from network.wire import decode, encode
from tests.network.test_wire import HEADER, example_bearings

SEEN, TOLD = example_bearings().bearings[0], example_bearings().predictions[0]


def seen_with(**changes: Any) -> BearingReport:
    return BearingReport((dataclasses.replace(SEEN, **changes),))


def told_with(**changes: Any) -> BearingReport:
    return BearingReport((), (dataclasses.replace(TOLD, **changes),))


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (BearingReport((SEEN, SEEN)), "malformed"),
        (BearingReport((), (TOLD, TOLD)), "malformed"),
        (seen_with(target="T"), "bad_id"),
        (seen_with(direction=np.array([0.6, 0.0, 0.81])), "out_of_range"),
        (seen_with(direction=np.array([np.nan, 0.0, 1.0])), "non_finite"),
        (seen_with(sigma_rad=0.0), "below_sensor_floor"),
        (seen_with(sigma_rad=-0.5), "below_sensor_floor"),
        (seen_with(sigma_rad=4.0), "out_of_range"),
        (seen_with(place_cov=np.diag([1.0, 1.0, -1.0])), "not_positive_definite"),
        (seen_with(age_ns=-1), "out_of_range"),
        (told_with(cov=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])), "not_positive_definite"),
        (told_with(mean=np.full(6, np.inf)), "non_finite"),
    ],
)
def test_what_breaks_a_rule_is_not_told(report: BearingReport, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        encode(HEADER, report)


def test_arrays_of_wrong_sizes_are_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="belongs"):
        encode(HEADER, told_with(mean=np.zeros(4)))


def test_what_is_told_is_what_is_heard() -> None:
    heard = decode(encode(HEADER, example_bearings()), HEADER.source).body
    assert isinstance(heard, BearingReport)
    assert np.array_equal(heard.bearings[0].direction, SEEN.direction)
    assert heard.predictions[0].cov is not None and np.array_equal(heard.predictions[0].cov, TOLD.cov)
    assert heard.predictions[1].cov is None


def test_who_tells_what_cannot_be_is_not_heard() -> None:
    assert plausible(example_bearings())
    assert not plausible(seen_with(place=np.array([2e6, 0.0, 0.0])))
    assert not plausible(BearingReport((), (Prediction("t1", np.full(6, 2e6)),)))
    assert not plausible(told_with(cov=1e-16 * np.eye(6)))
