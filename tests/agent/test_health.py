"""A peer that is wrong is quarantined and re-admitted; honest ones and few outliers are left alone."""

from __future__ import annotations

from collections import Counter

import numpy as np

from agent.effects import Alarm
from agent.health import Health
from agent.settings import HealthSettings
from network.peers import MAX_PEERS

NS = 1_000_000_000


def health(**settings: object) -> tuple[Health, Counter[str]]:
    counters: Counter[str] = Counter()
    return Health(HealthSettings(**settings), counters), counters  # type: ignore[arg-type]


def told(judge: Health, peer: str, values: list[float], own_observed: bool = True) -> list[bool]:
    return [judge.usable(peer, k * NS, nis, own_observed) for k, nis in enumerate(values)]


REASON = "mean NIS of its contacts was 6.9, consistent ones have 1"
UNTIL = "until 8 contacts in a row have a NIS below 6 and 3 on average"


def test_a_wrong_peer_is_quarantined_and_readmitted() -> None:
    judge, counters = health()
    assert told(judge, "r2", [1.0] * 8 + [10.5] * 6) == [True] * 12 + [False] * 2
    (found,) = judge.status(17 * NS)["peers"].values()  # type: ignore[attr-defined]
    assert (found["verdict"], found["since_ns"]) == ("quarantined", 12 * NS)
    assert (found["reason"], found["until"]) == (REASON, f"{UNTIL} (0 so far)")
    assert told(judge, "r2", [1.0] * 3) == [False] * 3
    assert judge.status(17 * NS)["reasons"] == [f"r2 is quarantined for 5 s: {REASON}; {UNTIL} (3 so far)"]
    assert told(judge, "r2", [1.0] * 6) == [False] * 4 + [True] * 2
    assert judge.status(30 * NS)["reasons"] == []
    assert judge.alarms() == [
        Alarm("peer_quarantined", f"r2: {REASON}; {UNTIL} (0 so far)"),
        Alarm("peer_readmitted", "r2"),
    ]
    assert judge.alarms() == []
    assert counters == {"health.quarantined": 1, "health.readmitted": 1, "pair.quarantined": 9}


def test_no_contact_beyond_the_gate_is_used() -> None:
    judge, counters = health()
    assert told(judge, "r2", [1.0, 11.9, 12.1, 1e300, 1.0]) == [True, True, False, False, True]
    assert counters == {"pair.gated": 2}


def test_verdicts_outlast_a_start() -> None:
    judge, _ = health()
    told(judge, "r2", [30.0] * 4 + [1.0] * 5)
    told(judge, "r3", [2.0] * 3)
    counters: Counter[str] = Counter()
    again = Health(HealthSettings(), counters, judge.saved())
    assert again.saved() == judge.saved()
    assert again.status(9 * NS) == judge.status(9 * NS)
    assert told(again, "r2", [1.0] * 3) == [False, False, True]


def test_a_robot_is_told_that_its_contacts_are_not_used() -> None:
    judge, _ = health()
    judge.answered("r2", inconsistent=False)
    assert judge.status(0)["reasons"] == []
    judge.answered("r2", inconsistent=True)
    assert judge.status(0)["reasons"] == ["r2 does not use contacts of this robot: they contradict what it knows"]
    judge.answered("r2", inconsistent=False)
    assert judge.status(0)["reasons"] == []


def test_an_inconsistent_contact_begins_the_wait_anew() -> None:
    judge, _ = health()
    told(judge, "r2", [30.0] * 4)
    assert told(judge, "r2", [1.0] * 7 + [7.0] + [1.0] * 7) == [False] * 15
    assert told(judge, "r2", [1.0]) == [True]


def test_contacts_that_are_hardly_consistent_do_not_readmit() -> None:
    judge, _ = health()
    told(judge, "r2", [30.0] * 4)
    assert not any(told(judge, "r2", [4.0] * 50))


def test_three_outliers_of_any_size_do_not_quarantine() -> None:
    judge, counters = health()
    used = told(judge, "r2", [1e9, 0.9, 1e9, 0.9, 1e9, 0.9, 0.9, 0.9] * 5)
    assert used == [False, True, False, True, False, True, True, True] * 5
    assert counters == {"pair.gated": 15}


def test_an_honest_peer_is_practically_never_quarantined() -> None:
    rng = np.random.default_rng(7)
    judge, counters = health()
    told(judge, "r2", list(rng.chisquare(1, 100_000)))
    assert counters["health.quarantined"] <= 1


def test_who_finds_all_peers_wrong_suspects_himself_and_gives_way_to_what_they_have_measured() -> None:
    judge, _ = health()
    told(judge, "r2", [30.0] * 8)
    assert not judge.own_suspect
    told(judge, "r3", [30.0] * 8)
    assert judge.own_suspect and judge.status(0)["own_sensor_suspect"]
    assert told(judge, "r2", [30.0]) == [False]
    assert told(judge, "r2", [30.0], own_observed=False) == [True]
    told(judge, "r4", [1.0] * 8)
    assert not judge.own_suspect
    assert told(judge, "r2", [30.0], own_observed=False) == [False]
    assert told(judge, "r5", [30.0], own_observed=False) == [False]


def test_switched_off_it_judges_nobody() -> None:
    judge, counters = health(enabled=False)
    assert all(told(judge, "r2", [1e6] * 50))
    assert not counters and judge.alarms() == []


def test_ever_new_peers_fill_no_table_and_free_nobody_who_is_quarantined() -> None:
    health = Health(HealthSettings(), Counter())
    for k in range(8):
        health.usable("liar", k * NS, 30.0, own_observed=True)
    for k in range(3 * MAX_PEERS):
        health.usable(f"r{k}", k * NS, 1.0, own_observed=True)
    assert len(health.saved()) == MAX_PEERS and health.saved()["liar"].quarantined
    for k in range(3 * MAX_PEERS * 8):
        health.usable(f"bad{k // 8}", k * NS, 30.0, own_observed=True)
    assert len(health.saved()) == MAX_PEERS
