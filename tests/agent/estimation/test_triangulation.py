"""Published bearing-only filters: the minimiser of their objective, recursions written otherwise, known figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.bearing_filters import Kind, build
from agent.estimation.sights import Sight, Told
from agent.estimation.triangulation import Triangulation, fading, numbers_told
from tests.agent.estimation.triangulation_world import (
    DT,
    LAYOUT,
    SIGMA,
    course,
    noisy,
    play,
    world,
)

Array = NDArray[np.float64]

A = np.block([[np.eye(3), DT * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
AXIS = SIGMA / np.sqrt(3.0)


def story(seed: int, steps: int) -> tuple[list[list[Sight]], list[list[Told]]]:
    """Sights of the robot and three neighbours, and what those tell, with covariances, at each step."""
    rng = np.random.default_rng(seed)
    truth, places = course("circle"), LAYOUT[:4] + rng.normal(size=(4, 3))
    seen, told = [], []
    for k in range(steps):
        away = truth[k, :3] - places
        g = noisy(away / np.linalg.norm(away, axis=-1, keepdims=True), SIGMA, rng)
        seen.append([Sight(places[j], g[j], AXIS, own=j == 0) for j in range(4)])
        roots = rng.normal(size=(3, 6, 6))
        told.append([Told(truth[k] + rng.normal(size=6), root @ root.T + np.eye(6)) for root in roots])
    return seen, told


def pseudo(sight: Sight) -> tuple[Array, Array]:
    """H (3, 6) and z (3,)."""
    P = np.eye(3) - np.outer(sight.direction, sight.direction)
    return np.hstack([P, -sight.age_s * P]), P @ sight.place


# -- spatial-temporal triangulation --------------------------------------------------------------------------


def test_forgetting_is_the_published_one_at_10_hz() -> None:
    assert fading(0.1, 6.25, 6.0) == pytest.approx(0.787240733566, abs=1e-12)
    assert Triangulation().forgetting(0.1) == fading(0.1, 6.25, 6.0)
    # By memory it does not depend on the rate.
    slow = Triangulation(memory_s=0.4)
    assert slow.forgetting(0.1) == pytest.approx(slow.forgetting(0.05) ** 2, rel=1e-12)


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_every_step_minimises_the_objective_over_the_horizon(late: float) -> None:
    """The stacked least squares of eq. 10-12: each term of the past, moved to the last instant, as a row of its own."""
    seed, steps, c = 3, 12, 2.0
    seen, told = story(seed, steps)
    told = [[Told(item.mean) for item in at] for at in told]
    seen = [[replace(s, age_s=0.0 if s.own else late) for s in at] for at in seen]
    chosen, r1 = Triangulation(), 10.0 * SIGMA**2
    f = chosen.forgetting(DT)
    state = chosen.start(seen[0][0].place)
    start = state.mean
    predictions: list[list[Array]] = []
    for k in range(steps):
        predictions.append([A @ state.mean, *(item.mean for item in told[k])])
        state = chosen.step(state, DT, seen[k], told[k])
        rows, right = [], []
        for t in range(k + 1):
            back = np.linalg.matrix_power(np.linalg.inv(A), k - t)
            lasting = np.sqrt(f ** (k - t))
            for sight in seen[t]:
                H, z = pseudo(sight)
                rows.append(lasting * np.sqrt(c / r1) * H @ back)
                right.append(lasting * np.sqrt(c / r1) * z)
            for prediction in predictions[t]:
                rows.append(lasting * np.sqrt(1.0 / 4.0) * back)
                right.append(lasting * np.sqrt(1.0 / 4.0) * prediction)
        # The start is one more term, M(0) = I, a step before the first.
        rows.append(np.sqrt(f ** (k + 1)) * np.linalg.matrix_power(np.linalg.inv(A), k + 1))
        right.append(np.sqrt(f ** (k + 1)) * start)
        expected, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)
        assert np.abs(state.mean - expected).max() < 1e-9, f"seed {seed}, step {k}"


def test_a_robot_that_sees_and_hears_nothing_moves_on() -> None:
    chosen = Triangulation()
    state = chosen.start(np.array([1.0, 2.0, 3.0]))
    state = chosen.step(state, DT, [Sight(np.zeros(3), np.array([1.0, 0.0, 0.0]), AXIS, used=False)], [])
    state = chosen.step(state, DT, [], [])
    assert np.allclose(state.mean, [1.0, 2.0, 3.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert np.linalg.eigvalsh(state.matrix).min() >= 1.0


def test_constant_velocity_without_noise_is_found_exactly() -> None:
    times = DT * np.arange(1, 301)[:, None]
    truth = np.hstack([np.array([15.0, 0.0, 0.0]) + times * [-1.0, 2.0, 0.3], np.tile([-1.0, 2.0, 0.3], (300, 1))])
    run = play(world(0, 1, truth, fixed=True, noise=0.0), "stt")
    assert np.abs(run.errors[:, -1]).max() < 1e-11


def test_a_circle_without_noise_leaves_a_lag() -> None:
    """Of the model, not of noise: it is there however much directions count, and larger when they count less."""
    lags = []
    for scale in (10.0, 1.6, 0.01):
        run = play(world(0, 1, "circle", fixed=True, noise=0.0), "stt", {"scale": scale})
        lags.append((run.position(run.tail), run.velocity(run.tail)))
    assert lags[0] == pytest.approx((0.270, 1.272), abs=0.001)
    assert lags[1] == pytest.approx((0.215, 1.156), abs=0.002)
    assert lags[2] == pytest.approx((0.204, 1.133), abs=0.002)


# -- the others ----------------------------------------------------------------------------------------------


def kalman(x: Array, P: Array, Q: Array, sights: list[Sight], R: Array) -> tuple[Array, Array]:
    """Prediction and one correction with all directions stacked, by the gain and Joseph's form."""
    x, P = A @ x, A @ P @ A.T + Q
    if not sights:
        return x, P
    pairs = [pseudo(sight) for sight in sights]
    H, z = np.vstack([pair[0] for pair in pairs]), np.concatenate([pair[1] for pair in pairs])
    R = np.kron(np.eye(len(sights)), R)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    left = np.eye(6) - K @ H
    return x + K @ (z - H @ x), left @ P @ left.T + K @ R @ K.T


