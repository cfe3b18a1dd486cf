"""Motion models: what a state means and how it moves.

A robot's own state is driven by odometry increments (`advance`); a target by its model alone (`drift`).
Planar states are x, y, heading (unicycle) or x, y, vx, vy; ENU, heading counter-clockwise from east.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import square_root, wrap
from agent.estimation.unscented import DEFAULT, Propagated, Transform, UnscentedParameters, propagate

Array = NDArray[np.float64]

PLANAR = (0, 1, 3)
"""Components of an odometry increment (dx, dy, dz, dyaw) that move a planar pose."""


@dataclass(frozen=True, slots=True)
class StateLayout:
    """Meaning of a state vector: its size, wrapped components, where heading (None: none) and position sit."""

    name: str
    dim: int
    angles: tuple[int, ...]
    heading: int | None
    position: tuple[int, ...] = (0, 1)


UNICYCLE = StateLayout("unicycle", 3, (2,), 2)
UNICYCLE_GAINS = StateLayout("unicycle_gains", 5, (2,), 2)
CONSTANT_VELOCITY = StateLayout("constant_velocity", 4, (), None)
DAMPED_VELOCITY = StateLayout("damped_velocity", 4, (), None)

LAYOUTS = {layout.name: layout for layout in (UNICYCLE, UNICYCLE_GAINS, CONSTANT_VELOCITY, DAMPED_VELOCITY)}


def compose(pose: Array, delta: Array) -> Array:
    """Planar pose (..., 3) moved by a body-frame increment (..., 3): the SE(2) product; heading not wrapped."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    moved = np.empty(np.broadcast_shapes(pose.shape, delta.shape))
    moved[..., 0] = pose[..., 0] + cos * delta[..., 0] - sin * delta[..., 1]
    moved[..., 1] = pose[..., 1] + sin * delta[..., 0] + cos * delta[..., 1]
    moved[..., 2] = pose[..., 2] + delta[..., 2]
    return moved


def between(start: Array, end: Array) -> Array:
    """Increment (..., 3) with compose(start, increment) = end; heading wrapped."""
    cos, sin = np.cos(start[..., 2]), np.sin(start[..., 2])
    dx, dy = end[..., 0] - start[..., 0], end[..., 1] - start[..., 1]
    return np.stack([cos * dx + sin * dy, -sin * dx + cos * dy, wrap(end[..., 2] - start[..., 2])], axis=-1)


def split_increment(delta: Array, cov: Array, fraction: float) -> tuple[Array, Array, Array, Array]:
    """Cut an increment (4,) with covariance (4, 4) into two that compose to it.

    The first part is the straight share `fraction` in (0, 1); variances divide with time, as for white noise.
    """
    first = delta * fraction
    second = delta - first
    head, whole = first[[0, 1, 3]], delta[[0, 1, 3]]
    second[[0, 1, 3]] = between(head, whole)
    return first, cov * fraction, second, cov * (1.0 - fraction)


def advance(
    mean: Array,
    cov: Array,
    delta: Array,
    delta_cov: Array,
    transform: Transform,
    parameters: UnscentedParameters = DEFAULT,
) -> Propagated:
    """Move a unicycle belief (3,), (3, 3) by an odometry increment (4,) with covariance (4, 4).

    x' = x (+) (u + w), w ~ N(0, Q): UT-CLAT eq. 9-12 with the increment in place of control times step.
    """
    increment = delta[[0, 1, 3]]
    noise = delta_cov[np.ix_(PLANAR, PLANAR)]
    if transform == "jacobian":
        moved = compose(mean, increment)
        dx, dy = moved[0] - mean[0], moved[1] - mean[1]
        F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        cos, sin = np.cos(mean[2]), np.sin(mean[2])
        G = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        moved[2] = wrap(moved[2])
        return Propagated(moved, F @ cov @ F.T + G @ noise @ G.T, F)
    active = np.flatnonzero(np.diagonal(noise) > 0.0)
    root = np.zeros((3, len(active)))
    if len(active):
        root[active] = square_root(noise[np.ix_(active, active)])

    def move(points: Array, noises: Array) -> Array:
        return compose(points, increment + noises)

    return propagate(move, mean, cov, root, UNICYCLE.angles, parameters)


