"""A little world of leaders and pods without a network: bearings of nobody knows whom, and teams that sort them out.

Two leaders and three pods start at random places in 10 x 10 m, at least 2 m apart, and move on arcs; nobody knows where
anybody is. Noises are those of De Silva, Mann, Gosine 2015, section III: 0.0036 rad^2 of bearings, 5 mm^2 of heights,
8 mm^2 of ranges, 0.05 (m/s)^2 and 0.01 (rad/s)^2 of velocities per sample. Steps at 20 Hz, scans at 10 Hz, fusion of
what leaders tell at 1 Hz.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from agent.estimation.correspondence import BodyMotion, Correspondence, CorrespondenceSettings, Scan
from agent.estimation.gaussian import wrap

Array = NDArray[np.float64]
Story = Literal["arcs", "kidnapped", "mirror"]

DT, SCAN_S = 0.05, 0.1
LEADERS = ("l1", "l2")
ROBOTS = ("l1", "l2", "p1", "p2", "p3")
BEARING_VAR, HEIGHT_VAR, RANGE_VAR = 0.0036, 5e-6, 8e-6
VELOCITY_COV = np.diag([0.05, 0.05, 0.05, 0.01])
ELEVATIONS = (-0.25 * np.pi, 0.25 * np.pi)
KIDNAPPED_S, TURNING_S = 15.0, 12.0
MIDDLE = float(chi2.median(4)) / 4.0
"""Median of the NEES per degree of freedom of an honest filter: wrong hypotheses would be all that a mean shows."""
RIGHT_M, FOR_S, TAIL_S = 0.5, 2.0, 10.0


@dataclass(frozen=True, eq=False)
class World:
    """Truth (k, n, 4): places and headings of all robots in one frame after each step; velocities (k, n, 4) of the step
    in each one's body frame, as measured."""

    truth: Array
    measured: Array

    def relative(self, step: int, i: int, j: int) -> Array:
        """State (4,) of j in the body frame of i."""
        of, to = self.truth[step, i], self.truth[step, j]
        c, s = np.cos(of[3]), np.sin(of[3])
        d = to[:3] - of[:3]
        return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], d[2], float(wrap(to[3] - of[3]))])


@dataclass(eq=False)
class Run:
    """Of each leader and peer (pairs,): errors (k, pairs, 4) of the dominant hypothesis, NaN where there is none; NEES
    (k, pairs); weights, tracks (k, pairs); seconds per step and leader."""

    errors: Array
    nees: Array
    weights: Array
    ambiguity: Array
    tracks: Array
    pairs: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0

    def right(self, at_s: float, which: NDArray[np.bool_] | slice = slice(None)) -> float:
        """Share of pairs whose dominant hypothesis is within half a metre."""
        return float(np.mean(self._right()[round(at_s / SCAN_S) - 1, which]))

    def identified(self) -> Array:
        """When each pair was right for two seconds for the first time; infinite if never."""
        good, need = self._right(), round(FOR_S / SCAN_S)
        found = np.full(good.shape[1], np.inf)
        for pair in range(good.shape[1]):
            for k in range(len(good) - need + 1):
                if good[k : k + need, pair].all():
                    found[pair] = k * SCAN_S
                    break
        return found

    def _right(self) -> NDArray[np.bool_]:
        return np.linalg.norm(self.errors[..., :3], axis=-1) < RIGHT_M


