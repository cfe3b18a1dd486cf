"""Floods of what a peer may send: into endpoints, and into the cores of a virtual run."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from random import Random
from typing import Any, Literal

import msgpack
import numpy as np

from agent.node import Node, Outgoing
from network.endpoint import Delivery, Endpoint, EndpointSettings
from network.life_messages import Hello
from network.messages import Channel, Header, Packet
from network.peers import MAX_PEERS
from network.wire import decode, encode, peek_header
from network.wire_fields import WireError
from sim.engine import VirtualEngine
from sim.invariants import InvariantChecker
from sim.trial import open_world
from tests.fuzz.corpus import corpus, fleet
from tests.fuzz.mutations import mutated, packed, renewed

Content = Literal["refused", "strangers", "lies"]
CONTENTS: tuple[Content, ...] = ("refused", "strangers", "lies")

RECEIVERS = ("r1", "r2", "r3")
CHANNELS = (Channel.HELLO, Channel.BELIEF, Channel.PAIR, Channel.STATUS, "", "x" * 300)
SETTINGS = EndpointSettings(clock_sigma_ns=5_000_000)
MS = 1_000_000
REFRESH, FRESH = 500, 50
"""How many messages are made from the same genuine ones, and of how many to each robot."""


class EndpointFlood:
    """Endpoints of three robots that live through a flood of mutated messages, a millisecond apart."""

    def __init__(self) -> None:
        self.endpoints = {
            name: Endpoint(robot=name, boot_id=1, incarnation=1, settings=SETTINGS, software="1") for name in RECEIVERS
        }
        self.now_ns = 10**12
        self.delivered: Counter[str] = Counter()
        self._genuine = corpus()
        self._seq = 0
        self._fresh: dict[str, list[Packet]] = {}

    def play(self, seed: int, count: int) -> None:
        """Raises `AssertionError`, with what led to it, if anything but a refusal or a valid message comes out."""
        rng = Random(seed)
        for index in range(count):
            self.now_ns += MS
            if index % REFRESH == 0:
                for name, endpoint in self.endpoints.items():
                    endpoint.tick(self.now_ns)
                    self._refresh(rng, name)
            name = RECEIVERS[index % 3]
            packet = self._packet(rng, name)
            try:
                self._receive(name, packet)
            except Exception as error:
                raise AssertionError(f"seed {seed}, message {index}: {packet}") from error
        for endpoint in self.endpoints.values():
            assert_books_close(endpoint)

    def _refresh(self, rng: Random, name: str) -> None:
        """Some genuine messages as robots in their present lives would send them now to `name`."""
        lives = {peer.peer: peer for peer in self.endpoints[name].peers()}
        fresh = []
        while len(fresh) < FRESH:
            packet = rng.choice(self._genuine)
            if packet.source == name:
                continue
            self._seq += 1
            life = lives.get(packet.source)
            known = None if life is None else (life.boot_id, life.incarnation)
            payload = renewed(packet.payload, seq=self._seq, t_ns=self.now_ns, life=known)
            fresh.append(Packet(packet.source, packet.channel, packet.destination and name, payload))
        self._fresh[name] = fresh

    def _packet(self, rng: Random, name: str) -> Packet:
        genuine, other = rng.choice(self._fresh[name]), rng.choice(self._genuine)
        source, channel, destination = genuine.source, genuine.channel, genuine.destination
        payload = mutated(rng, genuine.payload, other.payload)
        lie = rng.random()
        if lie < 0.01:
            source = rng.choice(("r1", "r2", "r4", "stranger", "", "R1", "r" * 300, "r1\x00"))
        elif lie < 0.02:
            channel = rng.choice(CHANNELS)
        elif lie < 0.03:
            destination = rng.choice((None, "r1", "r9", "", "r" * 300))
        elif lie < 0.04:
            source = f"x-{rng.getrandbits(30)}"
            payload = encode(Header(source, 1, 1, 0, self.now_ns, self.now_ns), Hello("1"))
            channel, destination = Channel.HELLO, None
        return Packet(source, channel, destination, payload)

    def _receive(self, name: str, packet: Packet) -> None:
        peek_header(packet.payload)
        for item in self.endpoints[name].receive(self.now_ns, packet):
            if isinstance(item, Delivery):
                body = item.message.body
                self.delivered[type(body).__name__] += 1
                if self.delivered.total() % 50 == 0:
                    # What is let through is valid: it could be sent again as it is.
                    encode(item.message.header, body)

    def reasons(self) -> Counter[str]:
        """What became of the messages, by name."""
        total: Counter[str] = Counter()
        for endpoint in self.endpoints.values():
            total.update(outcomes(endpoint))
        return total


def outcomes(endpoint: Endpoint) -> Counter[str]:
    """What became of everything an endpoint received, by name."""
    found = Counter({"delivered": endpoint.counters["delivered"], "hellos": endpoint.counters["hellos"]})
    for name, count in endpoint.counters.items():
        if name.startswith("rejected."):
            found[name.removeprefix("rejected.")] += count
    return found


def assert_books_close(endpoint: Endpoint) -> None:
    assert endpoint.counters["received"] == outcomes(endpoint).total()
    assert_bounded(endpoint)


class Flood:
    """An intruder beside one robot, who sends it a packet every `period_ns` from `begin_ns` on.

    refused    what a robot can tell is nothing for it, whatever it knows: what the wire refuses, what is meant for
               others or comes by the wrong channel, repetitions of a second ago, stamps of other times, earlier lives;
               also under the header of a robot it knows
    strangers  hellos of ever new robots, and what is refused of them
    lies       the `compromised` robot's own valid header over a body that is changed, or another robot's
    """

    def __init__(
        self, content: Content, seed: int, receiver: str, compromised: str, begin_ns: int, period_ns: int
    ) -> None:
        self._content, self._receiver, self._compromised = content, receiver, compromised
        self._begin_ns, self._period_ns = begin_ns, period_ns
        self._rng = Random(f"{seed}/{content}/{receiver}")
        self._heard: deque[Packet] = deque(maxlen=64)
        self._old: deque[tuple[int, Packet]] = deque(maxlen=512)
        self._life: Header | None = None
        self._sent = 10**6
        self._boot_id = 0
        self.count = 0

    def seen(self, packet: Packet) -> None:
        self._heard.append(packet)
        header = peek_header(packet.payload)
        assert header is not None
        self._old.append((header.t_send_ns, packet))
        if packet.source == self._compromised:
            self._life = header

    def next_ns(self, after_ns: int) -> int | None:
        return max(self._begin_ns, after_ns + self._period_ns)

    def packet(self, t_ns: int) -> Packet | None:
        if not self._heard or self._life is None:
            return None
        self.count += 1
        match self._content:
            case "refused":
                return self._refused(t_ns)
            case "strangers":
                return self._stranger(t_ns)
            case _:
                return self._lie(t_ns)

    def _refused(self, t_ns: int) -> Packet:
        rng = self._rng
        genuine, other = rng.choice(self._heard), rng.choice(self._heard)
        match rng.randrange(8):
            case 0:
                return Packet(genuine.source, Channel.PAIR, "r9", mutated(rng, genuine.payload, other.payload))
            case 1:
                wrong = (Channel.BELIEF, self._receiver), (Channel.PAIR, None), (Channel.STATUS, None)
                channel, to = rng.choice(wrong)
                return Packet(genuine.source, channel, to, genuine.payload)
            case 2:
                return Packet(self._receiver, genuine.channel, genuine.destination, genuine.payload)
            case 3:
                old = [packet for sent_ns, packet in self._old if sent_ns < t_ns - 10**9]
                return rng.choice(old) if old else Packet(genuine.source, Channel.STATUS, None, genuine.payload)
            case 4 if genuine.channel != Channel.HELLO:
                when_ns = t_ns + rng.choice((1, -1 if t_ns > 10**10 else 1)) * rng.randrange(8 * 10**9, 10**12)
                payload = renewed(genuine.payload, seq=self._number(), t_ns=max(0, when_ns))
                return Packet(genuine.source, genuine.channel, genuine.destination, payload)
            case 5:
                message: Any = msgpack.unpackb(genuine.payload, use_list=True)
                message[0][3:7] = 0, self._number(), t_ns, t_ns
                return Packet(genuine.source, genuine.channel, genuine.destination, packed(message, b""))
        # Under a header that is valid, too: of any robot, in its present life, with a number of its own.
        payload = renewed(genuine.payload, seq=self._number(), t_ns=t_ns)
        for _ in range(20):
            changed = mutated(rng, payload, other.payload)
            try:
                decode(changed, genuine.source)
            except WireError:
                return Packet(genuine.source, genuine.channel, genuine.destination, changed)
        return Packet(genuine.source, genuine.channel, genuine.destination, b"\xc1")

    def _stranger(self, t_ns: int) -> Packet:
        rng, name = self._rng, f"x-{self._rng.getrandbits(30)}"
        if rng.random() < 0.5:
            hello = Hello("stranger")
            return Packet(name, Channel.HELLO, None, encode(Header(name, rng.getrandbits(60), 1, 0, t_ns, t_ns), hello))
        genuine = rng.choice(self._heard)
        payload = mutated(rng, genuine.payload, genuine.payload)
        return Packet(name, genuine.channel, genuine.destination, payload)

    def _lie(self, t_ns: int) -> Packet:
        rng, life = self._rng, self._life
        assert life is not None
        genuine, other = rng.choice(self._heard), rng.choice(self._heard)
        message: Any = msgpack.unpackb(genuine.payload, use_list=True)
        name = life.source if rng.random() < 0.9 else f"x-{t_ns // 10**9 % 1000}"
        body = message[2]
        if message[1] in (2, 4, 7, 9):
            # A contact that is new.
            body[0] = [t_ns - rng.randrange(10**9), name, self._number()]
        if rng.random() < 0.0005:
            # It says that it was started again, and goes on in that life.
            self._boot_id = rng.getrandbits(60)
        boot_id, t_meas_ns = self._boot_id or life.boot_id, t_ns - rng.randrange(10**8)
        message[0] = [1, name, boot_id, life.incarnation, self._number(), t_meas_ns, t_ns]
        payload = packed(message, genuine.payload)
        if rng.random() < 0.7:
            payload = _body_changed(rng, payload, other.payload)
        destination = None if genuine.destination is None else self._receiver
        return Packet(name, genuine.channel, destination, payload)

    def _number(self) -> int:
        self._sent += 1
        return self._sent


def _body_changed(rng: Random, payload: bytes, other: bytes) -> bytes:
    """The message with some of its numbers moved a little or far, or changed in any way; its header stays."""
    message: Any = msgpack.unpackb(payload, use_list=True)
    arrays = list(_arrays(message[2]))
    if arrays and rng.random() < 0.7:
        here, index = rng.choice(arrays)
        values = np.frombuffer(here[index], "<f8").copy()
        place = rng.randrange(len(values))
        values[place] = rng.choice(
            (values[place] * (1 + rng.gauss(0, 0.1)), values[place] + rng.gauss(0, 10), 1e9, -1e9, 1e-9, 0.0, 1e-308)
        )
        here[index] = values.tobytes()
        return packed(message, payload)
    changed = mutated(rng, bytes(msgpack.packb(message[2])), bytes(msgpack.packb(other)))
    return b"\x93" + bytes(msgpack.packb(message[0])) + bytes(msgpack.packb(message[1])) + changed


def _arrays(body: Any) -> Iterator[tuple[list[Any], int]]:
    """Where numbers of double precision are in a body."""
    if isinstance(body, list):
        for index, item in enumerate(body):
            if isinstance(item, bytes) and len(item) >= 8 and len(item) % 8 == 0:
                yield body, index
            yield from _arrays(item)


class LetThrough(InvariantChecker):
    """Checks all invariants, but for packets that the endpoint has refused: they are many, and reach no core."""

    def after(self, node: Node, t_ns: int, event: str, out: Outgoing | None = None) -> None:
        counters = node.endpoint.counters
        let_through = counters["delivered"] + counters["hellos"]
        if not event.startswith("a packet") or let_through != self._seen.get(node.robot):
            super().after(node, t_ns, event, out)
        self._seen[node.robot] = let_through

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._seen: dict[str, int] = {}


class CoreFlood:
    """One virtual run of five robots; r1 to r3 are flooded by an intruder each, r4 and r5 are left alone.

    `r5` is the compromised robot: it goes on sending what it should, too.
    """

    def __init__(self, form: str, content: Content | None, seed: int, duration_s: float, packets: int = 0) -> None:
        """`content` None: nobody intrudes; otherwise about `packets` are sent in all."""
        self.form, self.content, self.seed = form, content, seed
        # A hello has echoes for sixteen peers, in turns: in a crowd of strangers clocks are measured less often, which
        # would show in the estimates by some 1e-9 where clocks are not known to agree.
        made = fleet(form, duration_s, clock_sigma_s=0.005 if content == "lies" else 0.0)
        checker = LetThrough(seed) if content == "lies" else None
        self.engine = VirtualEngine(made, open_world(made, seed), seed, checker=checker)
        self.floods: list[Flood] = []
        if content is not None:
            begin_ns = 2 * 10**9
            period_ns = max(1, int((duration_s * 1e9 - begin_ns) * len(RECEIVERS) / max(packets, 1)))
            for name in RECEIVERS:
                flood = Flood(content, seed, name, "r5", begin_ns, period_ns)
                self.floods.append(flood)
                self.engine.intrude(name, flood)

    def play(self) -> None:
        """Raises what escapes, and `AssertionError` if a table grows beyond its bound."""
        while self.engine.step():
            pass
        for node in self.engine.nodes.values():
            assert_books_close(node.endpoint)
            assert_bounded(node)

    @property
    def sent(self) -> int:
        return sum(flood.count for flood in self.floods)

    def estimates(self) -> dict[str, np.ndarray]:
        """Everything the robots have estimated at every step, by name."""
        trace = self.engine.result().trace
        found = {}
        for name, own in trace.robots.items():
            found[f"{name} mean"], found[f"{name} cov"] = own.mean, own.cov
        for target, tracks in trace.targets.items():
            for name, track in tracks.items():
                found[f"{target} of {name} mean"], found[f"{target} of {name} cov"] = track.mean, track.cov
        for (name, peer), seen in trace.relatives.items():
            found[f"{peer} by {name} mean"], found[f"{peer} by {name} cov"] = seen.mean, seen.cov
        return found

    def reasons(self) -> Counter[str]:
        """What became of everything that the flooded robots received, by name."""
        total: Counter[str] = Counter()
        for name in RECEIVERS:
            total.update(outcomes(self.engine.nodes[name].endpoint))
        return total

    def decisions(self) -> Counter[str]:
        """What the cores of the flooded robots did with what was let through."""
        total: Counter[str] = Counter()
        for name in RECEIVERS:
            total.update(self.engine.nodes[name].agent.counters)
        return total


def largest_difference(one: dict[str, np.ndarray], other: dict[str, np.ndarray], among: bool = True) -> float:
    """Between two runs, of any number at any instant. `among`: what is missing must be missing in both."""
    worst = 0.0
    assert not among or one.keys() == other.keys()
    for name in one.keys() & other.keys():
        if among:
            assert np.array_equal(np.isnan(one[name]), np.isnan(other[name])), name
        apart = np.abs(one[name] - other[name])
        worst = max([worst, *map(float, apart[np.isfinite(apart)])])
    return worst


# --- bounds -----------------------------------------------------------------------------------------------

MOST = 4096
"""No table of a robot holds more than the instants of a team's history (`agent.team_history.MAX_INSTANTS`)."""

