"""Courses that targets, and robots on the ground, follow whatever happens: pieces of constant turn rate about the
vertical, turns on the spot, and flight at random (`sim.wander`).

The velocity at instant k is the one that carried the target from instant k - 1 to k, so p(k) = p(k - 1) + dt v(k).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError, Finite, Part, Positive, Vector3
from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, StateLayout
from agent.settings import nanoseconds
from sim.wander import wandered

Array = NDArray[np.float64]


class PiecePart(Part):
    """For `for_s` the velocity turns at `turn_radps`, and at the end by `turn_rad` at once; to the left is positive."""

    for_s: Positive
    turn_radps: Finite = 0.0
    turn_rad: Finite = 0.0


class BendPart(Part):
    """For `for_s` the heading turns at `turn_radps`, to the left if that is positive."""

    for_s: Positive
    turn_radps: Finite = 0.0


class DrivePart(Part):
    """What a robot on the ground drives again and again, at its commanded speed."""

    pieces: list[BendPart]


KEYS: dict[str, tuple[str, ...]] = {
    "circle": ("lap_s", "side"),
    "square": ("turn_every_s", "side"),
    "pieces": ("pieces",),
    "wander": ("max_speed_mps", "max_acceleration_mps2", "reach_m", "min_altitude_m"),
}
"""The keys of each kind."""


class CoursePart(Part):
    """How the velocity of a target turns about the vertical; its size and its climb stay those of the start.

    A `circle` takes `lap_s`, to the left unless told otherwise; a `square` has a quarter turn every `turn_every_s`, to
    the right unless told otherwise; `pieces` are followed again and again. To `wander` is to fly at random from rest,
    not faster than `max_speed_mps`, not further than `reach_m` (of each axis) from the start, nor below
    `min_altitude_m`.
    """

    kind: Literal["circle", "square", "pieces", "wander"]
    lap_s: Positive = 20.0
    turn_every_s: Positive = 5.0
    side: Literal["left", "right"] | None = None
    pieces: list[PiecePart] = []
    max_speed_mps: Positive = 2.0
    max_acceleration_mps2: Positive = 1.0
    reach_m: Vector3 = [20.0, 20.0, 5.0]
    min_altitude_m: Finite = 2.0

    def stretches(self) -> list[PiecePart]:
        """The pieces of any kind but `wander`. Raises `ConfigError` without pieces."""
        if self.kind == "circle":
            sign = -1.0 if self.side == "right" else 1.0
            return [PiecePart(for_s=self.lap_s, turn_radps=sign * 2.0 * math.pi / self.lap_s)]
        if self.kind == "square":
            sign = 1.0 if self.side == "left" else -1.0
            return [PiecePart(for_s=self.turn_every_s, turn_rad=sign * 0.5 * math.pi)]
        if not self.pieces:
            raise ConfigError("course.pieces is missing; state at least one, for instance pieces = [{ for_s = 5.0 }]")
        return self.pieces

    def box(self, start: Array, axes: int) -> tuple[Array, Array]:
        """Lowest and highest corner (axes,) of where a target wanders from a `start` (axes or more,)."""
        reach = np.array(self.reach_m[:axes])
        low, high = start[:axes] - reach, start[:axes] + reach
        if axes == 3:
            low[2] = max(low[2], self.min_altitude_m)
        return low, high

    def check(self, model: str, start: list[float] | None = None) -> None:
        """Raises `ConfigError` if a target of `model` cannot follow it from a `start`, or for a key of another kind; a
        default that is stated is none.
        """
        for key, field in type(self).model_fields.items():
            if key != "kind" and key not in KEYS[self.kind] and getattr(self, key) != field.default:
                raise ConfigError(f"course.{key} is not of kind '{self.kind}'; leave it out")
        layout = LAYOUTS[model]
        if layout.heading is not None or layout.dim != 2 * len(layout.position):
            raise ConfigError(
                f"course: the model '{model}' does not move by a velocity alone; take 'constant_velocity_3d' or "
                "'constant_velocity'"
            )
        if self.kind != "wander":
            self.stretches()
        elif min(self.reach_m) <= 0.0:
            raise ConfigError("course.reach_m must be above 0 along each axis")
        elif start is not None and len(start) == layout.dim:
            axes = len(layout.position)
            if any(start[axes:]):
                raise ConfigError(f"course: who wanders starts at rest; end start.pose with {axes} zeros")
            if axes == 3 and start[2] < self.min_altitude_m:
                raise ConfigError(
                    f"course.min_altitude_m = {self.min_altitude_m:g} is above the start at {start[2]:g} m; lower it"
                )


def followed(
    course: CoursePart, layout: StateLayout, start: Array, step_ns: int, steps: int, seed: int = 0, name: str = ""
) -> Array:
    """True states (steps + 1, n) of position and velocity, in ENU [m, m/s], from a `start` (n,).

    A turn on the spot that is due at an instant is seen in the velocity of the next one: whoever turns every 5 s goes
    straight for all of them. Who wanders does so by draws of `seed` that are named by `name`.
    """
    if course.kind == "wander":
        low, high = course.box(start, len(layout.position))
        most = course.max_speed_mps, course.max_acceleration_mps2
        return wandered(layout, start, low, high, *most, step_ns * 1e-9, steps, seed, name)
    turned = _turned(course.stretches(), step_ns, steps)
    axes = len(layout.position)
    cos, sin = np.cos(turned), np.sin(turned)
    vx, vy = start[axes], start[axes + 1]
    track = np.tile(start, (steps + 1, 1))
    track[:, axes], track[:, axes + 1] = cos * vx - sin * vy, sin * vx + cos * vy
    moves = track[1:, axes:] * (step_ns * 1e-9)
    track[1:, :axes] += np.cumsum(moves, axis=0)
    return track


def driven_along(course: DrivePart, start: Array, speed_mps: float, step_ns: int, steps: int) -> tuple[Array, Array]:
    """True poses (steps + 1, 3) on the ground at a constant speed, and what a perfect odometry says of each step
    (steps, 3): straight on, and then the turn."""
    pieces = [PiecePart(for_s=piece.for_s, turn_radps=piece.turn_radps) for piece in course.pieces]
    turned = _turned(pieces, step_ns, steps)
    heading = start[2] + turned
    way = speed_mps * step_ns * 1e-9
    track = np.zeros((steps + 1, 3))
    track[0], track[:, 2] = start, wrap(heading)
    along = way * np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    track[1:, :2] = start[:2] + np.cumsum(along, axis=0)
    return track, np.stack([np.full(steps, way), np.zeros(steps), np.diff(turned)], axis=1)


def _turned(pieces: list[PiecePart], step_ns: int, steps: int) -> Array:
    """How far the velocity has turned [rad] at each instant (steps + 1,)."""
    edges = np.cumsum([0, *(nanoseconds(piece.for_s) for piece in pieces)])
    bent = np.cumsum([0.0, *(piece.turn_radps * piece.for_s for piece in pieces)])
    sharp = np.cumsum([0.0, *(piece.turn_rad for piece in pieces)])
    t_ns = np.arange(steps + 1) * step_ns
    laps, rest = np.divmod(t_ns, edges[-1])
    found = laps * bent[-1] + np.interp(rest, edges, bent)
    # Of turns on the spot those count that were due when the step began.
    laps, rest = np.divmod(np.maximum(t_ns - step_ns, 0), edges[-1])
    return np.asarray(found + laps * sharp[-1] + sharp[np.searchsorted(edges[1:], rest, side="right")])
