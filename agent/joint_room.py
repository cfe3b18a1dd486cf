"""Whether a robot and its targets fit into the messages of the form `joint`; see `agent.joint_factors`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.config_file import ConfigError
from agent.estimation.motion import StateLayout
from agent.factor_model import LONGEST
from network.messages import MAX_MESSAGE_BYTES, JointSnapshot, Measurement, PairRequest
from network.wire import size_bound


def check_room(robot: StateLayout, targets: Sequence[tuple[str, StateLayout]]) -> None:
    """Raises `ConfigError` if a contact with a robot alike could not be opened: what must be told of it is too long.

    That is mean, covariance, factor and line of robot and targets (id, layout), and one measurement of two numbers.
    """
    n = robot.dim + sum(layout.dim for _, layout in targets)
    models = tuple((name, layout.name) for name, layout in targets)
    told = JointSnapshot(robot.name, models, np.zeros(n), np.eye(n), LONGEST, np.zeros((n, n)), np.eye(n))
    measurement = Measurement("range_bearing", np.zeros(2), np.eye(2))
    try:
        fits = size_bound(PairRequest(LONGEST, (measurement,), told)) <= MAX_MESSAGE_BYTES
    except ValueError:
        # More components than the wire format knows of.
        fits = False
    if not fits:
        raise ConfigError(
            f"form = 'joint' tells robot and targets in one message, and {n} components are too many; "
            "take form = 'split_joint', or fewer or simpler targets"
        )
