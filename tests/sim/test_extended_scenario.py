"""A scenario on top of another one: tables by key, entries by id, and what cannot be is refused with the remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.config_file import ConfigError
from sim.scenario_file import load, merged


def written(folder: Path, name: str, text: str) -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_what_a_file_says_goes_on_top_of_what_it_extends(tmp_path: Path) -> None:
    text = """
extends = "ut-clat"
name = "far"
[links]
loss = 0.25
[[robots]]
id = "r2"
start_sigma = { position_m = 3.0 }
"""
    base, found = load("ut-clat"), load(written(tmp_path, "far.toml", text))
    assert found.name == "far" and found.links.loss == 0.25
    assert [robot.id for robot in found.robots] == [robot.id for robot in base.robots]
    assert found.robots[1].start_sigma.position_m == 3.0
    assert found.robots[1].start_sigma.heading_rad == base.robots[1].start_sigma.heading_rad
    assert found.robots[0] == base.robots[0] and found.targets == base.targets
    assert found.links.range_m == base.links.range_m


def test_a_path_is_relative_to_the_file_and_chains_work(tmp_path: Path) -> None:
    written(tmp_path, "first.toml", 'extends = "ut-clat"\nname = "first"\nduration_s = 60.0\nwindow_s = [10.0, 60.0]')
    found = load(written(tmp_path, "second.toml", 'extends = "first.toml"\nname = "second"'), ["duration_s=70.0"])
    assert (found.name, found.duration_s) == ("second", 70.0)


def test_new_entries_come_last_and_plain_lists_are_replaced() -> None:
    base = {"window_s": [1, 2], "robots": [{"id": "r1", "x": {"a": 1}}, {"id": "r2"}]}
    top = {"window_s": [3], "robots": [{"id": "r3"}, {"id": "r1", "x": {"b": 2}}]}
    assert merged(base, top) == {
        "window_s": [3],
        "robots": [{"id": "r1", "x": {"a": 1, "b": 2}}, {"id": "r2"}, {"id": "r3"}],
    }
    assert base["robots"][0] == {"id": "r1", "x": {"a": 1}}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('extends = "ut-clut"', "extends: no scenario 'ut-clut': did you mean 'ut-clat'"),
        ("extends = 3", "extends: the name or path of a scenario is needed"),
        ('extends = "gone.toml"', "no such file"),
        ('extends = "own.toml"', "which extends this one; leave one of the two out"),
    ],
)
def test_what_cannot_be_extended_is_refused(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        load(written(tmp_path, "own.toml", text))
