"""Evidence of a start at different instants, and what is missing without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap
from agent.estimation.motion import SPATIAL, UNICYCLE_GAINS, HeldAltitude, RobotMotion, SpatialMotion, compose
from agent.estimation.observation import absolute_model
from agent.settings import NS, AgentSettings, LatenessSettings
from agent.start import A_CONTACT, A_HEADING, A_PLACE, A_VIEW, AN_ALTITUDE, StartEvidence, Told
from network.messages import Measurement

Array = NDArray[np.float64]

STEP = np.array([0.4, 0.1, 0.0, 0.3])
NOISE = np.diag([1e-6, 1e-6, 1e-6, 1e-6])
FIRST = np.array([3.0, -2.0, 2.9])
PLANAR = [0, 1, 3]


def settings(source: str, **changes: object) -> AgentSettings:
    found = AgentSettings(
        "r3", 0, np.zeros(3), np.zeros((3, 3)), source=source, lateness=LatenessSettings(horizon_ns=10 * NS)  # type: ignore[arg-type]
    )
    return replace(found, **changes)  # type: ignore[arg-type]


def poses(count: int) -> list[Array]:
    """True poses at 0, 1, ... seconds."""
    found = [FIRST]
    for _ in range(count):
        found.append(compose(found[-1], STEP[PLANAR]))
    return found


def fixed(evidence: StartEvidence, subject: AgentSettings, kind: str, t_s: int, z: Array, variance: float) -> None:
    model = absolute_model(kind, subject.layout, z, variance * np.eye(len(z)))
    assert model is not None
    evidence.fix(t_s * NS, *model)


def walked(subject: AgentSettings, place_s: int, heading_s: int, until_s: int, variance: float = 1e-6) -> StartEvidence:
    evidence, truth = StartEvidence(subject), poses(until_s)
    for k in range(until_s + 1):
        if k:
            evidence.moved((k - 1) * NS, k * NS, STEP, NOISE)
        if k == place_s:
            fixed(evidence, subject, "position", k, truth[k][:2], variance)
        if k == heading_s:
            fixed(evidence, subject, "heading", k, truth[k][2:], variance)
    return evidence


@pytest.mark.parametrize(("place_s", "heading_s"), [(1, 1), (1, 4), (4, 1), (2, 5)])
def test_place_and_heading_of_different_instants_are_joined_by_the_odometry(place_s: int, heading_s: int) -> None:
    subject = settings("fix")
    evidence = walked(subject, place_s, heading_s, 6)
    begun = evidence.begun(6 * NS)
    assert begun is not None and begun.source == "survey" and begun.start_ns == 6 * NS
    assert begun.shared is None
    truth = poses(6)[6]
    assert np.abs(begun.mean[:2] - truth[:2]).max() < 1e-3
    assert abs(wrap(begun.mean[2] - truth[2])) < 1e-6
    assert evidence.missing() == ()


def test_the_start_is_as_unsure_as_its_fixes_and_what_lies_between() -> None:
    """A thousand robots that start from fixes with noise and walk with noise."""
    rng, noise, total = np.random.default_rng(5), np.diag([0.01, 0.005, 1e-9, 0.002]), 0.0
    subject = settings("fix")
    for _ in range(1000):
        evidence, pose = StartEvidence(subject), FIRST
        for k in range(5):
            if k:
                evidence.moved((k - 1) * NS, k * NS, STEP, noise)
                pose = compose(pose, (STEP + np.sqrt(noise.diagonal()) * rng.normal(size=4))[PLANAR])
            if k == 1:
                fixed(evidence, subject, "heading", k, pose[2:] + 0.1 * rng.normal(size=1), 0.01)
            if k == 3:
                fixed(evidence, subject, "position", k, pose[:2] + 0.3 * rng.normal(size=2), 0.09)
        begun = evidence.begun(4 * NS)
        assert begun is not None
        error = begun.mean - pose
        error[2] = wrap(error[2])
        total += float(error @ np.linalg.solve(begun.cov, error)) / 3.0
    assert 0.9 < total / 1000 < 1.1


def test_each_missing_piece_is_named_until_it_is_there() -> None:
    subject = settings("fix")
    evidence = StartEvidence(subject)
    assert evidence.missing() == (A_PLACE, A_HEADING)
    assert evidence.begun(0) is None
    fixed(evidence, subject, "position", 0, np.zeros(2), 0.1)
    assert evidence.missing() == (A_HEADING,)
    assert evidence.begun(0) is None
    fixed(evidence, subject, "heading", 0, np.zeros(1), 0.01)
    assert evidence.missing() == ()
    assert evidence.begun(0) is not None


def test_a_pose_tells_all_at_once() -> None:
    subject = settings("fix")
    evidence = StartEvidence(subject)
    fixed(evidence, subject, "pose", 2, np.array([4.0, 5.0, 0.7]), 0.01)
    begun = evidence.begun(2 * NS)
    assert begun is not None
    assert np.allclose(begun.mean, [4.0, 5.0, 0.7])
    assert np.allclose(begun.cov, 0.01 * np.eye(3))


def test_evidence_beyond_the_horizon_counts_no_more() -> None:
    subject = settings("fix")
    evidence = walked(subject, place_s=1, heading_s=99, until_s=12)
    assert evidence.missing() == (A_PLACE, A_HEADING)
    fixed(evidence, subject, "heading", 12, np.zeros(1), 0.01)
    assert evidence.begun(12 * NS) is None


def test_gains_of_an_odometry_keep_their_prior() -> None:
    mean, cov = np.array([0.0, 0.0, 0.0, 1.0, 1.0]), np.diag([0.0, 0.0, 0.0, 0.02, 0.03])
    subject = settings("fix", mean=mean, cov=cov, motion=RobotMotion(UNICYCLE_GAINS))
    evidence = StartEvidence(subject)
    fixed(evidence, subject, "pose", 0, np.array([4.0, 5.0, 0.7]), 0.01)
    begun = evidence.begun(0)
    assert begun is not None
    assert np.allclose(begun.mean, [4.0, 5.0, 0.7, 1.0, 1.0])
    assert np.allclose(begun.cov.diagonal(), [0.01, 0.01, 0.01, 0.02, 0.03])


def test_in_space_an_altitude_is_needed_unless_it_is_held() -> None:
    free = settings("fix", mean=np.zeros(4), cov=np.zeros((4, 4)), motion=SpatialMotion())
    evidence = StartEvidence(free)
    assert AN_ALTITUDE in evidence.missing()
    fixed(evidence, free, "heading", 0, np.array([0.3]), 0.01)
    fixed(evidence, free, "position", 0, np.array([1.0, 2.0]), 0.01)
    assert evidence.missing() == (AN_ALTITUDE,)
    assert evidence.begun(0) is None
    fixed(evidence, free, "position", 0, np.array([1.0, 2.0, 7.0]), 0.01)
    begun = evidence.begun(0)
    assert begun is not None and np.allclose(begun.mean, [1.0, 2.0, 7.0, 0.3])
    held = replace(free, motion=SpatialMotion(held=HeldAltitude(9.0, 0.1)))
    evidence = StartEvidence(held)
    fixed(evidence, held, "pose", 0, np.array([1.0, 2.0, 0.3]), 0.01)
    begun = evidence.begun(0)
    assert begun is not None and np.allclose(begun.mean, [1.0, 2.0, 9.0, 0.3])
    assert SPATIAL.altitude == 2


# -- peers ---------------------------------------------------------------------------------------------------------

PEER = np.array([6.0, 1.0, -0.4])
TOLD = Told("unicycle", PEER, np.diag([0.04, 0.04, 0.0001]))


def polar(observer: Array, subject: Array) -> Measurement:
    apart = subject[:2] - observer[:2]
    z = np.array([np.hypot(*apart), wrap(np.arctan2(apart[1], apart[0]) - observer[2])])
    return Measurement("range_bearing", z, np.diag([1e-4, 1e-6]))


def test_a_peer_that_is_measured_tells_the_place_and_a_heading_fix_the_rest() -> None:
    subject = settings("peer")
    evidence = StartEvidence(subject)
    assert evidence.missing() == (A_CONTACT, A_VIEW)
    assert evidence.contact(0, "r1", TOLD, [polar(FIRST, PEER)], own_observed=True)
    assert evidence.missing() == (A_VIEW,)
    assert evidence.begun(0) is None
    fixed(evidence, subject, "heading", 0, FIRST[2:], 1e-4)
    begun = evidence.begun(0)
    assert begun is not None and begun.shared is not None
    assert np.abs(begun.mean - FIRST).max() < 5e-3
    # The place is as far off as the peer's.
    assert np.allclose(begun.shared[:2, :2], 0.04 * np.eye(2), atol=1e-3)
    assert np.linalg.eigvalsh(begun.cov - begun.shared)[0] > -1e-12


def test_a_peer_that_measures_the_robot_and_is_seen_by_it_tells_all() -> None:
    evidence = StartEvidence(settings("peer"))
    evidence.view(NS, "r1", [polar(FIRST, PEER)])
    assert evidence.contact(NS, "r1", TOLD, [polar(PEER, FIRST)], own_observed=False)
    begun = evidence.begun(NS)
    assert begun is not None and np.abs(begun.mean - FIRST).max() < 5e-3


def test_a_view_of_another_instant_or_peer_tells_no_heading() -> None:
    evidence = StartEvidence(settings("peer"))
    evidence.view(0, "r1", [polar(FIRST, PEER)])
    evidence.view(NS, "r2", [polar(FIRST, PEER)])
    assert evidence.contact(NS, "r1", TOLD, [polar(PEER, FIRST)], own_observed=False)
    assert evidence.begun(NS) is None
    assert evidence.missing() == (A_VIEW,)


def test_a_contact_of_the_past_is_carried_to_the_present() -> None:
    subject, truth = settings("peer"), poses(4)
    evidence = StartEvidence(subject)
    for k in range(4):
        evidence.moved(k * NS, (k + 1) * NS, STEP, NOISE)
    assert evidence.contact(NS // 2, "r1", TOLD, [polar(PEER, _halfway(truth[0]))], own_observed=False)
    fixed(evidence, subject, "heading", 3, truth[3][2:], 1e-6)
    begun = evidence.begun(4 * NS)
    assert begun is not None and np.abs(begun.mean[:2] - truth[4][:2]).max() < 2e-2
    assert begun.shared is not None


def _halfway(pose: Array) -> Array:
    return compose(pose, 0.5 * STEP[PLANAR])


def test_a_range_alone_tells_no_place_and_a_fix_no_place_to_whom_peers_are_to_tell() -> None:
    subject = settings("peer")
    evidence = StartEvidence(subject)
    alone = Measurement("range", np.array([4.0]), np.array([[0.01]]))
    assert not evidence.contact(0, "r1", TOLD, [alone], own_observed=True)
    fixed(evidence, subject, "pose", 0, np.zeros(3), 0.01)
    assert evidence.missing() == (A_CONTACT,)
    assert evidence.begun(0) is None
    assert not StartEvidence(settings("fix")).contact(0, "r1", TOLD, [polar(FIRST, PEER)], own_observed=True)
