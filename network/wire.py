"""Wire format, version 1: a message is `[header, kind, body]` in msgpack, at most 1,200 bytes.

Header: `[schema, source, boot_id, incarnation, seq, t_meas_ns, t_send_ns]`. Numbers of an estimate travel as
little-endian float64 bytes next to their dimension, row by row; covariances as their upper triangle, row by
row. Everything is validated before a value is handed on: a decoded message satisfies every limit stated here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from network.messages import (
    MAX_ECHOES,
    MAX_JOINT_DIM,
    MAX_LINES,
    MAX_MEASUREMENTS,
    MAX_MESSAGE_BYTES,
    MAX_STATE_DIM,
    MAX_TARGETS,
    NEVER,
    SCHEMA,
    Array,
    Belief,
    Body,
    ClockEcho,
    Epoch,
    Header,
    Hello,
    Line,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
    SplitReply,
    SplitRequest,
    SplitSnapshot,
    TargetBelief,
)

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

_HELLO, _PAIR_REQUEST, _PAIR_REPLY, _SPLIT_REQUEST, _SPLIT_REPLY = 1, 2, 3, 4, 5
_HEADER_BYTES = 3 + 25 + 5 * 9 + 1
"""Upper bound of what surrounds a body: array marks, schema, longest source, five integers, kind."""

_ID = re.compile(r"[a-z0-9-]{1,24}").fullmatch
_SOFTWARE = re.compile(r"[A-Za-z0-9.+_-]{0,48}").fullmatch
_LIMITS: dict[str, Any] = {
    "use_list": False,
    "strict_map_key": True,
    "max_str_len": 48,
    "max_bin_len": 4 * MAX_JOINT_DIM * (MAX_JOINT_DIM + 1),
    "max_array_len": MAX_ECHOES,
    "max_map_len": 0,
    "max_ext_len": 0,
}
_TRIU = {n: np.triu_indices(n) for n in range(1, MAX_JOINT_DIM + 1)}


def _packed_index(n: int) -> NDArray[np.intp]:
    """(n, n) positions in the packed upper triangle."""
    index = np.zeros((n, n), dtype=np.intp)
    index[_TRIU[n]] = np.arange(n * (n + 1) // 2)
    return np.maximum(index, index.T)


_FULL = {n: _packed_index(n) for n in _TRIU}


class WireError(Exception):
    """A message was refused; `reason` is one of `REASONS` and contains nothing of the message."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class OversizeError(ValueError):
    """An own message is longer than one datagram; leave out identity lines or targets."""


def valid_id(text: str) -> bool:
    """Whether `text` is a robot or target id, `[a-z0-9-]{1,24}`."""
    return _ID(text) is not None


# --- encoding ---------------------------------------------------------------------------------------------


def encode(header: Header, body: Body) -> bytes:
    """The message as bytes, checked by the rules a receiver applies.

    Raises OversizeError (longer than MAX_MESSAGE_BYTES) or ValueError naming the rule a field breaks.
    """
    head = (
        header.schema,
        header.source,
        header.boot_id,
        header.incarnation,
        header.seq,
        header.t_meas_ns,
        header.t_send_ns,
    )
    try:
        kind, content = _pack_body(body)
        payload: bytes = msgpack.packb((head, kind, content))
    except (TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"message cannot be packed: {error}") from error
    if len(payload) > MAX_MESSAGE_BYTES:
        raise OversizeError(
            f"{type(body).__name__} takes {len(payload)} of {MAX_MESSAGE_BYTES} bytes: "
            "leave out identity lines or targets"
        )
    try:
        decode(payload, header.source)
    except WireError as error:
        raise ValueError(f"{type(body).__name__} breaks the wire format: {error.reason}") from error
    return payload


def size_bound(body: Body) -> int:
    """Upper bound of the encoded message's bytes, whatever its header; to choose what to leave out."""
    return _HEADER_BYTES + len(msgpack.packb(_pack_body(body)[1]))


