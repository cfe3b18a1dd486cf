"""The past of a joint state: cut where it is asked for, replayed when something is learnt late."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.joint_history import JointHistory
from agent.joint_state import JointModel, JointState
from agent.settings import NS, AgentSettings, LatenessSettings

Array = NDArray[np.float64]

SETTINGS = AgentSettings("r1", 0, np.array([0.0, 0.0, 0.2]), np.diag([0.2, 0.3, 0.01]))
STEP, NOISE = np.array([0.4, 0.1, 0.0, 0.1]), np.diag([0.01, 0.02, 0.0, 0.001])


def driven(steps: int, horizon_s: float = 60.0) -> tuple[JointHistory, Counter[str]]:
    model, counters = JointModel(SETTINGS), Counter[str]()
    history = JointHistory(model, LatenessSettings(horizon_ns=round(horizon_s * NS)), model.tracks.initial(), counters)
    for k in range(1, steps + 1):
        history.advance(k * NS, STEP, NOISE)
    return history, counters


def shifted(state: JointState) -> JointState:
    return replace(state, mean=state.mean + np.array([1.0, 0.0, 0.0]))


def failing(state: JointState) -> JointState:
    raise np.linalg.LinAlgError


def test_the_past_is_bounded() -> None:
    history, _ = driven(100, horizon_s=5.0)
    assert len(history) <= 7
    assert history.oldest_ns >= 94 * NS
    assert history.at(90 * NS) is None
    assert history.at(history.oldest_ns) is not None


def test_a_cut_changes_nothing_but_adds_an_instant() -> None:
    whole, _ = driven(3)
    cut, _ = driven(3)
    then = cut.at(NS + NS // 4)
    assert then is not None
    assert then.t_ns == NS + NS // 4
    assert len(cut) == len(whole) + 1
    cut.learn(then, lambda state: state)
    # The turn noise of the first part bends the second one: an effect of second order.
    assert np.abs(cut.newest.mean - whole.newest.mean).max() < 1e-4
    assert cut.newest.t_ns == whole.newest.t_ns


def test_an_instant_within_the_tolerance_is_an_entry_s() -> None:
    history, _ = driven(3)
    count = len(history)
    for offset in (-900_000, 0, 900_000):
        then = history.at(2 * NS + offset)
        assert then is not None
        assert then.t_ns == 2 * NS
    assert len(history) == count
    later = history.at(3 * NS + NS)
    assert later is history.newest


def test_what_is_learnt_late_moves_all_that_follows() -> None:
    early, _ = driven(1)
    early.learn(shifted(early.newest), shifted)
    late, _ = driven(1)
    for k in (2, 3):
        for history in (early, late):
            history.advance(k * NS, STEP, NOISE)
            history.learn(shifted(history.newest), shifted)
    then = late.at(NS)
    assert then is not None
    late.learn(shifted(then), shifted)
    assert np.allclose(late.newest.mean, early.newest.mean, atol=1e-12)
    assert np.allclose(late.newest.cov, early.newest.cov, atol=1e-12)


def test_what_fails_when_done_again_is_counted_and_left_out() -> None:
    history, counters = driven(2)
    history.learn(shifted(history.newest), failing)
    then = history.at(NS)
    assert then is not None
    history.learn(shifted(then), shifted)
    assert counters["update.failed_again"] == 1
    assert np.isfinite(history.newest.mean).all()
