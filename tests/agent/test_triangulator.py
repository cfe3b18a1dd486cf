"""Tracks of one robot whose own camera and neighbours tell it late what they saw."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.bearing_filters import acceleration_noise
from agent.estimation.direction import Directed
from agent.estimation.motion import CONSTANT_VELOCITY_3D, SpatialMotion, TargetMotion
from agent.estimation.triangulation import transition
from agent.rounds import Told
from agent.settings import NS, AgentSettings, LocalizationSettings, RoundSettings, TargetSettings, TrackingSettings
from agent.triangulator import Triangulator
from network.bearing_messages import Bearing, BearingReport
from tests.sizes import sized

Array = NDArray[np.float64]

DT, PERIOD_NS = 0.1, NS // 10
ROUNDS = 100
DENSITY = 5.0
SIGMA = 0.01
PLACES = {
    "r1": np.array([-40.0, 0.0, -10.0]),
    "r2": np.array([0.0, -40.0, 10.0]),
    "r3": np.array([40.0, 10.0, 0.0]),
    "r4": np.array([0.0, 40.0, -10.0]),
}
NOWHERE = np.zeros((3, 3))


def robot(kind: str) -> Triangulator:
    motion = TargetMotion(CONSTANT_VELOCITY_3D, noise_sigma=((DENSITY / DT) ** 0.5,) * 3, noise_step_s=DT)
    settings = AgentSettings(
        "r1",
        0,
        np.append(PLACES["r1"], 0.0),
        1e-6 * np.eye(4),
        motion=SpatialMotion(),
        targets=(TargetSettings("t1", motion, None, np.diag([100.0] * 3 + [25.0] * 3)),),
        localization=LocalizationSettings(kind="fixed"),
        tracking=TrackingSettings(kind),  # type: ignore[arg-type]
        round=RoundSettings(PERIOD_NS, 0, PERIOD_NS // 5),
    )
    return Triangulator(settings, Counter())


def flight(rng: np.random.Generator) -> Array:
    """States (k, 6) of a target that does what a filter of this density expects."""
    root, A = np.linalg.cholesky(acceleration_noise(DT, DENSITY)), transition(DT)
    states = [np.zeros(6)]
    for _ in range(ROUNDS):
        states.append(A @ states[-1] + root @ rng.normal(size=6))
    return np.array(states)


def seen(truth: Array, place: Array, rng: np.random.Generator) -> Array:
    away = truth[:3] - place
    g = away / np.linalg.norm(away)
    noisy = g + SIGMA * np.linalg.svd(g[None])[2][1:].T @ rng.normal(size=2)
    return np.asarray(noisy / np.linalg.norm(noisy))


def played(kind: str, seed: int, tail_s: float, least_s: float = 0.0) -> tuple[Array, Array]:
    """Errors [m] and NEES per degree of freedom from 3 s on. Sights come late; of several the newest counts."""
    rng = np.random.default_rng(seed)
    truth, track = flight(rng), robot(kind)
    comes: dict[tuple[str, int], int] = {}
    sights = {(name, k): seen(truth[k], place, rng) for k in range(1, ROUNDS + 1) for name, place in PLACES.items()}
    for name, k in sights:
        comes[name, k + round((least_s + rng.exponential(tail_s)) / DT)] = k
    errors, nees = [], []
    for k in range(1, ROUNDS + 1):
        heard = []
        for name, place in PLACES.items():
            of = comes.get((name, k))
            if of is None:
                continue
            if name == "r1":
                track.saw(of * PERIOD_NS, "t1", Directed(place, NOWHERE, sights[name, of], SIGMA))
            else:
                found = Bearing("t1", place, NOWHERE, sights[name, of], SIGMA, (k - of) * PERIOD_NS)
                heard.append(Told(name, k * PERIOD_NS, BearingReport((found,))))
        track.report(k * PERIOD_NS, PLACES["r1"])
        track.step(k * PERIOD_NS, PLACES["r1"], heard)
        for told in track.tracks(k * PERIOD_NS) if k * DT >= 3.0 else ():
            away = told.mean - truth[k]
            errors.append(np.linalg.norm(away[:3]))
            nees.append(float(away @ np.linalg.solve(told.cov, away)) / 6.0)
    return np.array(errors), np.array(nees)


@pytest.mark.parametrize("kind", ["icf_plus", "kcf_plus"])
@pytest.mark.parametrize(("tail_s", "least_s", "most"), [(0.7, 0.0, 1.15), (0.3, 1.0, 1.4)])
def test_what_comes_late_is_not_believed_too_much(kind: str, tail_s: float, least_s: float, most: float) -> None:
    """The target accelerates as stated. Used at its age, each bearing would add the same error again: 1.6 and more.

    Errors of predictions over a second last that long: of few that are independent the mean is less sure.
    """
    seeds = range(70, 70 + sized(4, 30))
    trials = [played(kind, seed, tail_s, least_s) for seed in seeds]
    mean = float(np.mean(np.concatenate([nees for _, nees in trials])))
    print(f"seeds {seeds}: {mean:.2f}, {np.sqrt(np.mean(np.concatenate([e for e, _ in trials]) ** 2)):.2f} m")
    assert mean < most
    assert sum(len(nees) for _, nees in trials) > 0.9 * len(trials) * 70
