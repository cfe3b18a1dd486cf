"""What leaves the core. Effects are carried out by a shell, in order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from network.messages import Body

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Send:
    """A message for one peer; `t_meas_ns` is the instant it speaks of."""

    peer: str
    t_meas_ns: int
    body: Body


@dataclass(frozen=True, slots=True, eq=False)
class Broadcast:
    """A message for everybody in reach."""

    channel: str
    t_meas_ns: int
    body: Body


@dataclass(frozen=True, slots=True, eq=False)
class TrackEstimate:
    """Belief of one target at the estimate's instant: mean (n,), cov (n, n) over a state of `model`.

    `learnt_ns`: when something was last learnt of it, by whoever saw it; None: not kept.
    """

    target: str
    model: str
    mean: Array
    cov: Array
    learnt_ns: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RelativeEstimate:
    """Where a peer is relative to the own body, as far as it is known by the instant `t_ns`.

    mean (4,)  x, y, z [m] in the own body frame (forward, left, up), and its heading less the own one; cov (4, 4) of it
    weight     probability of this hypothesis among all that are kept, `tracks` of them
    ambiguity  probability of the second one that is another place or heading; near `weight`, nobody can tell them apart
    confirmed  it has been as good as certain for a while
    """

    peer: str
    t_ns: int
    mean: Array
    cov: Array
    weight: float
    ambiguity: float
    tracks: int
    confirmed: bool


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Own belief at `t_ns`: mean (n,), cov (n, n) over a state of `model`; ENU, heading CCW from east.

    `relatives`: where others are relative to the own body, of who locates itself so.
    """

    t_ns: int
    model: str
    mean: Array
    cov: Array
    tracks: tuple[TrackEstimate, ...] = ()
    relatives: tuple[RelativeEstimate, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Named:
    """A measurement `z` of nobody knows whom, of a sensor at `t_meas_ns`, has been used as one of `peer`."""

    peer: str
    t_meas_ns: int
    sensor: str
    z: Array


@dataclass(frozen=True, slots=True, eq=False)
class Publish:
    """Something to show outside: the estimate with its tracks."""

    estimate: Estimate


@dataclass(frozen=True, slots=True)
class Alarm:
    """Something a person should know, named by `reason`; counted, and logged once per window."""

    reason: str
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Persist:
    """What the robot knows now, to be kept for its next start (`agent.saved_state`).

    `ahead`: messages that follow are of contacts, and a state older than they are must not be begun with again.
    """

    payload: bytes
    ahead: bool = False


@dataclass(frozen=True, slots=True)
class Steer:
    """How the vehicle is to move from now until `until_ns` (own clock), and to stand still from then on.

    velocity_mps  forward, left, up; body FLU
    yaw_rate_radps  counter-clockwise
    """

    velocity_mps: tuple[float, float, float]
    yaw_rate_radps: float
    until_ns: int


Effect = Send | Broadcast | Named | Publish | Alarm | Persist | Steer
