"""What neighbours told of one instant, at another one, with the settings of one robot (`agent.estimation.ageing`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.course import Moment
from agent.estimation.ageing import place_at_age, pose_at_age, target_at_age
from agent.estimation.jlatt import Placed
from agent.estimation.motion import STATES, TargetMotion
from agent.rounds import Told
from agent.settings import AgentSettings
from network.messages import Belief, RoundReport

Array = NDArray[np.float64]


class Carrier:
    """Ages are in nanoseconds, and may be negative; those within the tolerance of stamps are none."""

    def __init__(self, settings: AgentSettings) -> None:
        self._period_s = settings.round.period_ns * 1e-9
        self._tolerance_ns = settings.lateness.tolerance_ns
        self._transform = settings.localization.transform
        self._motions: dict[str, TargetMotion] = {target.id: target.motion for target in settings.targets}

    def _seconds(self, age_ns: int) -> float:
        return 0.0 if abs(age_ns) <= self._tolerance_ns else age_ns * 1e-9

    def belief(self, told: Told[RoundReport], t_ns: int) -> Belief:
        """A peer's belief of its pose at `t_ns`."""
        report, age_s = told.report, self._seconds(t_ns - told.t_ns)
        if age_s == 0.0:
            return report.belief
        model, own = report.belief.model, report.belief
        moved = pose_at_age(
            STATES[model], own.mean, own.cov, report.velocity, report.yaw_rate, age_s, self._period_s
        )
        return Belief(model, *moved)

    def target(self, target: str, belief: Belief, age_ns: int) -> tuple[Array, Array]:
        """A belief of a target, mean (n,) and cov (n, n), `age_ns` later."""
        age_s = self._seconds(age_ns)
        return target_at_age(self._motions[target], belief.mean, belief.cov, age_s, self._transform)

    def placed(self, target: str, item: Placed, track: Moment, age_ns: int) -> Placed:
        """A target's place by a sensor, `age_ns` later: it goes on as the target does by the belief `track`."""
        age_s = self._seconds(age_ns)
        return place_at_age(self._motions[target], item, track.mean, track.cov, age_s, self._transform)
