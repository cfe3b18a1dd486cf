"""Courses that targets follow whatever happens: pieces of constant turn rate about the vertical, and turns on the spot.

The velocity at instant k is the one that carried the target from instant k - 1 to k, so p(k) = p(k - 1) + dt v(k).
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError, Finite, Part, Positive
from agent.estimation.motion import LAYOUTS, StateLayout
from agent.settings import nanoseconds

Array = NDArray[np.float64]


class PiecePart(Part):
    """For `for_s` the velocity turns at `turn_radps`, and at the end by `turn_rad` at once; to the left is positive."""

    for_s: Positive
    turn_radps: Finite = 0.0
    turn_rad: Finite = 0.0


class CoursePart(Part):
    """How the velocity of a target turns about the vertical; its size and its climb stay those of the start.

    A `circle` takes `lap_s`, to the left unless told otherwise; a `square` has a quarter turn every `turn_every_s`, to
    the right unless told otherwise; `pieces` are followed again and again.
    """

    kind: Literal["circle", "square", "pieces"]
    lap_s: Positive = 20.0
    turn_every_s: Positive = 5.0
    side: Literal["left", "right"] | None = None
    pieces: list[PiecePart] = []

    def stretches(self) -> list[PiecePart]:
        """The pieces of any kind. Raises `ConfigError` for a key of another kind, and without pieces; a default that is
        stated is none.
        """
        own = {"circle": ("lap_s", "side"), "square": ("turn_every_s", "side"), "pieces": ("pieces",)}[self.kind]
        for key in ("lap_s", "turn_every_s", "side", "pieces"):
            if key not in own and getattr(self, key) != type(self).model_fields[key].default:
                raise ConfigError(f"course.{key} is not of kind '{self.kind}'; leave it out")
        if self.kind == "circle":
            sign = -1.0 if self.side == "right" else 1.0
            return [PiecePart(for_s=self.lap_s, turn_radps=sign * 2.0 * math.pi / self.lap_s)]
        if self.kind == "square":
            sign = 1.0 if self.side == "left" else -1.0
            return [PiecePart(for_s=self.turn_every_s, turn_rad=sign * 0.5 * math.pi)]
        if not self.pieces:
            raise ConfigError("course.pieces is missing; state at least one, for instance pieces = [{ for_s = 5.0 }]")
        return self.pieces

    def check(self, model: str) -> None:
        """Raises `ConfigError` if a target of `model` cannot follow it."""
        self.stretches()
        layout = LAYOUTS[model]
        if layout.heading is not None or layout.dim != 2 * len(layout.position):
            raise ConfigError(
                f"course: the model '{model}' does not move by a velocity alone; take 'constant_velocity_3d' or "
                "'constant_velocity'"
            )


def followed(course: CoursePart, layout: StateLayout, start: Array, step_ns: int, steps: int) -> Array:
    """True states (steps + 1, n) of position and velocity, in ENU [m, m/s], from a `start` (n,).

    A turn on the spot that is due at an instant is seen in the velocity of the next one: whoever turns every 5 s goes
    straight for all of them.
    """
    turned = _turned(course.stretches(), step_ns, steps)
    axes = len(layout.position)
    cos, sin = np.cos(turned), np.sin(turned)
    vx, vy = start[axes], start[axes + 1]
    track = np.tile(start, (steps + 1, 1))
    track[:, axes], track[:, axes + 1] = cos * vx - sin * vy, sin * vx + cos * vy
    moves = track[1:, axes:] * (step_ns * 1e-9)
    track[1:, :axes] += np.cumsum(moves, axis=0)
    return track


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
