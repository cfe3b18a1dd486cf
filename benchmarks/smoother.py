"""Filters that triangulate beside a factor-graph smoother: `python -m benchmarks.smoother`, which needs gtsam.

Bearings are those of `stt-circle` and `stt-square`. The smoother has them all in one place, as the centralized filters
do: a state of place and velocity per step, a factor of white acceleration between two of them, and one of the
directions of a step. The whole graph is optimized anew at every step, from where the last optimum was, as in the
published comparison (STT 2023, Table 1). `newest` is what it says of a step at that step, `smoothed` what it says of it
in the end. It is one of plain least squares, as `plain` is, which is `central_plus` without its weights against
directions that are off. Filters of robots are played robot by robot, each hears its nearest; there are no messages
here. Times are of whole trials on one core, as ratios to the first filter's.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.bearing_filters import Kind, acceleration_noise, build
from agent.estimation.direction import directed
from agent.estimation.motion import LAYOUTS
from agent.estimation.observation import RelativeModel
from agent.estimation.sights import Sight, projection
from agent.estimation.triangulation import transition
from agent.triangulator import density
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world

Array = NDArray[np.float64]

SCENARIOS = ("stt-circle", "stt-square")
CENTRALIZED: tuple[Kind, ...] = ("ckf", "central_plus")
DISTRIBUTED: tuple[Kind, ...] = ("stt", "icf_plus")
TAIL_S = 10.0
PLAIN = 1e6
"""A gate that lets anything pass."""

START_M, START_MPS = 30.0, 5.0
MISSING = "benchmarks.smoother: gtsam is not installed; python -m pip install --editable '.[smoother]'"


@dataclass(frozen=True, slots=True, eq=False)
class Bearings:
    """What n cameras at places (n, 3) saw of a target of states (k, 6), at steps of `dt` [s].

    directions (k, n, 3), sigma (k, n) of each per tangent axis; near (n, m): whom each hears; q: density [m^2/s^3].
    """

    truth: Array
    places: Array
    directions: Array
    sigma: Array
    near: NDArray[np.int64]
    dt: float
    q: float


@dataclass(frozen=True, slots=True, eq=False)
class Played:
    """Errors (k, 6) or (k, n, 6) of one trial, and how long it took."""

    errors: Array
    took_s: float


def bearings(scenario: Scenario, seed: int) -> Bearings:
    """Of one trial. Raises ValueError if a camera does not see the target once per step."""
    world = open_world(scenario, seed)
    (target,) = scenario.targets
    robots = [robot.id for robot in scenario.robots]
    shape = world.steps, len(robots)
    directions, sigma = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    for k in range(world.steps):
        for item in world.outputs(k + 1):
            if item.of != f"target:{target.id}":
                continue
            part = next(part for part in scenario.robots if part.id == item.robot)
            model = RelativeModel(item.kind, LAYOUTS[part.model], subject=LAYOUTS[target.model])
            found = directed(model, *world.start_belief(item.robot), item.z, item.R)
            if found is not None:
                row = k, robots.index(item.robot)
                directions[row], sigma[row] = found.direction, found.sigma_rad
    if np.isnan(sigma).any():
        raise ValueError(f"{scenario.name}: all cameras must see the target at each step; leave their rates")
    places = np.array([world.place(robot, 0) for robot in robots])
    gaps = np.linalg.norm(places[:, None] - places, axis=-1)
    near = np.argsort(gaps, axis=-1)[:, 1 : 1 + (scenario.links.nearest or len(robots))]
    truth = np.array([world.truth(target.id, k + 1) for k in range(world.steps)])
    return Bearings(
        truth, places, directions, sigma, near, scenario.step_s, density(target.motion(scenario.step_s))
    )


def _options(kind: Kind, made: Bearings) -> dict[str, float]:
    return {"q": made.q} if kind.endswith("_plus") else {}


def centralized(kind: Kind, made: Bearings, **options: float) -> Played:
    """A filter that has all bearings; `options` of it."""
    began = time.perf_counter()
    chosen, errors = build(kind, _options(kind, made) | options), []
    state = chosen.start(made.places.mean(axis=0))
    for truth, directions, sigma in zip(made.truth, made.directions, made.sigma):
        sights = [Sight(*seen) for seen in zip(made.places, directions, sigma)]
        state = chosen.step(state, made.dt, sights, [])
        errors.append(state.mean - truth)
    return Played(np.array(errors), time.perf_counter() - began)


def distributed(kind: Kind, made: Bearings) -> Played:
    """Each camera's own filter, which hears its nearest at once."""
    began = time.perf_counter()
    chosen, errors = build(kind, _options(kind, made)), []
    states = [chosen.start(place) for place in made.places]
    for truth, directions, sigma in zip(made.truth, made.directions, made.sigma):
        sights = [Sight(*seen) for seen in zip(made.places, directions, sigma)]
        told = [chosen.predicted(state, made.dt) for state in states]
        states = [
            chosen.step(state, made.dt, [sights[own], *(sights[j] for j in near)], [told[j] for j in near])
            for own, (state, near) in enumerate(zip(states, made.near))
        ]
        errors.append([state.mean - truth for state in states])
    return Played(np.array(errors), time.perf_counter() - began)


