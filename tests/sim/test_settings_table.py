"""What differs between scenarios, told as briefly as it can be."""

from __future__ import annotations

import copy
from typing import Any

from sim.settings_table import differing


def fleet(**change: Any) -> dict[str, Any]:
    robots = [{"id": name, "localization": {"form": "safe"}, "start": [0.0, 1.0]} for name in ("r1", "r2")]
    return {"name": "pair", "links": {"loss": 0.0}, "robots": robots, **change}


def test_equal_settings_differ_in_nothing() -> None:
    assert differing([fleet(), fleet(), fleet()]) == []


def test_what_differs_has_a_value_per_run() -> None:
    found = differing([fleet(), fleet(links={"loss": 0.3}), fleet(window_s=[0.0, 5.0])])
    assert found == [("links.loss", ["0.0", "0.3", "0.0"]), ("window_s", ["–", "–", "[0.0, 5.0]"])]


def test_the_same_change_of_all_robots_is_one_line() -> None:
    other = fleet()
    for robot in other["robots"]:
        robot["localization"]["form"] = "published"
    assert differing([fleet(), other]) == [("robots.*.localization.form", ["safe", "published"])]


def test_a_change_of_one_robot_names_it() -> None:
    other = copy.deepcopy(fleet())
    other["robots"][1]["start"] = [2.0, 1.0]
    assert differing([fleet(), other]) == [("robots.r2.start", ["[0.0, 1.0]", "[2.0, 1.0]"])]


def test_a_robot_more_is_told_once_and_hides_nothing_of_the_others() -> None:
    other = fleet()
    other["robots"].append({"id": "r3", "localization": {"form": "published"}, "start": [0.0, 1.0]})
    other["robots"][0]["start"] = [9.0, 9.0]
    assert differing([fleet(), other]) == [
        ("robots", ["r1, r2", "r1, r2, r3"]),
        ("robots.r1.start", ["[0.0, 1.0]", "[9.0, 9.0]"]),
    ]
