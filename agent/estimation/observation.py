"""Observation models: absolute information and relative measurements of a peer, a target or a landmark.

A relative model maps the observer's pose and the position of what it sees to a measurement; both are read from one
stacked vector so that a transform can be drawn over their joint. It is worked out in the plane if all positions are
planar, and in space if one of them has an altitude or the measurement is spatial itself (`bearing3`, `pixel`): what is
planar then lies at z = 0 of the fleet's frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import LOWEST
from agent.estimation.motion import UNICYCLE, StateLayout
from agent.estimation.mounting import Placed, levelled, placed
from agent.estimation.unscented import Turning
from agent.events import LEVEL, Observation
from network.messages import NO_MOUNT, Measurement, Mount

Array = NDArray[np.float64]

RELATIVE_ANGLES: dict[str, tuple[int, ...]] = {
    "range": (),
    "bearing": (0,),
    "bearing3": (0,),
    "range_bearing": (1,),
    "vector": (),
    "pixel": (),
}
"""Kinds of relative measurement and their wrapped components (an elevation never passes the half turn)."""

SPATIAL_KINDS = ("bearing3", "pixel")

ABSOLUTE: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "position": ((0, 1), ()),
    "pose": ((0, 1, 2), (2,)),
    "heading": ((2,), (0,)),
}
"""Kinds of absolute information of a planar pose: (observed state components, wrapped measurement components)."""

MIN_DISTANCE_M = 1e-3
MIN_DEPTH_M = 0.1
"""A camera sees nothing that is nearer to its image plane, or behind it."""


class OutOfViewError(np.linalg.LinAlgError):
    """A pixel was to be predicted of a point that is not, or not surely, in front of the camera."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera: focal length, principal point and image size (width, height), all in pixels."""

    focal_px: float = 500.0
    center_px: tuple[float, float] = (320.0, 240.0)
    size_px: tuple[float, float] = (640.0, 480.0)

    def normalized(self, z: Array, R: Array) -> tuple[Array, Array]:
        """A pixel (2,) with covariance (2, 2) on the image plane at unit distance from the principal point."""
        return (z - np.array(self.center_px)) / self.focal_px, R / self.focal_px**2

    def shows(self, pixel: Array) -> bool:
        """Whether a pixel (2,) lies in the image."""
        return bool(np.all(pixel >= 0.0) and np.all(pixel <= np.array(self.size_px)))


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteModel:
    """z = selected components of a state of `layout`.

    `position` is x, y or, with `size` 3, x, y, z; `pose` is x, y, heading or, with `size` 4, x, y, z, heading.
    """

    kind: str
    layout: StateLayout
    size: int = 0
    components: tuple[int, ...] = field(init=False)
    angles: tuple[int, ...] = field(init=False)
    turning: Turning = field(init=False)

    def __post_init__(self) -> None:
        found = absolute_components(self.kind, self.layout, self.size)
        if found is None:
            raise ValueError(f"kind '{self.kind}' of {self.size} numbers says nothing of a state '{self.layout.name}'")
        components = tuple(state for _, state in found)
        angles = tuple(row for row, column in enumerate(components) if column == self.layout.heading)
        object.__setattr__(self, "components", components)
        object.__setattr__(self, "angles", angles)
        object.__setattr__(self, "turning", tuple((row, components[row], 1.0) for row in angles))

    def h(self, state: Array) -> Array:
        return np.asarray(state[..., list(self.components)])

    def jacobian(self, state: Array) -> Array:
        H = np.zeros((*state.shape[:-1], len(self.components), self.layout.dim))
        for row, column in enumerate(self.components):
            H[..., row, column] = 1.0
        return H


def absolute_components(kind: str, layout: StateLayout, size: int = 0) -> list[tuple[int, int]] | None:
    """Pairs (component of z, component of the state) of absolute information; None if it says nothing of the state.

    An altitude in a position is left out for a planar state.
    """
    place = [(row, column) for row, column in enumerate(layout.position)]
    heading = [] if layout.heading is None else [layout.heading]
    match kind, size:
        case ("position", 0 | 2):
            return place[:2]
        case ("position", 3):
            return place
        case ("pose", 0 | 3):
            return [*place[:2], *((2, column) for column in heading)]
        case ("pose", 4):
            return [*place, *((3, column) for column in heading)]
        case ("heading", 0 | 1) if heading:
            return [(0, heading[0])]
        case ("altitude", 0 | 1) if layout.altitude is not None:
            return [(0, layout.altitude)]
    return None


def absolute_model(kind: str, layout: StateLayout, z: Array, R: Array) -> tuple[AbsoluteModel, Array, Array] | None:
    """The model of absolute information z (m,), R (m, m), with what of it the state has; None if that is nothing."""
    found = _absolute(kind, layout, len(z))
    if found is None:
        return None
    model, rows = found
    return (model, z, R) if len(rows) == len(z) else (model, z[rows], R[np.ix_(rows, rows)])


