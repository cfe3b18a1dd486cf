"""Wire format of what a robot tells its whole team: `[born_ns, [reckoning, ...], [measurement, ...]]`.

A reckoning is `[anchor_ns, before_ns, t_ns, delta, cov]`; a measurement is
`[t_ns, index, of, kind, m, z, R, mount or nil]`.
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np

from network.messages import (
    MAX_RAW_MEASUREMENTS,
    MAX_RECKONINGS,
    NO_MOUNT,
    Header,
    RawMeasurement,
    Reckoning,
    TeamReport,
)
from network.wire_fields import (
    MEASUREMENT_DIMS,
    SENSOR_FLOOR,
    WireError,
    pack_array,
    pack_cov,
    read_array,
    read_cov,
    read_fields,
    read_integer,
    read_items,
    read_mount,
    read_noise,
    read_text,
)

ABSOLUTE_DIMS = {"position": (2, 3), "pose": (3, 4), "heading": (1,), "altitude": (1,)}
"""Sizes of what concerns a robot alone."""

MAX_INDEX = 4095

_SUBJECT = re.compile(r"(?:landmark:[A-Za-z0-9_.-]{1,32}|target:[a-z0-9-]{1,24}|[a-z0-9-]{1,24})").fullmatch


def pack_report(report: TeamReport) -> tuple[Any, ...]:
    reckonings = tuple(
        (item.anchor_ns, item.before_ns, item.t_ns, pack_array(item.delta, (4,)), pack_cov(item.cov, 4))
        for item in report.reckonings
    )
    return report.born_ns, reckonings, tuple(map(_pack_measurement, report.measurements))


def _pack_measurement(item: RawMeasurement) -> tuple[Any, ...]:
    m = len(item.z)
    mount = None if item.mount == NO_MOUNT else pack_array(np.asarray(item.mount), (6,))
    return item.t_ns, item.index, item.of, item.kind, m, pack_array(item.z, (m,)), pack_cov(item.R, m), mount


def read_report(raw: Any, header: Header) -> TeamReport:
    """Raises WireError. Nothing is told before the robot's life began, or of what comes after the message's instant."""
    born_raw, reckonings_raw, measurements_raw = read_fields(raw, 3)
    born_ns = read_integer(born_raw, header.t_meas_ns)
    reckonings = tuple(_reckoning(item, born_ns, header) for item in read_items(reckonings_raw, MAX_RECKONINGS))
    if any(later.t_ns <= earlier.t_ns for earlier, later in pairwise(reckonings)):
        raise WireError("malformed")
    measurements = tuple(_measurement(item, header) for item in read_items(measurements_raw, MAX_RAW_MEASUREMENTS))
    told_twice = len({(item.t_ns, item.index) for item in measurements}) != len(measurements)
    if told_twice or not (reckonings or measurements):
        raise WireError("malformed")
    return TeamReport(born_ns, reckonings, measurements)


def _reckoning(raw: Any, born_ns: int, header: Header) -> Reckoning:
    anchor_raw, before_raw, t_raw, delta, cov = read_fields(raw, 5)
    anchor_ns, before_ns = read_integer(anchor_raw), read_integer(before_raw)
    t_ns = read_integer(t_raw, header.t_meas_ns)
    if not born_ns <= anchor_ns <= before_ns < t_ns:
        raise WireError("out_of_range")
    return Reckoning(anchor_ns, before_ns, t_ns, read_array(delta, 4), read_noise(cov, 4))


def _measurement(raw: Any, header: Header) -> RawMeasurement:
    t_raw, index, of, kind, m_raw, z_raw, R, mount = read_fields(raw, 8)
    read_text(kind)
    sizes = ABSOLUTE_DIMS.get(kind) if of is None else None
    if of is not None:
        if _SUBJECT(read_text(of)) is None or of == header.source:
            raise WireError("bad_id")
        sizes = (MEASUREMENT_DIMS[kind],) if kind in MEASUREMENT_DIMS else None
    if sizes is None:
        raise WireError("unknown_kind")
    m = read_integer(m_raw)
    if m not in sizes:
        raise WireError("malformed")
    z = read_array(z_raw, m)
    if kind in ("range", "range_bearing") and z[0] < 0.0:
        raise WireError("out_of_range")
    return RawMeasurement(
        read_integer(t_raw, header.t_meas_ns),
        read_integer(index, MAX_INDEX),
        of,
        kind,
        z,
        read_cov(R, m, SENSOR_FLOOR, "below_sensor_floor"),
        NO_MOUNT if mount is None else read_mount(mount),
    )
