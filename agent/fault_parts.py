"""Faults as they are written in files: `[[faults]]` of a scenario, and of an agent's `[injection]`.

One schedule for links, sensors, clocks and processes. `at_s` counts from the start of the run; without `for_s` a fault
lasts to the end.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, TypeAdapter, ValidationError

from agent.clock_faults import ClockFault
from agent.config_file import ConfigError, Finite, Id, NotNegative, Part, Positive, Share
from agent.settings import nanoseconds
from network.faults import FOREVER_NS, LinkFault, Links
from network.forgery import Forgery

Ids = Annotated[list[Id], Field(min_length=1)]


class TimedPart(Part):
    """When; `id` names it, by default its kind and number."""

    id: Annotated[str, Field(pattern=r"^[a-z0-9_-]{1,40}$")] | None = None
    at_s: NotNegative = 0.0
    for_s: Positive | None = None

    level: ClassVar[Literal["link", "forgery", "sensor", "clock", "process"]]

    def span_ns(self, start_ns: int = 0) -> tuple[int, int]:
        """Begin and end, the run starting at `start_ns`."""
        begin = start_ns + nanoseconds(self.at_s)
        return begin, FOREVER_NS if self.for_s is None else begin + nanoseconds(self.for_s)

    def names(self) -> list[str]:
        """Robots that are named."""
        return []


# -- links --------------------------------------------------------------------------------------------------


class LinkFaultPart(TimedPart, ABC):
    """Which links: from `sources` to `destinations` (absent: everybody), and back unless `both_ways = false`."""

    sources: Ids | None = None
    destinations: Ids | None = None
    both_ways: bool = True

    level = "link"

    def names(self) -> list[str]:
        return [*(self.sources or []), *(self.destinations or [])]

    def links(self) -> Links:
        return Links(_ids(self.sources), _ids(self.destinations), self.both_ways)

    def fault(self, name: str, start_ns: int = 0) -> LinkFault:
        """The fault under a name, the run starting at `start_ns`."""
        begin, end = self.span_ns(start_ns)
        return LinkFault(name, begin, end, self.links(), **self.suffered())

    @abstractmethod
    def suffered(self) -> dict[str, Any]:
        """What is wrong, as keywords of `LinkFault`."""


class PartitionPart(LinkFaultPart):
    """No packet between robots of different `groups`, or on the links named."""

    kind: Literal["partition"]
    groups: list[Ids] = []

    def names(self) -> list[str]:
        return [*super().names(), *(name for group in self.groups for name in group)]

    def links(self) -> Links:
        return Links(groups=tuple(frozenset(group) for group in self.groups)) if self.groups else super().links()

    def suffered(self) -> dict[str, Any]:
        return {"cut": True}


class IsolatePart(TimedPart):
    """No packet to or from a robot."""

    kind: Literal["isolate"]
    robot: Id

    level = "link"

    def names(self) -> list[str]:
        return [self.robot]

    def fault(self, name: str, start_ns: int = 0) -> LinkFault:
        """The fault under a name, the run starting at `start_ns`."""
        begin, end = self.span_ns(start_ns)
        return LinkFault(name, begin, end, Links(frozenset({self.robot})), cut=True)


class LossPart(LinkFaultPart):
    """Packets are lost, each with probability `share`."""

    kind: Literal["loss"]
    share: Share

    def suffered(self) -> dict[str, Any]:
        return {"loss": self.share}


class BurstLossPart(LinkFaultPart):
    """Packets are lost with probability `share` in bad spells of mean `bad_s` between good ones of mean `good_s`."""

    kind: Literal["burst_loss"]
    share: Share = 1.0
    good_s: Positive
    bad_s: Positive

    def suffered(self) -> dict[str, Any]:
        return {"burst_loss": self.share, "good_ns": nanoseconds(self.good_s), "bad_ns": nanoseconds(self.bad_s)}


class DelayPart(LinkFaultPart):
    """Packets are late by `delay_s` and an exponential time of mean `tail_s`, which reorders them."""

    kind: Literal["delay"]
    delay_s: NotNegative = 0.0
    tail_s: NotNegative = 0.0

    def suffered(self) -> dict[str, Any]:
        return {"delay_ns": nanoseconds(self.delay_s), "delay_tail_ns": nanoseconds(self.tail_s)}


class DuplicatePart(LinkFaultPart):
    """Packets arrive twice with probability `share`, the second time up to `within_s` after the first."""

    kind: Literal["duplicate"]
    share: Share
    within_s: NotNegative = 0.0

    def suffered(self) -> dict[str, Any]:
        return {"duplicate": self.share, "again_ns": nanoseconds(self.within_s)}


class ClogPart(LinkFaultPart):
    """Packets are held back, and all arrive when the clog ends; it needs `for_s`."""

    kind: Literal["clog"]
    for_s: Positive

    def suffered(self) -> dict[str, Any]:
        return {"clog": True}


class RateCapPart(LinkFaultPart):
    """A link carries so many bytes per second; packets that would wait for longer than `queue_s` are lost."""

    kind: Literal["rate_cap"]
    bytes_per_s: Positive
    queue_s: NotNegative = 1.0

    def suffered(self) -> dict[str, Any]:
        return {"bytes_per_s": self.bytes_per_s, "queue_ns": nanoseconds(self.queue_s)}


class CorruptPart(LinkFaultPart):
    """Bytes of packets are changed on the way, with probability `share`."""

    kind: Literal["corrupt"]
    share: Share

    def suffered(self) -> dict[str, Any]:
        return {"corrupt": self.share}


class ForgePart(TimedPart):
    """A stranger sends under the name `claims` to `destinations` (absent: everybody else); see `network.forgery`."""

    kind: Literal["forge"]
    claims: Id
    destinations: Ids | None = None
    rate_hz: Positive = 10.0
    content: Literal["damaged", "hostile", "replayed", "stranger"] = "damaged"

    level = "forgery"

    def names(self) -> list[str]:
        return list(self.destinations or [])

    def forgery(self, name: str, start_ns: int = 0) -> Forgery:
        """The forgery under a name, the run starting at `start_ns`."""
        begin, end = self.span_ns(start_ns)
        period = nanoseconds(1.0 / self.rate_hz)
        return Forgery(name, begin, end, self.claims, _ids(self.destinations), period, self.content)


# -- sensors and clocks -------------------------------------------------------------------------------------


class SensorFaultPart(TimedPart):
    """Which data: of a robot's `sensor` (absent: all), of the subject `of` (`r2`, `landmark:L3`; absent: all)."""

    robot: Id
    sensor: str | None = None
    of: str | None = None

    level = "sensor"

    def names(self) -> list[str]:
        return [self.robot]


