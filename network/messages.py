"""The messages robots exchange, as plain typed values.

`network.wire` turns them into bytes and back; nothing here knows how an estimate is made. All stamps are
integer nanoseconds of the *sender's* fleet clock unless a field says otherwise; all arrays are float64.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from network.bearing_messages import BearingReport
from network.leader_messages import LeaderReport, LeaderRequest
from network.life_messages import Hello, LifeNotice
from network.relative_messages import HypothesesReport, MotionReport

Array = NDArray[np.float64]

SCHEMA = 1
"""Version of the message layout; it is also part of every key (`cofix/v1/...`)."""

MAX_MESSAGE_BYTES = 1200
"""One message fits one datagram on a radio with a 1,280-byte MTU."""

MAX_LINES = 4
"""Unresolved identity lines a snapshot carries at most; a pair that would need an older one begins anew."""

MAX_STATE_DIM = 8
MAX_JOINT_DIM = 16
"""Components of a robot and its targets together in one belief."""

MAX_GROUP = 3
"""Robots whose correlation factors are exact enough; a belief with factors is told of no more."""

MAX_TARGETS = 8
MAX_MEASUREMENTS = 8

MAX_RECKONINGS = 4
MAX_RAW_MEASUREMENTS = 16
"""Of one report to a team; what does not fit goes in another one."""

Mount = tuple[float, float, float, float, float, float]
"""A sensor on a body: lever arm x, y, z [m, FLU], then roll, pitch, yaw [rad], turned in the order yaw, pitch, roll."""

NO_MOUNT: Mount = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Channel:
    """Names of the channels of a robot's key space."""

    HELLO = "hello"
    BELIEF = "belief"
    PAIR = "pair"
    STATUS = "status"
    ESTIMATE = "estimate"


@dataclass(frozen=True, slots=True)
class Header:
    """Who sent a message, in which life, and when.

    `seq` counts per channel and destination, so that the fate of a packet can be computed by its receiver.
    `t_meas_ns` is the instant the content refers to.
    """

    source: str
    boot_id: int
    incarnation: int
    seq: int
    t_meas_ns: int
    t_send_ns: int
    schema: int = SCHEMA


@dataclass(frozen=True, slots=True, order=True)
class Epoch:
    """Name of one contact of a pair; later contacts compare greater. The zero epoch means "never met"."""

    t_meas_ns: int = 0
    initiator: str = ""
    counter: int = 0

    @property
    def met(self) -> bool:
        return self != NEVER


NEVER = Epoch()


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """A Gaussian over a state of `model`: mean (n,), covariance (n, n)."""

    model: str
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class TargetBelief:
    """One robot's belief of one target; `age_ns`: how long ago something was last learnt of it, by whomever."""

    target: str
    belief: Belief
    age_ns: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """Accumulated left factors (n, n) of the sender's error since a contact not yet known to be applied.

    In a `JointSnapshot` the columns of common noise since then follow, (n, n + c), or are left out.
    """

    epoch: Epoch
    matrix: Array


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A robot at a contact's instant, before the contact's update.

    base   the last contact of the pair the sender applied
    factor (n, m) sigma for the pair, P_ab = sigma_a sigma_b^T; (n, 0) when never met
    line   (n, n) left factors accumulated since `base`
    lines  later contacts the sender opened and does not know the fate of, oldest first
    known  False when the correlation of the pair has been lost and zero may not be assumed
    """

    belief: Belief
    base: Epoch
    factor: Array
    line: Array
    lines: tuple[Line, ...] = ()
    targets: tuple[TargetBelief, ...] = ()
    known: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class JointSnapshot:
    """A robot and its targets as one belief with correlation factors, at a contact's instant and before its update.

    mean (n,), cov (n, n) over the robot's state followed by those of `targets` (id, model), in order: c components.
    Only what the correlation needs is told, the rest is None:

    base    the last contact of the pair the sender applied
    factor  (n, m) as in `Snapshot`
    line    (n, n) left factors since `base`
    noise   (n, c) covariance of the error with the targets' process noise since `base`, or since the start of a pair
            that never met, over `span_s` seconds: the white noise of each component, summed and scaled to unit variance
    prior   (n, c) columns of the targets' common prior, of a pair that never met
    lines   later contacts the sender opened and does not know the fate of, oldest first
    known   as in `Snapshot`
    anew    the pair began again from zero correlation: prior and noise from before do not count
    group   robots whose errors may be correlated with the sender's through any chain of contacts, and the sender; None
            if the sender does not count them
    """

    model: str
    targets: tuple[tuple[str, str], ...]
    mean: Array
    cov: Array
    base: Epoch
    factor: Array | None = None
    line: Array | None = None
    noise: Array | None = None
    prior: Array | None = None
    span_s: float = 0.0
    lines: tuple[Line, ...] = ()
    known: bool = True
    anew: bool = False
    group: frozenset[str] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """A relative measurement of the receiver by the sender: z (m,), covariance R (m, m).

    `mount` is the sensor on the sender's body, as if that were level at the instant. Of a `pixel`, z and R are on the
    image plane at unit distance from the optical axis.
    """

    kind: str
    z: Array
    R: Array
    mount: Mount = NO_MOUNT


class ReplyStatus(IntEnum):
    """Answer to a pair request. Everything but OK leaves the requester's estimate untouched."""

    OK = 0
    TOO_OLD = 1
    BUSY = 2
    SUPERSEDED = 3
    OTHER_FORM = 4
    INCONSISTENT = 5


