"""A small part of `make check-fuzz`: whatever peers send, nothing escapes, nothing grows, and the estimates stay."""

from __future__ import annotations

import pytest

from network.endpoint import Endpoint
from tests.fuzz.__main__ import LIES_MOVE
from tests.fuzz.examples import play_examples
from tests.fuzz.floods import SETTINGS, CoreFlood, EndpointFlood, assert_bounded, largest_difference

SECONDS, PACKETS = 6.0, 600


def test_mutated_messages_are_refused_for_a_reason_or_valid() -> None:
    flood = EndpointFlood()
    flood.play(1, 2_000)
    reasons = flood.reasons()
    assert reasons.total() == 2_000
    assert {"malformed", "wrong_type", "out_of_range", "duplicate", "delivered"} <= reasons.keys()
    assert len(flood.delivered) >= 5, "bodies of most kinds are let through now and then"


@pytest.mark.parametrize("form", ["safe", "split_joint", "jlatt", "icf_plus", "relative"])
def test_a_flood_that_is_refused_changes_no_estimate_by_a_bit(form: str) -> None:
    still = CoreFlood(form, None, 1, SECONDS)
    still.play()
    for content in ("refused", "strangers"):
        flood = CoreFlood(form, content, 1, SECONDS, PACKETS)
        flood.play()
        assert flood.sent >= PACKETS
        assert largest_difference(still.estimates(), flood.estimates()) == 0.0, content


def test_lies_under_a_valid_header_break_no_invariant_of_those_who_hear_them() -> None:
    still, flood = (CoreFlood("split_joint", content, 1, SECONDS, PACKETS) for content in (None, "lies"))
    still.play()
    flood.play()
    assert flood.reasons()["delivered"] > 20
    # What is let through does change them: the comparison above can fail.
    assert 0.0 < largest_difference(still.estimates(), flood.estimates()) <= LIES_MOVE


def test_a_table_without_a_bound_is_noticed() -> None:
    endpoint = Endpoint(robot="r1", boot_id=1, incarnation=1, settings=SETTINGS, software="1")
    assert_bounded(endpoint)
    endpoint._next_seq = {("pair", f"x-{index}"): 0 for index in range(1000)}
    with pytest.raises(AssertionError, match="_next_seq holds 1000 strangers"):
        assert_bounded(endpoint)


def test_messages_of_any_shape_are_accounted_for() -> None:
    assert play_examples(1, 100).total() >= 100
