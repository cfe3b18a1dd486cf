"""Fields of a saved state, read with every limit: what is wrong raises `StateError`, plain fields `WireError`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gaussian import is_positive_definite
from agent.settings import AgentSettings
from network.peers import MAX_PEERS
from network.wire_fields import MAX_INT, read_array, read_fields, read_id, read_items, read_text

Array = NDArray[np.float64]

MAX_TRACKS = 256
ASYMMETRY = 1e-9
"""Rounding, relative to the largest element, by which a covariance may be asymmetric."""


class StateError(ValueError):
    """A saved state that cannot be used; `reason` names why and contains nothing of it.

    Of a file: `torn`, `corrupt` (checksum), `unreadable`. Of its content: `other_version`, `other_robot`, `other_form`,
    `other_model`, `inconsistent`, and the reasons of `network.wire_fields.WireError`. Of its instant: `too_old`,
    `from_future`, `earlier_run`.
    """

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(reason)


def read_many(raw: Any) -> tuple[Any, ...]:
    """Of everything that may be kept of each peer."""
    return read_items(raw, 64 * MAX_PEERS)


def read_by_id(raw: Any, count: int, read: Callable[[tuple[Any, ...]], Any], most: int = MAX_PEERS) -> dict[str, Any]:
    """What is told of each robot or target by `count` fields."""
    found = {}
    for item in read_items(raw, most):
        name, *fields = read_fields(item, count + 1)
        if read_id(name) in found:
            raise StateError("inconsistent")
        found[name] = read(tuple(fields))
    return found


def read_targets(settings: AgentSettings, raw: Any, read: Callable[..., Any]) -> dict[str, Any]:
    """Beliefs of targets (id, model, mean, cov, and two fields more); `read` is given mean, cov and these fields."""
    found = read_by_id(raw, 5, lambda fields: fields, MAX_TRACKS)
    for name, (model, mean, cov, *rest) in found.items():
        dim = read_dim(settings, name, model)
        found[name] = read(read_array(mean, dim).copy(), read_cov(cov, dim), rest)
    return found


def read_dim(settings: AgentSettings, target: Any, model: Any) -> int:
    """Components of a target's track. Raises `StateError` if the settings have no such target."""
    motion = next((item.motion for item in settings.tracked if item.id == target), None)
    if motion is None or motion.layout.name != read_text(model):
        raise StateError("other_model")
    return motion.layout.dim


def read_cov(raw: Any, n: int) -> Array:
    """A covariance (n, n)."""
    P = read_array(raw, n * n).reshape(n, n).copy()
    if np.abs(P - P.T).max() > ASYMMETRY * np.abs(P).max() or not is_positive_definite(P):
        raise StateError("not_positive_definite")
    return P


def read_stamp(raw: Any) -> int:
    """An instant [ns], which may lie before the epoch."""
    if type(raw) is not int:
        raise StateError("wrong_type")
    if abs(raw) > MAX_INT:
        raise StateError("out_of_range")
    return raw


def read_flag(raw: Any) -> bool:
    """True or false."""
    if type(raw) is not bool:
        raise StateError("wrong_type")
    return raw


def read_amount(raw: Any) -> float:
    """A finite number that is not negative."""
    if type(raw) is not float:
        raise StateError("wrong_type")
    if not 0.0 <= raw <= MAX_INT:
        raise StateError("out_of_range")
    return raw
