"""Improved bearing-only filters: exact where they are linear, as accurate as they should be, and honest about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.bearing_filters import FILTERS, Kind, acceleration_noise, build
from agent.estimation.sights import Sight, Told
from agent.estimation.triangulation import TrackState, transition
from tests.agent.estimation.triangulation_world import DT, MODERATE, Faults, Run, course, play, world
from tests.sizes import sized

Array = NDArray[np.float64]

IMPROVED: tuple[Kind, ...] = ("kcf_plus", "icf_plus", "central_plus")
TRUTH = np.array([15.0, -4.0, 3.0, 1.0, -2.0, 0.5])
PLACES = np.array([[0.0, 0.0, 0.0], [20.0, 15.0, -5.0], [-10.0, 12.0, 8.0]])


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def near(seed: int) -> TrackState:
    """A state close to the truth, which is that of one step later."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    mean = np.linalg.inv(transition(DT)) @ TRUTH + 0.05 * rng.normal(size=6)
    return TrackState(mean, 0.3 * (root @ root.T) + 0.5 * np.eye(6))


# -- one step ------------------------------------------------------------------------------------------------


def test_process_noise_is_that_of_white_acceleration() -> None:
    """Two steps make one of twice the length."""
    once, twice = acceleration_noise(0.1, 3.0), acceleration_noise(0.2, 3.0)
    A = transition(0.1)
    assert np.allclose(A @ once @ A.T + once, twice, atol=1e-15)


@pytest.mark.parametrize("kind", IMPROVED)
def test_one_direction_is_an_extended_kalman_update_of_two_angles(kind: Kind) -> None:
    """In tangent axes: z is the offset there, R = (r sigma)^2 + place, weighed by the offset."""
    chosen, state, sigma = build(kind), near(1), 0.02
    cov = np.diag([0.2, 0.1, 0.3])
    late = 0.15
    seen_at = TRUTH[:3] - late * TRUTH[3:]
    g = unit(unit(seen_at - PLACES[0]) + np.array([0.01, -0.02, 0.015]))
    found = chosen.step(state, DT, [Sight(PLACES[0], g, sigma, cov, late)], [])

    A = transition(DT)
    mean, prior = A @ state.mean, A @ state.matrix @ A.T + acceleration_noise(DT, 5.0)
    expected = mean[:3] - late * mean[3:] - PLACES[0]
    distance = float(np.linalg.norm(expected))
    axes = np.linalg.svd(expected[None, :])[2][1:]
    r = np.sqrt(distance**2 + np.trace(prior[:3, :3]))
    R = ((r * sigma) ** 2 + 5.0 * late**3 / 3.0) * np.eye(2) + axes @ cov @ axes.T
    angle = np.arccos(unit(expected) @ g)
    spread = np.trace(axes @ prior[:3, :3] @ axes.T) / 2.0
    R *= (1.0 + (angle / 3.0) ** 2 / (sigma**2 + spread / r**2)) ** 2
    H = np.hstack([axes, -late * axes])
    K = prior @ H.T @ np.linalg.inv(H @ prior @ H.T + R)
    z = axes @ g * distance / (unit(expected) @ g)
    assert np.allclose(found.mean, mean + K @ z, rtol=0.0, atol=1e-9)
    assert np.allclose(found.matrix, prior - K @ H @ prior, rtol=0.0, atol=1e-9)


def test_mean_consensus_moves_half_way_and_claims_nothing() -> None:
    chosen, state = build("kcf_plus"), near(2)
    alone = chosen.step(state, DT, [], [])
    told = [alone.mean + 1.0, alone.mean + 2.0, alone.mean - 6.0]
    found = chosen.step(state, DT, [], [Told(mean) for mean in told])
    assert np.allclose(found.mean, alone.mean + 0.5 * (1.0 + 2.0 - 6.0) / 4.0)
    assert np.array_equal(found.matrix, alone.matrix)


def test_intersection_is_that_of_equal_weights() -> None:
    chosen, states = build("icf_plus"), [near(seed) for seed in range(4)]
    told = [chosen.predicted(state, DT) for state in states]
    found = chosen.step(states[0], DT, [], told[1:])
    informations = [np.linalg.inv(item.cov) for item in told if item.cov is not None]
    cov = np.linalg.inv(sum(informations) / 4.0)
    mean = cov @ sum(Y @ item.mean for Y, item in zip(informations, told)) / 4.0
    assert np.allclose(found.matrix, cov, atol=1e-9) and np.allclose(found.mean, mean, atol=1e-9)
    # What is late has grown by the noise since, and counts less: never surer than without.
    late = [Told(item.mean, item.cov, 1.0) for item in told[1:]]
    assert np.trace(chosen.step(states[0], DT, [], late).matrix) > np.trace(cov)


