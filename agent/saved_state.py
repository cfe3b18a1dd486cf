"""What a robot keeps across starts: how often it has started, and its last estimate.

A start is a new life: a new boot id and a new incarnation, so peers forget what they were waiting for. From a saved
estimate the robot begins at the instant it is of, and coasts from there until odometry comes: it does not know how it
moved meanwhile. Peers may hold what the estimate was made of, and what was learnt after it was saved, hence

    split_joint, auto       the whole covariance counts as shared, correlated with everybody's in an unknown way
    safe, published, joint  the own covariance is doubled and so is that of peers (`agent.pairs`): blk(2 P_a, 2 P_b)
                            bounds the joint covariance whatever the correlation

Either is sound however old the estimate is. So no correlation factor is ever written down, nothing has to be on disk
before a message leaves, and a power cut costs accuracy alone.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import blake2b
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from agent.effects import Estimate, TrackEstimate
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.motion import STATES
from agent.settings import AgentSettings
from network.wire_fields import MAX_INT, valid_id

Array = NDArray[np.float64]

MAGIC = b"cofix state 1\n"
DIGEST_BYTES = 16
MAX_BYTES = 1_000_000
MAX_TRACKS = 256
MAX_INCARNATION = 2**53


class StateError(ValueError):
    """A saved state that cannot be used; `reason` names why and contains nothing of it."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        super().__init__(reason)


def encode(robot: str, incarnation: int, estimate: Estimate | None) -> bytes:
    """The bytes of a state file."""
    told: Any = None
    if estimate is not None:
        tracks = [[track.target, *_belief(track.model, track.mean, track.cov)] for track in estimate.tracks]
        told = [estimate.t_ns, *_belief(estimate.model, estimate.mean, estimate.cov), tracks]
    body: bytes = msgpack.packb([robot, incarnation, told])
    return MAGIC + blake2b(body, digest_size=DIGEST_BYTES).digest() + body


def _belief(model: str, mean: Array, cov: Array) -> list[Any]:
    return [model, np.asarray(mean, "<f8").tobytes(), np.asarray(cov, "<f8").tobytes()]


def decode(payload: bytes, robot: str) -> tuple[int, Estimate | None]:
    """(incarnation, estimate) of a state file of `robot`. Raises `StateError`.

    Reasons: `torn` (cut or too long), `other_version`, `corrupt`, `other_robot`, `malformed`.
    """
    if len(payload) > MAX_BYTES or len(payload) < len(MAGIC) + DIGEST_BYTES:
        raise StateError("torn")
    if not payload.startswith(MAGIC):
        raise StateError("other_version" if payload.startswith(b"cofix state ") else "corrupt")
    digest, body = payload[len(MAGIC) :][:DIGEST_BYTES], payload[len(MAGIC) + DIGEST_BYTES :]
    if blake2b(body, digest_size=DIGEST_BYTES).digest() != digest:
        raise StateError("corrupt")
    try:
        raw = msgpack.unpackb(body, use_list=True, max_map_len=0, max_ext_len=0)
    except (ValueError, TypeError, msgpack.UnpackException):
        raise StateError("malformed") from None
    name, incarnation, told = _fields(raw, 3)
    if name != robot:
        raise StateError("other_robot")
    if type(incarnation) is not int or not 1 <= incarnation < MAX_INCARNATION:
        raise StateError("malformed")
    return incarnation, None if told is None else _estimate(told)


def _fields(raw: Any, count: int) -> list[Any]:
    if type(raw) is not list or len(raw) != count:
        raise StateError("malformed")
    return raw


def _estimate(told: Any) -> Estimate:
    t_ns, model, mean, cov, raw_tracks = _fields(told, 5)
    if type(t_ns) is not int or not 0 <= t_ns <= MAX_INT or type(raw_tracks) is not list:
        raise StateError("malformed")
    if len(raw_tracks) > MAX_TRACKS:
        raise StateError("malformed")
    tracks = []
    for item in raw_tracks:
        target, *belief = _fields(item, 4)
        if type(target) is not str or not valid_id(target):
            raise StateError("malformed")
        tracks.append(TrackEstimate(target, *_checked(*belief)))
    return Estimate(t_ns, *_checked(model, mean, cov), tuple(tracks))


def _checked(model: Any, mean: Any, cov: Any) -> tuple[str, Array, Array]:
    layout = STATES.get(model) if type(model) is str else None
    if layout is None or type(mean) is not bytes or type(cov) is not bytes:
        raise StateError("malformed")
    n = layout.dim
    if len(mean) != 8 * n or len(cov) != 8 * n * n:
        raise StateError("malformed")
    x, P = np.frombuffer(mean, "<f8").copy(), np.frombuffer(cov, "<f8").reshape(n, n).copy()
    if not np.isfinite(x).all() or not is_positive_definite(P) or np.abs(P - P.T).max() > 1e-9 * np.abs(P).max():
        raise StateError("malformed")
    return layout.name, x, P


def usable(settings: AgentSettings, estimate: Estimate, now_ns: int, max_age_ns: int, ahead_ns: int = 0) -> None:
    """Raises `StateError` if a robot of these settings can't begin with an estimate: `other_model`, `too_old`,
    `from_future`."""
    if estimate.model != settings.layout.name:
        raise StateError("other_model")
    if estimate.t_ns > now_ns + ahead_ns:
        raise StateError("from_future")
    if now_ns - estimate.t_ns > max_age_ns:
        raise StateError("too_old")


def restarted(settings: AgentSettings, estimate: Estimate) -> AgentSettings:
    """The settings of a robot that goes on with a saved estimate, by the rules above; other targets have no prior.

    A `replica` starts as it is configured: what it knows follows from raw data, which it no longer has.
    """
    localization = settings.localization
    if localization.kind == "replica":
        return settings
    tracks = {track.target: track for track in estimate.tracks}
    factors = localization.form in ("safe", "published", "joint")
    inflation = 2.0 if factors else 1.0
    targets = []
    for target in settings.targets:
        track = tracks.get(target.id)
        if track is not None and track.model == target.motion.layout.name:
            targets.append(replace(target, mean=track.mean, cov=inflation * track.cov))
        else:
            targets.append(target if localization.form == "joint" else replace(target, mean=None))
    return replace(
        settings,
        source="survey",
        start_ns=estimate.t_ns,
        mean=estimate.mean,
        cov=inflation * estimate.cov,
        shared=None if factors else estimate.cov,
        found_out=True,
        targets=tuple(targets),
    )
