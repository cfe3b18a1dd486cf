"""The pure half of the network: bytes and times in, events and bytes out.

Every shell sends and receives through an endpoint, the virtual engine too, so that all of them refuse the
same things for the same reasons. It reads no clock, holds no socket, and never raises on what others sent:
each refusal is counted as `rejected.<reason>`. Reasons besides those of `network.wire`:

    own_echo           our own message came back
    not_for_us         directed at another robot
    wrong_channel      a body on a channel where it does not belong
    from_future        stamped further ahead than `offset_bound_ns`
    too_old            sent or measured more than `horizon_ns` ago
    old_life           from before the sender's restart
    duplicate          accepted already
    too_old_seq        so far behind that it cannot be told from a duplicate
    too_many_peers     the peer table is full
    duplicate_robot    two processes send under the sender's id, or under ours
    clock_unusable     the sender's clock is beyond repair: its stamps mean nothing

`received = delivered + hellos + sum of rejected.*` holds at all times; what peers say of lives counts as a hello.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from network.leader_messages import LeaderReport, LeaderRequest
from network.life_messages import MAX_ECHOES, ClockEcho, Hello, LifeNotice
from network.messages import (
    MAX_MESSAGE_BYTES,
    Body,
    Channel,
    Header,
    Message,
    Packet,
    PairReply,
    PairRequest,
    SplitReply,
    SplitRequest,
    StartRequest,
)
from network.own_life import OwnLife
from network.peers import MAX_PEERS, Peer, PeerTable
from network.wire import OversizeError, decode, encode
from network.wire_fields import MAX_INT, WireError, valid_id

REPEATED = ("duplicate", "too_old_seq")
"""Why a message of a living robot is refused that has been taken before, or may have been."""

MAX_DESTINATIONS = 2 * MAX_PEERS
"""Channels and robots whose numbers are kept apart."""

MIN_MAX_BYTES = 900
"""A hello with all its echoes must fit."""


@dataclass(frozen=True, slots=True)
class EndpointSettings:
    """Periods and limits, in nanoseconds of fleet time unless said otherwise.

    horizon_ns       age limit of a message's stamps
    offset_bound_ns  how far in the future they may lie
    max_bytes        limit of one message [bytes]
    clock_sigma_ns   how well the clocks of the fleet agree by themselves (1 sigma), 0: one clock for all
    max_clock_sigma_ns   a peer's clock that is known less well than that is of no use

    Protections that can be switched off, for demonstrations:

    accept_duplicates    a message is taken as often as it arrives
    accept_stale         a message is taken however old it is
    trust_clocks         no peer's clock is beyond use
    """

    hello_period_ns: int = 500_000_000
    silent_after_ns: int = 3_000_000_000
    horizon_ns: int = 5_000_000_000
    offset_bound_ns: int = 1_000_000_000
    max_bytes: int = MAX_MESSAGE_BYTES
    clock_sigma_ns: int = 0
    max_clock_sigma_ns: int = 100_000_000
    accept_duplicates: bool = False
    accept_stale: bool = False
    trust_clocks: bool = False

    def __post_init__(self) -> None:
        for name in ("hello_period_ns", "silent_after_ns", "horizon_ns", "offset_bound_ns"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive")
        if not MIN_MAX_BYTES <= self.max_bytes <= MAX_MESSAGE_BYTES:
            raise ValueError(f"max_bytes must lie within {MIN_MAX_BYTES} and {MAX_MESSAGE_BYTES}")


@dataclass(frozen=True, slots=True, eq=False)
class Delivery:
    """A message for the layer above. `offset_ns`: sender's clock minus own, 0 until measured (sigma None)."""

    message: Message
    offset_ns: int = 0
    offset_sigma_ns: int | None = None


@dataclass(frozen=True, slots=True)
class PeerChange:
    """A peer was heard for the first time, came back, began a new life (up), or fell silent (not up)."""

    peer: str
    up: bool
    incarnation: int
    boot_id: int


@dataclass(frozen=True, slots=True)
class ClockChange:
    """A peer's clock is unusable for a `reason` of `PeerClock.unusable`, or usable again or not judged yet (None)."""

    peer: str
    reason: str | None


