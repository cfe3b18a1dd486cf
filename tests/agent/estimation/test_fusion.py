"""Intersection and pair updates: consistent for any correlation, and the identities the protocol stands on."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.colocalization import Options, contact, resolve_cross, sighting_update
from agent.estimation.gaussian import clip_canonical_correlations, gain, is_positive_definite
from agent.estimation.intersection import Weight, best_inflated_update, cost, fuse
from agent.estimation.motion import UNICYCLE
from agent.estimation.observation import RelativeModel
from agent.estimation.unscented import DEFAULT
from network.messages import NEVER, Belief, Epoch, Line, Measurement, Snapshot

Array = NDArray[np.float64]

WEIGHTS: tuple[Weight, ...] = ("trace", "logdet", "fast")


def random_joint(rng: np.random.Generator, n: int, m: int) -> Array:
    """A joint covariance with strong correlation."""
    root = rng.normal(size=(n + m, n + m)) * rng.uniform(0.1, 2.0, size=(n + m, 1))
    return np.asarray(root @ root.T + 1e-3 * np.eye(n + m))


@pytest.mark.parametrize("weight", WEIGHTS)
def test_intersection_bounds_the_true_covariance(weight: Weight) -> None:
    rng = np.random.default_rng(7)
    for draw in range(200):
        joint = random_joint(rng, 3, 3)
        P_a, P_b = joint[:3, :3], joint[3:, 3:]
        _, bound, w = fuse(np.zeros(3), P_a, np.zeros(3), P_b, (), weight)
        K_a, K_b = bound @ (w * np.linalg.inv(P_a)), bound @ ((1.0 - w) * np.linalg.inv(P_b))
        mix = np.hstack([K_a, K_b])
        truth = mix @ joint @ mix.T
        assert np.linalg.eigvalsh(bound - truth).min() > -1e-9, f"seed 7, draw {draw}"
        if weight != "fast":
            best = min(float(cost(P_a, weight)), float(cost(P_b, weight)))
            assert float(cost(bound, weight)) <= best + 1e-9


@pytest.mark.parametrize("weight", WEIGHTS)
def test_intersection_is_idempotent_and_symmetric(weight: Weight) -> None:
    rng = np.random.default_rng(8)
    joint = random_joint(rng, 3, 3)
    mean_a, mean_b = np.array([1.0, 2.0, 3.1]), np.array([1.5, 2.2, -3.1])
    P_a, P_b = joint[:3, :3], joint[3:, 3:]
    mean, cov, _ = fuse(mean_a, P_a, mean_a, P_a, (2,), weight)
    assert np.allclose(mean, mean_a)
    assert np.allclose(cov, P_a)
    one = fuse(mean_a, P_a, mean_b, P_b, (2,), weight)
    other = fuse(mean_b, P_b, mean_a, P_a, (2,), weight)
    assert np.allclose(one[1], other[1], rtol=1e-6)
    # Headings just either side of pi are close.
    assert abs(one[0][2]) > 2.0


def test_an_inflated_update_is_consistent_for_any_correlation() -> None:
    rng = np.random.default_rng(9)
    used = 0
    for draw in range(200):
        joint = random_joint(rng, 3, 3)
        H = rng.normal(size=(1, 6))
        R = np.array([[rng.uniform(0.001, 0.5)]])
        own, other = joint[:3, :3], joint[3:, 3:]
        found = best_inflated_update(
            own, H[:, :3], H[:, :3] @ own @ H[:, :3].T, H[:, 3:] @ other @ H[:, 3:].T, R, "trace"
        )
        if found is None:
            continue
        used += 1
        K, claimed, left, w = found
        mix = np.hstack([np.eye(3) - K @ H[:, :3], -K @ H[:, 3:]])
        truth = mix @ joint @ mix.T + K @ R @ K.T
        assert np.linalg.eigvalsh(claimed - truth).min() > -1e-9, f"seed 9, draw {draw}"
        assert np.trace(claimed) < np.trace(own)
        assert np.allclose(left, claimed @ np.linalg.inv(own / w))
    assert used > 20


def test_who_applied_a_contact_does_not_change_the_cross_covariance() -> None:
    rng = np.random.default_rng(10)
    for _ in range(50):
        joint = random_joint(rng, 3, 3)
        H, R = rng.normal(size=(2, 6)), np.diag([0.1, 0.2])
        S = H @ joint @ H.T + R
        K = gain(joint @ H.T, S)
        both = joint - K @ S @ K.T
        for keep in (slice(0, 3), slice(3, 6)):
            one_sided = K.copy()
            one_sided[keep] = 0.0
            left = np.eye(6) - one_sided @ H
            joint_after = left @ joint @ left.T + one_sided @ R @ one_sided.T
            assert np.allclose(joint_after[:3, 3:], both[:3, 3:], atol=1e-10)


def told(joint: Array, part: slice, factor: Array, base: Epoch = NEVER, lines: tuple[Line, ...] = ()) -> Snapshot:
    mean = np.array([0.0, 0.0, 0.3]) if part.start == 0 else np.array([5.0, 2.0, -1.0])
    return Snapshot(Belief("unicycle", mean, joint[part, part]), base, factor, np.eye(3), lines)


def test_a_contact_is_the_joint_update() -> None:
    joint = random_joint(np.random.default_rng(11), 3, 3) * 0.05
    base = Epoch(5, "r1", 1)
    low = told(joint, slice(0, 3), joint[:3, 3:], base)
    high = told(joint, slice(3, 6), np.eye(3), base)
    item = Measurement("range_bearing", np.array([5.5, 0.1]), np.diag([0.04, 0.01]))
    found = contact(low, high, True, [item], True, Options("jacobian", DEFAULT))
    H = RelativeModel("range_bearing", 3).jacobian(np.concatenate([low.belief.mean, high.belief.mean]))
    S = H @ joint @ H.T + item.R
    assert found.cross is not None
    assert np.allclose(found.cross, joint[:3, 3:])
    assert np.allclose(found.S, S)
    K = gain(joint @ H.T, S)
    assert np.allclose(found.cross_after, (joint - K @ S @ K.T)[:3, 3:])
    # The same contact with the roles of lower and higher id turned round.
    mirrored = contact(high, low, False, [item], True, Options("jacobian", DEFAULT))
    assert mirrored.cross is not None
    assert np.allclose(mirrored.cross, joint[:3, 3:].T)


def test_the_innovation_cap_inflates_to_exactly_the_cap() -> None:
    joint = random_joint(np.random.default_rng(12), 3, 3) * 0.01
    low, high = told(joint, slice(0, 3), np.zeros((3, 0))), told(joint, slice(3, 6), np.zeros((3, 0)))
    item = Measurement("range", np.array([30.0]), np.array([[0.01]]))
    found = contact(low, high, True, [item], True, Options("unscented", DEFAULT, innovation_cap=9.0))
    assert found.nis > 9.0
    assert float(found.innovation @ np.linalg.solve(found.S, found.innovation)) == pytest.approx(9.0)


def test_the_correlation_is_recovered_from_whichever_side_is_ahead() -> None:
    joint = random_joint(np.random.default_rng(13), 3, 3)
    old, new = Epoch(1, "r1", 1), Epoch(2, "r1", 2)
    A, B, line = np.diag([1.0, 2.0, 3.0]), np.diag([0.5, 1.0, 1.5]), np.diag([2.0, 2.0, 1.0])
    low, high = slice(0, 3), slice(3, 6)
    met = told(joint, low, A, new)
    assert np.allclose(resolve_cross(met, told(joint, high, B, new)), A)  # type: ignore[arg-type]
    behind = told(joint, high, B, old, (Line(new, line),))
    assert np.allclose(resolve_cross(met, behind), A @ line.T)  # type: ignore[arg-type]
    ahead = told(joint, high, B, new)
    assert np.allclose(resolve_cross(told(joint, low, A, old, (Line(new, line),)), ahead), line @ B.T)  # type: ignore[arg-type]
    assert resolve_cross(told(joint, low, A, old), ahead) is None
    assert resolve_cross(met, told(joint, high, B, old)) is None
    never = told(joint, low, np.zeros((3, 0))), told(joint, high, np.zeros((3, 0)))
    assert np.array_equal(resolve_cross(*never), np.zeros((3, 3)))  # type: ignore[arg-type]


def test_clipping_makes_a_joint_covariance_admissible_and_leaves_good_ones_alone() -> None:
    joint = random_joint(np.random.default_rng(14), 3, 3)
    good = clip_canonical_correlations(joint[:3, :3], joint[:3, 3:], joint[3:, 3:])
    assert np.allclose(good, joint[:3, 3:])
    clipped = clip_canonical_correlations(joint[:3, :3], 5.0 * joint[:3, 3:], joint[3:, 3:])
    repaired = joint.copy()
    repaired[:3, 3:], repaired[3:, :3] = clipped, clipped.T
    assert is_positive_definite(repaired)


def test_sightings_of_a_target_stay_honest() -> None:
    """Robot and target seen by range 20 times: NEES of both stays below one per degree of freedom (seed 15)."""
    rng = np.random.default_rng(15)
    own_nees, target_nees, count = 0.0, 0.0, 150
    P_own, P_target, R = np.diag([0.25, 0.25, 0.01]), np.diag([1.0, 1.0, 0.1]), np.array([[0.01]])
    model, options = RelativeModel("range", 3), Options("unscented", DEFAULT)
    for _ in range(count):
        true_own, true_target = np.array([0.0, 0.0, 0.2]), np.array([8.0, 3.0, 1.0])
        own = (rng.multivariate_normal(true_own, P_own), P_own)
        target = (rng.multivariate_normal(true_target, P_target), P_target)
        for _ in range(20):
            z = model.h(np.concatenate([true_own, true_target])) + rng.normal(size=1) * 0.1
            first, second, _ = sighting_update(
                (*own, UNICYCLE), (*target, UNICYCLE), model, z, R, "trace", True, options
            )
            own = own if first is None else (first.mean, first.cov)
            target = target if second is None else (second.mean, second.cov)
        for truth, (mean, cov), index in ((true_own, own, 0), (true_target, target, 1)):
            error = mean - truth
            nees = float(error @ np.linalg.solve(cov, error)) / 3.0
            own_nees, target_nees = (own_nees + nees, target_nees) if index == 0 else (own_nees, target_nees + nees)
        assert np.trace(target[1]) < np.trace(P_target)
    assert own_nees / count < 1.15
    assert target_nees / count < 1.15
