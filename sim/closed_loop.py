"""Robots that choose their motion: their true poses are known as far as the world has been played.

A step is played when all commands before its end are in. The motion of a run that is over can be kept in a file, and
the world be asked again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.effects import Steer
from agent.estimation.gaussian import wrap
from agent.estimation.motion import LAYOUTS, PLANAR, compose
from sim.multirotor import Multirotor
from sim.noise import normal_rows
from sim.scenario import RobotPart, Scenario
from sim.vehicle import Vehicle

Array = NDArray[np.float64]

MOTION = "motion.bin"
"""The file of a run directory that `MotionWriter` makes."""

MOVES = 4
"""Numbers of an increment: forward, left, up [m], yaw [rad]."""


@dataclass(slots=True)
class Motion:
    """By robot, true states (steps + 1, n), and increments (steps, 4) as its vehicle has carried out what was told.

    NaN of what is not played.
    """

    states: dict[str, Array] = field(default_factory=dict)
    moved: dict[str, Array] = field(default_factory=dict)

    def row(self, k: int) -> Array:
        """All numbers of instant k: of each robot the state, and the increment that led to it (NaN at the start)."""
        parts = []
        for robot, states in self.states.items():
            parts += [states[k], self.moved[robot][k - 1] if k else np.full(MOVES, np.nan)]
        return np.concatenate(parts)

    def put(self, k: int, row: Array) -> None:
        """The opposite of `row`."""
        place = 0
        for robot, states in self.states.items():
            n = states.shape[1]
            states[k] = row[place : place + n]
            if k:
                self.moved[robot][k - 1] = row[place + n : place + n + MOVES]
            place += n + MOVES


class ClosedLoop:
    """The vehicles of all robots that choose their motion.

    A step's pose is x' = x (+) (u + w): u as the vehicle has carried it out, w of the covariance that an odometry of
    the robot's `noise` has. Draws are named by robot and step, whatever is commanded.
    """

    def __init__(self, scenario: Scenario, motion: Motion, seed: int, step_ns: int) -> None:
        """`motion` is filled as the world is played; its states are there but for the poses after the start."""
        self.motion, self._step_ns, self._step_s = motion, step_ns, scenario.step_s
        self.played = 0
        robots = {robot.id: robot for robot in scenario.robots}
        self._robots = {name: robots[name] for name in motion.states}
        self._vehicles = {
            name: Multirotor(robot.vehicle) if robot.vehicle.flies else Vehicle(robot.vehicle)
            for name, robot in self._robots.items()
        }
        steps = {name: len(moved) for name, moved in motion.moved.items()}
        self._noise = {
            name: robot.noise.odometry(scenario.step_s, robot.vehicle.flies) for name, robot in self._robots.items()
        }
        self._draws = {
            name: normal_rows(seed, count, MOVES if self._robots[name].vehicle.flies else 2, name, "control")
            for name, count in steps.items()
        }

    def steer(self, robot: str, t_ns: int, steer: Steer) -> None:
        """Raises `ValueError` for a robot without planning."""
        if robot not in self._vehicles:
            raise ValueError(f"{robot} does not choose its motion; give it a planning.kind")
        self._vehicles[robot].steer(t_ns, steer)

    def play(self, k: int) -> None:
        """Drive from instant k - 1 to k. Raises `RuntimeError` out of order."""
        if k != self.played + 1:
            raise RuntimeError(f"step {k} of a closed loop after step {self.played}: ask for each step once, in order")
        for name, robot in self._robots.items():
            moved, flies = self._vehicles[name].advance(k * self._step_ns), robot.vehicle.flies
            if not flies:
                moved = increment(robot, moved, self._step_s)
            self.motion.moved[name][k - 1] = moved
            variances = np.diagonal(self._noise[name].covariance(moved, self._step_s))
            noisy = list(range(MOVES)) if flies else [0, 3]
            off = np.zeros(MOVES)
            off[noisy] = np.sqrt(variances[noisy]) * self._draws[name][k - 1]
            states, planar = self.motion.states[name], planar_of(robot)
            pose = compose(states[k - 1, planar], (moved + off)[list(PLANAR)])
            pose[2] = wrap(pose[2])
            states[k, planar] = pose
            if flies:
                states[k, 2] = states[k - 1, 2] + moved[2] + off[2]
        self.played = k


def increment(robot: RobotPart, moved: Array, step_s: float) -> Array:
    """What a vehicle has carried out, (3,), as an odometry tells it, (4,)."""
    found = np.zeros(MOVES)
    found[list(PLANAR)] = moved
    found[2] = step_s * robot.control.climb_mps
    return found


def planar_of(robot: RobotPart) -> list[int]:
    """Where x, y and the heading sit in the state of a robot."""
    heading = LAYOUTS[robot.model].heading
    assert heading is not None
    return [0, 1, heading]


class MotionWriter:
    """A file that `read_motion` reads: an instant after the other, as little-endian float64."""

    def __init__(self, path: Path, motion: Motion) -> None:
        self._file, self._motion = path.open("wb"), motion

    def add(self, k: int) -> None:
        """Keep instant k, the one after that before; at once, for the run may be looked at while it goes on."""
        self._file.write(self._motion.row(k).astype("<f8").tobytes())
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read_motion(path: Path, motion: Motion) -> None:
    """Fill `motion` with what a file holds, as far as it goes. Raises `OSError`."""
    size = len(motion.row(0))
    rows = np.fromfile(path, dtype="<f8")
    for k, row in enumerate(rows[: len(rows) // size * size].reshape(-1, size)):
        motion.put(k, row)
