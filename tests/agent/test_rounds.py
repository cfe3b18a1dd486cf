"""When rounds open and end, and who is waited for."""

from __future__ import annotations

import numpy as np
import pytest

from agent.events import LinkChange
from agent.rounds import OLDEST_ROUNDS, PRESENT_ROUNDS, Neighbours, RoundClock, Told
from agent.settings import RoundSettings
from network.messages import Belief, RoundReport, RoundStage

SECOND = 1_000_000_000
SETTINGS = RoundSettings(period_ns=SECOND, wait_ns=SECOND // 5)


def told(peer: str, t_ns: int, stage: RoundStage = RoundStage.PRIOR) -> Told:
    return Told(peer, t_ns, RoundReport(stage, Belief("unicycle", np.zeros(3), np.eye(3)), np.zeros(3), 0.0))


@pytest.mark.parametrize(("start", "anchor", "first"), [(0, 0, 0), (1, 0, SECOND), (SECOND, 0, SECOND), (5, 5, 5)])
def test_rounds_are_at_whole_periods_since_the_anchor(start: int, anchor: int, first: int) -> None:
    clock = RoundClock(RoundSettings(period_ns=SECOND, anchor_ns=anchor), start)
    assert clock.next_ns == first
    assert clock.due(first - 1) is None
    assert clock.due(first) == first and clock.open(first) == 0
    assert clock.due(first) is None and clock.next_ns == first + SECOND


def test_who_was_held_up_goes_on_with_the_newest_round() -> None:
    clock = RoundClock(SETTINGS, 0)
    assert clock.due(7 * SECOND + 3) == 7 * SECOND
    assert clock.open(7 * SECOND) == 7
    assert clock.next_ns == 8 * SECOND


def test_all_who_told_lately_are_waited_for_and_nobody_else() -> None:
    near = Neighbours(SETTINGS)
    assert not near.all_told(RoundStage.PRIOR, 0), "nobody is known: who knows who is there"
    for peer in ("r2", "r3"):
        assert near.hear(told(peer, SECOND))
    assert near.all_told(RoundStage.PRIOR, SECOND)
    assert near.hear(told("r2", 2 * SECOND))
    assert not near.all_told(RoundStage.PRIOR, 2 * SECOND)
    assert near.hear(told("r3", 2 * SECOND))
    assert near.all_told(RoundStage.PRIOR, 2 * SECOND)
    gone = (2 + PRESENT_ROUNDS + 1) * SECOND
    assert near.hear(told("r2", gone))
    assert near.all_told(RoundStage.PRIOR, gone), "r3 has been silent for long"
    assert not near.all_told(RoundStage.POSTERIOR, SECOND)


def test_the_newest_counts_whatever_the_order_of_arrival() -> None:
    near = Neighbours(SETTINGS)
    assert near.hear(told("r2", 3 * SECOND))
    assert not near.hear(told("r2", 2 * SECOND))
    assert not near.hear(told("r2", 3 * SECOND)), "a copy"
    assert near.hear(told("r2", 2 * SECOND, RoundStage.POSTERIOR)), "stages are kept apart"
    assert [item.t_ns for item in near.newest(RoundStage.PRIOR, 3 * SECOND)] == [3 * SECOND]


def test_what_is_too_old_is_not_used_and_peers_come_in_order() -> None:
    near = Neighbours(SETTINGS)
    for peer in ("r3", "r1", "r2"):
        near.hear(told(peer, SECOND))
    near.hear(told("r1", 9 * SECOND + 1))
    names = [item.peer for item in near.newest(RoundStage.PRIOR, (1 + OLDEST_ROUNDS) * SECOND)]
    assert names == ["r1", "r2", "r3"]
    assert [item.peer for item in near.newest(RoundStage.PRIOR, (1 + OLDEST_ROUNDS) * SECOND + 1)] == ["r1"]


def test_a_new_life_is_not_taken_for_the_former_one() -> None:
    near = Neighbours(SETTINGS)
    assert near.link_changed(LinkChange(0, "r2", True, 1, 7))
    near.hear(told("r2", SECOND))
    assert not near.link_changed(LinkChange(0, "r2", False, 1, 7))
    assert not near.link_changed(LinkChange(0, "r2", True, 1, 7))
    assert near.newest(RoundStage.PRIOR, SECOND)
    assert near.link_changed(LinkChange(0, "r2", True, 2, 8))
    assert not near.newest(RoundStage.PRIOR, SECOND)


def test_ever_new_names_do_not_fill_the_memory() -> None:
    from network.peers import MAX_PEERS

    near = Neighbours(SETTINGS)
    for k in range(3 * MAX_PEERS):
        near.hear(told(f"r{k}", SECOND))
        near.link_changed(LinkChange(0, f"x{k}", True, 1, k))
    assert len(near.newest(RoundStage.PRIOR, SECOND)) == MAX_PEERS
    assert len(near._stages[RoundStage.PRIOR]._lives) == MAX_PEERS
