"""What enters the core. Every event is frozen and carries `t_ns`, the fleet time at which it was handed in.

Data carry `t_meas_ns` besides: the instant they refer to. Frames: ENU position, heading counter-clockwise
from east, body FLU. Units SI and radians.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from network.messages import NO_MOUNT, Message, Mount

Array = NDArray[np.float64]

LEVEL = (0.0, 0.0)
"""Roll and pitch [rad] of a level body."""


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed; nothing else happened."""

    t_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Motion over [t0_ns, t_meas_ns], in the body frame at t0: delta = (dx, dy, dz, dyaw), cov (4, 4)."""

    t_ns: int
    t0_ns: int
    t_meas_ns: int
    delta: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Absolute information: kind `position` (x, y[, z]), `pose` (x, y[, z], heading), `heading`, `altitude`."""

    t_ns: int
    t_meas_ns: int
    kind: str
    z: Array
    R: Array
    sensor: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """A relative measurement of a subject: `r2`, `landmark:L3`, `target:t1`, or None (identity unknown).

    kinds `range` (m), `bearing` (rad), `bearing3` (azimuth, elevation in rad), `range_bearing` (m, rad), `vector` (x,
    y in m, forward and left), `pixel` (on the image plane at unit distance, right and down); azimuths are
    counter-clockwise from the sensor's forward axis. `mount`: the sensor on the body; `attitude`: roll and pitch [rad]
    of the body at the instant.
    """

    t_ns: int
    t_meas_ns: int
    kind: str
    of: str | None
    z: Array
    R: Array
    sensor: str = ""
    mount: Mount = NO_MOUNT
    attitude: tuple[float, float] = LEVEL


@dataclass(frozen=True, slots=True, eq=False)
class Completed:
    """An own measurement of the leader, and the leader's word about where it was then; nothing comes in with it.

    z, R, mount       as of an `Observation`
    place, place_cov  (2,) and (2, 2), ENU
    velocity          (2,) [m/s], ENU
    """

    t_meas_ns: int
    kind: str
    z: Array
    R: Array
    place: Array
    place_cov: Array
    velocity: Array
    mount: Mount = NO_MOUNT
    sensor: str = "leader"


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """A message that passed the endpoint, with the clock offset of its sender as known then.

    offset_ns: peer clock minus own clock; offset_sigma_ns: its standard deviation (None: not measured yet).
    """

    t_ns: int
    message: Message
    offset_ns: int = 0
    offset_sigma_ns: int | None = None


@dataclass(frozen=True, slots=True)
class LinkChange:
    """A peer was heard for the first time, came back, fell silent, or began a new life."""

    t_ns: int
    peer: str
    up: bool
    incarnation: int
    boot_id: int


@dataclass(frozen=True, slots=True)
class ClockJudged:
    """A peer's clock has become unusable for a `reason`, or usable again (None)."""

    t_ns: int
    peer: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class ControlReport:
    """What the autopilot says of being steered: None once it obeys, else why it does not, in a few words."""

    t_ns: int
    refused: str | None


@dataclass(frozen=True, slots=True)
class PlannerOverrun:
    """A plan took longer than it may: the next ones are made by the fallback."""

    t_ns: int


Event = Tick | Odometry | Fix | Observation | Received | LinkChange | ClockJudged | ControlReport | PlannerOverrun
