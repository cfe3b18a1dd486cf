"""What must be true of a robot after every event, whatever happens to the fleet. It looks and never touches.

The engine asks after every event of a robot; tests, benchmarks and users may ask as well. A breach stops the run and
says what was broken, by whom, when, and how to see it again.

    covariance    covariances of robot and tracks are finite, symmetric and positive definite
    time          the instant of the estimate never goes back within a life
    sequence      numbers of messages sent rise by one, for each channel and destination (anew, for one forgotten)
    books         what the endpoint received is what it delivered, hellos and refusals
    bounds        every buffer keeps within its stated bound
    contacts      with factors, the last contact of a pair never becomes an earlier one within a life
    once          no contact is used twice within a life
    information   without information a pose gets no surer: motion keeps the volume of its uncertainty and adds noise
    split         private and shared parts of a covariance are positive semi-definite and add up to it
    counters      no counter falls, and there are only so many
    deadlines     no robot waits for an instant that is past, again and again
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.auto_filter import AutoFilter
from agent.effects import Estimate
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.motion import UNICYCLE_GAINS
from agent.factor_filter import FactorFilter
from agent.naming_filter import NamingFilter
from agent.node import Node, Outgoing
from agent.replica_filter import ReplicaFilter
from agent.split_filter import SplitFilter
from network.endpoint import MAX_DESTINATIONS
from network.messages import Epoch
from network.peers import MAX_PEERS
from network.wire import peek_header

Array = NDArray[np.float64]

MAX_COUNTERS = 256
ROUNDING = 1e-9

LEARNING = ("pair.applied", "pair.quarantined", "pair.gated", "start.", "track.", "team.", "leader.")
"""Counters that tell of information used besides those of the NIS, or of an instant it was looked at for.

