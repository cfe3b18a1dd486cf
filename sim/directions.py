"""Noise of measured directions, and directions of what is not there.

A direction is azimuth and elevation [rad] (2,) in the sensor's frame. An error of the direction by s across it, to the
side, is one of s / cos(elevation) in azimuth: noise that is equal in azimuth and elevation is that of a pan and tilt
mount, not of a camera, which errs as far in any direction.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DirectionNoise = Literal["angles", "isotropic", "published"]

DRAWS: dict[DirectionNoise, int] = {"isotropic": 2, "published": 4}
"""Standard normal numbers that an error takes; `angles` are a sensor's numbers like any other."""

MAX_AZIMUTH_VARIANCE = math.pi**2 / 3.0
"""Of an azimuth that nothing is known of, as that of what is straight above."""


def vector(direction: Array) -> Array:
    """Unit vectors (..., 3), forward, left, up, of directions (..., 2)."""
    azimuth, elevation = direction[..., 0], direction[..., 1]
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def direction_of(vectors: Array) -> Array:
    """Directions (..., 2) of vectors (..., 3) of any length above 0."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def disturbed(noise: DirectionNoise, clean: Array, sigma_rad: float, draws: Array) -> Array:
    """Measured direction (..., 2) of a true one (..., 2), by standard normal `draws` (..., DRAWS[noise]).

    isotropic   turned about a random axis across the direction, sigma_rad along each of two such axes
    published   turned by N(0, sigma_rad) about g x u, g the direction and u a random unit vector, whose length is left
                as it is (Spatial-temporal triangulation, eq. 1-2 as simulated there): the turn is by sigma_rad times
                the length of g x u, its root mean square sigma_rad sqrt(2 / 3)
    """
    g = vector(clean)
    if noise == "isotropic":
        # Around the direction: left, and up.
        azimuth, elevation = clean[..., 0], clean[..., 1]
        left = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros_like(azimuth)], axis=-1)
        up = vector(np.stack([azimuth, elevation + 0.5 * math.pi], axis=-1))
        angle = sigma_rad * np.sqrt(np.sum(draws**2, axis=-1, keepdims=True))
        across = sigma_rad * (draws[..., :1] * left + draws[..., 1:2] * up)
        # sinc: an error of exactly 0 has no axis.
        return direction_of(np.cos(angle) * g + np.sinc(angle / math.pi) * across)
    u = draws[..., :3] / np.linalg.norm(draws[..., :3], axis=-1, keepdims=True)
    across = u - np.sum(g * u, axis=-1, keepdims=True) * g
    angle = sigma_rad * draws[..., 3:4]
    return direction_of(np.cos(angle) * g + np.sin(angle) * across)


def direction_covariance(noise: DirectionNoise, measured: Array, sigma_rad: float) -> Array:
    """R (2, 2) of azimuth and elevation that goes with a measured direction (2,).

    The azimuth is the worse known the higher it is looked. The published noise has a variance of sigma_rad^2 / 3 along
    each axis across the direction: that of a component of u.
    """
    variance = sigma_rad**2 / (3.0 if noise == "published" else 1.0)
    level = max(math.cos(float(measured[1])) ** 2, variance / MAX_AZIMUTH_VARIANCE)
    return np.diag([variance / level, variance])


def anywhere(size: int, uniforms: Array, fov_rad: float | None) -> Array:
    """A direction drawn evenly over the sphere, or over its part within `fov_rad` of azimuth, by `uniforms` (2,).

    (1,) of `size` 1, an azimuth.
    """
    azimuth = (2.0 * uniforms[0] - 1.0) * (math.pi if fov_rad is None else min(0.5 * fov_rad, math.pi))
    return np.array([azimuth, math.asin(2.0 * uniforms[1] - 1.0)])[:size]