@pytest.mark.parametrize("kind", IMPROVED)
def test_arrays_of_trials_are_played_as_each_alone(kind: Kind) -> None:
    made = world(8, 3, "square", fixed=False, faults=Faults(loss=0.3, jitter=2, missed=0.3, false=0.1, place_m=0.5))
    together = play(made, kind).errors
    assert np.allclose(together[1], play(made.only(1), kind).errors[0], rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("kind", FILTERS)
def test_nothing_seen_or_heard_is_a_prediction(kind: Kind) -> None:
    chosen = build(kind)
    state = chosen.start(np.array([1.0, 2.0, 3.0]))
    masked = Sight(np.zeros(3), np.array([np.nan, 0.0, 0.0]), 0.1, used=False)
    for sights in ([], [masked], [masked, masked]):
        found = chosen.step(state, DT, sights, [])
        assert np.allclose(found.mean, state.mean, atol=1e-9)
        mean, cov = chosen.belief(found)
        assert np.isfinite(mean).all() and np.linalg.eigvalsh(cov).min() > 0.0


def test_what_does_not_exist_is_named() -> None:
    with pytest.raises(ValueError, match="'eif' is no bearing filter"):
        build("eif")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"stt: .*'memory'"):
        build("stt", {"memory": 1.0})


# -- teams ---------------------------------------------------------------------------------------------------


def both(kind: Kind, faults: Faults, seed: int, trials: int) -> list[Run]:
    return [play(world(seed, trials, target, fixed=False, faults=faults), kind) for target in ("circle", "square")]


@pytest.mark.parametrize(("kind", "least_m"), [("kcf_plus", 1.15), ("icf_plus", 1.0)])
def test_random_layouts_are_tracked_better_than_published(kind: Kind, least_m: float) -> None:
    """Within a tenth, for 25 trials, and a fifth for ten; the published filter is at 2 to 2.8 m."""
    seed = 41
    for run in both(kind, Faults(), seed, sized(10, 25)):
        assert run.position(run.tail) < sized(1.2, 1.1) * least_m, f"seed {seed}"
        assert run.anees() < 1.15, f"seed {seed}"


@pytest.mark.parametrize("kind", ["kcf_plus", "icf_plus"])
@pytest.mark.parametrize(
    "faults",
    [
        MODERATE,
        Faults(loss=0.7),
        Faults(delay=5),
        Faults(place_m=1.0),
        Faults(missed=0.5),
        Faults(blackout=(12.0, 15.0)),
    ],
    ids=["moderate", "loss", "delay", "places", "missed", "blackout"],
)
def test_faults_do_not_make_it_overconfident(kind: Kind, faults: Faults) -> None:
    seed = 42
    for run in both(kind, faults, seed, sized(5, 10)):
        assert run.anees(run.tail) < 1.15, f"seed {seed}"
        if faults == MODERATE:
            assert run.position(run.tail) < 1.1 * 1.7, f"seed {seed}"


@pytest.mark.parametrize("kind", ["kcf_plus", "icf_plus"])
def test_false_directions_do_not_make_a_beginning_overconfident(kind: Kind) -> None:
    """One in five is false, and a prior of 30 m lets all of them pass; 2 and more if what crosses is believed."""
    for target in ("circle", "square"):
        for seed in (45, 46):
            made = world(seed, 12, course(target, 40), fixed=False, faults=Faults(false=0.2))
            run = play(made, kind)
            assert run.anees(slice(0, 30)) < 1.15, f"seed {seed}"
            assert run.position(slice(30, 40)) < 4.0, f"seed {seed}"


def test_a_robot_that_hears_nobody_stays_unsure_of_the_range() -> None:
    """Its mean is along its ray, and the covariance says so for 20 s."""
    seed = 43
    for run in both("kcf_plus", Faults(loss=1.0), seed, 10):
        assert run.position(run.tail) > 5.0
        assert run.anees() < 1.3, f"seed {seed}"


def test_a_team_that_lost_the_target_finds_it_again() -> None:
    """All believe, and are sure, that it is 30 m from where it is."""
    made = world(44, 10, "circle", fixed=True)
    chosen = build("icf_plus")
    off = np.array([20.0, -20.0, 10.0, 0.0, 0.0, 0.0])
    places, row = made.told_places, np.arange(10)[:, None]
    mean = np.broadcast_to(made.truth[0] + off, (10, 10, 6))
    state = TrackState(mean, np.broadcast_to(np.eye(6), (10, 10, 6, 6)))
    for k in range(16):
        told, sights = chosen.predicted(state, DT), [Sight(places, made.directions[:, k], 0.0577, own=True)]
        others = []
        for m in range(3):
            who = made.neighbours[:, k, :, m]
            sights.append(Sight(places[row, who], made.directions[:, k][row, who], 0.0577))
            assert told.cov is not None
            others.append(replace(told, mean=told.mean[row, who], cov=told.cov[row, who]))
        state = chosen.step(state, DT, sights, others)
    errors = np.linalg.norm(state.mean[..., :3] - made.truth[15, :3], axis=-1)
    # It takes twice as long if the prediction is never doubted.
    assert np.sqrt(np.mean(errors**2)) < 5.0
