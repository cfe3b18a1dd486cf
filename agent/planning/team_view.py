"""What a team believes of its targets, as planners use it: beliefs that can be so, and where targets are and go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import is_positive_definite
from agent.planning.situation import Member, Situation, TargetView
from agent.plausible import FARTHEST

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Believer:
    """A member that believes something of a target: its place in the team (0: the robot itself), and its view."""

    member: int
    view: TargetView

    @property
    def place(self) -> Array:
        """Where the target is (2,) [m]."""
        return self.view.mean[:2]

    @property
    def velocity(self) -> Array:
        """Velocity (2,) [m/s] of the target: its known speed along its heading, or what the state says."""
        layout = self.view.motion.layout
        if layout.heading is None:
            begin = len(layout.position)
            return self.view.mean[begin : begin + 2]
        heading = float(self.view.mean[layout.heading])
        return self.view.motion.control[0] * np.array([math.cos(heading), math.sin(heading)])

    @property
    def certainty(self) -> float:
        """1 / tr P_T, what eq. 3.3 weighs beliefs by."""
        return 1.0 / float(self.view.cov.trace())


def usable(situation: Situation) -> Situation:
    """The situation without members and views whose numbers cannot be a belief; the robot's own pose is taken as it is.

    Left out is what is not finite, beyond `FARTHEST`, of another size than its model's state, or has a covariance that
    is not positive definite.
    """
    others = tuple(_with_usable_views(member) for member in situation.others if _is_usable(member))
    return replace(situation, own=_with_usable_views(situation.own), others=others)


def _is_usable(member: Member) -> bool:
    told = (member.speed_mps, member.yaw_rate_radps, member.age_s, member.altitude_m)
    return _is_belief(member.pose, member.cov, 3) and all(abs(number) <= FARTHEST for number in told)


def _with_usable_views(member: Member) -> Member:
    views = tuple(view for view in member.targets if _is_belief(view.mean, view.cov, view.motion.layout.dim))
    return member if len(views) == len(member.targets) else replace(member, targets=views)


def _is_belief(mean: Array, cov: Array, dim: int) -> bool:
    return (
        mean.shape == (dim,)
        and cov.shape == (dim, dim)
        and bool(np.abs(mean).max() <= FARTHEST)
        and is_positive_definite(cov)
    )


def believers(situation: Situation, present: bool) -> Mapping[str, tuple[Believer, ...]]:
    """Who believes what of each target, the robot itself first, targets in ascending order of ids.

    `present`: beliefs told some time ago are moved on to the present by the target's model; else they are as told.
    """
    found: dict[str, list[Believer]] = {}
    for index, member in enumerate((situation.own, *situation.others)):
        for view in member.targets:
            if present and member.age_s > 0.0:
                moved = view.motion.drift(view.mean, view.cov, member.age_s, "jacobian")
                view = replace(view, mean=moved.mean, cov=moved.cov)
            found.setdefault(view.target, []).append(Believer(index, view))
    return {target: tuple(found[target]) for target in sorted(found)}