def _pack_body(body: Body) -> tuple[int, tuple[Any, ...]]:
    if isinstance(body, Hello):
        echoes = tuple((echo.peer, echo.t1_ns, echo.t2_ns) for echo in body.echoes)
        return _HELLO, (body.software, echoes)
    if isinstance(body, PairRequest):
        measurements = tuple(_pack_measurement(m) for m in body.measurements)
        return _PAIR_REQUEST, (_pack_epoch(body.epoch), measurements, _pack_snapshot(body.snapshot))
    if isinstance(body, PairReply):
        snapshot = None if body.snapshot is None else _pack_snapshot(body.snapshot)
        return _PAIR_REPLY, (_pack_epoch(body.epoch), int(body.status), snapshot)
    if isinstance(body, SplitRequest):
        measurements = tuple(_pack_measurement(m) for m in body.measurements)
        return _SPLIT_REQUEST, (_pack_epoch(body.epoch), measurements, _pack_split(body.snapshot))
    if isinstance(body, SplitReply):
        return _SPLIT_REPLY, (_pack_epoch(body.epoch), _pack_split(body.snapshot))
    raise TypeError(f"{type(body).__name__} is not a message body")


def _pack_epoch(epoch: Epoch) -> tuple[int, str, int]:
    return epoch.t_meas_ns, epoch.initiator, epoch.counter


def _pack_array(array: Array, shape: tuple[int, ...]) -> bytes:
    values = np.asarray(array, dtype="<f8")
    if values.shape != shape:
        raise ValueError(f"array of shape {values.shape} where {shape} belongs")
    return values.tobytes()


def _pack_cov(cov: Array, n: int) -> bytes:
    values = np.asarray(cov, dtype="<f8")
    if values.shape != (n, n) or n not in _TRIU:
        raise ValueError(f"covariance of shape {values.shape} where {(n, n)} belongs")
    if np.abs(values - values.T).max() > 1e-6 * np.abs(values).max():
        raise ValueError("covariance is not symmetric")
    return values[_TRIU[n]].tobytes()


def _pack_belief(belief: Belief) -> tuple[Any, ...]:
    n = len(belief.mean)
    return belief.model, n, _pack_array(belief.mean, (n,)), _pack_cov(belief.cov, n)


def _pack_measurement(measurement: Measurement) -> tuple[Any, ...]:
    m = len(measurement.z)
    return (
        measurement.kind,
        m,
        _pack_array(measurement.z, (m,)),
        _pack_cov(measurement.R, m),
        _pack_array(np.asarray(measurement.mount), (6,)),
    )


def _pack_snapshot(snapshot: Snapshot) -> tuple[Any, ...]:
    n = len(snapshot.belief.mean)
    columns = snapshot.factor.shape[-1]
    return (
        _pack_belief(snapshot.belief),
        _pack_epoch(snapshot.base),
        columns,
        _pack_array(snapshot.factor, (n, columns)),
        _pack_array(snapshot.line, (n, n)),
        tuple((_pack_epoch(line.epoch), _pack_array(line.matrix, (n, n))) for line in snapshot.lines),
        tuple((target.target, *_pack_belief(target.belief)) for target in snapshot.targets),
        snapshot.known,
    )


def _pack_split(snapshot: SplitSnapshot) -> tuple[Any, ...]:
    n = len(snapshot.mean)
    private = None if snapshot.private is None else _pack_cov(snapshot.private, n)
    return snapshot.model, snapshot.targets, _pack_array(snapshot.mean, (n,)), _pack_cov(snapshot.cov, n), private


# --- decoding ---------------------------------------------------------------------------------------------


def decode(payload: bytes, source: str) -> Message:
    """The message in `payload`, received under the key of robot `source`.

    Raises WireError on anything that is not exactly a valid message; no other exception leaves it.
    Arrays of the result are read-only where they alias the payload.
    """
    if len(payload) > MAX_MESSAGE_BYTES:
        raise WireError("oversize")
    try:
        raw = msgpack.unpackb(payload, **_LIMITS)
    except (ValueError, TypeError, msgpack.UnpackException):
        raise WireError("malformed") from None
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if not raw:
        raise WireError("malformed")
    header = _header(raw[0])
    if len(raw) != 3:
        raise WireError("malformed")
    if header.source != source:
        raise WireError("source_mismatch")
    kind, content = raw[1], raw[2]
    if type(kind) is not int:
        raise WireError("wrong_type")
    body_of = _BODIES.get(kind)
    if body_of is None:
        raise WireError("unknown_kind")
    with np.errstate(over="ignore", invalid="ignore"):
        return Message(header, body_of(content, header))


def peek_header(payload: bytes) -> Header | None:
    """The header alone, or None if there is no valid one; the body is neither read nor checked."""
    if len(payload) > MAX_MESSAGE_BYTES:
        return None
    unpacker = msgpack.Unpacker(max_buffer_size=MAX_MESSAGE_BYTES, **_LIMITS)
    unpacker.feed(payload)
    try:
        return _header(unpacker.unpack()) if unpacker.read_array_header() == 3 else None
    except (ValueError, TypeError, msgpack.UnpackException, WireError):
        return None


