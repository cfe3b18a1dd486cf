"""Poses of calibrated cameras, and the shift of their clock, from what they saw of one object whose track is known.

A first pose is the direct linear transform (Hartley and Zisserman, Multiple View Geometry, 2nd ed., section 7.1), at
the shift of a grid at which it fits best; it is then refined by robust least squares of the reprojection error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

COARSE_S, FINE_S = 1.0, 0.1
"""Steps of the two grids of shifts; what is left is estimated."""
GRID_POINTS, FIT_POINTS = 300, 3000
"""At most so many sightings of a camera are used for a place on a grid, and for a pose."""
MIN_POINTS = 30
MIN_SHARE = 0.6
"""A shift is tried if so much of a camera's sightings then falls into the track."""
MAX_MISFIT = 0.25
"""Reprojection error over spread of the sightings from which on a track does not fit them."""
TINY = 1e-9
ROBUST = 0.002
"""Reprojection error, on the plane at unit distance, from which on sightings count less."""


class ResectionError(ValueError):
    """No pose or shift fits; says what."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Places xyz_m (K, 3) of an object at ascending t_s (K,)."""

    t_s: Array
    xyz_m: Array
    _spline: CubicSpline = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_spline", CubicSpline(self.t_s, self.xyz_m, extrapolate=False))

    def at(self, t_s: Array) -> Array:
        """Places (N, 3) by a cubic spline, NaN before the first and after the last one."""
        return np.asarray(self._spline(t_s))


@dataclass(frozen=True, slots=True, eq=False)
class Sighted:
    """What a camera saw of it: points (K, 2), right and down on the plane at unit distance, at ascending t_s (K,)."""

    t_s: Array
    plane: Array

    def thinned(self, count: int) -> Sighted:
        every = max(1, len(self.t_s) // count)
        return Sighted(self.t_s[::every], self.plane[::every])


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """A camera at `centre` (3,); `turn` (3, 3) takes vectors of the world into its axes right, down, forward."""

    turn: Array
    centre: Array

    def project(self, places: Array) -> Array:
        """Points (K, 2) on the plane at unit distance of places (K, 3)."""
        seen = (places - self.centre) @ self.turn.T
        return np.asarray(seen[:, :2] / seen[:, 2:])


def clock_shift(cameras: Sequence[Sighted], track: Track) -> float:
    """What is to be added to the cameras' common clock to have that of the track [s]. Raises `ResectionError`.

    The median over the cameras, since one of them may have frames at uneven intervals.
    """
    first = min(float(camera.t_s[0]) for camera in cameras)
    last = max(float(camera.t_s[-1]) for camera in cameras)
    begin, end = float(track.t_s[0]), float(track.t_s[-1])
    few = [camera.thinned(GRID_POINTS) for camera in cameras]
    coarse = np.arange(begin - last, end - first, COARSE_S)
    near = min(coarse, key=lambda shift: _misfit(few, track, shift), default=0.0)
    fine = np.arange(near - COARSE_S, near + COARSE_S, FINE_S)
    shift = float(min(fine, key=lambda shift: _misfit(few, track, shift)))
    if not _misfit(few, track, shift) <= MAX_MISFIT:
        raise ResectionError("what the cameras saw does not fit the track at any shift of their clock")
    return float(np.median([_refined(camera, track, shift, free=True)[1] for camera in cameras]))


def pose(camera: Sighted, track: Track, shift_s: float) -> CameraPose:
    """The pose from which a camera whose clock is `shift_s` behind saw the track. Raises `ResectionError`."""
    return _refined(camera, track, shift_s, free=False)[0]


def _misfit(cameras: Sequence[Sighted], track: Track, shift_s: float) -> float:
    """Mean over cameras of the reprojection error over the spread of sightings; infinite for too few of them."""
    total = 0.0
    for camera in cameras:
        plane, places = _pairs(camera, track, shift_s)
        if len(plane) < max(MIN_POINTS, MIN_SHARE * len(camera.plane)):
            return np.inf
        # A shift at which much is behind the camera fits no worse than badly.
        off = np.minimum(np.sum((_projected(_transform(places, plane), places) - plane) ** 2, axis=1), 1.0)
        total += float(np.sqrt(np.mean(off)) / max(np.std(plane), TINY))
    return total / len(cameras)


def _pairs(camera: Sighted, track: Track, shift_s: float) -> tuple[Array, Array]:
    """Points (N, 2) and places (N, 3) of the sightings within the track."""
    places = track.at(camera.t_s + shift_s)
    within = np.isfinite(places[:, 0])
    return camera.plane[within], places[within]


def _transform(places: Array, plane: Array) -> Array:
    """The projection matrix (3, 4), up to scale and sign, of places (N, 3) that are seen at points (N, 2)."""
    mean, scale = places.mean(axis=0), places.std() or 1.0
    scaled = np.column_stack([(places - mean) / scale, np.ones(len(places))])
    zero = np.zeros_like(scaled)
    rows = np.vstack(
        [
            np.hstack([scaled, zero, -plane[:, :1] * scaled]),
            np.hstack([zero, scaled, -plane[:, 1:] * scaled]),
        ]
    )
    smallest = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, 4)
    back = np.eye(4)
    back[:3, :3], back[:3, 3] = np.eye(3) / scale, -mean / scale
    return np.asarray(smallest @ back)


def _projected(transform: Array, places: Array) -> Array:
    seen = places @ transform[:, :3].T + transform[:, 3]
    return np.asarray(seen[:, :2] / seen[:, 2:])


def _first(transform: Array) -> CameraPose:
    """The pose of a projection matrix: its left part is a turn, but for scale and errors."""
    left = transform[:, :3] if np.linalg.det(transform[:, :3]) > 0.0 else -transform[:, :3]
    U, _, Vt = np.linalg.svd(left)
    return CameraPose(U @ Vt, -np.linalg.pinv(transform[:, :3]) @ transform[:, 3])


def _refined(camera: Sighted, track: Track, shift_s: float, free: bool) -> tuple[CameraPose, float]:
    """Pose and shift; that is estimated too if it is `free`, and otherwise as given."""
    few = camera.thinned(FIT_POINTS)
    plane, places = _pairs(few, track, shift_s)
    if len(plane) < MIN_POINTS:
        raise ResectionError(f"{len(plane)} sightings fall into the track; a pose takes {MIN_POINTS}")
    start = _first(_transform(places, plane))
    guess = [*Rotation.from_matrix(start.turn).as_rotvec(), *start.centre, *([0.0] if free else [])]

    def error(values: Array) -> Array:
        moved = places if not free else track.at(few.t_s + shift_s + values[6])
        seen = _posed(values).project(moved)
        if not free:
            return np.asarray((seen - plane).ravel())
        # What is moved out of the track is left out without changing the number of errors.
        return np.asarray(np.nan_to_num(seen - few.plane, nan=0.0).ravel())

    scale = [0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 0.1][: len(guess)]
    found = least_squares(error, guess, loss="soft_l1", f_scale=ROBUST, x_scale=scale)
    return _posed(found.x), shift_s + (float(found.x[6]) if free else 0.0)


def _posed(values: Array) -> CameraPose:
    return CameraPose(Rotation.from_rotvec(values[:3]).as_matrix(), np.asarray(values[3:6]))
