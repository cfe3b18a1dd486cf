"""Who is out there: duplicates refused, lives told apart, silence noticed.

A life of a robot is a pair (incarnation, boot id). A new life has another boot id, not superseded before, and a higher
incarnation, or the same one if it was sent later than everything heard of the present life: without the last condition
a straggler of a boot that ended before we first listened would supersede the living one for good.
Messages of earlier lives are refused. An earlier life that goes on sending after the next has begun means that two
processes bear one id: which of them is the robot nobody can know, so neither is believed until one is silent. Both are
told. If it is the present life that has fallen silent, the other one begins a new life (`network.own_life`).
"""

from __future__ import annotations

from collections import Counter, deque

from network.clock import PeerClock
from network.life_messages import LifeNotice

WINDOW = 1024
DOUBLED_AFTER = 3
"""So many messages on end, sent by one former boot after the present life has begun, are no stragglers."""
MAX_PEERS = 64
MAX_BOOT_IDS = 16
"""Superseded boot ids remembered per peer; sixteen restarts outlast every message still under way."""

_MASK = (1 << WINDOW) - 1


class DuplicateWindow:
    """Sequence numbers seen of one sender's channel, over the latest `WINDOW` of them."""

    __slots__ = ("_highest", "_seen")

    def __init__(self) -> None:
        self._highest = -1
        self._seen = 0

    def refusal(self, seq: int) -> str | None:
        """Why `seq` is refused, "duplicate" or "too_old_seq", or None; nothing is recorded."""
        behind = self._highest - seq
        if behind < 0:
            return None
        if behind >= WINDOW:
            return "too_old_seq"
        return "duplicate" if self._seen >> behind & 1 else None

    def record(self, seq: int) -> None:
        """Remember that `seq` was accepted."""
        ahead = seq - self._highest
        if ahead <= 0:
            self._seen |= 1 << -ahead & _MASK
        else:
            self._seen = 1 if ahead >= WINDOW else (self._seen << ahead | 1) & _MASK
            self._highest = seq


class Peer:
    """One robot heard: its life, when it was last heard, its clock, and what was counted."""

    def __init__(self, robot: str, boot_id: int, incarnation: int) -> None:
        self.robot = robot
        self.boot_id = boot_id
        self.incarnation = incarnation
        self.up = False
        self.heard_ns = 0
        self.sent_ns = 0
        self.silence_max_ns = 0
        """Longest time between two messages."""
        self._latest_sent_ns = -1
        self._began_ns: int | None = None
        self._outlived = 0
        self.doubled_ns: int | None = None
        self._other: int | None = None
        self._other_heard = False
        self._unheard_ns: int | None = None
        self.clock = PeerClock()
        self.clock_unusable: str | None = None
        self.counters: Counter[str] = Counter()
        self._superseded: deque[int] = deque(maxlen=MAX_BOOT_IDS)
        self._windows: dict[str, DuplicateWindow] = {}

    def is_new_life(self, boot_id: int, incarnation: int) -> bool:
        """Whether a message of this life begins a new one; meaningful only if it is not of an old life."""
        return (boot_id, incarnation) != (self.boot_id, self.incarnation)

    def is_old_life(self, boot_id: int, incarnation: int, t_send_ns: int) -> bool:
        """Whether a message of this life comes from before the present one."""
        if boot_id == self.boot_id:
            # A boot has one incarnation; another one is damage.
            return incarnation != self.incarnation
        if incarnation != self.incarnation:
            return incarnation < self.incarnation or boot_id in self._superseded
        return boot_id in self._superseded or t_send_ns <= self._latest_sent_ns

    def refusal(self, t_send_ns: int, boot_id: int, incarnation: int, channel: str, seq: int) -> str | None:
        """Why a message is refused, or None: "old_life", "duplicate", "too_old_seq". Nothing is recorded."""
        if self.is_old_life(boot_id, incarnation, t_send_ns):
            return "old_life"
        window = self._windows.get(channel)
        if window is None or self.is_new_life(boot_id, incarnation):
            return None
        return window.refusal(seq)

    def outlived(self, now_ns: int, t_send_ns: int, boot_id: int) -> bool:
        """Take a message of a former life; True if by it two processes are seen to bear this robot's id."""
        if self._began_ns is None or t_send_ns <= self._began_ns or boot_id == self.boot_id:
            return False
        # Damaged messages are of another boot each.
        self._outlived = self._outlived + 1 if boot_id == self._other else 1
        self._other = boot_id
        if self._outlived < DOUBLED_AFTER:
            return False
        first, self.doubled_ns, self._other_heard = self.doubled_ns is None, now_ns, True
        return first

    def notices(self) -> list[LifeNotice]:
        """What to tell the processes that bear this robot's id, once the former one has been heard again."""
        heard, self._other_heard = self._other_heard, False
        if self._other is None or not heard:
            return []
        told = [LifeNotice(self._other, self.incarnation, not self.up)]
        return [*told, LifeNotice(self.boot_id, self.incarnation, False)] if self.up else told

    def told_whom_it_hears(self, now_ns: int, us: bool) -> None:
        """Take from one of its hellos, which tells all that it hears, whether we are among them."""
        if us:
            self._unheard_ns = None
        elif self._unheard_ns is None:
            self._unheard_ns = now_ns

    def hears_us(self, now_ns: int, silent_after_ns: int) -> bool:
        """Whether it does as far as is known: a link may work in one direction alone."""
        return not self.up or self._unheard_ns is None or now_ns - self._unheard_ns < silent_after_ns

    def doubled(self, now_ns: int, silent_after_ns: int) -> bool:
        """Whether two processes bear this robot's id: until the former one is silent for `silent_after_ns`."""
        if self.doubled_ns is not None and not 0 <= now_ns - self.doubled_ns < silent_after_ns:
            self.doubled_ns, self._outlived = None, 0
        return self.doubled_ns is not None

    def accept(self, now_ns: int, t_send_ns: int, boot_id: int, incarnation: int, channel: str, seq: int) -> bool:
        """Record a message that was not refused; True if the peer came up or began a new life with it."""
        changed = not self.up
        if self.is_new_life(boot_id, incarnation):
            self._superseded.append(self.boot_id)
            self.boot_id, self.incarnation = boot_id, incarnation
            self._windows.clear()
            self._latest_sent_ns = -1
            self._began_ns = t_send_ns
            if boot_id == self._other:
                self._outlived, self._other_heard = 0, False
            self.clock, self.clock_unusable = PeerClock(), None
            self.counters["lives"] += 1
            changed = True
        if self._began_ns is None:
            self._began_ns = t_send_ns
        if changed:
            self._unheard_ns = None
        self._windows.setdefault(channel, DuplicateWindow()).record(seq)
        if self.counters["accepted"]:
            self.silence_max_ns = max(self.silence_max_ns, now_ns - self.heard_ns)
        self.up = True
        self.heard_ns, self.sent_ns = now_ns, t_send_ns
        self._latest_sent_ns = max(self._latest_sent_ns, t_send_ns)
        self.counters["accepted"] += 1
        return changed


