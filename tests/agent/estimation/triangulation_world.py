"""A little world of observers that watch one target, in arrays over trials: teams of bearing filters without a network.

Ten static observers see a target that turns on a circle or a square in 20 s; each hears its three nearest. Directions
are noisy as published: turned by a normal angle about g x u with u random of unit length, which is not normalised, so
the deviation per tangent axis is sigma / sqrt(3).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from agent.estimation.bearing_filters import Kind, build
from agent.estimation.sights import EXACT, Sight, Told

Array = NDArray[np.float64]
Course = Literal["circle", "square"]

DT = 0.1
STEPS = 200
SIGMA = 0.1
BOX = np.array([80.0, 80.0, 40.0])
LAYOUT = np.array(
    [
        [-26.7479536001115, 5.97879069802922, -12.9122474989695],
        [-26.8115470806662, 34.4187346072475, -7.47023718162715],
        [22.2767825133615, 37.6446816650379, -34.0130100417117],
        [36.9621587227301, -6.41656697013157, -19.1130898217642],
        [15.9560085427048, 10.8019577943791, -16.6926655026746],
        [-23.7609823031385, 11.9758825276354, 38.9630631674099],
        [-37.5803918901555, -7.84877427678396, 13.7164615056577],
        [0.143563320371038, 18.2062509819998, 0.365099287400428],
        [-9.04026768641223, -15.4256764188321, 6.67564864265168],
        [-12.6658032071978, -5.74253008029820, -5.08259320434903],
    ]
)


@dataclass(frozen=True)
class Faults:
    """loss of a packet, delay in steps (fixed, and uniformly up to `jitter` more), missed and false detections, error
    [m] of the places told, constant in a trial, three random neighbours at each step, nobody sees anything between two
    times [s]."""

    loss: float = 0.0
    delay: int = 0
    jitter: int = 0
    missed: float = 0.0
    false: float = 0.0
    place_m: float = 0.0
    rewire: bool = False
    blackout: tuple[float, float] = (0.0, 0.0)


NOMINAL = Faults()
MODERATE = Faults(loss=0.3, jitter=2, missed=0.2, false=0.05, place_m=0.5)
HEAVY = Faults(loss=0.3, jitter=5, missed=0.2, false=0.05, place_m=0.5)


@dataclass(frozen=True, eq=False)
class World:
    """Truth (k, 6), places as told (t, n, 3), directions (t, k, n, 3), whether seen (t, k, n), links (t, k, n, m):
    whom each hears, with delays in steps, and whether the packet came."""

    truth: Array
    told_places: Array
    directions: Array
    seen: NDArray[np.bool_]
    neighbours: NDArray[np.int64]
    delays: NDArray[np.int64]
    came: NDArray[np.bool_]
    faults: Faults
    sigma: float = SIGMA

    def only(self, trial: int) -> World:
        """One trial of it."""
        parts = ("told_places", "directions", "seen", "neighbours", "delays", "came")
        return replace(self, **{name: getattr(self, name)[trial : trial + 1] for name in parts})


@dataclass(eq=False)
class Run:
    """Errors (t, k, n, 6) of a team, and their normalised squares (t, k, n), 6 on average if honest."""

    errors: Array
    nees: Array
    tail: slice = field(default_factory=lambda: slice(STEPS // 2, None))

    def position(self, part: slice = slice(None)) -> float:
        """RMSE [m]."""
        return float(np.sqrt(np.mean(np.sum(self.errors[:, part, :, :3] ** 2, axis=-1))))

    def velocity(self, part: slice = slice(None)) -> float:
        """RMSE [m/s]."""
        return float(np.sqrt(np.mean(np.sum(self.errors[:, part, :, 3:] ** 2, axis=-1))))

    def anees(self, part: slice = slice(None)) -> float:
        """Mean NEES per degree of freedom."""
        return float(np.mean(self.nees[:, part]) / 6.0)


def course(kind: Course, steps: int = STEPS) -> Array:
    """States (k, 6): v(k) is the velocity that carried the target there from k - 1."""
    place, velocity = np.array([15.0, 0.0, 0.0]), np.array([0.0, 5.0, 0.0])
    if kind == "square":
        place, velocity = np.array([20.0, 20.0, 5.0]), np.array([0.0, -4.0, 0.0])
    states = []
    for k in range(steps):
        if kind == "circle":
            angle = 2.0 * np.pi * k * DT / 20.0
            turned = _turned(velocity, angle)
        else:
            turned = _turned(velocity, -0.5 * np.pi * int(k * DT / 5.0 + 1e-9))
        place = place + DT * turned
        states.append(np.concatenate([place, turned]))
    return np.array(states)


def _turned(velocity: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1], velocity[2]])


def noisy(g: Array, sigma: float, rng: np.random.Generator) -> Array:
    """Directions (..., 3) turned as in the published simulation (Rodrigues' formula, the axis not normalised)."""
    u = rng.normal(size=g.shape)
    axis = np.cross(g, u / np.linalg.norm(u, axis=-1, keepdims=True))
    angle = sigma * rng.normal(size=(*g.shape[:-1], 1))
    once = np.cross(axis, g)
    return np.asarray(g + np.sin(angle) * once + (1.0 - np.cos(angle)) * np.cross(axis, once))


def world(
    seed: int,
    trials: int,
    target: Course | Array,
    fixed: bool,
    faults: Faults = NOMINAL,
    sigma: float = SIGMA,
    noise: float | None = None,
) -> World:
    """Layouts and directions depend on the seed, not on the faults; `noise` is the true sigma if it is another."""
    rng, chance = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1])
    truth = course(target) if isinstance(target, str) else target
    n, hears = len(LAYOUT), 3
    places = np.broadcast_to(LAYOUT, (trials, n, 3)) if fixed else BOX * (rng.uniform(size=(trials, n, 3)) - 0.5)
    away = truth[None, :, None, :3] - places[:, None]
    directions = noisy(away / np.linalg.norm(away, axis=-1, keepdims=True), sigma if noise is None else noise, rng)
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    near = np.argsort(apart, axis=-1)[..., 1 : hears + 1]
    shape = (trials, len(truth), n, hears)
    neighbours = np.broadcast_to(near[:, None], shape)
    if faults.rewire:
        keys = chance.uniform(size=(trials, len(truth), n, n)) + 2.0 * np.eye(n)
        neighbours = np.argsort(keys, axis=-1)[..., :hears]
    seen = chance.uniform(size=(trials, len(truth), n)) >= faults.missed
    since, until = (round(at / DT) for at in faults.blackout)
    seen[:, since:until] = False
    wrong = chance.normal(size=directions.shape)
    wrong /= np.linalg.norm(wrong, axis=-1, keepdims=True)
    directions = np.where((chance.uniform(size=seen.shape) < faults.false)[..., None], wrong, directions)
    told = places + faults.place_m * chance.normal(size=places.shape)
    delays = faults.delay + chance.integers(0, faults.jitter + 1, size=shape)
    came = chance.uniform(size=shape) >= faults.loss
    return World(truth, np.asarray(told), directions, seen, neighbours, delays, came, faults, sigma)