MOST_NAMED = 2 * MAX_PEERS
"""No table by robot holds more names than destinations are told apart (`network.endpoint.MAX_DESTINATIONS`)."""


def tables(root: Any) -> Iterator[tuple[str, Any]]:
    """(path, container) of every table below an object of the product."""
    seen: set[int] = set()
    stack: list[tuple[str, Any]] = [(type(root).__name__, root)]
    while stack:
        path, item = stack.pop()
        if id(item) in seen or isinstance(item, Enum | str | bytes | int | float | np.ndarray | type(None)):
            continue
        seen.add(id(item))
        if isinstance(item, dict | list | tuple | set | frozenset | deque):
            yield path, item
            parts = item.values() if isinstance(item, dict) else item
            stack.extend((f"{path}[]", part) for part in parts)
        elif type(item).__module__.split(".")[0] in ("agent", "network"):
            names = [*getattr(item, "__dict__", ())]
            names += [name for part in type(item).__mro__ for name in getattr(part, "__slots__", ())]
            if is_dataclass(item):
                names += [field.name for field in fields(item)]
            stack.extend((f"{path}.{name}", getattr(item, name)) for name in set(names) if hasattr(item, name))


def assert_bounded(root: Any) -> None:
    """Every table is small, and those by robot no larger than there may be peers."""
    for path, table in tables(root):
        assert len(table) <= MOST, f"{path} holds {len(table)}"
        if isinstance(table, dict):
            strange = sum(1 for key in table if "x-" in str(key))
            assert strange <= MOST_NAMED, f"{path} holds {strange} strangers"
