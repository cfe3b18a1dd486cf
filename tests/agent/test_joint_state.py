"""A robot and its targets as one belief: a Kalman filter of the joint state while nobody else is met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from agent.estimation.motion import CONSTANT_VELOCITY, TargetMotion
from agent.estimation.observation import RelativeModel, absolute_model
from agent.estimation.split_joint import Split
from agent.joint_state import CONTRADICTIONS, JointModel
from agent.joint_tracks import JointState
from agent.settings import NS, AgentSettings, LocalizationSettings, TargetSettings
from network.messages import MAX_MEASUREMENTS, MAX_MESSAGE_BYTES, Epoch, Measurement, SplitRequest, SplitSnapshot
from network.wire import size_bound

Array = NDArray[np.float64]

TINY = 1e-12
HEADING = 0.4
MOTION = TargetMotion(CONSTANT_VELOCITY, noise_sigma=(0.2, 0.2))
STEP = np.array([0.3, 0.1, 0.0, 0.0])
NOISE = np.diag([0.02, 0.02, 0.0, 0.0])


def model(transform: str, names: tuple[str, ...] = ("t1",)) -> JointModel:
    targets = tuple(TargetSettings(name, MOTION, np.array([4.0, 3.0, 0.2, -0.1]), np.eye(4)) for name in names)
    localization = LocalizationSettings(transform=transform, innovation_cap=0.0)  # type: ignore[arg-type]
    start = np.array([1.0, 2.0, HEADING])
    return JointModel(
        AgentSettings("r1", 0, start, np.diag([0.3, 0.2, TINY]), targets=targets, localization=localization)
    )


@pytest.mark.parametrize("transform", ["unscented", "jacobian"])
def test_alone_it_is_the_kalman_filter_of_robot_and_target(transform: str) -> None:
    subject = model(transform)
    state = subject.tracks.initial()
    library = KalmanFilter(dim_x=6, dim_z=2)
    library.x = state.mean[[0, 1, 3, 4, 5, 6], None].copy()
    library.P = np.diag([0.3, 0.2, 1.0, 1.0, 1.0, 1.0])
    F = np.eye(6)
    F[2, 4] = F[3, 5] = 1.0
    turn = np.array([[np.cos(HEADING), -np.sin(HEADING)], [np.sin(HEADING), np.cos(HEADING)]])
    Q = np.zeros((6, 6))
    Q[:2, :2] = turn @ NOISE[:2, :2] @ turn.T
    Q[2:, 2:] = MOTION.drift(np.zeros(4), np.zeros((4, 4)), 1.0, "jacobian").cov
    seen = np.hstack([-turn.T, turn.T, np.zeros((2, 2))])
    fixed = np.hstack([np.eye(2), np.zeros((2, 4))])
    rng = np.random.default_rng(3)
    for k in range(1, 15):
        state = subject.moved(state, k * NS, STEP, NOISE)
        library.F, library.Q = F, Q
        library.predict()
        library.x[:2, 0] += turn @ STEP[:2]
        R = np.diag([0.05, 0.08])
        if k % 3 == 0:
            z = state.mean[:2] + rng.normal(size=2)
            found = absolute_model("position", AgentSettings("r", 0, np.zeros(3), np.eye(3)).layout, z, R)
            assert found is not None
            state = subject.absolute(state, *found).state
            library.update(z[:, None], R, fixed)
        else:
            z = turn.T @ (state.mean[3:5] - state.mean[:2]) + 0.2 * rng.normal(size=2)
            sensor = RelativeModel("vector", model(transform)._settings.layout, subject=CONSTANT_VELOCITY)
            state = subject.sighting(state, "t1", sensor, z, R).state
            library.update(z[:, None], R, seen)
        keep = [0, 1, 3, 4, 5, 6]
        assert np.abs(state.mean[keep] - library.x[:, 0]).max() < 1e-6
        assert np.abs(state.cov[np.ix_(keep, keep)] - library.P).max() < 1e-6


def test_own_noise_is_private_and_what_all_know_of_a_target_is_shared() -> None:
    subject = model("unscented")
    state = subject.moved(subject.tracks.initial(), NS, STEP, NOISE)
    assert not state.split.private[3:].any()
    assert not state.split.shared[:3].any()
    assert np.linalg.eigvalsh(state.split.private)[-1] > 0.2
    assert np.linalg.eigvalsh(state.split.shared)[-1] > 1.0


def test_tracks_are_told_and_found_by_name() -> None:
    """Robots that track different targets, or in another order, share what both have."""
    mine, theirs = model("unscented", ("t1", "t2", "t3")), model("unscented", ("t3", "t1"))
    told = theirs.snapshot(theirs.tracks.initial(), ("t3", "t1"))
    state = mine.tracks.initial()
    assert mine._layout(state).common(told) == [(slice(11, 15), slice(3, 7)), (slice(3, 7), slice(7, 11))]
    only = mine.snapshot(state, ("t2",))
    assert only.targets == (("t2", "constant_velocity"),)
    assert np.array_equal(only.mean, np.concatenate([state.mean[:3], state.mean[7:11]]))
    assert np.array_equal(only.cov, state.cov[np.ix_([*range(3), *range(7, 11)], [*range(3), *range(7, 11)])])


@pytest.mark.parametrize("count", [1, 3, 12])
@pytest.mark.parametrize("measured", [0, MAX_MEASUREMENTS])
def test_the_first_tracks_are_told_as_many_as_fit_into_a_message(count: int, measured: int) -> None:
    subject = model("unscented", tuple(f"t{k}" for k in range(count)))
    state = subject.tracks.initial()
    items = (Measurement("range", np.ones(1), np.eye(1)),) * measured
    snapshot, left_out = subject.fitting(state, items)

    def size(told: SplitSnapshot) -> int:
        return size_bound(SplitRequest(Epoch(2**62, "r" * 24, 2**53), items, told))

    kept = count - left_out
    assert [name for name, _ in snapshot.targets] == list(state.tracks)[:kept]
    assert size(snapshot) <= MAX_MESSAGE_BYTES
    assert left_out == 0 or size(subject.snapshot(state, state.tracks[: kept + 1])) > MAX_MESSAGE_BYTES
    assert left_out > 0 or count == 1


def test_an_innovation_beyond_the_cap_counts_less() -> None:
    settings = model("unscented")._settings
    capped = JointModel(
        AgentSettings(
            "r1", 0, settings.mean, settings.cov, localization=LocalizationSettings(innovation_cap=9.0), track=False
        )
    )
    found = absolute_model("position", settings.layout, settings.mean[:2] + 30.0, 0.01 * np.eye(2))
    assert found is not None
    free = model("unscented").absolute(model("unscented").tracks.initial(), *found)
    used = capped.absolute(capped.tracks.initial(), *found)
    assert used.nis > 9.0
    assert np.trace(used.state.cov[:2, :2]) > 2.0 * np.trace(free.state.cov[:2, :2])


def on_a_wrong_side(kind: str) -> tuple[JointModel, list[JointState]]:
    """Sightings of a target that is at (-4, 2) while the track is sure that it is at (4, 3); states after each."""
    subject = model("unscented")
    state = subject.tracks.initial()
    cov = state.cov.copy()
    cov[3:, 3:] *= 0.01
    state = replace(state, mean=state.mean.copy(), split=Split(np.zeros_like(cov), cov))
    sensor = RelativeModel(kind, subject._settings.layout, subject=CONSTANT_VELOCITY)
    states = [state]
    for k in range(1, 12):
        state = subject.moved(state, k * NS, STEP, NOISE)
        truth = np.concatenate([state.mean[:3], [-4.0, 2.0, 0.0, 0.0]])
        z = sensor.h(truth)
        state = subject.sighting(state, "t1", sensor, z, 0.01 * np.eye(len(z))).state
        states.append(state)
    return subject, states


@pytest.mark.parametrize("kind", ["vector", "range_bearing"])
def test_a_track_that_is_contradicted_on_end_begins_again_where_the_target_is(kind: str) -> None:
    _, states = on_a_wrong_side(kind)
    (block,) = model("unscented").tracks.blocks(states[-1])
    error = states[-1].mean[block][:2] - np.array([-4.0, 2.0])
    cov = states[-1].cov[block, block][:2, :2]
    assert float(error @ np.linalg.solve(cov, error)) / 2.0 < 3.0
    assert np.hypot(*error) < 0.5
    assert states[CONTRADICTIONS].doubted == {"t1": CONTRADICTIONS}
    assert states[-1].doubted == {}


def test_where_a_sighting_tells_no_place_a_contradicted_track_stays_beside_the_joint_belief() -> None:
    subject = model("unscented")
    state = replace(subject.tracks.initial(), doubted={"t1": CONTRADICTIONS})
    sensor = RelativeModel("range", subject._settings.layout, subject=CONSTANT_VELOCITY)
    place = np.array([-4.0, 2.0])
    z = sensor.h(np.concatenate([state.mean[:3], place, [0.0, 0.0]]))
    after = subject.sighting(state, "t1", sensor, z, 0.01 * np.eye(1)).state
    assert after.tracks == () and np.array_equal(after.mean, state.mean[:3])
    track = after.relayed["t1"]
    error = track.mean[:2] - place
    assert float(error @ np.linalg.solve(track.cov[:2, :2], error)) / 2.0 < 1.5


def test_one_outlier_is_the_sensors_fault() -> None:
    subject = model("unscented")
    state = subject.moved(subject.tracks.initial(), NS, STEP, NOISE)
    sensor = RelativeModel("vector", subject._settings.layout, subject=CONSTANT_VELOCITY)
    clean = sensor.h(state.mean)
    for off in (50.0, 0.0, 50.0, 0.0, 50.0, 0.0):
        state = subject.sighting(state, "t1", sensor, clean + off, 0.01 * np.eye(2)).state
    assert state.tracks == ("t1",)


def test_a_contradicted_track_ends_where_a_bearing_cannot_say_how_far_off_the_target_is() -> None:
    subject = model("unscented")
    state = replace(subject.tracks.initial(), doubted={"t1": CONTRADICTIONS})
    sensor = RelativeModel("bearing", subject._settings.layout, subject=CONSTANT_VELOCITY)
    after = subject.sighting(state, "t1", sensor, np.array([2.0]), 0.01 * np.eye(1)).state
    assert after.tracks == () and after.relayed == {} and after.doubted == {}


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.95])
def test_a_heading_that_is_nowhere_claims_no_more_than_its_wrapped_error(correlation: float) -> None:
    """Whatever the unwrapped error was correlated with: what is claimed covers place and wrapped heading together."""
    n = 3
    cov = np.diag([4.0, 1.0, 36.0])
    cov[0, 2] = cov[2, 0] = correlation * 12.0
    settings = AgentSettings("r1", 0, np.zeros(n), cov)
    state = JointModel(settings).moved(
        JointState(0, np.zeros(n), Split(0.3 * cov, 0.7 * cov), (), ()), NS, np.zeros(4), np.zeros((4, 4))
    )
    random = np.random.default_rng(11)
    error = random.multivariate_normal(np.zeros(n), cov, 200_000)
    error[:, 2] = np.remainder(error[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    spread = np.cov(error.T)
    assert np.linalg.eigvalsh(state.cov - 0.98 * spread).min() > -0.02
    assert float(np.trace(np.linalg.solve(state.cov, spread))) / n < 1.02
