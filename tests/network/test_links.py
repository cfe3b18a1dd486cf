"""The link model: fates that depend on nothing but the packet, and a table of who hears whom."""

from __future__ import annotations

import math

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network.faults import Parcel
from network.links import (
    MAX_TABLE_BYTES,
    FateRecord,
    LinkModel,
    LinkSettings,
    RangeTable,
    decode_table,
    encode_table,
    hear,
    lowest,
    packet_fate,
)
from network.wire_fields import WireError

PACKET = {"source": "r1", "destination": "r2", "channel": "pair", "incarnation": 1, "seq": 7}
HARSH = LinkSettings(seed=3, loss=0.3, delay_s=0.1, delay_tail_s=0.05, duplicate=0.2)


def everywhere(source: str, destination: str, t_send_ns: int) -> bool:
    return True


# --- fates ------------------------------------------------------------------------------------------------


def test_a_perfect_link_does_nothing_to_a_packet() -> None:
    fate = packet_fate(LinkSettings(seed=1), **PACKET)
    assert (fate.lost, fate.delay_ns, fate.duplicate_delay_ns) == (False, 0, None)


FATES = [
    (False, 220168537, None),
    (True, 162510242, None),
    (False, 130168694, 112025890),
    (False, 115430342, None),
]


def test_fates_are_written_down() -> None:
    """Fates are part of a recorded run: they must not change between versions."""
    fates = [packet_fate(HARSH, **(PACKET | {"seq": seq})) for seq in range(4)]
    assert [(fate.lost, fate.delay_ns, fate.duplicate_delay_ns) for fate in fates] == FATES


@pytest.mark.parametrize(
    "change",
    [{"source": "r3"}, {"destination": "r3"}, {"channel": "hello"}, {"incarnation": 2}, {"seq": 8}],
    ids=lambda change: next(iter(change)),
)
def test_every_part_of_a_packets_name_matters(change: dict[str, str | int]) -> None:
    assert packet_fate(HARSH, **PACKET).delay_ns != packet_fate(HARSH, **(PACKET | change)).delay_ns


def test_the_seed_matters_and_names_do_not_run_together() -> None:
    other_seed = LinkSettings(seed=4, loss=0.3, delay_s=0.1, delay_tail_s=0.05, duplicate=0.2)
    assert packet_fate(HARSH, **PACKET) != packet_fate(other_seed, **PACKET)
    glued = PACKET | {"source": "r1r", "destination": "2"}
    assert packet_fate(HARSH, **PACKET) != packet_fate(HARSH, **glued)


def test_fates_have_the_stated_frequencies() -> None:
    n = 6_000
    fates = [packet_fate(HARSH, **(PACKET | {"seq": seq})) for seq in range(n)]
    tails = np.array([fate.delay_ns for fate in fates]) * 1e-9 - HARSH.delay_s
    # Four standard deviations of each estimate.
    assert np.mean([fate.lost for fate in fates]) == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / n))
    assert np.mean([fate.duplicate_delay_ns is not None for fate in fates]) == pytest.approx(
        0.2, abs=4 * math.sqrt(0.16 / n)
    )
    assert tails.min() >= 0.0
    assert tails.mean() == pytest.approx(0.05, abs=4 * 0.05 / math.sqrt(n))
    assert np.mean(tails > 0.05) == pytest.approx(math.exp(-1), abs=4 * math.sqrt(0.23 / n))
    lost_tails = tails[[fate.lost for fate in fates]]
    assert lost_tails.mean() == pytest.approx(0.05, abs=4 * 0.05 / math.sqrt(0.3 * n))


def test_more_loss_loses_a_superset() -> None:
    for seq in range(300):
        packet = PACKET | {"seq": seq}
        if packet_fate(LinkSettings(seed=1, loss=0.2), **packet).lost:
            assert packet_fate(LinkSettings(seed=1, loss=0.5), **packet).lost


