"""Two ends of a link: what is delivered, what is refused and why, and who is there."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from network.endpoint import (
    MAX_DESTINATIONS,
    ClockChange,
    Delivery,
    Endpoint,
    EndpointSettings,
    PeerChange,
    PeerDoubled,
)
from network.life_messages import MAX_ECHOES, ClockEcho, Hello, LifeNotice
from network.messages import (
    MAX_MESSAGE_BYTES,
    NEVER,
    Belief,
    Channel,
    Epoch,
    Header,
    Packet,
    PairReply,
    ReplyStatus,
    Snapshot,
    TargetBelief,
)
from network.peers import MAX_PEERS
from network.wire import OversizeError, decode, encode, peek_header

MS = 10**6
S = 10**9
T0 = 1_000 * S


def endpoint(robot: str = "r1", boot_id: int = 1, incarnation: int = 1, **limits: int) -> Endpoint:
    return Endpoint(
        robot=robot,
        boot_id=boot_id,
        incarnation=incarnation,
        settings=EndpointSettings(**limits),
        software="0.1.0",
    )


def reply(counter: int = 0) -> PairReply:
    """The smallest message above the endpoint; `counter` tells them apart."""
    return PairReply(Epoch(1, "r1", counter), ReplyStatus.BUSY)


def counter_of(delivery: Delivery) -> int:
    assert isinstance(delivery.message.body, PairReply)
    return delivery.message.body.epoch.counter


def deliveries(events: list[Any]) -> list[Delivery]:
    return [event for event in events if isinstance(event, Delivery)]


def changes(events: list[Any]) -> list[PeerChange]:
    return [event for event in events if isinstance(event, PeerChange)]


def rejected(end: Endpoint) -> dict[str, int]:
    return {name: count for name, count in end.counters.items() if name.startswith("rejected.")}


def adds_up(end: Endpoint) -> bool:
    counters = end.counters
    return counters["received"] == counters["delivered"] + counters["hellos"] + sum(rejected(end).values())


# --- delivery ---------------------------------------------------------------------------------------------


def test_a_directed_message_arrives_and_brings_its_sender_up() -> None:
    a, b = endpoint("r1", boot_id=7, incarnation=3), endpoint("r2")
    change, delivery = b.receive(T0 + MS, a.send(T0, "r2", T0 - MS, reply(5)))
    assert change == PeerChange("r1", up=True, incarnation=3, boot_id=7)
    assert isinstance(delivery, Delivery)
    assert delivery.message.header == Header("r1", 7, 3, 0, T0 - MS, T0)
    assert counter_of(delivery) == 5
    assert (delivery.offset_ns, delivery.offset_sigma_ns) == (0, None)


def test_sequence_numbers_count_per_channel_and_destination() -> None:
    a = endpoint("r1")
    packets = [a.send(T0, "r2", T0, reply()), a.send(T0, "r2", T0, reply()), a.send(T0, "r3", T0, reply())]
    packets += a.tick(T0)[0]
    assert [decode(packet.payload, "r1").header.seq for packet in packets] == [0, 1, 0, 0]


def test_a_message_that_could_not_be_sent_uses_up_no_sequence_number() -> None:
    a = endpoint("r1")
    with pytest.raises(ValueError):
        a.send(T0, "r2", -1, reply())
    assert decode(a.send(T0, "r2", T0, reply()).payload, "r1").header.seq == 0
    assert a.counters["sent"] == 1


# --- refusals ---------------------------------------------------------------------------------------------


def packet_from(
    source: str = "r2", *, channel: str = Channel.PAIR, destination: str | None = "r1", **header: Any
) -> Packet:
    """A packet of r2 for r1, sent at T0."""
    body = Hello("x") if channel == Channel.HELLO else reply()
    stamps = {"boot_id": 1, "incarnation": 1, "seq": 0, "t_meas_ns": T0, "t_send_ns": T0} | header
    return Packet(source, channel, destination, encode(Header(source, **stamps), body))


HORIZON, BOUND = EndpointSettings().horizon_ns, EndpointSettings().offset_bound_ns

REFUSED = {
    "own_echo": packet_from("r1", channel=Channel.HELLO, destination=None),
    "not_for_us": packet_from(destination="r3"),
    "wrong_channel": packet_from(channel=Channel.HELLO, destination=None, seq=1),
    "from_future": packet_from(t_send_ns=T0 + BOUND + 1),
    "too_old": packet_from(t_send_ns=T0 - HORIZON - 1),
    "malformed": Packet("r2", Channel.PAIR, "r1", b"\xc1"),
    "oversize": Packet("r2", Channel.PAIR, "r1", b"\x00" * (MAX_MESSAGE_BYTES + 1)),
    "source_mismatch": dataclasses.replace(packet_from("r3"), source="r2"),
}
REFUSED["wrong_channel"] = dataclasses.replace(REFUSED["wrong_channel"], channel=Channel.BELIEF)


@pytest.mark.parametrize("reason", sorted(REFUSED))
def test_a_packet_is_refused_for_one_counted_reason(reason: str) -> None:
    end = endpoint("r1")
    assert end.receive(T0, REFUSED[reason]) == []
    assert rejected(end) == {f"rejected.{reason}": 1}
    assert end.peers() == ()
    assert adds_up(end)


@pytest.mark.parametrize(
    "packet",
    [
        dataclasses.replace(packet_from(), destination=None),
        dataclasses.replace(packet_from(), channel=Channel.HELLO, destination=None),
        dataclasses.replace(packet_from(), channel="no/such", destination=None),
        dataclasses.replace(packet_from(channel=Channel.HELLO), channel=Channel.PAIR),
    ],
    ids=["pair to all", "reply as hello", "reply on an unknown channel", "hello as pair"],
)
def test_bodies_are_refused_on_channels_where_they_do_not_belong(packet: Packet) -> None:
    end = endpoint("r1")
    assert end.receive(T0, packet) == []
    assert rejected(end) == {"rejected.wrong_channel": 1}


def test_old_measurements_are_refused_even_if_sent_just_now() -> None:
    end = endpoint("r1")
    assert end.receive(T0, packet_from(t_meas_ns=T0 - HORIZON - 1)) == []
    assert end.receive(T0, packet_from(t_meas_ns=T0 - HORIZON)) != []
    assert rejected(end) == {"rejected.too_old": 1}


def test_replays_and_messages_of_an_earlier_life_are_refused() -> None:
    end = endpoint("r2")
    old = endpoint("r1", boot_id=1)
    first, late = old.send(T0, "r2", T0, reply(1)), old.send(T0, "r2", T0, reply(2))
    end.receive(T0, first)
    assert end.receive(T0, first) == []
    reborn = endpoint("r1", boot_id=2)
    events = end.receive(T0 + MS, reborn.send(T0 + MS, "r2", T0, reply(3)))
    assert changes(events) == [PeerChange("r1", up=True, incarnation=1, boot_id=2)]
    assert [counter_of(delivery) for delivery in deliveries(events)] == [3]
    assert end.receive(T0 + MS, late) == []
    assert rejected(end) == {"rejected.duplicate": 1, "rejected.old_life": 1}
    assert end.peers()[0].counts == {"accepted": 2, "rejected": 2, "lives": 1}


def test_a_stale_message_of_another_boot_does_not_begin_a_life() -> None:
    end = endpoint("r1")
    end.receive(T0, packet_from(boot_id=1))
    assert end.receive(T0, packet_from(boot_id=2, t_send_ns=T0 - HORIZON - 1)) == []
    assert end.peers()[0].boot_id == 1


def test_two_processes_under_one_id_are_named_and_neither_is_believed_until_one_is_silent() -> None:
    end, first, second = endpoint("r2"), endpoint("r1", boot_id=1), endpoint("r1", boot_id=2)
    end.receive(T0, first.send(T0, "r2", T0, reply()))
    end.receive(T0 + MS, second.send(T0 + MS, "r2", T0, reply(1)))
    # A straggler of the first process is no second robot.
    end.receive(T0 + 3 * MS, first.send(T0 + MS // 2, "r2", T0, reply(2)))
    told = []
    for k in range(4, 10):
        now_ns = T0 + k * S // 10
        told += end.receive(now_ns, first.send(now_ns, "r2", now_ns, reply(k)))
    assert told == [PeerDoubled("r1")] and end.peers()[0].doubled
    late_ns = T0 + 2 * S
    assert deliveries(end.receive(late_ns, second.send(late_ns, "r2", late_ns, reply(10)))) == []
    assert rejected(end) == {"rejected.old_life": 7, "rejected.duplicate_robot": 1}
    healed_ns = T0 + 4 * S
    assert len(deliveries(end.receive(healed_ns, second.send(healed_ns, "r2", healed_ns, reply(11))))) == 1
    assert not end.peers()[0].doubled


def hears(listener: Endpoint, now_ns: int, packets: list[Packet]) -> list[Any]:
    return [event for packet in packets for event in listener.receive(now_ns, packet)]


def test_who_is_held_to_be_over_begins_a_new_life_once_the_other_process_is_silent() -> None:
    """r1 runs twice; the newcomer stops after 20 s. r2 and r3 hear both, and are heard by both."""
    first, second = endpoint("r1", boot_id=1, incarnation=4), endpoint("r1", boot_id=2, incarnation=9)
    peers = [endpoint("r2"), endpoint("r3")]
    due: dict[int, int] = {}
    named: dict[str, set[int]] = {"first": set(), "second": set()}
    for k in range(80):
        now_ns = T0 + k * S // 2
        twice = 10 <= k < 40
        for peer in peers:
            for packet in peer.tick(now_ns)[0]:
                for name, own in (("first", first), *([("second", second)] if twice else [])):
                    if packet.destination in (None, "r1") and PeerDoubled("r1") in own.receive(now_ns, packet):
                        named[name].add(k)
        for own in (first, second) if twice else (first,):
            for packet in own.tick(now_ns)[0]:
                hears(peers[0], now_ns, [packet])
                hears(peers[1], now_ns, [packet])
            if (number := own.own_life.next_incarnation(now_ns)) is not None:
                assert own is first
                due[k] = number
                first = endpoint("r1", boot_id=3, incarnation=number)
        if 16 <= k < 40:
            assert first.own_life.doubled(now_ns) and second.own_life.doubled(now_ns)
            message = peers[0].send(now_ns, "r1", now_ns, reply(k))
            assert deliveries(first.receive(now_ns, message)) == deliveries(second.receive(now_ns, message)) == []
    # Silence is found out after 3 s.
    assert list(due.values()) == [10] and 40 + 5 <= min(due) <= 40 + 8
    assert {16, 39} <= named["first"] and {16, 39} <= named["second"]
    end_ns = T0 + 40 * S
    for peer in peers:
        assert (peer.peers()[0].incarnation, peer.peers()[0].up) == (10, True)
        assert len(deliveries(peer.receive(end_ns, first.send(end_ns, peer.robot, end_ns, reply(99))))) == 1
        assert adds_up(peer) and not peer.peers()[0].doubled


def test_nobody_begins_anew_while_a_peer_still_hears_the_other_process() -> None:
    own = endpoint("r1", boot_id=1, incarnation=4).own_life
    assert own.next_incarnation(T0) is None
    for k in range(40):
        now_ns = T0 + k * S // 2
        own.told(now_ns, "r2", LifeNotice(1, 9, True))
        own.told(now_ns, "r3", LifeNotice(1, 11, False))
        assert own.next_incarnation(now_ns) is None
    own.told(now_ns, "r3", LifeNotice(1, 11, True))
    assert own.next_incarnation(now_ns) == 12


def test_notices_that_are_of_others_old_or_absurd_end_no_life() -> None:
    own = endpoint("r1", boot_id=1, incarnation=4).own_life
    assert own.next_incarnation(T0) is None
    now_ns = T0 + 20 * S
    assert not own.told(now_ns, "r2", LifeNotice(7, 9, True))
    assert not own.told(now_ns, "r2", LifeNotice(1, 2**41, True))
    assert own.next_incarnation(now_ns) is None and not own.doubled(now_ns)
    assert own.told(now_ns, "r2", LifeNotice(1, 9, True))
    assert own.next_incarnation(now_ns + 3 * S) is None and own.next_incarnation(T0 - S) is None


def test_a_life_lasts_for_a_while_whatever_peers_say() -> None:
    own = endpoint("r1", boot_id=1).own_life
    for k in range(20):
        now_ns = T0 + k * S // 2
        own.told(now_ns, "r2", LifeNotice(1, 9, True))
        assert own.next_incarnation(now_ns) is None
    own.told(T0 + 10 * S, "r2", LifeNotice(1, 9, True))
    assert own.next_incarnation(T0 + 10 * S) == 10


def test_a_second_process_with_an_earlier_life_is_named_too() -> None:
    end, first, second = endpoint("r2"), endpoint("r1", boot_id=1, incarnation=5), endpoint("r1", boot_id=2)
    told = []
    for k in range(6):
        now_ns = T0 + k * S // 2
        told += [event for own in (first, second) for event in hears(end, now_ns, own.tick(now_ns)[0])]
    assert PeerDoubled("r1") in told
    bodies = [decode(packet.payload, "r2").body for packet in end.tick(now_ns)[0]]
    assert bodies[1:] == [LifeNotice(2, 5, False), LifeNotice(1, 5, False)]


def test_a_crowd_beyond_the_table_is_refused() -> None:
    end = endpoint("r1")
    for k in range(MAX_PEERS + 3):
        end.receive(T0, packet_from(f"x{k}"))
    assert rejected(end) == {"rejected.too_many_peers": 3}
    assert len(end.peers()) == MAX_PEERS


short = st.text(max_size=8)


@settings(max_examples=200, deadline=None)
@given(short, short, st.none() | st.just("r1"), st.binary(max_size=1300), st.integers())
def test_no_packet_raises(source: str, channel: str, destination: str | None, payload: bytes, now_ns: int) -> None:
    end = endpoint("r1")
    assert end.receive(now_ns, Packet(source, channel, destination, payload)) == []
    assert adds_up(end)


# --- hello, silence, deadlines ----------------------------------------------------------------------------


def test_the_first_tick_says_hello_and_later_ones_keep_the_period() -> None:
    end = endpoint("r1", hello_period_ns=500 * MS)
    assert end.next_deadline_ns() == 0
    said = []
    for now_ns in range(T0, T0 + 2 * S, 30 * MS):
        packets, _ = end.tick(now_ns)
        said += [now_ns - T0] * len(packets)
    assert said == [0, 510 * MS, 1_020 * MS, 1_500 * MS]
    assert end.next_deadline_ns() == T0 + 2 * S


def test_after_a_pause_one_hello_is_said_and_not_a_burst() -> None:
    end = endpoint("r1")
    end.tick(T0)
    assert len(end.tick(T0 + 60 * S)[0]) == 1
    assert end.tick(T0 + 60 * S + 1)[0] == []


def test_own_clock_set_back_does_not_stop_hellos() -> None:
    end = endpoint("r1")
    end.tick(T0)
    assert len(end.tick(T0 - 500 * S)[0]) == 1


def test_silence_and_return_are_told() -> None:
    end = endpoint("r1", silent_after_ns=2 * S)
    end.tick(T0)
    end.receive(T0, packet_from())
    assert end.tick(T0 + 2 * S - 1)[1] == []
    assert end.tick(T0 + 2 * S)[1] == [PeerChange("r2", up=False, incarnation=1, boot_id=1)]
    events = end.receive(T0 + 3 * S, packet_from(seq=1))
    assert changes(events) == [PeerChange("r2", up=True, incarnation=1, boot_id=1)]


def test_the_deadline_covers_silence() -> None:
    end = endpoint("r1", silent_after_ns=2 * S, hello_period_ns=60 * S)
    end.tick(T0)
    end.receive(T0 + 5, packet_from())
    assert end.next_deadline_ns() == T0 + 5 + 2 * S


def hello_round(a: Endpoint, b: Endpoint, t_ns: int, ahead_ns: int, delay_ns: int) -> None:
    """a says hello at t, b when it has heard it; b's clock is `ahead_ns` ahead of true time, a's is true."""
    for packet in a.tick(t_ns)[0]:
        b.receive(t_ns + delay_ns + ahead_ns, packet)
    answered_ns = t_ns + 2 * delay_ns
    for packet in b.tick(answered_ns + ahead_ns)[0]:
        a.receive(answered_ns + delay_ns, packet)


@pytest.mark.parametrize("ahead_ns", [300 * MS, -900 * MS])
def test_hellos_measure_the_offset_of_the_clocks(ahead_ns: int) -> None:
    a, b = endpoint("r1", clock_sigma_ns=S), endpoint("r2", clock_sigma_ns=S)
    hello_round(a, b, T0, ahead_ns, 2 * MS)
    hello_round(a, b, T0 + S, ahead_ns, 2 * MS)
    assert a.peers()[0].offset_ns == ahead_ns
    assert b.peers()[0].offset_ns == -ahead_ns
    assert a.counters["hellos"] == 2
    sent_ns = T0 + S + 100 * MS
    (delivery,) = deliveries(a.receive(sent_ns, b.send(sent_ns + ahead_ns, "r1", sent_ns + ahead_ns, reply())))
    assert delivery.offset_ns == ahead_ns
    assert delivery.offset_sigma_ns is not None
    assert 2 * MS / 3**0.5 < delivery.offset_sigma_ns < 2 * MS


def test_ages_are_judged_on_the_senders_clock_once_it_is_known() -> None:
    a, b = endpoint("r1", clock_sigma_ns=S), endpoint("r2", clock_sigma_ns=S)
    behind_ns = 900 * MS
    for k in range(3):
        hello_round(a, b, T0 + k * S, -behind_ns, 2 * MS)
    # Sent 4.5 s ago; by the sender's stamp it looks 5.4 s old, beyond the horizon of 5 s.
    now_ns = T0 + 7 * S
    sent_ns = now_ns - 4_500 * MS - behind_ns
    packet = b.send(sent_ns, "r1", sent_ns, reply())
    assert len(deliveries(a.receive(now_ns, packet))) == 1
    assert endpoint("r1").receive(now_ns, packet) == []


@pytest.mark.parametrize("ahead_ns", [-2 * S, 2 * S, 100 * S, -100 * S])
def test_clocks_however_far_apart_meet_if_the_fleet_allows_for_it(ahead_ns: int) -> None:
    a, b = endpoint("r1", clock_sigma_ns=50 * S), endpoint("r2", clock_sigma_ns=50 * S)
    for k in range(3):
        hello_round(a, b, T0 + k * S, ahead_ns, 2 * MS)
    assert a.peers()[0].offset_ns == ahead_ns and a.peers()[0].clock_unusable is None
    sent_ns = T0 + 3 * S
    packet = b.send(sent_ns + ahead_ns, "r1", sent_ns + ahead_ns, reply())
    assert len(deliveries(a.receive(sent_ns, packet))) == 1


def test_a_clock_that_is_off_by_more_than_is_allowed_is_named_and_not_used() -> None:
    a, b = endpoint("r1"), endpoint("r2")
    for packet in a.tick(T0)[0]:
        b.receive(T0 + 2 * S, packet)
    told = [event for packet in b.tick(T0 + 2 * S)[0] for event in a.receive(T0 + MS, packet)]
    assert ClockChange("r2", "offset") in told
    assert a.peers()[0].clock_unusable == "offset"
    packet = b.send(T0 + 3 * S, "r1", T0 + 3 * S, reply())
    assert deliveries(a.receive(T0 + S, packet)) == []
    assert rejected(a) == {"rejected.clock_unusable": 1}


def test_a_clock_that_is_set_right_again_is_used_again() -> None:
    a, b = endpoint("r1"), endpoint("r2")
    for k in range(3):
        hello_round(a, b, T0 + k * S, 2 * S, 2 * MS)
    assert a.peers()[0].clock_unusable == "offset"
    for k in range(3, 12):
        hello_round(a, b, T0 + k * S, 0, 2 * MS)
    assert a.peers()[0].clock_unusable is None and a.peers()[0].offset_ns == 0
    assert len(deliveries(a.receive(T0 + 12 * S, b.send(T0 + 12 * S, "r1", T0 + 12 * S, reply())))) == 1


def test_a_new_life_has_a_clock_that_nobody_has_judged_yet() -> None:
    a, b = endpoint("r1"), endpoint("r2")
    for k in range(3):
        hello_round(a, b, T0 + k * S, 2 * S, 2 * MS)
    assert a.peers()[0].clock_unusable == "offset"
    again = endpoint("r2", boot_id=77)
    told = [event for packet in again.tick(T0 + 20 * S)[0] for event in a.receive(T0 + 20 * S + MS, packet)]
    assert ClockChange("r2", None) in told and a.peers()[0].clock_unusable is None


@pytest.mark.parametrize("step_ns", [-100 * S, -10 * S, 10 * S, 100 * S])
def test_a_clock_that_is_set_by_more_than_the_horizon_is_soon_understood_again(step_ns: int) -> None:
    a, b = endpoint("r1", clock_sigma_ns=50 * S), endpoint("r2", clock_sigma_ns=50 * S)
    for k in range(5):
        hello_round(a, b, T0 + k * S, 0, 2 * MS)
    for k in range(5, 15):
        hello_round(a, b, T0 + k * S, step_ns, 2 * MS)
    for end, offset_ns, now_ns in ((a, step_ns, T0 + 15 * S), (b, -step_ns, T0 + 15 * S + step_ns)):
        (peer,) = end.peers()
        assert peer.up and peer.offset_ns == offset_ns and peer.clock_unusable is None
        other = b if end is a else a
        sent_ns = now_ns + offset_ns
        packet = other.send(sent_ns, end.robot, sent_ns, reply())
        assert len(deliveries(end.receive(now_ns, packet))) == 1


def test_a_clock_that_is_set_again_and_again_is_named() -> None:
    a, b = endpoint("r1", clock_sigma_ns=50 * S), endpoint("r2", clock_sigma_ns=50 * S)
    for k in range(24):
        hello_round(a, b, T0 + k * S, (k // 4) * 3 * S, 2 * MS)
    assert a.peers()[0].clock_unusable == "steps"


def test_long_delays_alone_accuse_nobody() -> None:
    a, b = endpoint("r1"), endpoint("r2")
    for k in range(6):
        hello_round(a, b, T0 + 4 * k * S, 0, S)
    assert a.peers()[0].clock_unusable is None


def test_an_absurd_echo_is_counted_and_ignored() -> None:
    a = endpoint("r1")
    hello = Hello("x", (ClockEcho("r1", t1_ns=T0 + 9 * S, t2_ns=5),))
    packet = Packet("r2", Channel.HELLO, None, encode(Header("r2", 1, 1, 0, T0, T0), hello))
    a.receive(T0, packet)
    assert a.counters["clock_refused"] == 1
    assert a.peers()[0].offset_ns is None


def test_every_neighbour_of_a_crowd_gets_its_echo_in_turn() -> None:
    end = endpoint("r1")
    robots = {f"x{k:02}" for k in range(2 * MAX_ECHOES + 5)}
    for robot in sorted(robots):
        end.receive(T0, packet_from(robot))
    echoed: set[str] = set()
    for k in range(3):
        (packet,) = end.tick(T0 + k * 500 * MS)[0]
        body = decode(packet.payload, "r1").body
        assert isinstance(body, Hello)
        assert len(body.echoes) == MAX_ECHOES
        echoed |= {echo.peer for echo in body.echoes}
    assert echoed == robots


# --- own mistakes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes_", [{"robot": "R 1"}, {"boot_id": -1}, {"incarnation": 2**63}, {"software": "<b>"}]
)
def test_an_endpoint_that_could_not_say_hello_is_not_built(changes_: dict[str, Any]) -> None:
    arguments = {"robot": "r1", "boot_id": 1, "incarnation": 1, "software": "1"} | changes_
    with pytest.raises(ValueError):
        Endpoint(settings=EndpointSettings(), **arguments)


@pytest.mark.parametrize(
    "limits", [{"hello_period_ns": 0}, {"horizon_ns": -1}, {"max_bytes": 100}, {"max_bytes": 9999}]
)
def test_settings_that_cannot_work_are_refused(limits: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(limits))):
        EndpointSettings(**limits)


def test_messages_cannot_be_sent_to_the_wrong_place() -> None:
    end = endpoint("r1")
    with pytest.raises(ValueError, match="another robot"):
        end.send(T0, "r1", T0, reply())
    with pytest.raises(ValueError, match="use send"):
        end.broadcast(T0, Channel.PAIR, T0, reply())
    with pytest.raises(ValueError, match="does not belong"):
        end.broadcast(T0, Channel.HELLO, T0, reply())


def test_a_narrower_limit_of_bytes_holds_for_both_directions() -> None:
    belief = Belief("constant_velocity", np.zeros(4), np.eye(4))
    targets = tuple(TargetBelief(f"t{k}", belief) for k in range(6))
    snapshot = Snapshot(belief, NEVER, np.zeros((4, 0)), np.eye(4), targets=targets)
    large = PairReply(Epoch(1, "r2", 1), ReplyStatus.OK, snapshot)
    packet = endpoint("r1").send(T0, "r2", T0, large)
    assert len(packet.payload) > 1_000
    narrow = endpoint("r2", max_bytes=1_000)
    assert narrow.receive(T0, packet) == []
    assert rejected(narrow) == {"rejected.oversize": 1}
    with pytest.raises(OversizeError, match="max_bytes"):
        narrow.send(T0, "r1", T0, large)


# --- model ------------------------------------------------------------------------------------------------


class LossyPipe(RuleBasedStateMachine):
    """Two endpoints and a pipe that loses, repeats, reorders and delays; either may restart at any time."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = T0
        self.boots = {"r1": 1, "r2": 1}
        self.ends = {robot: endpoint(robot) for robot in self.boots}
        self.pipe: list[tuple[str, int, Packet]] = []
        self.sent = 0
        self.got: list[tuple[str, int]] = []

    @rule(robot=st.sampled_from(["r1", "r2"]))
    def send(self, robot: str) -> None:
        peer = "r2" if robot == "r1" else "r1"
        packet = self.ends[robot].send(self.now_ns, peer, self.now_ns, reply(self.sent))
        self.pipe.append((peer, self.boots[robot], packet))
        self.sent += 1

    @rule(robot=st.sampled_from(["r1", "r2"]), step_ns=st.integers(0, 2 * S))
    def tick(self, robot: str, step_ns: int) -> None:
        self.now_ns += step_ns
        peer = "r2" if robot == "r1" else "r1"
        packets, _ = self.ends[robot].tick(self.now_ns)
        self.pipe += [(peer, self.boots[robot], packet) for packet in packets]
        assert self.ends[robot].next_deadline_ns() > self.now_ns

    @rule(robot=st.sampled_from(["r1", "r2"]))
    def restart(self, robot: str) -> None:
        self.now_ns += MS
        self.boots[robot] += 1
        self.ends[robot] = endpoint(robot, boot_id=self.boots[robot])
        # What it was told in an earlier life may reach it again: it has no memory of it.
        self.got = [(receiver, number) for receiver, number in self.got if receiver != robot]

    @rule(pick=st.integers(0, 10**6), keep=st.booleans())
    def deliver(self, pick: int, keep: bool) -> None:
        if not self.pipe:
            return
        receiver, boot_id, packet = self.pipe[pick % len(self.pipe)]
        if not keep:
            self.pipe.remove((receiver, boot_id, packet))
        end = self.ends[receiver]
        before = {peer.peer: peer for peer in end.peers()}.get(packet.source)
        sent_ns = decode(packet.payload, packet.source).header.t_send_ns
        events = end.receive(self.now_ns, packet)
        self.got += [(receiver, counter_of(delivery)) for delivery in deliveries(events)]
        if before is not None and boot_id > before.boot_id and self.now_ns - sent_ns <= 4 * S:
            assert changes(events) == [PeerChange(packet.source, True, 1, boot_id)]
        if before is not None and boot_id < before.boot_id:
            assert events == []

    @rule(pick=st.integers(0, 10**6))
    def lose(self, pick: int) -> None:
        if self.pipe:
            del self.pipe[pick % len(self.pipe)]

    @invariant()
    def each_message_is_delivered_at_most_once(self) -> None:
        assert len(self.got) == len(set(self.got))

    @invariant()
    def counters_add_up(self) -> None:
        assert all(adds_up(end) for end in self.ends.values())

    @invariant()
    def clocks_that_agree_are_found_to_agree(self) -> None:
        for end in self.ends.values():
            for peer in end.peers():
                if peer.offset_ns is not None and peer.offset_sigma_ns is not None:
                    assert abs(peer.offset_ns) <= peer.offset_sigma_ns * 3**0.5 + 1


