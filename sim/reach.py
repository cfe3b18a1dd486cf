"""Who can hear whom, from true positions: the only thing of the truth that links may know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from network.links import hear
from sim.world import World


class Reach:
    """Pairs in radio range, with hysteresis from instant to instant."""

    def __init__(self, world: World, range_m: float, hysteresis_m: float) -> None:
        self._world, self._range_m, self._hysteresis_m = world, range_m, hysteresis_m
        count = len(world.robots)
        self._heard: NDArray[np.bool_] = np.zeros((count, count), dtype=bool)
        self._pairs: list[tuple[str, str]] = []

    def at(self, k: int) -> list[tuple[str, str]]:
        """(source, destination) pairs in range at instant k; instants are asked for in order."""
        place = np.array([self._world.place(robot, k) for robot in self._world.robots])
        gaps = np.linalg.norm(place[:, None] - place[None], axis=-1)
        heard = hear(self._heard, gaps, self._range_m, self._hysteresis_m)
        if (heard != self._heard).any():
            ids = self._world.robots
            self._pairs = [(ids[a], ids[b]) for a, b in np.argwhere(heard).tolist() if a != b]
        self._heard = heard
        return self._pairs
