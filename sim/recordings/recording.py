"""What a recording of several robots holds, whatever its format: sightings, odometry and truth at their own stamps."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import between
from agent.estimation.observation import Intrinsics
from network.messages import Mount

Array = NDArray[np.float64]
Stamps = NDArray[np.int64]

VELOCITY_SPAN_NS = 250_000_000
"""Half the stretch of truth whose mean velocity counts as the velocity at its middle."""


class RecordingError(ValueError):
    """A recording that cannot be used; one line names the file and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Commanded velocities, held until the next stamp: t_ns (K,), v_mps (K,), w_radps (K,).

    `pose` (K, 3) is their exact integral from the first stamp.
    """

    t_ns: Stamps
    v_mps: Array
    w_radps: Array
    pose: Array


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Relative measurements: t_ns (K,), subject ids, range_m (K,) as recorded, bearing_rad (K,) left positive.

    `pixel` (K, 2) is of the robot's camera; None: it has none. What a sensor does not measure is NaN.
    """

    t_ns: Stamps
    subject: tuple[str, ...]
    range_m: Array
    bearing_rad: Array
    pixel: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Motion capture: t_ns (K,), pose x, y, heading (K, 3), in space x, y, z, heading (K, 4); heading unwrapped.

    The heading of what has none is 0.
    """

    t_ns: Stamps
    pose: Array


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated pinhole camera on its robot, see `agent.estimation.observation.RelativeModel`."""

    mount: Mount
    intrinsics: Intrinsics


@dataclass(frozen=True, slots=True, eq=False)
class RobotRecording:
    """What there is of one robot; None where the recording has no odometry, no truth, or no camera."""

    odometry: Odometry | None
    sightings: Sightings
    truth: Truth | None
    camera: Camera | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A whole recording. [start_ns, end_ns] is the span all robots have in common, see `common_span`.

    `left_out` names robots of which files are missing; `counters` says what was dropped and why.
    """

    robots: dict[str, RobotRecording]
    landmarks: dict[str, tuple[float, float]]
    start_ns: int
    end_ns: int
    counters: Counter[str] = field(default_factory=Counter)
    left_out: tuple[str, ...] = ()

    def _robot(self, name: str) -> RobotRecording:
        if name not in self.robots:
            raise RecordingError(f"the recording has no robot {name!r}; it has {', '.join(self.robots)}")
        return self.robots[name]

    def truth_at(self, robot: str, t_ns: int) -> Array:
        """True pose (3,) or (4,) interpolated linearly, heading wrapped.

        Raises `RecordingError` without truth, and outside its span: a pose there would be invented.
        """
        truth = self._robot(robot).truth
        if truth is None:
            raise RecordingError(f"the recording has no ground truth of {robot}")
        first, last = int(truth.t_ns[0]), int(truth.t_ns[-1])
        if not first <= t_ns <= last:
            raise RecordingError(f"{robot}: no ground truth at {t_ns} ns; it spans [{first}, {last}]")
        index = max(int(np.searchsorted(truth.t_ns, t_ns)), 1)
        if len(truth.t_ns) == 1:
            pose = truth.pose[0].copy()
        else:
            before, after = int(truth.t_ns[index - 1]), int(truth.t_ns[index])
            share = (t_ns - before) / (after - before)
            pose = truth.pose[index - 1] + share * (truth.pose[index] - truth.pose[index - 1])
        pose[-1] = wrap(pose[-1])
        return np.asarray(pose)

    def velocity_at(self, robot: str, t_ns: int) -> Array:
        """True velocity (2,) or (3,) around an instant, from truth 0.25 s to either side where it is known."""
        truth = self._robot(robot).truth
        first, last = (t_ns, t_ns) if truth is None else (int(truth.t_ns[0]), int(truth.t_ns[-1]))
        before, after = max(t_ns - VELOCITY_SPAN_NS, first), min(t_ns + VELOCITY_SPAN_NS, last)
        moved = self.truth_at(robot, after)[:-1] - self.truth_at(robot, before)[:-1]
        return moved / ((after - before) * 1e-9) if after > before else np.zeros_like(moved)

    def increment(self, robot: str, t0_ns: int, t1_ns: int) -> Array:
        """Odometry (dx, dy, dyaw) over [t0, t1] in the body frame at t0: held commands, integrated as arcs.

        Before its first command a robot stands; its last one is held on. Without odometry it is the true motion, of
        which a change of altitude is left out.
        """
        odometry = self._robot(robot).odometry
        if odometry is None:
            first, last = (self.truth_at(robot, t_ns)[[0, 1, -1]] for t_ns in (t0_ns, t1_ns))
            return between(first, last)
        return between(_integrated(odometry, t0_ns), _integrated(odometry, t1_ns))


def common_span(robots: dict[str, RobotRecording], margin_ns: int) -> tuple[int, int]:
    """From `margin_ns` after the last robot's first truth to the first robot's last truth.

    A robot without truth counts with its odometry.
    """
    stamps = [item.t_ns for robot in robots.values() if (item := robot.truth or robot.odometry) is not None]
    return max(int(t[0]) for t in stamps) + margin_ns, min(int(t[-1]) for t in stamps)


def _integrated(odometry: Odometry, t_ns: int) -> Array:
    """Integral (3,) of the commands from the first stamp to t."""
    index = int(np.searchsorted(odometry.t_ns, t_ns, side="right")) - 1
    if index < 0:
        return np.asarray(odometry.pose[0])
    dt = (t_ns - int(odometry.t_ns[index])) * 1e-9
    x, y, heading = (float(value) for value in odometry.pose[index])
    half = float(odometry.w_radps[index]) * dt / 2.0
    chord = float(odometry.v_mps[index]) * dt * (math.sin(half) / half if half else 1.0)
    return np.array([x + chord * math.cos(heading + half), y + chord * math.sin(heading + half), heading + 2.0 * half])
