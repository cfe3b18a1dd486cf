"""What trials are made from, and what is said when it differs."""

from __future__ import annotations

from sim.provenance import differences, provenance, summed_up
from sim.scenario_file import load

BASE = provenance(load("ut-clat"), 1, False)


def told(*overrides: str, seed: int = 1, bound: bool = False) -> str:
    return summed_up(differences(BASE, provenance(load("ut-clat", list(overrides)), seed, bound)))


def test_equal_settings_differ_in_nothing() -> None:
    assert told() == ""


def test_a_difference_is_named_by_its_key() -> None:
    assert told(seed=2) == "seed is 1 there, 2 here"
    assert told(bound=True) == "bound is false there, true here"
    assert told("links.loss=0.3") == "links.loss is 0.0 there, 0.3 here"
    assert told("robots.r2.sensors.range.sigma_m=0.5").startswith("robots.r2.sensors.range.sigma_m is ")
    assert told("localization.pair_interval_s=2") == "localization.pair_interval_s is absent there, 2.0 here"


def test_many_differences_stay_one_line() -> None:
    line = told("links.loss=0.3", "links.delay_s=1", "links.duplicate=0.1", "step_s=0.5", seed=3)
    assert line.endswith(", and 2 more")
    assert line.count(";") == 2


def test_the_order_of_robots_and_their_number_matter() -> None:
    there = {"robots": [{"id": "r1"}, {"id": "r2"}]}
    assert differences(there, {"robots": [{"id": "r2"}, {"id": "r1"}]})
    (line,) = differences(there, {"robots": [{"id": "r1"}]})
    assert line == 'robots is ["r1", "r2"] there, ["r1"] here'


def test_other_code_is_another_origin() -> None:
    changed = {**BASE, "software": {**BASE["software"], "code": "0"}}
    (line,) = differences(changed, BASE)
    assert line.startswith('software.code is "0" there')
