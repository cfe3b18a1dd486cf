"""Parts of a message of the wire format: how numbers, beliefs and measurements are written, and read with every limit.

Functions `pack_*` raise ValueError for what breaks a rule, `read_*` raise WireError.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf

from network.messages import MAX_JOINT_DIM, NEVER, Array, Belief, Epoch, Measurement, Mount

MODEL_DIMS = {
    "unicycle": 3,
    "unicycle_gains": 5,
    "spatial": 4,
    "constant_velocity": 4,
    "damped_velocity": 4,
    "constant_velocity_3d": 6,
    "damped_velocity_3d": 6,
    "constant_acceleration": 6,
}
MEASUREMENT_DIMS = {"range": 1, "bearing": 1, "bearing3": 2, "range_bearing": 2, "vector": 2, "pixel": 2}

MAX_INT = 2**63 - 1
MAX_ABS = 1e9
"""Largest magnitude of any number of an estimate."""

SENSOR_FLOOR = 1e-10
"""Smallest variance [m^2, rad^2] a measurement may claim: 10 micrometres, 10 microradians."""

BELIEF_FLOOR = 1e-18
"""Smallest conditional variance of a belief that double precision still inverts."""

PART_FLOOR = 1e-9
"""How far below zero, relative to the largest variance, rounding may take a part of a split covariance."""

REASONS = (
    "malformed",
    "wrong_type",
    "out_of_range",
    "unknown_version",
    "unknown_kind",
    "unknown_model",
    "bad_id",
    "non_finite",
    "not_positive_definite",
    "below_sensor_floor",
    "oversize",
    "source_mismatch",
)
"""Every reason a `WireError` may carry; they are counter names and do not change."""

_ID = re.compile(r"[a-z0-9-]{1,24}").fullmatch
_TRIU = {n: np.triu_indices(n) for n in range(1, MAX_JOINT_DIM + 1)}


def _packed_index(n: int) -> NDArray[np.intp]:
    """(n, n) positions in the packed upper triangle."""
    index = np.zeros((n, n), dtype=np.intp)
    index[_TRIU[n]] = np.arange(n * (n + 1) // 2)
    return np.maximum(index, index.T)


FULL = {n: _packed_index(n) for n in _TRIU}


class WireError(Exception):
    """A message was refused; `reason` is one of `REASONS` and contains nothing of the message."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def valid_id(text: str) -> bool:
    """Whether `text` is a robot or target id, `[a-z0-9-]{1,24}`."""
    return _ID(text) is not None


def pack_epoch(epoch: Epoch) -> tuple[int, str, int]:
    return epoch.t_meas_ns, epoch.initiator, epoch.counter