def world(seed: int, seconds: float, story: Story = "arcs") -> World:
    rng = np.random.default_rng([seed, 0])
    n, steps = len(ROBOTS), round(seconds / DT)
    pose = np.zeros((n, 4))
    while True:
        pose[:, :2] = rng.uniform(0.0, 10.0, size=(n, 2))
        apart = np.linalg.norm(pose[:, None, :2] - pose[None, :, :2], axis=-1) + 10.0 * np.eye(n)
        if apart.min() >= 2.0:
            break
    pose[:, 2] = rng.uniform(0.0, 2.0, size=n)
    pose[:, 3] = rng.uniform(-np.pi, np.pi, size=n)
    speed = rng.uniform(0.4, 0.8, size=n)
    rate = rng.uniform(0.1, 0.25, size=n) * rng.choice([-1.0, 1.0], size=n)
    climb, phase = rng.uniform(0.1, 0.3, size=n), rng.uniform(-np.pi, np.pi, size=n)
    if story == "mirror":
        _mirrored(pose, speed, climb, phase, rng)
    truth, true = np.empty((steps, n, 4)), np.empty((steps, n, 4))
    for k in range(steps):
        turning = rate if story != "mirror" or k * DT >= TURNING_S else np.zeros(n)
        up = climb * np.cos(0.5 * k * DT + phase)
        true[k] = np.stack([speed, np.zeros(n), up, turning], axis=-1)
        pose[:, 0] += DT * speed * np.cos(pose[:, 3])
        pose[:, 1] += DT * speed * np.sin(pose[:, 3])
        pose[:, 2] += DT * up
        pose[:, 3] += DT * turning
        if story == "kidnapped" and k == round(KIDNAPPED_S / DT):
            angle = rng.uniform(-np.pi, np.pi)
            pose[2, :2] += 4.0 * np.array([np.cos(angle), np.sin(angle)])
            pose[2, 3] += 2.0
        truth[k] = pose
    noise = rng.normal(size=true.shape) * np.sqrt(np.diag(VELOCITY_COV))
    return World(truth, true + noise)


def _mirrored(pose: Array, speed: Array, climb: Array, phase: Array, rng: np.random.Generator) -> None:
    """Leaders on a line, along which they move straight, and two pods on either side of it that mirror each other."""
    pose[0], pose[1] = [0.0, 0.0, 1.0, 0.0], [3.0, 0.0, 1.2, 0.0]
    x, y, away = rng.uniform(2.0, 6.0), rng.uniform(2.0, 4.0), rng.uniform(0.1, 0.4)
    z = rng.uniform(0.5, 1.5)
    pose[2], pose[3] = [x, y, z, away], [x, -y, z, -away]
    speed[3], climb[3], phase[3] = speed[2], climb[2], phase[2]


def scan_of(made: World, step: int, leader: int, detection: float, clutter: float, rng: np.random.Generator) -> tuple:
    """What a leader senses after a step, and the index of each seen robot's bearing."""
    ranges, heights, bearings, whose = {}, {}, [], []
    for j, peer in enumerate(ROBOTS):
        if j == leader:
            continue
        x = made.relative(step, leader, j)
        heights[peer] = (x[2] + np.sqrt(HEIGHT_VAR) * rng.normal(), HEIGHT_VAR)
        if rng.uniform() < detection:
            ranges[peer] = (float(np.linalg.norm(x[:3])) + np.sqrt(RANGE_VAR) * rng.normal(), RANGE_VAR)
        if rng.uniform() < detection:
            bearing = np.array([np.arctan2(x[1], x[0]), np.arctan2(x[2], np.hypot(x[0], x[1]))])
            bearings.append(bearing + np.sqrt(BEARING_VAR) * rng.normal(size=2))
            whose.append(peer)
    for _ in range(rng.poisson(clutter)):
        bearings.append(np.array([rng.uniform(-np.pi, np.pi), rng.uniform(*ELEVATIONS)]))
        whose.append("")
    order = rng.permutation(len(bearings))
    stacked = np.array([bearings[index] for index in order]).reshape(-1, 2)
    stacked[:, 0] = wrap(stacked[:, 0])
    labels = {whose[index]: row for row, index in enumerate(order) if whose[index]}
    return Scan(stacked, BEARING_VAR * np.eye(2), ranges, heights), labels


