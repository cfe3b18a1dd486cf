"""What the core needs to know, as plain frozen values; `agent.config` reads them from a file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation.correspondence import CorrespondenceSettings
from agent.estimation.intersection import Weight
from agent.estimation.motion import PLANAR_MOTION, RobotMotion, StateLayout, TargetMotion
from agent.estimation.unscented import DEFAULT, Transform, UnscentedParameters

Array = NDArray[np.float64]

NS = 1_000_000_000

RoundWeights = Literal["split_ci", "trace", "logdet", "info", "pinv_guard"]
"""How information that may be correlated is weighed: see `agent.estimation.jlatt`."""


LatenessKind = Literal["compensate", "replay", "discard", "algorithm1", "equivalent", "ignore"]
"""What happens to data that come late."""


def nanoseconds(seconds: float) -> int:
    """Seconds as integer nanoseconds, rounded to the nearest."""
    return round(seconds * NS)


@dataclass(frozen=True, slots=True)
class LocalizationSettings:
    """Cooperative localization: `clat`, by contacts of pairs; `replica`, by raw data told to the whole team;
    `jlatt`, by rounds in which neighbours tell their beliefs; `leader`, by a leader that tells where it was; `fixed`,
    not at all: the pose is what fixes say; `relative`, as `fixed`, and others are located relative to the own body
    (`RelativeSettings`).

    leader, exchange  who leads, and whether it tells everybody once per round, or who asks
    fixes             of the leader: they are `fused`, or `trusted` as by the kind `fixed`
    leader_correlation_ns  the time in which the error of what the leader tells becomes another one; 0: each is new
    clock_state       the remaining offset of the leader's clock is a state
    weights                           how `jlatt` weighs what may be correlated
    sighting_weight / fusion_weight   how intersections choose their weight
    pair_interval_ns                  least time between two contacts of a pair that are used
    pair_timeout_ns                   a request unanswered for this long is forgotten
    innovation_cap                    NIS per degree of freedom beyond which S is inflated (0: never)
    max_lines                         identity lines kept per peer
    """

    kind: Literal["clat", "replica", "jlatt", "leader", "relative", "fixed"] = "clat"
    form: Literal["auto", "split_joint", "safe", "published", "joint"] = "auto"
    leader: str = ""
    exchange: Literal["broadcast", "request"] = "broadcast"
    fixes: Literal["fused", "trusted"] = "fused"
    leader_correlation_ns: int = 0
    clock_state: bool = False
    transform: Transform = "unscented"
    correlation: Literal["factors", "ignored"] = "factors"
    sighting_weight: Weight = "trace"
    fusion_weight: Weight = "fast"
    pair_interval_ns: int = 3 * NS
    pair_timeout_ns: int = 2 * NS
    innovation_cap: float = 0.0
    max_lines: int = 24
    restart_interval_ns: int = 60 * NS
    weights: RoundWeights = "split_ci"
    parameters: UnscentedParameters = DEFAULT


@dataclass(frozen=True, slots=True)
class RoundSettings:
    """When robots tell each other what an instant brought: at whole multiples of `period_ns` since `anchor_ns`.

    wait_ns  a round ends when all neighbours have told, or this long after its instant
    lean     one message per round: plans are made of what is told before the corrections
    """

    period_ns: int = NS
    anchor_ns: int = 0
    wait_ns: int = NS // 5
    lean: bool = False


@dataclass(frozen=True, slots=True)
class SensingSettings:
    """What a planner knows of the sensor that sees targets and peers: a range and bearing within its field of view."""

    min_range_m: float = 2.0
    max_range_m: float = 15.0
    fov_rad: float = math.pi / 3.0
    sigma_m: float = 0.0
    sigma_m_per_m: float = 0.03
    sigma_rad: float = math.pi / 180.0


@dataclass(frozen=True, slots=True)
class PlanningSettings:
    """How a robot chooses its motion (Su 2022, chapter 3; `agent.planning`).

    kind             `none`: it does not; `random`; `potential` (AJLATT-C); `optimal` (AJLATT-O); `encircle`, of robots
                     that fly (STT 2023, section 7)
    form             of `potential` and `optimal`: `improved`, or as `published`
    max_speed_mps, max_turn_radps  what the vehicle can do; on the ground it never drives backwards
    max_climb_mps    the same of one that flies, up and down
    radius_m         of the circle on which `encircle` keeps robots above the target
    speed_share, heading_rad_per_m  deviations of the odometry, as a share of the way and in heading per metre
    closest_m, apart_m  robots and the target push each other off below `apart_m`, and hardest at `closest_m`
    radio_range_m    neighbours are in reach within this distance
    self_weight, target_weight  alpha_R and alpha_T of eq. 3.7: how much own and target's uncertainty cost
    potential_weight  beta of eq. 3.7
    ahead, horizon   t1 and t2 of eq. 3.7, in rounds
    candidates       most commands that `optimal` evaluates per round
    weights          the rule of the corrections that `optimal` predicts
    seed             of the kind `random`
    overrun_ns       a plan that takes longer took too long
    """

    kind: Literal["none", "random", "potential", "optimal", "encircle"] = "none"
    form: Literal["improved", "published"] = "improved"
    max_speed_mps: float = 0.5
    max_turn_radps: float = math.pi / 5.0
    max_climb_mps: float = 0.5
    radius_m: float = 10.0
    speed_share: float = 0.0070710678118654755
    heading_rad_per_m: float = 0.0282842712474619
    closest_m: float = 6.0
    apart_m: float = 10.0
    radio_range_m: float = 30.0
    self_weight: float = 0.2
    target_weight: float = 1.0
    potential_weight: float = 1.0
    ahead: int = 4
    horizon: int = 11
    candidates: int = 61
    weights: RoundWeights = "split_ci"
    sensing: SensingSettings = SensingSettings()
    seed: int = 0
    overrun_ns: int = NS // 2


@dataclass(frozen=True, slots=True)
class LatenessSettings:
    """When data are fused and what happens to those that come late.

    kind               late own data: `compensate`, by a delayed update; `replay`, in their place by a bounded rewind as
                       far back as the last contact; `discard`. Of the kind `leader` also `algorithm1`, `equivalent`
                       and `ignore`, and `compensate` is what is published; see `agent.late_words`
    then               the kind from so long [ns] after the start on
    iterations         passes of an update by the leader
    settle_ns          an instant is processed once it is this old, so that all its data are in
    tolerance_ns       stamps this close to a state instant count as that instant
    horizon_ns         how far the history reaches back
    odometry_wait_ns   how long data wait for odometry to cover them before the robot coasts to them
    clock_sigma_ns     how well the fleet's clocks agree by themselves (1 sigma); 0: one clock for all.
                       Measured offsets are blended with this prior.
    """

    kind: LatenessKind = "compensate"
    then: tuple[int, LatenessKind] | None = None
    iterations: int = 2
    settle_ns: int = 0
    tolerance_ns: int = 1_000_000
    horizon_ns: int = 5 * NS
    odometry_wait_ns: int = NS
    clock_sigma_ns: int = 0

    @property
    def kinds(self) -> tuple[str, ...]:
        """All kinds that are ever on."""
        return (self.kind,) if self.then is None else (self.kind, self.then[1])

    def kind_at(self, age_ns: int) -> str:
        """The kind that is on so long after the start."""
        return self.kind if self.then is None or age_ns < self.then[0] else self.then[1]


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """When a peer's contacts are no longer used, and when they are again; see `agent.health`.

    window         contacts that are looked at
    suspect_nis    mean normalized innovation squared per degree of freedom at which a peer is quarantined
    gate_nis       a single contact beyond it is not used, and counts as much
    readmit_after  consistent contacts in a row after which a peer is re-admitted
    """

    enabled: bool = True
    window: int = 8
    suspect_nis: float = 6.0
    gate_nis: float = 12.0
    readmit_after: int = 8


@dataclass(frozen=True, slots=True)
class UnsafeSettings:
    """Protections that are switched off, each by its own switch; for demonstrations.

    ignore_correlation   peers' errors count as independent of the own one: the same information is used again and again
    ignore_gaps          a robot whose odometry is silent, or that was down, has not moved
    trust_liars          no contact is refused for its innovation, and nobody quarantined
    trust_clocks         peers' clocks count as right, whatever is measured of them
    accept_duplicates    packets are taken as often as they arrive, and without factors contacts are used as often
    accept_stale         messages of any age are taken; of what the past no longer reaches back to, as if of now
    use_late_as_new      peers' measurements are used as if made when they arrive
    trust_restarts       who begins anew, or has lost a correlation, counts as independent; no covariance is doubled
    send_before_saving   messages of contacts do not wait for the state file that they rely on
    """

    ignore_correlation: bool = False
    ignore_gaps: bool = False
    trust_liars: bool = False
    trust_clocks: bool = False
    accept_duplicates: bool = False
    accept_stale: bool = False
    use_late_as_new: bool = False
    trust_restarts: bool = False
    send_before_saving: bool = False

    def named(self) -> list[str]:
        """The switches that are on."""
        return [item.name for item in fields(self) if getattr(self, item.name)]


@dataclass(frozen=True, slots=True)
class CoastSettings:
    """What the robot may do while its odometry is silent: unknown constant speed and yaw rate (1 sigma)."""

    speed_mps: float = 0.5
    yaw_rate_radps: float = 0.5


@dataclass(frozen=True, slots=True)
class TrackingSettings:
    """How targets are tracked: `own`, by the robot's own filter; else by bearings that robots tell each other once per
    round (`agent.triangulator`).

    memory_s      time in which what is known fades to 1 / e, of the kind `stt`; None: as published
    parallax_rad  a place is told once bearings cross by so much, and more than noise may make them seem to; 0: at once
    """

    kind: Literal["own", "stt", "cmkf", "cikf", "hcmci", "tkf", "kcf_plus", "icf_plus"] = "own"
    memory_s: float | None = None
    parallax_rad: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class TargetSettings:
    """A target all robots know of: its model, and the common prior at the start, mean (n,) and cov (n, n).

    Without a mean nobody knows where it is, and a sighting or a peer starts its track: `cov` is then of what a sighting
    does not tell, velocity or heading, which are 0 as far as is known, and an altitude about `altitude_m`.
    """

    id: str
    motion: TargetMotion
    mean: Array | None
    cov: Array
    altitude_m: float = 0.0


@dataclass(frozen=True, slots=True)
class RelativeSettings:
    """How a robot of the kind `relative` locates others relative to its own body.

    peers              the others; nobody else counts
    leads              it has a camera that sees others, and finds out where they are; else it only tells how it moves
    known              the camera knows whom it sees; else it does not, and `correspondence` says how that is found out
    acceleration_mps2, turn_acceleration_radps2  how the velocity of a peer that is not heard may change (1 sigma)
    """

    peers: tuple[str, ...] = ()
    leads: bool = False
    known: bool = False
    correspondence: CorrespondenceSettings = field(default_factory=CorrespondenceSettings)
    acceleration_mps2: float = 1.0
    turn_acceleration_radps2: float = 1.0


@dataclass(frozen=True, slots=True)
class TrackEnd:
    """When a track ends: nothing learnt for `after_ns`, or a position deviation above `above_m`; None: never."""

    after_ns: int | None = None
    above_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TeamMember:
    """Another robot of a team whose members keep the joint belief of all: how it moves, and its belief at its start."""

    id: str
    motion: RobotMotion
    mean: Array
    cov: Array


@dataclass(frozen=True, slots=True, eq=False)
class AgentSettings:
    """Everything the core is given at its start.

    source           where the initial belief comes from: `survey`, mean and cov as they are; `fix`, absolute
                     information of place and heading; `peer`, a contact with a peer that knows its own pose. Of mean
                     and cov only what neither tells, the gains of an odometry, counts then
    shared           the part (n, n) of cov that stems from errors which peers may hold too; None: nothing of it
    found_out        the robot has found out where it is, and starts later than the others
    persist_ns       what is known is kept for the next start so often, at most
    track_within_m   how far off a target can be that is seen by a bearing or a range alone; None: such a sighting
                     starts no track
    """

    robot: str
    start_ns: int
    mean: Array
    cov: Array
    motion: RobotMotion = PLANAR_MOTION
    targets: tuple[TargetSettings, ...] = ()
    landmarks: dict[str, tuple[float, ...]] = field(default_factory=dict)
    one_way_sensors: tuple[str, ...] = ()
    localization: LocalizationSettings = field(default_factory=LocalizationSettings)
    lateness: LatenessSettings = field(default_factory=LatenessSettings)
    coast: CoastSettings = field(default_factory=CoastSettings)
    health: HealthSettings = HealthSettings()
    round: RoundSettings = RoundSettings()
    planning: PlanningSettings = PlanningSettings()
    unsafe: UnsafeSettings = UnsafeSettings()
    track: bool = True
    tracking: TrackingSettings = TrackingSettings()
    relative: RelativeSettings = RelativeSettings()
    team: tuple[TeamMember, ...] = ()
    track_end: TrackEnd = TrackEnd()
    track_within_m: float | None = None
    source: Literal["survey", "fix", "peer"] = "survey"
    shared: Array | None = None
    found_out: bool = False
    persist_ns: int = NS

    @property
    def layout(self) -> StateLayout:
        return self.motion.layout

    @property
    def tracked(self) -> tuple[TargetSettings, ...]:
        """The targets there may be tracks of."""
        return self.targets if self.track else ()