@lru_cache(maxsize=256)
def _absolute(kind: str, layout: StateLayout, size: int) -> tuple[AbsoluteModel, list[int]] | None:
    """The model of `size` numbers, and which of them it takes."""
    found = absolute_components(kind, layout, size)
    return None if found is None else (AbsoluteModel(kind, layout, size), [row for row, _ in found])


@dataclass(frozen=True, slots=True, eq=False)
class RelativeModel:
    """What an observer's sensor measures of a subject.

    range           distance [m]
    bearing         azimuth [rad] about the sensor's upward axis, left positive, from its forward axis
    bearing3        azimuth and elevation [rad]
    range_bearing   distance and azimuth
    vector          x, y [m] in the sensor's frame (forward, left)
    pixel           u (right), v (down) of a pinhole whose optical axis is the sensor's forward axis, on the image plane
                    at unit distance, or in pixels with `intrinsics` (UT-CLAT eq. 36: d_f x_c[:2] / x_c[2])

    The stacked state is [observer; subject], or the observer alone with a `landmark` (2,) or (3,). `mount` is the
    sensor's lever arm x, y, z [m, FLU] and turn roll, pitch, yaw [rad] on the observer's body, `attitude` the body's
    roll and pitch at the instant. The observer needs a heading unless the kind is `range` and the lever arm is zero.
    """

    kind: str
    observer: StateLayout
    mount: Mount = NO_MOUNT
    landmark: tuple[float, ...] | None = None
    subject: StateLayout = UNICYCLE
    attitude: tuple[float, float] = LEVEL
    intrinsics: Intrinsics | None = None
    dims: int = field(init=False)
    _placed: Placed = field(init=False)

    def __post_init__(self) -> None:
        seen = len(self.subject.position) if self.landmark is None else len(self.landmark)
        dims = 3 if self.kind in SPATIAL_KINDS else max(seen, len(self.observer.position))
        object.__setattr__(self, "dims", dims)
        object.__setattr__(self, "_placed", placed(self.mount, self.attitude, dims))

    @property
    def angles(self) -> tuple[int, ...]:
        return RELATIVE_ANGLES[self.kind]

    @property
    def turning(self) -> Turning:
        """Azimuths about the vertical fall by what the observer turns; those of a tilted sensor don't quite."""
        heading, measured = self.observer.heading, MEASURED[self.kind]
        if heading is None or "azimuth" not in measured or not self.mount[3:5] == LEVEL == self.attitude:
            return ()
        return ((measured.index("azimuth"), heading, -1.0),)

    @property
    def _turns(self) -> bool:
        """Whether the measurement depends on where the observer heads."""
        return self.kind != "range" or self._placed.apart

    def _between(self, state: Array) -> Array:
        """Vector (..., dims) from observer to subject in ENU."""
        own, begin = len(self.observer.position), self.observer.dim
        size = len(self.subject.position) if self.landmark is None else len(self.landmark)
        place = state[..., begin : begin + size] if self.landmark is None else np.asarray(self.landmark)
        if own == size == self.dims:
            return np.asarray(place - state[..., :own])
        d = np.zeros((*state.shape[:-1], self.dims))
        d[..., :size] = place
        d[..., :own] -= state[..., :own]
        return d

    def _levelled(self, state: Array, d: Array) -> Array:
        """A vector (..., dims) in ENU, in the levelled body's frame."""
        if self.observer.heading is None:
            raise ValueError(f"a '{self.kind}' of an observer without heading: '{self.observer.name}'")
        heading = state[..., self.observer.heading]
        cos, sin = np.cos(heading), np.sin(heading)
        turned = np.empty_like(d)
        turned[..., 2:] = d[..., 2:]
        turned[..., 0] = cos * d[..., 0] + sin * d[..., 1]
        turned[..., 1] = cos * d[..., 1] - sin * d[..., 0]
        return turned

    def _in_sensor(self, levelled: Array) -> Array:
        """Where a sensor sees what lies (..., dims) from its robot in the levelled body's frame."""
        if not self._placed.moved:
            return levelled
        return np.asarray(levelled @ self._placed.turn.T - self._placed.lever)

    def distance(self, state: Array) -> float:
        """Distance [m] of the subject from the sensor, for one stacked state (n,)."""
        s = self._between(state)
        if self._placed.apart:
            s = self._in_sensor(self._levelled(state, s))
        return math.hypot(*s.tolist())

    def h(self, state: Array) -> Array:
        """Measurement (..., m) of a stacked state (..., n). Raises `OutOfViewError`."""
        s = self._between(state)
        if self._turns:
            s = self._in_sensor(self._levelled(state, s))
        match self.kind:
            case "range":
                return _norm(s)[..., None]
            case "bearing":
                return _azimuth(s)[..., None]
            case "bearing3":
                return np.stack([_azimuth(s), np.arctan2(s[..., 2], np.hypot(s[..., 0], s[..., 1]))], axis=-1)
            case "range_bearing":
                return np.stack([_norm(s), _azimuth(s)], axis=-1)
            case "vector":
                return np.asarray(s[..., :2])
        _in_front(s)
        plane = -s[..., 1:] / s[..., :1]
        if self.intrinsics is None:
            return np.asarray(plane)
        return np.asarray(self.intrinsics.focal_px * plane + np.array(self.intrinsics.center_px))

    def jacobian(self, state: Array) -> Array:
        """H (..., m, n). Distances below 1 mm are taken as 1 mm: angles are undefined at the sensor.

        Raises `OutOfViewError`.
        """
        d = self._between(state)
        dims, own = self.dims, len(self.observer.position)
        J = np.zeros((*state.shape[:-1], dims, state.shape[-1]))
        turn = np.zeros((*state.shape[:-1], dims, dims))
        if self._turns:
            levelled = self._levelled(state, d)
            heading = state[..., self.observer.heading]
            cos, sin = np.cos(heading), np.sin(heading)
            turn[..., 0, 0], turn[..., 0, 1], turn[..., 1, 0], turn[..., 1, 1] = cos, sin, -sin, cos
            if dims == 3:
                turn[..., 2, 2] = 1.0
            turn = self._placed.turn @ turn
            across = np.zeros_like(levelled)
            across[..., 0], across[..., 1] = levelled[..., 1], -levelled[..., 0]
            J[..., self.observer.heading] = across @ self._placed.turn.T
            s = self._in_sensor(levelled)
        else:
            turn[...] = np.eye(dims)
            s = d
        J[..., :own] = -turn[..., :own]
        if self.landmark is None:
            begin, size = self.observer.dim, len(self.subject.position)
            J[..., begin : begin + size] = turn[..., :size]
        return np.asarray(self._gradient(s) @ J)

    def _gradient(self, s: Array) -> Array:
        """Derivative (..., m, dims) of the measurement by the subject's place (..., dims) in the sensor's frame."""
        rows = np.zeros((*s.shape[:-1], len(MEASURED[self.kind]), self.dims))
        for index, what in enumerate(MEASURED[self.kind]):
            row = rows[..., index, :]
            level = np.maximum(np.hypot(s[..., 0], s[..., 1]), MIN_DISTANCE_M)
            match what:
                case "range":
                    row[...] = s / np.maximum(_norm(s), MIN_DISTANCE_M)[..., None]
                case "azimuth":
                    row[..., 0], row[..., 1] = -s[..., 1] / level**2, s[..., 0] / level**2
                case "elevation":
                    square = np.maximum(_norm(s), MIN_DISTANCE_M) ** 2
                    row[..., :2] = -(s[..., 2] / (level * square))[..., None] * s[..., :2]
                    row[..., 2] = level / square
                case "x" | "y":
                    row[..., index] = 1.0
                case _:
                    _in_front(s)
                    focal = 1.0 if self.intrinsics is None else self.intrinsics.focal_px
                    row[..., 0] = focal * s[..., index + 1] / s[..., 0] ** 2
                    row[..., index + 1] = -focal / s[..., 0]
        return rows


