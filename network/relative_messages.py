"""Messages of robots that find out where the others are relative to themselves: how one moved, and what one believes.

As all messages these are plain values; see `network.messages`. Frames are those of bodies: forward, left, up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_HYPOTHESES = 5
"""Told of one robot."""

MAX_SUBJECTS = 15
"""Robots that one report tells of."""

MAX_PARTS = 16
"""Messages that one report may be told in."""


@dataclass(frozen=True, slots=True)
class Height:
    """The altitude [m] of a robot above the fleet's origin, its variance [m^2], and the time from its measurement to
    the report's instant."""

    altitude_m: float
    variance_m2: float
    age_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class MotionReport:
    """How a robot moved over the `span_ns` that end at the header's `t_meas_ns`, told to everybody in reach.

    velocity (4,)  forward, left, up [m/s] and yaw rate [rad/s], mean over the span, in the body frame at its beginning
    cov (4, 4)     of its error, which is another one in each report
    height         None: not measured in this span
    """

    span_ns: int
    velocity: Array
    cov: Array
    height: Height | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SubjectReport:
    """What a robot believes of where another one is: a sum of Gaussians, best first, in the own body frame.

    A state is x, y, z [m] of `subject`, and its heading less the own one [rad].

    weights (k,), means (k, 4), covs (k, 4, 4)
    priors (k, 4), prior_covs (k, 4, 4)  the same before what was learnt since the last round, if that is told
    prior_known (k,)                     False of a hypothesis that is younger than that round
    """

    subject: str
    weights: Array
    means: Array
    covs: Array
    priors: Array | None = None
    prior_covs: Array | None = None
    prior_known: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class HypothesesReport:
    """What a robot believes of all others at the header's `t_meas_ns`, as part number `part` of `parts`.

    `since_ns`: the instant of the round before, on the sender's clock, which priors are of; 0: there was none.
    """

    since_ns: int
    part: int
    parts: int
    subjects: tuple[SubjectReport, ...]