def play(made: World, kind: Kind, options: dict[str, float] | None = None, aware: bool = True) -> Run:
    """A team of filters of one kind. `aware`: late packets are used as late, not as if they were new.

    Centralized kinds have all directions at once.
    """
    chosen = build(kind, options)
    steps, n = made.seen.shape[1:]
    alone = kind in ("ckf", "central_plus")
    place = made.told_places
    cov = EXACT + made.faults.place_m**2 * np.eye(3)
    sigma = made.sigma / np.sqrt(3.0)
    state = chosen.start(place.mean(axis=1, keepdims=True) if alone else place)
    sent: list[Told] = []
    errors, nees = [], []
    for k in range(steps):
        own = Sight(place, made.directions[:, k], sigma, cov, 0.0, True, made.seen[:, k])
        if alone:
            each = [slice(i, i + 1) for i in range(n)]
            sights = [
                Sight(place[:, i], made.directions[:, k, i], sigma, cov, 0.0, False, made.seen[:, k, i]) for i in each
            ]
            state = chosen.step(state, DT, sights, [])
        else:
            sent.append(chosen.predicted(state, DT, [own]))
            heard, told = _arrived(made, k, sent, cov, sigma, aware)
            state = chosen.step(state, DT, [own, *heard], told)
        mean, matrix = chosen.belief(state)
        error = mean - made.truth[k]
        errors.append(error)
        nees.append((error[..., None, :] @ np.linalg.solve(matrix, error[..., None]))[..., 0, 0])
    return Run(np.stack(errors, axis=1), np.stack(nees, axis=1))


def _arrived(
    made: World, k: int, sent: list[Told], cov: Array, sigma: float, aware: bool
) -> tuple[list[Sight], list[Told]]:
    """Packets that arrive at step k: all sights, and of each neighbour the newest of what it told."""
    row, links = np.arange(len(made.seen))[:, None], range(made.neighbours.shape[-1])
    sights, told = [], []
    for m in links:
        newest: Told | None = None
        for late in range(made.faults.delay, min(made.faults.delay + made.faults.jitter, k) + 1):
            when = k - late
            who = made.neighbours[:, when, :, m]
            came = made.came[:, when, :, m] & (made.delays[:, when, :, m] == late)
            age, place = DT * late if aware else 0.0, made.told_places[row, who]
            seen = came & made.seen[:, when][row, who]
            sights.append(Sight(place, made.directions[:, when][row, who], sigma, cov, age, False, seen))
            then = sent[when]
            item = Told(then.mean[row, who], None if then.cov is None else then.cov[row, who], age, came)
            newest = item if newest is None else _newer(newest, item)
        if newest is not None:
            told.append(newest)
    return sights, told


def _newer(newest: Told, item: Told) -> Told:
    """`newest` where something came, otherwise `item`."""
    came = np.asarray(newest.used)
    covs = None
    if newest.cov is not None and item.cov is not None:
        covs = np.where(came[..., None, None], newest.cov, item.cov)
    mean = np.where(came[..., None], newest.mean, item.mean)
    return Told(mean, covs, np.where(came, newest.age_s, item.age_s), came | item.used)
