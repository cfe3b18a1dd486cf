"""One robot without its I/O: two nodes talk through bytes alone, and nothing they hear stops them."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.effects import Effect, Steer
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import Intrinsics
from agent.events import Event, LinkChange, Observation, Odometry, Tick
from agent.node import Node, Outgoing, rejected
from agent.sensor_input import ABSOLUTE_KINDS, SIZES, SensorConfig, encode
from agent.settings import AgentSettings
from network.endpoint import EndpointSettings
from network.life_messages import LifeNotice
from network.messages import Channel, Packet
from network.wire import OversizeError

S = 1_000_000_000
STARTS = {"r1": [0.0, 0.0, 0.0], "r2": [5.0, 0.0, 1.0]}


def node(robot: str, seen: list[tuple[Event, list[Effect]]] | None = None) -> Node:
    recorder = None if seen is None else lambda event, effects: seen.append((event, effects))
    return Node(
        AgentSettings(robot, 0, np.array(STARTS[robot]), np.diag([0.25, 0.25, 0.01])),
        EndpointSettings(),
        boot_id=7,
        incarnation=1,
        software="test",
        sensors={
            "uwb": SensorConfig(planar_mount(0.1, 0.0, 0.0)),
            "camera": SensorConfig((0.0, 0.0, 1.0, 0.0, 0.3, 0.0), intrinsics=Intrinsics()),
        },
        recorder=recorder,
    )


def moved(t0_ns: int, t_ns: int) -> bytes:
    return encode(t_ns, "odometry", np.array([0.1, 0.0, 0.0, 0.0]), np.eye(4) * 1e-4, t0_ns=t0_ns)


def ranged(t_ns: int, of: str = "r2", z: float = 5.0) -> bytes:
    return encode(t_ns, "range", np.array([z]), np.eye(1) * 0.01, of=of, sensor="uwb")


def introduced() -> tuple[Node, Node]:
    """Two nodes that have heard each other's hello."""
    one, other = node("r1"), node("r2")
    for speaker, listener in ((one, other), (other, one)):
        for packet in speaker.on_tick(1).packets:
            listener.on_packet(1, packet)
    return one, other


def test_the_newest_motion_that_is_chosen_comes_out(monkeypatch: pytest.MonkeyPatch) -> None:
    one = node("r1")
    assert one.on_tick(1).steer is None
    old, new = (Steer((speed, 0.0, 0.0), 0.0, 2 * S) for speed in (0.25, 0.5))
    monkeypatch.setattr(one.agent, "handle", lambda event: [old, new])
    assert one.on_event(Tick(S)).steer == new


# --- what happens between two robots ----------------------------------------------------------------------


def test_a_range_becomes_a_request_a_reply_and_two_better_estimates() -> None:
    one, other = introduced()
    for robot in (one, other):
        robot.on_sensor(S, moved(0, S))
    spread = {robot.robot: np.trace(robot.agent.estimate().cov) for robot in (one, other)}
    (request,) = one.on_sensor(S, ranged(S)).packets
    assert (request.source, request.channel, request.destination) == ("r1", Channel.PAIR, "r2")
    out = other.on_packet(S, request)
    (reply,) = out.packets
    assert (reply.source, reply.destination) == ("r2", "r1")
    assert len(out.estimates) == 1
    assert one.on_packet(S, reply).packets == []
    for robot in (one, other):
        assert np.trace(robot.agent.estimate().cov) < spread[robot.robot]
    assert one.agent.counters["pair.applied_initiator"] == other.agent.counters["pair.applied_responder"] == 1


def test_hearing_a_peer_for_the_first_time_is_an_event_of_the_core() -> None:
    seen: list[tuple[Event, list[Effect]]] = []
    one, other = node("r1", seen), node("r2")
    (hello,) = other.on_tick(1).packets
    one.on_packet(1, hello)
    ((event, _),) = seen
    assert event == LinkChange(1, "r2", True, 1, 7)


def test_a_peer_that_is_heard_and_does_not_hear_us_is_named() -> None:
    one, other = introduced()

    def hellos(until_s: int, back: bool) -> list[list[str]]:
        """Both say hello each second; `back`: whether the other hears it."""
        told = []
        for second in range(until_s - 7, until_s + 1):
            for packet in one.on_tick(second * S).packets:
                if back:
                    other.on_packet(second * S, packet)
            for packet in other.on_tick(second * S).packets:
                one.on_packet(second * S, packet)
            told.append(one.status()["unheard_by"])
        return told

    assert hellos(8, True) == [[]] * 8
    # It goes on echoing us until it takes us for gone, and so long again it is given for a hello that got lost.
    deaf = hellos(16, False)
    assert deaf[:3] == [[]] * 3 and deaf[-1] == ["r2"]
    assert one.status()["peers"] == {"r2": True} and other.status()["peers"] == {"r1": False}
    assert hellos(24, True)[-1] == []