@pytest.mark.parametrize(
    "bad",
    [
        {"seed": -1},
        {"loss": 1.5},
        {"duplicate": -0.1},
        {"delay_s": math.inf},
        {"delay_tail_s": -1.0},
        {"range_m": math.nan},
        {"hysteresis_m": -1.0},
        {"nearest": 0},
        {"rewire": -1},
    ],
    ids=lambda bad: next(iter(bad)),
)
def test_settings_that_make_no_sense_name_their_key(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        LinkSettings(**({"seed": 1} | bad))


# --- the model --------------------------------------------------------------------------------------------


def test_every_packet_is_counted_once_and_logged() -> None:
    log: list[FateRecord] = []
    harsh_with_range = LinkSettings(seed=3, range_m=10, loss=0.3, delay_s=0.1, delay_tail_s=0.05, duplicate=0.2)
    model = LinkModel(harsh_with_range, lambda source, destination, t_ns: t_ns < 800, log.append)
    arrivals = [model.decide(Parcel(**(PACKET | {"seq": seq}), t_send_ns=seq)).delays_ns for seq in range(1_000)]
    counters = model.counters
    assert counters["delivered"] + counters["lost"] + counters["out_of_range"] == 1_000
    assert counters["out_of_range"] == 200
    assert counters["delivered"] == sum(len(delays) > 0 for delays in arrivals)
    assert counters["duplicated"] == sum(len(delays) == 2 for delays in arrivals) > 0
    assert all(delays == () for delays in arrivals[800:])
    for record, delays in zip(log, arrivals, strict=True):
        assert (record.in_range and not record.lost) == bool(delays)
        assert record.duplicate == (len(delays) == 2)
        assert not delays or delays[0] == record.delay_ns


@pytest.mark.parametrize("part", [{}, {"delay_s": 0.25}, {"loss": 0.5}, {"duplicate": 0.5}, {"delay_tail_s": 0.1}])
def test_a_link_decides_by_the_fate_of_the_packet_whether_it_leaves_room_for_chance_or_not(
    part: dict[str, float],
) -> None:
    made = LinkSettings(seed=5, **part)
    model = LinkModel(made, everywhere)
    for seq in range(40):
        fate = packet_fate(made, source="r1", destination="r2", channel="pair", incarnation=1, seq=seq)
        expected = () if fate.lost else (fate.delay_ns,)
        if not fate.lost and fate.duplicate_delay_ns is not None:
            expected += (fate.duplicate_delay_ns,)
        assert model.decide(Parcel("r1", "r2", "pair", 1, seq, 0)).delays_ns == expected


def test_without_a_range_the_world_is_not_asked() -> None:
    def nobody(source: str, destination: str, t_send_ns: int) -> bool:
        raise AssertionError

    assert LinkModel(LinkSettings(seed=1), nobody).decide(Parcel(**PACKET, t_send_ns=0)).delays_ns == (0,)


@pytest.mark.parametrize("part", [{"range_m": 10.0}, {"nearest": 3}, {"rewire": 3}])
def test_if_somebody_may_be_out_of_hearing_the_world_is_asked(part: dict[str, float]) -> None:
    made = LinkSettings(1, **part)
    assert made.limited
    model = LinkModel(made, lambda source, destination, t_ns: t_ns == 5)
    assert [model.decide(Parcel(**PACKET, t_send_ns=t_ns)).delays_ns for t_ns in (4, 5)] == [(), (0,)]
    assert model.counters["out_of_range"] == 1


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_each_hears_so_many_of_the_lowest_rank(n: int, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rank = np.where(rng.random((n, n)) < 0.3, np.inf, rng.integers(0, 4, (n, n)).astype(float))
    heard = lowest(rank, count)
    for destination in range(n):
        others = [k for k in range(n) if k != destination and np.isfinite(rank[k, destination])]
        expected = sorted(others, key=lambda k: (rank[k, destination], k))[:count]
        assert np.flatnonzero(heard[:, destination]).tolist() == sorted(expected)


def test_two_receivers_agree_on_a_packets_fate_without_talking() -> None:
    one, two = LinkModel(HARSH, everywhere), LinkModel(HARSH, everywhere)
    for seq in reversed(range(50)):
        one.decide(Parcel(**(PACKET | {"seq": seq}), t_send_ns=seq))
    assert one.decide(Parcel(**PACKET, t_send_ns=0)).delays_ns == two.decide(Parcel(**PACKET, t_send_ns=0)).delays_ns


# --- range ------------------------------------------------------------------------------------------------


def test_an_existing_link_breaks_only_beyond_the_hysteresis() -> None:
    distance_m = [9.0, 10.0, 11.0, 12.0, 13.0]
    assert hear(False, distance_m, 10.0, 2.0).tolist() == [True, True, False, False, False]
    assert hear(True, distance_m, 10.0, 2.0).tolist() == [True, True, True, True, False]
    assert hear(np.zeros((2, 2)), np.full((2, 2), 1e9), None).all()


def test_a_publication_holds_until_the_next() -> None:
    table = RangeTable()
    assert not table.state("r1", "r2", 5)
    table.publish(10, [("r1", "r2")])
    table.publish(20, [])
    assert [table.state("r1", "r2", t_ns) for t_ns in (0, 10, 19, 20, 99)] == [True, True, True, False, False]
    assert not table.state("r2", "r1", 15)


@given(st.permutations([(10, True), (20, False), (30, True), (40, False)]))
def test_publications_may_arrive_in_any_order(publications: list[tuple[int, bool]]) -> None:
    table = RangeTable()
    for t_ns, heard in publications:
        table.publish(t_ns, [("r1", "r2")] if heard else [])
    assert [table.state("r1", "r2", t_ns) for t_ns in (15, 25, 35, 45)] == [True, False, True, False]


def test_a_later_word_on_the_same_instant_replaces_the_first() -> None:
    table = RangeTable()
    table.publish(10, [])
    table.publish(10, [("r1", "r2")])
    assert table.state("r1", "r2", 10)
    assert len(table) == 1


def test_the_table_forgets_the_oldest() -> None:
    table = RangeTable(capacity=4)
    for t_ns in range(10):
        table.publish(t_ns, [("r1", "r2")] if t_ns % 2 else [])
    assert len(table) == 4
    assert [table.state("r1", "r2", t_ns) for t_ns in (6, 7, 8, 9)] == [False, True, False, True]


robots_lists = st.lists(st.text("abc019-", min_size=1, max_size=24), max_size=20, unique=True)


@settings(max_examples=80)
@given(robots_lists, st.integers(0, 2**63 - 1), st.integers(0, 2**400 - 1))
def test_tables_survive_the_wire(robots: list[str], t_ns: int, bits: int) -> None:
    everybody = [(source, destination) for source in robots for destination in robots]
    pairs = [pair for k, pair in enumerate(everybody) if bits >> k & 1]
    assert decode_table(encode_table(t_ns, robots, pairs)) == (t_ns, frozenset(pairs))


def test_a_table_of_strangers_is_not_encoded() -> None:
    with pytest.raises(ValueError, match="not listed"):
        encode_table(1, ["r1"], [("r1", "r2")])
    with pytest.raises(ValueError, match="at most"):
        encode_table(1, [f"r{k}" for k in range(257)], [])


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"\xc1", "malformed"),
        (b"\x00" * (MAX_TABLE_BYTES + 1), "oversize"),
        (msgpack.packb([1, 2, []]), "malformed"),
        (msgpack.packb([True, 2, [], b""]), "wrong_type"),
        (msgpack.packb([2, 2, [], b""]), "unknown_version"),
        (msgpack.packb([1, -2, [], b""]), "out_of_range"),
        (msgpack.packb([1, 2, ["R 1"], b"\x00"]), "bad_id"),
        (msgpack.packb([1, 2, [7], b"\x00"]), "bad_id"),
        (msgpack.packb([1, 2, ["r1"], b""]), "malformed"),
    ],
)
def test_a_spoiled_table_is_refused_with_its_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(WireError) as refused:
        decode_table(payload)
    assert refused.value.reason == reason


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_no_table(payload: bytes) -> None:
    with pytest.raises(WireError):
        decode_table(payload)
