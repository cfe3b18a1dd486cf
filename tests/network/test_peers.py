"""Duplicates, lives and silence of peers."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from network.peers import MAX_BOOT_IDS, MAX_PEERS, WINDOW, DuplicateWindow, Peer, PeerTable

S = 10**9


@settings(max_examples=200)
@given(st.lists(st.one_of(st.integers(0, 3 * WINDOW), st.integers(0, 40), st.integers(0, 2**62)), max_size=80))
def test_the_window_agrees_with_remembering_everything(sequence: list[int]) -> None:
    window, seen, highest = DuplicateWindow(), [], -1
    for seq in sequence:
        expected = "too_old_seq" if highest - seq >= WINDOW else "duplicate" if seq in seen else None
        assert window.refusal(seq) == expected
        if expected is None:
            window.record(seq)
            seen.append(seq)
            highest = max(highest, seq)


def heard(peer: Peer, boot_id: int, incarnation: int, seq: int, channel: str = "pair", t_ns: int = 0) -> str:
    refusal = peer.refusal(t_ns, boot_id, incarnation, channel, seq)
    if refusal is not None:
        return refusal
    return "change" if peer.accept(t_ns, t_ns, boot_id, incarnation, channel, seq) else "known"


def test_the_first_message_brings_a_peer_up_once() -> None:
    peer = Peer("r2", 7, 1)
    assert heard(peer, 7, 1, 0) == "change"
    assert heard(peer, 7, 1, 1) == "known"
    assert heard(peer, 7, 1, 1) == "duplicate"
    assert heard(peer, 7, 1, 1, channel="hello") == "known"


def test_a_restart_is_a_new_life_and_the_old_one_is_over() -> None:
    peer = Peer("r2", 7, 1)
    heard(peer, 7, 1, 900)
    assert heard(peer, 8, 1, 0, t_ns=1) == "change"
    assert heard(peer, 7, 1, 901, t_ns=2) == "old_life"
    assert heard(peer, 8, 1, 0, t_ns=1) == "duplicate"


def test_a_straggler_of_a_boot_never_heard_does_not_displace_the_living() -> None:
    peer = Peer("r2", 8, 1)
    heard(peer, 8, 1, 0, t_ns=5)
    assert heard(peer, 7, 1, 400, t_ns=4) == "old_life"
    assert heard(peer, 8, 1, 1, t_ns=6) == "known"


def test_a_higher_incarnation_is_a_new_life_of_another_boot() -> None:
    peer = Peer("r2", 7, 1)
    heard(peer, 7, 1, 3)
    assert heard(peer, 7, 2, 4, t_ns=1) == heard(peer, 7, 0, 4, t_ns=1) == "old_life"
    assert heard(peer, 8, 2, 3) == "change"
    assert heard(peer, 7, 1, 4, t_ns=1) == "old_life"
    assert heard(peer, 9, 1, 0, t_ns=1) == "old_life"


def test_messages_with_damaged_lives_make_no_second_process() -> None:
    peer = Peer("r2", 7, 5)
    heard(peer, 7, 5, 0)
    for t_ns in range(1, 200):
        boot_id, incarnation = (7, t_ns % 5) if t_ns % 2 else (1000 + t_ns, 4)
        assert heard(peer, boot_id, incarnation, t_ns, t_ns=t_ns) == "old_life"
        assert not peer.outlived(t_ns, t_ns, boot_id)
    assert peer.notices() == [] and not peer.doubled(200, 3 * S)


def test_remembered_boot_ids_are_bounded() -> None:
    peer = Peer("r2", 0, 1)
    for boot_id in range(MAX_BOOT_IDS + 2):
        assert heard(peer, boot_id, 1, 0, t_ns=boot_id) == "change"
    assert heard(peer, MAX_BOOT_IDS, 1, 0, t_ns=99) == "old_life"
    assert heard(peer, 0, 1, 0, t_ns=99) == "change"


def table_of(*robots: str, t_ns: int = 0) -> PeerTable:
    table = PeerTable(silent_after_ns=3 * S, forget_after_ns=10 * S)
    for robot in robots:
        peer = table.admit(t_ns, robot, 1, 1)
        assert peer is not None
        heard(peer, 1, 1, 0, t_ns=t_ns)
    return table


def test_silence_is_told_once_and_at_its_deadline() -> None:
    table = table_of("r2", "r3")
    assert table.next_silence_ns() == 3 * S
    assert table.silence(3 * S - 1) == []
    assert [peer.robot for peer in table.silence(3 * S)] == ["r2", "r3"]
    assert table.silence(4 * S) == []
    assert table.next_silence_ns() is None


def test_a_silent_peer_that_is_heard_again_is_a_change() -> None:
    table = table_of("r2")
    table.silence(3 * S)
    peer = table.get("r2")
    assert peer is not None
    assert heard(peer, 1, 1, 1, t_ns=4 * S) == "change"


def test_own_clock_set_back_does_not_postpone_silence() -> None:
    table = table_of("r2", t_ns=1_000 * S)
    assert table.silence(10 * S) == []
    assert [peer.robot for peer in table.silence(13 * S)] == ["r2"]


def test_a_full_table_forgets_only_the_long_silent() -> None:
    table = table_of(*(f"r{k}" for k in range(MAX_PEERS)))
    assert table.admit(1 * S, "new", 1, 1) is None
    table.silence(4 * S)
    assert table.admit(4 * S, "new", 1, 1) is None
    assert table.admit(10 * S, "new", 1, 1) is not None
    assert table.get("r0") is None
    assert len(table.sorted()) == MAX_PEERS
