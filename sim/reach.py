"""Who can hear whom, from true positions: the only thing of the truth that links may know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from network.links import LinkSettings, hear, lowest
from sim.noise import generator
from sim.world import World


class Reach:
    """Who hears whom: pairs in radio range, with hysteresis from instant to instant, or some of them.

    Instants are asked for in order, as hysteresis needs it.
    """

    def __init__(self, world: World, settings: LinkSettings) -> None:
        self._world, self._settings = world, settings
        count = len(world.robots)
        self._in_range: NDArray[np.bool_] = np.zeros((count, count), dtype=bool)
        self._heard = self._in_range
        self._pairs: list[tuple[str, str]] = []

    def heard(self, k: int) -> NDArray[np.bool_]:
        """Who hears whom at instant k (n, n), by (source, destination); of the diagonal it says nothing."""
        settings, count = self._settings, len(self._world.robots)
        place = np.array([self._world.place(robot, k) for robot in self._world.robots])
        gaps = np.linalg.norm(place[:, None] - place[None], axis=-1)
        self._in_range = hear(self._in_range, gaps, settings.range_m, settings.hysteresis_m)
        if settings.nearest is not None:
            return lowest(np.where(self._in_range, gaps, np.inf), settings.nearest)
        if settings.rewire is not None:
            drawn = generator(settings.seed, "links", "rewire", str(k)).random((count, count))
            return lowest(np.where(self._in_range, drawn, np.inf), settings.rewire)
        return self._in_range

    def at(self, k: int) -> list[tuple[str, str]]:
        """(source, destination) pairs who hear each other at instant k."""
        heard = self.heard(k)
        if (heard != self._heard).any():
            ids = self._world.robots
            self._pairs = [(ids[a], ids[b]) for a, b in np.argwhere(heard).tolist() if a != b]
        self._heard = heard
        return self._pairs
