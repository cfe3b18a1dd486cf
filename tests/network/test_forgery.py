"""Forged packets: when they come, what they are made from, and that the endpoint refuses them."""

from __future__ import annotations

import pytest

from network.endpoint import Endpoint, EndpointSettings
from network.forgery import Content, Forger, Forgery
from network.life_messages import Hello
from network.messages import Channel, Packet
from network.wire import decode
from network.wire_fields import WireError

S = 1_000_000_000


def forger(content: Content, seed: int = 3) -> Forger:
    return Forger(Forgery("fake", 2 * S, 4 * S, "r2", None, S // 2, content), seed, "r1")


def robot(name: str) -> Endpoint:
    return Endpoint(robot=name, boot_id=5, incarnation=1, settings=EndpointSettings(), software="test")


def overheard(into: Forger) -> list[Packet]:
    """Hellos of r2 as r1 gets them."""
    sender = robot("r2")
    packets = [packet for k in range(4) for packet in sender.tick(k * S // 2)[0]]
    for packet in packets:
        into.seen(packet)
    return packets


def test_it_lasts_from_its_begin_to_its_end() -> None:
    made, t_ns, found = forger("stranger"), -1, []
    while (following := made.next_ns(t_ns)) is not None:
        found.append(following)
        t_ns = following
    assert found == [2 * S, 5 * S // 2, 3 * S, 7 * S // 2]


def test_it_reaches_everybody_but_the_robot_it_claims_to_be() -> None:
    forgery = forger("damaged").forgery
    assert forgery.reaches("r1") and not forgery.reaches("r2")
    aimed = Forgery("fake", 0, S, "r2", frozenset({"r3"}), S, "damaged")
    assert aimed.reaches("r3") and not aimed.reaches("r1")


@pytest.mark.parametrize("content", ["damaged", "hostile", "replayed"])
def test_without_anything_overheard_there_is_nothing_to_forge(content: Content) -> None:
    made = forger(content)
    assert made.packet(2 * S) is None
    made.seen(Packet("r3", Channel.HELLO, None, b"of somebody else"))
    assert made.packet(2 * S) is None


def test_a_replay_is_genuine_and_refused_as_a_duplicate() -> None:
    made, receiver = forger("replayed"), robot("r1")
    for packet in overheard(made):
        receiver.receive(2 * S, packet)
    again = made.packet(2 * S)
    assert again is not None and decode(again.payload, "r2").header.source == "r2"
    assert receiver.receive(2 * S, again) == []
    assert receiver.counters["rejected.duplicate"] == 1


@pytest.mark.parametrize("content", ["damaged", "hostile"])
def test_no_damaged_packet_raises_and_few_are_accepted(content: Content) -> None:
    made, receiver = forger(content), robot("r1")
    packets = overheard(made)
    receiver.receive(2 * S, packets[0])
    for k in range(2000):
        forged = made.packet(2 * S + k)
        assert forged is not None
        receiver.receive(2 * S, forged)
    refused = sum(count for name, count in receiver.counters.items() if name.startswith("rejected."))
    assert refused > 1000
    assert receiver.counters["received"] == refused + receiver.counters["hellos"] + receiver.counters["delivered"]


def test_a_stranger_says_hello_in_another_life_each_time() -> None:
    made = forger("stranger")
    found = [made.packet(t_ns) for t_ns in range(2 * S, 2 * S + 20)]
    messages = [decode(packet.payload, "r2") for packet in found if packet is not None]
    assert len({message.header.boot_id for message in messages}) == 20
    assert all(isinstance(message.body, Hello) for message in messages)


def test_equal_seeds_forge_equal_packets() -> None:
    one, two, other = forger("damaged"), forger("damaged"), forger("damaged", seed=4)
    for made in (one, two, other):
        overheard(made)
    assert [one.packet(t_ns) for t_ns in range(9)] == [two.packet(t_ns) for t_ns in range(9)]
    assert [one.packet(t_ns) for t_ns in range(9)] != [other.packet(t_ns) for t_ns in range(9)]


def test_damage_can_always_be_decoded_or_is_refused() -> None:
    made = forger("hostile")
    overheard(made)
    for t_ns in range(500):
        packet = made.packet(t_ns)
        assert packet is not None
        try:
            decode(packet.payload, "r2")
        except WireError:
            continue