@dataclass(frozen=True, slots=True, eq=False)
class PairRequest:
    """Opens a contact: what was measured at `epoch.t_meas_ns`, and the initiator at that instant."""

    epoch: Epoch
    measurements: tuple[Measurement, ...]
    snapshot: Snapshot | JointSnapshot


@dataclass(frozen=True, slots=True, eq=False)
class PairReply:
    """Answers a contact with the peer's snapshot at the same instant (None unless the status is OK)."""

    epoch: Epoch
    status: ReplyStatus
    snapshot: Snapshot | JointSnapshot | None = None


@dataclass(frozen=True, slots=True)
class StartRequest:
    """Asks a peer for its belief at `epoch.t_meas_ns`, when a robot that does not know where it is has measured it.

    The answer is a reply of the peer's form.
    """

    epoch: Epoch


@dataclass(frozen=True, slots=True, eq=False)
class SplitSnapshot:
    """A robot and targets as one belief whose error covariance is split, before a contact's update.

    mean (n,), cov (n, n) over the robot's state followed by those of `targets` (id, model), in order; private (n, n) is
    the part of cov that stems from noise nobody else holds, None if there is none. `ages_ns`: how long ago something
    was last learnt of each target, by whomever. `relayed`: targets the robot only knows of from others, correlated in
    unknown ways.
    """

    model: str
    targets: tuple[tuple[str, str], ...]
    mean: Array
    cov: Array
    private: Array | None = None
    ages_ns: tuple[int, ...] = ()
    relayed: tuple[TargetBelief, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SplitRequest:
    """A `PairRequest` between robots that keep no correlation factors."""

    epoch: Epoch
    measurements: tuple[Measurement, ...]
    snapshot: SplitSnapshot


@dataclass(frozen=True, slots=True, eq=False)
class SplitReply:
    """Answers a `SplitRequest` with the peer's snapshot at the same instant."""

    epoch: Epoch
    snapshot: SplitSnapshot


@dataclass(frozen=True, slots=True, eq=False)
class Reckoning:
    """A robot's odometry from `anchor_ns` to `t_ns` as one increment; its last part began at `before_ns`.

    delta (4,) is dx, dy, dz, dyaw (not wrapped) in the body frame at the anchor, cov (4, 4) its covariance, positive
    semi-definite. Two of one anchor tell the odometry between them, whatever was lost in between.
    """

    anchor_ns: int
    before_ns: int
    t_ns: int
    delta: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class RawMeasurement:
    """What a robot's sensor measured at `t_ns`: z (m,), covariance R (m, m).

    `index` tells apart what the robot measured at one instant. `of` is a robot, `target:ID` or `landmark:ID`, and None
    of what concerns the robot alone. `mount` as of a `Measurement`.
    """

    t_ns: int
    index: int
    of: str | None
    kind: str
    z: Array
    R: Array
    mount: Mount = NO_MOUNT


@dataclass(frozen=True, slots=True, eq=False)
class TeamReport:
    """Raw data of one robot for its whole team, which hears the newest and those of the instant before.

    `born_ns` is the instant the robot's present life began; reckonings ascend in time.
    """

    born_ns: int
    reckonings: tuple[Reckoning, ...]
    measurements: tuple[RawMeasurement, ...] = ()


class RoundStage(IntEnum):
    """What a `RoundReport` tells of: before the corrections of its instant, or after them."""

    PRIOR = 0
    POSTERIOR = 1


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Where a target is by the sensors of one robot alone: place (d,) in ENU, d = 2 or 3.

    Its error has two independent parts: `sensor` (d, d), the covariance of what stems from the sensor's noise, which is
    new at each instant, and `pose` (d, d), of what stems from the error of the robot's own pose.
    """

    target: str
    place: Array
    sensor: Array
    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class RoundReport:
    """What one robot tells everybody in reach once per round, at the header's `t_meas_ns` (Su 2022, table 3.1).

    belief       of its own pose
    velocity     (3,) last commanded or measured velocity [m/s], body FLU
    yaw_rate     last commanded or measured yaw rate [rad/s]
    targets      what it believes of targets, each with its age
    corrections  of the stage `PRIOR`: what its sensors have told of targets since the round before
    """

    stage: RoundStage
    belief: Belief
    velocity: Array
    yaw_rate: float
    targets: tuple[TargetBelief, ...] = ()
    corrections: tuple[Correction, ...] = ()


Body = (
    Hello
    | LifeNotice
    | PairRequest
    | PairReply
    | SplitRequest
    | SplitReply
    | StartRequest
    | TeamReport
    | RoundReport
    | BearingReport
    | LeaderRequest
    | LeaderReport
    | MotionReport
    | HypothesesReport
)


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A decoded message."""

    header: Header
    body: Body


@dataclass(frozen=True, slots=True)
class Packet:
    """Bytes on a channel. `destination` is None for a broadcast."""

    source: str
    channel: str
    destination: str | None
    payload: bytes
