"""The live table says why nothing happens."""

from __future__ import annotations

from deploy.status import _cells


def test_a_neighbour_whose_clock_is_of_no_use_is_named_with_the_reason() -> None:
    clock = {"offset_s": 2.0, "sigma_s": 0.001, "steps": 0, "unusable": "offset"}
    status = {
        "x_m": 0.0,
        "y_m": 0.0,
        "sigma_m": 0.1,
        "lag_s": 0.0,
        "peers": {"r2": True, "r3": True, "r4": False},
        "clocks": {"r2": clock, "r3": {**clock, "unusable": None}},
    }
    assert _cells(None, status)[1] == "r2 (clock: offset) r3"