def pack_array(array: Array, shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    values = np.asarray(array, dtype=dtype)
    if values.shape != shape:
        raise ValueError(f"array of shape {values.shape} where {shape} belongs")
    return values.tobytes()


def pack_single(array: Array | None, shape: tuple[int, ...]) -> bytes:
    """An array in single precision; nothing for None."""
    return b"" if array is None else pack_array(array, shape, "<f4")


def pack_cov(cov: Array, n: int, dtype: str = "<f8") -> bytes:
    values = np.asarray(cov, dtype=dtype)
    if values.shape != (n, n) or n not in _TRIU:
        raise ValueError(f"covariance of shape {values.shape} where {(n, n)} belongs")
    if np.abs(values - values.T).max() > 1e-6 * np.abs(values).max():
        raise ValueError("covariance is not symmetric")
    return values[_TRIU[n]].tobytes()


def pack_belief(belief: Belief) -> tuple[Any, ...]:
    n = len(belief.mean)
    return belief.model, n, pack_array(belief.mean, (n,)), pack_cov(belief.cov, n)


def pack_measurement(measurement: Measurement) -> tuple[Any, ...]:
    m = len(measurement.z)
    return (
        measurement.kind,
        m,
        pack_array(measurement.z, (m,)),
        pack_cov(measurement.R, m),
        pack_array(np.asarray(measurement.mount), (6,)),
    )


def read_fields(raw: Any, count: int) -> tuple[Any, ...]:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if len(raw) != count:
        raise WireError("malformed")
    return raw


def read_items(raw: Any, most: int) -> tuple[Any, ...]:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if len(raw) > most:
        raise WireError("out_of_range")
    return raw


def read_integer(raw: Any, most: int = MAX_INT) -> int:
    if type(raw) is not int:
        raise WireError("wrong_type")
    if not 0 <= raw <= most:
        raise WireError("out_of_range")
    return raw


def read_text(raw: Any) -> str:
    if type(raw) is not str:
        raise WireError("wrong_type")
    return raw


def read_id(raw: Any) -> str:
    if _ID(read_text(raw)) is None:
        raise WireError("bad_id")
    return str(raw)


def read_array(raw: Any, count: int) -> Array:
    """(count,) finite values of magnitude at most MAX_ABS."""
    if type(raw) is not bytes:
        raise WireError("wrong_type")
    if len(raw) != 8 * count:
        raise WireError("malformed")
    values: Array = np.frombuffer(raw, dtype="<f8")
    # One product bounds every element, and is NaN or infinite if one of them is.
    if not values.dot(values) <= MAX_ABS**2:
        _refuse_if_bad(values)
    return values


def read_single(raw: Any, *shape: int) -> Array:
    """Finite values of single precision and magnitude at most MAX_ABS."""
    if type(raw) is not bytes:
        raise WireError("wrong_type")
    if len(raw) != 4 * math.prod(shape):
        raise WireError("malformed")
    values = np.frombuffer(raw, dtype="<f4").astype(np.float64)
    if not values.dot(values) <= MAX_ABS**2:
        _refuse_if_bad(values)
    return values.reshape(shape)


def read_single_or_none(raw: Any, *shape: int) -> Array | None:
    """`read_single`, or None for no bytes at all."""
    return None if raw == b"" else read_single(raw, *shape)


def _refuse_if_bad(values: Array) -> None:
    if not np.isfinite(values).all():
        raise WireError("non_finite")
    if np.abs(values).max() > MAX_ABS:
        raise WireError("out_of_range")


def read_cov(raw: Any, n: int, floor: float, below: str) -> Array:
    """(n, n) symmetric positive definite matrix whose conditional variances are not below `floor`."""
    return checked_cov(read_array(raw, n * (n + 1) // 2), n, floor, below)


def checked_cov(packed: Array, n: int, floor: float, below: str) -> Array:
    """The matrix (n, n) of a packed upper triangle; see `read_cov`."""
    if n == 1:
        variance = packed[0]
        if variance < floor:
            raise WireError("not_positive_definite" if variance <= 0.0 else below)
        return packed.reshape(1, 1)
    cov: Array = packed[FULL[n]]
    root, info = dpotrf(cov, lower=1)
    if info != 0:
        raise WireError("not_positive_definite")
    if root.diagonal().min() ** 2 < floor:
        raise WireError(below)
    return cov


def read_noise(raw: Any, n: int) -> Array:
    """(n, n) symmetric matrix that is not negative; noise may be missing altogether."""
    cov: Array = read_array(raw, n * (n + 1) // 2)[FULL[n]]
    slack = PART_FLOOR * float(cov.diagonal().max()) + BELIEF_FLOOR
    if cov.diagonal().min() < 0.0 or dpotrf(cov + slack * np.eye(n), lower=1)[1] != 0:
        raise WireError("not_positive_definite")
    return cov


def read_epoch(raw: Any) -> Epoch:
    t_meas_ns, initiator, counter = read_fields(raw, 3)
    if read_text(initiator) == "":
        # Only the zero epoch has no initiator.
        if read_integer(t_meas_ns) or read_integer(counter):
            raise WireError("bad_id")
        return NEVER
    return Epoch(read_integer(t_meas_ns), read_id(initiator), read_integer(counter))


def read_contact(raw: Any) -> Epoch:
    """An epoch of a pair that has met."""
    epoch = read_epoch(raw)
    if not epoch.met:
        raise WireError("out_of_range")
    return epoch


def read_belief(raw: tuple[Any, ...]) -> Belief:
    model, n, mean, cov = read_fields(raw, 4)
    dim = read_dim(model)
    if read_integer(n) != dim:
        raise WireError("malformed")
    return Belief(model, read_array(mean, dim), read_cov(cov, dim, BELIEF_FLOOR, "not_positive_definite"))


def read_measurement(raw: Any) -> Measurement:
    kind, m, z, R, mount = read_fields(raw, 5)
    dim = MEASUREMENT_DIMS.get(read_text(kind))
    if dim is None:
        raise WireError("unknown_kind")
    if read_integer(m) != dim:
        raise WireError("malformed")
    cov = read_cov(R, dim, SENSOR_FLOOR, "below_sensor_floor")
    return Measurement(kind, read_array(z, dim), cov, read_mount(mount))


def read_mount(raw: Any) -> Mount:
    x, y, up, roll, pitch, yaw = read_array(raw, 6).tolist()
    return x, y, up, roll, pitch, yaw


def is_part(part: Array, whole: Array) -> bool:
    """Whether a symmetric matrix (n, n) is a part of a covariance: neither it nor what is left is negative."""
    slack = PART_FLOOR * float(whole.diagonal().max()) * np.eye(len(whole))
    return all(dpotrf(item + slack, lower=1)[1] == 0 for item in (part, whole - part))


def read_dim(model: Any) -> int:
    """Components of a state of `model`."""
    dim = MODEL_DIMS.get(read_text(model))
    if dim is None:
        raise WireError("unknown_model")
    return dim