def test_who_is_told_that_its_life_is_over_says_so_and_asks_for_another() -> None:
    one, other = introduced()
    last_ns = 9 * S
    for t_ns in range(S, last_ns + 1, S):
        one.on_tick(t_ns)
    out = one.on_packet(last_ns, other.endpoint.send(last_ns, "r1", last_ns, LifeNotice(7, 4, True)))
    assert [alarm.reason for alarm in out.alarms] == ["duplicate_robot"] and "r1: " in out.alarms[0].detail
    assert one.status()["duplicates"] == ["r1"] and one.status()["incarnation"] == 1
    assert one.on_tick(last_ns + 1).next_life is None
    assert one.on_tick(11 * S).next_life == 5
    assert one.on_tick(13 * S).next_life is None and one.status()["duplicates"] == []


def test_a_life_that_follows_counts_on() -> None:
    one, other = introduced()
    for robot in (one, other):
        robot.on_sensor(S, moved(0, S))
    (request,) = one.on_sensor(S, ranged(S)).packets
    (reply,) = other.on_packet(S, request).packets
    one.on_packet(S, reply)
    after = node("r1")
    after.count_on(one)
    after.count_on(one)
    assert after.agent.counters["pair.applied_initiator"] == 2 * one.agent.counters["pair.applied_initiator"] == 2
    assert after.endpoint.counters["received"] == 2 * one.endpoint.counters["received"] > 0
    assert {kind: entry.count for kind, entry in after.agent.nis.items()} == {
        kind: 2 * entry.count for kind, entry in one.agent.nis.items()
    } != {}


def test_a_peer_that_falls_silent_is_an_event_of_the_core() -> None:
    seen: list[tuple[Event, list[Effect]]] = []
    one, other = node("r1", seen), node("r2")
    (hello,) = other.on_tick(1).packets
    one.on_packet(1, hello)
    one.on_tick(10 * S)
    assert [event for event, _ in seen if isinstance(event, LinkChange)][-1] == LinkChange(10 * S, "r2", False, 1, 7)


def test_the_core_sees_events_that_passed_and_the_recorder_sees_what_it_saw() -> None:
    seen: list[tuple[Event, list[Effect]]] = []
    one = node("r1", seen)
    one.on_sensor(S, moved(0, S))
    one.on_sensor(S, ranged(S))
    one.on_event(Tick(2 * S))
    one.on_sensor(S, b"rubbish")
    assert [type(event) for event, _ in seen] == [Odometry, Observation, Tick]
    observation = seen[1][0]
    assert isinstance(observation, Observation)
    assert observation.mount == planar_mount(0.1, 0.0, 0.0)
    assert all(isinstance(effects, list) for _, effects in seen)


# --- time -------------------------------------------------------------------------------------------------


def test_hellos_go_out_on_time() -> None:
    one = node("r1")
    sent = []
    now = 0
    while now < 5 * S:
        now = max(now + 1, one.next_deadline_ns())
        sent += [(now, packet.channel) for packet in one.on_tick(now).packets]
    assert {channel for _, channel in sent} == {Channel.HELLO}
    assert len(sent) == 11
    assert one.on_tick(now).packets == []


def test_the_core_is_not_woken_before_it_asked_for() -> None:
    seen: list[tuple[Event, list[Effect]]] = []
    one = node("r1", seen)
    one.on_tick(1)
    assert seen == []
    one.on_sensor(S, ranged(S))
    deadline = one.agent.next_deadline_ns()
    assert S < deadline < 10 * S
    one.on_tick(deadline - 1)
    assert not any(isinstance(event, Tick) for event, _ in seen)
    one.on_tick(deadline)
    assert [event for event, _ in seen if isinstance(event, Tick)] == [Tick(deadline)]


# --- refusals ---------------------------------------------------------------------------------------------


