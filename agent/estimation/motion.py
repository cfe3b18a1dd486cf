"""Motion models: what a state means and how it moves.

A robot's own state is driven by odometry increments (`advance`); a target by its model alone (`drift`).
States are ENU positions x, y[, z] followed by a heading, counter-clockwise from east, or by velocities. Roll and pitch
are no states: odometry increments are of the levelled body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import congruence, identity, wrap
from agent.estimation.heading_moments import moved_in_its_frame
from agent.estimation.unscented import Propagated, Transform

Array = NDArray[np.float64]

PLANAR = (0, 1, 3)
"""Components of an odometry increment (dx, dy, dz, dyaw) that move a planar pose."""

PLANAR_SQUARE = np.ix_(PLANAR, PLANAR)


@dataclass(frozen=True, slots=True)
class StateLayout:
    """Meaning of a state vector: its size, wrapped components, where heading (None: none) and position sit.

    The position is the first two components, or three with an altitude.
    """

    name: str
    dim: int
    angles: tuple[int, ...]
    heading: int | None
    position: tuple[int, ...] = (0, 1)

    @property
    def altitude(self) -> int | None:
        """Where the altitude sits; None for a planar state."""
        return self.position[2] if len(self.position) == 3 else None


UNICYCLE = StateLayout("unicycle", 3, (2,), 2)
UNICYCLE_GAINS = StateLayout("unicycle_gains", 5, (2,), 2)
SPATIAL = StateLayout("spatial", 4, (3,), 3, (0, 1, 2))
CONSTANT_VELOCITY = StateLayout("constant_velocity", 4, (), None)
DAMPED_VELOCITY = StateLayout("damped_velocity", 4, (), None)
CONSTANT_VELOCITY_3D = StateLayout("constant_velocity_3d", 6, (), None, (0, 1, 2))
DAMPED_VELOCITY_3D = StateLayout("damped_velocity_3d", 6, (), None, (0, 1, 2))
CONSTANT_ACCELERATION = StateLayout("constant_acceleration", 6, (), None)

STATES = {
    layout.name: layout
    for layout in (
        UNICYCLE,
        UNICYCLE_GAINS,
        SPATIAL,
        CONSTANT_VELOCITY,
        DAMPED_VELOCITY,
        CONSTANT_VELOCITY_3D,
        DAMPED_VELOCITY_3D,
        CONSTANT_ACCELERATION,
    )
}
"""State layouts by the name beliefs carry."""

LAYOUTS = {name: layout for name, layout in STATES.items() if layout is not SPATIAL} | {
    "quadrotor": SPATIAL,
    "planar_altitude": SPATIAL,
}
"""State layouts by the name of a model of motion."""


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
    persistent_rad2: float = math.inf,
) -> Propagated:
    """Move a unicycle belief (3,), (3, 3) by an odometry increment (4,) with covariance (4, 4).

    x' = x (+) (u + w), w ~ N(0, Q): UT-CLAT eq. 9-12 with the increment in place of control times step.
    """
    if transform == "jacobian":
        increment = delta[[0, 1, 3]]
        noise = delta_cov[PLANAR_SQUARE]
        moved = compose(mean, increment)
        dx, dy = moved[0] - mean[0], moved[1] - mean[1]
        F = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        cos, sin = np.cos(mean[2]), np.sin(mean[2])
        G = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        moved[2] = wrap(moved[2])
        return Propagated(moved, congruence(F, cov) + congruence(G, noise), F)
    return moved_in_its_frame(mean, cov, delta, delta_cov, 2, persistent_rad2=persistent_rad2)


@dataclass(frozen=True, slots=True)
class HeldAltitude:
    """An altitude that a vehicle holds: commanded, with a deviation that is new at every instant."""

    altitude_m: float
    sigma_m: float


def advance_spatial(
    mean: Array,
    cov: Array,
    delta: Array,
    delta_cov: Array,
    transform: Transform,
    held: HeldAltitude | None = None,
    persistent_rad2: float = math.inf,
) -> Propagated:
    """Move a belief of x, y, z, heading (4,), (4, 4) by an odometry increment (4,) with covariance (4, 4).

    The altitude is that before plus the increment's; with `held` it is the held one instead, z' = z_c + w, of which
    the past tells nothing: F has a zero row (UT-CLAT eq. 33).
    """
    if transform == "jacobian":
        pose = compose(mean[[0, 1, 3]], delta[[0, 1, 3]])
        moved = np.array([pose[0], pose[1], mean[2] + delta[2], wrap(pose[2])])
        F, G = identity(4).copy(), identity(4).copy()
        F[0, 3], F[1, 3] = mean[1] - moved[1], moved[0] - mean[0]
        cos, sin = np.cos(mean[3]), np.sin(mean[3])
        G[:2, :2] = [[cos, -sin], [sin, cos]]
        found = Propagated(moved, congruence(F, cov) + congruence(G, delta_cov), F)
    else:
        found = moved_in_its_frame(mean, cov, delta, delta_cov, 3, persistent_rad2=persistent_rad2)
    if held is not None:
        found.mean[2] = held.altitude_m
        found.F[2, :] = 0.0
        found.cov[2, :] = found.cov[:, 2] = 0.0
        found.cov[2, 2] = held.sigma_m**2
    return found


@dataclass(frozen=True, slots=True)
class RobotMotion:
    """How a robot's own state moves with its odometry; here x, y, heading.

    `persistent_rad2`: variance of a heading from which on it matters that one that is off stays off, see
    `agent.estimation.heading_moments`; where it is less, measurements correct it before that.
    """

    layout: StateLayout = UNICYCLE
    persistent_rad2: float = 1.0

    def advance(
        self,
        mean: Array,
        cov: Array,
        delta: Array,
        delta_cov: Array,
        dt_s: float,
        transform: Transform,
        ) -> Propagated:
        """Belief (n,), (n, n) after an odometry increment (4,) with covariance (4, 4) over `dt_s` > 0 seconds."""
        return advance(mean, cov, delta, delta_cov, transform, self.persistent_rad2)


PLANAR_MOTION = RobotMotion()


@dataclass(frozen=True, slots=True)
class SpatialMotion(RobotMotion):
    """Motion of x, y, z, heading; the altitude is that of the odometry, or `held`."""

    layout: StateLayout = SPATIAL
    held: HeldAltitude | None = None

    def advance(
        self,
        mean: Array,
        cov: Array,
        delta: Array,
        delta_cov: Array,
        dt_s: float,
        transform: Transform,
        ) -> Propagated:
        return advance_spatial(mean, cov, delta, delta_cov, transform, self.held, self.persistent_rad2)


@dataclass(frozen=True, slots=True)
class TargetMotion:
    """How an uncooperative target moves, as its trackers model it.

    unicycle                control (speed_mps, yaw_rate_radps) with white noise on both;
    spatial                 the same at a held altitude;
    constant_velocity[_3d]  white acceleration noise on each axis;
    damped_velocity[_3d]    the same with velocity decaying by exp(-dt / damping_s);
    constant_acceleration   white jerk noise on each axis.

    Noise is given as standard deviation of a control (of an axis) held over `noise_step_s`; a step of another length dt
    keeps the same spectral density: variance sigma^2 noise_step_s / dt of a control held over dt. `persistent_rad2` as
    of robots; less, since what is out of sight is not corrected.
    """

    layout: StateLayout
    control: tuple[float, float] = (0.0, 0.0)
    noise_sigma: tuple[float, ...] = (0.1, 0.1)
    noise_step_s: float = 1.0
    damping_s: float = 2.0
    held: HeldAltitude | None = None
    persistent_rad2: float = 0.1

    def drift(self, mean: Array, cov: Array, dt_s: float, transform: Transform) -> Propagated:
        """Belief (n,), (n, n) after `dt_s` > 0 seconds."""
        if self.layout.heading is None:
            return self._drift_velocity(mean, cov, dt_s)
        delta, noise = _controlled(self.control, self.noise_sigma, self.noise_step_s, dt_s)
        if self.layout is SPATIAL:
            return advance_spatial(mean, cov, delta, noise, transform, self.held, self.persistent_rad2)
        return advance(mean, cov, delta, noise, transform, self.persistent_rad2)

    def _drift_velocity(self, mean: Array, cov: Array, dt: float) -> Propagated:
        F, Q = velocity_step(self.layout, dt, self.damping_s)
        density = np.array(self.noise_sigma) ** 2 * self.noise_step_s
        Q = Q * np.tile(density, self.layout.dim // len(density))[:, None]
        return Propagated(F @ mean, F @ cov @ F.T + Q, F)


@lru_cache(maxsize=256)
def _controlled(
    control: tuple[float, float], sigma: tuple[float, ...], noise_step_s: float, dt_s: float
) -> tuple[Array, Array]:
    """Increment (4,) and its covariance (4, 4) of a noisy control over `dt_s`, read-only."""
    scale = math.sqrt(noise_step_s * dt_s)
    delta = np.array([control[0] * dt_s, 0.0, 0.0, control[1] * dt_s])
    noise = np.diag([(sigma[0] * scale) ** 2, 0.0, 0.0, (sigma[1] * scale) ** 2])
    delta.flags.writeable = noise.flags.writeable = False
    return delta, noise


def velocity_step(layout: StateLayout, dt: float, damping_s: float) -> tuple[Array, Array]:
    """(F, Q) (n, n) over `dt` of a model without heading, for unit density of the noise that drives it; Q is exact.

    The noise drives the highest derivative in the state: acceleration noise a velocity, jerk noise an acceleration.
    """
    axes = np.eye(len(layout.position))
    if layout in (DAMPED_VELOCITY, DAMPED_VELOCITY_3D):
        F, Q = _damped_axis(dt, 1.0 / damping_s)
    else:
        F, Q = _integrated_axis(dt, layout.dim // len(axes))
    return np.asarray(np.kron(F, axes), dtype=np.float64), np.asarray(np.kron(Q, axes), dtype=np.float64)


def _integrated_axis(dt: float, order: int) -> tuple[Array, Array]:
    """(F, Q) of a chain of `order` integrators driven by white noise (van Loan)."""
    F, Q = np.eye(order), np.empty((order, order))
    for i in range(order):
        for j in range(order):
            if j > i:
                F[i, j] = dt ** (j - i) / math.factorial(j - i)
            p, q = order - 1 - i, order - 1 - j
            Q[i, j] = dt ** (p + q + 1) / ((p + q + 1) * math.factorial(p) * math.factorial(q))
    return F, Q


def _damped_axis(dt: float, rate: float) -> tuple[Array, Array]:
    """(F, Q) of position and a velocity that decays at `rate` (van Loan)."""
    decay = -math.expm1(-rate * dt)
    q_vv = -math.expm1(-2.0 * rate * dt) / (2.0 * rate)
    q_pv = decay**2 / (2.0 * rate**2)
    q_pp = dt**3 * _damped_position_variance(rate * dt)
    return np.array([[1.0, decay / rate], [0.0, 1.0 - decay]]), np.array([[q_pp, q_pv], [q_pv, q_vv]])


def _damped_position_variance(x: float) -> float:
    """(x - 2 (1 - e^-x) + (1 - e^-2x) / 2) / x^3; by its series where the closed form cancels."""
    if x < 0.5:
        return sum((-x) ** (k - 3) * (2.0 ** (k - 1) - 2.0) / math.factorial(k) for k in range(3, 19))
    return (x + 2.0 * math.expm1(-x) - 0.5 * math.expm1(-2.0 * x)) / x**3