Motion up to such an instant and from there is not quite the motion over the whole step.
"""

USED = ("pair.applied_initiator", "pair.applied_responder")
"""Counters of contacts that were used."""


class InvariantBreach(AssertionError):
    """An invariant does not hold; `rule` is its name."""

    def __init__(self, rule: str, robot: str, seed: int, t_ns: int, event: str, what: str, replay: str) -> None:
        self.rule, self.robot, self.seed, self.t_ns = rule, robot, seed, t_ns
        again = f", replay it with: {replay}" if replay else ""
        super().__init__(f"{rule}: {robot} at {t_ns * 1e-9:.6f} s, after {event}: {what}; seed {seed}{again}")


@dataclass(slots=True, eq=False)
class _Life:
    """What was seen of one life of a robot."""

    node: Node
    t_ns: int = -(2**62)
    sent: dict[tuple[str, str | None], int] = field(default_factory=dict)
    contacts: dict[str, Epoch] = field(default_factory=dict)
    used: set[tuple[str, Epoch]] = field(default_factory=set)
    peers: dict[str, tuple[int, int]] = field(default_factory=dict)
    counted: dict[str, int] = field(default_factory=dict)
    learnt: int = 0
    volume: float = 0.0
    form: object = None
    due_ns: int = -(2**62)
    at_once: int = 0


SPIN_NS, MOST_AT_ONCE = 1_000, 100
"""A robot whose timers go off so often within so little time each waits for what does not come."""


class InvariantChecker:
    """Checks the robots of one run; `replay` is the command line that plays it again, if somebody knows it."""

    def __init__(self, seed: int, replay: str = "") -> None:
        self._seed, self._replay = seed, replay
        self._lives: dict[str, _Life] = {}
        self.checked = 0
        """Events after which all held."""

    def after(self, node: Node, t_ns: int, event: str, out: Outgoing | None = None) -> None:
        """A robot has handled an event at `t_ns`. Raises `InvariantBreach`."""
        life = self._lives.get(node.robot)
        if life is None or life.node is not node:
            life = self._lives[node.robot] = _Life(node)
        for rule, wrong in (*_spinning(life, t_ns, event), *self._wrong(life, out)):
            raise InvariantBreach(rule, node.robot, self._seed, t_ns, event, wrong, self._replay)
        self.checked += 1

    def _wrong(self, life: _Life, out: Outgoing | None) -> Iterable[tuple[str, str]]:
        """(rule, what is wrong) of everything that is."""
        node = life.node
        estimate = node.agent.estimate()
        if estimate is not None:
            yield from _covariances(estimate)
            if estimate.t_ns < life.t_ns:
                yield "time", f"the estimate went back by {(life.t_ns - estimate.t_ns) * 1e-9:.6f} s"
            life.t_ns = estimate.t_ns
            yield from _unlearnt(life, estimate)
        yield from _split(node)
        yield from _books(node)
        yield from _bounds(node)
        yield from _contacts(life)
        yield from _counters(life)
        if out is not None:
            yield from _sent(life, out)


def _spinning(life: _Life, t_ns: int, event: str) -> Iterable[tuple[str, str]]:
    if event != "a timer":
        return
    life.at_once = life.at_once + 1 if t_ns - life.due_ns <= SPIN_NS else 0
    life.due_ns = t_ns
    if life.at_once > MOST_AT_ONCE:
        yield "deadlines", f"{life.at_once} timers in a row went off at once"


def _covariances(estimate: Estimate) -> Iterable[tuple[str, str]]:
    for name, mean, cov in (
        ("the own belief", estimate.mean, estimate.cov),
        *((f"the track of {track.target}", track.mean, track.cov) for track in estimate.tracks),
        *((f"the place of {other.peer}", other.mean, other.cov) for other in estimate.relatives),
    ):
        if not np.isfinite(mean).all():
            yield "covariance", f"the mean of {name} is not finite"
        elif not is_positive_definite(cov):
            yield "covariance", f"{name} has no Cholesky factor: {np.diagonal(cov).tolist()}"
        elif float(np.abs(cov - cov.T).max()) > ROUNDING * float(np.abs(cov).max()):
            yield "covariance", f"{name} is not symmetric"


def _unlearnt(life: _Life, estimate: Estimate) -> Iterable[tuple[str, str]]:
    """Where nothing has been learnt the determinant of the pose covariance (x, y, heading) does not fall.

    That of the position alone may: what was unsure across the track can become what is unsure along it. A `replica`
    makes its belief anew from all data, whenever any arrive, and who is `fixed` or `relative` believes what it is told.
    """
    agent = life.node.agent
    if agent.settings.localization.kind in ("replica", "fixed", "relative"):
        return
    learnt = sum(entry.count for entry in agent.nis.values())
    learnt += sum(count for name, count in agent.counters.items() if name.startswith(LEARNING))
    heading = agent.settings.layout.heading
    if heading is None:
        return
    # A pose may become surer by the gains of its odometry that it is correlated with, never both together.
    pose = list(range(len(estimate.mean))) if estimate.model == UNICYCLE_GAINS.name else [0, 1, heading]
    volume = float(np.linalg.slogdet(estimate.cov[np.ix_(pose, pose)])[1])
    form = (agent.filter, agent.filter.form()[0])
    if learnt == life.learnt and form == life.form and volume < life.volume - 1e-6:
        yield "information", f"the log determinant of the pose fell from {life.volume:.6g} to {volume:.6g} by nothing"
    life.learnt, life.volume, life.form = learnt, volume, form


def _active(node: Node) -> Any:
    """The filter that localizes, of the form that is on."""
    active: Any = node.agent.filter
    if isinstance(active, NamingFilter):
        active = active.own
    return active.active if isinstance(active, AutoFilter) else active


def _split(node: Node) -> Iterable[tuple[str, str]]:
    active = _active(node)
    if not isinstance(active, SplitFilter):
        return
    split = active.state.split
    scale = float(np.abs(split.cov).max())
    for name, part in (("private", split.private), ("shared", split.shared)):
        if float(np.linalg.eigvalsh(part)[0]) < -ROUNDING * scale:
            yield "split", f"the {name} part has a negative eigenvalue"
    if float(np.abs(split.private + split.shared - split.cov).max()) > ROUNDING * scale:
        yield "split", "the parts do not add up to the covariance"


def _books(node: Node) -> Iterable[tuple[str, str]]:
    counters = node.endpoint.counters
    refused = sum(count for name, count in counters.items() if name.startswith("rejected."))
    known = counters["delivered"] + counters["hellos"] + refused
    if counters["received"] != known:
        yield "books", f"{counters['received']} received, {known} accounted for"


def _bounds(node: Node) -> Iterable[tuple[str, str]]:
    for name, (size, bound) in node.agent.sizes().items():
        if size > bound:
            yield "bounds", f"{name} holds {size}, more than {bound}"
    if len(node.endpoint.peers()) > MAX_PEERS:
        yield "bounds", f"{len(node.endpoint.peers())} peers, more than {MAX_PEERS}"


def _contacts(life: _Life) -> Iterable[tuple[str, str]]:
    active = _active(life.node)
    newest = active.contacts()
    if isinstance(active, ReplicaFilter):
        # It is told raw data, also late ones, and keeps each once; nothing is a contact.
        return
    if isinstance(active, FactorFilter):
        for peer, epoch in newest.items():
            before = life.contacts.get(peer)
            if before is not None and epoch.met and epoch < before:
                yield "contacts", f"the last one with {peer} went back from {before} to {epoch}"
    for peer in life.node.endpoint.peers():
        # Who has begun anew, or says so, counts its contacts anew.
        if life.peers.get(peer.peer) != (begun := (peer.boot_id, peer.incarnation)):
            life.peers[peer.peer] = begun
            life.contacts.pop(peer.peer, None)
            life.used = {item for item in life.used if item[0] != peer.peer}
    counters = life.node.agent.counters
    used = sum(counters.get(name, 0) - life.counted.get(name, 0) for name in USED)
    # A contact may be used and its correlation given up at the same event.
    given_up = counters.get("pair.fallback", 0) > life.counted.get("pair.fallback", 0)
    fresh = {item for item in newest.items() if item[1] != life.contacts.get(item[0])}
    if used and not fresh and not given_up:
        yield "once", "the last contact with a peer was used again"
    again = next(iter(sorted(fresh & life.used)), None)
    if used and again is not None:
        yield "once", f"the contact {again[1]} with {again[0]} was used again"
    life.used |= fresh
    life.contacts = dict(newest)


def _counters(life: _Life) -> Iterable[tuple[str, str]]:
    agent, endpoint = life.node.agent.counters, life.node.endpoint.counters
    counted = {**agent, **{f"endpoint.{name}": count for name, count in endpoint.items()}}
    fell = next((name for name, count in life.counted.items() if counted.get(name, 0) < count), None)
    if fell is not None:
        yield "counters", f"{fell} fell from {life.counted[fell]} to {counted.get(fell, 0)}"
    if len(counted) > MAX_COUNTERS:
        yield "counters", f"{len(counted)} counters, more than {MAX_COUNTERS}"
    life.counted = counted


def _sent(life: _Life, out: Outgoing) -> Iterable[tuple[str, str]]:
    for packet in out.packets:
        header = peek_header(packet.payload)
        assert header is not None
        where = packet.channel, packet.destination
        expected = life.sent.get(where, -1) + 1
        anew = len(life.sent) >= MAX_DESTINATIONS and header.seq > expected
        if header.seq != expected and not anew:
            yield "sequence", f"number {header.seq} on {where} where {expected} was due"
        life.sent[where] = header.seq
