"""A follower whose leader's word comes late: policies where theory ties them together, and whether they are honest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.delayed import (
    LeaderSight,
    algorithm1,
    anticipated,
    begun,
    compensated,
    corrected,
    equivalent,
    innovation,
    moved,
    predicted,
    seen_place,
)
from benchmarks.delays import Figures, play, story
from tests.assertions import assert_covariance
from tests.sizes import sized

Array = NDArray[np.float64]

R = np.diag([0.25, np.radians(0.5) ** 2])
COV = np.diag([0.09, 0.09, np.radians(5.0) ** 2])
NOISE = np.diag([1e-4, 0.0, np.radians(0.3) ** 2])
STRAIGHT = np.array([0.1, 0.0, 0.0])
BEND = np.array([0.1, 0.02, 0.05])
SEEDS = st.integers(0, 2**32 - 1)
TRIALS = sized(60, 200)


def sight(rng: np.random.Generator, arm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> LeaderSight:
    place = rng.uniform(2.0, 5.0, 2)
    return LeaderSight(np.zeros(2), R, place, 0.01 * np.eye(2), rng.normal(size=2), arm)


def numeric(of: object, at: Array, step: float = 1e-6) -> Array:
    """Derivative of a function of a vector (n,) by central differences."""
    columns = []
    for index in range(len(at)):
        shift = step * np.eye(len(at))[index]
        columns.append((of(at + shift) - of(at - shift)) / (2.0 * step))  # type: ignore[operator]
    return np.stack(columns, axis=-1)


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.sampled_from([3, 4]))
def test_jacobians_of_a_sight(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    state, seen = rng.normal(scale=0.3, size=n), sight(rng, (0.4, -0.2, 0.7))
    _, Cf, Cl = predicted(state, seen.place, seen)
    assert numeric(lambda x: predicted(x, seen.place, seen)[0], state) == pytest.approx(Cf, abs=1e-6)
    assert numeric(lambda place: predicted(state, place, seen)[0], seen.place) == pytest.approx(Cl, abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_jacobian_of_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, delta = rng.normal(size=4), rng.normal(size=3)
    F = moved(state, np.eye(4), delta, NOISE)[2]
    assert numeric(lambda x: moved(x, np.eye(4), delta, NOISE)[0], state) == pytest.approx(F, abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(SEEDS)
def test_range_and_bearing_place_the_leader_where_they_are_predicted_from(seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, seen = rng.normal(scale=0.3, size=3), sight(rng, (0.4, -0.2, 0.7))
    exact = replace(seen, z=predicted(state, seen.place, seen)[0])
    assert seen_place(state, exact) == pytest.approx(seen.place, abs=1e-9)
    assert innovation(state, exact) == pytest.approx(np.zeros(2), abs=1e-12)


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_one_pass_is_the_filter_with_the_leader_in_its_state(seed: int) -> None:
    """The paper's augmented state (eq. 1), updated and marginalized, is what R + Cl Pl Cl^T stands for."""
    rng = np.random.default_rng(seed)
    state, seen = rng.normal(scale=0.3, size=3), sight(rng)
    seen = replace(seen, z=predicted(state, seen.place, seen)[0] + [0.3, 0.01])
    _, Cf, Cl = predicted(state, seen.place, seen)
    P, C = np.zeros((5, 5)), np.concatenate([Cl, Cf], axis=1)
    P[:2, :2], P[2:, 2:] = seen.place_cov, COV
    K = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    whole = P - K @ C @ P
    found = corrected(state, COV, seen)
    assert found.cov == pytest.approx(whole[2:, 2:], abs=1e-12)
    assert found.mean == pytest.approx(state + (K @ innovation(state, seen))[2:], abs=1e-12)


def test_where_the_leader_is_further_passes_change_nothing_once_they_agree() -> None:
    rng = np.random.default_rng(3)
    state, seen = np.zeros(3), sight(rng)
    seen = replace(seen, z=predicted(state, seen.place, seen)[0] + [0.8, 0.05])
    passes = [corrected(state, COV, seen, count).mean for count in (1, 8, 9)]
    assert passes[1] == pytest.approx(passes[2], abs=1e-9)
    assert np.abs(passes[0] - passes[1]).max() > 1e-4, "else this test sees nothing"