class Smoother:
    """The graph of all steps so far, and its optimum."""

    def __init__(self, made: Bearings, gtsam: Any) -> None:
        self._made, self._gtsam = made, gtsam
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._count = 0
        self._motion = gtsam.noiseModel.Gaussian.Covariance(acceleration_noise(made.dt, made.q))
        self._options = gtsam.LevenbergMarquardtParams()
        self._options.setRelativeErrorTol(1e-4)
        self._options.setMaxIterations(20)

    def step(self) -> Array:
        """Take in the next step; its state (6,), optimized with all before."""
        gtsam, made, k = self._gtsam, self._made, self._count
        noise = gtsam.noiseModel
        if k == 0:
            first = np.append(nearest(made.places, made.directions[0]), np.zeros(3))
            middle = np.append(made.places.mean(axis=0), np.zeros(3))
            start = noise.Diagonal.Sigmas(np.array([START_M] * 3 + [START_MPS] * 3))
            self._graph.add(gtsam.PriorFactorVector(0, middle, start))
        else:
            first = transition(made.dt) @ self._values.atVector(k - 1)
            self._graph.add(gtsam.CustomFactor(self._motion, [k - 1, k], motion_error(transition(made.dt))))
        across = noise.Diagonal.Sigmas(np.repeat(made.sigma[k], 2))
        self._graph.add(gtsam.CustomFactor(across, [k], bearing_error(made.places, made.directions[k])))
        self._values.insert(k, first)
        self._count += 1
        self._values = gtsam.LevenbergMarquardtOptimizer(self._graph, self._values, self._options).optimize()
        return np.asarray(self._values.atVector(k))

    def states(self) -> Array:
        """Of all steps (k, 6), as all data say."""
        return np.array([self._values.atVector(k) for k in range(self._count)])


def nearest(places: Array, directions: Array) -> Array:
    """The place (3,) nearest to all rays."""
    P = projection(directions / np.linalg.norm(directions, axis=-1)[:, None])
    return np.asarray(np.linalg.solve(P.sum(axis=0), (P @ places[..., None])[..., 0].sum(axis=0)))


Error = Callable[[Any, Any, Any], Array]


def motion_error(A: Array) -> Error:
    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        first, second = factor.keys()
        before, after = values.atVector(first), values.atVector(second)
        if jacobians is not None:
            jacobians[0], jacobians[1] = -A, np.eye(6)
        return np.asarray(after - A @ before)

    return error


def bearing_error(places: Array, directions: Array) -> Error:
    """Of the predicted directions in the planes (2 axes each) across those measured, (2 n,)."""
    axes = np.linalg.svd((directions / np.linalg.norm(directions, axis=-1)[:, None])[:, None, :])[2][:, 1:]

    def error(factor: Any, values: Any, jacobians: Any) -> Array:
        away = values.atVector(factor.keys()[0])[:3] - places
        r = np.linalg.norm(away, axis=-1)[:, None]
        h = away / r
        if jacobians is not None:
            slope = np.zeros((2 * len(places), 6))
            slope[:, :3] = (axes @ projection(h) / r[..., None]).reshape(-1, 3)
            jacobians[0] = slope
        return np.asarray((axes @ h[..., None])[..., 0].reshape(-1))

    return error


def smoothed(made: Bearings, gtsam: Any) -> tuple[Played, Played]:
    """The newest state at each step, and all as the last step leaves them."""
    began = time.perf_counter()
    smoother = Smoother(made, gtsam)
    newest = np.array([smoother.step() for _ in made.truth]) - made.truth
    took_s = time.perf_counter() - began
    return Played(newest, took_s), Played(smoother.states() - made.truth, took_s)


HEADS = ("filter", "place [m]", "from 10 s on", "velocity [m/s]", "from 10 s on", "time")


def table(played: dict[str, list[Played]], dt: float, what: str) -> str:
    """RMSE over all trials, cameras and steps, in Markdown under a heading."""
    lines = [f"**{what}**", "", f"| {' | '.join(HEADS)} |", f"|{' --- |' * len(HEADS)}"]
    unit_s = np.mean([item.took_s for item in next(iter(played.values()))])
    for name, trials in played.items():
        cells = []
        for part in (slice(0, 3), slice(3, 6)):
            squares = [np.sum(item.errors[..., part] ** 2, axis=-1) for item in trials]
            for since in (0, round(TAIL_S / dt) - 1):
                cells.append(f"{np.sqrt(np.mean([square[since:] for square in squares])):.2f}")
        ratio = np.mean([item.took_s for item in trials]) / unit_s
        lines.append(f"| `{name}` | {' | '.join(cells)} | {ratio:.{0 if ratio > 10 else 1}f} |")
    return "\n".join([*lines, ""])


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(prog="python -m benchmarks.smoother", description=__doc__)
    found.add_argument("--trials", type=int, default=3)
    found.add_argument("--seed", type=int, default=1)
    found.add_argument("--scenarios", nargs="+", default=list(SCENARIOS), choices=SCENARIOS)
    found.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    return found


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    try:
        import gtsam
    except ImportError:
        print(MISSING, file=sys.stderr)
        return 2
    for name in options.scenarios:
        played: dict[str, list[Played]] = {}
        scenario = load(name, options.overrides)
        for seed in range(options.seed, options.seed + options.trials):
            made = bearings(scenario, seed)
            for kind in CENTRALIZED:
                played.setdefault(kind, []).append(centralized(kind, made))
            played.setdefault("plain", []).append(centralized("central_plus", made, gate=PLAIN))
            for kind in DISTRIBUTED:
                played.setdefault(kind, []).append(distributed(kind, made))
            for which, found in zip(("newest", "smoothed"), smoothed(made, gtsam)):
                played.setdefault(f"smoother, {which}", []).append(found)
        print(table(played, scenario.step_s, f"{name}, {options.trials} trials"), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
