"""Which bearing is of whom, and where everybody is: what one leader believes of all robots around it.

Leaders measure ranges and heights of known robots and bearings of nobody knows whom. Of each other robot a leader keeps
a sum of Gaussians, one per history of associations (De Silva, Mann, Gosine 2015). The state of robot j relative to i
is x = (x, y, z, th) (4,), m and rad: its place in the body frame of i (FLU), and its heading less that of i.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Form = Literal["improved", "published"]


@dataclass(frozen=True, slots=True, eq=False)
class BodyMotion:
    """How a robot moves over one step, as it measured: velocity (4,) is vx, vy, vz [m/s] in its body frame (FLU) and
    yaw rate [rad/s]; cov (4, 4) of it."""

    velocity: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What a leader sensed at one instant, all in its body frame.

    bearings (m, 2)     azimuth and elevation [rad], of nobody knows whom
    bearing_cov (2, 2)  of each [rad^2]
    ranges              peer -> range [m] and variance [m^2]; a missing key is a missed range
    heights             peer -> height of the peer above the own [m] and variance [m^2]
    """

    bearings: Array
    bearing_cov: Array
    ranges: Mapping[str, tuple[float, float]]
    heights: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """What is told of one target: best first, at most five.

    weights (k,), means (k, 4), covs (k, 4, 4); where fusion subtracts what was told before also priors (k, 4), prior_covs
    (k, 4, 4), which are those of the last fusion moved to the present, and prior_known (k,), False of younger tracks.
    """

    weights: Array
    means: Array
    covs: Array
    priors: Array | None = None
    prior_covs: Array | None = None
    prior_known: Mask | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Dominant:
    """The hypothesis that is believed: mean (4,), cov (4, 4), its weight, `ambiguity`, the weight of the second distinct
    mode, the number of tracks, and whether it has been as good as certain for a while."""

    mean: Array
    cov: Array
    weight: float
    ambiguity: float
    tracks: int
    confirmed: bool


@dataclass(frozen=True, slots=True)
class CorrespondenceSettings:
    """How a leader tells robots apart.

    detection   probability that a robot in view is seen, P_D
    clutter     expected false bearings per scan
    birth       probability of a new track, P_B; None: of the form
    gate        probability that a right measurement is inside a gate, P_G; None: of the form
    view_rad2   solid angle of the view, azimuth times elevation [rad^2]
    fusion      of what other leaders tell; None: of the form
    """

    kind: Literal["gaussian_sum", "nearest"] = "gaussian_sum"
    form: Form = "improved"
    detection: float = 0.95
    clutter: float = 1.0
    birth: float | None = None
    gate: float | None = None
    view_rad2: float = 2.0 * math.pi * 0.5 * math.pi
    fusion: Literal["intersection", "subtraction"] | None = None


class Correspondence:
    """All sums of one leader, `robot`, of the robots `peers`."""

    def __init__(self, settings: CorrespondenceSettings, peers: Sequence[str], robot: str) -> None:
        self.settings = settings
        self.robot = robot
        self.peers = tuple(peers)

    def advance(self, own: BodyMotion, peers: Mapping[str, BodyMotion], dt_s: float) -> None:
        """All sums dt_s later. Every peer's motion must be there: of one that was not heard, a guess with its doubt."""

    def scan(self, scan: Scan, labels: Mapping[str, int] | None = None) -> None:
        """Direct fusion of one scan; peers that nothing was measured of are untouched.

        labels: where identities are known, peer -> index into the bearings; a missing peer was not seen.
        """

    def told(self, peer: str) -> Hypotheses:
        """What the others are told of `peer`; changes nothing."""
        return Hypotheses(np.empty(0), np.empty((0, 4)), np.empty((0, 4, 4)))

    def fuse(self, leader: str, told: Mapping[str, Hypotheses]) -> None:
        """What `leader` told, in its own frame and carried to the present: mutual fusion of what it says of this robot,
        indirect fusion of the rest."""

    def fused(self) -> None:
        """The end of a round of fusion: what is believed now is what the next round subtracts."""

    def dominant(self, peer: str) -> Dominant | None:
        """The hypothesis of `peer` that is believed, None before there is any."""
        return None


def carry(
    told: Hypotheses, of: BodyMotion, peer: BodyMotion, dt_s: float, form: Form = "improved"
) -> Hypotheses:
    """What the leader that moves as `of` told of the robot that moves as `peer`, dt_s later."""
    return told