# -- policies ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["ignore", "compensate", "equivalent", "replay", "discard"])
def test_without_delay_all_are_the_plain_filter(policy: str) -> None:
    found = story(5, np.random.default_rng(1))
    plain, other = play(found, 1, "nodelay"), play(found, 1, policy)
    assert (other.position_cm, other.heading_deg, other.anees) == pytest.approx(
        (plain.position_cm, plain.heading_deg, plain.anees), rel=1e-9
    )


def test_algorithm_1_as_printed_uses_a_measurement_twice_even_without_delay() -> None:
    found = story(TRIALS, np.random.default_rng(1))
    assert play(found, 1, "algorithm1").anees > 1.1 * play(found, 1, "nodelay").anees


def late(steps: int) -> tuple[Array, Array, Array, Array, LeaderSight, list[Array]]:
    """A sight that fits what is believed, so that all is nearly linear: the belief then, and `steps` later."""
    mean, place = np.array([0.0, 0.0, 0.6]), 3.0 * np.array([np.cos(0.6), np.sin(0.6)])
    seen = LeaderSight(np.array([3.0005, 0.0001]), R, place, 0.01 * np.eye(2), np.zeros(2))
    steps_of = [BEND] * steps
    now, cov = mean, COV
    for delta in steps_of:
        now, cov, _ = moved(now, cov, delta, NOISE)
    return mean, COV, now, cov, seen, steps_of


def test_one_in_flight_is_compensated_as_by_a_replay() -> None:
    mean, cov, late_mean, _, seen, steps = late(8)
    there = corrected(mean, cov, seen)
    flight = replace(begun(mean, cov), gain=there.gain)
    replayed, replayed_cov, shrunk, way = there.mean, there.cov, there.cov, mean
    for delta in steps:
        replayed, replayed_cov, _ = moved(replayed, replayed_cov, delta, NOISE)
        way, shrunk, F = moved(way, shrunk, delta, NOISE)
        flight = flight.moved(F, delta)
    assert compensated(late_mean, flight, seen) == pytest.approx(replayed, abs=1e-6)
    assert shrunk == pytest.approx(replayed_cov, abs=1e-5)


def test_several_in_flight_are_compensated_to_the_same_mean_once_all_are_there() -> None:
    """Each was predicted without those before it, which M makes up for: (I - K C) is in it."""
    mean, cov = np.zeros(3), COV
    straight, straight_cov, flights, seen = mean, cov, {}, {}
    late_mean, late_cov = mean, cov
    for k in range(4):
        z = np.array([3.0 - 0.1 * k + 0.0004 * k, 0.0001])
        seen[k] = LeaderSight(z, R, np.array([3.0, 0.0]), 0.01 * np.eye(2), np.zeros(2))
        there = corrected(straight, straight_cov, seen[k])
        expected = corrected(late_mean, late_cov, seen[k])
        flights = {s: flight.updated(expected.left) for s, flight in flights.items()}
        flights[k] = replace(begun(late_mean, late_cov), gain=expected.gain)
        straight, straight_cov, _ = moved(there.mean, there.cov, STRAIGHT, NOISE)
        late_mean, late_cov, F = moved(late_mean, expected.cov, STRAIGHT, NOISE)
        flights = {s: flight.moved(F, STRAIGHT) for s, flight in flights.items()}
    for k, flight in flights.items():
        late_mean = compensated(late_mean, flight, seen[k])
    assert late_mean == pytest.approx(straight, abs=1e-6)
    assert late_cov == pytest.approx(straight_cov, abs=1e-6)


