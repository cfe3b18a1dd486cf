"""Wire format of a leader's word: `[number]`, and `[place, cov, velocity, before or nil, answers or nil]`."""

from __future__ import annotations

from typing import Any

import numpy as np

from network.leader_messages import LeaderReport, LeaderRequest
from network.messages import Header
from network.wire_fields import (
    SENSOR_FLOOR,
    WireError,
    pack_array,
    pack_cov,
    read_array,
    read_cov,
    read_fields,
    read_integer,
)
from network.wire_round import MAX_SPEED


def pack_request(request: LeaderRequest) -> tuple[Any, ...]:
    return (request.number,)


def pack_word(report: LeaderReport) -> tuple[Any, ...]:
    """The fields of a report. Raises ValueError for arrays of wrong sizes."""
    place, velocity = pack_array(report.place, (2,)), pack_array(report.velocity, (2,))
    return place, pack_cov(report.cov, 2), velocity, report.before_ns, report.answers


def read_request(raw: Any, header: Header) -> LeaderRequest:
    """Raises WireError."""
    (number,) = read_fields(raw, 1)
    return LeaderRequest(read_integer(number))


def read_word(raw: Any, header: Header) -> LeaderReport:
    """Raises WireError. A report is of a later instant than the one before it, and has none if it is an answer."""
    place, cov, velocity_raw, before_raw, answers_raw = read_fields(raw, 5)
    velocity = read_array(velocity_raw, 2)
    if np.abs(velocity).max() > MAX_SPEED:
        raise WireError("out_of_range")
    before_ns = None if before_raw is None else read_integer(before_raw)
    answers = None if answers_raw is None else read_integer(answers_raw)
    if before_ns is not None and (answers is not None or before_ns >= header.t_meas_ns):
        raise WireError("malformed")
    return LeaderReport(
        read_array(place, 2), read_cov(cov, 2, SENSOR_FLOOR, "below_sensor_floor"), velocity, before_ns, answers
    )
