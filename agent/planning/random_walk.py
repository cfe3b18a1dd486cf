"""Random motion, what other planners are compared with (RM: Su 2022, section 4.1)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from agent.planning.situation import Command, Situation


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """Full speed ahead, and a yaw rate drawn anew at each choice, uniform within the limits.

    It looks at nothing and keeps clear of nobody. The draw is named by (seed, robot, index of the choice).
    """

    robot: str
    seed: int
    max_speed_mps: float
    max_turn_radps: float

    def command(self, situation: Situation) -> Command:
        """The command of the choice `situation.index`; nothing else of the situation matters."""
        name = hashlib.blake2b(f"{self.seed}\x1f{self.robot}\x1frandom walk".encode(), digest_size=16).digest()
        draws = np.random.Philox(key=int.from_bytes(name, "little"), counter=situation.index)
        turn = np.random.Generator(draws).uniform(-self.max_turn_radps, self.max_turn_radps)
        return Command(self.max_speed_mps, float(turn))
