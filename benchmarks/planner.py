"""One robot's choice of motion by predicted beliefs, beside the same choice with one candidate after the other."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.motion import UNICYCLE, TargetMotion
from agent.planning.optimal import Objective, Search
from agent.planning.situation import Member, Situation, TargetView
from agent.settings import PlanningSettings

Array = NDArray[np.float64]

NEIGHBOURS = 5
TARGET = TargetMotion(UNICYCLE, (0.25, 0.0), (0.0053, 0.0212))
SETTINGS = PlanningSettings(kind="optimal")


@dataclass(frozen=True, slots=True)
class Choice:
    """Medians of CPU time [s] of a choice with all candidates of a round at once, and with one after the other."""

    batch_s: float
    single_s: float


def situation() -> Situation:
    """A robot and its neighbours on a ring about a target that some of them see, all with beliefs of it."""
    members = []
    for index in range(1 + NEIGHBOURS):
        angle = 2.0 * np.pi * index / (1 + NEIGHBOURS)
        pose = np.array([8.0 * np.cos(angle), 8.0 * np.sin(angle), angle + np.pi - 0.2 * index])
        view = TargetView("t1", TARGET, np.array([0.1 * index, 0.0, 0.0]), np.diag([0.3, 0.2, 0.1]))
        members.append(Member(f"r{index}", pose, np.diag([0.1, 0.1, 0.01]), 0.3, 0.1, (view,)))
    return Situation(0, 1.0, members[0], tuple(members[1:]))


def choice(rounds: int = 40) -> Choice:
    """Both measured in turns; both must choose the same command."""
    seen = situation()
    search = Search.within(SETTINGS.candidates, SETTINGS.max_speed_mps, SETTINGS.max_turn_radps)

    def batch() -> Array:
        return search.best(Objective(SETTINGS, seen))

    def single() -> Array:
        cost = Objective(SETTINGS, seen)
        return search.best(lambda commands: np.concatenate([cost(command[None]) for command in commands]))

    assert np.array_equal(batch(), single())
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for step, taken in zip((batch, single), times, strict=True):
            begin = time.process_time()
            step()
            taken.append(time.process_time() - begin)
    return Choice(statistics.median(times[0]), statistics.median(times[1]))