def play(
    made: World,
    seed: int,
    settings: CorrespondenceSettings,
    detection: float = 0.95,
    clutter: float = 1.0,
    lost: float = 0.0,
    known: bool = False,
    fuse: bool = True,
) -> Run:
    """A team in a world; `lost` is the share of broadcasts that do not arrive."""
    rng = np.random.default_rng([seed, 1])
    teams = {robot: Correspondence(settings, [peer for peer in ROBOTS if peer != robot], robot) for robot in LEADERS}
    pairs = [(leader, peer) for leader in LEADERS for peer in ROBOTS if peer != leader]
    steps = len(made.truth)
    errors, nees = np.full((steps // 2, len(pairs), 4), np.nan), np.full((steps // 2, len(pairs)), np.nan)
    weights, ambiguity, tracks = (np.zeros((steps // 2, len(pairs))) for _ in range(3))
    spent = 0.0
    for k in range(steps):
        motions = {robot: BodyMotion(made.measured[k, j], VELOCITY_COV) for j, robot in enumerate(ROBOTS)}
        scans = {}
        if k % 2 == 1:
            scans = {robot: scan_of(made, k, ROBOTS.index(robot), detection, clutter, rng) for robot in LEADERS}
        began = time.process_time()
        for robot, own in teams.items():
            own.advance(motions[robot], {peer: motions[peer] for peer in own.peers}, DT)
            if robot in scans:
                scan, labels = scans[robot]
                own.scan(scan, labels if known else None)
        if fuse and k % 20 == 19:
            told = {robot: {peer: own.told(peer) for peer in own.peers} for robot, own in teams.items()}
            for robot, own in teams.items():
                for leader in LEADERS:
                    if leader != robot and rng.uniform() >= lost:
                        own.fuse(leader, told[leader])
                own.fused()
        spent += time.process_time() - began
        if not scans:
            continue
        k //= 2
        for index, (robot, peer) in enumerate(pairs):
            found = teams[robot].dominant(peer)
            if found is None:
                continue
            error = found.mean - made.relative(2 * k + 1, ROBOTS.index(robot), ROBOTS.index(peer))
            error[3] = wrap(error[3])
            errors[k, index] = error
            nees[k, index] = error @ np.linalg.solve(found.cov, error)
            weights[k, index], ambiguity[k, index], tracks[k, index] = found.weight, found.ambiguity, found.tracks
    return Run(errors, nees, weights, ambiguity, tracks, pairs, spent / steps / len(LEADERS))


def joined(runs: list[Run]) -> Run:
    """Pairs of many runs side by side."""
    parts = ("errors", "nees", "weights", "ambiguity", "tracks")
    stacked = [np.concatenate([getattr(run, name) for run in runs], axis=1) for name in parts]
    pairs = [pair for run in runs for pair in run.pairs]
    return Run(*stacked, pairs, float(np.median([run.seconds for run in runs])))


def row(runs: list[Run], at_s: tuple[float, ...], which: tuple[str, ...] = ROBOTS) -> str:
    """One line of a table: shares identified at some times, time to identify, errors, consistency, tracks, cost."""
    made = joined(runs)
    chosen = np.array([peer in which for _, peer in made.pairs])
    tail = slice(-round(TAIL_S / SCAN_S), None)
    place = np.linalg.norm(made.errors[tail, chosen, :3], axis=-1)
    turn = np.abs(made.errors[tail, chosen, 3])
    nees = made.nees[tail, chosen] / 4.0
    when = made.identified()[chosen]
    return " | ".join(
        [
            " ".join(f"{100.0 * made.right(at, chosen):.0f}" for at in at_s),
            f"{np.median(when):.2f}, {np.percentile(when, 90, method='lower'):.1f}",
            f"{np.sqrt(np.nanmean(place**2)):.2f} ({np.nanmedian(place):.2f})",
            f"{np.degrees(np.sqrt(np.nanmean(turn**2))):.1f} ({np.degrees(np.nanmedian(turn)):.1f})",
            f"{np.nanmedian(nees) / MIDDLE:.2f}",
            f"{made.tracks[: round(5.0 / SCAN_S), chosen].mean():.1f} / {made.tracks[tail, chosen].mean():.1f}",
            f"{1e3 * made.seconds:.2f} ms",
        ]
    )
