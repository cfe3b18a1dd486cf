"""Variants of a scenario: names, products, and which of them share a centralized filter."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from agent.config_file import ConfigError
from sim import bound, variants
from sim.scenario_file import load
from sim.variants import bound_leaders, choices, parse


def names(*texts: str) -> list[str]:
    return [choice.name for choice in choices(parse(list(texts), []))]


def test_a_variant_is_named_by_its_value() -> None:
    assert names("links.loss=0,0.3") == ["loss=0", "loss=0.3"]
    assert names("localization.form=safe, published") == ["form=safe", "form=published"]


def test_two_keys_make_a_product() -> None:
    found = choices(parse(["links.loss=0,0.3", "localization.form=safe,published"], []))
    assert [choice.name for choice in found] == [
        "loss=0,form=safe",
        "loss=0,form=published",
        "loss=0.3,form=safe",
        "loss=0.3,form=published",
    ]
    assert found[1].overrides == ("links.loss=0", "localization.form=published")


def test_keys_of_the_same_last_name_are_told_apart() -> None:
    found = names("robots.r1.sensors.range.sigma_m=0.1,1", "robots.r2.sensors.range.sigma_m=0.1,1")
    assert found[1] == "robots.r1.sensors.range.sigma_m=0.1,robots.r2.sensors.range.sigma_m=1"


def test_values_may_be_lists_and_names_stay_names() -> None:
    found = choices(parse(['world.path="a, b","c/d"', "window_s=[0, 5],[5, 9]"], []))
    assert found[0].overrides == ('world.path="a, b"', "window_s=[0, 5]")
    assert [choice.name for choice in found] == [
        "path=a,b,window_s=_0,5_",
        "path=a,b,window_s=_5,9_",
        "path=c_d,window_s=_0,5_",
        "path=c_d,window_s=_5,9_",
    ]


def test_names_that_would_be_equal_are_counted() -> None:
    assert names('world.path="a/b","a:b","a b"') == ["path=a_b", "path=a_b~2", "path=ab"]


@pytest.mark.parametrize(
    ("texts", "fixed", "remedy"),
    [
        (["links.loss"], [], "KEY=A,B"),
        (["=1,2"], [], "KEY=A,B"),
        (["links.loss=0,,1"], [], "KEY=A,B"),
        (["links.loss=0.3"], [], "at least two"),
        (["links.loss=0.3,0.3"], [], "none of them twice"),
        (["links.loss=0,1", "links.loss=2,3"], [], "varied twice"),
        (["links.loss=0,1"], ["links.loss=0.2"], "drop one"),
    ],
)
def test_wrong_use_names_the_remedy(texts: list[str], fixed: list[str], remedy: str) -> None:
    with pytest.raises(ConfigError, match=remedy):
        parse(texts, fixed)


def test_too_many_variants_are_refused() -> None:
    values = ",".join(str(value) for value in range(9))
    with pytest.raises(ConfigError, match="81 variants"):
        choices(parse([f"links.loss={values}", f"links.delay_s={values}"], []))


def test_variants_of_what_only_agents_do_share_their_centralized_filter() -> None:
    def leaders(*overrides: str) -> list[int]:
        return bound_leaders([load("ut-clat", [override]) for override in overrides])

    assert leaders("links.loss=0", "links.loss=0.3", "localization.form=published", "lateness.kind=discard") == [0] * 4
    assert leaders("localization.form=safe", "robots.r2.localization.form=published") == [0, 0]
    assert leaders("links.loss=0", "localization.transform=jacobian", "localization.innovation_cap=3") == [0, 1, 2]
    assert leaders("links.loss=0", "robots.r2.sensors.range.sigma_m=0.1", "coast.speed_mps=1") == [0, 1, 2]
    assert leaders("window_s=[0,100]", "window_s=[50,100]", "window_s=[0,100]") == [0, 1, 0]


def test_everything_the_bound_reads_of_the_localization_tells_variants_apart() -> None:
    read = set(re.findall(r"scenario\.localization\.(\w+)", Path(bound.__file__).read_text()))
    told = set(re.findall(r"used\.(\w+)", Path(variants.__file__).read_text()))
    assert read
    assert read <= told
