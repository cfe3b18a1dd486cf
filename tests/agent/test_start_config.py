"""Where a robot has its start from, in its file: what is needed for it, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config import load_agent_config
from tests.agent.test_config import complaint, example, write

POSITION, COMPASS = {"kind": "position"}, {"kind": "heading"}


def start(source: str, sensors: dict[str, Any], **change: Any) -> dict[str, Any]:
    return example(initial={"source": source}, sensors=sensors, **change)


@pytest.mark.parametrize(
    ("source", "sensors", "fixes"),
    [
        ("fix", {"gps": POSITION, "compass": COMPASS}, []),
        ("fix", {"gps": {"kind": "pose"}}, []),
        ("fix", {}, ["position", "heading"]),
        ("fix", {"compass": COMPASS}, ["position"]),
        ("peer", {"compass": COMPASS}, []),
        ("peer", {}, ["heading"]),
        ("peer", {"camera": {"kind": "bearing"}}, []),
    ],
)
def test_a_robot_may_find_out_where_it_is(
    tmp_path: Path, source: str, sensors: dict[str, Any], fixes: list[str]
) -> None:
    mavlink = {"endpoint": "udpin:127.0.0.1:14550", "simulated": True, "fixes": fixes}
    settings = load_agent_config(write(tmp_path, start(source, sensors, mavlink=mavlink))).settings(0)
    assert settings.source == source
    assert not settings.mean.any() and not settings.cov.any()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (start("fix", {"gps": POSITION}), ["initial.source = 'fix'", "nothing gives a heading fix"]),
        (start("fix", {"compass": COMPASS}), ["nothing gives a position fix", "'position' in mavlink.fixes"]),
        (start("fix", {}), ["a position fix", "nor a heading fix"]),
        (start("fix", {"camera": {"kind": "range_bearing"}}), ["a position fix", "nor a heading fix"]),
        (start("peer", {"uwb": {"kind": "range"}}), ["initial.source = 'peer'", "or a sensor of peers"]),
        (
            start("fix", {"gps": {"kind": "pose"}}, motion={"model": "planar_altitude"}),
            ["nothing gives an altitude fix", "'altitude' in mavlink.fixes"],
        ),
        (
            start("fix", {"gps": {"kind": "pose"}}, localization={"form": "joint"}),
            ["initial.source = 'fix'", "form = 'joint'", "take form = 'split_joint'"],
        ),
        (
            start("fix", {"gps": {"kind": "pose"}}, motion={"model": "unicycle_gains"}),
            ["initial.start_sigma.gain_along is missing"],
        ),
        (example(initial={"source": "survey"}), ["initial.mean is missing", "source = 'fix' or 'peer'"]),
        (
            example(initial={"source": "peer", "mean": [0.0, 0.0, 0.0]}),
            ["initial.mean is not used with source = 'peer'", "remove it"],
        ),
        (example(initial={"mean": [0.0, 0.0, 0.0]}), ["initial.start_sigma.position_m is missing"]),
        (example(initial={"source": "guess"}), ["'initial.source' = 'guess'", "'survey', 'fix' or 'peer'"]),
    ],
)
def test_a_start_nothing_can_tell_is_refused(tmp_path: Path, data: dict[str, Any], words: list[str]) -> None:
    line = complaint(tmp_path, data)
    for word in words:
        assert word in line


def test_an_altitude_that_is_held_needs_no_fix(tmp_path: Path) -> None:
    motion = {"model": "quadrotor", "altitude_m": 5.0, "altitude_sigma_m": 0.2}
    assert load_agent_config(write(tmp_path, start("fix", {"gps": {"kind": "pose"}}, motion=motion)))


def test_gains_of_an_odometry_start_at_one_all_the_same(tmp_path: Path) -> None:
    initial = {"source": "fix", "start_sigma": {"gain_along": 0.1, "gain_turn": 0.2}}
    data = example(initial=initial, sensors={"gps": {"kind": "pose"}}, motion={"model": "unicycle_gains"})
    settings = load_agent_config(write(tmp_path, data)).settings(0)
    np.testing.assert_array_equal(settings.mean, [0.0, 0.0, 0.0, 1.0, 1.0])
    np.testing.assert_allclose(settings.cov, np.diag([0.0, 0.0, 0.0, 0.01, 0.04]))


def test_the_joint_form_starts_and_ends_no_tracks(tmp_path: Path) -> None:
    target = {"id": "t1", "model": "constant_velocity", "start_sigma": {"velocity_mps": 0.5}}
    joint = {"form": "joint"}
    line = complaint(tmp_path, example(localization=joint, targets=[target]))
    assert "target 't1' has no prior" in line and "form = 'split_joint'" in line
    ending = example(localization=joint, tracking={"end_after_s": 9})
    assert "remove tracking.end_after_s" in complaint(tmp_path, ending)
    assert load_agent_config(write(tmp_path, example(localization=joint)))
    assert load_agent_config(write(tmp_path, example(targets=[target], tracking={"end_after_s": 9})))
