"""How many targets the form `joint` has room for: what is refused could not have been told."""

from __future__ import annotations

import pytest

from agent.config_file import ConfigError
from agent.estimation.motion import CONSTANT_VELOCITY, CONSTANT_VELOCITY_3D, SPATIAL, UNICYCLE, StateLayout
from agent.joint_room import check_room


@pytest.mark.parametrize(
    ("robot", "targets"),
    [
        (UNICYCLE, []),
        (UNICYCLE, [CONSTANT_VELOCITY]),
        (UNICYCLE, [UNICYCLE]),
        (SPATIAL, [SPATIAL]),
        (SPATIAL, [CONSTANT_VELOCITY]),
    ],
)
def test_a_robot_and_a_target_fit(robot: StateLayout, targets: list[StateLayout]) -> None:
    check_room(robot, [(f"t{k}", layout) for k, layout in enumerate(targets)])


@pytest.mark.parametrize(
    ("robot", "targets"),
    [(UNICYCLE, [CONSTANT_VELOCITY] * 2), (SPATIAL, [CONSTANT_VELOCITY_3D]), (UNICYCLE, [CONSTANT_VELOCITY] * 8)],
)
def test_what_does_not_fit_is_refused_with_the_remedy(robot: StateLayout, targets: list[StateLayout]) -> None:
    with pytest.raises(ConfigError, match="take form = 'split_joint', or fewer or simpler targets"):
        check_room(robot, [(f"t{k}", layout) for k, layout in enumerate(targets)])
