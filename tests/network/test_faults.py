"""Faults of links: each kind does what it says, and equal packets have equal fates in any order of asking."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from network.faults import (
    UNHARMED,
    LinkFault,
    LinkFaults,
    Links,
    Parcel,
    Spells,
    corrupted,
    exponential_ns,
    uniforms,
)

S = 1_000_000_000
PARCEL = Parcel("r1", "r2", "pair", 3, 7, 5 * S, 200)


def parcels(count: int, t_ns: int = 5 * S, step_ns: int = 0, **change: str) -> list[Parcel]:
    return [replace(PARCEL, seq=seq, t_send_ns=t_ns + seq * step_ns, **change) for seq in range(count)]


def faults(*found: LinkFault, seed: int = 4) -> LinkFaults:
    return LinkFaults(seed, list(found))


def test_without_faults_nothing_happens() -> None:
    assert faults().on(PARCEL) == UNHARMED


@pytest.mark.parametrize(("t_ns", "cut"), [(S - 1, False), (S, True), (2 * S - 1, True), (2 * S, False)])
def test_a_fault_lasts_from_its_begin_to_its_end(t_ns: int, cut: bool) -> None:
    found = faults(LinkFault("wall", S, 2 * S, cut=True)).on(replace(PARCEL, t_send_ns=t_ns))
    assert (found.cause == "wall") == cut


@pytest.mark.parametrize(
    ("links", "there", "back"),
    [
        (Links(), True, True),
        (Links(frozenset({"r1"})), True, True),
        (Links(frozenset({"r1"}), both_ways=False), True, False),
        (Links(frozenset({"r2"}), both_ways=False), False, True),
        (Links(frozenset({"r1"}), frozenset({"r2"}), both_ways=False), True, False),
        (Links(frozenset({"r1"}), frozenset({"r3"})), False, False),
        (Links(groups=(frozenset({"r1", "r3"}), frozenset({"r2"}))), True, True),
        (Links(groups=(frozenset({"r1", "r2"}), frozenset({"r3"}))), False, False),
        (Links(groups=(frozenset({"r1"}),)), True, True),
    ],
)
def test_which_links_are_meant(links: Links, there: bool, back: bool) -> None:
    assert links.contain("r1", "r2") == there
    assert links.contain("r2", "r1") == back


def test_robots_in_no_group_are_alone() -> None:
    links = Links(groups=(frozenset({"r1", "r2"}),))
    assert links.contain("r3", "r4") and not links.contain("r1", "r2")


def test_a_clog_delivers_all_at_its_end() -> None:
    found = faults(LinkFault("clog", 4 * S, 9 * S, clog=True))
    for parcel in parcels(40, 4 * S, S // 10):
        effect = found.on(parcel)
        assert effect.cause is None and parcel.t_send_ns + effect.delay_ns == 9 * S


def test_the_share_of_losses_damages_and_copies_is_the_stated_one() -> None:
    found = faults(LinkFault("bad", loss=0.2, duplicate=0.3, again_ns=S, corrupt=0.1))
    effects = [found.on(parcel) for parcel in parcels(4000)]
    kept = [effect for effect in effects if effect.cause is None]
    assert len(kept) / len(effects) == pytest.approx(0.8, abs=0.02)
    assert sum(len(effect.copies_ns) for effect in kept) / len(kept) == pytest.approx(0.3, abs=0.03)
    assert sum(effect.corrupted for effect in kept) / len(kept) == pytest.approx(0.1, abs=0.02)
    again = [copy for effect in kept for copy in effect.copies_ns]
    assert 0 <= min(again) < S // 20 and S - S // 20 < max(again) <= S


def test_losses_are_independent_from_link_to_link_and_fault_to_fault() -> None:
    one, other = faults(LinkFault("one", loss=0.5)), faults(LinkFault("other", loss=0.5))
    lost = [
        [f.on(p).cause is not None for p in parcels(400, **way)]  # type: ignore[arg-type]
        for f in (one, other)
        for way in ({}, {"destination": "r3"})
    ]
    for a in range(4):
        for b in range(a):
            assert 140 < sum(x == y for x, y in zip(lost[a], lost[b])) < 260


def test_the_delay_has_a_shortest_value_and_a_tail_of_the_stated_mean() -> None:
    found = faults(LinkFault("late", delay_ns=S, delay_tail_ns=S // 2))
    delays = [found.on(parcel).delay_ns for parcel in parcels(4000)]
    assert min(delays) >= S
    assert sum(delays) / len(delays) == pytest.approx(1.5 * S, rel=0.05)


def test_delays_of_several_faults_add_up() -> None:
    found = faults(LinkFault("a", delay_ns=S), LinkFault("b", delay_ns=2 * S))
    assert found.on(PARCEL).delay_ns == 3 * S


def test_a_bursty_link_is_bad_for_spells_of_the_stated_lengths() -> None:
    spells = Spells(1, LinkFault("burst", burst_loss=1.0, good_ns=3 * S, bad_ns=S), "r1", "r2")
    bad = [spells.bad(k * S // 20) for k in range(80_000)]
    assert sum(bad) / len(bad) == pytest.approx(0.25, abs=0.03)
    turns = sum(a != b for a, b in itertools.pairwise(bad))
    assert turns / 2 == pytest.approx(1000, rel=0.1)


def test_losses_of_a_bursty_link_come_together() -> None:
    found = faults(LinkFault("burst", burst_loss=1.0, good_ns=3 * S, bad_ns=S))
    lost = [found.on(parcel).cause is not None for parcel in parcels(4000, 0, S // 10)]
    again = sum(a and b for a, b in itertools.pairwise(lost)) / sum(lost)
    assert sum(lost) / len(lost) == pytest.approx(0.25, abs=0.06)
    assert again > 0.8


def test_a_rate_cap_queues_and_then_loses() -> None:
    found = faults(LinkFault("narrow", bytes_per_s=200.0, queue_ns=3 * S))
    effects = [found.on(parcel) for parcel in parcels(10)]
    assert [effect.delay_ns for effect in effects[:4]] == [S, 2 * S, 3 * S, 4 * S]
    assert [effect.cause for effect in effects[4:]] == ["narrow"] * 6
    assert found.on(replace(PARCEL, seq=99, t_send_ns=20 * S)).delay_ns == S


def test_faults_are_added_and_ended_while_in_use() -> None:
    found = faults()
    found.add([LinkFault("wall", cut=True)])
    assert found.active(S) == ["wall"] and found.on(PARCEL).cause == "wall"
    with pytest.raises(ValueError, match="wall"):
        found.add([LinkFault("wall", cut=True)])
    assert found.end("wall", 5 * S) and not found.end("wall", 5 * S) and not found.end("hedge", 0)
    assert found.active(5 * S) == [] and found.on(PARCEL) == UNHARMED


@pytest.mark.parametrize(
    "wrong",
    [
        {"begin_ns": 5, "end_ns": 4},
        {"loss": 1.5},
        {"corrupt": -0.1},
        {"delay_ns": -1},
        {"burst_loss": 0.5},
        {"bytes_per_s": 0.0},
    ],
)
def test_what_makes_no_sense_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="odd"):
        LinkFault("odd", **wrong)  # type: ignore[arg-type]


@given(seed=st.integers(0, 2**32))
def test_the_order_of_asking_does_not_matter(seed: int) -> None:
    made = [
        LinkFault("a", loss=0.3, duplicate=0.3, again_ns=S, corrupt=0.2),
        LinkFault("b", 6 * S, 9 * S, burst_loss=0.9, good_ns=S, bad_ns=S),
        LinkFault("c", delay_ns=S, delay_tail_ns=S, links=Links(frozenset({"r1"}))),
    ]
    asked = [*parcels(30, 4 * S, S // 4), *parcels(30, 4 * S, S // 4, destination="r3")]
    in_order = {parcel: faults(*made, seed=seed).on(parcel) for parcel in asked}
    random.Random(seed).shuffle(asked)
    mixed = faults(*made, seed=seed)
    assert all(mixed.on(parcel) == in_order[parcel] for parcel in asked)


@given(payload=st.binary(min_size=1, max_size=300), seed=st.integers(0, 2**32), seq=st.integers(0, 50))
def test_damage_changes_bytes_and_never_the_length(payload: bytes, seed: int, seq: int) -> None:
    parcel = replace(PARCEL, seq=seq)
    changed = corrupted(payload, seed, parcel)
    assert len(changed) == len(payload) and changed == corrupted(payload, seed, parcel)
    assert 0 <= sum(a != b for a, b in zip(changed, payload)) <= 4


def test_damage_is_seen_and_nothing_stays_nothing() -> None:
    assert corrupted(b"", 1, PARCEL) == b""
    assert all(corrupted(bytes(100), seed, PARCEL) != bytes(100) for seed in range(50))


def test_numbers_of_a_packet_lie_below_one_and_differ_by_name() -> None:
    assert all(0.0 <= number < 1.0 for seed in range(100) for number in uniforms(seed, "x", PARCEL))
    assert len({uniforms(1, name, PARCEL) for name in ("", "a", "b", "ab")}) == 4
    assert exponential_ns(S, 0.0) == 0 and exponential_ns(S, 1.0) < 40 * S
