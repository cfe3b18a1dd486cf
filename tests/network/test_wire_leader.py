"""A leader's words: what breaks a rule is our own mistake on the way out, and refused on the way in."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from agent.plausible import plausible
from network.endpoint import Endpoint, EndpointSettings
from network.leader_messages import LeaderReport, LeaderRequest
from network.messages import Channel
from network.wire import decode, encode
from tests.network.test_wire import HEADER, example_word


def word_with(**changes: Any) -> LeaderReport:
    return dataclasses.replace(example_word(), **changes)


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (word_with(place=np.array([np.nan, 0.0])), "non_finite"),
        (word_with(place=np.array([2e9, 0.0])), "out_of_range"),
        (word_with(cov=np.diag([1.0, 0.0])), "not_positive_definite"),
        (word_with(cov=1e-11 * np.eye(2)), "below_sensor_floor"),
        (word_with(velocity=np.array([2e3, 0.0])), "out_of_range"),
        (word_with(before_ns=HEADER.t_meas_ns), "malformed"),
        (word_with(before_ns=-1), "out_of_range"),
        (word_with(answers=3), "malformed"),
        (word_with(before_ns=None, answers=True), "wrong_type"),
    ],
)
def test_what_breaks_a_rule_is_not_told(report: LeaderReport, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        encode(HEADER, report)


def test_arrays_of_wrong_sizes_are_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="belongs"):
        encode(HEADER, word_with(place=np.zeros(3)))


def test_what_is_told_is_what_is_heard() -> None:
    heard = decode(encode(HEADER, example_word()), HEADER.source).body
    assert isinstance(heard, LeaderReport)
    assert np.array_equal(heard.place, example_word().place)
    assert np.array_equal(heard.cov, example_word().cov)
    assert (heard.before_ns, heard.answers) == (HEADER.t_meas_ns - 100, None)
    assert decode(encode(HEADER, LeaderRequest(2**40)), HEADER.source).body == LeaderRequest(2**40)


def test_an_answer_is_for_who_asked_and_a_word_for_everybody() -> None:
    end = Endpoint(robot="r1", boot_id=1, incarnation=1, settings=EndpointSettings(), software="1")
    assert end.send(0, "r2", 2_000, word_with(before_ns=None, answers=1)).channel == Channel.PAIR
    assert end.broadcast(0, Channel.BELIEF, 2_000, example_word()).destination is None
    with pytest.raises(ValueError, match="does not belong"):
        end.send(0, "r2", 2_000, example_word())
    with pytest.raises(ValueError, match="does not belong"):
        end.broadcast(0, Channel.BELIEF, 2_000, LeaderRequest(1))


def test_who_tells_what_cannot_be_is_not_heard() -> None:
    assert plausible(example_word())
    assert not plausible(word_with(place=np.array([2e6, 0.0])))
