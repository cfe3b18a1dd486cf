"""Where a robot is and heads by a few words of its leader and its own odometry alone, whatever was believed before.

Range and bearing of the leader from one place leave a circle, which no Gaussian describes while the heading is wide.
Two places of the leader that are apart, seen from a body whose way between them is known, tell the pose: first as the
rigid motions that lay what was seen onto what was told, then by Gauss-Newton over all measurements (maximum likelihood,
with the told places marginalized as in `agent.estimation.delayed`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.delayed import LeaderSight, moved, predicted
from agent.estimation.gaussian import symmetrize, wrap
from agent.estimation.motion import between, compose

Array = NDArray[np.float64]

STARTS = 8
"""Headings from which the answer is sought: a few words have other answers nearby that fit worse."""

ITERATIONS = 12
SETTLED = 1e-5
APART = 0.1
"""Answers that differ by more, in m or rad, are two."""

UNLIKELIER = 13.8
"""By how much the residuals' square of any other answer must be larger: odds of a thousand."""

LEAST_INFORMATION = 1e-9
PLAUSIBLE = 3.0
"""Square of residuals per degree of freedom beyond which an answer is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """The own pose (3,) now, and its covariance (3, 3), in the body's frame at the instant of a sight."""

    path: Array
    cov: Array

    def moved(self, delta: Array, noise: Array) -> Way:
        """After an increment (3,) with covariance (3, 3)."""
        path, cov, _ = moved(self.path, self.cov, delta, noise)
        return Way(path, cov)


def no_way() -> Way:
    """Of a sight of the present instant."""
    return Way(np.zeros(3), np.zeros((3, 3)))