def test_what_is_refused_has_a_counter_with_its_reason() -> None:
    one, other = introduced()
    one.on_sensor(S, b"rubbish")
    one.on_sensor(S, ranged(S, of="r1"))
    one.on_sensor(S, ranged(S, of="landmark:nowhere"))
    one.on_sensor(S, moved(0, S))
    one.on_packet(S, Packet("r2", Channel.HELLO, None, b"rubbish"))
    (hello,) = other.on_tick(S).packets
    one.on_packet(S, hello)
    one.on_packet(S, hello)
    one.on_packet(S, Packet("r1", Channel.HELLO, None, hello.payload))
    assert rejected(one) == {
        "duplicate": 1,
        "malformed": 1,
        "observation.of_self": 1,
        "observation.unknown_landmark": 1,
        "own_echo": 1,
        "sensor.malformed": 1,
    }
    assert rejected(node("r1")) == {}


def test_a_message_to_nobody_is_counted() -> None:
    """A driver may name a robot that can't be addressed: itself, or one whose name is no name."""
    one = node("r1")
    one.on_event(Odometry(S, 0, S, np.zeros(4), np.eye(4)))
    out = one.on_event(Observation(S, S, "range", "x y", np.array([1.0]), np.eye(1)))
    assert out.packets == []
    assert one.counters["send.degenerate"] == 1


def test_a_message_too_large_for_the_radio_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    one, _ = introduced()
    one.on_sensor(S, moved(0, S))

    def refuse(*_: Any) -> Packet:
        raise OversizeError("too large")

    monkeypatch.setattr(one.endpoint, "send", refuse)
    assert one.on_sensor(S, ranged(S)).packets == []
    assert one.counters["send.oversize"] == 1


NUMBERS = st.floats(-100.0, 100.0) | st.floats(-1e9, 1e9)


@st.composite
def well_formed(draw: st.DrawFn) -> bytes:
    """A datagram that passes the sensor gate, with numbers from sensible to absurd."""
    kind = draw(st.sampled_from(["range", *SIZES]))
    size = draw(st.sampled_from(SIZES[kind]))
    t_ns = draw(st.integers(1, 20 * S))
    data: dict[str, Any] = {
        "t_ns": t_ns,
        "kind": kind,
        "z": draw(st.lists(NUMBERS, min_size=size, max_size=size)),
        "R": (np.eye(size) * draw(st.floats(1e-4, 1.0) | st.floats(1e-12, 1e9))).tolist(),
    }
    if "range" in kind:
        data["z"][0] = abs(data["z"][0])
    if kind == "odometry":
        data["t0_ns"] = max(0, t_ns - draw(st.integers(1, 3 * S)))
    elif kind not in ABSOLUTE_KINDS:
        data["of"] = draw(st.sampled_from(["r2", "r2", None, "r1", "r3", "landmark:x", "target:x"]))
        data["sensor"] = "camera" if kind == "pixel" else draw(st.sampled_from(["", "uwb", "camera"]))
        if draw(st.booleans()):
            data["attitude"] = draw(st.lists(st.floats(-1.5, 1.5), min_size=2, max_size=2))
    return bytes(msgpack.packb(data))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 20 * S), well_formed()), max_size=25))
def test_no_sensor_input_stops_a_robot_or_breaks_its_belief(inputs: list[tuple[int, bytes]]) -> None:
    one, other = introduced()
    for now, payload in sorted(inputs):
        deliver(now, one.on_sensor(now, payload), other, one)
        deliver(now, one.on_tick(now), other, one)
    assert not any(name.startswith("sensor.") for name in one.counters)
    for robot in (one, other):
        estimate = robot.agent.estimate()
        assert np.all(np.isfinite(estimate.mean))
        assert is_positive_definite(estimate.cov)


def deliver(now: int, out: Outgoing, to: Node, back: Node) -> None:
    for packet in out.packets:
        for answer in to.on_packet(now, packet).packets:
            back.on_packet(now, answer)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_packet_stops_a_robot(data: st.DataObject) -> None:
    one, other = introduced()
    one.on_sensor(S, moved(0, S))
    (request,) = one.on_sensor(S, ranged(S)).packets
    payload = bytearray(request.payload)
    for _ in range(data.draw(st.integers(1, 6))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    channel = data.draw(st.sampled_from([Channel.PAIR, Channel.HELLO, "belief", "nonsense"]))
    destination = data.draw(st.sampled_from(["r2", None, "r1"]))
    other.on_packet(S, Packet("r1", channel, destination, bytes(payload)))
    other.on_packet(S, Packet("r1", channel, destination, data.draw(st.binary(max_size=1300))))
    other.on_tick(2 * S)
    estimate = other.agent.estimate()
    assert np.all(np.isfinite(estimate.mean))
    assert is_positive_definite(estimate.cov)
    assert other.endpoint.counters["received"] == 3
