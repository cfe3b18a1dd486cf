"""The chain of a robot's odometry: the same in whatever order it is heard, and honest about what it does not tell."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.reckoning import extended
from agent.settings import NS, CoastSettings
from agent.team_teller import Teller
from agent.team_track import MAX_NAMES, MAX_NODES, MAX_SUMS, Life, Node, Place, Step, Track
from network.messages import Reckoning

Array = NDArray[np.float64]

LIFE: Life = (1, 77)
COAST = CoastSettings(0.5, 0.4)
TOLERANCE = 1_000_000
NOISE = np.diag([0.01, 0.004, 0.0, 0.002])


def track() -> tuple[Track, Place]:
    start = Node(0, 0)
    made = Track(start, COAST, TOLERANCE, Counter())
    made.begin(LIFE, 0, 0)
    return made, Place(0, start)


def told(count: int, seed: int = 3, born_ns: int = 0) -> tuple[list[Reckoning], list[tuple[Array, Array]]]:
    """What a robot tells that moves once per second, and its increments."""
    rng, teller = np.random.default_rng(seed), Teller(born_ns)
    parts = [(rng.normal([1.0, 0.0, 0.0, 0.3], 0.2), NOISE * rng.uniform(0.5, 1.5)) for _ in range(count)]
    return [teller.moved(born_ns + (k + 1) * NS, *part) for k, part in enumerate(parts)], parts


def walked(made: Track, place: Place, until_ns: int) -> list[Step]:
    """All stretches up to an instant."""
    found = []
    while place.t_ns < until_ns - TOLERANCE:
        found.append(made.step(place, until_ns))
        place = found[-1].place
    return found


def moved(steps: list[Step]) -> tuple[Array, Array]:
    total = np.zeros(4), np.zeros((4, 4))
    for step in steps:
        total = extended(*total, step.delta, step.cov)
    return total


def test_every_increment_is_gone_through_as_the_robot_told_it() -> None:
    made, place = track()
    reckonings, parts = told(6)
    for item in reckonings:
        made.add(LIFE, item, 0)
    steps = walked(made, place, 6 * NS)
    assert [step.place.t_ns for step in steps] == [k * NS for k in range(1, 7)]
    for step, (delta, cov) in zip(steps, parts, strict=True):
        np.testing.assert_allclose(step.delta, delta, atol=1e-12)
        np.testing.assert_allclose(step.cov, cov, atol=1e-13)
        assert step.dt_s == pytest.approx(1.0)


@given(st.permutations(range(8)), st.lists(st.integers(0, 7), max_size=5))
def test_order_and_repetition_do_not_matter(order: list[int], again: list[int]) -> None:
    reckonings, _ = told(8)
    plain, place = track()
    for item in reckonings:
        plain.add(LIFE, item, 0)
    mixed, other = track()
    for index in [*order, *again]:
        mixed.add(LIFE, reckonings[index], 0)
    for one, two in zip(walked(plain, place, 8 * NS), walked(mixed, other, 8 * NS), strict=True):
        assert one.place.t_ns == two.place.t_ns
        np.testing.assert_array_equal(one.delta, two.delta)
        np.testing.assert_array_equal(one.cov, two.cov)


@given(st.sets(st.integers(0, 6)))
def test_what_is_lost_leaves_no_hole(lost: set[int]) -> None:
    reckonings, parts = told(8)
    made, place = track()
    for index, item in enumerate(reckonings):
        if index not in lost:
            made.add(LIFE, item, 0)
    delta, cov = moved(walked(made, place, 8 * NS))
    whole = np.zeros(4), np.zeros((4, 4))
    for part in parts:
        whole = extended(*whole, *part)
    np.testing.assert_allclose(delta, whole[0], atol=1e-11)
    np.testing.assert_allclose(cov, whole[1], atol=1e-11)


def test_it_is_told_from_when_on_the_motion_is_another_one() -> None:
    made, _ = track()
    reckonings, _ = told(4)
    assert made.add(LIFE, reckonings[0], 0) == TOLERANCE + 1
    assert made.add(LIFE, reckonings[3], 0) == NS + TOLERANCE + 1
    assert made.add(LIFE, reckonings[1], 0) == NS + TOLERANCE + 1
    assert made.add(LIFE, reckonings[1], 0) is None


def test_between_two_instants_a_robot_that_told_both_moves_evenly() -> None:
    made, place = track()
    (item,), ((delta, cov),) = told(1)
    made.add(LIFE, item, 0)
    first, second = made.step(place, NS // 4), made.step(made.step(place, NS // 4).place, 2 * NS)
    np.testing.assert_allclose(first.delta, 0.25 * delta)
    np.testing.assert_allclose(first.cov, 0.25 * cov)
    np.testing.assert_allclose(second.cov, 0.75 * cov)
    assert (first.dt_s, second.dt_s) == (0.25, 0.75)
    np.testing.assert_allclose(moved([first, second])[0], delta, atol=1e-12)


def test_within_what_was_lost_a_robot_may_be_anywhere() -> None:
    """It told of 1, 2, 3 and 4 s, and 2 and 3 s were not heard."""
    made, place = track()
    reckonings, _ = told(4)
    made.add(LIFE, reckonings[0], 0)
    made.add(LIFE, reckonings[3], 0)
    quarters = [k * NS // 4 for k in range(1, 17)]
    covered = [made.covers(place, t_ns) for t_ns in quarters]
    # Between 3 and 4 s it moved evenly, but nobody knows from where.
    assert covered == [t_ns <= NS or t_ns == 4 * NS for t_ns in quarters]
    made.add(LIFE, reckonings[2], 0)
    assert [made.covers(place, t_ns) for t_ns in quarters] == [t_ns <= NS or t_ns >= 3 * NS for t_ns in quarters]
    made.add(LIFE, reckonings[1], 0)
    assert all(made.covers(place, t_ns) for t_ns in quarters)


def test_a_new_life_is_coasted_to() -> None:
    made, place = track()
    for item in told(2)[0]:
        made.add(LIFE, item, 0)
    reborn = told(2, born_ns=5 * NS)[0]
    for item in reborn:
        made.add((2, 5), item, 0)
    steps = walked(made, place, 7 * NS)
    assert [step.place.t_ns // NS for step in steps] == [1, 2, 5, 6, 7]
    np.testing.assert_array_equal(steps[2].delta, np.zeros(4))
    np.testing.assert_allclose(steps[2].cov, np.diag([0.25, 0.25, 0.25, 0.16]) * 9.0)
    at_two = steps[1].place
    assert [made.covers(at_two, t_s * NS) for t_s in (2, 3, 5, 6, 8)] == [True, False, True, True, False]


def test_renewed_anchors_link_as_long_as_the_end_of_the_old_sum_is_known() -> None:
    teller, part = Teller(0), (np.array([1.0, 0.0, 0.0, 0.1]), NOISE)
    reckonings = [teller.moved((k + 1) * 100 * NS, *part) for k in range(9)]
    assert len({item.anchor_ns for item in reckonings}) == 2
    closing = next(item for item in reckonings if item.t_ns == reckonings[-1].anchor_ns)
    linked, place = track()
    for item in (reckonings[0], closing, reckonings[-1]):
        linked.add(LIFE, item, 0)
    steps = walked(linked, place, 900 * NS)
    whole = np.zeros(4), np.zeros((4, 4))
    for _ in range(9):
        whole = extended(*whole, *part)
    np.testing.assert_allclose(moved(steps)[0], whole[0], atol=1e-11)
    np.testing.assert_allclose(moved(steps)[1], whole[1], atol=1e-10)
    broken, place = track()
    for item in (reckonings[0], reckonings[-1]):
        broken.add(LIFE, item, 0)
    assert walked(broken, place, 900 * NS)[1].cov[0, 0] == pytest.approx((0.5 * 500.0) ** 2)


def test_sums_that_contradict_each_other_are_not_believed() -> None:
    counters: Counter[str] = Counter()
    start = Node(0, 0)
    made = Track(start, COAST, TOLERANCE, counters)
    made.begin(LIFE, 0, 0)
    first, second = told(2)[0]
    made.add(LIFE, first, 0)
    made.add(LIFE, Reckoning(0, NS, 2 * NS, second.delta, 0.1 * second.cov), 0)
    steps = walked(made, Place(0, start), 2 * NS)
    np.testing.assert_array_equal(steps[1].delta, np.zeros(4))
    assert counters["replica.bad_odometry"] == 1


def test_what_is_settled_is_forgotten_and_not_changed_any_more() -> None:
    made, place = track()
    reckonings, _ = told(6)
    for item in (*reckonings[:2], *reckonings[3:]):
        made.add(LIFE, item, 0)
    there = walked(made, place, 4 * NS)[-1].place
    made.settle(there)
    assert made.add(LIFE, reckonings[2], 0) is None
    assert made.add(LIFE, reckonings[0], 0) is None
    assert [step.place.t_ns // NS for step in walked(made, there, 6 * NS)] == [5, 6]


def test_a_clock_that_is_off_is_allowed_for() -> None:
    made = Track(Node(0, 0), COAST, TOLERANCE, Counter())
    made.begin(LIFE, 7 * NS, 7 * NS)
    (item,), _ = told(1, born_ns=7 * NS)
    made.add(LIFE, item, 7 * NS)
    assert made.newest.t_ns == NS


def test_there_is_an_end_to_memory_and_to_the_chain() -> None:
    counters: Counter[str] = Counter()
    start = Node(0, 0)
    made = Track(start, COAST, TOLERANCE, counters)
    for k in range(MAX_NODES + 3):
        made.add(LIFE, Reckoning(0, k, k + 1, np.zeros(4), np.zeros((4, 4))), 0)
    assert counters["replica.overflow"] == 4
    with pytest.raises(ValueError, match="covers"):
        made.step(Place(MAX_NODES, made.newest), 2 * MAX_NODES)


def test_one_instant_takes_no_more_than_a_few_sums_and_names() -> None:
    """Whoever makes up anchors or lives without end fills no memory."""
    counters: Counter[str] = Counter()
    made = Track(Node(0, 0), COAST, TOLERANCE, counters)
    for k in range(100):
        made.add(LIFE, Reckoning(k, k, NS, np.zeros(4), np.zeros((4, 4))), 0)
    assert max(len(node.sums) for node in made._nodes) == MAX_SUMS
    for k in range(2 * MAX_NAMES):
        made.begin((2, k), NS, 0)
    assert len(made._known) == MAX_NAMES
    assert counters["replica.overflow"] > MAX_NAMES


def test_an_exact_zero_of_the_noise_comes_out_of_long_sums_as_one() -> None:
    """No increment has a negative variance, and none is taken for a contradiction."""
    counters: Counter[str] = Counter()
    start = Node(0, 0)
    made, place = Track(start, COAST, TOLERANCE, counters), Place(0, start)
    made.begin(LIFE, 0, 0)
    total = np.zeros(4), np.zeros((4, 4))
    for k in range(1, 500):
        total = extended(*total, np.array([0.5, 0.0, 0.0, 0.3]), np.diag([0.01, 0.0, 0.0, 1e-6]))
        made.add(LIFE, Reckoning(0, (k - 1) * NS, k * NS, *total), 0)
    for step in walked(made, place, 499 * NS):
        assert np.linalg.eigvalsh(step.cov)[0] > -1e-15
        np.testing.assert_allclose(step.cov, np.diag([0.01, 0.0, 0.0, 1e-6]), atol=1e-9)
    assert not counters
