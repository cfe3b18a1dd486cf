"""The file a robot keeps: whole or refused, whatever happens to the disk; and the number of its lives, which grows."""

from __future__ import annotations

import asyncio
import errno
import os
import stat
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from agent.effects import Alarm, Persist
from agent.settings import AgentSettings
from agent.state_fields import StateError
from agent.state_file import FILE, MAGIC, REFUSED, Found, StateFile, next_incarnation, pack, unpack
from agent.state_keeper import Start, StateKeeper

NOW = 1_700_000_000_000_000_000
STATE = bytes(range(200))
SETTINGS = AgentSettings("r1", 0, np.zeros(3), np.eye(3))


def test_what_was_written_is_found_and_only_the_robot_may_read_it(tmp_path: Path) -> None:
    file = StateFile(tmp_path, "r1")
    assert file.read() == Found()
    file.write(7, STATE)
    assert file.read() == Found(7, STATE)
    file.write(7, None)
    assert file.read() == Found(7, None)
    assert [path.name for path in tmp_path.iterdir()] == [FILE]
    assert stat.S_IMODE((tmp_path / FILE).stat().st_mode) == 0o600


def test_a_file_cut_at_any_byte_is_refused(tmp_path: Path) -> None:
    whole = pack("r1", 7, STATE)
    for length in range(len(whole)):
        (tmp_path / FILE).write_bytes(whole[:length])
        (tmp_path / REFUSED).unlink(missing_ok=True)
        found = StateFile(tmp_path, "r1").read()
        assert found == Found(None, None, "torn"), length
        assert not (tmp_path / FILE).exists() and (tmp_path / REFUSED).read_bytes() == whole[:length]


def test_a_file_with_any_bit_flipped_is_refused() -> None:
    whole = pack("r1", 7, STATE)
    for index in range(len(whole)):
        for bit in range(8):
            bad = bytearray(whole)
            bad[index] ^= 1 << bit
            with pytest.raises(StateError) as refused:
                unpack(bytes(bad), "r1")
            assert refused.value.reason in ("corrupt", "torn", "other_version"), index


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "torn"),
        (b"{" * 100, "corrupt"),
        (MAGIC + b"0\n" + bytes(100), "other_version"),
        (pack("r1", 7, STATE) + b"x", "corrupt"),
        (pack("r2", 7, STATE), "other_robot"),
        (pack("r1", 0, STATE), "malformed"),
        (pack("r1", 2**53, STATE), "malformed"),
        (pack("r1", True, STATE), "malformed"),
        (pack("r1", 1, "text"), "malformed"),  # type: ignore[arg-type]
        (pack("R 1", 1, STATE), "malformed"),
        (pack("r1", 7, bytes(5_000_000)), "oversize"),
    ],
)
def test_what_cannot_be_used_is_refused_with_the_reason(tmp_path: Path, payload: bytes, reason: str) -> None:
    (tmp_path / FILE).write_bytes(payload)
    assert StateFile(tmp_path, "r1").read() == Found(None, None, reason)


def test_a_folder_in_its_place_is_refused_too(tmp_path: Path) -> None:
    (tmp_path / FILE).mkdir()
    assert StateFile(tmp_path, "r1").read().refused == "unreadable"
    StateFile(tmp_path, "r1").write(1, STATE)
    assert StateFile(tmp_path, "r1").read() == Found(1, STATE)


def test_a_file_put_aside_still_tells_the_number_of_its_life(tmp_path: Path) -> None:
    file = StateFile(tmp_path, "r1")
    file.write(7, STATE)
    assert file.refuse()
    assert file.read() == Found(7)
    assert file.refuse(), "there is nothing left to put aside"


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = StateFile(tmp_path, "r1")
    file.write(7, STATE)
    write = os.write

    def full(handle: int, data: bytes) -> int:
        write(handle, data[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError):
        file.write(7, STATE[:50])
    assert file.read() == Found(7, STATE)


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    def write(handle: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", write)


def test_without_room_the_state_is_put_aside_and_messages_go_out(tmp_path: Path, full_disk: None) -> None:
    (tmp_path / FILE).write_bytes(pack("r1", 7, STATE))
    counters: Counter[str] = Counter()
    keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, counters)
    for _ in range(3):
        assert keeper.keep(Persist(STATE, ahead=True))
    assert counters["state.write_failed"] == 3
    assert keeper.alarms() == [Alarm("state.write_failed", "No space left on device")]
    assert StateFile(tmp_path, "r1").read() == Found(7), "the next start begins a new life"


def test_if_not_even_that_is_possible_messages_of_contacts_wait(
    tmp_path: Path, full_disk: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / FILE).write_bytes(pack("r1", 7, STATE))

    def refused(path: Path, target: Path) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, Counter())
    monkeypatch.setattr(Path, "replace", refused)
    assert not keeper.keep(Persist(STATE, ahead=True))


