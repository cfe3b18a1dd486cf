"""What a peer says that cannot be so is refused for a named reason, and moves neither the robot nor its tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.events import Observation, Odometry, Received
from agent.pairs import MAX_INFLATIONS
from agent.settings import NS, HealthSettings, LocalizationSettings
from network.messages import (
    NEVER,
    Belief,
    Epoch,
    Header,
    Measurement,
    Message,
    PairRequest,
    Snapshot,
    SplitRequest,
    SplitSnapshot,
    TargetBelief,
)
from tests.agent.team_story import TARGET, settings

Array = NDArray[np.float64]

FORMS = ("safe", "split_joint")
HERE, COV = np.zeros(3), np.diag([0.2, 0.3, 0.01])
THERE = np.array([5.0, 0.0, 0.0])
FAR = np.array([1e5, 0.0, 0.0, 0.0])
SURE = np.eye(4) * 0.01


def robot(form: str, *, target: bool = True, judges: bool = True) -> Agent:
    """r1 at the origin, who knows of a target, and where it is or not."""
    localization = LocalizationSettings(form=form, pair_interval_ns=0)
    made = settings("r1", HERE, COV, TARGET, localization)
    if not target:
        made = replace(made, targets=(replace(made.targets[0], mean=None),))
    return Agent(replace(made, health=HealthSettings(enabled=judges)))


def drive(agent: Agent, second: int) -> None:
    agent.handle(Odometry(second * NS, (second - 1) * NS, second * NS, np.zeros(4), np.eye(4) * 1e-6))


def tells(
    agent: Agent,
    second: int,
    mean: Array = THERE,
    cov: Array = COV,
    target: tuple[Array, Array] | None = None,
    known: bool = True,
    peer: str = "r2",
) -> None:
    """`peer` has measured r1 five metres away, and says where itself and the target are."""
    t_ns = second * NS
    epoch, seen = Epoch(t_ns, peer, second), (Measurement("range", np.array([5.0]), np.eye(1) * 0.01),)
    body: PairRequest | SplitRequest
    if agent.settings.localization.form == "split_joint":
        parts = () if target is None else (("t1", "constant_velocity"),)
        if target is not None:
            both = np.zeros((7, 7))
            both[:3, :3], both[3:, 3:] = cov, target[1]
            mean, cov = np.concatenate([mean, target[0]]), both
        body = SplitRequest(epoch, seen, SplitSnapshot("unicycle", parts, mean, cov, None, (0,) * len(parts)))
    else:
        of = () if target is None else (TargetBelief("t1", Belief("constant_velocity", *target)),)
        own = Belief("unicycle", mean, cov)
        body = PairRequest(epoch, seen, Snapshot(own, NEVER, np.zeros((3, 0)), np.eye(3), (), of, known))
    agent.handle(Received(t_ns, Message(Header(peer, 1, 1, second, t_ns, t_ns), body)))


def numbers(agent: Agent) -> Array:
    found = agent.estimate()
    assert found is not None
    parts = [found.mean, found.cov.ravel(), *(track.mean for track in found.tracks)]
    return np.concatenate([*parts, *(track.cov.ravel() for track in found.tracks)])


def track(agent: Agent) -> tuple[Array, Array]:
    found = agent.estimate()
    assert found is not None
    return found.tracks[0].mean, found.tracks[0].cov


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "lie",
    [
        {"mean": np.array([1e8, 0.0, 0.0])},
        {"cov": np.diag([1e-16, 0.3, 0.01])},
        {"target": (np.array([0.0, -1e8, 0.0, 0.0]), SURE)},
        {"target": (TARGET, np.diag([1e-16, 0.1, 0.1, 0.1]))},
    ],
)
def test_what_can_be_of_no_robot_or_target_is_refused(form: str, lie: dict[str, Array]) -> None:
    agent = robot(form)
    drive(agent, 1)
    before = numbers(agent)
    tells(agent, 1, **lie)  # type: ignore[arg-type]
    assert agent.counters["pair.implausible"] == 1
    assert np.array_equal(numbers(agent), before)


@pytest.mark.parametrize("form", FORMS)
def test_a_target_that_a_peer_puts_elsewhere_is_not_used_while_the_contact_is(form: str) -> None:
    agent, trusting, honest = robot(form), robot(form, judges=False), robot(form)
    for each, place in ((agent, FAR), (trusting, FAR), (honest, None)):
        drive(each, 1)
        tells(each, 1, target=None if place is None else (place, SURE))
    assert agent.counters["target.gated"] == 1
    assert agent.counters["pair.applied_responder"] == 1
    assert np.allclose(numbers(agent), numbers(honest))
    assert not np.allclose(numbers(trusting), numbers(honest)), "the gate is what keeps it out"


@pytest.mark.parametrize("form", FORMS)
def test_what_was_heard_of_a_target_does_not_give_way_to_a_liar(form: str) -> None:
    agent, trusting = robot(form, target=False), robot(form, target=False, judges=False)
    for each in (agent, trusting):
        drive(each, 1)
        tells(each, 1, target=(TARGET, np.eye(4)))
        drive(each, 2)
        tells(each, 2, target=(FAR, SURE), peer="r3")
    assert agent.counters["target.gated"] == 1
    assert np.linalg.norm(track(agent)[0][:2] - TARGET[:2]) < 1.0
    assert track(trusting)[0][0] > 1e4, "the gate is what keeps it out"


@pytest.mark.parametrize("form", FORMS)
def test_a_target_that_a_peer_puts_where_it_may_be_is_used(form: str) -> None:
    agent, alone = robot(form), robot(form)
    for each, target in ((agent, (TARGET + np.array([1.0, 0.5, 0.0, 0.0]), SURE)), (alone, None)):
        drive(each, 1)
        tells(each, 1, target=target)
    assert agent.counters["target.gated"] == 0
    assert np.trace(track(agent)[1]) < 0.5 * np.trace(track(alone)[1])


@pytest.mark.parametrize("form", FORMS)
def test_a_track_that_a_liar_began_gives_way_to_own_sightings_and_leaves_the_pose_alone(form: str) -> None:
    agent = robot(form, target=False)
    drive(agent, 1)
    tells(agent, 1, target=(FAR, SURE))
    assert track(agent)[0][0] == pytest.approx(1e5, rel=0.1)
    for second in range(2, 7):
        drive(agent, second)
        z, noise = np.array([3.0, 0.5]), np.diag([0.04, 0.001])
        agent.handle(Observation(second * NS, second * NS, "range_bearing", "target:t1", z, noise, "camera"))
    found = agent.estimate()
    assert found is not None
    assert np.linalg.norm(found.mean[:2]) < 1.0
    # Without factors a sighting that tells the place begins a track in place of what was only heard of.
    assert agent.counters["track.contradicted"] == (1 if form == "safe" else 0)
    assert np.linalg.norm(found.tracks[0].mean[:2] - 3.0 * np.array([np.cos(0.5), np.sin(0.5)])) < 1.0


def test_however_many_peers_have_lost_a_correlation_the_own_covariance_grows_by_a_bound() -> None:
    agent = robot("safe")
    for second in range(1, 21):
        drive(agent, second)
        tells(agent, second, known=False, peer=f"x{second}")
    found = agent.estimate()
    assert found is not None
    assert agent.counters["pair.restarts"] == MAX_INFLATIONS
    assert agent.counters["pair.restart_refused"] == 20 - MAX_INFLATIONS
    assert np.trace(found.cov) < 1.1 * 2.0**MAX_INFLATIONS * np.trace(COV)