MEASURED: dict[str, tuple[str, ...]] = {
    "range": ("range",),
    "bearing": ("azimuth",),
    "bearing3": ("azimuth", "elevation"),
    "range_bearing": ("range", "azimuth"),
    "vector": ("x", "y"),
    "pixel": ("u", "v"),
}
"""What the numbers of a relative measurement are."""


def _norm(vector: Array) -> Array:
    if vector.shape[-1] == 2:
        return np.asarray(np.hypot(vector[..., 0], vector[..., 1]))
    return np.asarray(np.sqrt(np.sum(vector**2, axis=-1)))


def _azimuth(vector: Array) -> Array:
    # Straight behind is the positive half turn: no negative zero, and not a hair beyond it.
    return np.maximum(np.arctan2(vector[..., 1] + 0.0, vector[..., 0]), LOWEST)


def _in_front(vector: Array) -> None:
    if not np.all(vector[..., 0] >= MIN_DEPTH_M):
        raise OutOfViewError("a point of the belief is behind the image plane")


def relative_model(
    measured: Observation | Measurement,
    observer: StateLayout,
    subject: StateLayout = UNICYCLE,
    landmark: tuple[float, ...] | None = None,
) -> RelativeModel:
    """The model of a measurement by a robot of state `observer`, of a state `subject` or of a `landmark`."""
    attitude = measured.attitude if isinstance(measured, Observation) else LEVEL
    return RelativeModel(measured.kind, observer, measured.mount, landmark, subject, attitude)


def told(observation: Observation) -> Measurement:
    """An observation as it is told to a peer: as if by a sensor on a level body."""
    mount = levelled(observation.mount, observation.attitude)
    return Measurement(observation.kind, observation.z, observation.R, mount)
