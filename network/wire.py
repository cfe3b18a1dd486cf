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

from network.bearing_messages import BearingReport
from network.leader_messages import LeaderReport, LeaderRequest
from network.life_messages import MAX_ECHOES, ClockEcho, Hello, LifeNotice
from network.messages import (
    MAX_JOINT_DIM,
    MAX_MEASUREMENTS,
    MAX_MESSAGE_BYTES,
    SCHEMA,
    Body,
    Epoch,
    Header,
    JointSnapshot,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
    RoundReport,
    SplitReply,
    SplitRequest,
    StartRequest,
    TeamReport,
)
from network.relative_messages import HypothesesReport, MotionReport
from network.wire_bearings import pack_bearings, read_bearings
from network.wire_fields import (
    WireError,
    pack_epoch,
    pack_measurement,
    read_contact,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_measurement,
    read_text,
)
from network.wire_leader import pack_request, pack_word, read_request, read_word
from network.wire_relative import pack_hypotheses, pack_motion, read_hypotheses, read_motion
from network.wire_round import pack_round, read_round
from network.wire_snapshots import (
    pack_joint,
    pack_snapshot,
    pack_split,
    read_joint,
    read_snapshot,
    read_split,
)
from network.wire_team import pack_report, read_report

_HELLO, _PAIR_REQUEST, _PAIR_REPLY, _SPLIT_REQUEST, _SPLIT_REPLY, _TEAM_REPORT = 1, 2, 3, 4, 5, 6
_JOINT_REQUEST, _JOINT_REPLY, _START_REQUEST, _LIFE_NOTICE, _ROUND_REPORT = 7, 8, 9, 10, 11
_BEARING_REPORT, _MOTION_REPORT, _HYPOTHESES_REPORT = 12, 13, 14
_LEADER_REQUEST, _LEADER_REPORT = 15, 16
_HEADER_BYTES = 3 + 25 + 5 * 9 + 1
"""Upper bound of what surrounds a body: array marks, schema, longest source, five integers, kind."""

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


class OversizeError(ValueError):
    """An own message is longer than one datagram; leave out identity lines or targets."""


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
        measurements = tuple(pack_measurement(m) for m in body.measurements)
        epoch = pack_epoch(body.epoch)
        if isinstance(body.snapshot, JointSnapshot):
            return _JOINT_REQUEST, (epoch, measurements, pack_joint(body.snapshot))
        return _PAIR_REQUEST, (epoch, measurements, pack_snapshot(body.snapshot))
    if isinstance(body, PairReply):
        if isinstance(body.snapshot, JointSnapshot):
            return _JOINT_REPLY, (pack_epoch(body.epoch), pack_joint(body.snapshot))
        snapshot = None if body.snapshot is None else pack_snapshot(body.snapshot)
        return _PAIR_REPLY, (pack_epoch(body.epoch), int(body.status), snapshot)
    if isinstance(body, SplitRequest):
        measurements = tuple(pack_measurement(m) for m in body.measurements)
        return _SPLIT_REQUEST, (pack_epoch(body.epoch), measurements, pack_split(body.snapshot))
    if isinstance(body, SplitReply):
        return _SPLIT_REPLY, (pack_epoch(body.epoch), pack_split(body.snapshot))
    if isinstance(body, TeamReport):
        return _TEAM_REPORT, pack_report(body)
    if isinstance(body, RoundReport):
        return _ROUND_REPORT, pack_round(body)
    if isinstance(body, BearingReport):
        return _BEARING_REPORT, pack_bearings(body)
    if isinstance(body, LeaderRequest):
        return _LEADER_REQUEST, pack_request(body)
    if isinstance(body, LeaderReport):
        return _LEADER_REPORT, pack_word(body)
    if isinstance(body, MotionReport):
        return _MOTION_REPORT, pack_motion(body)
    if isinstance(body, HypothesesReport):
        return _HYPOTHESES_REPORT, pack_hypotheses(body)
    if isinstance(body, StartRequest):
        return _START_REQUEST, (pack_epoch(body.epoch),)
    if isinstance(body, LifeNotice):
        return _LIFE_NOTICE, (body.boot_id, body.incarnation, body.over)
    raise TypeError(f"{type(body).__name__} is not a message body")


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


