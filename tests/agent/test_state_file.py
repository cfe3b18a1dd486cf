"""The state file: whole or refused with the reason, and the number of a life grows whatever happens to the disk."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from agent.effects import Estimate, TrackEstimate
from agent.saved_state import MAGIC, StateError, decode, encode
from agent.state_file import FILE, REFUSED, StateFile
from agent.state_keeper import StateKeeper

NOW = 1_700_000_000_000_000_000
S = 1_000_000_000


def estimate(t_ns: int = NOW) -> Estimate:
    track = TrackEstimate("t1", "constant_velocity", np.array([1.0, 2.0, 0.1, 0.2]), np.diag([1.0, 2.0, 0.1, 0.3]))
    cov = np.array([[0.4, 0.1, 0.0], [0.1, 0.3, 0.02], [0.0, 0.02, 0.01]])
    return Estimate(t_ns, "unicycle", np.array([1.0 / 3.0, -2.0, 3.1]), cov, (track,))


def assert_equal(left: Estimate, right: Estimate | None) -> None:
    assert right is not None and (left.t_ns, left.model) == (right.t_ns, right.model)
    np.testing.assert_array_equal(left.mean, right.mean)
    np.testing.assert_array_equal(left.cov, right.cov)
    assert [track.target for track in left.tracks] == [track.target for track in right.tracks]
    for a, b in zip(left.tracks, right.tracks):
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.cov, b.cov)


# -- numbers of lives ---------------------------------------------------------------------------------------


def test_every_start_is_one_more(tmp_path: Path) -> None:
    first = StateFile(tmp_path, "r1").begin(NOW).incarnation
    assert first == NOW // S
    assert [StateFile(tmp_path, "r1").begin(NOW).incarnation for _ in range(3)] == [first + 1, first + 2, first + 3]


def test_a_stated_number_is_that_of_the_first_life(tmp_path: Path) -> None:
    assert [StateFile(tmp_path, "r1").begin(NOW, 7).incarnation for _ in range(3)] == [7, 8, 9]


def test_the_number_is_on_disk_before_it_is_used(tmp_path: Path) -> None:
    number = StateFile(tmp_path, "r1").begin(NOW).incarnation
    assert decode((tmp_path / FILE).read_bytes(), "r1") == (number, None)
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    assert (tmp_path / FILE).stat().st_mode & 0o777 == 0o600


def test_a_lost_disk_starts_above_everything_counted_before(tmp_path: Path) -> None:
    before = [StateFile(tmp_path, "r1").begin(NOW).incarnation for _ in range(5)][-1]
    (tmp_path / FILE).unlink()
    assert StateFile(tmp_path, "r1").begin(NOW + 3_600 * S).incarnation > before


def test_without_any_clock_the_first_life_is_one(tmp_path: Path) -> None:
    assert StateFile(tmp_path, "r1").begin(0).incarnation == 1


# -- what is kept -------------------------------------------------------------------------------------------


def test_the_last_estimate_survives_bit_for_bit(tmp_path: Path) -> None:
    file = StateFile(tmp_path, "r1")
    first = file.begin(NOW)
    assert first.estimate is None and first.refused is None
    file.write(estimate())
    for _ in range(3):
        # A life that ends before it has anything to write leaves what there was.
        again = StateFile(tmp_path, "r1").begin(NOW)
        assert_equal(estimate(), again.estimate)


def test_a_file_cut_anywhere_is_refused() -> None:
    whole = encode("r1", 3, estimate())
    for size in range(len(whole)):
        with pytest.raises(StateError) as refused:
            decode(whole[:size], "r1")
        assert refused.value.reason in ("torn", "corrupt")


def test_a_file_with_any_byte_changed_is_refused() -> None:
    whole = encode("r1", 3, estimate())
    for index in range(len(whole)):
        changed = whole[:index] + bytes([whole[index] ^ 0x41]) + whole[index + 1 :]
        with pytest.raises(StateError):
            decode(changed, "r1")


def signed(body: bytes) -> bytes:
    from hashlib import blake2b

    return MAGIC + blake2b(body, digest_size=16).digest() + body


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "torn"),
        (b"cofix state 2\n" + bytes(40), "other_version"),
        (bytes(100), "corrupt"),
        (b'{"incarnation": 3}' + bytes(40), "corrupt"),
        (MAGIC + bytes(2_000_000), "torn"),
        (encode("r2", 3, estimate()), "other_robot"),
        (encode("r1", 0, None), "malformed"),
        (encode("r1", 2**53, None), "malformed"),
        (signed(b"\xc1" * 30), "malformed"),
        (signed(b"\x90" + bytes(30)), "malformed"),
        (encode("r1", 3, Estimate(-1, "unicycle", np.zeros(3), np.eye(3))), "malformed"),
        (encode("r1", 3, Estimate(5, "hovercraft", np.zeros(3), np.eye(3))), "malformed"),
        (encode("r1", 3, Estimate(5, "unicycle", np.zeros(4), np.eye(4))), "malformed"),
        (encode("r1", 3, Estimate(5, "unicycle", np.full(3, np.nan), np.eye(3))), "malformed"),
        (encode("r1", 3, Estimate(5, "unicycle", np.zeros(3), -np.eye(3))), "malformed"),
        (encode("r1", 3, Estimate(5, "unicycle", np.zeros(3), np.eye(3) + np.triu(np.ones((3, 3)), 1))), "malformed"),
    ],
)
def test_what_is_no_state_of_this_robot_is_refused_with_the_reason(tmp_path: Path, payload: bytes, reason: str) -> None:
    with pytest.raises(StateError) as refused:
        decode(payload, "r1")
    assert refused.value.reason == reason
    (tmp_path / FILE).write_bytes(payload)
    found = StateFile(tmp_path, "r1").begin(NOW)
    assert (found.refused, found.estimate, found.incarnation) == (reason, None, NOW // S)
    assert (tmp_path / REFUSED).read_bytes() == payload
    assert StateFile(tmp_path, "r1").begin(NOW).refused is None


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / FILE).mkdir()
    assert StateFile(tmp_path, "r1").begin(NOW).refused == "unreadable"


# -- writing it ---------------------------------------------------------------------------------------------


def keep(tmp_path: Path, stamps: list[int], counters: Counter[str]) -> StateFile:
    """A robot that publishes estimates of these instants, and ends."""
    file = StateFile(tmp_path, "r1")
    file.begin(NOW)

    async def live() -> None:
        keeper = StateKeeper(file, S, counters)
        for t_ns in stamps:
            keeper.published(estimate(t_ns))
            await asyncio.sleep(0.01)
        await keeper.close()

    asyncio.run(live())
    return file


def test_it_is_written_at_most_once_an_interval_and_at_the_end(tmp_path: Path) -> None:
    counters: Counter[str] = Counter()
    keep(tmp_path, [NOW + k * S // 10 for k in range(25)], counters)
    assert counters["state.written"] == 4
    assert_equal(estimate(NOW + 24 * S // 10), StateFile(tmp_path, "r1").begin(NOW).estimate)


def test_a_full_disk_is_counted_and_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    counters: Counter[str] = Counter()
    keep(tmp_path, [NOW], counters)

    def full(handle: int, data: bytes) -> int:
        raise OSError(28, os.strerror(28))

    file = StateFile(tmp_path, "r1")
    file.begin(NOW)
    monkeypatch.setattr("agent.state_file.os.write", full)

    async def live() -> None:
        keeper = StateKeeper(file, S, counters)
        for k in range(4):
            keeper.published(estimate(NOW + 2 * k * S))
            await asyncio.sleep(0.02)
        await keeper.close()

    asyncio.run(live())
    assert counters["state.write_failed"] >= 2
    assert caplog.text.count("state file") == 1
    monkeypatch.undo()
    assert_equal(estimate(NOW), StateFile(tmp_path, "r1").begin(NOW).estimate)
