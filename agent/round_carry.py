"""What neighbours have told of one instant, carried to another one (Su 2022, eq. 2.6, 2.7; what is told is late).

Nobody knows how a peer has moved since it told, but how fast it went. Its pose is moved on with that, and its
covariance grows with the time; by its square, for an unknown velocity lasts. A target is moved on
by its model, and so is the place where a sensor has seen it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.course import Moment
from agent.estimation.gaussian import symmetrize, wrap_components
from agent.estimation.jlatt import Placed
from agent.estimation.motion import STATES, TargetMotion
from agent.rounds import Told
from agent.settings import AgentSettings
from network.messages import Belief

Array = NDArray[np.float64]

AWAY_M, TURNED_RAD = 0.15, 0.2
"""Standard deviations of what a peer may have done otherwise in one round, in each direction and in heading."""


class Carrier:
    """Carries with the settings of one robot. Ages are in nanoseconds, and may be negative."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._motions: dict[str, TargetMotion] = {target.id: target.motion for target in settings.targets}

    def _fresh(self, age_ns: int) -> bool:
        return abs(age_ns) <= self._settings.lateness.tolerance_ns

    def belief(self, told: Told, t_ns: int) -> Belief:
        """A peer's belief of its pose at `t_ns`."""
        belief, age_ns = told.report.belief, t_ns - told.t_ns
        if self._fresh(age_ns):
            return belief
        layout, age_s = STATES[belief.model], age_ns * 1e-9
        mean, F = belief.mean.copy(), np.eye(len(belief.mean))
        forward, left, up = told.report.velocity * age_s
        if layout.heading is not None:
            cos, sin = np.cos(mean[layout.heading]), np.sin(mean[layout.heading])
            dx, dy = cos * forward - sin * left, sin * forward + cos * left
            mean[0], mean[1] = mean[0] + dx, mean[1] + dy
            F[0, layout.heading], F[1, layout.heading] = -dy, dx
            mean[layout.heading] += told.report.yaw_rate * age_s
        if layout.altitude is not None:
            mean[layout.altitude] += up
        rounds = age_ns / self._settings.round.period_ns
        away = np.zeros(len(mean))
        away[list(layout.position)] = AWAY_M
        if layout.heading is not None:
            away[layout.heading] = TURNED_RAD
        cov = symmetrize(F @ belief.cov @ F.T + np.diag(away**2) * max(abs(rounds), rounds**2))
        return Belief(belief.model, wrap_components(mean, layout.angles), cov)

    def target(self, target: str, belief: Belief, age_ns: int) -> tuple[Array, Array]:
        """A belief of a target, mean (n,) and cov (n, n), `age_ns` later."""
        if self._fresh(age_ns):
            return belief.mean, belief.cov
        motion, transform = self._motions[target], self._settings.localization.transform
        moved = motion.drift(belief.mean, belief.cov, abs(age_ns) * 1e-9, transform)
        if age_ns > 0:
            return moved.mean, moved.cov
        # Back in time: as far as it would have gone, and no surer.
        back = belief.mean - wrap_components(moved.mean - belief.mean, motion.layout.angles)
        return wrap_components(back, motion.layout.angles), moved.cov

    def placed(self, target: str, item: Placed, track: Moment, age_ns: int) -> Placed:
        """A target's place by a sensor, `age_ns` later: it goes on as the target does by the belief `track`."""
        if self._fresh(age_ns):
            return item
        motion, transform, d = self._motions[target], self._settings.localization.transform, len(item.place)
        # Only what is not known of its motion makes the place less sure.
        still = track.cov.copy()
        still[:d, :] = still[:, :d] = 0.0
        still[:d, :d] = 1e-12 * np.eye(d)
        moved = motion.drift(track.mean, still, abs(age_ns) * 1e-9, transform)
        way = np.sign(age_ns) * (moved.mean[:d] - track.mean[:d])
        return Placed(item.place + way, item.sensor, symmetrize(item.pose + moved.cov[:d, :d]))
