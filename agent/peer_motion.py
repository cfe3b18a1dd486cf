"""How one robot moved, as it told: velocities over stretches of time, and what is guessed in between.

Over a gap a robot is taken to move on as it did last. How far that may be off depends on how long the gap is, not on
how often it is cut: the error of the velocity lasts, so that the variance of the way grows with the square of the time
and more, and each step within the gap gets the difference of two such variances.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.correspondence import BodyMotion
from agent.estimation.reckoning import extended
from agent.settings import CoastSettings

Array = NDArray[np.float64]

MAX_STRETCHES = 512
STILL = np.zeros(4)
LEAST_VARIANCE = 1e-12
"""Of a velocity: a robot that claims to know its motion exactly is taken to know it nearly so."""


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Mean velocity (4,) with the covariance (4, 4) of its error from `t0_ns` to `t_ns`."""

    t0_ns: int
    t_ns: int
    velocity: Array
    cov: Array


class PeerMotion:
    """The past of one peer's motion over a bounded horizon, from `start_ns` on; instants are of the own clock.

    `accelerations` (m/s^2, rad/s^2): deviations of how its velocity may change.
    """

    def __init__(
        self, start_ns: int, coast: CoastSettings, accelerations: tuple[float, float], tolerance_ns: int
    ) -> None:
        self._start_ns, self._tolerance_ns = start_ns, tolerance_ns
        speed, turn = accelerations
        self._acceleration = np.array([speed, speed, speed, turn])
        self._coast = np.array([coast.speed_mps, coast.speed_mps, coast.speed_mps, coast.yaw_rate_radps])
        self._stretches: deque[Stretch] = deque(maxlen=MAX_STRETCHES)

    @property
    def end_ns(self) -> int | None:
        """Until when it has told how it moved; None: never."""
        return self._stretches[-1].t_ns if self._stretches else None

    def add(self, stretch: Stretch) -> bool:
        """Take what it told; False if some of that is known already."""
        later: list[Stretch] = []
        while self._stretches and self._stretches[-1].t_ns > stretch.t_ns + self._tolerance_ns:
            later.append(self._stretches.pop())
        before = self._stretches[-1].t_ns if self._stretches else stretch.t0_ns
        after = later[-1].t0_ns if later else stretch.t_ns
        fits = before <= stretch.t0_ns + self._tolerance_ns and stretch.t_ns <= after + self._tolerance_ns
        if fits:
            self._stretches.append(stretch)
        self._stretches.extend(reversed(later))
        return fits

    def covers(self, t_ns: int) -> bool:
        """Whether it has told of the time up to `t_ns`."""
        return bool(self._stretches) and self._stretches[-1].t_ns >= t_ns - self._tolerance_ns

    def over(self, t0_ns: int, t_ns: int) -> tuple[BodyMotion, bool]:
        """Mean velocity from t0_ns to t_ns, and whether some of it is a guess."""
        total, total_cov, guessed = STILL, np.zeros((4, 4)), False
        for index, (begin_ns, end_ns, stretch) in enumerate(self._cut(t0_ns, t_ns)):
            dt_s = (end_ns - begin_ns) * 1e-9
            if stretch is not None:
                # White noise: the shorter the part, the larger the variance of its mean.
                share = max((end_ns - begin_ns) / (stretch.t_ns - stretch.t0_ns), 1e-9)
                delta, cov = stretch.velocity * dt_s, stretch.cov * (dt_s**2 / min(share, 1.0))
            else:
                delta, cov = self._guess(begin_ns, end_ns)
                guessed = True
            total, total_cov = extended(total, total_cov, delta, cov) if index else (delta, cov)
        dt_s = (t_ns - t0_ns) * 1e-9
        cov = total_cov / dt_s**2 + LEAST_VARIANCE * np.eye(4)
        return BodyMotion(total / dt_s, cov), guessed

    def _cut(self, t0_ns: int, t_ns: int) -> Iterator[tuple[int, int, Stretch | None]]:
        """Parts of the time from t0_ns to t_ns, with what is known of each; None in gaps."""
        here, tolerance = t0_ns, self._tolerance_ns
        for stretch in self._between(t0_ns, t_ns):
            if stretch.t0_ns > here + tolerance:
                yield here, stretch.t0_ns, None
                here = stretch.t0_ns
            # What is within the tolerance of the end counts as the end.
            end_ns = t_ns if stretch.t_ns >= t_ns - tolerance else stretch.t_ns
            if end_ns > here:
                yield here, end_ns, stretch
                here = end_ns
        if here < t_ns:
            yield here, t_ns, None

    def _between(self, t0_ns: int, t_ns: int) -> list[Stretch]:
        """Stretches that have a part in the time from t0_ns to t_ns, in order."""
        tolerance, found = self._tolerance_ns, []
        for stretch in reversed(self._stretches):
            if stretch.t_ns <= t0_ns + tolerance:
                break
            if stretch.t0_ns < t_ns - tolerance:
                found.append(stretch)
        return found[::-1]

    def _guess(self, begin_ns: int, end_ns: int) -> tuple[Array, Array]:
        """Increment (4,), (4, 4) over a part of a gap."""
        last = next((item for item in reversed(self._stretches) if item.t_ns <= begin_ns + self._tolerance_ns), None)
        since_ns = self._start_ns if last is None else last.t_ns
        velocity = STILL if last is None else last.velocity
        first, second = max(begin_ns - since_ns, 0) * 1e-9, max(end_ns - since_ns, 0) * 1e-9
        grown = np.diag(self._way_variance(second, last) - self._way_variance(first, last))
        if last is not None:
            grown = grown + last.cov * (second**2 - first**2)
        return velocity * ((end_ns - begin_ns) * 1e-9), grown

    def _way_variance(self, gap_s: float, last: Stretch | None) -> Array:
        """Variances (4,) of the way over a gap, but for the error of the last velocity.

        The velocity may change by its acceleration, but a robot is no faster than its last velocity and what an
        unknown one may be.
        """
        if last is None:
            return np.asarray((self._coast * gap_s) ** 2)
        most = np.hypot(np.abs(last.velocity), self._coast)
        return np.asarray((np.minimum(0.5 * self._acceleration * gap_s, most) * gap_s) ** 2)