TestLossyPipe = LossyPipe.TestCase
TestLossyPipe.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)


def test_a_perfect_pipe_delivers_everything() -> None:
    a, b = endpoint("r1"), endpoint("r2")
    got = []
    for k in range(3_000):
        now_ns = T0 + k * MS
        got += [counter_of(d) for d in deliveries(b.receive(now_ns, a.send(now_ns, "r2", now_ns, reply(k))))]
    assert got == list(range(3_000))


def test_ever_new_destinations_are_forgotten_and_their_numbers_never_used_again() -> None:
    """A robot that is written to again must not take the message for a repetition."""
    sender, receiver = endpoint("r1"), endpoint("r2")
    refused = PairReply(Epoch(T0, "r2", 1), ReplyStatus.BUSY)
    for _ in range(3):
        assert len(receiver.receive(T0, sender.send(T0, "r2", T0, refused))) >= 1
    for index in range(3 * MAX_DESTINATIONS):
        sender.send(T0, f"x-{index}", T0, refused)
        sender.tick(T0 + index)
    assert len(sender._next_seq) == MAX_DESTINATIONS
    receiver.receive(T0, sender.send(T0, "r2", T0, refused))
    assert receiver.counters["delivered"] == 4
    header = peek_header(sender.tick(T0 + 10 * S)[0][0].payload)
    assert header is not None and header.seq > 0, "the channel to everybody is not forgotten"