def test_the_equivalent_measurement_is_the_replay_if_the_motion_is_exact() -> None:
    mean, cov, _, _, seen, steps = late(8)
    flight, now, now_cov = begun(mean, cov), mean, cov
    there = corrected(mean, cov, seen)
    replayed, replayed_cov = there.mean, there.cov
    for delta in steps:
        now, now_cov, F = moved(now, now_cov, delta, np.zeros((3, 3)))
        replayed, replayed_cov, _ = moved(replayed, replayed_cov, delta, np.zeros((3, 3)))
        flight = flight.moved(F, delta)
    found = equivalent(now, now_cov, flight, seen)
    assert found.mean == pytest.approx(replayed, abs=1e-6)
    assert found.cov == pytest.approx(replayed_cov, abs=1e-6)


def test_algorithm_1_is_both_together() -> None:
    mean, cov, now, now_cov, seen, steps = late(3)
    flight = begun(mean, cov)
    for delta in steps:
        flight = flight.moved(moved(mean, cov, delta, NOISE)[2], delta)
    found = algorithm1(now, now_cov, flight, seen)
    twice = equivalent(compensated(now, flight, seen), now_cov, flight, seen)
    assert found.mean == pytest.approx(twice.mean, abs=1e-12)


def test_what_can_be_told_at_once_is_the_covariance_alone() -> None:
    mean, cov, _, _, seen, _ = late(0)
    expected = anticipated(mean, cov, seen)
    assert expected.cov == pytest.approx(corrected(mean, cov, seen).cov, abs=1e-5)
    assert_covariance(expected.cov)


def test_covariances_stay_proper_while_words_are_late() -> None:
    found = story(3, np.random.default_rng(5), delay=8, loss=0.3)
    for policy in ("compensate", "equivalent", "algorithm1", "replay"):
        assert np.isfinite(play(found, 5, policy).anees), policy


# -- figures of Zhang & Cao's simulation ------------------------------------------------------------------------------


def figures(policy: str, iterations: int = 1, scale: float = 1.0, **what: object) -> Figures:
    found = story(TRIALS, np.random.default_rng(2), **what)  # type: ignore[arg-type]
    return play(found, 2, policy, iterations=iterations, scale=scale)


@pytest.mark.parametrize("what", [{"delay": 1}, {"delay": 8}, {"delay": 8, "loss": 0.3}, {"delay": 8, "every": 8}])
def test_replay_with_two_passes_is_honest_whatever_is_late_or_lost(what: dict[str, object]) -> None:
    assert 0.85 < figures("replay", 2, **what).anees < 1.15


def test_replay_with_two_passes_beats_the_plain_filter_that_gets_everything_in_time() -> None:
    late, plain = figures("replay", 2, delay=8), figures("nodelay")
    assert late.position_cm < plain.position_cm


def test_words_that_overtake_each_other_make_no_difference_to_replay() -> None:
    drawn = np.random.default_rng(4).integers(0, 9, (TRIALS, 301))
    assert 0.9 < figures("replay", 2, delay=drawn).anees < 1.15


def test_what_is_published_claims_too_much() -> None:
    ignore, compensate, equal = (figures(policy, delay=8).anees for policy in ("ignore", "compensate", "equivalent"))
    assert ignore > 50.0
    assert 2.0 < compensate < 5.0
    assert 1.4 < equal < 2.6
    assert figures("compensate", delay=8, loss=0.3).anees > 1.5 * compensate, "P has shrunk for what never comes"


def test_discarding_is_honest_and_knows_little() -> None:
    found = figures("discard", delay=8)
    assert found.anees < 1.3
    assert found.position_cm > 40.0


def test_a_leader_whose_error_lasts_needs_a_larger_covariance() -> None:
    assert figures("replay", 2, delay=8, correlation_s=5.0).anees > 3.0
    assert 0.7 < figures("replay", 2, 50.0, delay=8, correlation_s=5.0).anees < 1.15


def test_a_clock_nobody_knows_is_found_out() -> None:
    found = story(TRIALS, np.random.default_rng(3), delay=8, offset=2)
    trusting, knowing = play(found, 3, "replay"), play(found, 3, "replay", tau_sigma_s=0.2)
    assert knowing.anees < 0.6 * trusting.anees
    assert knowing.tau_ms < 0.5 * 1e3 * float(np.sqrt((found.tau_s**2).mean()))
