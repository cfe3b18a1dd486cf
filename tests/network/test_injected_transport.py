"""Link faults at the receiver: equal fates to virtual time, delays counted from the send stamp."""

from __future__ import annotations

from collections.abc import Callable

from network.injected_transport import LinkInjector
from network.life_messages import Hello
from network.links import LinkModel, LinkSettings, packet_fate
from network.messages import Channel, Header, Packet
from network.wire import encode

MS = 1_000_000
SENT = 1_000 * MS


class Desk:
    """An injector for robot r2 with a clock and a timer in the test's hands."""

    def __init__(self, settings: LinkSettings, in_range: bool = True) -> None:
        self.now_ns = SENT
        self.asked: list[tuple[str, str, int]] = []
        self.timers: list[tuple[int, Callable[[], None]]] = []
        self.delivered: list[Packet] = []

        def link_state(source: str, destination: str, t_send_ns: int) -> bool:
            self.asked.append((source, destination, t_send_ns))
            return in_range

        self.injector = LinkInjector(
            "r2",
            LinkModel(settings, link_state),
            lambda: self.now_ns,
            lambda wait, call: self.timers.append((wait, call)),
            self.delivered.append,
        )

    def hear(self, packet: Packet) -> None:
        self.injector.on_packet(packet)

    def ring(self) -> None:
        """Let every timer that is set go off."""
        timers, self.timers = self.timers, []
        for _, call in timers:
            call()


def packet(seq: int = 0, t_send_ns: int = SENT, incarnation: int = 1) -> Packet:
    header = Header("r1", 5, incarnation, seq, t_send_ns, t_send_ns)
    return Packet("r1", Channel.HELLO, None, encode(header, Hello("test")))


def test_a_perfect_link_hands_on_at_once_what_it_is_given() -> None:
    desk = Desk(LinkSettings(seed=1))
    first = packet()
    desk.hear(first)
    assert desk.delivered == [first]
    assert desk.delivered[0] is first
    assert desk.timers == []
    assert desk.injector.counters == {"delivered": 1}


def test_the_delay_counts_from_the_send_stamp() -> None:
    desk = Desk(LinkSettings(seed=1, delay_s=0.1))
    desk.now_ns = SENT + 30 * MS
    desk.hear(packet())
    assert desk.delivered == []
    assert [wait for wait, _ in desk.timers] == [70 * MS]
    desk.ring()
    assert len(desk.delivered) == 1


def test_what_took_longer_than_its_delay_already_is_not_held() -> None:
    desk = Desk(LinkSettings(seed=1, delay_s=0.1))
    desk.now_ns = SENT + 100 * MS
    desk.hear(packet())
    assert (len(desk.delivered), desk.timers) == (1, [])


def test_a_stamp_from_the_future_holds_a_packet_no_longer_than_its_delay() -> None:
    desk = Desk(LinkSettings(seed=1, delay_s=0.1))
    desk.hear(packet(t_send_ns=2**62))
    assert [wait for wait, _ in desk.timers] == [100 * MS]


def test_fates_are_those_of_the_packet() -> None:
    settings = LinkSettings(seed=4, loss=0.4, delay_s=0.05, delay_tail_s=0.05, duplicate=0.3)
    lost = twice = 0
    for seq in range(60):
        fate = packet_fate(settings, source="r1", destination="r2", channel=Channel.HELLO, incarnation=3, seq=seq)
        desk = Desk(settings)
        desk.hear(packet(seq, incarnation=3))
        expected = [] if fate.lost else [fate.delay_ns]
        if not fate.lost and fate.duplicate_delay_ns is not None:
            expected.append(fate.duplicate_delay_ns)
            twice += 1
        lost += fate.lost
        assert [wait for wait, _ in desk.timers] == expected
        assert desk.injector.counters == {"lost" if fate.lost else "delivered": 1}
        desk.ring()
        assert len(desk.delivered) == len(expected)
    assert lost > 10
    assert twice > 3


def test_two_packets_that_wait_at_once_stay_apart() -> None:
    desk = Desk(LinkSettings(seed=1, delay_s=0.1))
    first, second = packet(0), packet(1)
    desk.hear(first)
    desk.hear(second)
    desk.ring()
    assert desk.delivered == [first, second]


def test_out_of_range_nothing_arrives() -> None:
    desk = Desk(LinkSettings(seed=1, range_m=10.0), in_range=False)
    desk.hear(packet())
    assert (desk.delivered, desk.timers) == ([], [])
    assert desk.asked == [("r1", "r2", SENT)]
    assert desk.injector.counters == {"lost": 1}


def test_rubbish_goes_on_to_those_who_count_it() -> None:
    desk = Desk(LinkSettings(seed=1, loss=1.0))
    rubbish = Packet("r1", Channel.HELLO, None, b"\xc1rubbish")
    desk.hear(rubbish)
    assert desk.delivered == [rubbish]
    assert desk.injector.counters == {}
