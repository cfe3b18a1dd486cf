"""What peers say of the own life: whether another process bears our id, and whether our life is over.

Peers that have heard a later life refuse ours for good (`network.peers`). While the other process sends, nobody
believes either of us, and neither of us uses what peers send: which of the two they mean nobody can know. Once it is
silent a new life is due, later than the one that peers go on with, in which nothing is left that they might rely on.

A life lasts `MIN_LIFE_NS` at least: at that pace two processes take turns that some peers hear only one of.
"""

from __future__ import annotations

from network.life_messages import LifeNotice

MIN_LIFE_NS = 10_000_000_000
MAX_INCARNATION = 2**40
"""Higher numbers are not taken from peers: no stranger uses up those that are left."""


class OwnLife:
    """Notices of peers, each good for `silent_after_ns`."""

    def __init__(self, boot_id: int, incarnation: int, silent_after_ns: int) -> None:
        self._boot_id, self._incarnation, self._silent_after_ns = boot_id, incarnation, silent_after_ns
        self._began_ns: int | None = None
        self._told: dict[str, tuple[int, LifeNotice]] = {}

    def told(self, now_ns: int, peer: str, notice: LifeNotice) -> bool:
        """Take a notice of a peer that is known; whether it is meant for this process."""
        if notice.boot_id != self._boot_id or notice.incarnation > max(self._incarnation, MAX_INCARNATION):
            return False
        self._told[peer] = now_ns, notice
        return True

    def doubled(self, now_ns: int) -> bool:
        """Whether another process bears our id, or peers go on with the life of one."""
        return bool(self._fresh(now_ns))

    def next_incarnation(self, now_ns: int) -> int | None:
        """The number of a new life, if one is due; to be asked from the first instant of this one on."""
        if self._began_ns is None or now_ns < self._began_ns:
            self._began_ns = now_ns
        fresh = self._fresh(now_ns)
        if not fresh or not all(notice.over for notice in fresh) or now_ns - self._began_ns < MIN_LIFE_NS:
            return None
        return max(self._incarnation, *(notice.incarnation for notice in fresh)) + 1

    def _fresh(self, now_ns: int) -> list[LifeNotice]:
        if self._told:
            self._told = {
                peer: (at_ns, notice)
                for peer, (at_ns, notice) in self._told.items()
                if 0 <= now_ns - at_ns < self._silent_after_ns
            }
        return [notice for _, notice in self._told.values()]
