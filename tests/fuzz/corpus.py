"""Genuine messages of every kind, overheard in virtual runs of each form."""

from __future__ import annotations

from functools import cache

import msgpack

from network.messages import Packet
from sim.engine import VirtualEngine
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world

VIEW = (
    "robots.*.sensors.view={kind='range_bearing', of=['peers'], sigma_m=0.5, sigma_rad=0.02, rate_hz=2.0}",
)
"""A follower measures its leader."""

FORMS = {
    "safe": ["localization.form=safe"],
    "published": ["localization.form=published"],
    "joint": ["localization.form=joint"],
    "split_joint": ["localization.form=split_joint"],
    "replica": ["localization.kind=replica"],
    "jlatt": ["localization.kind=jlatt"],
    "leader": ["localization.kind=leader", "localization.leader=r1", "tracking.kind=none", *VIEW],
    "asked_leader": [
        "localization.kind=leader",
        "localization.leader=r1",
        "localization.exchange=request",
        "tracking.kind=none",
        *VIEW,
    ],
    "icf_plus": [
        "tracking.kind=icf_plus",
        "robots.*.sensors.camera.kind=bearing",
        "targets.t1.model=constant_velocity_3d",
        "targets.t1.start.pose=[3.0, 2.0, 0.0, 0.3, 0.1, 0.0]",
        "targets.t1.start_sigma={position_m=1.0, altitude_m=0.5, velocity_mps=0.5}",
        "targets.t1.control={}",
        "targets.t1.noise={acceleration_mps2=0.1}",
    ],
    "relative": [],
}
"""`--set` overrides by form; `relative` is a fleet of its own, for it needs robots in space."""

KINDS = frozenset((*range(1, 10), *range(11, 17)))
"""Every kind of message of the wire format but the notice to a robot that is there twice."""


def fleet(form: str, duration_s: float, clock_sigma_s: float = 0.005) -> Scenario:
    """Five robots in reach of each other and of a target, no faults, messages that take a while."""
    if form == "relative":
        return _leaders(duration_s, clock_sigma_s)
    more = [f"lateness.clock_sigma_s={clock_sigma_s}", *FORMS[form]]
    more += [f"duration_s={duration_s}", f"window_s=[2, {duration_s}]", "links.delay_s=0.05"]
    return load("fault-plan", more).model_copy(update={"fault_plan": None})


def _leaders(duration_s: float, clock_sigma_s: float) -> Scenario:
    """Five robots r1 to r5 that locate each other relative to their bodies; r1 and r2 have cameras."""
    more = [f"lateness.clock_sigma_s={clock_sigma_s}", f"duration_s={duration_s}", f"window_s=[2, {duration_s}]"]
    made = load("correspondence", [*more, "links.delay_s=0.05"])
    robots = [robot.model_copy(update={"id": f"r{index}"}) for index, robot in enumerate(made.robots, 1)]
    return made.model_copy(update={"robots": robots})


class Listener:
    """Somebody beside a robot who only listens."""

    def __init__(self) -> None:
        self.heard: list[Packet] = []

    def seen(self, packet: Packet) -> None:
        self.heard.append(packet)

    def next_ns(self, after_ns: int) -> int | None:
        return None

    def packet(self, t_ns: int) -> Packet | None:
        return None


@cache
def recorded(form: str, duration_s: float = 6.0, beginner: bool = False) -> tuple[Packet, ...]:
    """What reaches robots r1 to r3 in a run; with a `beginner`, r2 has to ask where it is."""
    made = fleet(form, duration_s)
    if beginner:
        robots = [
            robot.model_copy(update={"start_source": "peer", "sensors": robot.sensors | {"eye": _eye(robot)}})
            if robot.id == "r2"
            else robot
            for robot in made.robots
        ]
        made = made.model_copy(update={"robots": robots})
    engine = VirtualEngine(made, open_world(made, 1), 1)
    listener = Listener()
    for robot in ("r1", "r2", "r3"):
        engine.intrude(robot, listener)
    engine.run()
    # A broadcast is overheard by each of them.
    return tuple(dict.fromkeys(listener.heard))


def _eye(robot):  # type: ignore[no-untyped-def]
    """A camera that sees peers, as that of targets."""
    return robot.sensors["camera"].model_copy(update={"of": ["peers"]})


@cache
def corpus() -> tuple[Packet, ...]:
    """Messages of every kind and form."""
    packets = [packet for form in FORMS for packet in recorded(form)]
    packets += [packet for form in ("safe", "split_joint") for packet in recorded(form, 6.0, True)]
    assert {kind(packet) for packet in packets} == KINDS, sorted({kind(packet) for packet in packets})
    return tuple(packets)


def kind(packet: Packet) -> int:
    return int(msgpack.unpackb(packet.payload)[1])
