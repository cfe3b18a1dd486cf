"""What a planner is told, and what it answers. Planners see beliefs, never truth.

Robots on the ground lie in the plane; of who flies the altitude is known too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import TargetMotion

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TargetView:
    """One robot's belief of one target: mean (n,), cov (n, n) over the state of `motion`."""

    target: str
    motion: TargetMotion
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """A robot of the team: pose (3,) x, y, heading with cov (3, 3), last known command, what it believes of targets.

    `age_s`: how old all of this is. The own one is of the present. `altitude_m` is 0 of who lies in the plane.
    `silent`: it was heard there last, and is no longer counted on.
    """

    robot: str
    pose: Array
    cov: Array
    speed_mps: float
    yaw_rate_radps: float
    targets: tuple[TargetView, ...] = ()
    age_s: float = 0.0
    altitude_m: float = 0.0
    silent: bool = False

    @property
    def place(self) -> Array:
        """x, y, z (3,) [m]."""
        return np.array([self.pose[0], self.pose[1], self.altitude_m])


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """A moment of choice: the `index`-th since the start, held for `dt_s`; `others` in ascending order of ids."""

    index: int
    dt_s: float
    own: Member
    others: tuple[Member, ...] = ()


@dataclass(frozen=True, slots=True)
class Command:
    """Forward speed and yaw rate, held until the next choice; of who flies also the speeds to the left and up."""

    speed_mps: float
    yaw_rate_radps: float
    left_mps: float = 0.0
    up_mps: float = 0.0


class Planner(Protocol):
    """Chooses a robot's motion; equal situations give equal commands."""

    def command(self, situation: Situation) -> Command:
        """Never raises on what peers have told; without a target it keeps clear of others."""
        ...