@dataclass(frozen=True, slots=True)
class PeerDoubled:
    """Two processes are seen to send under a peer's id, or under the own one."""

    peer: str


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """What is known of one peer, for people: `counts` has accepted, rejected, lives, clock_refused.

    `clock_unusable`: why its clock is of no use; None: it is. `silence_max_ns`: longest time between two messages.
    `doubled`: two processes send under its id. `hears_us`: False if it is heard and has not heard us for some time.
    """

    peer: str
    up: bool
    incarnation: int
    boot_id: int
    heard_ns: int
    offset_ns: int | None
    offset_sigma_ns: int | None
    clock_steps: int
    clock_unusable: str | None
    counts: dict[str, int]
    silence_max_ns: int = 0
    doubled: bool = False
    hears_us: bool = True


class Endpoint:
    """One robot's end of all its links, for one life of the robot.

    robot        own id; boot_id must differ between starts, incarnation says how often factors were lost
    software     version told to neighbours
    Raises ValueError if an argument cannot be put on the wire.
    """

    def __init__(
        self, *, robot: str, boot_id: int, incarnation: int, settings: EndpointSettings, software: str
    ) -> None:
        if not valid_id(robot):
            raise ValueError("robot must match [a-z0-9-]{1,24}")
        for name, value in (("boot_id", boot_id), ("incarnation", incarnation)):
            if not 0 <= value <= MAX_INT:
                raise ValueError(f"{name} must lie within 0 and 2**63 - 1")
        self.robot = robot
        self.boot_id = boot_id
        self.incarnation = incarnation
        self.settings = settings
        self.software = software
        self.counters: Counter[str] = Counter()
        self._table = PeerTable(settings.silent_after_ns, settings.horizon_ns + settings.silent_after_ns)
        self._next_seq: dict[tuple[str, str | None], int] = {}
        # Where numbers begin: beyond those to robots that have been forgotten here.
        self._first_seq = 0
        self._hello_due_ns: int | None = None
        self._echo_turn = 0
        self._clock_changes: list[ClockChange] = []
        self._doubled: list[PeerDoubled] = []
        self.own_life = OwnLife(boot_id, incarnation, settings.silent_after_ns)
        encode(self._header(0, 0, 0), Hello(software))

    # --- out ----------------------------------------------------------------------------------------------

    def send(self, now_ns: int, peer: str, t_meas_ns: int, body: Body) -> Packet:
        """A directed message. Raises OversizeError or ValueError (see `network.wire.encode`)."""
        if not valid_id(peer) or peer == self.robot:
            raise ValueError("peer must be the id of another robot")
        return self._packet(now_ns, Channel.PAIR, peer, t_meas_ns, body)

    def broadcast(self, now_ns: int, channel: str, t_meas_ns: int, body: Body) -> Packet:
        """A message for everybody in reach. Raises OversizeError or ValueError."""
        if channel == Channel.PAIR:
            raise ValueError("channel pair is directed: use send")
        return self._packet(now_ns, channel, None, t_meas_ns, body)

    def _header(self, seq: int, t_meas_ns: int, now_ns: int) -> Header:
        return Header(self.robot, self.boot_id, self.incarnation, seq, t_meas_ns, now_ns)

    def _packet(self, now_ns: int, channel: str, peer: str | None, t_meas_ns: int, body: Body) -> Packet:
        if not _belongs(body, channel):
            raise ValueError(f"{type(body).__name__} does not belong on channel {channel}")
        seq = self._next_seq.get((channel, peer), self._first_seq)
        payload = encode(self._header(seq, t_meas_ns, now_ns), body)
        if len(payload) > self.settings.max_bytes:
            raise OversizeError(f"message takes {len(payload)} of max_bytes = {self.settings.max_bytes}")
        self._count_from(channel, peer, seq + 1)
        self.counters["sent"] += 1
        self.counters["sent_bytes"] += len(payload)
        return Packet(self.robot, channel, peer, payload)

    def _count_from(self, channel: str, peer: str | None, seq: int) -> None:
        """Remember the next number to a destination; beyond the bound the robot written to longest ago is forgotten."""
        self._next_seq.pop((channel, peer), None)
        self._next_seq[channel, peer] = seq
        if len(self._next_seq) > MAX_DESTINATIONS:
            oldest = next(where for where in self._next_seq if where[1] is not None)
            self._first_seq = max(self._first_seq, self._next_seq.pop(oldest))

    def tick(self, now_ns: int) -> tuple[list[Packet], list[PeerChange]]:
        """The hello if it is due, and the peers that fell silent, by id."""
        packets = []
        due_ns, period_ns = self._hello_due_ns, self.settings.hello_period_ns
        # A due time beyond one period means that our own clock was set back.
        if due_ns is None or now_ns >= due_ns or due_ns - now_ns > period_ns:
            packets.append(self.broadcast(now_ns, Channel.HELLO, now_ns, Hello(self.software, self._echoes())))
            told = ((peer.robot, notice) for peer in self._table.sorted() for notice in peer.notices())
            packets += [self.send(now_ns, peer, now_ns, notice) for peer, notice in told]
            on_time = due_ns is not None and 0 <= now_ns - due_ns < period_ns
            self._hello_due_ns = period_ns + (due_ns if on_time and due_ns is not None else now_ns)
        changes = [_change(peer) for peer in self._table.silence(now_ns)]
        return packets, changes

    def next_deadline_ns(self) -> int:
        """When `tick` next has something to do, as far as is known now."""
        if self._hello_due_ns is None:
            return 0
        silence_ns = self._table.next_silence_ns()
        return self._hello_due_ns if silence_ns is None else min(self._hello_due_ns, silence_ns)

    def _echoes(self) -> tuple[ClockEcho, ...]:
        """Echoes for the neighbours that are up; in turns if there are more than fit."""
        up = [peer for peer in self._table.sorted() if peer.up]
        if len(up) > MAX_ECHOES:
            first = self._echo_turn % len(up)
            self._echo_turn = first + MAX_ECHOES
            up = sorted((up + up)[first : first + MAX_ECHOES], key=lambda peer: peer.robot)
        return tuple(ClockEcho(peer.robot, peer.sent_ns, peer.heard_ns) for peer in up)

    # --- in -----------------------------------------------------------------------------------------------

    def receive(self, now_ns: int, packet: Packet) -> list[Delivery | PeerChange | ClockChange | PeerDoubled]:
        """What a packet means to the layer above: nothing, a change of its sender, a message, or both."""
        self.counters["received"] += 1
        self.counters["received_bytes"] += len(packet.payload)
        self._clock_changes, self._doubled = [], []
        try:
            return [*self._receive(now_ns, packet), *self._clock_changes]
        except WireError as error:
            self.counters[f"rejected.{error.reason}"] += 1
            peer = self._table.get(packet.source)
            if peer is not None:
                peer.counters["rejected"] += 1
            return [*self._clock_changes, *self._doubled]

    def _receive(self, now_ns: int, packet: Packet) -> list[Delivery | PeerChange | PeerDoubled]:
        message = self._admissible(packet)
        header, body = message.header, message.body
        fresh: Hello | None = None
        peer = self._table.get(header.source)
        if peer is not None:
            refusal = peer.refusal(header.t_send_ns, header.boot_id, header.incarnation, packet.channel, header.seq)
            if refusal == "old_life" and peer.outlived(now_ns, header.t_send_ns, header.boot_id):
                self.counters["doubled"] += 1
                self._doubled.append(PeerDoubled(peer.robot))
            if refusal is not None and not (self.settings.accept_duplicates and refusal in REPEATED):
                raise WireError(refusal)
        if isinstance(body, Hello) and peer is not None and not peer.is_new_life(header.boot_id, header.incarnation):
            # An echo tells the clock whose stamps are about to be judged: one that was set must not lock its robot out.
            self._take_echo(now_ns, header, body, peer)
        elif isinstance(body, Hello):
            fresh = body
        if not isinstance(body, Hello) or self._knows_clock(now_ns, header, peer):
            self._check_age(now_ns, header, peer)
        doubled = peer is not None and peer.doubled(now_ns, self.settings.silent_after_ns)
        if not isinstance(body, Hello | LifeNotice):
            if doubled or self.own_life.doubled(now_ns):
                raise WireError("duplicate_robot")
            if peer is not None and peer.clock_unusable is not None:
                raise WireError("clock_unusable")
        if peer is None:
            peer = self._table.admit(now_ns, header.source, header.boot_id, header.incarnation)
            if peer is None:
                raise WireError("too_many_peers")
            if (gone := self._table.forgotten) is not None and gone.clock_unusable is not None:
                self._clock_changes.append(ClockChange(gone.robot, None))
        unusable = peer.clock_unusable
        events: list[Delivery | PeerChange | PeerDoubled] = []
        if peer.accept(now_ns, header.t_send_ns, header.boot_id, header.incarnation, packet.channel, header.seq):
            events.append(_change(peer))
            if unusable is not None and peer.clock_unusable is None:
                # A new life has a clock that nobody has judged yet.
                self.counters["clock_usable"] += 1
                self._clock_changes.append(ClockChange(peer.robot, None))
        if isinstance(body, Hello | LifeNotice):
            self.counters["hellos"] += 1
            if fresh is not None:
                self._take_echo(now_ns, header, fresh, peer)
            if isinstance(body, LifeNotice) and self.own_life.told(now_ns, peer.robot, body):
                events.append(PeerDoubled(self.robot))
        else:
            self.counters["delivered"] += 1
            known = peer.clock.at(now_ns)
            events.append(Delivery(message) if known is None else Delivery(message, *known))
        return events

    def _admissible(self, packet: Packet) -> Message:
        """The decoded message, if a packet like this may reach us at all."""
        if packet.source == self.robot:
            raise WireError("own_echo")
        if packet.destination is not None and packet.destination != self.robot:
            raise WireError("not_for_us")
        if (packet.channel == Channel.PAIR) != (packet.destination is not None):
            raise WireError("wrong_channel")
        if len(packet.payload) > self.settings.max_bytes:
            raise WireError("oversize")
        message = decode(packet.payload, packet.source)
        if not _belongs(message.body, packet.channel):
            raise WireError("wrong_channel")
        return message

    def _check_age(self, now_ns: int, header: Header, peer: Peer | None) -> None:
        """Refuse stamps outside [-offset bound, horizon], on the sender's clock as far as it is known."""
        offset_ns = 0
        if peer is not None and not peer.is_new_life(header.boot_id, header.incarnation):
            known = peer.clock.at(now_ns)
            offset_ns = 0 if known is None else known[0]
        for stamp_ns in (header.t_send_ns, header.t_meas_ns):
            age_ns = now_ns - (stamp_ns - offset_ns)
            if age_ns < -self.settings.offset_bound_ns:
                raise WireError("from_future")
            if age_ns > self.settings.horizon_ns and not self.settings.accept_stale:
                raise WireError("too_old")

    def _knows_clock(self, now_ns: int, header: Header, peer: Peer | None) -> bool:
        """Whether the clock of a message's sender is known: without that nobody can say how old a hello is."""
        if peer is None or peer.is_new_life(header.boot_id, header.incarnation):
            return False
        return peer.clock.at(now_ns) is not None

    def _take_echo(self, now_ns: int, header: Header, hello: Hello, peer: Peer) -> None:
        if len(hello.echoes) < MAX_ECHOES:
            peer.told_whom_it_hears(now_ns, any(echo.peer == self.robot for echo in hello.echoes))
        # Those of stamps that another process of our id has sent are of its clock.
        for echo in () if self.own_life.doubled(now_ns) else hello.echoes:
            if echo.peer == self.robot and not peer.clock.add(echo.t1_ns, echo.t2_ns, header.t_send_ns, now_ns):
                self.counters["clock_refused"] += 1
                peer.counters["clock_refused"] += 1
        settings = self.settings
        reason = None
        if not settings.trust_clocks:
            reason = peer.clock.unusable(now_ns, settings.clock_sigma_ns, settings.max_clock_sigma_ns)
        if reason != peer.clock_unusable:
            peer.clock_unusable = reason
            self.counters["clock_unusable" if reason is not None else "clock_usable"] += 1
            self._clock_changes.append(ClockChange(peer.robot, reason))

    # --- for people ---------------------------------------------------------------------------------------

    def peers(self, now_ns: int = 0) -> tuple[PeerStatus, ...]:
        """Everybody ever heard and not forgotten, by id, as it is at `now_ns`."""
        return tuple(
            PeerStatus(
                peer.robot,
                peer.up,
                peer.incarnation,
                peer.boot_id,
                peer.heard_ns,
                peer.clock.offset_ns,
                peer.clock.sigma_ns,
                peer.clock.steps,
                peer.clock_unusable,
                dict(peer.counters),
                peer.silence_max_ns,
                peer.doubled_ns is not None,
                peer.hears_us(now_ns, self.settings.silent_after_ns),
            )
            for peer in self._table.sorted()
        )


def _change(peer: Peer) -> PeerChange:
    return PeerChange(peer.robot, peer.up, peer.incarnation, peer.boot_id)


def _belongs(body: Body, channel: str) -> bool:
    """Whether a body of this type may travel on this channel."""
    if isinstance(body, Hello):
        return channel == Channel.HELLO
    if isinstance(body, LifeNotice | PairRequest | PairReply | SplitRequest | SplitReply | StartRequest):
        return channel == Channel.PAIR
    if isinstance(body, LeaderRequest):
        return channel == Channel.PAIR
    if isinstance(body, LeaderReport) and body.answers is not None:
        return channel == Channel.PAIR
    return channel == Channel.BELIEF
