"""Moments of a moved pose against a cloud of samples, and against sigma points where those are good."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.estimation.heading_moments import moved_in_its_frame

SAMPLES = 400_000


def cloud(
    mean: np.ndarray, cov: np.ndarray, delta: np.ndarray, noise: np.ndarray, heading: int, gains: tuple[int, int] | None
) -> tuple[np.ndarray, np.ndarray]:
    """States before and after, sampled; headings are not wrapped."""
    rng = np.random.default_rng(5)
    before = rng.multivariate_normal(mean, cov, SAMPLES)
    w = rng.multivariate_normal(np.zeros(len(delta)), noise, SAMPLES)
    scale, turn = (before[:, gains[0]], before[:, gains[1]]) if gains else (np.ones(SAMPLES), np.ones(SAMPLES))
    phi = before[:, heading] + 0.5 * delta[-1] * (turn - 1.0)
    step = complex(delta[0], delta[1]) * scale * np.exp(1j * phi)
    step = step + (w[:, 0] + 1j * w[:, 1]) * np.exp(1j * before[:, heading])
    after = before.copy()
    after[:, 0] += step.real
    after[:, 1] += step.imag
    after[:, heading] += turn * delta[-1] + w[:, -1]
    if len(delta) == 4:
        after[:, 2] += delta[2] + w[:, 2]
    return before, after


CASES = {
    "unicycle": (3, 2, None, 3),
    "gains": (5, 2, (3, 4), 3),
    "space": (4, 3, None, 4),
}


@pytest.mark.parametrize("sigma", [0.1, 1.0, 3.0])
@pytest.mark.parametrize("case", sorted(CASES))
def test_the_moments_are_those_of_samples(case: str, sigma: float) -> None:
    n, heading, gains, k = CASES[case]
    rng = np.random.default_rng(11)
    root = rng.normal(size=(n, n)) * 0.4
    scale = np.ones(n)
    scale[heading] = sigma / np.linalg.norm(root[heading])
    if gains:
        scale[list(gains)] = 0.3
    root = scale[:, None] * root
    cov = root @ root.T
    mean = np.zeros(n)
    mean[heading] = 0.7
    if gains:
        mean[list(gains)] = [0.9, 1.1]
    delta = rng.normal(size=k)
    spread = rng.normal(size=(k, k)) * 0.3
    noise = spread @ spread.T
    found = moved_in_its_frame(mean, cov, delta, noise, heading, gains)
    before, after = cloud(mean, cov, delta, noise, heading, gains)
    assert np.linalg.norm(found.mean - after.mean(axis=0)) < 0.02 * max(1.0, sigma)
    sampled = np.cov(after.T)
    deviations = np.sqrt(np.diagonal(sampled))
    assert np.abs((found.cov - sampled) / np.outer(deviations, deviations)).max() < 0.02
    crossed = (after - after.mean(axis=0)).T @ (before - before.mean(axis=0)) / SAMPLES
    wide = np.outer(deviations, np.sqrt(np.diagonal(cov)))
    assert np.abs((found.F @ cov - crossed) / wide).max() < 0.02


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 6.0))
def test_the_covariance_is_one_and_holds_what_is_linear(seed: int, sigma: float) -> None:
    """P' - F P F^T is the spread F does not explain: not negative for any width of the heading and any correlation."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 5)) * np.array([1.0, 1.0, sigma, 0.3, 0.3])[:, None]
    cov, mean = root @ root.T + 1e-9 * np.eye(5), np.append(rng.normal(size=3), [1.0, 1.0])
    found = moved_in_its_frame(mean, cov, rng.normal(size=3), np.zeros((3, 3)), 2, (3, 4))
    rest = np.linalg.eigvalsh(found.cov - found.F @ cov @ found.F.T)
    assert rest.min() > -1e-9 * np.abs(found.cov).max(), seed


@pytest.mark.parametrize("gains", [None, (3, 4)])
def test_a_position_is_not_learnt_by_driving_blindly(gains: tuple[int, int] | None) -> None:
    """An hour without any measurement, until the heading is nowhere: the claimed position only grows."""
    n = 5 if gains else 3
    mean, cov = np.zeros(n), np.diag([0.01, 0.01, 0.01, 0.02, 0.02][:n])
    mean[3:] = 1.0
    before = 0.0
    for k in range(3600):
        found = moved_in_its_frame(mean, cov, np.array([0.1, 0.0, 0.05]), np.diag([1e-4, 1e-6, 1e-2]), 2, gains)
        mean, cov = found.mean, found.cov
        smallest = float(np.linalg.eigvalsh(cov[:2, :2])[0])
        if k % 600 == 599:
            assert smallest > before
            before = smallest
    assert before > 1.0


@pytest.mark.parametrize("sigma_rad", [0.5, 1.0, 3.0, 10.0])
def test_who_heads_anywhere_and_goes_on_ends_up_anywhere(sigma_rad: float) -> None:
    """A straight drive of many steps with a heading that stays unknown: the error is not more than is claimed."""
    rng = np.random.default_rng(3)
    cov = np.diag([0.04, 0.04, sigma_rad**2])
    starts = np.sqrt(np.diagonal(cov)) * rng.standard_normal((4000, 3))
    mean = np.zeros(3)
    for _ in range(60):
        moved = moved_in_its_frame(mean, cov, np.array([0.1, 0.0, 0.0]), np.zeros((3, 3)), 2, persistent_rad2=0.1)
        mean, cov = moved.mean, moved.cov
    truth = starts[:, :2] + 6.0 * np.stack([np.cos(starts[:, 2]), np.sin(starts[:, 2])], axis=1)
    error = truth - mean[:2]
    claimed = float(np.trace(cov[:2, :2]))
    assert float((error**2).sum(axis=1).mean()) < 1.02 * claimed
    assert claimed < 4.0 * float((error**2).sum(axis=1).mean())


def test_a_planar_pose_takes_no_notice_of_what_is_vertical() -> None:
    rng = np.random.default_rng(7)
    root, noise_root, delta = rng.standard_normal((3, 3)), rng.standard_normal((4, 4)), rng.standard_normal(4)
    cov, noise, planar = 0.1 * root @ root.T, noise_root @ noise_root.T, [0, 1, 3]
    whole = moved_in_its_frame(np.array([1.0, 2.0, 0.3]), cov, delta, noise, 2)
    part = moved_in_its_frame(np.array([1.0, 2.0, 0.3]), cov, delta[planar], noise[np.ix_(planar, planar)], 2)
    assert np.array_equal(whole.mean, part.mean) and np.array_equal(whole.cov, part.cov)
