"""Fields of a saved state: what is not of the type, the size or the sense it should be is refused with the reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from agent.state_fields import StateError, read_amount, read_by_id, read_cov, read_flag, read_stamp
from network.wire_fields import MAX_INT, WireError


@pytest.mark.parametrize(
    ("read", "raw", "reason"),
    [
        (read_stamp, True, "wrong_type"),
        (read_stamp, 1.0, "wrong_type"),
        (read_stamp, -MAX_INT - 1, "out_of_range"),
        (read_flag, 1, "wrong_type"),
        (read_amount, 1, "wrong_type"),
        (read_amount, -0.1, "out_of_range"),
        (read_amount, float("nan"), "out_of_range"),
        (read_amount, float("inf"), "out_of_range"),
    ],
)
def test_what_is_no_such_field_is_refused(read: Callable[[Any], Any], raw: Any, reason: str) -> None:
    with pytest.raises(StateError) as refused:
        read(raw)
    assert refused.value.reason == reason


def test_what_is_one_is_read() -> None:
    assert (read_stamp(-5), read_flag(False), read_amount(0.25)) == (-5, False, 0.25)


@pytest.mark.parametrize("wrong", [np.diag([1.0, -1.0]), np.array([[1.0, 0.1], [0.2, 1.0]]), np.zeros((2, 2))])
def test_what_is_no_covariance_is_refused(wrong: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    with pytest.raises(StateError, match="not_positive_definite"):
        read_cov(wrong.tobytes(), 2)


def test_a_covariance_is_one_s_own_copy() -> None:
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = read_cov(P.tobytes(), 2)
    found[0, 0] = 3.0
    assert np.array_equal(read_cov(P.tobytes(), 2), P)


def test_each_name_is_told_of_once_and_all_of_it() -> None:
    assert read_by_id((("r2", 1, 2), ("r3", 3, 4)), 2, sum) == {"r2": 3, "r3": 7}
    with pytest.raises(StateError, match="inconsistent"):
        read_by_id((("r2", 1), ("r2", 1)), 1, sum)
    with pytest.raises(WireError):
        read_by_id((("r2", 1),), 2, sum)
    with pytest.raises(WireError):
        read_by_id(tuple((f"r{k}", k) for k in range(5)), 1, sum, most=4)
