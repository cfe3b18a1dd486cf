"""Tables of rounds and planning: plain values, and what is refused with a remedy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from agent.config_file import ConfigError, validate
from agent.config_parts import LocalizationPart
from agent.motion_parts import ControlNoisePart, ControlPart, OdometryPart
from agent.planning_parts import PlanningPart, RoundPart
from agent.settings import NS, LocalizationSettings, PlanningSettings, RoundSettings, SensingSettings
from agent.target_parts import target_motion


def test_what_is_absent_is_plain() -> None:
    assert PlanningPart().settings() == PlanningSettings()
    assert RoundPart().settings() == RoundSettings()
    assert PlanningPart(sensing=validate(PlanningPart, {"sensing": {}}, "").sensing).settings() == PlanningSettings()


def test_what_is_stated_counts() -> None:
    stated = {
        "kind": "optimal",
        "form": "published",
        "max_speed_mps": 0.7,
        "max_turn_radps": 0.4,
        "max_climb_mps": 0.2,
        "radius_m": 12.0,
        "speed_share": 0.0,
        "heading_rad_per_m": 0.5,
        "closest_m": 5.0,
        "apart_m": 9.0,
        "radio_range_m": 20.0,
        "self_weight": 0.0,
        "target_weight": 2.0,
        "potential_weight": 3.0,
        "ahead": 2,
        "horizon": 7,
        "candidates": 45,
        "weights": "trace",
        "seed": 9,
    }
    sensing = {"min_range_m": 1.0, "max_range_m": 8.0, "fov_rad": 1.0, "sigma_m": 0.1, "sigma_m_per_m": 0.0}
    part = validate(PlanningPart, stated | {"sensing": sensing}, "planning")
    expected: Any = stated | {"sensing": SensingSettings(1.0, 8.0, 1.0, 0.1, 0.0)}
    assert part.settings() == PlanningSettings(**expected)
    rounds = validate(RoundPart, {"period_s": 2.0, "wait_s": 0.5, "lean": True}, "round")
    assert rounds.settings() == RoundSettings(period_ns=2 * NS, wait_ns=NS // 2, lean=True)


@pytest.mark.parametrize(
    ("part", "words"),
    [
        (RoundPart(period_s=1.0, wait_s=1.0), r"round\.wait_s = 1 is not below round\.period_s = 1.*shorten"),
        (
            PlanningPart(kind="encircle", closest_m=6.0, radius_m=5.0),
            r"closest_m = 6 is not below planning\.radius_m = 5.*or planning\.radius_m larger",
        ),
        (
            PlanningPart(kind="potential", closest_m=12.0),
            r"closest_m = 12 is not below planning\.apart_m = 10; make it smaller, or planning\.apart_m larger",
        ),
        (PlanningPart(kind="optimal", radio_range_m=9.0), r"apart_m = 10 is not below planning\.radio_range_m"),
        (
            validate(PlanningPart, {"sensing": {"min_range_m": 20.0}}, ""),
            r"planning\.sensing\.min_range_m = 20 is not below max_range_m = 15.*smaller",
        ),
    ],
)
def test_what_does_not_go_together_is_refused_with_the_remedy(part: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        part.settings()


def test_distances_do_not_matter_to_who_does_not_push_others_off() -> None:
    assert PlanningPart(radio_range_m=5.0).settings().radio_range_m == 5.0


def test_rounds_have_weights_and_no_contacts() -> None:
    found = LocalizationPart(kind="jlatt", weights="trace", transform="jacobian").settings()
    assert found == LocalizationSettings(kind="jlatt", weights="trace", transform="jacobian")
    assert LocalizationPart(kind="jlatt").settings().weights == "split_ci"


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ({"kind": "jlatt", "form": "safe"}, r"'safe' is of kind 'clat'.*'jlatt' has no contacts.*leave form out"),
        ({"kind": "jlatt", "correlation": "ignored"}, r"correlation = 'ignored' is of kind 'clat'"),
        ({"kind": "jlatt", "pair_interval_s": 1.0}, r"leave pair_interval_s out"),
        ({"kind": "clat", "weights": "info"}, r"'info' is of kind 'jlatt'.*'clat' has no rounds; leave weights out"),
        ({"kind": "replica", "weights": "info"}, r"weights = 'info' is of kind 'jlatt'"),
    ],
)
def test_keys_of_another_kind_are_refused_with_the_remedy(part: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        validate(LocalizationPart, part, "localization").settings()


# --- noise by the speed -----------------------------------------------------------------------------------


def test_noise_by_the_speed_adds_to_the_constant_one() -> None:
    noise = ControlNoisePart(speed_mps=0.3, yaw_rate_radps=0.05, speed_share=0.4, yaw_rate_per_mps=0.12)
    assert noise.deviations(-1.0) == pytest.approx((0.5, 0.13))
    assert noise.deviations(0.0) == (0.3, 0.05)
    odometry = noise.odometry(4.0)
    cov = odometry.covariance(np.array([2.0, 0.0, 0.0, 0.0]), 4.0)
    assert cov[0, 0] == pytest.approx((0.3 * 4.0) ** 2 + (0.4 * 2.0) ** 2)
    assert cov[3, 3] == pytest.approx((0.05 * 4.0) ** 2 + (0.12 * 2.0) ** 2)


def test_an_odometry_may_state_shares_of_the_way() -> None:
    none = {"along_m_per_sqrt_s": 0.0, "vertical_m_per_sqrt_s": 0.0, "heading_rad_per_sqrt_s": 0.0}
    part = OdometryPart(**none, along_share=0.1, heading_rad_per_m=0.2)
    still = part.noise().covariance(np.array([0.0, 0.0, 0.0, 1.0]), 1.0)
    assert not still.any()
    far = part.noise().covariance(np.array([3.0, 4.0, 0.0, 0.0]), 1.0)
    assert (math.sqrt(far[0, 0]), math.sqrt(far[3, 3])) == pytest.approx((0.5, 1.0))


def test_trackers_know_of_a_target_s_noise_by_its_speed() -> None:
    noise = ControlNoisePart(speed_share=0.02, yaw_rate_per_mps=0.08)
    motion = target_motion("unicycle", ControlPart(speed_mps=0.25), noise, 1.0, 2.0)
    assert motion.noise_sigma == pytest.approx((0.005, 0.02))


@pytest.mark.parametrize(
    ("model", "targets", "words"),
    [
        ("unicycle", [("t1", "constant_velocity_3d")], "take 'planar_altitude'"),
        ("planar_altitude", [], "give one of .*'constant_velocity_3d'"),
        ("planar_altitude", [("t1", "unicycle")], "moves by a velocity"),
    ],
)
def test_who_cannot_fly_or_has_nobody_to_follow_does_not_encircle(
    model: str, targets: list[tuple[str, str]], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        PlanningPart(kind="encircle").check_model(model, targets)
    PlanningPart(kind="potential").check_model(model, targets)
    PlanningPart(kind="encircle").check_model("planar_altitude", [*targets, ("t2", "constant_velocity_3d")])
