"""Wire format of what is triangulated with: `[[bearing, ...], [prediction, ...]]`, each ascending by target.

A bearing is `[id, place, place_cov, direction, sigma, age]`, a prediction `[id, mean, cov or nil]`.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from network.bearing_messages import Bearing, BearingReport, Prediction
from network.messages import MAX_TARGETS, Header
from network.wire_fields import (
    BELIEF_FLOOR,
    SENSOR_FLOOR,
    WireError,
    pack_array,
    pack_cov,
    read_array,
    read_cov,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_noise,
)

UNIT = 1e-6
"""How far the length of a direction may be from 1."""


def pack_bearings(report: BearingReport) -> tuple[Any, ...]:
    """The fields of a report. Raises ValueError for arrays of wrong sizes."""
    return tuple(map(_pack_bearing, report.bearings)), tuple(map(_pack_prediction, report.predictions))


def _pack_bearing(item: Bearing) -> tuple[Any, ...]:
    place, direction = pack_array(item.place, (3,)), pack_array(item.direction, (3,))
    sigma = pack_array(np.array([item.sigma_rad]), (1,))
    return item.target, place, pack_cov(item.place_cov, 3), direction, sigma, item.age_ns


def _pack_prediction(item: Prediction) -> tuple[Any, ...]:
    return item.target, pack_array(item.mean, (6,)), None if item.cov is None else pack_cov(item.cov, 6)


def read_bearings(raw: Any, header: Header) -> BearingReport:
    """What `pack_bearings` made, or `WireError`."""
    bearings_raw, predictions_raw = read_fields(raw, 2)
    bearings = tuple(map(_bearing, read_items(bearings_raw, MAX_TARGETS)))
    predictions = tuple(map(_prediction, read_items(predictions_raw, MAX_TARGETS)))
    for names in ([item.target for item in bearings], [item.target for item in predictions]):
        if any(later <= earlier for earlier, later in pairwise(names)):
            raise WireError("malformed")
    return BearingReport(bearings, predictions)


def _bearing(raw: Any) -> Bearing:
    target, place, place_cov, direction_raw, sigma_raw, age_raw = read_fields(raw, 6)
    direction, sigma = read_array(direction_raw, 3), float(read_array(sigma_raw, 1)[0])
    if abs(float(np.linalg.norm(direction)) - 1.0) > UNIT or sigma > math.pi:
        raise WireError("out_of_range")
    if sigma * abs(sigma) < SENSOR_FLOOR:
        raise WireError("below_sensor_floor")
    return Bearing(
        read_id(target), read_array(place, 3), read_noise(place_cov, 3), direction, sigma, read_integer(age_raw)
    )


def _prediction(raw: Any) -> Prediction:
    target, mean, cov_raw = read_fields(raw, 3)
    cov = None if cov_raw is None else read_cov(cov_raw, 6, BELIEF_FLOOR, "not_positive_definite")
    return Prediction(read_id(target), read_array(mean, 6), cov)
