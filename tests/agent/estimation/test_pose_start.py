"""A pose found next to a peer: where the robot is, how sure that is, and how much of it is the peer's error."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.estimation.gaussian import wrap, wrap_components
from agent.estimation.motion import SPATIAL, UNICYCLE, UNICYCLE_GAINS, StateLayout
from agent.estimation.observation import NO_MOUNT, RelativeModel
from agent.estimation.pose_start import Known, heading_from_view, pose_from_peer
from network.messages import Mount

Array = NDArray[np.float64]

MOUNT = (0.3, -0.2, 0.0, 0.0, 0.0, 0.8)
DOWN = (0.2, 0.1, -0.05, 0.0, 0.4, 0.3)
R = np.diag([0.01, 0.0004])
CASES = [
    pytest.param(own_observed, by_view, own, peer, mount, id=f"{own_observed}-{by_view}-{own.name}-{peer.name}-{mount}")
    for own_observed, by_view in ((True, False), (False, False), (False, True))
    for own, peer, mount in (
        (UNICYCLE, UNICYCLE, NO_MOUNT),
        (UNICYCLE, UNICYCLE_GAINS, MOUNT),
        *(() if by_view else ((SPATIAL, SPATIAL, DOWN), (SPATIAL, UNICYCLE, DOWN))),
    )
]


class Scene:
    """A robot and a peer apart from it, and what they measure without noise."""

    def __init__(
        self, rng: np.random.Generator, own_observed: bool, own: StateLayout, peer: StateLayout, mount: Mount
    ) -> None:
        self.own, self.peer = np.zeros(own.dim), np.zeros(peer.dim)
        away = rng.uniform(-np.pi, np.pi)
        self.own[:2] = rng.uniform(-20.0, 20.0, 2)
        self.peer[:2] = self.own[:2] + rng.uniform(4.0, 9.0) * np.array([np.cos(away), np.sin(away)])
        for state, layout in ((self.own, own), (self.peer, peer)):
            state[layout.heading] = rng.uniform(-np.pi, np.pi)
            if layout.altitude is not None:
                state[layout.altitude] = rng.uniform(0.5, 1.5)
        if peer.dim == 5:
            self.peer[3:] = 1.0
        self.layout, self.own_observed = own, own_observed
        observer, subject = (own, peer) if own_observed else (peer, own)
        self.model = RelativeModel("range_bearing", observer, mount, subject=subject)
        both = (self.own, self.peer) if own_observed else (self.peer, self.own)
        self.z = self.model.h(np.concatenate(both))
        self.view = RelativeModel("bearing", own, mount, subject=peer)
        self.azimuth = float(self.view.h(np.concatenate([self.own, self.peer]))[0])
        self.here = [*own.position, own.heading]

    def found(self, peer: Array, P: Array, z: Array, by_view: bool, turn: Known, altitude: Known):  # type: ignore[no-untyped-def]
        return pose_from_peer(
            self.model,
            self.own_observed,
            self.layout,
            (peer, P),
            z,
            R,
            heading=None if by_view else turn,
            view=(self.view, turn) if by_view else None,
            altitude=altitude if self.layout.altitude is not None else None,
        )


def spread(layout: StateLayout) -> Array:
    sigma = np.full(layout.dim, 0.1)
    sigma[:2], sigma[layout.heading] = (0.3, 0.2), 0.03
    return np.diag(sigma**2)


@pytest.mark.parametrize(("own_observed", "by_view", "own", "peer", "mount"), CASES)
def test_what_is_sure_gives_the_true_pose(
    own_observed: bool, by_view: bool, own: StateLayout, peer: StateLayout, mount: Mount
) -> None:
    for seed in range(10):
        scene = Scene(np.random.default_rng(seed), own_observed, own, peer, mount)
        turn = Known(scene.azimuth if by_view else float(scene.own[own.heading]), 1e-12)
        altitude = Known(float(scene.own[own.altitude]) if own.altitude is not None else 0.0, 1e-12)
        found = scene.found(scene.peer, 1e-12 * np.eye(peer.dim), scene.z, by_view, turn, altitude)
        # A range with noise shortens a place by a hair.
        error = found.mean - scene.own[scene.here]
        assert np.abs(error[:-1]).max() < 5e-3
        assert abs(wrap(error[-1])) < 1e-3


@pytest.mark.parametrize(("own_observed", "by_view", "own", "peer", "mount"), CASES)
def test_errors_are_as_large_as_claimed_and_without_those_of_the_peer_as_large_as_not_shared(
    own_observed: bool, by_view: bool, own: StateLayout, peer: StateLayout, mount: Mount
) -> None:
    trials, total, rng = 600, 0.0, np.random.default_rng(7)
    P = spread(peer)
    for _ in range(trials):
        scene = Scene(rng, own_observed, own, peer, mount)
        told = scene.peer + np.sqrt(P.diagonal()) * rng.normal(size=peer.dim)
        z = wrap_components(scene.z + np.sqrt(R.diagonal()) * rng.normal(size=2), (1,))
        truth = scene.azimuth if by_view else float(scene.own[own.heading])
        turn = Known(truth + 0.05 * rng.normal(), 0.05**2)
        height = float(scene.own[own.altitude]) if own.altitude is not None else 0.0
        altitude = Known(height + 0.05 * rng.normal(), 0.05**2)
        found = scene.found(told, P, z, by_view, turn, altitude)
        error = found.mean - scene.own[scene.here]
        error[-1] = wrap(error[-1])
        total += float(error @ np.linalg.solve(found.cov, error)) / len(error)
        assert np.linalg.eigvalsh(found.cov - found.shared)[0] > -1e-12
        sure = scene.found(told, 1e-10 * np.eye(peer.dim), z, by_view, turn, altitude)
        np.testing.assert_allclose(found.cov - found.shared, sure.cov, atol=0.1 * float(np.trace(sure.cov)))
    assert 0.85 < total / trials < 1.15


def test_a_heading_from_a_view_is_that_from_which_the_peer_is_seen_so() -> None:
    rng = np.random.default_rng(3)
    model = RelativeModel("bearing", UNICYCLE, MOUNT)
    for _ in range(50):
        state = np.concatenate([rng.uniform(-5.0, 5.0, 2), rng.uniform(-np.pi, np.pi, 1), rng.uniform(6.0, 12.0, 3)])
        found = heading_from_view(state[:2], state[3:5], model.h(state)[0], model)
        assert abs(wrap(found - state[2])) < 1e-9


def test_nothing_follows_without_a_heading_or_with_a_vague_one() -> None:
    scene = Scene(np.random.default_rng(1), True, UNICYCLE, UNICYCLE, NO_MOUNT)
    peer, P = scene.peer, spread(UNICYCLE)
    model = scene.model
    assert pose_from_peer(model, True, UNICYCLE, (peer, P), scene.z, R) is None
    assert pose_from_peer(model, True, UNICYCLE, (peer, P), scene.z, R, heading=Known(0.0, 1.0)) is None
    assert pose_from_peer(model, True, UNICYCLE, (peer, P), scene.z, R, view=(scene.view, Known(0.0, 0.01))) is None
    assert pose_from_peer(model, True, UNICYCLE, (peer, P), scene.z, R, heading=Known(0.0, 0.01)) is not None