def pose_from_words(
    sights: Sequence[LeaderSight], ways: Sequence[Way], clock: tuple[float, float] | None = None
) -> tuple[Array, Array] | None:
    """Mean (n,) and covariance (n, n) of the present pose, and of the leader's clock if `clock` tells mean and variance
    of it; None if the sights do not tell one, or another one as well.

    Errors of ways are correlated, for later ones are parts of earlier ones: each counts as often as there are sights,
    which bounds them however they are.
    """
    if len(sights) < 2:
        return None
    groups = _grouped(sights, ways)
    state = _starts(groups, () if clock is None else (clock[0],))
    for _ in range(ITERATIONS):
        information, vector, cost = _summed(groups, len(sights), state, clock)
        step = np.linalg.solve(information, vector[..., None])[..., 0]
        state = state + step
        state[:, 2] = wrap(state[:, 2])
        if np.abs(step).max() < SETTLED:
            break
    settled = np.abs(step).max(axis=1) < SETTLED
    best = int(np.argmin(np.where(settled, cost, np.inf)))
    if not settled[best] or cost[best] > PLAUSIBLE * 2 * len(sights):
        return None
    elsewhere = np.abs(state - state[best]).max(axis=1) > APART
    if (cost[elsewhere] < cost[best] + UNLIKELIER).any():
        return None
    return state[best], symmetrize(np.linalg.inv(information[best]))


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Sights by one sensor, stacked (m, ...), with ways since, their covariances, and the poses then as seen now."""

    sight: LeaderSight
    path: Array
    cov: Array
    back: Array


def _grouped(sights: Sequence[LeaderSight], ways: Sequence[Way]) -> list[_Group]:
    groups = []
    for arm in dict.fromkeys(sight.arm for sight in sights):
        rows = [row for row, sight in enumerate(sights) if sight.arm == arm]
        z, R, place, place_cov, velocity = (
            np.array([getattr(sights[row], name) for row in rows])
            for name in ("z", "R", "place", "place_cov", "velocity")
        )
        path, cov = np.array([ways[row].path for row in rows]), np.array([ways[row].cov for row in rows])
        groups.append(_Group(LeaderSight(z, R, place, place_cov, velocity, arm), path, cov, between(path, np.zeros(3))))
    return groups


def _starts(groups: list[_Group], tau: tuple[float, ...]) -> Array:
    """States (s, n) to begin with: headings all around, and places that lay the middle of what was seen onto what was
    told; the first with the heading that lays everything best."""
    seen, told = [], []
    for group in groups:
        (x, y, yaw), z = group.sight.arm, group.sight.z
        angle = yaw + z[:, 1]
        point = np.stack([x + z[:, 0] * np.cos(angle), y + z[:, 0] * np.sin(angle), np.zeros(len(z))], axis=-1)
        seen.append(compose(group.back, point)[:, :2])
        told.append(group.sight.place + sum(tau) * group.sight.velocity)
    here, there = np.concatenate(seen), np.concatenate(told)
    here_mean, there_mean = here.mean(axis=0), there.mean(axis=0)
    here, there = here - here_mean, there - there_mean
    turn = np.arctan2((here[:, 0] * there[:, 1] - here[:, 1] * there[:, 0]).sum(), (here * there).sum())
    headings = wrap(turn + 2.0 * np.pi / STARTS * np.arange(STARTS))
    cos, sin = np.cos(headings), np.sin(headings)
    x, y = (
        there_mean[0] - cos * here_mean[0] + sin * here_mean[1],
        there_mean[1] - sin * here_mean[0] - cos * here_mean[1],
    )
    return np.stack([x, y, headings, *(np.full(STARTS, value) for value in tau)], axis=-1)


def _summed(
    groups: list[_Group], count: int, state: Array, clock: tuple[float, float] | None
) -> tuple[Array, Array, Array]:
    """Information (s, n, n), its vector (s, n) and the square of residuals (s,) of all sights at states (s, n)."""
    n = state.shape[1]
    information, vector = np.tile(LEAST_INFORMATION * np.eye(n), (len(state), 1, 1)), np.zeros(state.shape)
    cost = np.zeros(len(state))
    for group in groups:
        sight = group.sight
        then = np.repeat(state[:, None], len(sight.z), axis=1)
        then[..., :3] = compose(state[:, None, :3], group.back)
        J = np.tile(np.eye(n), (*then.shape[:2], 1, 1))
        J[..., 0, 2], J[..., 1, 2] = state[:, None, 1] - then[..., 1], then[..., 0] - state[:, None, 0]
        h, Cf, Cl = predicted(then, sight.place, sight)
        residual = sight.z - h
        residual[..., 1] = wrap(residual[..., 1])
        slope = Cf[..., :3] @ _of_way(state[:, 2], group.path)
        noise = sight.R + Cl @ sight.place_cov @ Cl.swapaxes(-1, -2)
        noise = noise + count * slope @ group.cov @ slope.swapaxes(-1, -2)
        C = Cf @ J
        weighted = np.linalg.solve(noise, np.concatenate([C, residual[..., None]], axis=-1))
        information += (C.swapaxes(-1, -2) @ weighted[..., :n]).sum(axis=1)
        vector += (C.swapaxes(-1, -2) @ weighted[..., n:]).sum(axis=1)[..., 0]
        cost += (residual * weighted[..., n]).sum(axis=(1, 2))
    if clock is not None:
        off = clock[0] - state[:, 3]
        information[:, 3, 3] += 1.0 / clock[1]
        vector[:, 3] += off / clock[1]
        cost += off**2 / clock[1]
    return information, vector, cost


def _of_way(heading: Array, path: Array) -> Array:
    """Jacobian (s, m, 3, 3) of the pose at a sight by the way (m, 3) since, of headings (s,)."""
    x, y, turned = path.T
    cos, sin = np.cos(turned), np.sin(turned)
    back = np.zeros((len(path), 3, 3))
    back[:, 0] = np.stack([-cos, -sin, sin * x - cos * y], axis=-1)
    back[:, 1] = np.stack([sin, -cos, cos * x + sin * y], axis=-1)
    back[:, 2, 2] = -1.0
    cos, sin = np.cos(heading), np.sin(heading)
    turn = np.zeros((len(heading), 1, 3, 3))
    turn[:, 0, 0, 0], turn[:, 0, 0, 1], turn[:, 0, 1, 0], turn[:, 0, 1, 1], turn[:, 0, 2, 2] = cos, -sin, sin, cos, 1.0
    return turn @ back
