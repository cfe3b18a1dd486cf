"""Whether a robot and its targets fit into the messages of the form `joint`; see `agent.joint_factors`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.config_file import ConfigError
from agent.estimation.motion import StateLayout
from agent.factor_model import LONGEST
from network.messages import MAX_GROUP, MAX_MESSAGE_BYTES, JointSnapshot, Measurement, PairRequest
from network.wire import size_bound

LONGEST_GROUP = frozenset(letter * 24 for letter in "abcdefgh"[:MAX_GROUP])


def has_room(robot: StateLayout, targets: Sequence[tuple[str, StateLayout]]) -> bool:
    """Whether a contact with a robot alike can be opened, with targets (id, layout).

    Mean, covariance, factor and line of robot and targets, and one measurement of two numbers must be told.
    """
    n = _components(robot, targets)
    models = tuple((name, layout.name) for name, layout in targets)
    told = JointSnapshot(
        robot.name, models, np.zeros(n), np.eye(n), LONGEST, np.zeros((n, n)), np.eye(n), group=LONGEST_GROUP
    )
    measurement = Measurement("range_bearing", np.zeros(2), np.eye(2))
    try:
        return size_bound(PairRequest(LONGEST, (measurement,), told)) <= MAX_MESSAGE_BYTES
    except ValueError:
        # More components than the wire format knows of.
        return False


def check_room(robot: StateLayout, targets: Sequence[tuple[str, StateLayout]]) -> None:
    """Raises `ConfigError` if there is no room."""
    if not has_room(robot, targets):
        raise ConfigError(
            f"form = 'joint' tells robot and targets in one message, and {_components(robot, targets)} components are "
            "too many; take form = 'split_joint', or fewer or simpler targets"
        )


def _components(robot: StateLayout, targets: Sequence[tuple[str, StateLayout]]) -> int:
    return robot.dim + sum(layout.dim for _, layout in targets)
