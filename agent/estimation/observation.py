"""Observation models: absolute information and relative measurements of a peer, a target or a landmark.

A relative model maps the observer's pose (x, y, heading, ...) and the position of what it sees to a
measurement; both are read from one stacked vector so that a transform can be drawn over their joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import StateLayout

Array = NDArray[np.float64]

RELATIVE_ANGLES: dict[str, tuple[int, ...]] = {"range": (), "bearing": (0,), "range_bearing": (1,), "vector": ()}
"""Kinds of relative measurement and their wrapped components."""

ABSOLUTE: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    "position": ((0, 1), ()),
    "pose": ((0, 1, 2), (2,)),
    "heading": ((2,), (0,)),
}
"""Kinds of absolute information: (observed state components, wrapped measurement components)."""

NO_MOUNT = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteModel:
    """z = selected components of a state of `layout`."""

    kind: str
    layout: StateLayout

    @property
    def angles(self) -> tuple[int, ...]:
        return ABSOLUTE[self.kind][1]

    def h(self, state: Array) -> Array:
        return np.asarray(state[..., list(ABSOLUTE[self.kind][0])])

    def jacobian(self, state: Array) -> Array:
        components = ABSOLUTE[self.kind][0]
        H = np.zeros((*state.shape[:-1], len(components), self.layout.dim))
        for row, column in enumerate(components):
            H[..., row, column] = 1.0
        return H


@dataclass(frozen=True, slots=True, eq=False)
class RelativeModel:
    """Range [m], bearing [rad] or both from an observer to a subject, or the `vector` x, y [m] in the sensor's frame.

    The stacked state is [observer; subject], the subject's position being its first two components, or
    `landmark` (2,) when given (the stack is then the observer alone). `mount` is the sensor's lever arm x, y
    [m, FLU] and yaw [rad] on the observer's body. The observer needs a heading unless the kind is `range` and
    the lever arm is zero.
    """

    kind: str
    observer: StateLayout
    mount: tuple[float, float, float] = NO_MOUNT
    landmark: tuple[float, float] | None = None

    @property
    def angles(self) -> tuple[int, ...]:
        return RELATIVE_ANGLES[self.kind]

    def _geometry(self, state: Array) -> tuple[Array, Array]:
        """Vector (..., 2) from sensor to subject in ENU, and the vector (..., 2) of the lever arm in ENU."""
        subject: Array
        if self.landmark is not None:
            subject = np.asarray(self.landmark)
        else:
            subject = state[..., self.observer.dim : self.observer.dim + 2]
        x, y, _ = self.mount
        if x == 0.0 and y == 0.0:
            lever = np.zeros((*state.shape[:-1], 2))
        else:
            cos, sin = np.cos(state[..., 2]), np.sin(state[..., 2])
            lever = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
        return subject - state[..., :2] - lever, lever

    def _turn(self, state: Array) -> Array:
        """Rotation (..., 2, 2) from ENU into the sensor's frame."""
        angle = state[..., 2] + self.mount[2]
        cos, sin = np.cos(angle), np.sin(angle)
        return np.stack([np.stack([cos, sin], axis=-1), np.stack([-sin, cos], axis=-1)], axis=-2)

    def h(self, state: Array) -> Array:
        """Measurement (..., m) of a stacked state (..., n)."""
        d, _ = self._geometry(state)
        if self.kind == "vector":
            return np.asarray((self._turn(state) @ d[..., None])[..., 0])
        distance = np.hypot(d[..., 0], d[..., 1])
        if self.kind == "range":
            return np.asarray(distance[..., None])
        bearing = wrap(np.arctan2(d[..., 1], d[..., 0]) - state[..., 2] - self.mount[2])
        if self.kind == "bearing":
            return np.asarray(bearing[..., None])
        return np.stack([distance, bearing], axis=-1)

    def jacobian(self, state: Array) -> Array:
        """H (..., m, n). Distances below 1 mm are taken as 1 mm: the bearing is undefined at the sensor."""
        d, lever = self._geometry(state)
        n = state.shape[-1]
        if self.kind == "vector":
            turn = self._turn(state)
            H = np.zeros((*state.shape[:-1], 2, n))
            H[..., :2] = -turn
            if self.landmark is None:
                H[..., self.observer.dim : self.observer.dim + 2] = turn
            seen = (turn @ (d + lever)[..., None])[..., 0]
            H[..., 0, 2], H[..., 1, 2] = seen[..., 1], -seen[..., 0]
            return H
        distance = np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-3)
        unit = d / distance[..., None]
        normal = np.stack([-unit[..., 1], unit[..., 0]], axis=-1) / distance[..., None]
        turned = np.stack([-lever[..., 1], lever[..., 0]], axis=-1)
        rows = []
        for direction, is_bearing in ((unit, False), (normal, True)):
            if self.kind != "range_bearing" and is_bearing != (self.kind == "bearing"):
                continue
            row = np.zeros((*state.shape[:-1], n))
            row[..., :2] = -direction
            if self.landmark is None:
                row[..., self.observer.dim : self.observer.dim + 2] = direction
            if is_bearing or np.any(lever):
                row[..., 2] = -np.sum(direction * turned, axis=-1) - (1.0 if is_bearing else 0.0)
            rows.append(row)
        return np.stack(rows, axis=-2)