def test_a_disk_that_has_room_again_holds_the_newest_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, Counter())
    with monkeypatch.context() as broken:
        broken.setattr(os, "write", lambda handle, data: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
        keeper.keep(Persist(STATE, ahead=True))
    assert keeper.keep(Persist(STATE[:9], ahead=True)) and not keeper.alarms()
    assert StateFile(tmp_path, "r1").read() == Found(7, STATE[:9])


def test_states_beside_the_loop_do_not_undo_newer_ones(tmp_path: Path) -> None:
    async def story() -> None:
        keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, Counter())
        keeper.keep(Persist(b"old"))
        keeper.keep(Persist(b"newer", ahead=True))
        await keeper.close(None)
        assert StateFile(tmp_path, "r1").read() == Found(7, b"newer")
        keeper.keep(Persist(b"first"))
        keeper.keep(Persist(b"second"))
        await keeper.close(b"last")

    asyncio.run(story())
    assert StateFile(tmp_path, "r1").read() == Found(7, b"last")


def test_a_life_that_follows_leaves_nothing_of_the_one_before(tmp_path: Path) -> None:
    async def story() -> None:
        keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, Counter())
        keeper.keep(Persist(b"told", ahead=True))
        keeper.keep(Persist(b"of the life before"))
        keeper.succeed(Start(SETTINGS, 9, b"alone"))
        await keeper.close(None)
        assert StateFile(tmp_path, "r1").read() == Found(9, b"alone")
        keeper.keep(Persist(b"later"))
        await keeper.close(None)

    asyncio.run(story())
    assert StateFile(tmp_path, "r1").read() == Found(9, b"later")


def test_a_life_that_follows_without_room_leaves_no_state_of_the_one_before(tmp_path: Path, full_disk: None) -> None:
    (tmp_path / FILE).write_bytes(pack("r1", 7, STATE))
    StateKeeper(StateFile(tmp_path, "r1"), 7, Counter()).succeed(Start(SETTINGS, 9, b"alone"))
    assert StateFile(tmp_path, "r1").read() == Found(7), "the next start begins a new life"


def test_no_older_state_follows_one_that_could_not_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def story() -> None:
        keeper = StateKeeper(StateFile(tmp_path, "r1"), 7, Counter())
        keeper.keep(Persist(b"old"))
        with monkeypatch.context() as broken:
            broken.setattr(os, "write", lambda handle, data: (_ for _ in ()).throw(OSError(errno.ENOSPC, "full")))
            assert keeper.keep(Persist(b"told", ahead=True))
        await keeper.close(None)

    asyncio.run(story())
    assert StateFile(tmp_path, "r1").read().state is None


class Killed(BaseException):
    """The process is gone, between two calls of the system."""


class Disk:
    """Lets a process have so many calls of the system, of which some fail by a full disk, and kills it then."""

    def __init__(self, calls: int, full: frozenset[int], patch: pytest.MonkeyPatch) -> None:
        self.calls, self._left, self._full = 0, calls, full
        for owner, name, needs_room in (
            (os, "open", True),
            (os, "write", True),
            (os, "fdatasync", True),
            (os, "fsync", False),
            (Path, "replace", False),
        ):
            self._guard(owner, name, needs_room, patch)

    def _guard(self, owner: object, name: str, needs_room: bool, patch: pytest.MonkeyPatch) -> None:
        real = getattr(owner, name)

        def call(*args: object) -> object:
            if self.calls == self._left:
                raise Killed
            self.calls += 1
            if needs_room and self._message in self._full:
                if name == "write":
                    real(args[0], args[1][:3])  # type: ignore[index]
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*args)

        patch.setattr(owner, name, call)

    _message = 0

    def about(self, message: int) -> None:
        """The state of this message is written next."""
        self._message = message


@pytest.mark.parametrize("full", [(), (1,), (2,), (1, 2), (0, 1, 2), (0, 2), (2, 3), (0, 1, 2, 3)])
def test_no_kill_at_any_moment_has_a_start_know_less_than_peers_were_told(
    full: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four messages, each with its state before it; the disk is full for some, and the process dies at every call."""
    moments = 0
    while True:
        folder = tmp_path / str(moments)
        folder.mkdir()
        (folder / FILE).write_bytes(pack("r1", 7, b"0"))
        told, survived = 0, False
        with monkeypatch.context() as patch:
            disk = Disk(moments, frozenset(full), patch)
            keeper = StateKeeper(StateFile(folder, "r1"), 7, Counter())
            try:
                for message in range(4):
                    disk.about(message)
                    if keeper.keep(Persist(str(message + 1).encode(), ahead=True)):
                        told = message + 1
                survived = True
            except Killed:
                pass
        found = StateFile(folder, "r1").read()
        assert found.incarnation == 7, f"killed at call {moments}"
        assert found.state is None or int(found.state) >= told, f"killed at call {moments}: {found.state!r} of {told}"
        if survived:
            break
        moments += 1
    assert moments > 8


def test_every_new_life_has_a_later_number() -> None:
    assert next_incarnation(None, NOW) == NOW // 1_000_000_000
    assert next_incarnation(7, NOW) == 8
    assert next_incarnation(None, 0) == 1
    assert next_incarnation(None, NOW) > 5, "a lost disk starts above what was counted before"


def test_a_folder_belongs_to_one_process_at_a_time(tmp_path: Path) -> None:
    first, second = StateFile(tmp_path, "r1"), StateFile(tmp_path, "r1")
    assert first.claim()
    assert not second.claim()
    second.release()
    assert not second.claim()
    first.release()
    assert second.claim()
    second.release()
