"""What bearing filters are given: what is refused, and whether directions cross."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.sights import Sight, Told, crossing, observable, refusal, stack_sights, stack_told
from agent.estimation.triangulation import Triangulation
from tests.agent.estimation.triangulation_world import DT, LAYOUT, course

Array = NDArray[np.float64]

GOOD = Sight(np.zeros(3), np.array([0.6, 0.0, 0.8]), 0.01)


def towards(place: Array, target: Array, sigma: float, rng: np.random.Generator) -> Sight:
    """A direction with an isotropic error."""
    g = (target - place) / np.linalg.norm(target - place) + sigma * rng.normal(size=3)
    return Sight(place, g / np.linalg.norm(g), sigma)


# -- refusals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sight", "word"),
    [
        (GOOD, None),
        (replace(GOOD, direction=1.05 * GOOD.direction), None),
        (replace(GOOD, direction=np.full(3, np.nan)), "out_of_view"),
        (replace(GOOD, direction=np.zeros(3)), "no_direction"),
        (replace(GOOD, direction=30.0 * GOOD.direction), "no_direction"),
        (replace(GOOD, place=np.array([0.0, np.inf, 0.0])), "no_place"),
        (replace(GOOD, sigma_rad=0.0), "no_noise"),
        (replace(GOOD, sigma_rad=float("nan")), "no_noise"),
        (replace(GOOD, place_cov=np.full((3, 3), np.nan)), "no_noise"),
        (replace(GOOD, age_s=-0.1), "age"),
    ],
)
def test_what_cannot_be_used_has_a_word_for_a_counter(sight: Sight, word: str | None) -> None:
    assert refusal(sight) == word


def test_a_step_refuses_what_has_no_direction() -> None:
    chosen = Triangulation()
    state = chosen.start(np.zeros(3))
    for direction in (np.zeros(3), np.full(3, np.nan)):
        with pytest.raises(ValueError, match="refusal"):
            chosen.step(state, DT, [GOOD, replace(GOOD, direction=direction)], [])
        # What is masked may be anything.
        masked = chosen.step(state, DT, [GOOD, replace(GOOD, direction=direction, used=False)], [])
        assert np.array_equal(masked.mean, chosen.step(state, DT, [GOOD], []).mean)


def test_neighbours_of_another_kind_are_refused() -> None:
    with pytest.raises(ValueError, match="same kind"):
        stack_told([Told(np.zeros(6)), Told(np.zeros(6), np.eye(6))], ())


# -- whether directions cross --------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.7, np.pi / 2.0, 2.5])
def test_two_rays_cross_by_their_angle(angle: float) -> None:
    other = Sight(np.array([5.0, 0.0, 0.0]), np.array([np.cos(angle), np.sin(angle), 0.0]), 0.01)
    first = Sight(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.01)
    found = crossing(stack_sights([first, other], ()))
    assert found == pytest.approx((1.0 - abs(np.cos(angle))) / 2.0, abs=1e-12)


def test_an_isolated_observer_is_never_valid() -> None:
    """However often it looks, and though the target moves all round it."""
    rng = np.random.default_rng(5)
    sights = [towards(LAYOUT[7], state[:3], 0.0577, rng) for state in course("circle")]
    assert not observable([]) and not observable(sights[:1])
    for since in range(0, 200, 7):
        assert not observable(sights[since : since + 5])
    assert not observable(sights)
    # A robot that drifts by less than what counts as another place is none either.
    near = [replace(item, place=item.place + 0.3 * rng.uniform(-1.0, 1.0, size=3)) for item in sights[:5]]
    assert not observable(near)


def test_one_other_place_is_enough_if_rays_cross() -> None:
    rng = np.random.default_rng(6)
    target = np.array([15.0, 0.0, 0.0])
    sights = [towards(place, target, 0.0577, rng) for place in LAYOUT[7:9]]
    assert observable(sights) and not observable([sights[0], replace(sights[1], used=False)])


@pytest.mark.parametrize("sigma", [0.001, 0.01, 0.0577])
def test_parallel_directions_are_not_valid(sigma: float) -> None:
    """Four observers 1 to 2 m apart, 40 m from the target; 4000 draws."""
    rng = np.random.default_rng(7)
    places = 1.5 * np.vstack([np.zeros(3), np.eye(3)])
    away = np.array([40.0, 0.0, 0.0]) - places
    g = away / np.linalg.norm(away, axis=-1, keepdims=True) + sigma * rng.normal(size=(4000, 4, 3))
    g /= np.linalg.norm(g, axis=-1, keepdims=True)
    assert not observable([Sight(np.broadcast_to(places[j], (4000, 3)), g[:, j], sigma) for j in range(4)]).any()


def test_most_of_random_layouts_are_valid_and_those_that_are_not_triangulate_badly() -> None:
    rng = np.random.default_rng(8)
    target, sigma, trials = np.array([15.0, 0.0, 0.0]), 0.0577, 2000
    places = np.array([80.0, 80.0, 40.0]) * (rng.uniform(size=(trials, 4, 3)) - 0.5)
    away = target - places
    g = away / np.linalg.norm(away, axis=-1, keepdims=True) + sigma * rng.normal(size=(trials, 4, 3))
    g /= np.linalg.norm(g, axis=-1, keepdims=True)
    valid = observable([Sight(places[:, j], g[:, j], sigma) for j in range(4)])
    P = np.eye(3) - g[..., :, None] * g[..., None, :]
    points = np.linalg.solve(P.sum(axis=1), (P @ places[..., None]).sum(axis=1))[..., 0]
    errors = np.linalg.norm(points - target, axis=-1)
    assert valid.mean() > 0.9
    assert np.median(errors[~valid]) > 2.0 * np.median(errors[valid])
