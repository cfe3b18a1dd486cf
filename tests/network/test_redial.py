"""Who is dialled anew, and when no more: silence that is a riddle, told from silence that is none."""

from __future__ import annotations

import pytest

from network.redial import MAX_PATIENCE_S, SPARE_S, PeerWatch

PATIENCE_S = 3.0


@pytest.fixture
def watch() -> PeerWatch:
    """That of r2 between r1, which it dials, and r3, which dials it."""
    return PeerWatch("r2", ("r1", "r3"), PATIENCE_S, 100.0)


def test_who_is_dialled_is_waited_for_twice_as_long(watch: PeerWatch) -> None:
    assert watch.overdue(103.0) == []
    assert watch.overdue(103.1) == ["r1"]
    assert watch.overdue(106.0) == ["r1"]
    assert watch.overdue(106.1) == ["r1", "r3"]


def test_whatever_way_a_peer_is_heard_it_is_waited_for_anew(watch: PeerWatch) -> None:
    watch.heard("r1", 103.0, main=True)
    watch.heard("r3", 103.0, main=False)
    assert watch.overdue(106.0) == []
    assert watch.overdue(109.1) == ["r1", "r3"]
    watch.heard("stranger", 103.0, main=True)
    assert watch.overdue(1e6) == ["r1", "r3"]


def test_who_is_out_of_reach_is_asked_for_again_without_growing_patience(watch: PeerWatch) -> None:
    for k in range(1, 50):
        watch.heard("r3", 100.0 + 3.1 * k, main=True)
        assert watch.overdue(100.0 + 3.1 * k) == ["r1"]
        watch.unreachable("r1", 100.0 + 3.1 * k)


def test_dialling_in_vain_grows_rarer_and_hearing_ends_that(watch: PeerWatch) -> None:
    now_s, waits = 100.0, []
    for _ in range(8):
        begin_s = now_s
        while "r1" not in watch.overdue(now_s):
            now_s += 0.25
        watch.dialled("r1", now_s)
        waits.append(now_s - begin_s)
    assert waits == pytest.approx([3.25, 6.25, 12.25, 24.25, 48.25, *[MAX_PATIENCE_S + 0.25] * 3])
    watch.heard("r1", now_s, main=False)
    assert "r1" in watch.overdue(now_s + PATIENCE_S + 0.1)


def test_who_stood_still_itself_accuses_nobody(watch: PeerWatch) -> None:
    watch.wait_anew(160.0)
    assert watch.overdue(163.0) == []
    assert watch.overdue(163.1) == ["r1"]


def test_a_session_is_spare_when_the_main_one_brings_packets_for_a_while(watch: PeerWatch) -> None:
    watch.dialled("r1", 104.0)
    watch.heard("r1", 104.1, main=False)
    watch.heard("r1", 104.0 + SPARE_S, main=True)
    assert watch.spare() == []
    watch.heard("r1", 104.1 + SPARE_S, main=False)
    assert watch.spare() == []
    watch.heard("r1", 104.1 + SPARE_S, main=True)
    assert watch.spare() == ["r1"]
    assert watch.spare() == []


def test_a_session_that_replaces_another_is_as_new(watch: PeerWatch) -> None:
    watch.dialled("r1", 104.0)
    watch.heard("r1", 108.0, main=True)
    watch.dialled("r1", 112.0)
    assert watch.spare() == []
    watch.heard("r1", 115.1, main=True)
    assert watch.spare() == ["r1"]
