"""Going on with a saved estimate: by whom it can be used, and that nobody knows more by it than there is to know."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Estimate
from agent.fault_parts import made
from agent.saved_state import StateError, restarted, usable
from sim.agents import agent_config
from sim.engine import VirtualEngine
from sim.metrics import nees
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial

S = 1_000_000_000
FORMS = ("auto", "split_joint", "safe", "published", "joint")


def settings(form: str) -> Any:
    scenario = load("ut-clat-quadrotors", [f"localization.form={form}"])
    return agent_config(scenario, open_world(scenario, 1), scenario.robots[1]).settings(0)


def saved(form: str, t_ns: int = 20 * S) -> Estimate:
    """What the second quadrotor knows after a while."""
    scenario = load("ut-clat-quadrotors", [f"localization.form={form}"])
    engine = VirtualEngine(scenario, open_world(scenario, 1), 1)
    while engine.t_s * S < t_ns:
        engine.step()
    found = engine.nodes["q2"].agent.estimate()
    assert found is not None
    return found


@pytest.mark.parametrize("form", FORMS)
def test_it_begins_where_it_was_and_tells_peers_nothing_twice(form: str) -> None:
    before = saved(form)
    begun = restarted(settings(form), before)
    agent = Agent(begun)
    now = agent.estimate()
    assert now is not None and now.t_ns == before.t_ns
    np.testing.assert_array_equal(now.mean, before.mean)
    # Unknown correlation with everybody costs a factor of two where it is not kept apart as shared.
    doubled = 2.0 if form in ("safe", "published", "joint") else 1.0
    np.testing.assert_allclose(now.cov, doubled * before.cov)
    assert [track.target for track in now.tracks] == [track.target for track in before.tracks]
    for mine, track in zip(now.tracks, before.tracks):
        np.testing.assert_allclose(mine.cov, doubled * track.cov)
    if form in ("auto", "split_joint"):
        assert agent.filter.form()[0] == "split_joint"
        state = getattr(agent.filter, "active", agent.filter).state
        assert not state.split.private.any()


@pytest.mark.parametrize(
    ("change", "now_ns", "reason"),
    [
        ({"model": "unicycle"}, 20 * S, "other_model"),
        ({}, 19 * S, "from_future"),
        ({}, 700 * S, "too_old"),
    ],
)
def test_what_cannot_be_used_is_refused(change: dict[str, Any], now_ns: int, reason: str) -> None:
    before = saved("auto")
    estimate = Estimate(before.t_ns, change.get("model", before.model), before.mean, before.cov)
    with pytest.raises(StateError) as refused:
        usable(settings("auto"), estimate, now_ns, 600 * S)
    assert refused.value.reason == reason


def test_a_replica_begins_as_configured() -> None:
    plain = settings("auto")
    from dataclasses import replace

    replica = replace(plain, localization=replace(plain.localization, kind="replica"))
    assert restarted(replica, saved("auto")) is replica


def story(form: str, state: str, *more: dict[str, Any]) -> Scenario:
    faults = [made(kind="crash", robot="q2", at_s=20.0, for_s=5.0, state=state), *(made(**item) for item in more)]
    base = load("ut-clat-quadrotors", [f"localization.form={form}", "duration_s=40", "window_s=[0, 40]"])
    return base.model_copy(update={"faults": faults})


@pytest.mark.parametrize("state", ["kept", "lost"])
@pytest.mark.parametrize("form", ["auto", "joint", "safe"])
def test_nobody_is_overconfident_after_a_crash(form: str, state: str) -> None:
    """ANEES of all robots after the return, over seeds, against that without the crash."""
    ratio: list[float] = []
    for seed in range(1, 3):
        crashed = run_trial(story(form, state), seed).trace
        late = crashed.t_s > 26.0
        ratio += [float(np.nanmean(nees(trace)[late])) for trace in crashed.robots.values()]
    assert np.mean(ratio) < 1.7, f"seeds 1-2: {ratio}"


def test_a_robot_that_crashes_all_the_time_does_not_drown_the_others() -> None:
    """Peers of a form with factors double their covariance once a minute at most, however often it starts."""
    crashes = [{"kind": "crash", "robot": "q2", "at_s": 5.0 + k, "for_s": 0.5} for k in range(1, 16)]
    base = load("ut-clat-quadrotors", ["localization.form=joint", "duration_s=24", "window_s=[0, 24]"])
    looping = base.model_copy(update={"faults": [made(**item) for item in crashes]})
    found = run_trial(looping, 2)
    for robot in ("q1", "q3"):
        assert found.counters[robot]["pair.restarts"] == 1
        assert found.counters[robot]["pair.restart_refused"] > 5
        alone = run_trial(base.model_copy(update={"faults": [made(kind="isolate", robot="q2", at_s=5.0)]}), 2)
        wide = np.trace(found.trace.robots[robot].cov[-1][:2, :2])
        assert wide < 4.0 * np.trace(alone.trace.robots[robot].cov[-1][:2, :2])