def _fields(raw: Any, count: int) -> tuple[Any, ...]:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if len(raw) != count:
        raise WireError("malformed")
    return raw


def _items(raw: Any, most: int) -> tuple[Any, ...]:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if len(raw) > most:
        raise WireError("out_of_range")
    return raw


def _integer(raw: Any, most: int = MAX_INT) -> int:
    if type(raw) is not int:
        raise WireError("wrong_type")
    if not 0 <= raw <= most:
        raise WireError("out_of_range")
    return raw


def _text(raw: Any) -> str:
    if type(raw) is not str:
        raise WireError("wrong_type")
    return raw


def _identifier(raw: Any) -> str:
    if _ID(_text(raw)) is None:
        raise WireError("bad_id")
    return str(raw)


def _header(raw: Any) -> Header:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if not raw:
        raise WireError("malformed")
    if _integer(raw[0]) != SCHEMA:
        raise WireError("unknown_version")
    _, source, boot_id, incarnation, seq, t_meas_ns, t_send_ns = _fields(raw, 7)
    return Header(
        _identifier(source),
        _integer(boot_id),
        _integer(incarnation),
        _integer(seq),
        _integer(t_meas_ns),
        _integer(t_send_ns),
    )


def _array(raw: Any, count: int) -> Array:
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


def _refuse_if_bad(values: Array) -> None:
    if not np.isfinite(values).all():
        raise WireError("non_finite")
    if np.abs(values).max() > MAX_ABS:
        raise WireError("out_of_range")


