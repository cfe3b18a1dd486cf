"""Steering a team by what it will know: AJLATT-O (Su 2022, eq. 3.7 and 3.8).

Each robot chooses the command that, held on, makes the least of

    alpha_R tr P_i(k + t2) + sum over targets of alpha_T tr P_T(k + t2) + beta sum of J over neighbours and targets

As `published`, J is of the places at k + t1 only, neighbours and target keep 2 m off, and 20 m is far enough from a
target, though a sensor that ends at 15 m has lost it by then. `improved`, J is the mean over k ... k + t1, bodies keep
3 m off and up to 1 m more for two deviations of where they are, a target may be 1 m less far than the sensor reaches,
beliefs of targets that are told late are moved on to the present (robots are taken to be where they were when they
told: going on with old commands leads to collisions), and where nothing else differs a robot faces the nearest target.
Of several targets only the nearest can be too far then: who keeps between all sees none, once they are far apart.
Without a target the sum is left without its terms: robots keep apart and in reach, and stand still apart from that.

The cost jumps where something gets into view, so nothing is known of gradients: the best of a grid of speeds and yaw
rates is taken, then twice the best of its eight neighbours at half the spacing before. Of equal ones an `improved`
planner takes the slowest and straightest; the `published` one, whose order nobody knows, the first of the grid: a robot
that has nothing to gain stands and turns on the spot, as long as it sees nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.planning.potential import PotentialPlanner
from agent.planning.prediction import Predicted, Prediction
from agent.planning.situation import Command, Situation
from agent.planning.team_view import believers, usable
from agent.settings import PlanningSettings

Array = NDArray[np.float64]

FORBIDDEN = 1e4
"""Cost of a distance that must not be. Infinity would make all candidates alike where nothing better can be reached."""

MARGIN_M = 2.0
"""a of eq. 3.8: how far from a bound its cost begins."""

PUBLISHED_LEAST_M, LEAST_M, MOST_UNSURE_M = 2.0, 3.0, 1.0
PUBLISHED_TARGET_MOST_M = 20.0
SENSOR_MARGIN_M = 1.0

FACING = 1e-6
"""Cost [m^2/rad] of a target off the robot's nose: below whatever else a command changes."""

FEWEST = 6
"""Candidates without which there is no choice: two speeds, three yaw rates."""


def spacing_cost(distance: Array, least: Array | float, most: Array | float) -> Array:
    """J (...) of distances (...) [m] (eq. 3.8), zero from `least` + 2 m to `most` - 2 m.

    What eq. 3.8 makes infinite is large, and the larger the nearer, so that robots that are too near drive apart.
    """
    above = distance - least
    near = -10.0 * np.log(np.maximum(above, 1e-300) / MARGIN_M)
    far = 10.0 * np.maximum(distance - (most - MARGIN_M), 0.0) ** 2
    inside = FORBIDDEN * (1.0 - above)
    return np.where(above <= 0.0, inside, np.where(above <= MARGIN_M, near, far))


