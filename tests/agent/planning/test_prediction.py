"""What commands will have done to beliefs: closed forms and batches against single steps, plans against fact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.estimation.gaussian import wrap_scalar
from agent.estimation.jlatt import predicted_robot_cov, predicted_target_cov
from agent.estimation.motion import CONSTANT_VELOCITY, SPATIAL, HeldAltitude, TargetMotion
from agent.planning.optimal import Objective
from agent.planning.prediction import Prediction, grown_trace, moved, sightings
from agent.planning.situation import Member, Situation, TargetView
from agent.planning.team_view import believers
from agent.settings import PlanningSettings, RoundWeights, SensingSettings
from tests.agent.planning.field import TARGET, Field, member, view

SETTINGS = PlanningSettings()
COMMANDS = np.array([[0.5, 0.3], [0.0, -0.6], [0.25, 0.0], [0.4, -0.5]])
WEIGHTS: tuple[RoundWeights, ...] = ("split_ci", "trace", "logdet", "info", "pinv_guard")


def random_cov(rng: np.random.Generator, n: int = 3, scale: float = 0.1) -> np.ndarray:
    root = rng.normal(size=(n, n))
    return scale * (root @ root.T + 0.1 * np.eye(n))


def stepped(pose: np.ndarray, cov: np.ndarray, command: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """One step as eq. 2.6 with 4.1 to 4.3 has it."""
    (x, y, th), (v, w) = pose, command
    F = np.array([[1, 0, -v * dt * np.sin(th)], [0, 1, v * dt * np.cos(th)], [0, 0, 1]])
    G = dt * np.array([[np.cos(th), 0], [np.sin(th), 0], [0, 1]])
    s = 0.01 * v
    Q = np.diag([(np.sqrt(0.5) * s) ** 2, (2.0 * np.sqrt(2.0) * s) ** 2])
    new = np.array([x + v * dt * np.cos(th), y + v * dt * np.sin(th), th + w * dt])
    return new, F @ cov @ F.T + G @ Q @ G.T


@pytest.mark.parametrize("dt", [1.0, 0.4])
def test_growth_in_closed_form_is_growth_step_by_step(dt: float) -> None:
    rng = np.random.default_rng(0)
    poses, covs = rng.uniform(-3, 3, (4, 3)), np.array([random_cov(rng) for _ in range(4)])
    new = moved(poses, covs, COMMANDS, dt, 12, SETTINGS)
    grown = grown_trace(new.covs, new.track, new.way, new.heading)
    for index, command in enumerate(COMMANDS):
        pose, cov = stepped(poses[index], covs[index], command, dt)
        assert np.allclose(new.poses[index], pose, rtol=0, atol=1e-12)
        assert np.allclose(new.covs[index], cov, rtol=0, atol=1e-12)
        for step in range(11):
            pose, cov = stepped(pose, cov, command, dt)
            assert np.allclose(new.track[index, step + 1], pose[:2], rtol=0, atol=1e-12)
        assert grown[index] == pytest.approx(np.trace(cov), abs=1e-12)


def test_a_robot_that_stands_gets_no_less_sure() -> None:
    new = moved(np.zeros((1, 3)), np.eye(3)[None], np.array([[0.0, 0.6]]), 1.0, 12, SETTINGS)
    assert np.array_equal(new.covs[0], np.eye(3))
    assert grown_trace(new.covs, new.track, new.way, new.heading) == pytest.approx(3.0, abs=1e-12)


def test_a_sighting_as_a_place_is_range_and_bearing() -> None:
    """Information of the pose, eq. 2.8a, and covariance of the place, eq. 2.12a, by the Jacobians of z = (r, beta)."""
    rng = np.random.default_rng(1)
    poses, places = rng.uniform(-3, 3, (6, 3)), rng.uniform(-12, 12, (6, 4, 2))
    sensing = SensingSettings(sigma_m=0.1)
    sight = sightings(poses, places, sensing)
    for c in range(6):
        for m in range(4):
            d = places[c, m] - poses[c, :2]
            r, beta = np.hypot(*d), wrap_scalar(np.arctan2(d[1], d[0]) - poses[c, 2])
            u = d / r
            H = np.array([[-u[0], -u[1], 0.0], [u[1] / r, -u[0] / r, -1.0]])
            Ht = np.array([[u[0], u[1]], [-u[1] / r, u[0] / r]])
            R = np.diag([(0.1 + 0.03 * r) ** 2, np.deg2rad(1.0) ** 2])
            other, cov = random_cov(rng, 2), random_cov(rng)
            J = sight.jacobian[c, m]
            assert np.allclose(
                J.T @ np.linalg.inv(sight.sensor[c, m] + other) @ J, H.T @ np.linalg.inv(R + Ht @ other @ Ht.T) @ H
            )
            back = np.linalg.inv(Ht)
            pose_part = sight.pose_part(np.tile(cov, (6, 1, 1)))[c, m]
            assert np.allclose(sight.sensor[c, m] + pose_part, back @ (R + H @ cov @ H.T) @ back.T)
            assert sight.seen[c, m] == (2.0 <= r <= 15.0 and abs(beta) <= np.pi / 6)
    assert 2 < sight.seen.sum() < 12


def team(rng: np.random.Generator, count: int, names: tuple[str, ...] = ("t1",)) -> Situation:
    members = [
        Member(
            f"r{i}",
            np.r_[rng.uniform(-6, 6, 2), rng.uniform(-3, 3)],
            random_cov(rng, scale=0.05),
            float(rng.uniform(0, 0.5)),
            float(rng.uniform(-0.6, 0.6)),
            tuple(view(rng.uniform(-6, 6, 3), random_cov(rng, scale=0.2), name) for name in names),
        )
        for i in range(count)
    ]
    return Situation(0, 1.0, members[0], tuple(members[1:]))


def predicted(settings: PlanningSettings, situation: Situation, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    found = Prediction(settings, situation, believers(situation, present=True)).of(commands)
    return found.own, found.targets


def in_view(pose: np.ndarray, place: np.ndarray) -> bool:
    d = place - pose[:2]
    bearing = wrap_scalar(np.arctan2(d[1], d[0]) - pose[2])
    return bool(2.0 <= np.hypot(*d) <= 15.0 and abs(bearing) <= np.pi / 6)


def one_by_one(
    settings: PlanningSettings, situation: Situation, target: str, command: np.ndarray
) -> tuple[float, float]:
    """Table 3.2 for one candidate and one target, step by step with a neighbour after the other."""
    own, others = situation.own, situation.others

    def sighted(pose: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        d = place - pose[:2]
        r, a = np.hypot(*d), np.arctan2(d[1], d[0])
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        sensor = turn @ np.diag([(0.03 * r) ** 2, (np.deg2rad(1.0) * r) ** 2]) @ turn.T
        return np.array([[1.0, 0.0, -d[1]], [0.0, 1.0, d[0]]]), sensor

    pose, cov = stepped(own.pose, own.cov, command, 1.0)
    near = [stepped(o.pose, o.cov, np.array([o.speed_mps, o.yaw_rate_radps]), 1.0) for o in others]
    views = [next(item for item in o.targets if item.target == target) for o in (own, *others)]
    beliefs = [TARGET.drift(item.mean, item.cov, 1.0, "jacobian") for item in views]
    seen, J, sensor, around = [], [], [], []
    for place, its_cov in [*((p[:2], c[:2, :2]) for p, c in near), (beliefs[0].mean[:2], beliefs[0].cov[:2, :2])]:
        one_J, one_sensor = sighted(pose, place)
        seen.append(in_view(pose, place)), J.append(one_J), sensor.append(one_sensor), around.append(its_cov)
    after = predicted_robot_cov(
        cov[None], np.array(J)[None], np.array(sensor)[None], np.array(around), np.array(seen)[None], settings.weights
    )[0]
    seen, parts = [], []
    for (p, c), belief in zip([(pose, cov), *near], beliefs, strict=True):
        one_J, one_sensor = sighted(p, belief.mean[:2])
        seen.append(in_view(p, belief.mean[:2])), parts.append((one_sensor, one_J @ c @ one_J.T))
    target_after = predicted_target_cov(
        np.array([belief.cov for belief in beliefs]),
        np.array([part[0] for part in parts])[None],
        np.array([part[1] for part in parts])[None],
        np.array(seen)[None],
        settings.weights,
    )[0]
    for _ in range(settings.horizon):
        pose, after = stepped(pose, after, command, 1.0)
    mean = beliefs[0].mean
    for _ in range(settings.horizon):
        step = TARGET.drift(mean, target_after, 1.0, "jacobian")
        mean, target_after = step.mean, step.cov
    return float(np.trace(after)), float(np.trace(target_after))


def test_places_may_count_further_ahead_than_uncertainty() -> None:
    settings, situation = replace(SETTINGS, ahead=9, horizon=3), team(np.random.default_rng(0), 3)
    found = Prediction(settings, situation, believers(situation, present=True)).of(COMMANDS)
    assert found.track.shape == (4, 10, 2)
    for index, command in enumerate(COMMANDS):
        alone = one_by_one(settings, situation, "t1", command)
        assert (found.own[index], found.targets[index]) == pytest.approx(alone, rel=1e-9)
    assert np.all(np.isfinite(Objective(settings, situation)(COMMANDS)))


@pytest.mark.parametrize("weights", WEIGHTS)
def test_all_candidates_at_once_are_one_after_the_other(weights: RoundWeights) -> None:
    settings = replace(SETTINGS, weights=weights)
    for seed in range(6):
        situation = team(np.random.default_rng(seed), 5)
        own, targets = predicted(settings, situation, COMMANDS)
        for index, command in enumerate(COMMANDS):
            alone = one_by_one(settings, situation, "t1", command)
            assert (own[index], targets[index]) == pytest.approx(alone, rel=1e-9), seed


def test_several_targets_add_up() -> None:
    situation = team(np.random.default_rng(3), 4, ("t1", "t2"))
    _, both = predicted(SETTINGS, situation, COMMANDS)
    alone = [
        [one_by_one(SETTINGS, _only(situation, name), name, command)[1] for command in COMMANDS]
        for name in ("t1", "t2")
    ]
    assert np.allclose(both, np.sum(alone, axis=0), rtol=1e-9)


def _only(situation: Situation, name: str) -> Situation:
    def kept(one: Member) -> Member:
        return replace(one, targets=tuple(item for item in one.targets if item.target == name))

    return replace(situation, own=kept(situation.own), others=tuple(kept(other) for other in situation.others))


def test_what_is_predicted_comes_true() -> None:
    """Without noise, and once all hold their commands, the trace predicted for the next step is the one that comes."""
    settings = replace(SETTINGS, kind="random", max_turn_radps=1e-9, horizon=0, ahead=0)
    poses = np.array([[0.0, 0.0, 0.1], [-4.0, 3.0, -0.1], [4.0, -3.0, 2.8]])
    field = Field(settings, poses, np.array([9.0, 2.0, 0.0])).run(4)
    for _ in range(3):
        field.step()
        told = field.members[-1]
        for i in range(3):
            situation = Situation(0, 1.0, told[i], told[:i] + told[i + 1 :])
            own, target = predicted(settings, situation, field.commands[i : i + 1])
            assert own[0] == pytest.approx(np.trace(field.covs[i]), rel=1e-9)
            if i == 0:
                assert target[0] == pytest.approx(np.trace(field.target_covs[i]), rel=1e-9)
    assert np.any(field.seeing)


@pytest.mark.parametrize(
    ("motion", "mean"),
    [
        (TargetMotion(CONSTANT_VELOCITY), [5.0, 1.0, 0.2, 0.1]),
        (TargetMotion(SPATIAL, (0.3, 0.1), held=HeldAltitude(10.0, 0.1)), [5.0, 1.0, 10.0, 0.3]),
    ],
    ids=["constant velocity", "spatial"],
)
def test_targets_of_any_model_are_predicted(motion: TargetMotion, mean: list[float]) -> None:
    belief = TargetView("t1", motion, np.array(mean), 0.3 * np.eye(4))
    situation = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], belief), (member("r2", [1.0, 4.0, 2.0], belief),))
    commands = np.array([[0.0, 0.0], [0.0, -0.6]])
    found = Prediction(SETTINGS, situation, believers(situation, present=True)).of(commands)
    state, cov = motion.drift(belief.mean, belief.cov, 1.0, "jacobian").mean, np.zeros((4, 4))
    sight = sightings(np.array([[0.0, 0.0, 0.0]]), state[None, None, :2], SETTINGS.sensing)
    after = predicted_target_cov(
        np.tile(motion.drift(belief.mean, belief.cov, 1.0, "jacobian").cov, (2, 1, 1)),
        sight.sensor,
        sight.pose_part(situation.own.cov[None]),
        np.array([[True]]),
        SETTINGS.weights,
    )[0]
    cov = after
    for _ in range(11):
        step = motion.drift(state, cov, 1.0, "jacobian")
        state, cov = step.mean, step.cov
    assert found.targets[0] == pytest.approx(np.trace(cov), rel=1e-9)
    assert found.targets[1] > found.targets[0]


def test_only_its_own_sighting_of_a_target_depends_on_the_robot() -> None:
    """Who does not see the target whatever it does has the same trace for all commands."""
    behind = Situation(0, 1.0, member("r1", [0.0, 0.0, 0.0], view([-8.0, 0.0, 0.0])))
    ahead = replace(behind, own=member("r1", [0.0, 0.0, 3.0], view([-8.0, 0.0, 0.0])))
    for horizon in (0, 11):
        settings = replace(SETTINGS, horizon=horizon)
        _, targets = predicted(settings, behind, COMMANDS)
        assert np.ptp(targets) == 0.0
        _, seen = predicted(settings, ahead, COMMANDS)
        in_sight = [in_view(np.array([0.0, 0.0, 3.0 + turn]), np.array([-8.0, 0.0])) for _, turn in COMMANDS]
        assert np.array_equal(seen != targets[0], in_sight)
        assert any(in_sight) and not all(in_sight)