class PeerTable:
    """At most `MAX_PEERS` peers. Full, it forgets the one silent longest, if silent for `forget_after_ns`."""

    def __init__(self, silent_after_ns: int, forget_after_ns: int) -> None:
        self.silent_after_ns = silent_after_ns
        self.forget_after_ns = forget_after_ns
        self._peers: dict[str, Peer] = {}
        self.forgotten: Peer | None = None
        """Who had to go for the peer that was admitted last, if anybody."""

    def get(self, robot: str) -> Peer | None:
        return self._peers.get(robot)

    def admit(self, now_ns: int, robot: str, boot_id: int, incarnation: int) -> Peer | None:
        """A new entry for a robot not in the table, or None if there is no room."""
        self.forgotten = None
        if len(self._peers) >= MAX_PEERS:
            oldest = min(self._peers.values(), key=lambda peer: (peer.heard_ns, peer.robot))
            if oldest.up or now_ns - oldest.heard_ns < self.forget_after_ns:
                return None
            self.forgotten = self._peers.pop(oldest.robot)
        peer = Peer(robot, boot_id, incarnation)
        self._peers[robot] = peer
        return peer

    def silence(self, now_ns: int) -> list[Peer]:
        """The peers that fell silent by now, by id; each is told once."""
        silent = []
        for peer in self.sorted():
            # Our own clock may be set back; the wait then starts over instead of growing by the step.
            peer.heard_ns = min(peer.heard_ns, now_ns)
            if peer.up and now_ns - peer.heard_ns >= self.silent_after_ns:
                peer.up = False
                peer.doubled(now_ns, self.silent_after_ns)
                # Whatever its clock said may have changed unseen.
                peer.clock = PeerClock()
                silent.append(peer)
        return silent

    def next_silence_ns(self) -> int | None:
        """When the next peer falls silent if nothing is heard; None if nobody is up."""
        heard = [peer.heard_ns for peer in self._peers.values() if peer.up]
        return min(heard) + self.silent_after_ns if heard else None

    def sorted(self) -> list[Peer]:
        """All peers by id."""
        return [self._peers[robot] for robot in sorted(self._peers)]