@dataclass(frozen=True, slots=True)
class Search:
    """Commands to try: a grid of `speeds` x (2 `speeds` - 1) yaw rates, then `rounds` of eight around the best."""

    max_speed_mps: float
    max_turn_radps: float
    speeds: int
    rounds: int
    straight: bool = True
    """Whether of equal commands the straightest is taken, not the first."""

    @classmethod
    def within(
        cls, candidates: int, max_speed_mps: float, max_turn_radps: float, straight: bool = True
    ) -> Search:
        """The search that evaluates at most so many: 5 x 9 + 8 + 8 = 61; with fewer a coarser grid, then fewer rounds.

        Raises ValueError below six.
        """
        if candidates < FEWEST:
            raise ValueError(f"planning.candidates = {candidates} leaves no choice: give at least {FEWEST}")
        rounds = min(2, (candidates - FEWEST) // 8)
        speeds = 2
        while (speeds + 1) * (2 * speeds + 1) + 8 * rounds <= candidates:
            speeds += 1
        return cls(max_speed_mps, max_turn_radps, speeds, rounds, straight)

    def best(self, cost: Callable[[Array], Array]) -> Array:
        """The command (2,) of least cost; `cost` of commands (c, 2) is (c,). Of equal ones one of the slowest."""
        n = self.speeds
        speeds, turns = np.linspace(0.0, self.max_speed_mps, n), np.linspace(-1.0, 1.0, 2 * n - 1) * self.max_turn_radps
        if self.straight:
            turns = turns[np.argsort(np.abs(turns), kind="stable")]
        grid = np.stack(np.meshgrid(speeds, turns, indexing="ij"), axis=-1).reshape(-1, 2)
        chosen, least = _least(grid, cost(grid))
        step = np.array([self.max_speed_mps, self.max_turn_radps]) / (n - 1)
        most = np.array([self.max_speed_mps, self.max_turn_radps])
        for _ in range(self.rounds):
            step = 0.5 * step
            around = np.clip(chosen + step * STENCIL, [0.0, -self.max_turn_radps], most)
            found, its_cost = _least(around, cost(around))
            if its_cost < least:
                chosen, least = found, its_cost
        return chosen


STENCIL = np.array([[v, w] for v in (-1.0, 0.0, 1.0) for w in (-1.0, 0.0, 1.0) if v or w])


def _least(commands: Array, costs: Array) -> tuple[Array, float]:
    costs = np.where(np.isfinite(costs), costs, np.inf)
    index = int(np.argmin(costs))
    return commands[index], float(costs[index])


class OptimalPlanner:
    """AJLATT-O with the search as far as `settings.candidates` reach. Raises ValueError if that is below six.

    `fallback` answers where a covariance that is to be inverted is singular.
    """

    def __init__(self, settings: PlanningSettings, fallback: PotentialPlanner) -> None:
        self._settings, self._fallback = settings, fallback
        self._improved = settings.form == "improved"
        limits = settings.max_speed_mps, settings.max_turn_radps
        self._search = Search.within(settings.candidates, *limits, straight=self._improved)

    def command(self, situation: Situation) -> Command:
        """Within the vehicle's limits; see `agent.planning.situation.Planner`."""
        try:
            speed, turn = self._search.best(Objective(self._settings, situation)).tolist()
        except np.linalg.LinAlgError:
            return self._fallback.command(situation)
        return Command(speed, turn)


class Objective:
    """The cost of commands in a situation (eq. 3.7)."""

    def __init__(self, settings: PlanningSettings, situation: Situation) -> None:
        self._settings, self._improved = settings, settings.form == "improved"
        situation = usable(situation)
        targets = believers(situation, present=self._improved)
        self._prediction = prediction = Prediction(settings, situation, targets)
        robots, sought = len(prediction.others.poses), len(prediction.targets)
        self._tracks = np.concatenate([prediction.others.track, *(target.track[None] for target in prediction.targets)])
        self._most = np.array([settings.radio_range_m] * robots + [PUBLISHED_TARGET_MOST_M] * sought)[:, None]
        # Who tells of a place far out of reach is not there; he is not to be followed.
        self._farthest = np.array([2.0 * settings.radio_range_m] * robots + [np.inf] * sought)[:, None]
        self._least = np.full((robots + sought, 1), PUBLISHED_LEAST_M)
        if self._improved:
            self._most[robots:] = np.inf
            if prediction.nearest is not None:
                self._most[robots + prediction.nearest] = settings.sensing.max_range_m - SENSOR_MARGIN_M
            covs = [*prediction.others.covs[:, :2, :2], *(target.place_cov for target in prediction.targets)]
            for index, cov in enumerate(covs):
                widest = float(np.linalg.eigvalsh(cov + situation.own.cov[:2, :2])[-1])
                self._least[index] = LEAST_M + min(2.0 * math.sqrt(max(widest, 0.0)), MOST_UNSURE_M)

    def __call__(self, commands: Array) -> Array:
        """Costs (c,) of commands (c, 2), [m/s] and [rad/s]."""
        settings = self._settings
        found = self._prediction.of(commands)
        cost = settings.self_weight * found.own + settings.target_weight * found.targets
        if settings.potential_weight > 0.0:
            cost = cost + settings.potential_weight * self._spacing(found)
        return cost + FACING * found.off_nose if self._improved else cost

    def _spacing(self, found: Predicted) -> Array:
        """Sum (c,) of J over neighbours and targets: of the last instant, or the mean over all."""
        apart = found.track[:, None] - self._tracks[None]
        if not self._improved:
            apart = apart[:, :, -1:]
        distance = np.minimum(np.hypot(apart[..., 0], apart[..., 1]), self._farthest)
        return np.asarray(spacing_cost(distance, self._least, self._most).mean(axis=2).sum(axis=1))