class DropoutPart(SensorFaultPart):
    """The sensor is silent, or loses a `share` of its data."""

    kind: Literal["sensor_dropout"]
    share: Share = 1.0


class OutliersPart(SensorFaultPart):
    """A `share` of the data is off by up to `sigmas` times the stated standard deviation, evenly drawn."""

    kind: Literal["sensor_outliers"]
    share: Share
    sigmas: Positive = 30.0


class BiasPart(SensorFaultPart):
    """The first number of each datum, a range or bearing for instance, is too large by `bias`."""

    kind: Literal["sensor_bias"]
    bias: Finite


class SensorDelayPart(SensorFaultPart):
    """The data reach the robot late by `delay_s` and an exponential time of mean `tail_s`, which reorders them."""

    kind: Literal["sensor_delay"]
    delay_s: NotNegative = 0.0
    tail_s: NotNegative = 0.0


class SilencePart(TimedPart):
    """A robot's autopilot is silent: no odometry, no fix of its own."""

    kind: Literal["autopilot_silence"]
    robot: Id

    level = "sensor"

    def names(self) -> list[str]:
        return [self.robot]


class ClockStepPart(TimedPart):
    """A robot's clock is ahead by `offset_s`."""

    kind: Literal["clock_step"]
    robot: Id
    offset_s: Finite

    level = "clock"

    def names(self) -> list[str]:
        return [self.robot]

    def clock(self, start_ns: int = 0) -> ClockFault:
        """The fault, the run starting at `start_ns`."""
        return ClockFault(*self.span_ns(start_ns), step_ns=nanoseconds(self.offset_s))


