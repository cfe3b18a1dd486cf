"""A scan of a sum of Gaussians: weights as enumerated by hand, new tracks, bearings that are surely another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from agent.estimation.gaussian import wrap
from agent.estimation.gaussian_sum import FADING, FAN, Rules, Seen, Tracks, begun_tracks, no_tracks, scanned
from agent.estimation.gaussian_sum_doubt import REFUTED
from agent.estimation.gaussian_sum_pruning import pruned
from tests.assertions import assert_covariance

Array = NDArray[np.float64]

H_VAR, R_VAR, NOISE = 0.02**2, 0.03**2, np.diag([0.06**2, 0.05**2])
IMPROVED = Rules(
    detection=0.9,
    gate=0.999,
    birth=5e-4,
    clutter=0.3,
    anywhere=0.1,
    strangeness=1.0,
    adoption=0.005,
    improved=True,
    floor=1e-12,
    depth=4,
    family=1e-3,
)
PUBLISHED = replace(IMPROVED, gate=0.95, birth=0.5, clutter=1.0, adoption=0.5, improved=False)


def tracks_of(*of: int, mean: Array, weight: Array, sigma: float = 0.3, heading: float = 0.2) -> Tracks:
    """Tracks of robots `of` with independent components."""
    count = len(of)
    cov = np.diag([sigma**2, sigma**2, 0.01, heading**2])
    return Tracks(
        np.array(of),
        np.asarray(weight, dtype=np.float64),
        np.asarray(mean, dtype=np.float64)[:, None],
        np.broadcast_to(cov, (count, 1, 4, 4)).copy(),
        np.zeros(count, dtype=np.bool_),
        np.arange(1, 4 * count + 1).reshape(count, 4),
        np.zeros(count),
    )


def seen_of(heights: Array, ranges: Array, bearings: Array, possible: Array | None = None) -> Seen:
    """A scan of robots with these heights and ranges; NaN where there is none."""
    h, r, b = (np.asarray(part, dtype=np.float64) for part in (heights, ranges, bearings))
    n = len(h)
    there = np.isfinite(h), np.isfinite(r)
    return Seen(
        np.nan_to_num(h),
        np.full(n, H_VAR),
        there[0],
        np.nan_to_num(r),
        np.full(n, R_VAR),
        there[1],
        there[0] | there[1],
        b.reshape(-1, 2),
        NOISE,
        np.ones((n, len(b)), dtype=np.bool_) if possible is None else np.asarray(possible),
        possible is not None,
    )


def ekf(m: Array, P: Array, y: float | Array, H: Array, R: Array, extra: float = 0.0) -> tuple[Array, Array, Array]:
    """An extended Kalman filter's update, and the innovation's covariance."""
    H, y = np.atleast_2d(H), np.atleast_1d(y)
    S = H @ P @ H.T + R + extra
    K = P @ H.T @ np.linalg.inv(S)
    new = m + K @ y
    new[3] = (new[3] + np.pi) % (2.0 * np.pi) - np.pi
    return new, P - K @ S @ K.T, S


def by_hand(m: Array, P: Array, w: float, h: float, r: float, bearings: Array, rules: Rules) -> list[tuple]:
    """Children (weight, mean) of one track, all measurements but far bearings being inside their gates."""
    residual = h - m[2]
    m, P, S = ekf(m, P, residual, np.array([0.0, 0.0, 1.0, 0.0]), np.array([[H_VAR]]))
    w *= rules.detection * norm(0.0, np.sqrt(S[0, 0])).pdf(residual)
    d = np.linalg.norm(m[:3])
    curve = (np.eye(3) - np.outer(m[:3], m[:3]) / d**2) / d @ P[:3, :3]
    residual = r - d - 0.5 * np.trace(curve)
    row = np.append(m[:3] / d, 0.0)
    m, P, S = ekf(m, P, residual, row, np.array([[R_VAR]]), 0.5 * np.trace(curve @ curve))
    w *= rules.detection * norm(0.0, np.sqrt(S[0, 0])).pdf(residual)
    x, y, z, _ = m
    q = np.hypot(x, y)
    d2 = x * x + y * y + z * z
    rows = np.array([[-y / q**2, x / q**2, 0.0, 0.0], [-x * z / (q * d2), -y * z / (q * d2), q / d2, 0.0]])
    children = [(w * (1.0 - rules.detection * rules.gate) * rules.clutter, m)]
    for bearing in bearings:
        off = bearing - [np.arctan2(y, x), np.arctan2(z, q)]
        off[0] = (off[0] + np.pi) % (2.0 * np.pi) - np.pi
        mean, _, S = ekf(m, P, off, rows, NOISE)
        square = float(off @ np.linalg.solve(S, off))
        if square <= chi2.ppf(rules.gate, 2):
            likely = np.exp(-0.5 * square) / (2.0 * np.pi * np.sqrt(np.linalg.det(S)))
            children.append((w * rules.detection * likely, mean))
    return children


def test_weights_and_means_of_children_are_those_of_an_enumeration() -> None:
    """Two tracks of one robot, a bearing for each, one between both, and one of nobody."""
    start = tracks_of(0, 0, mean=[[4.0, 1.0, 0.5, 0.3], [3.6, 2.0, 0.5, -2.0]], weight=[0.7, 0.3])
    bearings = np.array([[0.25, 0.12], [0.5, 0.1], [0.4, 0.12], [-2.0, 0.3]])
    seen = seen_of([0.52], [4.15], bearings)
    found, name = scanned(start, seen, replace(IMPROVED, birth=0.0), 100)
    children = [
        child
        for k in range(2)
        for child in by_hand(start.mean[k, 0].copy(), start.cov[k, 0], start.weight[k], 0.52, 4.15, bearings, IMPROVED)
    ]
    total = sum(weight for weight, _ in children)
    order = np.argsort([-weight for weight, _ in children])
    mine = np.argsort(-found.weight)
    assert len(found) == len(children) > 5
    assert np.allclose(found.weight[mine], [children[k][0] / total for k in order], rtol=1e-9)
    assert np.allclose(found.mean[mine, 0], [children[k][1] for k in order], atol=1e-9)
    assert_covariance(found.cov[:, 0])
    # Each child has a fresh name and remembers its parent.
    assert sorted(found.lineage[:, -1]) == list(range(100, name))
    assert set(found.lineage[:, -2].tolist()) == {4, 8}


@pytest.mark.parametrize("rules", [IMPROVED, PUBLISHED], ids=["improved", "published"])
def test_a_step_of_a_known_robot_is_that_of_an_extended_kalman_filter(rules: Rules) -> None:
    start = tracks_of(0, mean=[[4.0, 1.0, 0.5, 0.3]], weight=[1.0])
    bearings = np.array([[1.9, 0.3], [0.27, 0.11]])
    found, _ = scanned(start, seen_of([0.52], [4.15], bearings, [[False, True]]), rules, 1)
    assert len(found) == 1 and found.weight[0] == 1.0
    if rules.improved:
        (_, _), (_, mean) = by_hand(start.mean[0, 0].copy(), start.cov[0, 0], 1.0, 0.52, 4.15, bearings[1:], rules)
    else:
        m, P, _ = ekf(start.mean[0, 0], start.cov[0, 0], 0.02, np.array([0.0, 0.0, 1.0, 0.0]), np.array([[H_VAR]]))
        d = np.linalg.norm(m[:3])
        m, P, _ = ekf(m, P, 4.15 - d, np.append(m[:3] / d, 0.0), np.array([[R_VAR]]))
        x, y, z, _ = m
        q, d2 = np.hypot(x, y), m[:3] @ m[:3]
        H = np.array([[-y / q**2, x / q**2, 0.0, 0.0], [-x * z / (q * d2), -y * z / (q * d2), q / d2, 0.0]])
        mean, _, _ = ekf(m, P, bearings[1] - [np.arctan2(y, x), np.arctan2(z, q)], H, NOISE)
    assert np.allclose(found.mean[0, 0], mean, atol=1e-9)


def test_a_bearing_that_only_another_robot_can_have_made_is_no_evidence() -> None:
    """Both are in the direction of the one bearing; the first is nowhere else, the second may be elsewhere."""
    ahead, behind = [8.0, 2.0, 1.0, -2.0], [-8.0, 2.0, 1.0, 1.0]
    bearing = np.array([[np.arctan2(1.0, 4.0), 0.12]])
    alone = tracks_of(0, 0, mean=[ahead, behind], weight=[0.5, 0.5], sigma=0.1)
    found, _ = scanned(alone, seen_of([1.0], [np.nan], bearing), IMPROVED, 50)
    assert found.weight[found.mean[:, 0, 0] > 0.0].sum() > 0.9
    both = tracks_of(1, 0, 0, mean=[[4.0, 1.0, 0.5, 0.3], ahead, behind], weight=[1.0, 0.5, 0.5], sigma=0.1)
    found, _ = scanned(both, seen_of([1.0, 0.5], [np.nan, np.nan], bearing), IMPROVED, 50)
    second = found.of == 0
    assert found.weight[second & (found.mean[:, 0, 0] > 0.0)].sum() == pytest.approx(0.5, abs=0.2)
    assert np.bincount(found.of, found.weight) == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("missing", [None, 0, 1])
def test_robots_that_may_be_in_each_other_s_place_stay_so_whoever_is_not_seen(missing: int | None) -> None:
    """Two robots that mirror each other, seen without error for twenty scans: no bearing tells which is which.

    Where one is not seen, both may be where the other is, which makes two to one of it; without regard to who else may
    have made the bearing it would be a hundred to one.
    """
    places = [[4.0, 3.0, 0.5, 0.3], [4.0, -3.0, 0.5, -0.3]]
    rules = replace(IMPROVED, floor=1e-5)
    tracks = tracks_of(0, 0, 1, 1, mean=[*places, *places], weight=[0.5, 0.5, 0.5, 0.5], sigma=0.2)
    azimuth, elevation = np.arctan2(3.0, 4.0), np.arctan2(0.5, 5.0)
    bearings = np.array([[azimuth, elevation], [-azimuth, elevation]])
    if missing is not None:
        bearings = np.delete(bearings, missing, axis=0)
    seen, name = seen_of([0.5, 0.5], [np.hypot(5.0, 0.5)] * 2, bearings), 100
    for _ in range(20 if missing is None else 1):
        tracks, name = scanned(tracks, seen, rules, name)
        tracks = pruned(tracks, rules, families=True)
    for robot in (0, 1):
        up = (tracks.of == robot) & (tracks.mean[:, 0, 1] > 0.0)
        assert 0.3 < tracks.weight[up].sum() < 0.7


def test_a_bearing_outside_all_gates_begins_a_fan_of_headings_where_the_range_says() -> None:
    seen = seen_of([0.4], [5.0], np.array([[2.0, 0.1]]))
    found, _ = scanned(no_tracks(IMPROVED), seen, IMPROVED, 1)
    assert len(found) == FAN and np.allclose(found.weight, 1.0 / FAN)
    assert np.ptp(np.sort(np.mod(found.mean[:, 0, 3], 2.0 * np.pi))) == pytest.approx(2.0 * np.pi * 7 / 8)
    place = found.mean[0, 0, :3]
    assert np.linalg.norm(place) == pytest.approx(5.0, abs=0.03) and place[2] == pytest.approx(0.4, abs=0.01)
    # Well known along and in height, as badly across as the azimuth is.
    across = np.array([-np.sin(2.0), np.cos(2.0)])
    assert np.sqrt(across @ found.cov[0, 0, :2, :2] @ across) == pytest.approx(0.06 * 5.0, rel=0.05)
    assert found.cov[0, 0, 2, 2] <= H_VAR
    # Together they are as good as a uniform heading.
    angles = np.linspace(-np.pi, np.pi, 50)
    off = wrap(angles[:, None] - found.mean[:, 0, 3])
    mixed = norm(0.0, np.sqrt(found.cov[0, 0, 3, 3])).pdf(off).mean(axis=1)
    assert np.ptp(mixed) < 0.05 * mixed.mean()


def test_what_a_track_fits_worse_than_a_right_one_would_is_its_misfit() -> None:
    """Half of each Mahalanobis square less half its degrees of freedom, and how rare it is not to be seen."""
    start = replace(tracks_of(0, mean=[[4.0, 1.0, 0.5, 0.3]], weight=[1.0]), misfit=np.array([7.0]))
    bearing = np.array([[0.3, 0.15]])
    found, _ = scanned(start, seen_of([0.7], [np.nan], bearing), IMPROVED, 10)
    z = start.cov[0, 0, 2, 2]
    height = 0.2**2 / (z + H_VAR)
    m, P, _ = ekf(start.mean[0, 0], start.cov[0, 0], 0.2, np.array([0.0, 0.0, 1.0, 0.0]), np.array([[H_VAR]]))
    x, y, z = m[:3]
    q, d2 = np.hypot(x, y), m[:3] @ m[:3]
    H = np.array([[-y / q**2, x / q**2, 0.0, 0.0], [-x * z / (q * d2), -y * z / (q * d2), q / d2, 0.0]])
    off = bearing[0] - [np.arctan2(y, x), np.arctan2(z, q)]
    seen = float(off @ np.linalg.solve(H @ P @ H.T + NOISE, off))
    rare = 1.0 - IMPROVED.detection * IMPROVED.gate
    usual = -rare * np.log(rare) - (1.0 - rare) * np.log(1.0 - rare)
    before = FADING * 7.0 + 0.5 * (height - 1.0)
    expected = [before - np.log(rare) - usual, before + 0.5 * (seen - 2.0) - np.log(1.0 - rare) - usual]
    assert found.misfit == pytest.approx(expected)


def test_a_track_begun_beside_others_has_yet_to_prove_itself() -> None:
    """Else any bearing of somebody else would leave no robot sure."""
    seen = seen_of([0.4], [5.0], np.array([[2.0, 0.1]]))
    first, _ = scanned(no_tracks(IMPROVED), seen, IMPROVED, 1)
    assert np.all(first.misfit < REFUTED)
    beside, _ = scanned(tracks_of(0, mean=[[-4.0, 1.0, 0.4, 0.3]], weight=[1.0]), seen, IMPROVED, 1)
    new = beside.lineage[:, -2] == 0
    assert new.sum() == FAN and np.all(beside.misfit[new] > REFUTED)


def test_published_tracks_begin_with_the_printed_mean_variance_and_weight() -> None:
    seen = seen_of([0.4], [5.0], np.array([[2.0, 0.1]]))
    start = tracks_of(0, mean=[[-4.0, 1.0, 0.4, 0.3]], weight=[1.0])
    found, _ = scanned(start, replace(seen, with_range=np.array([True])), PUBLISHED, 1)
    new = found.lineage[:, -2] == 0
    assert np.allclose(
        found.mean[new, 0, :3], 5.0 * np.array([np.cos(0.1) * np.cos(2.0), np.cos(0.1) * np.sin(2.0), np.sin(0.1)])
    )
    assert np.allclose(found.cov[new, 0], np.diag([0.1, 0.1, 0.05, 4.0 * np.pi]))
    weight = 0.5 * norm(5.0 * np.sin(0.1), np.sqrt(0.05)).pdf(0.4)
    old = 1.0 - 0.9 * 0.95
    assert found.weight[new] == pytest.approx([weight / (weight + old)])


@pytest.mark.parametrize("case", ["in a gate", "without range", "of another"])
def test_no_track_begins_from_a_bearing(case: str) -> None:
    start = tracks_of(0, mean=[[4.0, 1.0, 0.5, 0.3]], weight=[1.0])
    bearing = np.array([[0.26, 0.12]]) if case == "in a gate" else np.array([[2.0, 0.1]])
    seen = seen_of([0.5], [np.nan if case == "without range" else 4.15], bearing)
    if case == "of another":
        seen = replace(seen, possible=np.array([[False]]))
    found, _ = scanned(start, seen, IMPROVED, 10)
    assert set(found.lineage[:, -2].tolist()) == {4}


def test_a_number_outside_its_gate_costs_a_track_weight_and_moves_nothing() -> None:
    start = tracks_of(0, 0, mean=[[4.0, 1.0, 0.5, 0.3], [9.0, 1.0, 0.5, 0.3]], weight=[0.1, 0.9])
    found, _ = scanned(start, seen_of([0.5], [4.15], np.empty((0, 2))), IMPROVED, 10)
    assert found.weight[0] > 5.0 * start.weight[0]
    assert np.array_equal(found.mean[1, 0, :2], [9.0, 1.0])


def test_a_peer_that_nothing_was_measured_of_is_untouched() -> None:
    start = tracks_of(0, 1, mean=[[4.0, 1.0, 0.5, 0.3], [-4.0, 1.0, 0.5, 0.3]], weight=[1.0, 1.0])
    seen = seen_of([0.5, np.nan], [4.15, np.nan], np.array([[0.25, 0.12], [2.9, 0.12]]))
    found, _ = scanned(start, seen, IMPROVED, 10)
    other = found.of == 1
    assert np.array_equal(found.mean[other], start.mean[1:]) and np.array_equal(found.cov[other], start.cov[1:])


def test_new_tracks_of_many_bearings_are_as_of_each() -> None:
    seen = seen_of([0.4, np.nan], [5.0, 7.0], np.array([[2.0, 0.1], [-1.0, -0.2]]))
    of, bearing = np.array([0, 1]), np.array([1, 0])
    both = begun_tracks(of, np.array([0.4, 0.8]), bearing, seen, IMPROVED)
    for k in range(2):
        alone = begun_tracks(of[k : k + 1], np.array([0.4]), bearing[k : k + 1], seen, IMPROVED)
        rows = both.of == k
        assert np.allclose(both.mean[rows], alone.mean) and np.allclose(both.cov[rows], alone.cov)