def noise(qp: float, qv: float) -> Array:
    return np.diag([qp, qp, qp, qv, qv, qv])


def cmkf(x: Array, P: Array, sights: list[Sight], told: list[Told]) -> tuple[Array, Array]:
    return kalman(x, P, noise(0.1325, 0.2390), sights, 26.5483 * SIGMA**2 * np.eye(3))


def cikf(x: Array, P: Array, sights: list[Sight], told: list[Told]) -> tuple[Array, Array]:
    x, P = kalman(x, P, noise(0.8987, 0.2988), sights[:1], 23.1375 * SIGMA**2 * np.eye(3))
    means, covs = np.array([item.mean for item in told]), np.array([item.cov for item in told])
    return 0.25 * x + 0.75 * means.mean(axis=0), 0.25 * P + 0.75 * covs.mean(axis=0)


def hcmci(x: Array, P: Array, sights: list[Sight], told: list[Told]) -> tuple[Array, Array]:
    """What is told here is the posterior of the last step, moved: it is moved back first, as the method reads it."""
    back = np.linalg.inv(A)
    means = [x, *(back @ item.mean for item in told)]
    covs = [P, *(back @ item.cov @ back.T for item in told if item.cov is not None)]
    x, P = 0.25 * x + 0.75 * np.mean(means, axis=0), 0.25 * P + 0.75 * np.mean(covs, axis=0)
    return kalman(x, P, 4.0 * noise(0.0542, 0.0804), sights, 4.0 * 1.9219 * SIGMA**2 * np.eye(3))


def tkf(x: Array, P: Array, sights: list[Sight], told: list[Told]) -> tuple[Array, Array]:
    G, places = np.array([s.direction for s in sights]), np.array([s.place for s in sights])
    along = np.sum(G * places, axis=1)
    point = np.linalg.solve(len(sights) * np.eye(3) - G.T @ G, places.sum(axis=0) - G.T @ along)
    x, P = A @ x, A @ P @ A.T + noise(0.1325, 0.2390)
    K = P[:, :3] @ np.linalg.inv(P[:3, :3] + 26.5483 * SIGMA**2 * np.eye(3))
    return x + K @ (point - x[:3]), P - K @ P[:3]


Recursion = Callable[[Array, Array, list[Sight], list[Told]], tuple[Array, Array]]
RECURSIONS: dict[Kind, Recursion] = {"cmkf": cmkf, "cikf": cikf, "hcmci": hcmci, "tkf": tkf}


@pytest.mark.parametrize("kind", RECURSIONS)
def test_published_filters_equal_recursions_written_otherwise(kind: Kind) -> None:
    seed = 11
    seen, told = story(seed, 40)
    chosen = build(kind)
    state = chosen.start(seen[0][0].place)
    x, P = state.mean, state.matrix
    assert np.array_equal(P, np.eye(6)) and np.array_equal(x[3:], np.zeros(3))
    for k, (sights, others) in enumerate(zip(seen, told)):
        x, P = RECURSIONS[kind](x, P, sights, others)
        state = chosen.step(state, DT, sights, others)
        mean, cov = chosen.belief(state)
        assert np.allclose(mean, x, rtol=0.0, atol=1e-9), f"seed {seed}, step {k}"
        assert np.allclose(cov, P, rtol=0.0, atol=1e-9), f"seed {seed}, step {k}"


