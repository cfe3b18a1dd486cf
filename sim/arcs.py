"""Robots that fly arcs: at a speed and turn rate drawn for each trial, up and down, exactly as told.

Their odometry errs, and not the robots: what it reports is the true motion of each step and noise of the covariance it
states. A robot that is kidnapped is set down elsewhere, which no odometry reports.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from agent.config_file import ConfigError, Finite, Id, NotNegative, Part, Positive, Vector2
from agent.estimation.gaussian import wrap
from sim.noise import generator

Array = NDArray[np.float64]


class KidnapPart(Part):
    """At `at_s` the robot is set down `by_m` away, in a direction drawn from the seed, and turned by `turn_rad`."""

    at_s: Positive
    by_m: NotNegative = 4.0
    turn_rad: Finite = 2.0


class ArcPart(Part):
    """A course of a robot in space, in its own body frame. Pairs of numbers are bounds of an even draw.

    It turns to a side that is drawn too, unless `side` says so; from `turns_from_s` on, straight before. Its climb is a
    wave of amplitude `climb_mps` and angular rate `wave_radps`, of a phase that is drawn. What is drawn for a robot
    with `as_of` is what is drawn for that one.
    """

    speed_mps: Vector2 = [0.4, 0.8]
    turn_radps: Vector2 = [0.1, 0.25]
    side: Finite | None = None
    climb_mps: Vector2 = [0.1, 0.3]
    wave_radps: NotNegative = 0.5
    turns_from_s: NotNegative = 0.0
    as_of: Id | None = None
    kidnapped: KidnapPart | None = None

    def check(self) -> None:
        """Raises `ConfigError` for bounds the wrong way round, or a side that is none."""
        for key in ("speed_mps", "turn_radps", "climb_mps"):
            low, high = getattr(self, key)
            if not 0.0 <= low <= high:
                raise ConfigError(
                    f"arc.{key} = [{low:g}, {high:g}] is no span; state two bounds, not below 0, the lower one first"
                )
        if self.side not in (None, 1.0, -1.0):
            raise ConfigError(f"arc.side = {self.side:g} is none; 1 is to the left, -1 to the right")


def flown(arc: ArcPart, start: Array, step_s: float, steps: int, seed: int, name: str) -> tuple[Array, Array]:
    """True states (steps + 1, 4) of x, y, z, heading from a `start` (4,), and motions (steps, 4) of the steps.

    A motion is dx, dy, dz, dyaw in the body frame at its beginning. Draws are named by the robot.
    """
    draws = generator(seed, arc.as_of or name, "arc").random(5)
    speed, turn, climb = (
        low + float(draw) * (high - low)
        for (low, high), draw in zip((arc.speed_mps, arc.turn_radps, arc.climb_mps), draws)
    )
    side = arc.side if arc.side is not None else math.copysign(1.0, float(draws[3]) - 0.5)
    t_s = np.arange(steps) * step_s
    moves = np.zeros((steps, 4))
    moves[:, 0] = speed
    moves[:, 2] = climb * np.cos(arc.wave_radps * t_s + 2.0 * math.pi * float(draws[4]))
    moves[:, 3] = np.where(t_s >= arc.turns_from_s - 1e-9, side * turn, 0.0)
    moves *= step_s
    shifts, turns = np.zeros((steps, 2)), moves[:, 3].copy()
    if arc.kidnapped is not None:
        at = round(arc.kidnapped.at_s / step_s)
        if at < steps:
            angle = generator(seed, name, "kidnapped").uniform(-math.pi, math.pi)
            shifts[at] = arc.kidnapped.by_m * np.array([math.cos(angle), math.sin(angle)])
            turns[at] += arc.kidnapped.turn_rad
    heading = start[3] + np.concatenate([[0.0], np.cumsum(turns)])
    along = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1) * moves[:, :1] + shifts
    track = np.empty((steps + 1, 4))
    track[:, :2] = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(along, axis=0)])
    track[:, 2] = start[2] + np.concatenate([[0.0], np.cumsum(moves[:, 2])])
    track[:, 3] = wrap(heading)
    return track, moves
