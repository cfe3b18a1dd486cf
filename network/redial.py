"""Which peers hang on a link that looks alive and carries nothing, and are dialled anew.

Two sides of a link can disagree about it: when one of them has stood still for longer than the lease, what it takes for
the old link may be a new one to the other, which waits for declarations that never come. Both keep it alive, so it
never ends. Who answers at its address and is not heard hangs on such a link, or says nothing; one more link cures the
one and does no harm to the other.
"""

from __future__ import annotations

from collections.abc import Iterable

MAX_PATIENCE_S = 60.0
SPARE_S = 3.0
"""A peer's own session is spare when the main one brings its packets after so long."""


class PeerWatch:
    """When each peer was last heard, on the main session and on one of its own. Instants are of any clock [s].

    Who dials a peer anyway waits `patience_s`; who is dialled waits twice as long, as one new link serves both. The
    patience doubles with every dialling in vain, up to a minute.
    """

    def __init__(self, robot: str, peers: Iterable[str], patience_s: float, now_s: float) -> None:
        self._least = {peer: patience_s if peer < robot else 2.0 * patience_s for peer in peers}
        self._patience = dict(self._least)
        self._since = dict.fromkeys(self._least, now_s)
        self._main: dict[str, float] = {}
        self._dialled: dict[str, float] = {}

    def heard(self, peer: str, now_s: float, main: bool) -> None:
        """A packet of a peer has come, over the main session or over one of its own."""
        if peer not in self._least:
            return
        self._since[peer], self._patience[peer] = now_s, self._least[peer]
        if main:
            self._main[peer] = now_s

    def wait_anew(self, now_s: float) -> None:
        """Nobody could have been heard until now."""
        self._since = dict.fromkeys(self._least, now_s)

    def overdue(self, now_s: float) -> list[str]:
        """Peers that are silent for longer than they are waited for."""
        return [peer for peer, since in self._since.items() if now_s - since > self._patience[peer]]

    def unreachable(self, peer: str, now_s: float) -> None:
        """Nothing answers at its address: it is out of reach, and its silence no riddle."""
        self._since[peer] = now_s

    def dialled(self, peer: str, now_s: float) -> None:
        """A session of its own dials the peer from now on, in place of an earlier one."""
        self._since[peer] = self._dialled[peer] = now_s
        self._patience[peer] = min(2.0 * self._patience[peer], max(MAX_PATIENCE_S, self._least[peer]))

    def spare(self) -> list[str]:
        """Peers whose own session is not needed any more; each is told once."""
        spare = [
            peer for peer, since in self._dialled.items() if self._main.get(peer, since) > since + SPARE_S
        ]
        for peer in spare:
            del self._dialled[peer]
        return spare
