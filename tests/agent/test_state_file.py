"""The number of a robot's life: it grows, whatever happens to the disk."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agent.state_file import FILE, next_incarnation

NOW = 1_700_000_000_000_000_000


def test_every_start_is_one_more(tmp_path: Path) -> None:
    first = next_incarnation(tmp_path, NOW)
    assert first == NOW // 1_000_000_000
    assert [next_incarnation(tmp_path, NOW) for _ in range(3)] == [first + 1, first + 2, first + 3]


def test_the_number_is_on_disk_before_it_is_used(tmp_path: Path) -> None:
    number = next_incarnation(tmp_path, NOW)
    assert json.loads((tmp_path / FILE).read_text()) == {"incarnation": number}
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def test_a_lost_disk_starts_above_everything_counted_before(tmp_path: Path) -> None:
    before = [next_incarnation(tmp_path, NOW) for _ in range(5)][-1]
    (tmp_path / FILE).unlink()
    an_hour_later = NOW + 3_600 * 1_000_000_000
    assert next_incarnation(tmp_path, an_hour_later) > before


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"[]",
        b"3",
        b"null",
        b"{}",
        b'{"incarnation": null}',
        b'{"incarnation": "x"}',
        b'{"incarnation": true}',
        b'{"incarnation": 1e999}',
        b'{"incarnation": -7}',
        b'{"incarnation": 99999999999999999999999}',
        b"[" * 100_000,
    ],
)
def test_an_unreadable_file_counts_as_lost(tmp_path: Path, text: bytes) -> None:
    (tmp_path / FILE).write_bytes(text)
    assert next_incarnation(tmp_path, NOW) == NOW // 1_000_000_000


def test_without_any_clock_the_first_life_is_one(tmp_path: Path) -> None:
    assert next_incarnation(tmp_path, 0) == 1
