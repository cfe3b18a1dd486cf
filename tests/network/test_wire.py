"""The wire format: what goes in comes out, byte for byte as written down, and nothing foreign gets through."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from network.bearing_messages import Bearing, BearingReport, Prediction
from network.leader_messages import LeaderReport, LeaderRequest
from network.life_messages import MAX_ECHOES, ClockEcho, Hello, LifeNotice
from network.messages import (
    MAX_GROUP,
    MAX_JOINT_DIM,
    MAX_LINES,
    MAX_MESSAGE_BYTES,
    MAX_RAW_MEASUREMENTS,
    MAX_RECKONINGS,
    MAX_TARGETS,
    NEVER,
    NO_MOUNT,
    Belief,
    Body,
    Correction,
    Epoch,
    Header,
    JointSnapshot,
    Line,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    RawMeasurement,
    Reckoning,
    ReplyStatus,
    RoundReport,
    RoundStage,
    Snapshot,
    SplitReply,
    SplitRequest,
    SplitSnapshot,
    StartRequest,
    TargetBelief,
    TeamReport,
)
from network.relative_messages import Height, HypothesesReport, MotionReport, SubjectReport
from network.wire import OversizeError, decode, encode, peek_header, size_bound
from network.wire_fields import MAX_INT, MEASUREMENT_DIMS, MODEL_DIMS, REASONS, WireError
from network.wire_team import ABSOLUTE_DIMS, MAX_INDEX

VECTORS = Path(__file__).parents[1] / "vectors" / "v1.json"
EYE = np.eye(3)
HEADER = Header("r1", boot_id=77, incarnation=2, seq=5, t_meas_ns=1_000, t_send_ns=1_200)


def example_snapshot() -> Snapshot:
    return Snapshot(
        belief=Belief("unicycle", np.array([1.5, -2.0, 0.25]), np.diag([0.25, 0.5, 0.01])),
        base=Epoch(400, "r2", 3),
        factor=np.arange(9.0).reshape(3, 3) / 16,
        line=EYE + 0.125,
        lines=(Line(Epoch(500, "r1", 4), 0.5 * EYE),),
        targets=(TargetBelief("t1", Belief("constant_velocity", np.arange(4.0), np.eye(4) * 2), 600),),
    )


def example_request() -> PairRequest:
    z, R = np.array([4.5, 0.5]), np.array([[0.04, 0.001], [0.001, 0.0025]])
    measurement = Measurement("range_bearing", z, R, mount=(0.1, 0.0, 0.0, 0.0, 0.0, 1.5))
    return PairRequest(Epoch(1_000, "r1", 9), (measurement,), example_snapshot())


def example_spatial_request() -> PairRequest:
    """A quadrotor that sees another one in its camera, and tracks something that flies."""
    pixel = Measurement("pixel", np.array([0.25, -0.125]), np.eye(2) / 16384, (0.1, 0.0, -0.05, 0.25, 1.5, 0.0))
    snapshot = Snapshot(
        belief=Belief("spatial", np.array([1.5, -2.0, 16.5, 0.25]), np.diag([0.25, 0.5, 0.125, 0.01])),
        base=NEVER,
        factor=np.zeros((4, 0)),
        line=np.eye(4),
        targets=(
            TargetBelief("t1", Belief("damped_velocity_3d", np.arange(6.0), np.eye(6) * 2)),
            TargetBelief("t2", Belief("constant_acceleration", np.arange(6.0), np.eye(6) / 2)),
        ),
    )
    return PairRequest(Epoch(1_000, "r1", 10), (pixel,), snapshot)


def example_split(private: bool = True) -> SplitSnapshot:
    """A robot and a target that are correlated."""
    cov = np.diag([0.25, 0.5, 0.01, 2.0, 2.0, 1.0, 1.0])
    cov[0, 3] = cov[3, 0] = 0.125
    own = np.diag([0.125, 0.25, 0.005, 0.0, 0.0, 0.0, 0.0]) if private else None
    relayed = (TargetBelief("t2", Belief("unicycle", np.array([8.0, 4.0, 2.0]), np.diag([4.0, 4.0, 1.0])), 900),)
    targets = (("t1", "constant_velocity"),)
    return SplitSnapshot("unicycle", targets, np.arange(7.0) / 4, cov, own, (300,), relayed if private else ())


def example_report() -> TeamReport:
    """A drone re-anchored at 900: the end of the old reckoning, two of the new one, and what it measured."""
    noise, mount = np.diag([0.25, 0.125, 0.0, 0.0625]), (0.1, 0.0, 0.0, 0.0, 1.5, 0.0)
    return TeamReport(
        born_ns=100,
        reckonings=(
            Reckoning(100, 850, 900, np.array([3.0, -1.5, 0.25, 7.0]), noise),
            Reckoning(900, 900, 950, np.array([0.5, 0.0, 0.0, 0.125]), noise / 8),
            Reckoning(900, 950, 1_000, np.array([1.0, 0.125, 0.0, 0.25]), noise / 4),
        ),
        measurements=(
            RawMeasurement(950, 0, "r2", "range", np.array([4.5]), np.array([[0.04]])),
            RawMeasurement(1_000, 0, None, "pose", np.array([1.0, 2.0, 8.0, 0.5]), np.eye(4) / 16),
            RawMeasurement(1_000, 1, "landmark:Gate.7", "pixel", np.array([0.25, -0.125]), np.eye(2) / 16384, mount),
            RawMeasurement(1_000, 2, "target:t1", "bearing3", np.array([-3.0, 0.5]), np.eye(2) / 1024),
        ),
    )


def example_joint(met: bool = True) -> JointSnapshot:
    """A robot and a target with factors; of a pair that met, or with what all have in common."""
    found = JointSnapshot(
        model="unicycle",
        targets=(("t1", "constant_velocity"),),
        mean=np.arange(7.0) / 4,
        cov=example_split().cov.astype(np.float32).astype(float),
        base=Epoch(400, "r2", 3) if met else NEVER,
    )
    if not met:
        return dataclasses.replace(
            found,
            noise=np.eye(7, 4) / 2,
            prior=np.eye(7, 4, -3),
            span_s=2.5,
            known=False,
            group=frozenset(("r1", "r2")),
        )
    lines = (Line(Epoch(500, "r1", 4), 0.5 * np.eye(7)), Line(Epoch(600, "r1", 5), np.eye(7, 11) / 4))
    factor = np.arange(21.0).reshape(7, 3) / 16
    return dataclasses.replace(found, factor=factor, line=np.eye(7) + 0.125, lines=lines, anew=True)


def example_round() -> RoundReport:
    """A robot before the corrections of a round, with a target it has seen and one it has heard of."""
    targets = (
        TargetBelief("t1", Belief("unicycle", np.array([8.0, 4.0, 2.0]), np.diag([4.0, 4.0, 1.0])), 900),
        TargetBelief("t2", Belief("constant_velocity", np.arange(4.0), np.eye(4) * 2), 0),
    )
    seen = Correction("t1", np.array([8.5, 4.25]), np.eye(2) / 16, np.diag([0.5, 0.25]))
    belief = Belief("unicycle", np.array([1.5, -2.0, 0.25]), np.diag([0.25, 0.5, 0.01]))
    return RoundReport(RoundStage.PRIOR, belief, np.array([0.5, 0.0, 0.0]), -0.125, targets, (seen,))


def example_bearings() -> BearingReport:
    """A camera that has seen one target and expects another one somewhere."""
    seen = Bearing("t1", np.array([1.0, -2.0, 0.5]), np.diag([0.25, 0.25, 0.0]), np.array([0.6, 0.0, 0.8]), 0.125, 90)
    told = Prediction("t1", np.arange(6.0), 2.0 * np.eye(6)), Prediction("t2", -np.arange(6.0))
    return BearingReport((seen,), told)


def example_word() -> LeaderReport:
    """A leader tells everybody where it was; its word before was of 100 ns earlier."""
    return LeaderReport(np.array([1.5, -2.0]), np.diag([0.25, 0.5]), np.array([1.0, 0.5]), HEADER.t_meas_ns - 100)


def example_motion() -> MotionReport:
    """A robot that flies a turn, with its altitude of a moment ago."""
    velocity = np.array([0.5, -0.25, 0.125, 0.0625])
    return MotionReport(50_000_000, velocity, np.diag([0.5, 0.5, 0.5, 0.125]), Height(488.1, 0.25, 1_000))


def example_hypotheses() -> HypothesesReport:
    """Two places where one robot may be, with what was known before of the first, and one of another."""
    means = np.array([[1.0, -2.0, 0.5, 3.0], [1.0, 2.0, 0.5, -3.0]])
    covs = np.array([np.diag([0.5, 0.25, 0.125, 1.0]) + 0.0625, np.eye(4)])
    first = SubjectReport("p1", np.array([0.75, 0.125]), means, covs, -means, 2.0 * covs, (True, False))
    return HypothesesReport(900, 1, 2, (first, SubjectReport("p2", np.ones(1), means[:1], covs[:1])))


EXAMPLES: dict[str, Body] = {
    "hello": Hello("0.1.0", (ClockEcho("r2", 10, 20), ClockEcho("r3", 30, 40))),
    "pair_request": example_request(),
    "pair_request_spatial": example_spatial_request(),
    "pair_reply": PairReply(Epoch(1_000, "r2", 9), ReplyStatus.OK, example_snapshot()),
    "pair_reply_too_old": PairReply(Epoch(1_000, "r2", 9), ReplyStatus.TOO_OLD),
    "split_request": SplitRequest(Epoch(1_000, "r1", 9), example_request().measurements, example_split()),
    "split_reply": SplitReply(Epoch(1_000, "r2", 9), example_split(private=False)),
    "team_report": example_report(),
    "joint_request": PairRequest(Epoch(1_000, "r1", 9), example_request().measurements, example_joint()),
    "joint_reply": PairReply(Epoch(1_000, "r2", 9), ReplyStatus.OK, example_joint(met=False)),
    "start_request": StartRequest(Epoch(1000, "r1", 9)),
    "round_report": example_round(),
    "bearing_report": example_bearings(),
    "leader_request": LeaderRequest(9),
    "leader_report": example_word(),
    "leader_answer": dataclasses.replace(example_word(), before_ns=None, answers=9),
    "motion_report": example_motion(),
    "hypotheses_report": example_hypotheses(),
    "life_notice": LifeNotice(2**53 - 1, 9, True),
}


def same(a: Any, b: Any) -> bool:
    """Deep equality of message parts, exact in every number."""
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and bool(np.all(a == b))
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        names = [field.name for field in dataclasses.fields(a)]
        return type(a) is type(b) and all(same(getattr(a, name), getattr(b, name)) for name in names)
    return type(a) is type(b) and bool(a == b)


# --- generators -------------------------------------------------------------------------------------------

stamps = st.integers(0, MAX_INT)
ids = st.text("abcxyz019-", min_size=1, max_size=24)
numbers = st.floats(-1e9, 1e9, allow_subnormal=False)
epochs = st.builds(Epoch, stamps, ids, stamps)


def arrays(*shape: int) -> st.SearchStrategy[np.ndarray]:
    size = int(np.prod(shape))
    return st.lists(numbers, min_size=size, max_size=size).map(lambda v: np.array(v).reshape(shape))


@st.composite
def covariances(draw: st.DrawFn, n: int) -> np.ndarray:
    factors = draw(st.lists(st.floats(-1, 1), min_size=n * n, max_size=n * n))
    # Dependences that add up over many components make a matrix that no computer can tell from a singular one.
    below = np.tril(np.array(factors).reshape(n, n), -1) / max(1, n - 5)
    root = below + np.diag(draw(scales(n)) if n <= 6 else np.maximum(draw(scales(n)), 0.5))
    return root @ root.T


def scales(n: int) -> st.SearchStrategy[list[float]]:
    return st.lists(st.floats(1e-2, 1e2), min_size=n, max_size=n)


@st.composite
def beliefs(draw: st.DrawFn) -> Belief:
    model = draw(st.sampled_from(sorted(MODEL_DIMS)))
    n = MODEL_DIMS[model]
    return Belief(model, draw(arrays(n)), draw(covariances(n)))


@st.composite
def measurements(draw: st.DrawFn) -> Measurement:
    kind = draw(st.sampled_from(sorted(MEASUREMENT_DIMS)))
    m = MEASUREMENT_DIMS[kind]
    mount = draw(st.tuples(numbers, numbers, numbers, numbers, numbers, numbers))
    return Measurement(kind, draw(arrays(m)), draw(covariances(m)), mount)


@st.composite
def snapshots(draw: st.DrawFn) -> Snapshot:
    belief = draw(beliefs())
    n = len(belief.mean)
    line_epochs = sorted(draw(st.lists(epochs, max_size=2, unique=True)))
    target_ids = draw(st.lists(ids, max_size=2, unique=True))
    return Snapshot(
        belief=belief,
        base=draw(st.one_of(st.just(NEVER), epochs)),
        factor=draw(arrays(n, draw(st.integers(0, 4)))),
        line=draw(arrays(n, n)),
        lines=tuple(Line(epoch, draw(arrays(n, n))) for epoch in line_epochs),
        targets=tuple(TargetBelief(target, draw(beliefs()), draw(stamps)) for target in target_ids),
        known=draw(st.booleans()),
    )


@st.composite
def robots_and_targets(draw: st.DrawFn) -> tuple[str, tuple[tuple[str, str], ...], int]:
    """Model, targets and number of components of a joint belief."""
    models = sorted(MODEL_DIMS)
    model, names = draw(st.sampled_from(models)), draw(st.lists(ids, max_size=2, unique=True))
    targets = tuple((name, draw(st.sampled_from(models))) for name in names)
    while MODEL_DIMS[model] + sum(MODEL_DIMS[item] for _, item in targets) > MAX_JOINT_DIM:
        targets = targets[:-1]
    return model, targets, MODEL_DIMS[model] + sum(MODEL_DIMS[item] for _, item in targets)


def singles(*shape: int) -> st.SearchStrategy[np.ndarray]:
    """Arrays of what single precision can hold, told apart by a few numbers in them."""
    number = st.floats(-1e9, 1e9, width=32, allow_subnormal=False)
    size = int(np.prod(shape))
    return st.lists(number, min_size=1, max_size=5).map(lambda v: np.resize(np.array(v), size).reshape(shape))


@st.composite
def joint_snapshots(draw: st.DrawFn) -> JointSnapshot:
    model, targets, n = draw(robots_and_targets())
    c = n - MODEL_DIMS[model]
    line_epochs = sorted(draw(st.lists(epochs, max_size=2, unique=True)))
    cov = draw(covariances(n))
    # An empty array is told as nothing.
    columns = st.none() if c == 0 else st.one_of(st.none(), singles(n, c))
    return JointSnapshot(
        model=model,
        targets=targets,
        mean=draw(arrays(n)),
        cov=(cov + np.diag(cov.diagonal())).astype(np.float32).astype(float),
        base=draw(st.one_of(st.just(NEVER), epochs)),
        factor=draw(st.one_of(st.none(), singles(n, draw(st.integers(1, 8))))),
        line=draw(st.one_of(st.none(), singles(n, n))),
        noise=draw(columns),
        prior=draw(columns),
        span_s=draw(st.floats(0.0, 1e9)),
        lines=tuple(Line(epoch, draw(singles(n, n + draw(st.sampled_from([0, c]))))) for epoch in line_epochs),
        known=draw(st.booleans()),
        anew=draw(st.booleans()),
        group=draw(st.one_of(st.none(), st.frozensets(ids, max_size=MAX_GROUP))),
    )


@st.composite
def split_snapshots(draw: st.DrawFn) -> SplitSnapshot:
    model, targets, n = draw(robots_and_targets())
    share = draw(st.one_of(st.none(), st.floats(0.0, 1.0)))
    cov = draw(covariances(n))
    names = {name for name, _ in targets}
    others = [name for name in draw(st.lists(ids, max_size=2, unique=True)) if name not in names]
    relayed = tuple(TargetBelief(name, draw(beliefs()), draw(stamps)) for name in others)
    ages_ns = tuple(draw(stamps) for _ in targets)
    private = None if share is None else share * cov
    return SplitSnapshot(model, targets, draw(arrays(n)), cov, private, ages_ns, relayed)


@st.composite
def reports(draw: st.DrawFn, source: str, until_ns: int) -> TeamReport:
    born_ns = draw(st.integers(0, until_ns))
    instants = sorted(draw(st.lists(st.integers(born_ns, until_ns), max_size=MAX_RECKONINGS, unique=True)))
    reckonings = []
    for t_ns in instants:
        if t_ns > born_ns:
            cov = draw(st.floats(0, 1)) * draw(covariances(4))
            anchor_ns = draw(st.integers(born_ns, t_ns - 1))
            reckonings.append(Reckoning(anchor_ns, draw(st.integers(anchor_ns, t_ns - 1)), t_ns, draw(arrays(4)), cov))
    found = draw(st.lists(st.tuples(st.integers(0, until_ns), st.integers(0, MAX_INDEX)), max_size=4, unique=True))
    if not found and not reckonings:
        found = [(until_ns, 0)]
    return TeamReport(born_ns, tuple(reckonings), tuple(draw(raw_measurements(source, *key)) for key in found))


@st.composite
def raw_measurements(draw: st.DrawFn, source: str, t_ns: int, index: int) -> RawMeasurement:
    if draw(st.booleans()):
        kind = draw(st.sampled_from(sorted(ABSOLUTE_DIMS)))
        of, m, mount = None, draw(st.sampled_from(ABSOLUTE_DIMS[kind])), NO_MOUNT
    else:
        kind = draw(st.sampled_from(sorted(MEASUREMENT_DIMS)))
        prefix = draw(st.sampled_from(["", "target:", "landmark:"]))
        of, m = prefix + draw(ids.filter(lambda name: prefix or name != source)), MEASUREMENT_DIMS[kind]
        mount = draw(st.tuples(numbers, numbers, numbers, numbers, numbers, numbers))
    z = draw(arrays(m))
    if kind in ("range", "range_bearing"):
        z[0] = abs(z[0])
    return RawMeasurement(t_ns, index, of, kind, z, draw(covariances(m)), mount)


@st.composite
def rounds(draw: st.DrawFn) -> RoundReport:
    stage = draw(st.sampled_from(RoundStage))
    names = sorted(draw(st.lists(ids, max_size=3, unique=True)))
    corrections = []
    for name in names if stage is RoundStage.PRIOR else []:
        d = draw(st.sampled_from((2, 3)))
        corrections.append(Correction(name, draw(arrays(d)), draw(covariances(d)), draw(covariances(d))))
    rate = draw(st.floats(-1e3, 1e3))
    return RoundReport(
        stage,
        draw(beliefs()),
        np.array(draw(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3))),
        rate,
        tuple(TargetBelief(name, draw(beliefs()), draw(stamps)) for name in names),
        tuple(corrections),
    )


@st.composite
def messages(draw: st.DrawFn) -> Message:
    header = Header(draw(ids), *(draw(stamps) for _ in range(5)))
    kinds = ["hello", "request", "reply", "split request", "split reply", "report", "joint", "round"]
    kind = draw(st.sampled_from(kinds))
    body: Body
    if kind == "hello":
        peers = sorted(draw(st.lists(ids, max_size=MAX_ECHOES, unique=True)))
        body = Hello(
            draw(st.text("0123456789.dev+", max_size=48)),
            tuple(ClockEcho(peer, draw(stamps), draw(stamps)) for peer in peers),
        )
    elif kind == "request":
        epoch = Epoch(draw(stamps), header.source, draw(stamps))
        measured = draw(st.lists(measurements(), min_size=1, max_size=2))
        body = PairRequest(epoch, tuple(measured), draw(snapshots()))
    elif kind == "split request":
        epoch = Epoch(draw(stamps), header.source, draw(stamps))
        measured = draw(st.lists(measurements(), min_size=1, max_size=2))
        body = SplitRequest(epoch, tuple(measured), draw(split_snapshots()))
    elif kind == "report":
        body = draw(reports(header.source, header.t_meas_ns))
    elif kind == "round":
        body = draw(rounds())
    elif kind == "joint":
        epoch = Epoch(draw(stamps), header.source, draw(stamps))
        body = PairRequest(epoch, (draw(measurements()),), draw(joint_snapshots()))
        if draw(st.booleans()):
            body = PairReply(epoch, ReplyStatus.OK, draw(joint_snapshots()))
    elif kind == "split reply":
        body = SplitReply(draw(epochs), draw(split_snapshots()))
    else:
        status = draw(st.sampled_from(ReplyStatus))
        body = PairReply(draw(epochs), status, draw(snapshots()) if status is ReplyStatus.OK else None)
    return Message(header, body)


# --- what goes in comes out -------------------------------------------------------------------------------


@settings(max_examples=120, deadline=None)
@given(messages())
def test_every_message_survives_the_wire_exactly(message: Message) -> None:
    try:
        payload = encode(message.header, message.body)
    except OversizeError:
        assert size_bound(message.body) > MAX_MESSAGE_BYTES
        return
    assert same(decode(payload, message.header.source), message)
    assert peek_header(payload) == message.header
    assert len(payload) <= size_bound(message.body)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_version_1_is_written_down_byte_for_byte(name: str) -> None:
    vector = bytes.fromhex(json.loads(VECTORS.read_text())[name])
    assert encode(HEADER, EXAMPLES[name]) == vector
    assert same(decode(vector, "r1"), Message(HEADER, EXAMPLES[name]))


def test_every_vector_belongs_to_an_example() -> None:
    assert sorted(json.loads(VECTORS.read_text())) == sorted(EXAMPLES)


def test_size_bound_is_tight_within_the_longest_header() -> None:
    header = Header("a" * 24, MAX_INT, MAX_INT, MAX_INT, MAX_INT, MAX_INT)
    hello = EXAMPLES["hello"]
    assert len(encode(header, hello)) == size_bound(hello)


# --- our own mistakes raise -------------------------------------------------------------------------------


def snapshot_with(**changes: Any) -> PairReply:
    snapshot = dataclasses.replace(example_snapshot(), **changes)
    return PairReply(Epoch(1_000, "r2", 9), ReplyStatus.OK, snapshot)


def split_with(**changes: Any) -> SplitReply:
    return SplitReply(Epoch(1_000, "r2", 9), dataclasses.replace(example_split(), **changes))


def report_with(**changes: Any) -> TeamReport:
    return dataclasses.replace(example_report(), **changes)


def measured_with(**changes: Any) -> TeamReport:
    first, *others = example_report().measurements
    return report_with(measurements=(dataclasses.replace(first, **changes), *others))


def joint_with(**changes: Any) -> PairReply:
    return PairReply(Epoch(1_000, "r2", 9), ReplyStatus.OK, dataclasses.replace(example_joint(), **changes))


def test_too_many_lines_and_targets_for_one_datagram_are_an_oversize_error() -> None:
    lines = tuple(Line(Epoch(500 + k, "r1", k), EYE) for k in range(MAX_LINES))
    belief = Belief("constant_velocity", np.zeros(4), np.eye(4))
    targets = tuple(TargetBelief(f"t{k}", belief) for k in range(MAX_TARGETS))
    body = snapshot_with(lines=lines, targets=targets)
    with pytest.raises(OversizeError, match="leave out"):
        encode(HEADER, body)
    assert size_bound(body) > MAX_MESSAGE_BYTES


@pytest.mark.parametrize(
    "body",
    [
        snapshot_with(factor=np.zeros((2, 3))),
        snapshot_with(line=np.full((3, 3), np.nan)),
        snapshot_with(belief=Belief("unicycle", np.zeros(4), np.eye(4))),
        snapshot_with(belief=Belief("hovercraft", np.zeros(3), EYE)),
        snapshot_with(belief=Belief("unicycle", np.zeros(3), -EYE)),
        snapshot_with(belief=Belief("unicycle", np.zeros(3), np.triu(np.ones((3, 3))) + EYE)),
        snapshot_with(lines=(Line(Epoch(9, "r1", 2), EYE), Line(Epoch(9, "r1", 1), EYE))),
        snapshot_with(known=1),
        PairReply(Epoch(1, "r2", 1), ReplyStatus.OK, None),
        PairReply(Epoch(1, "r2", 1), ReplyStatus.BUSY, example_snapshot()),
        PairReply(NEVER, ReplyStatus.BUSY),
        PairRequest(Epoch(1, "r2", 1), example_request().measurements, example_snapshot()),
        PairRequest(Epoch(1, "r1", 1), (), example_snapshot()),
        SplitReply(NEVER, example_split()),
        SplitRequest(Epoch(1, "r2", 1), example_request().measurements, example_split()),
        SplitRequest(Epoch(1, "r1", 1), (), example_split()),
        split_with(private=2.0 * example_split().cov),
        split_with(private=-np.eye(7)),
        split_with(cov=-np.eye(7), private=None),
        split_with(targets=(("t1", "hovercraft"),)),
        split_with(targets=(("t1", "unicycle"),)),
        TeamReport(100, ()),
        report_with(born_ns=1_001),
        report_with(born_ns=101),
        report_with(reckonings=example_report().reckonings[::-1]),
        report_with(reckonings=(Reckoning(100, 100, 900, np.zeros(3), np.eye(4)),)),
        report_with(reckonings=(Reckoning(100, 100, 900, np.zeros(4), -np.eye(4)),)),
        measured_with(t_ns=1_001),
        measured_with(t_ns=1_000),
        measured_with(of="r1"),
        measured_with(of="team:t1"),
        measured_with(kind="pose"),
        measured_with(of=None),
        measured_with(z=np.array([-1.0])),
        measured_with(R=-np.eye(1)),
        measured_with(index=MAX_INDEX + 1),
        joint_with(factor=np.zeros((3, 7))),
        joint_with(line=np.zeros((7, 3))),
        joint_with(noise=np.zeros((7, 3))),
        joint_with(prior=np.zeros((3, 4))),
        joint_with(prior=np.full((7, 4), np.inf)),
        joint_with(lines=(Line(Epoch(500, "r1", 4), np.zeros((7, 8))),)),
        joint_with(cov=-np.eye(7)),
        joint_with(mean=np.zeros(3)),
        joint_with(targets=(("t1", "hovercraft"),)),
        joint_with(span_s=-1.0),
        joint_with(known=1),
        PairRequest(Epoch(1, "r2", 1), example_request().measurements, example_joint()),
        Hello("spaces and <markup>"),
        Hello("1", (ClockEcho("r2", 1, 1), ClockEcho("r2", 1, 1))),
        Hello("1", (ClockEcho("r2", -1, 1),)),
        "not a body",
    ],
)
def test_a_malformed_own_message_is_a_value_error(body: Any) -> None:
    with pytest.raises(ValueError):
        encode(HEADER, body)


# --- foreign bytes are refused, each with its reason ------------------------------------------------------


def doubles(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def singles_of(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def raw(name: str) -> list[Any]:
    """The message as nested lists, ready to be spoiled."""
    unpacked: list[Any] = msgpack.unpackb(encode(HEADER, EXAMPLES[name]))
    return unpacked


def put(name: str, path: tuple[int, ...], value: Any) -> bytes:
    message = raw(name)
    at = message
    for index in path[:-1]:
        at = at[index]
    at[path[-1]] = value
    packed: bytes = msgpack.packb(message)
    return packed


SPOILED = {
    "a later version": (put("hello", (0, 0), 2), "unknown_version"),
    "a version that is a boolean": (put("hello", (0, 0), True), "wrong_type"),
    "a header of six": (put("hello", (0,), [1, "r1", 77, 2, 5, 1_000]), "malformed"),
    "an empty header": (put("hello", (0,), []), "malformed"),
    "a header that is a number": (put("hello", (0,), 1), "wrong_type"),
    "a foreign source": (put("hello", (0, 1), "r2"), "source_mismatch"),
    "a source with capitals": (put("hello", (0, 1), "R1"), "bad_id"),
    "a source that is bytes": (put("hello", (0, 1), b"r1"), "wrong_type"),
    "a boot id that is a boolean": (put("hello", (0, 2), True), "wrong_type"),
    "a boot id that is a float": (put("hello", (0, 2), 77.0), "wrong_type"),
    "a negative incarnation": (put("hello", (0, 3), -1), "out_of_range"),
    "a stamp beyond 63 bits": (put("hello", (0, 6), 2**63), "out_of_range"),
    "a fourth part": (msgpack.packb([*raw("hello"), 0]), "malformed"),
    "an unknown body": (put("hello", (1,), 99), "unknown_kind"),
    "a body kind that is a boolean": (put("hello", (1,), True), "wrong_type"),
    "a body kind that is text": (put("hello", (1,), "hello"), "wrong_type"),
    "a body of another kind": (put("hello", (1,), 2), "malformed"),
    "a body that is a map": (put("hello", (2,), {}), "wrong_type"),
    "a filled map": (put("hello", (2,), {"a": 1}), "malformed"),
    "an extension type": (put("hello", (2, 0), msgpack.ExtType(5, b"xx")), "malformed"),
    "a time stamp extension": (put("hello", (2, 0), msgpack.Timestamp(1)), "malformed"),
    "no array at all": (msgpack.packb(1), "wrong_type"),
    "an empty array": (msgpack.packb([]), "malformed"),
    "bytes after the message": (encode(HEADER, EXAMPLES["hello"]) + b"\x00", "malformed"),
    "a message cut short": (encode(HEADER, EXAMPLES["hello"])[:-1], "malformed"),
    "nothing": (b"", "malformed"),
    "deep nesting": (b"\x91" * MAX_MESSAGE_BYTES, "malformed"),
    "one byte too many": (b"\x00" * (MAX_MESSAGE_BYTES + 1), "oversize"),
    "text that is not UTF-8": (msgpack.packb([[1, "r1"], 1]).replace(b"r1", b"\xff\xff"), "malformed"),
    "unsorted echoes": (put("hello", (2, 1, 0, 0), "r9"), "malformed"),
    "an echo with a bad id": (put("hello", (2, 1, 0, 0), ""), "bad_id"),
    "too many echoes": (put("hello", (2, 1), [["r2", 1, 1]] * (MAX_ECHOES + 1)), "malformed"),
    "markup as software": (put("hello", (2, 0), "<b>"), "bad_id"),
    "an unknown measurement": (put("pair_request", (2, 1, 0, 0), "smell"), "unknown_kind"),
    "a wrong dimension of z": (put("pair_request", (2, 1, 0, 1), 1), "malformed"),
    "z too short": (put("pair_request", (2, 1, 0, 2), doubles(4.5)), "malformed"),
    "z as text": (put("pair_request", (2, 1, 0, 2), "0123456789abcdef"), "wrong_type"),
    "z not a number": (put("pair_request", (2, 1, 0, 2), doubles(4.5, float("nan"))), "non_finite"),
    "z infinite": (put("pair_request", (2, 1, 0, 2), doubles(float("inf"), 0.0)), "non_finite"),
    "z enormous": (put("pair_request", (2, 1, 0, 2), doubles(1.0001e9, 0.0)), "out_of_range"),
    "z whose square overflows": (put("pair_request", (2, 1, 0, 2), doubles(1e300, 0.0)), "out_of_range"),
    "R not positive": (put("pair_request", (2, 1, 0, 3), doubles(1.0, 2.0, 1.0)), "not_positive_definite"),
    "R below the floor": (put("pair_request", (2, 1, 0, 3), doubles(1.0, 0.0, 9e-11)), "below_sensor_floor"),
    "R nearly singular": (put("pair_request", (2, 1, 0, 3), doubles(1, 1, 1 + 1e-12)), "below_sensor_floor"),
    "a mount that is missing": (put("pair_request", (2, 1, 0, 4), None), "wrong_type"),
    "no measurement": (put("pair_request", (2, 1), []), "malformed"),
    "too many measurements": (put("pair_request", (2, 1), [0] * 9), "out_of_range"),
    "an initiator other than the source": (put("pair_request", (2, 0, 1), "r2"), "source_mismatch"),
    "the epoch of a pair that never met": (put("pair_request", (2, 0), [0, "", 0]), "out_of_range"),
    "an epoch without initiator": (put("pair_request", (2, 0), [5, "", 0]), "bad_id"),
    "an unknown model": (put("pair_reply", (2, 2, 0, 0), "hovercraft"), "unknown_model"),
    "a model with a wrong dimension": (put("pair_reply", (2, 2, 0, 1), 4), "malformed"),
    "P indefinite": (put("pair_reply", (2, 2, 0, 3), doubles(1, 2, 0, 1, 0, 1)), "not_positive_definite"),
    "P singular": (put("pair_reply", (2, 2, 0, 3), doubles(1, 0, 0, 1, 0, 0)), "not_positive_definite"),
    "a factor with too many columns": (put("pair_reply", (2, 2, 2), 9), "out_of_range"),
    "a factor of other size than said": (put("pair_reply", (2, 2, 2), 2), "malformed"),
    "a line cut short": (put("pair_reply", (2, 2, 4), doubles(1.0)), "malformed"),
    "too many lines": (put("pair_reply", (2, 2, 5), [0] * (MAX_LINES + 1)), "out_of_range"),
    "a bad target id": (put("pair_reply", (2, 2, 6, 0, 0), "T/1"), "bad_id"),
    "a target learnt of in the future": (put("pair_reply", (2, 2, 6, 0, 5), -1), "out_of_range"),
    "a target both in the belief and relayed": (put("split_request", (2, 2, 6, 0, 0), "t1"), "malformed"),
    "a relayed belief cut short": (put("split_request", (2, 2, 6, 0, 3), doubles(1.0)), "malformed"),
    "a joint target learnt of at no time": (put("split_reply", (2, 1, 5, 0), None), "wrong_type"),
    "fewer ages than targets": (put("split_reply", (2, 1, 5), []), "malformed"),
    "a start asked for in another's name": (put("start_request", (2, 0, 1), "r7"), "source_mismatch"),
    "a start of no instant": (put("start_request", (2, 0), [0, "", 0]), "out_of_range"),
    "a start with more": (put("start_request", (2,), [[1000, "r1", 9], 1]), "malformed"),
    "a life that is over as a number": (put("life_notice", (2, 2), 1), "wrong_type"),
    "a life of no number": (put("life_notice", (2, 1), -1), "out_of_range"),
    "known as a number": (put("pair_reply", (2, 2, 7), 1), "wrong_type"),
    "a split of a robot nobody knows": (put("split_reply", (2, 1, 0), "hovercraft"), "unknown_model"),
    "a target of a model nobody knows": (put("split_reply", (2, 1, 1, 0, 1), "hovercraft"), "unknown_model"),
    "a target named twice": (put("split_reply", (2, 1, 1), [["t", "unicycle"]] * 2), "malformed"),
    "more targets than a belief may have": (
        put("split_reply", (2, 1, 1), [[f"t{k}", "unicycle"] for k in range(MAX_JOINT_DIM // 3)]),
        "out_of_range",
    ),
    "a joint mean of another size": (put("split_reply", (2, 1, 2), doubles(1.0, 2.0, 3.0)), "malformed"),
    "more private than there is": (
        put("split_request", (2, 2, 4), doubles(*np.diag([9.0, 0, 0, 0, 0, 0, 0])[np.triu_indices(7)])),
        "not_positive_definite",
    ),
    "less private than nothing": (
        put("split_request", (2, 2, 4), doubles(*(-1e-3 * np.eye(7))[np.triu_indices(7)])),
        "not_positive_definite",
    ),
    "private of another size": (put("split_request", (2, 2, 4), doubles(1.0)), "malformed"),
    "a split contact that never met": (put("split_reply", (2, 0), [0, "", 0]), "out_of_range"),
    "a split request for another": (put("split_request", (2, 0, 1), "r2"), "source_mismatch"),
    "a life that begins after its message": (put("team_report", (2, 0), 1_001), "out_of_range"),
    "a report of nothing": (put("team_report", (2,), [100, [], []]), "malformed"),
    "odometry from before its life": (put("team_report", (2, 1, 0, 0), 99), "out_of_range"),
    "odometry that ends where it begins": (put("team_report", (2, 1, 0, 2), 850), "out_of_range"),
    "odometry whose last part began before the anchor": (put("team_report", (2, 1, 0, 1), 99), "out_of_range"),
    "odometry that ends after the message": (put("team_report", (2, 1, 2, 2), 1_001), "out_of_range"),
    "odometry told twice": (put("team_report", (2, 1, 1, 2), 1_000), "malformed"),
    "odometry of three numbers": (put("team_report", (2, 1, 0, 3), doubles(1, 2, 3)), "malformed"),
    "odometry without a stamp": (put("team_report", (2, 1, 0, 2), None), "wrong_type"),
    "odometry that is not a number": (put("team_report", (2, 1, 0, 3), doubles(1, 2, 3, float("nan"))), "non_finite"),
    "negative noise of odometry": (
        put("team_report", (2, 1, 0, 4), doubles(*np.diag([1.0, 1.0, -1e-6, 1.0])[np.triu_indices(4)])),
        "not_positive_definite",
    ),
    "too much odometry": (put("team_report", (2, 1), [0] * (MAX_RECKONINGS + 1)), "out_of_range"),
    "too many raw measurements": (put("team_report", (2, 2), [0] * MAX_RAW_MEASUREMENTS), "wrong_type"),
    "more raw measurements than any array": (put("team_report", (2, 2), [0] * (MAX_RAW_MEASUREMENTS + 1)), "malformed"),
    "a measurement of itself": (put("team_report", (2, 2, 0, 2), "r1"), "bad_id"),
    "a measurement of nonsense": (put("team_report", (2, 2, 0, 2), "target:T"), "bad_id"),
    "a range of nobody": (put("team_report", (2, 2, 0, 2), None), "unknown_kind"),
    "a pose of another": (put("team_report", (2, 2, 1, 2), "r2"), "unknown_kind"),
    "a pose of two numbers": (put("team_report", (2, 2, 1, 4), 2), "malformed"),
    "a negative range": (put("team_report", (2, 2, 0, 5), doubles(-1.0)), "out_of_range"),
    "two measurements under one name": (put("team_report", (2, 2, 2, 1), 0), "malformed"),
    "a measurement of the future": (put("team_report", (2, 2, 0, 0), 1_001), "out_of_range"),
    "an index beyond all reason": (put("team_report", (2, 2, 0, 1), MAX_INDEX + 1), "out_of_range"),
    "a mount of five numbers": (put("team_report", (2, 2, 2, 7), doubles(1, 2, 3, 4, 5)), "malformed"),
    "a raw measurement below the floor": (put("team_report", (2, 2, 0, 6), doubles(1e-11)), "below_sensor_floor"),
    "a joint belief of a robot nobody knows": (put("joint_reply", (2, 1, 0), "hovercraft"), "unknown_model"),
    "a joint belief with a target named twice": (put("joint_reply", (2, 1, 1), [["t", "unicycle"]] * 2), "malformed"),
    "a joint belief of more than there is room for": (
        put("joint_reply", (2, 1, 1), [[f"t{k}", "unicycle"] for k in range(MAX_JOINT_DIM // 3)]),
        "out_of_range",
    ),
    "a mean of another size than robot and targets": (put("joint_reply", (2, 1, 2), doubles(1.0)), "malformed"),
    "a joint covariance in double precision": (put("joint_reply", (2, 1, 3), doubles(*range(28))), "malformed"),
    "a joint covariance that is indefinite": (
        put("joint_reply", (2, 1, 3), singles_of(*(-np.eye(7))[np.triu_indices(7)])),
        "not_positive_definite",
    ),
    "a joint factor of other size than said": (put("joint_request", (2, 2, 5), 4), "malformed"),
    "a joint factor with too many columns": (put("joint_request", (2, 2, 5), MAX_JOINT_DIM + 1), "out_of_range"),
    "a joint line as text": (put("joint_request", (2, 2, 7), "no"), "wrong_type"),
    "noise that is not a number": (put("joint_reply", (2, 1, 8), singles_of(*[float("nan")] * 28)), "non_finite"),
    "a prior that is enormous": (put("joint_reply", (2, 1, 9), singles_of(*[2e9] * 28)), "out_of_range"),
    "a span that is whole": (put("joint_reply", (2, 1, 10), 2), "wrong_type"),
    "a span before the start": (put("joint_reply", (2, 1, 10), -1.0), "out_of_range"),
    "a span without end": (put("joint_reply", (2, 1, 10), float("inf")), "non_finite"),
    "joint lines that are not in order": (put("joint_request", (2, 2, 11, 1, 0), [500, "r1", 3]), "malformed"),
    "a joint line of neither size": (put("joint_request", (2, 2, 11, 0, 1), singles_of(1.0)), "malformed"),
    "known joint factors as a number": (put("joint_reply", (2, 1, 12), 0), "wrong_type"),
    "a joint pair anew as a number": (put("joint_reply", (2, 1, 13), 0), "wrong_type"),
    "a group out of order": (put("joint_reply", (2, 1, 14), ["r2", "r1"]), "malformed"),
    "a group too large for factors": (put("joint_reply", (2, 1, 14), ["r1", "r2", "r3", "r4"]), "out_of_range"),
    "a group of somebody without a name": (put("joint_reply", (2, 1, 14), [""]), "bad_id"),
    "a group that is a name": (put("joint_reply", (2, 1, 14), "r1"), "wrong_type"),
    "a joint reply to no contact": (put("joint_reply", (2, 0), [0, "", 0]), "out_of_range"),
    "a joint request for another": (put("joint_request", (2, 0, 1), "r2"), "source_mismatch"),
    "a joint request without measurement": (put("joint_request", (2, 1), []), "malformed"),
    "an unknown status": (put("pair_reply", (2, 1), 9), "out_of_range"),
    "a refusal with a snapshot": (put("pair_reply", (2, 1), 1), "malformed"),
    "a success without a snapshot": (put("pair_reply", (2, 2), None), "malformed"),
}


@pytest.mark.parametrize("case", sorted(SPOILED))
def test_a_foreign_message_is_refused_for_the_right_reason(case: str) -> None:
    payload, reason = SPOILED[case]
    with pytest.raises(WireError) as refused:
        decode(payload, "r1")
    assert refused.value.reason == reason


def test_every_reason_is_shown_by_an_example() -> None:
    assert {reason for _, reason in SPOILED.values()} == set(REASONS)


def test_target_named_twice_is_refused() -> None:
    message = raw("pair_reply")
    message[2][2][6] *= 2
    with pytest.raises(WireError, match="malformed"):
        decode(msgpack.packb(message), "r1")


def test_a_scalar_variance_obeys_the_floor_too() -> None:
    message = raw("pair_request")
    for variance, reason in [(0.0, "not_positive_definite"), (9e-11, "below_sensor_floor")]:
        message[2][1] = [["range", 1, doubles(4.0), doubles(variance), doubles(0, 0, 0, 0, 0, 0)]]
        with pytest.raises(WireError, match=reason):
            decode(msgpack.packb(message), "r1")


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=MAX_MESSAGE_BYTES + 10))
def test_arbitrary_bytes_raise_only_wire_errors(payload: bytes) -> None:
    with pytest.raises(WireError) as refused:
        decode(payload, "r1")
    assert refused.value.reason in REASONS
    peek_header(payload)


edits_of_bytes = st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=3)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(EXAMPLES)), edits_of_bytes)
def test_mutated_messages_raise_only_wire_errors(name: str, edits: list[tuple[int, int]]) -> None:
    payload = bytearray(encode(HEADER, EXAMPLES[name]))
    for position, value in edits:
        payload[position % len(payload)] = value
    try:
        message = decode(bytes(payload), "r1")
    except WireError:
        return
    assert same(decode(encode(message.header, message.body), "r1"), message)


def test_structures_of_any_shape_raise_only_wire_errors() -> None:
    leaves = st.one_of(
        st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(max_size=5), st.binary()
    )
    trees = st.recursive(leaves, lambda inner: st.lists(inner, max_size=8), max_leaves=30)

    @settings(max_examples=200, deadline=None)
    @given(trees, st.integers(0, 8))
    def check(body: Any, kind: int) -> None:
        with pytest.raises(WireError):
            decode(msgpack.packb([[1, "r1", 1, 1, 1, 1, 1], kind, [body, [], []]]), "r1")

    check()


def test_the_header_can_be_read_without_the_body() -> None:
    assert peek_header(put("pair_reply", (2,), None)) == HEADER
    assert peek_header(put("hello", (0, 0), 2)) is None
    assert peek_header(b"\x93") is None
