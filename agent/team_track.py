"""Where one robot of a team is known to have moved: a chain of instants with its odometry since common anchors.

What is heard late, twice or in another order leads to the same chain. Between two instants that share an anchor the
motion is known, however much was lost in between, but not the places on the way; where the chain is broken (the robot
has begun a new life) it coasts.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import symmetrize
from agent.estimation.reckoning import increment, moved_between
from agent.settings import CoastSettings
from network.messages import Reckoning

Array = NDArray[np.float64]

Life = tuple[int, int]
"""Incarnation and boot id."""

Anchor = tuple[Life, int]
"""A life and an instant of it by the robot's own clock: where sums of odometry begin."""

MAX_NODES = 8192
"""The keeper cuts its horizon short long before its own chain is as long as this."""

MAX_NAMES = 2 * MAX_NODES
MAX_SUMS = 8
"""Sums that lead to one node: a robot renews its anchor rarely."""
NO_MOTION = np.zeros(4), np.zeros((4, 4))
ROUNDING = 1e-9
"""How negative a covariance may come out of sums, relative to them."""


@dataclass(slots=True, eq=False)
class Node:
    """An instant of the chain, with the sums of odometry (4,), (4, 4) that lead to it, by anchor.

    The robot itself has it that it moved evenly since `even_ns`; before that nobody knows what is not told.
    """

    t_ns: int
    even_ns: int
    sums: dict[Anchor, tuple[Array, Array]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """How far a robot's state has been moved: to `t_ns`, by `delta` (4,) since `node`; None: it is at the node."""

    t_ns: int
    node: Node
    delta: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A stretch to `place` over `dt_s`, with the increment (4,), (4, 4) of odometry."""

    place: Place
    delta: Array
    cov: Array
    dt_s: float


class Track:
    """The chain of one robot, whose state starts at `start`. Instants are of the clock of whoever keeps it."""

    def __init__(self, start: Node, coast: CoastSettings, tolerance_ns: int, counters: Counter[str]) -> None:
        self._coast, self._tolerance_ns, self._counters = coast, tolerance_ns, counters
        self._nodes = [start]
        self._stamps = [start.t_ns]
        self._known: dict[Anchor, Node] = {}
        self.settled_ns = start.t_ns
        """Nothing is learnt any more of what was up to here."""

    @property
    def newest(self) -> Node:
        return self._nodes[-1]

    def add(self, life: Life, reckoning: Reckoning, offset_ns: int) -> int | None:
        """Take in odometry told by a robot whose clock is ahead by `offset_ns`.

        Returns the earliest instant at which the robot's motion is another one now, None if nothing is new.
        """
        anchor = (life, reckoning.anchor_ns)
        anchor_ns, even_ns = reckoning.anchor_ns - offset_ns, reckoning.before_ns - offset_ns
        node, total = Node(reckoning.t_ns - offset_ns, even_ns), (reckoning.delta, reckoning.cov)
        return _earliest(
            self._put(anchor, Node(anchor_ns, anchor_ns), anchor, NO_MOTION),
            self._put((life, reckoning.t_ns), node, anchor, total),
        )

    def begin(self, life: Life, born_ns: int, offset_ns: int) -> int | None:
        """A life begins at `born_ns` of the robot's clock; returns as `add`."""
        t_ns = born_ns - offset_ns
        return self._put((life, born_ns), Node(t_ns, t_ns), (life, born_ns), NO_MOTION)

    def _put(self, name: Anchor, new: Node, anchor: Anchor, total: tuple[Array, Array]) -> int | None:
        """Take in a sum that leads to a node which is new, unless it is known by its name or instant."""
        node = self._known.get(name)
        if node is None and len(self._known) >= MAX_NAMES:
            self._counters["replica.overflow"] += 1
            return None
        if node is None:
            index = bisect_left(self._stamps, new.t_ns)
            if index < len(self._stamps) and self._stamps[index] == new.t_ns:
                node = self._nodes[index]
            elif new.t_ns <= self.settled_ns:
                return None
            elif len(self._nodes) >= MAX_NODES:
                self._counters["replica.overflow"] += 1
                return None
            else:
                node = new
                self._nodes.insert(index, node)
                self._stamps.insert(index, node.t_ns)
            self._known[name] = node
        if anchor in node.sums:
            return None
        if len(node.sums) >= MAX_SUMS:
            self._counters["replica.overflow"] += 1
            return None
        node.sums[anchor] = total
        node.even_ns = min(node.even_ns, new.even_ns)
        before = bisect_left(self._stamps, node.t_ns) - 1
        if before < 0:
            return node.t_ns
        # Whatever counts as the instant of the node before does not depend on this one.
        return min(node.t_ns - self._tolerance_ns, self._stamps[before] + self._tolerance_ns + 1)

    def settle(self, place: Place) -> None:
        """The state has been moved to `place` for good: forget what was before."""
        index = bisect_left(self._stamps, place.node.t_ns)
        del self._nodes[:index], self._stamps[:index]
        self.settled_ns = max(self.settled_ns, place.t_ns)
        self._known = {name: node for name, node in self._known.items() if node.t_ns >= place.node.t_ns}

    # -- motion ---------------------------------------------------------------------------------------------

    def next_ns(self, place: Place) -> int | None:
        """The first instant of the chain after `place`."""
        index = bisect_right(self._stamps, place.t_ns)
        return self._stamps[index] if index < len(self._stamps) else None

    def covers(self, place: Place, t_ns: int) -> bool:
        """Whether a state at `place` can be brought to `t_ns`, give or take the tolerance, without guessing."""
        at, tolerance = place, self._tolerance_ns
        while at.t_ns < t_ns - tolerance:
            index = bisect_right(self._stamps, at.t_ns)
            if index == len(self._stamps):
                return False
            node = self._nodes[index]
            if node.t_ns > t_ns + tolerance:
                # Within what was lost a robot may have been anywhere.
                return node.even_ns <= at.node.t_ns and _shared(at.node, node) is not None
            at = Place(node.t_ns, node)
        return True

    def step(self, place: Place, until_ns: int) -> Step:
        """The next stretch from `place` towards `until_ns`, which is later: to the next instant of the chain at most.

        Where the chain is broken the stretch leads to that instant, by coasting; what `covers` an instant in between
        is gone through evenly. Raises `ValueError` at the end of the chain.
        """
        index = bisect_right(self._stamps, place.t_ns)
        if index == len(self._stamps):
            raise ValueError("the chain ends here; ask `covers` first")
        node = self._nodes[index]
        moved = self._moved(place.node, node)
        if moved is None:
            dt_s = (node.t_ns - place.t_ns) * 1e-9
            return Step(Place(node.t_ns, node), np.zeros(4), self.coasted(dt_s), dt_s)
        delta, cov = moved
        whole = node.t_ns - place.node.t_ns
        if node.t_ns <= until_ns + self._tolerance_ns:
            end = Place(node.t_ns, node)
        else:
            end = Place(until_ns, place.node, delta * ((until_ns - place.node.t_ns) / whole))
        gone = end.t_ns - place.t_ns
        target = delta if end.delta is None else end.delta
        rest = target if place.delta is None else moved_between(place.delta, target)
        return Step(end, rest, cov * (gone / whole) if gone < whole else cov, gone * 1e-9)

    def coasted(self, time_s: float) -> Array:
        """Covariance (4, 4) of where a robot may be after a time of which nothing is known."""
        spread, turn = (self._coast.speed_mps * time_s) ** 2, (self._coast.yaw_rate_radps * time_s) ** 2
        return np.diag([spread, spread, spread, turn])

    def _moved(self, first: Node, second: Node) -> tuple[Array, Array] | None:
        """The increment between two nodes; None if no anchor tells it."""
        anchor = _shared(first, second)
        if anchor is None:
            return None
        delta, cov = increment(*first.sums[anchor], *second.sums[anchor])
        values, vectors = np.linalg.eigh(cov)
        if values[0] >= 0.0:
            return delta, cov
        if values[0] < -ROUNDING * float(np.abs(second.sums[anchor][1]).max()) - 1e-15:
            # Not of one odometry: whoever told it is wrong somewhere.
            self._counters["replica.bad_odometry"] += 1
            return None
        # What sums leave of an exact zero, or a little more after a long time, is rounding.
        return delta, symmetrize((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _shared(first: Node, second: Node) -> Anchor | None:
    """The latest anchor both nodes have a sum of."""
    return max(first.sums.keys() & second.sums.keys(), default=None)


def _earliest(*instants: int | None) -> int | None:
    return min((t_ns for t_ns in instants if t_ns is not None), default=None)