def _cov(raw: Any, n: int, floor: float, below: str) -> Array:
    """(n, n) symmetric positive definite matrix whose conditional variances are not below `floor`."""
    packed = _array(raw, n * (n + 1) // 2)
    if n == 1:
        variance = packed[0]
        if variance < floor:
            raise WireError("not_positive_definite" if variance <= 0.0 else below)
        return packed.reshape(1, 1)
    cov: Array = packed[_FULL[n]]
    try:
        root = np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        raise WireError("not_positive_definite") from None
    if root.diagonal().min() ** 2 < floor:
        raise WireError(below)
    return cov


def _epoch(raw: Any) -> Epoch:
    t_meas_ns, initiator, counter = _fields(raw, 3)
    if _text(initiator) == "":
        # Only the zero epoch has no initiator.
        if _integer(t_meas_ns) or _integer(counter):
            raise WireError("bad_id")
        return NEVER
    return Epoch(_integer(t_meas_ns), _identifier(initiator), _integer(counter))


def _contact(raw: Any) -> Epoch:
    epoch = _epoch(raw)
    if not epoch.met:
        raise WireError("out_of_range")
    return epoch


def _belief(raw: tuple[Any, ...]) -> Belief:
    model, n, mean, cov = _fields(raw, 4)
    dim = MODEL_DIMS.get(_text(model))
    if dim is None:
        raise WireError("unknown_model")
    if _integer(n) != dim:
        raise WireError("malformed")
    return Belief(model, _array(mean, dim), _cov(cov, dim, BELIEF_FLOOR, "not_positive_definite"))


def _measurement(raw: Any) -> Measurement:
    kind, m, z, R, mount = _fields(raw, 5)
    dim = MEASUREMENT_DIMS.get(_text(kind))
    if dim is None:
        raise WireError("unknown_kind")
    if _integer(m) != dim:
        raise WireError("malformed")
    x, y, up, roll, pitch, yaw = _array(mount, 6).tolist()
    cov = _cov(R, dim, SENSOR_FLOOR, "below_sensor_floor")
    return Measurement(kind, _array(z, dim), cov, (x, y, up, roll, pitch, yaw))


def _line(raw: Any, n: int) -> Line:
    epoch, matrix = _fields(raw, 2)
    return Line(_contact(epoch), _array(matrix, n * n).reshape(n, n))


def _target(raw: Any) -> TargetBelief:
    fields = _fields(raw, 5)
    return TargetBelief(_identifier(fields[0]), _belief(fields[1:]))


def _snapshot(raw: Any) -> Snapshot:
    belief_raw, base, columns, factor, line, lines_raw, targets_raw, known = _fields(raw, 8)
    belief = _belief(belief_raw)
    n = len(belief.mean)
    m = _integer(columns, MAX_STATE_DIM)
    lines = tuple(_line(item, n) for item in _items(lines_raw, MAX_LINES))
    if any(later.epoch <= earlier.epoch for earlier, later in pairwise(lines)):
        raise WireError("malformed")
    targets = tuple(_target(item) for item in _items(targets_raw, MAX_TARGETS))
    if len({target.target for target in targets}) != len(targets):
        raise WireError("malformed")
    if type(known) is not bool:
        raise WireError("wrong_type")
    return Snapshot(
        belief=belief,
        base=_epoch(base),
        factor=_array(factor, n * m).reshape(n, m),
        line=_array(line, n * n).reshape(n, n),
        lines=lines,
        targets=targets,
        known=known,
    )


def _hello(raw: Any, header: Header) -> Hello:
    software, echoes_raw = _fields(raw, 2)
    if _SOFTWARE(_text(software)) is None:
        raise WireError("bad_id")
    echoes = []
    for item in _items(echoes_raw, MAX_ECHOES):
        peer, t1_ns, t2_ns = _fields(item, 3)
        echoes.append(ClockEcho(_identifier(peer), _integer(t1_ns), _integer(t2_ns)))
    if any(later.peer <= earlier.peer for earlier, later in pairwise(echoes)):
        raise WireError("malformed")
    return Hello(software, tuple(echoes))


def _pair_request(raw: Any, header: Header) -> PairRequest:
    epoch_raw, measurements_raw, snapshot = _fields(raw, 3)
    epoch = _contact(epoch_raw)
    if epoch.initiator != header.source:
        raise WireError("source_mismatch")
    measurements = tuple(_measurement(item) for item in _items(measurements_raw, MAX_MEASUREMENTS))
    if not measurements:
        raise WireError("malformed")
    return PairRequest(epoch, measurements, _snapshot(snapshot))


def _pair_reply(raw: Any, header: Header) -> PairReply:
    epoch, status_raw, snapshot_raw = _fields(raw, 3)
    status = _integer(status_raw)
    if status not in _STATUSES:
        raise WireError("out_of_range")
    if (snapshot_raw is not None) != (status == ReplyStatus.OK):
        raise WireError("malformed")
    snapshot = None if snapshot_raw is None else _snapshot(snapshot_raw)
    return PairReply(_contact(epoch), ReplyStatus(status), snapshot)


def _dim(model: Any) -> int:
    dim = MODEL_DIMS.get(_text(model))
    if dim is None:
        raise WireError("unknown_model")
    return dim


def _split(raw: Any) -> SplitSnapshot:
    model, targets_raw, mean, cov_raw, private_raw = _fields(raw, 5)
    targets = []
    for item in _items(targets_raw, MAX_TARGETS):
        name, target_model = _fields(item, 2)
        targets.append((_identifier(name), _text(target_model)))
    if len({name for name, _ in targets}) != len(targets):
        raise WireError("malformed")
    n = _dim(model) + sum(_dim(target_model) for _, target_model in targets)
    if n > MAX_JOINT_DIM:
        raise WireError("out_of_range")
    cov = _cov(cov_raw, n, BELIEF_FLOOR, "not_positive_definite")
    private = None
    if private_raw is not None:
        private = _array(private_raw, n * (n + 1) // 2)[_FULL[n]]
        # Neither part may be negative: what is private is within the whole, and what is left is shared.
        floor = -PART_FLOOR * cov.diagonal().max()
        if np.linalg.eigvalsh(private)[0] < floor or np.linalg.eigvalsh(cov - private)[0] < floor:
            raise WireError("not_positive_definite")
    return SplitSnapshot(model, tuple(targets), _array(mean, n), cov, private)


def _split_request(raw: Any, header: Header) -> SplitRequest:
    epoch_raw, measurements_raw, snapshot = _fields(raw, 3)
    epoch = _contact(epoch_raw)
    if epoch.initiator != header.source:
        raise WireError("source_mismatch")
    measurements = tuple(_measurement(item) for item in _items(measurements_raw, MAX_MEASUREMENTS))
    if not measurements:
        raise WireError("malformed")
    return SplitRequest(epoch, measurements, _split(snapshot))


def _split_reply(raw: Any, header: Header) -> SplitReply:
    epoch, snapshot = _fields(raw, 2)
    return SplitReply(_contact(epoch), _split(snapshot))


_STATUSES = frozenset(int(status) for status in ReplyStatus)
_BODIES: dict[int, Callable[[Any, Header], Body]] = {
    _HELLO: _hello,
    _PAIR_REQUEST: _pair_request,
    _PAIR_REPLY: _pair_reply,
    _SPLIT_REQUEST: _split_request,
    _SPLIT_REPLY: _split_reply,
}