def _header(raw: Any) -> Header:
    if type(raw) is not tuple:
        raise WireError("wrong_type")
    if not raw:
        raise WireError("malformed")
    if read_integer(raw[0]) != SCHEMA:
        raise WireError("unknown_version")
    _, source, boot_id, incarnation, seq, t_meas_ns, t_send_ns = read_fields(raw, 7)
    return Header(
        read_id(source),
        read_integer(boot_id),
        read_integer(incarnation),
        read_integer(seq),
        read_integer(t_meas_ns),
        read_integer(t_send_ns),
    )


def _hello(raw: Any, header: Header) -> Hello:
    software, echoes_raw = read_fields(raw, 2)
    if _SOFTWARE(read_text(software)) is None:
        raise WireError("bad_id")
    echoes = []
    for item in read_items(echoes_raw, MAX_ECHOES):
        peer, t1_ns, t2_ns = read_fields(item, 3)
        echoes.append(ClockEcho(read_id(peer), read_integer(t1_ns), read_integer(t2_ns)))
    if any(later.peer <= earlier.peer for earlier, later in pairwise(echoes)):
        raise WireError("malformed")
    return Hello(software, tuple(echoes))


def _opened(raw: Any, header: Header) -> tuple[Epoch, tuple[Measurement, ...], Any]:
    """Epoch, measurements and the unread snapshot of a request."""
    epoch_raw, measurements_raw, snapshot = read_fields(raw, 3)
    epoch = read_contact(epoch_raw)
    if epoch.initiator != header.source:
        raise WireError("source_mismatch")
    measurements = tuple(read_measurement(item) for item in read_items(measurements_raw, MAX_MEASUREMENTS))
    if not measurements:
        raise WireError("malformed")
    return epoch, measurements, snapshot


def _pair_request(raw: Any, header: Header) -> PairRequest:
    epoch, measurements, snapshot = _opened(raw, header)
    return PairRequest(epoch, measurements, read_snapshot(snapshot))


def _pair_reply(raw: Any, header: Header) -> PairReply:
    epoch, status_raw, snapshot_raw = read_fields(raw, 3)
    status = read_integer(status_raw)
    if status not in _STATUSES:
        raise WireError("out_of_range")
    if (snapshot_raw is not None) != (status == ReplyStatus.OK):
        raise WireError("malformed")
    snapshot = None if snapshot_raw is None else read_snapshot(snapshot_raw)
    return PairReply(read_contact(epoch), ReplyStatus(status), snapshot)


def _split_request(raw: Any, header: Header) -> SplitRequest:
    epoch, measurements, snapshot = _opened(raw, header)
    return SplitRequest(epoch, measurements, read_split(snapshot))


def _split_reply(raw: Any, header: Header) -> SplitReply:
    epoch, snapshot = read_fields(raw, 2)
    return SplitReply(read_contact(epoch), read_split(snapshot))


def _joint_request(raw: Any, header: Header) -> PairRequest:
    epoch, measurements, snapshot = _opened(raw, header)
    return PairRequest(epoch, measurements, read_joint(snapshot))


def _joint_reply(raw: Any, header: Header) -> PairReply:
    epoch, snapshot = read_fields(raw, 2)
    return PairReply(read_contact(epoch), ReplyStatus.OK, read_joint(snapshot))


def _start_request(raw: Any, header: Header) -> StartRequest:
    (epoch_raw,) = read_fields(raw, 1)
    epoch = read_contact(epoch_raw)
    if epoch.initiator != header.source:
        raise WireError("source_mismatch")
    return StartRequest(epoch)


def _life_notice(raw: Any, header: Header) -> LifeNotice:
    boot_id, incarnation, over = read_fields(raw, 3)
    if type(over) is not bool:
        raise WireError("wrong_type")
    return LifeNotice(read_integer(boot_id), read_integer(incarnation), over)


_STATUSES = frozenset(int(status) for status in ReplyStatus)
_BODIES: dict[int, Callable[[Any, Header], Body]] = {
    _HELLO: _hello,
    _PAIR_REQUEST: _pair_request,
    _PAIR_REPLY: _pair_reply,
    _SPLIT_REQUEST: _split_request,
    _SPLIT_REPLY: _split_reply,
    _TEAM_REPORT: read_report,
    _JOINT_REQUEST: _joint_request,
    _JOINT_REPLY: _joint_reply,
    _START_REQUEST: _start_request,
    _LIFE_NOTICE: _life_notice,
    _ROUND_REPORT: read_round,
    _BEARING_REPORT: read_bearings,
    _LEADER_REQUEST: read_request,
    _LEADER_REPORT: read_word,
    _MOTION_REPORT: read_motion,
    _HYPOTHESES_REPORT: read_hypotheses,
}
