"""What a leader and its followers tell each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LeaderRequest:
    """A follower has measured its leader at the header's `t_meas_ns` and asks where it was then; its `number`."""

    number: int


@dataclass(frozen=True, slots=True, eq=False)
class LeaderReport:
    """Where a leader was at the header's `t_meas_ns`.

    place, cov  (2,) [m], ENU, and (2, 2)
    velocity    (2,) [m/s], ENU
    before_ns   the instant of its report before this one, as it told both to everybody; None: there was none
    answers     number of the request that it answers; None: it is told to everybody
    """

    place: Array
    cov: Array
    velocity: Array
    before_ns: int | None = None
    answers: int | None = None
