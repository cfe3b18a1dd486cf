"""Cooperative localization: what is exact in the linear case, what is only a bound, and what each side may skip."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.estimation.colocalization import (
    Contact,
    Options,
    StackedModel,
    absolute_update,
    contact,
    pair_update,
    resolve_cross,
    sighting_update,
)
from agent.estimation.gaussian import is_positive_definite, wrap
from agent.estimation.intersection import Weight
from agent.estimation.motion import SPATIAL, UNICYCLE
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.unscented import DEFAULT, Transform
from network.messages import NEVER, Belief, Epoch, Line, Measurement, Snapshot
from tests.assertions import assert_consistent

Array = NDArray[np.float64]

TRANSFORMS: tuple[Transform, ...] = ("unscented", "linearized", "jacobian")
WEIGHTS: tuple[Weight, ...] = ("trace", "logdet", "fast")
SEED = st.integers(0, 2**32 - 1)
OLD, MIDDLE, NEW = (Epoch(t, "r1", 1) for t in (1, 2, 3))


def random_covariance(rng: np.random.Generator, n: int) -> Array:
    root = rng.normal(size=(n, n))
    return np.asarray(root @ root.T + 0.1 * np.eye(n))


def options(transform: Transform = "unscented", cap: float = 0.0) -> Options:
    return Options(transform, DEFAULT, cap)


# Absolute information


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("kind", ["pose", "position", "heading"])
@given(SEED)
def test_absolute_information_is_used_as_by_a_kalman_filter(transform: Transform, kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov = rng.uniform(-2.0, 2.0, size=3), random_covariance(rng, 3) * 0.02
    model = AbsoluteModel(kind, UNICYCLE)
    H = model.jacobian(mean)
    z, R = H @ mean + rng.normal(size=len(H)) * 0.3, random_covariance(rng, len(H)) * 0.1
    found = absolute_update(mean.copy(), cov, UNICYCLE, model, z, R, options(transform))
    assert found is not None
    S = H @ cov @ H.T + R
    K = cov @ H.T @ np.linalg.inv(S)
    expected = mean + K @ (z - H @ mean)
    assert np.allclose(found.mean[:2], expected[:2], atol=1e-9)
    assert abs(float(wrap(found.mean[2] - expected[2]))) < 1e-9
    assert np.allclose(found.cov, (np.eye(3) - K @ H) @ cov, atol=1e-9)
    assert np.allclose(found.left, np.eye(3) - K @ H, atol=1e-8)
    assert found.nis == pytest.approx(float((z - H @ mean) @ np.linalg.solve(S, z - H @ mean)) / len(H))


def test_a_heading_fix_across_the_half_turn_moves_the_heading_the_short_way() -> None:
    mean, cov = np.array([0.0, 0.0, 3.1]), np.diag([1.0, 1.0, 0.04])
    found = absolute_update(
        mean, cov, UNICYCLE, AbsoluteModel("heading", UNICYCLE), np.array([-3.1]), np.array([[0.04]]), options()
    )
    assert found is not None
    assert abs(abs(float(found.mean[2])) - np.pi) < 1e-9
    assert np.array_equal(mean, [0.0, 0.0, 3.1])


@pytest.mark.parametrize("cap", [0.5, 4.0])
def test_the_cap_inflates_the_innovation_covariance_until_the_nis_is_the_cap(cap: float) -> None:
    """One dimension by hand: S' = S nis / cap, hence K' = K cap / nis and P' = P - K' S' K'^T."""
    cov, R, z = np.diag([1.0, 1.0, 0.5]), np.array([[0.5]]), np.array([2.5])
    heading = AbsoluteModel("heading", UNICYCLE)
    found = absolute_update(np.zeros(3), cov, UNICYCLE, heading, z, R, options("jacobian", cap))
    assert found is not None
    assert found.nis == pytest.approx(2.5**2)
    capped = 2.5**2 / cap
    assert float(found.mean[2]) == pytest.approx(0.5 / capped * 2.5)
    assert float(found.cov[2, 2]) == pytest.approx(0.5 - 0.25 / capped)


def test_an_innovation_below_the_cap_is_used_in_full() -> None:
    arguments = (np.zeros(3), np.eye(3), UNICYCLE, AbsoluteModel("position", UNICYCLE), np.array([0.5, 0.1]), np.eye(2))
    capped, plain = absolute_update(*arguments, options(cap=4.0)), absolute_update(*arguments, options())
    assert capped is not None
    assert plain is not None
    assert np.array_equal(capped.mean, plain.mean)
    assert np.array_equal(capped.cov, plain.cov)


# Sightings of a target


def sighting(
    own: tuple[Array, Array], target: tuple[Array, Array], z: Array, weight: Weight, correlated: bool, cap: float = 0.0
) -> tuple[tuple[Array, Array], tuple[Array, Array], tuple[bool, bool]]:
    """Beliefs after a range and bearing, and which of them were changed."""
    first, second, _ = sighting_update(
        (*own, UNICYCLE), (*target, UNICYCLE), SEES, z, R_SEES, weight, correlated, options(cap=cap)
    )
    return (
        own if first is None else (first.mean, first.cov),
        target if second is None else (second.mean, second.cov),
        (first is not None, second is not None),
    )


SEES = RelativeModel("range_bearing", UNICYCLE)
R_SEES = np.diag([0.05**2, 0.02**2])
OWN_TRUTH, TARGET_TRUTH = np.array([1.0, 2.0, 0.4]), np.array([9.0, 5.0, -1.0])


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize(("own_scale", "target_scale"), [(1.0, 10.0), (10.0, 1.0), (1.0, 1.0)])
def test_a_sighting_with_independent_beliefs_is_never_overconfident(
    weight: Weight, own_scale: float, target_scale: float
) -> None:
    """400 draws of both beliefs; the mean NEES per degree of freedom of either stays below one (seed 51)."""
    rng = np.random.default_rng(51)
    P_own, P_target = np.diag([0.02, 0.03, 0.001]) * own_scale, np.diag([0.02, 0.02, 0.01]) * target_scale
    nees, changed = np.zeros((400, 2)), np.zeros((400, 2), dtype=bool)
    for draw in range(400):
        own = rng.multivariate_normal(OWN_TRUTH, P_own), P_own
        target = rng.multivariate_normal(TARGET_TRUTH, P_target), P_target
        z = SEES.h(np.concatenate([OWN_TRUTH, TARGET_TRUTH])) + rng.normal(size=2) * np.sqrt(np.diagonal(R_SEES))
        own, target, changed[draw] = sighting(own, target, z, weight, True)
        for side, (truth, (mean, cov), prior) in enumerate(((OWN_TRUTH, own, P_own), (TARGET_TRUTH, target, P_target))):
            error = mean - truth
            nees[draw, side] = error @ np.linalg.solve(cov, error) / 3.0
            assert is_positive_definite(cov)
            size, before = (
                (np.linalg.det(cov), np.linalg.det(prior)) if weight == "logdet" else (np.trace(cov), np.trace(prior))
            )
            assert size <= before, f"seed 51, draw {draw}"
    assert nees.mean(axis=0).max() < 1.1, nees.mean(axis=0)
    if own_scale != target_scale:
        assert changed[:, 1 if target_scale > own_scale else 0].all()


def test_the_naive_sighting_is_the_joint_kalman_update_of_independent_beliefs() -> None:
    own, target = (OWN_TRUTH, np.diag([0.2, 0.3, 0.01])), (TARGET_TRUTH, np.diag([1.0, 0.5, 0.1]))
    z = np.array([8.9, -0.1])
    first, second, nis = sighting_update(
        (*own, UNICYCLE), (*target, UNICYCLE), SEES, z, R_SEES, "trace", False, options("jacobian")
    )
    assert first is not None
    assert second is not None
    joint, state = np.zeros((6, 6)), np.concatenate([OWN_TRUTH, TARGET_TRUTH])
    joint[:3, :3], joint[3:, 3:] = own[1], target[1]
    H = SEES.jacobian(state)
    S = H @ joint @ H.T + R_SEES
    K, innovation = joint @ H.T @ np.linalg.inv(S), z - SEES.h(state)
    after, cov = state + K @ innovation, joint - K @ S @ K.T
    assert np.allclose(np.concatenate([first.mean, second.mean]), after)
    assert np.allclose(first.cov, cov[:3, :3])
    assert np.allclose(second.cov, cov[3:, 3:])
    assert np.allclose(first.left, np.eye(3) - K[:3] @ H[:, :3])
    assert nis == pytest.approx(float(innovation @ np.linalg.solve(S, innovation)) / 2.0)


def test_repeated_naive_sightings_are_overconfident_and_intersected_ones_are_not() -> None:
    """A robot and a target see each other forty times: information circulates between them (seed 52)."""
    rng = np.random.default_rng(52)
    P_own, P_target, trials = np.diag([0.05, 0.05, 0.002]), np.diag([0.2, 0.2, 0.1]), 60
    worst = {}
    for correlated in (False, True):
        nees = np.zeros(trials)
        for trial in range(trials):
            own = rng.multivariate_normal(OWN_TRUTH, P_own), P_own
            target = rng.multivariate_normal(TARGET_TRUTH, P_target), P_target
            for _ in range(40):
                z = SEES.h(np.concatenate([OWN_TRUTH, TARGET_TRUTH])) + rng.normal(size=2) * np.sqrt(
                    np.diagonal(R_SEES)
                )
                own, target, _ = sighting(own, target, z, "trace", correlated)
            error = target[0] - TARGET_TRUTH
            nees[trial] = error @ np.linalg.solve(target[1], error) / 3.0
        worst[correlated] = float(nees.mean())
    assert worst[True] < 1.3, worst
    assert worst[False] > 2.0, worst


def test_a_capped_sighting_moves_less_and_promises_less() -> None:
    own, target = (OWN_TRUTH, np.diag([0.02, 0.03, 0.001])), (TARGET_TRUTH, np.diag([1.0, 1.0, 0.1]))
    outlier = np.array([25.0, 0.0])
    for correlated in (False, True):
        _, plain, _ = sighting(own, target, outlier, "trace", correlated)
        _, capped, _ = sighting(own, target, outlier, "trace", correlated, cap=4.0)
        assert np.linalg.norm(capped[0] - TARGET_TRUTH) < 0.5 * np.linalg.norm(plain[0] - TARGET_TRUTH)
        assert np.trace(capped[1]) > np.trace(plain[1])


# Contacts of a pair


def random_joint(rng: np.random.Generator, scale: float = 0.05) -> Array:
    root = rng.normal(size=(6, 6))
    return np.asarray((root @ root.T + 0.2 * np.eye(6)) * scale)


LOW_MEAN, HIGH_MEAN = np.array([0.0, 0.0, 0.3]), np.array([5.0, 2.0, -1.0])


def snapshots(joint: Array) -> tuple[Snapshot, Snapshot]:
    """Both sides up to date: the lower id keeps the cross-covariance, the higher the identity."""
    low = Snapshot(Belief("unicycle", LOW_MEAN, joint[:3, :3]), NEW, joint[:3, 3:], np.eye(3))
    return low, Snapshot(Belief("unicycle", HIGH_MEAN, joint[3:, 3:]), NEW, np.eye(3), np.eye(3))


BOTH = [
    Measurement("range", np.array([5.6]), np.array([[0.01]]), planar_mount(0.1, 0.2, 0.0)),
    Measurement("bearing", np.array([0.15]), np.array([[0.002]]), planar_mount(0.0, 0.1, 0.2)),
]


@given(SEED)
def test_the_cross_covariance_after_a_contact_does_not_depend_on_who_applied_it(seed: int) -> None:
    """E[e_i+ e_j^T] = E[e_i e_j+^T] = E[e_i+ e_j+^T]: a lost reply does no harm."""
    rng = np.random.default_rng(seed)
    joint, H, R = random_joint(rng), rng.normal(size=(2, 6)), random_covariance(rng, 2) * 0.1
    S = H @ joint @ H.T + R
    C = joint @ H.T
    found = Contact(C[:3], C[3:], S, np.zeros(2), joint[:3, 3:], 0.0)
    K = C @ np.linalg.inv(S)
    for i, j in itertools.product((0.0, 1.0), repeat=2):
        if i or j:
            applied = np.concatenate([np.full(3, i), np.full(3, j)])[:, None] * K
            keep = np.eye(6) - applied @ H
            after = keep @ joint @ keep.T + applied @ R @ applied.T
            assert np.abs(after[:3, 3:] - found.cross_after).max() < 1e-12


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("initiator_is_low", [True, False])
def test_a_contact_applied_by_both_is_the_joint_update(transform: Transform, initiator_is_low: bool) -> None:
    joint = random_joint(np.random.default_rng(61), 0.02)
    low, high = snapshots(joint)
    pair = (low, high) if initiator_is_low else (high, low)
    order = np.arange(6) if initiator_is_low else np.array([3, 4, 5, 0, 1, 2])
    arranged = joint[np.ix_(order, order)]
    found = contact(*pair, initiator_is_low, BOTH, True, options(transform))
    state = np.concatenate([pair[0].belief.mean, pair[1].belief.mean])
    model = StackedModel([RelativeModel(item.kind, UNICYCLE, item.mount) for item in BOTH], [1, 1])
    z, R = np.array([5.6, 0.15]), np.diag([0.01, 0.002])
    whole = absolute_update(state, arranged, TWO, model, z, R, options(transform))  # type: ignore[arg-type]
    assert whole is not None
    sides = []
    for snapshot, C in zip(pair, (found.C_i, found.C_j)):
        side = pair_update(snapshot.belief.mean, snapshot.belief.cov, UNICYCLE, np.eye(3), C, found)
        assert side is not None
        sides.append(side)
    assert np.allclose(np.concatenate([side.mean for side in sides]), whole.mean, atol=1e-9)
    assert np.allclose(sides[0].cov, whole.cov[:3, :3], atol=1e-9)
    assert np.allclose(sides[1].cov, whole.cov[3:, 3:], atol=1e-9)
    assert np.allclose(found.cross_after, whole.cov[:3, 3:], atol=1e-9)
    assert found.nis == pytest.approx(whole.nis)


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("initiator_is_low", [True, False])
def test_a_drone_and_a_rover_meet_as_in_their_joint_belief(transform: Transform, initiator_is_low: bool) -> None:
    rng = np.random.default_rng(62)
    root = rng.normal(size=(7, 7))
    joint = (root @ root.T + 0.2 * np.eye(7)) * 0.02
    drone_mean, rover_mean = np.array([0.0, 0.0, 9.0, 0.3]), np.array([5.0, 2.0, -1.0])
    drone = Snapshot(Belief("spatial", drone_mean, joint[:4, :4]), NEW, joint[:4, 4:], np.eye(4))
    rover = Snapshot(Belief("unicycle", rover_mean, joint[4:, 4:]), NEW, joint[4:, :4], np.eye(3))
    if not initiator_is_low:
        drone = dataclasses.replace(drone, factor=np.eye(4))
        rover = dataclasses.replace(rover, factor=joint[4:, :4])
    down = (0.1, 0.0, -0.05, 0.0, 1.4, 0.2)
    items = [
        Measurement("range", np.array([10.6]), np.array([[0.01]]), down),
        Measurement("pixel", np.array([-0.1, -0.6]), np.eye(2) * 1e-4, down),
        Measurement("bearing3", np.array([0.1, -0.4]), np.eye(2) * 1e-3, down),
    ]
    found = contact(drone, rover, initiator_is_low, items, True, options(transform))
    models = [RelativeModel(item.kind, SPATIAL, item.mount) for item in items]
    both = type(UNICYCLE)("drone and rover", 7, (3, 6), 3)
    z, R = np.concatenate([item.z for item in items]), np.diag([0.01, 1e-4, 1e-4, 1e-3, 1e-3])
    state = np.concatenate([drone_mean, rover_mean])
    whole = absolute_update(state, joint, both, StackedModel(models, [1, 2, 2]), z, R, options(transform))  # type: ignore[arg-type]
    assert whole is not None
    sides = []
    for told_of, layout, C in ((drone, SPATIAL, found.C_i), (rover, UNICYCLE, found.C_j)):
        side = pair_update(told_of.belief.mean, told_of.belief.cov, layout, np.eye(layout.dim), C, found)
        assert side is not None
        sides.append(side)
    assert np.allclose(np.concatenate([side.mean for side in sides]), whole.mean, atol=1e-9)
    assert np.allclose(sides[0].cov, whole.cov[:4, :4], atol=1e-9)
    assert np.allclose(sides[1].cov, whole.cov[4:, 4:], atol=1e-9)
    assert np.allclose(found.cross_after, whole.cov[:4, 4:], atol=1e-9)


TWO = type(UNICYCLE)("two robots", 6, (2, 5), 2)


def test_a_contact_applied_late_is_the_contact_applied_in_time_and_moved() -> None:
    rng = np.random.default_rng(62)
    joint = random_joint(rng)
    found = contact(*snapshots(joint), True, BOTH, True, options())
    F, Q = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), random_covariance(rng, 3) * 0.01
    in_time = pair_update(LOW_MEAN, joint[:3, :3], UNICYCLE, np.eye(3), found.C_i, found)
    late = pair_update(F @ LOW_MEAN, F @ joint[:3, :3] @ F.T + Q, UNICYCLE, F, found.C_i, found)
    assert in_time is not None
    assert late is not None
    assert np.allclose(late.mean, F @ in_time.mean, atol=1e-12)
    assert np.allclose(late.cov, F @ in_time.cov @ F.T + Q, atol=1e-12)


def test_a_contact_that_would_leave_no_covariance_is_refused() -> None:
    """A belief now that is better than what the old contact still had to give."""
    found = contact(*snapshots(random_joint(np.random.default_rng(71))), True, BOTH, True, options())
    assert pair_update(LOW_MEAN, np.eye(3) * 1e-6, UNICYCLE, np.eye(3), found.C_i, found) is None


def test_the_naive_contact_takes_the_pair_for_uncorrelated() -> None:
    joint = random_joint(np.random.default_rng(63))
    found = contact(*snapshots(joint), True, BOTH, False, options("jacobian"))
    assert found.cross is not None
    assert not found.cross.any()
    blind = joint.copy()
    blind[:3, 3:] = blind[3:, :3] = 0.0
    honest = contact(*snapshots(blind), True, BOTH, True, options("jacobian"))
    assert np.allclose(found.S, honest.S)
    assert np.allclose(found.C_i, honest.C_i)


def test_an_inadmissible_correlation_is_clipped_before_it_is_used() -> None:
    joint = random_joint(np.random.default_rng(64))
    low, high = snapshots(joint)
    low = Snapshot(low.belief, NEW, joint[:3, 3:] * 1.3, np.eye(3))
    assert not is_positive_definite(np.block([[joint[:3, :3], low.factor], [low.factor.T, joint[3:, 3:]]]))
    found = contact(low, high, True, BOTH, True, options())
    assert found.cross is not None
    repaired = joint.copy()
    repaired[:3, 3:], repaired[3:, :3] = found.cross, found.cross.T
    assert is_positive_definite(repaired)
    assert np.linalg.eigvalsh(found.S).min() > 0.0


def test_a_correlation_far_above_one_is_of_no_contact() -> None:
    joint = random_joint(np.random.default_rng(64))
    low, high = snapshots(joint)
    low = Snapshot(low.belief, NEW, joint[:3, 3:] * 20.0, np.eye(3))
    with pytest.raises(np.linalg.LinAlgError):
        contact(low, high, True, BOTH, True, options())


def test_a_contact_of_unknown_correlation_says_so() -> None:
    low, high = snapshots(random_joint(np.random.default_rng(65)))
    forgotten = Snapshot(low.belief, NEW, low.factor, low.line, known=False)
    for initiator_is_low in (True, False):
        pair = (forgotten, high) if initiator_is_low else (high, forgotten)
        assert contact(*pair, initiator_is_low, BOTH, True, options()).cross is None


@pytest.mark.parametrize("cap", [1.0, 6.0])
def test_the_cap_of_a_contact_is_met_exactly(cap: float) -> None:
    joint = random_joint(np.random.default_rng(66))
    outlier = [Measurement("range_bearing", np.array([30.0, 2.0]), np.diag([0.01, 0.01]))]
    plain = contact(*snapshots(joint), True, outlier, True, options())
    capped = contact(*snapshots(joint), True, outlier, True, options(cap=cap))
    assert plain.nis > cap
    assert capped.nis == pytest.approx(plain.nis)
    assert float(capped.innovation @ np.linalg.solve(capped.S, capped.innovation)) / 2.0 == pytest.approx(cap)
    assert np.allclose(capped.S, plain.S * plain.nis / cap)


def test_pairs_stay_honest_when_their_correlation_is_kept() -> None:
    """Two robots range each other ten times, each updating itself alone: NEES of either (seed 67)."""
    rng, trials = np.random.default_rng(67), 300
    cov, nees = np.diag([0.05, 0.05, 0.002]), {True: np.zeros(trials), False: np.zeros(trials)}
    model, R = RelativeModel("range_bearing", UNICYCLE), np.diag([0.01, 0.002])
    truth = np.concatenate([LOW_MEAN, HIGH_MEAN])
    for correlated, trial in itertools.product((True, False), range(trials)):
        means = [rng.multivariate_normal(LOW_MEAN, cov), rng.multivariate_normal(HIGH_MEAN, cov)]
        covs, cross = [cov, cov], np.zeros((3, 3))
        for _ in range(10):
            item = Measurement("range_bearing", model.h(truth) + rng.normal(size=2) * np.sqrt(np.diagonal(R)), R)
            low = Snapshot(Belief("unicycle", means[0], covs[0]), NEW, cross, np.eye(3))
            high = Snapshot(Belief("unicycle", means[1], covs[1]), NEW, np.eye(3), np.eye(3))
            found = contact(low, high, True, [item], correlated, options())
            for side, C in enumerate((found.C_i, found.C_j)):
                update = pair_update(means[side], covs[side], UNICYCLE, np.eye(3), C, found)
                assert update is not None
                means[side], covs[side] = update.mean, update.cov
            cross = found.cross_after
        error = means[0] - LOW_MEAN
        nees[correlated][trial] = error @ np.linalg.solve(covs[0], error) / 3.0
    assert_consistent(nees[True], 3, slack=1.1)
    with pytest.raises(AssertionError, match="overconfident"):
        assert_consistent(nees[False], 3, slack=1.1)


# Which correlation two snapshots stand for

SIGMA_LOW, SIGMA_HIGH = np.diag([1.0, 2.0, 3.0]), np.array([[0.5, 0.1, 0.0], [0.0, 1.0, 0.2], [0.3, 0.0, 1.5]])
LINE_LOW, LINE_HIGH = np.array([[1.0, 0.4, 0.0], [0.0, 0.9, 0.0], [0.2, 0.0, 0.8]]), np.diag([0.7, 1.1, 0.9])


UNMOVED = np.eye(3)


def told(
    base: Epoch, factor: Array, line: Array = UNMOVED, lines: tuple[Line, ...] = (), known: bool = True
) -> Snapshot:
    return Snapshot(Belief("unicycle", np.zeros(3), np.eye(3)), base, factor, line, lines, known=known)


def resolved(low: Snapshot, high: Snapshot) -> Array:
    found = resolve_cross(low, high)
    assert found is not None
    return found


def test_pairs_that_never_met_are_uncorrelated_whatever_their_sizes() -> None:
    low = told(NEVER, np.zeros((3, 0)))
    high = Snapshot(Belief("constant_velocity", np.zeros(4), np.eye(4)), NEVER, np.zeros((4, 0)), np.eye(4))
    assert np.array_equal(resolved(low, high), np.zeros((3, 4)))


def test_equal_bases_take_the_lower_factor_and_the_higher_line() -> None:
    assert np.allclose(resolved(told(NEW, SIGMA_LOW), told(NEW, SIGMA_HIGH, LINE_HIGH)), SIGMA_LOW @ LINE_HIGH.T)


@pytest.mark.parametrize("base", [NEVER, OLD])
def test_a_side_that_is_behind_gives_its_line_for_the_contact(base: Epoch) -> None:
    """The lines of other contacts are not taken for it."""
    other = Line(MIDDLE, np.eye(3) * 9.0)
    high = told(base, SIGMA_HIGH, np.eye(3) * 5.0, (other, Line(NEW, LINE_HIGH)))
    assert np.allclose(resolved(told(NEW, SIGMA_LOW), high), SIGMA_LOW @ LINE_HIGH.T)
    low = told(base, SIGMA_LOW, np.eye(3) * 5.0, (other, Line(NEW, LINE_LOW)))
    assert np.allclose(resolved(low, told(NEW, SIGMA_HIGH)), LINE_LOW @ SIGMA_HIGH.T)


def test_a_correlation_that_cannot_be_recovered_is_none() -> None:
    up_to_date, stray = told(NEW, SIGMA_LOW), (Line(MIDDLE, LINE_HIGH),)
    assert resolve_cross(up_to_date, told(OLD, SIGMA_HIGH, lines=stray)) is None
    assert resolve_cross(told(OLD, SIGMA_LOW, lines=stray), told(NEW, SIGMA_HIGH)) is None
    assert resolve_cross(up_to_date, told(NEVER, np.zeros((3, 0)))) is None
    assert resolve_cross(told(NEVER, np.zeros((3, 0))), told(NEW, SIGMA_HIGH)) is None
    assert resolve_cross(told(NEW, SIGMA_LOW, known=False), told(NEW, SIGMA_HIGH)) is None
    assert resolve_cross(up_to_date, told(NEW, SIGMA_HIGH, known=False)) is None


@pytest.mark.parametrize("applied", ["both", "low", "high"])
def test_the_correlation_is_that_of_the_errors_whoever_applied_the_last_contact(applied: str) -> None:
    """A contact, then both move: P_ab from the snapshots is the joint filter's with the other's gain set to zero."""
    rng = np.random.default_rng(68)
    joint = random_joint(rng)
    found = contact(*snapshots(joint), True, BOTH, True, options("jacobian"))
    F_low, F_high = np.eye(3) + 0.2 * rng.normal(size=(3, 3)), np.eye(3) + 0.2 * rng.normal(size=(3, 3))
    epoch = Epoch(4, "r1", 2)
    low = (
        told(NEW, joint[:3, 3:], np.eye(3), (Line(epoch, F_low),))
        if applied == "high"
        else told(epoch, F_low @ found.cross_after, F_low)
    )
    high = (
        told(NEW, np.eye(3), np.eye(3), (Line(epoch, F_high),))
        if applied == "low"
        else told(epoch, F_high @ found.cross_after.T, F_high)
    )
    assert np.allclose(resolved(low, high), F_low @ found.cross_after @ F_high.T, atol=1e-12)


# Several measurements at once


def test_stacked_models_are_the_models_one_above_the_other() -> None:
    rng = np.random.default_rng(69)
    kinds = ("bearing", "range_bearing", "range", "bearing")
    models = [RelativeModel(kind, UNICYCLE, (0.1 * k, -0.1, 0.0, 0.0, 0.0, 0.2 * k)) for k, kind in enumerate(kinds)]
    stacked = StackedModel(models, [1, 2, 1, 1])
    assert stacked.angles == (0, 2, 4)
    states = rng.normal(size=(5, 6)) * 3.0
    assert np.array_equal(stacked.h(states), np.concatenate([model.h(states) for model in models], axis=-1))
    assert stacked.h(states).shape == (5, 5)
    assert np.array_equal(stacked.jacobian(states), np.concatenate([m.jacobian(states) for m in models], axis=-2))
    assert stacked.jacobian(states[0]).shape == (5, 6)


def test_measurements_of_one_instant_are_as_good_together_as_in_turn() -> None:
    """To first order: with the same Jacobians the joint posterior is that of one after the other."""
    joint = random_joint(np.random.default_rng(70), 1e-7)
    exact = np.concatenate([LOW_MEAN, HIGH_MEAN])
    items = [Measurement(i.kind, RelativeModel(i.kind, UNICYCLE, i.mount).h(exact), i.R * 1e-5, i.mount) for i in BOTH]
    together = contact(*snapshots(joint), True, items, True, options("jacobian"))
    both = pair_update(LOW_MEAN, joint[:3, :3], UNICYCLE, np.eye(3), together.C_i, together)
    for item in items:
        found = contact(*snapshots(joint), True, [item], True, options("jacobian"))
        after = joint.copy()
        for side, C in enumerate((found.C_i, found.C_j)):
            part = slice(3 * side, 3 * side + 3)
            after[part, part] -= C @ np.linalg.solve(found.S, C.T)
        after[:3, 3:], after[3:, :3] = found.cross_after, found.cross_after.T
        joint = after
    assert both is not None
    assert np.allclose(both.cov, joint[:3, :3], rtol=1e-9, atol=1e-16)
    assert np.allclose(both.mean, LOW_MEAN, atol=1e-12)
