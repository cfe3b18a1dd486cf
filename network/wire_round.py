"""Wire format of rounds: `[stage, belief, velocity, yaw_rate, [target, ...], [correction, ...]]`.

A target is as in a pair's snapshot, a correction `[id, d, place, sensor, pose]`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from network.messages import MAX_TARGETS, Correction, Header, RoundReport, RoundStage
from network.wire_fields import (
    SENSOR_FLOOR,
    WireError,
    pack_array,
    pack_belief,
    pack_cov,
    read_array,
    read_belief,
    read_cov,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_noise,
)
from network.wire_snapshots import pack_target, read_target

MAX_SPEED = 1e3
"""Largest speed [m/s] or yaw rate [rad/s] a robot may tell of."""


def pack_round(report: RoundReport) -> tuple[Any, ...]:
    return (
        int(report.stage),
        pack_belief(report.belief),
        pack_array(report.velocity, (3,)),
        pack_array(np.array([report.yaw_rate]), (1,)),
        tuple(map(pack_target, report.targets)),
        tuple(map(_pack_correction, report.corrections)),
    )


def _pack_correction(item: Correction) -> tuple[Any, ...]:
    d = len(item.place)
    return item.target, d, pack_array(item.place, (d,)), pack_cov(item.sensor, d), pack_cov(item.pose, d)


def read_round(raw: Any, header: Header) -> RoundReport:
    """Raises WireError. Corrections belong to the stage before they are used."""
    stage_raw, belief, velocity_raw, yaw_rate_raw, targets_raw, corrections_raw = read_fields(raw, 6)
    stage = read_integer(stage_raw)
    if stage not in (RoundStage.PRIOR, RoundStage.POSTERIOR):
        raise WireError("out_of_range")
    velocity, yaw_rate = read_array(velocity_raw, 3), read_array(yaw_rate_raw, 1)
    if np.abs(velocity).max() > MAX_SPEED or abs(yaw_rate[0]) > MAX_SPEED:
        raise WireError("out_of_range")
    targets = tuple(map(read_target, read_items(targets_raw, MAX_TARGETS)))
    corrections = tuple(map(_correction, read_items(corrections_raw, MAX_TARGETS)))
    if corrections and stage != RoundStage.PRIOR:
        raise WireError("malformed")
    for names in ([item.target for item in targets], [item.target for item in corrections]):
        if any(later <= earlier for earlier, later in pairwise(names)):
            raise WireError("malformed")
    return RoundReport(
        RoundStage(stage), read_belief(read_fields(belief, 4)), velocity, float(yaw_rate[0]), targets, corrections
    )


def _correction(raw: Any) -> Correction:
    target, d_raw, place, sensor, pose = read_fields(raw, 5)
    d = read_integer(d_raw)
    if d not in (2, 3):
        raise WireError("malformed")
    return Correction(
        read_id(target),
        read_array(place, d),
        read_cov(sensor, d, SENSOR_FLOOR, "below_sensor_floor"),
        read_noise(pose, d),
    )