class ClockDriftPart(TimedPart):
    """A robot's clock gains `ppm` microseconds per second; what it has gained stays."""

    kind: Literal["clock_drift"]
    robot: Id
    ppm: Annotated[float, Field(ge=-100_000.0, le=100_000.0)]

    level = "clock"

    def names(self) -> list[str]:
        return [self.robot]

    def clock(self, start_ns: int = 0) -> ClockFault:
        """The fault, the run starting at `start_ns`."""
        return ClockFault(*self.span_ns(start_ns), rate=self.ppm * 1e-6)


# -- processes ----------------------------------------------------------------------------------------------


class CrashPart(TimedPart):
    """A robot's agent is killed, and starts again after `for_s` (absent: never), with its state file or without."""

    kind: Literal["crash"]
    robot: Id
    state: Literal["kept", "lost"] = "kept"

    level = "process"

    def names(self) -> list[str]:
        return [self.robot]


class RestartPart(TimedPart):
    """A robot's agent is stopped in good order, and starts again after `for_s` (absent: at once)."""

    kind: Literal["restart"]
    robot: Id

    level = "process"

    def names(self) -> list[str]:
        return [self.robot]


class PausePart(TimedPart):
    """A robot's agent does nothing for `for_s`, and then all that its sockets have kept."""

    kind: Literal["pause"]
    robot: Id
    for_s: Positive

    level = "process"

    def names(self) -> list[str]:
        return [self.robot]


AnyLinkFaultPart = (
    PartitionPart
    | IsolatePart
    | LossPart
    | BurstLossPart
    | DelayPart
    | DuplicatePart
    | ClogPart
    | RateCapPart
    | CorruptPart
)
AnyClockFaultPart = ClockStepPart | ClockDriftPart
AnySensorFaultPart = DropoutPart | OutliersPart | BiasPart | SensorDelayPart | SilencePart
AnyProcessFaultPart = CrashPart | RestartPart | PausePart
AnyFaultPart = AnyLinkFaultPart | ForgePart | AnySensorFaultPart | AnyClockFaultPart | AnyProcessFaultPart
FaultPart = Annotated[AnyFaultPart, Field(discriminator="kind")]

FAULT_KINDS = tuple(get_args(part.model_fields["kind"].annotation)[0] for part in get_args(AnyFaultPart))
"""Every kind of fault."""


_ADAPTER: TypeAdapter[AnyFaultPart] = TypeAdapter(FaultPart)


def made(**table: Any) -> AnyFaultPart:
    """A fault from the keys of its table. Raises `ConfigError`."""
    try:
        return _ADAPTER.validate_python(table)
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(key) for key in first["loc"][1:]) or "kind"
        raise ConfigError(f"fault: key '{path}': {first['msg'][0].lower()}{first['msg'][1:]}") from None


def named(faults: Iterable[AnyFaultPart]) -> dict[str, AnyFaultPart]:
    """Faults by their names. Raises `ConfigError` if two have the same."""
    found: dict[str, AnyFaultPart] = {}
    for index, fault in enumerate(faults, start=1):
        name = fault.id if fault.id is not None else f"{fault.kind}-{index}"
        if name in found:
            raise ConfigError(f"faults: id '{name}' is used twice; ids must differ")
        found[name] = fault
    return found


def check_faults(faults: Iterable[AnyFaultPart], robots: Iterable[str]) -> None:
    """Raises `ConfigError` if a fault names a robot that is not there."""
    there = list(robots)
    for name, fault in named(faults).items():
        stranger = next((robot for robot in fault.names() if robot not in there), None)
        if stranger is not None:
            raise ConfigError(f"faults.{name}: no robot '{stranger}'; there are: {', '.join(there)}")


def _ids(names: list[str] | None) -> frozenset[str] | None:
    return None if names is None else frozenset(names)