def test_the_centralized_filter_is_a_kalman_filter_of_all_with_a_prior_of_n_robots() -> None:
    """S / n, y / n, n Q with P(0) = I is P' = P / n of the plain filter with Q and P'(0) = I / n."""
    seen, _ = story(5, 30)
    chosen = build("ckf")
    state = chosen.start(np.zeros(3))
    x, P = np.zeros(6), np.eye(6) / 4.0
    for sights in seen:
        x, P = kalman(x, P, noise(0.000325, 0.000696), sights, 1.354101 * SIGMA**2 * np.eye(3))
        state = chosen.step(state, DT, sights, [])
    assert np.allclose(state.mean, x, atol=1e-9)
    assert np.allclose(state.matrix / 4.0, P, atol=1e-9)


def test_what_neighbours_are_told() -> None:
    numbers: dict[Kind, int] = {
        "stt": 12, "cmkf": 6, "tkf": 6, "cikf": 27, "hcmci": 33, "kcf_plus": 12, "icf_plus": 33
    }  # fmt: skip
    assert {kind: numbers_told(build(kind)) for kind in numbers} == numbers
    seen, told = story(2, 2)
    for kind in numbers:
        chosen = build(kind)
        state = chosen.step(chosen.start(seen[0][0].place), DT, seen[0], told[0] if chosen.tells_cov else [])
        item = chosen.predicted(state, DT, seen[1])
        assert (item.cov is not None) == chosen.tells_cov
        if kind == "cikf":
            # The posterior of own directions: alone, it is what the step comes to.
            alone = chosen.step(state, DT, seen[1][:1], [])
            assert np.array_equal(item.mean, alone.mean) and np.array_equal(item.cov, alone.matrix)
        else:
            assert np.allclose(item.mean, A @ state.mean, atol=1e-12)


def test_a_late_prediction_is_moved_to_the_instant() -> None:
    seen, told = story(4, 1)
    for kind in ("stt", "cikf", "hcmci"):
        chosen = build(kind)
        state = chosen.start(seen[0][0].place)
        now = [Told(np.concatenate([t.mean[:3] + 0.4 * t.mean[3:], t.mean[3:]])) for t in told[0]]
        late = [Told(t.mean, age_s=0.4) for t in told[0]]
        if chosen.tells_cov:
            far = np.block([[np.eye(3), 0.4 * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
            now = [Told(item.mean, far @ t.cov @ far.T) for item, t in zip(now, told[0]) if t.cov is not None]
            late = [Told(t.mean, t.cov, 0.4) for t in told[0]]
        one, other = chosen.step(state, DT, seen[0], now), chosen.step(state, DT, seen[0], late)
        assert np.allclose(one.mean, other.mean, atol=1e-9) and np.allclose(one.matrix, other.matrix, atol=1e-9)


def test_arrays_of_trials_are_played_as_each_alone() -> None:
    made = world(8, 3, "square", fixed=False)
    for kind in ("stt", "tkf", "hcmci"):
        together = play(made, kind).errors
        alone = play(made.only(1), kind).errors[0]
        assert np.allclose(together[1], alone, rtol=0.0, atol=1e-9)


# -- figures of the published simulation ---------------------------------------------------------------------

KNOWN: dict[Kind, tuple[float, float, float, float]] = {
    # Tail RMSE on the circle, and on the square: m, m/s.
    "ckf": (0.880, 1.558, 0.873, 1.898),
    "stt": (1.518, 1.816, 1.618, 2.124),
    "tkf": (1.834, 2.300, 1.832, 2.512),
    "cmkf": (1.985, 2.431, 1.991, 2.585),
    "hcmci": (2.371, 2.855, 2.346, 2.974),
    "cikf": (1.936, 2.657, 2.068, 2.487),
}


@pytest.mark.parametrize("kind", KNOWN)
def test_figures_of_the_published_layout(kind: Kind) -> None:
    """Within 6 percent: means over 10 trials are within 2 percent of those over 100."""
    seed, found = 21, []
    for target in ("circle", "square"):
        run = play(world(seed, 10, target, fixed=True), kind)
        found += [run.position(run.tail), run.velocity(run.tail)]
    assert found == pytest.approx(KNOWN[kind], rel=0.06), f"seed {seed}: {found}"


def test_the_noise_is_the_published_one() -> None:
    rng = np.random.default_rng(1)
    g = np.tile([0.6, 0.0, 0.8], (200_000, 1))
    angles = np.arccos(np.clip(np.sum(g * noisy(g, SIGMA, rng), axis=-1), -1.0, 1.0))
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(0.0814, abs=0.0005)
