"""Every interleaving of the messages of three robots whose contacts overlap: an explicit-state search over real nodes.

A state is reached by a path of choices and made again from it, so that paths can be replayed with one noise at a time:
with known headings all is linear, and the responses of the estimates give the true joint covariance of their errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.events import Observation, Odometry
from agent.node import Node, Outgoing
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings
from network.endpoint import EndpointSettings
from network.messages import Channel, Packet
from sim.invariants import InvariantChecker
from tests.agent.team_story import COVS, DELTA, NOISE, PLACES, R

Array = NDArray[np.float64]
Noise = tuple[tuple[str, ...], Array] | None
Choice = tuple[str, int]
"""What befalls the waiting packet of that number: it `arrives`, is `lost`, or arrives and comes `again`; or `time`."""

Contacts = tuple[tuple[str, str], ...]
CHAIN: Contacts = (("r1", "r2"), ("r2", "r3"))
TRIANGLE: Contacts = (*CHAIN, ("r1", "r3"))
"""Who measures whom, all at one instant."""

TIMES = 1
"""How often time may pass: requests are repeated then."""


class Fleet:
    """Three nodes that have moved for a second and measured each other; their packets wait."""

    def __init__(self, form: Any, contacts: Contacts, noise: Noise = None, check: bool = True) -> None:
        self._noise, self._check = noise, InvariantChecker(0) if check else None
        localization = LocalizationSettings(
            form=form, transform="jacobian", pair_interval_ns=0, pair_timeout_ns=NS
        )
        self.nodes = {
            name: Node(
                AgentSettings(
                    name,
                    0,
                    np.array(place) + self._off(3, "start", name),
                    COVS[name],
                    localization=localization,
                    lateness=LatenessSettings(horizon_ns=60 * NS),
                    track=False,
                ),
                EndpointSettings(hello_period_ns=10**15),
                boot_id=1,
                incarnation=1,
                software="",
            )
            for name, place in PLACES.items()
        }
        self.waiting: list[Packet] = []
        self.now_ns = self.times = 0
        for name in self.nodes:
            for packet in self.nodes[name].endpoint.tick(0)[0]:
                for other in self.nodes:
                    if other != name:
                        self.nodes[other].on_packet(0, packet)
        self._pass_time()
        truth = {name: _moved(np.array(place)) for name, place in PLACES.items()}
        for observer, subject in contacts:
            heading = truth[observer][2]
            turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
            z = turn @ (truth[subject] - truth[observer])[:2] + self._off(2, "z", observer, subject)
            event = Observation(self.now_ns, self.now_ns, "vector", subject, z, R, "camera")
            self._take(observer, self.nodes[observer].on_event(event))

    def _off(self, size: int, *name: str) -> Array:
        return self._noise[1] if self._noise is not None and self._noise[0] == name else np.zeros(size)

    def _take(self, robot: str, out: Outgoing) -> None:
        if self._check is not None:
            self._check.after(self.nodes[robot], self.now_ns, "a choice", None)
        self.waiting += [packet for packet in out.packets if packet.channel == Channel.PAIR]

    def _pass_time(self) -> None:
        before, self.now_ns, self.times = self.now_ns, self.now_ns + NS, self.times + 1
        for name, node in self.nodes.items():
            delta = DELTA + self._off(4, "odometry", name, str(self.times))
            self._take(name, node.on_event(Odometry(self.now_ns, before, self.now_ns, delta, NOISE)))

    def choices(self) -> list[Choice]:
        found = [(fate, index) for index in range(len(self.waiting)) for fate in ("arrives", "lost", "again")]
        return found + ([("time", 0)] if self.times <= TIMES else [])

    def choose(self, choice: Choice) -> None:
        fate, index = choice
        if fate == "time":
            self._pass_time()
            return
        packet = self.waiting[index] if fate == "again" else self.waiting.pop(index)
        if fate != "lost":
            assert packet.destination is not None
            self._take(packet.destination, self.nodes[packet.destination].on_packet(self.now_ns, packet))

    def finish(self) -> None:
        """All that still waits arrives, the oldest first."""
        while self.waiting:
            self.choose(("arrives", 0))

    def key(self) -> bytes:
        """Equal for states with the same future."""
        digest = blake2b(digest_size=16)
        for name, node in self.nodes.items():
            state = node.agent.filter.state
            digest.update(name.encode() + state.mean.tobytes() + state.cov.tobytes())
            digest.update(repr(sorted(node.agent.filter.contacts().items())).encode())
            found = node.agent.filter
            exchanges = found._exchanges if hasattr(found, "_exchanges") else found._pairs._exchanges
            for peer, exchange in sorted(exchanges.items()):
                digest.update(f"{peer}{_pending(exchange)}".encode())
            saved = node.agent.saved()
            digest.update(saved or b"")
        for packet in sorted((packet.destination or "").encode() + packet.payload for packet in self.waiting):
            digest.update(packet)
        digest.update(str(self.times).encode())
        return digest.digest()

    def means(self) -> Array:
        return np.concatenate([node.agent.filter.state.mean[:2] for node in self.nodes.values()])


def _pending(exchange: Any) -> str:
    """What an exchange waits for and has answered."""
    if hasattr(exchange, "_answered"):
        return f"{list(exchange._pending)} {list(exchange._answered)}"
    reply = exchange.last_reply
    return f"{exchange.pending and exchange.pending.epoch} {reply and (reply.epoch, reply.status)}"


def _moved(place: Array) -> Array:
    cos, sin = np.cos(place[2]), np.sin(place[2])
    return place + np.array([cos * DELTA[0] - sin * DELTA[1], sin * DELTA[0] + cos * DELTA[1], 0.0])


def replay(
    form: str, contacts: Contacts, path: tuple[Choice, ...], noise: Noise = None, check: bool = False
) -> Fleet:
    fleet = Fleet(form, contacts, noise, check)
    for choice in path:
        fleet.choose(choice)
    return fleet


def noises(contacts: Contacts) -> Iterator[Noise]:
    """Every independent noise, as what it adds and where."""
    for name, cov in COVS.items():
        for column in np.linalg.cholesky(cov).T[:2]:
            yield ("start", name), column
        for k in range(1, TIMES + 2):
            for column in range(2):
                yield ("odometry", name, str(k)), np.sqrt(NOISE[column, column]) * np.eye(4)[column]
    for contact in contacts:
        for column in np.linalg.cholesky(R).T:
            yield ("z", *contact), column


def slack(form: str, contacts: Contacts, path: tuple[Choice, ...]) -> dict[str, float]:
    """By robot the smallest eigenvalue of what it claims of its place beyond the true covariance."""

    def end(noise: Noise) -> Fleet:
        fleet = replay(form, contacts, path, noise)
        fleet.finish()
        return fleet

    still = end(None)
    rest = still.means()
    # What odometry says differs from what happened: the response to it is that of the error.
    E = np.stack([end(noise).means() - rest for noise in noises(contacts)], axis=1)
    found = {}
    for index, (name, node) in enumerate(still.nodes.items()):
        rows = E[2 * index : 2 * index + 2]
        claimed = node.agent.filter.state.cov[:2, :2]
        found[name] = float(np.linalg.eigvalsh(claimed - rows @ rows.T)[0])
    return found


@dataclass(slots=True)
class Search:
    """What was found: states told apart, leaves, and the worst a robot claimed too little at a leaf [m^2]."""

    states: int = 0
    leaves: int = 0
    checked: int = 0
    worst: float = np.inf
    where: tuple[Choice, ...] = ()
    _seen: set[bytes] = field(default_factory=set)


def search(form: str, contacts: Contacts, depth: int, every: int = 1) -> Search:
    """All paths of `depth` choices, states that are met again left out; the claims are checked at every so many leaves.

    Raises `InvariantBreach` if a robot breaks one on the way.
    """
    found = Search()
    layer: list[tuple[Choice, ...]] = [()]
    for level in range(depth + 1):
        following: list[tuple[Choice, ...]] = []
        for path in layer:
            fleet = replay(form, contacts, path, check=True)
            key = fleet.key()
            if key in found._seen:
                continue
            found._seen.add(key)
            found.states += 1
            choices = fleet.choices() if level < depth else []
            if choices:
                following += [(*path, choice) for choice in choices]
                continue
            found.leaves += 1
            if found.leaves % every == 0:
                found.checked += 1
                lowest = min(slack(form, contacts, path).values())
                if lowest < found.worst:
                    found.worst, found.where = lowest, path
        layer = following
    return found