@dataclass(frozen=True, slots=True)
class RobotMotion:
    """How a robot's own state moves with its odometry."""

    layout: StateLayout = UNICYCLE

    def advance(
        self,
        mean: Array,
        cov: Array,
        delta: Array,
        delta_cov: Array,
        dt_s: float,
        transform: Transform,
        parameters: UnscentedParameters = DEFAULT,
    ) -> Propagated:
        """Belief (n,), (n, n) after an odometry increment (4,) with covariance (4, 4) over `dt_s` > 0 seconds."""
        return advance(mean, cov, delta, delta_cov, transform, parameters)


PLANAR_MOTION = RobotMotion()


@dataclass(frozen=True, slots=True)
class TargetMotion:
    """How an uncooperative target moves, as its trackers model it.

    unicycle            control (speed_mps, yaw_rate_radps) with white noise on both;
    constant_velocity   white acceleration noise;
    damped_velocity     the same with velocity decaying by exp(-dt / damping_s).

    Noise is given as standard deviation of a control held over `noise_step_s`; a step of another length dt
    keeps the same spectral density: variance sigma^2 noise_step_s / dt of a control held over dt.
    """

    layout: StateLayout
    control: tuple[float, float] = (0.0, 0.0)
    noise_sigma: tuple[float, float] = (0.1, 0.1)
    noise_step_s: float = 1.0
    damping_s: float = 2.0
    parameters: UnscentedParameters = field(default=DEFAULT)

    def drift(self, mean: Array, cov: Array, dt_s: float, transform: Transform) -> Propagated:
        """Belief (n,), (n, n) after `dt_s` > 0 seconds."""
        if self.layout.heading is None:
            return self._drift_velocity(mean, cov, dt_s)
        scale = np.sqrt(self.noise_step_s * dt_s)
        speed, turn = self.control[0] * dt_s, self.control[1] * dt_s
        delta = np.array([speed, 0.0, 0.0, turn])
        noise = np.diag([(self.noise_sigma[0] * scale) ** 2, 0.0, 0.0, (self.noise_sigma[1] * scale) ** 2])
        return advance(mean, cov, delta, noise, transform, self.parameters)

    def _drift_velocity(self, mean: Array, cov: Array, dt: float) -> Propagated:
        F, Q = velocity_step(self.layout, dt, self.damping_s)
        density = np.array(self.noise_sigma) ** 2 * self.noise_step_s
        Q = Q * np.tile(density, 2)[:, None]
        return Propagated(F @ mean, F @ cov @ F.T + Q, F)


def velocity_step(layout: StateLayout, dt: float, damping_s: float) -> tuple[Array, Array]:
    """(F, Q) of a planar velocity model over `dt` for unit acceleration density; Q exact (van Loan)."""
    F, Q = np.eye(4), np.zeros((4, 4))
    if layout is CONSTANT_VELOCITY:
        position, velocity = dt, 1.0
        q_pp, q_pv, q_vv = dt**3 / 3.0, dt**2 / 2.0, dt
    else:
        rate = 1.0 / damping_s
        decay = -math.expm1(-rate * dt)
        position, velocity = decay / rate, 1.0 - decay
        q_vv = -math.expm1(-2.0 * rate * dt) / (2.0 * rate)
        q_pv = decay**2 / (2.0 * rate**2)
        q_pp = dt**3 * _damped_position_variance(rate * dt)
    for axis in (0, 1):
        F[axis, axis + 2], F[axis + 2, axis + 2] = position, velocity
        Q[axis, axis], Q[axis + 2, axis + 2] = q_pp, q_vv
        Q[axis, axis + 2] = Q[axis + 2, axis] = q_pv
    return F, Q


def _damped_position_variance(x: float) -> float:
    """(x - 2 (1 - e^-x) + (1 - e^-2x) / 2) / x^3; by its series where the closed form cancels."""
    if x < 0.5:
        return sum((-x) ** (k - 3) * (2.0 ** (k - 1) - 2.0) / math.factorial(k) for k in range(3, 19))
    return (x + 2.0 * math.expm1(-x) - 0.5 * math.expm1(-2.0 * x)) / x**3
