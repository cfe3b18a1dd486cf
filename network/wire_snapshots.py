"""Wire format of beliefs: robots and targets apart or in one, with factors or with a split covariance.

Numbers travel as `network.wire` says; what a reader returns satisfies every limit stated here and there.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from network.messages import (
    MAX_GROUP,
    MAX_JOINT_DIM,
    MAX_LINES,
    MAX_STATE_DIM,
    MAX_TARGETS,
    JointSnapshot,
    Line,
    Snapshot,
    SplitSnapshot,
    TargetBelief,
)
from network.wire_fields import (
    BELIEF_FLOOR,
    FULL,
    MAX_ABS,
    WireError,
    checked_cov,
    is_part,
    pack_array,
    pack_belief,
    pack_cov,
    pack_epoch,
    pack_single,
    read_array,
    read_belief,
    read_contact,
    read_cov,
    read_dim,
    read_epoch,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_single,
    read_single_or_none,
    read_text,
)


def pack_snapshot(snapshot: Snapshot) -> tuple[Any, ...]:
    """The fields of a snapshot with targets apart. Raises ValueError for arrays of wrong sizes."""
    n = len(snapshot.belief.mean)
    columns = snapshot.factor.shape[-1]
    return (
        pack_belief(snapshot.belief),
        pack_epoch(snapshot.base),
        columns,
        pack_array(snapshot.factor, (n, columns)),
        pack_array(snapshot.line, (n, n)),
        tuple((pack_epoch(line.epoch), pack_array(line.matrix, (n, n))) for line in snapshot.lines),
        tuple(pack_target(target) for target in snapshot.targets),
        snapshot.known,
    )


def pack_target(target: TargetBelief) -> tuple[Any, ...]:
    return (target.target, *pack_belief(target.belief), target.age_ns)


def pack_split(snapshot: SplitSnapshot) -> tuple[Any, ...]:
    """The fields of a belief with a split covariance. Raises ValueError for arrays of wrong sizes."""
    n = len(snapshot.mean)
    return (
        snapshot.model,
        snapshot.targets,
        pack_array(snapshot.mean, (n,)),
        pack_cov(snapshot.cov, n),
        None if snapshot.private is None else pack_cov(snapshot.private, n),
        snapshot.ages_ns,
        tuple(pack_target(target) for target in snapshot.relayed),
    )


def pack_joint(snapshot: JointSnapshot) -> tuple[Any, ...]:
    """The fields of a joint belief with factors. Raises ValueError for arrays of wrong sizes."""
    n = len(snapshot.mean)
    c = n - read_dim(snapshot.model)
    columns = 0 if snapshot.factor is None else snapshot.factor.shape[-1]
    return (
        snapshot.model,
        snapshot.targets,
        pack_array(snapshot.mean, (n,)),
        pack_cov(snapshot.cov, n, "<f4"),
        pack_epoch(snapshot.base),
        columns,
        pack_single(snapshot.factor, (n, columns)),
        pack_single(snapshot.line, (n, n)),
        pack_single(snapshot.noise, (n, c)),
        pack_single(snapshot.prior, (n, c)),
        float(snapshot.span_s),
        tuple((pack_epoch(line.epoch), pack_single(line.matrix, line.matrix.shape)) for line in snapshot.lines),
        snapshot.known,
        snapshot.anew,
        None if snapshot.group is None else tuple(sorted(snapshot.group)),
    )


def _line(raw: Any, n: int) -> Line:
    epoch, matrix = read_fields(raw, 2)
    return Line(read_contact(epoch), read_array(matrix, n * n).reshape(n, n))


def read_target(raw: Any) -> TargetBelief:
    fields = read_fields(raw, 6)
    return TargetBelief(read_id(fields[0]), read_belief(fields[1:5]), read_integer(fields[5]))


def read_snapshot(raw: Any) -> Snapshot:
    """What `pack_snapshot` made, or `WireError`."""
    belief_raw, base, columns, factor, line, lines_raw, targets_raw, known = read_fields(raw, 8)
    belief = read_belief(belief_raw)
    n = len(belief.mean)
    m = read_integer(columns, MAX_STATE_DIM)
    lines = tuple(_line(item, n) for item in read_items(lines_raw, MAX_LINES))
    if any(later.epoch <= earlier.epoch for earlier, later in pairwise(lines)):
        raise WireError("malformed")
    targets = tuple(read_target(item) for item in read_items(targets_raw, MAX_TARGETS))
    if len({target.target for target in targets}) != len(targets):
        raise WireError("malformed")
    if type(known) is not bool:
        raise WireError("wrong_type")
    return Snapshot(
        belief=belief,
        base=read_epoch(base),
        factor=read_array(factor, n * m).reshape(n, m),
        line=read_array(line, n * n).reshape(n, n),
        lines=lines,
        targets=targets,
        known=known,
    )


def _robot_and_targets(model: Any, targets_raw: Any) -> tuple[tuple[tuple[str, str], ...], int, int]:
    """Targets (id, model) of a joint belief, its size and that of the targets together."""
    targets = []
    for item in read_items(targets_raw, MAX_TARGETS):
        name, target_model = read_fields(item, 2)
        targets.append((read_id(name), read_text(target_model)))
    if len({name for name, _ in targets}) != len(targets):
        raise WireError("malformed")
    c = sum(read_dim(target_model) for _, target_model in targets)
    n = read_dim(model) + c
    if n > MAX_JOINT_DIM:
        raise WireError("out_of_range")
    return tuple(targets), n, c


def read_split(raw: Any) -> SplitSnapshot:
    """What `pack_split` made, or `WireError`."""
    model, targets_raw, mean, cov_raw, private_raw, ages_raw, relayed_raw = read_fields(raw, 7)
    targets, n, _ = _robot_and_targets(model, targets_raw)
    ages_ns = tuple(read_integer(item) for item in read_items(ages_raw, MAX_TARGETS))
    relayed = tuple(read_target(item) for item in read_items(relayed_raw, MAX_TARGETS))
    names = {name for name, _ in targets} | {item.target for item in relayed}
    if len(ages_ns) != len(targets) or len(names) != len(targets) + len(relayed):
        raise WireError("malformed")
    cov = read_cov(cov_raw, n, BELIEF_FLOOR, "not_positive_definite")
    private = None
    if private_raw is not None:
        private = read_array(private_raw, n * (n + 1) // 2)[FULL[n]]
        if not is_part(private, cov):
            raise WireError("not_positive_definite")
    return SplitSnapshot(model, targets, read_array(mean, n), cov, private, ages_ns, relayed)


def read_joint(raw: Any) -> JointSnapshot:
    """What `pack_joint` made, or `WireError`."""
    fields = read_fields(raw, 15)
    model, targets_raw, mean, cov, base, columns, factor, line, noise, prior, span_s = fields[:11]
    lines_raw, known, anew, group = fields[11:]
    targets, n, c = _robot_and_targets(model, targets_raw)
    m = read_integer(columns, MAX_JOINT_DIM)
    if type(known) is not bool or type(anew) is not bool or type(span_s) is not float:
        raise WireError("wrong_type")
    if not 0.0 <= span_s <= MAX_ABS:
        raise WireError("out_of_range" if math.isfinite(span_s) else "non_finite")
    lines = []
    for item in read_items(lines_raw, MAX_LINES):
        epoch, matrix = read_fields(item, 2)
        wide = type(matrix) is bytes and len(matrix) > 4 * n * n
        lines.append(Line(read_contact(epoch), read_single(matrix, n, n + c if wide else n)))
    if any(later.epoch <= earlier.epoch for earlier, later in pairwise(lines)):
        raise WireError("malformed")
    packed = read_single(cov, n * (n + 1) // 2)
    return JointSnapshot(
        model=model,
        targets=targets,
        mean=read_array(mean, n),
        cov=checked_cov(packed, n, BELIEF_FLOOR, "not_positive_definite"),
        base=read_epoch(base),
        factor=read_single_or_none(factor, n, m),
        line=read_single_or_none(line, n, n),
        noise=read_single_or_none(noise, n, c),
        prior=read_single_or_none(prior, n, c),
        span_s=span_s,
        lines=tuple(lines),
        known=known,
        anew=anew,
        group=None if group is None else _group(group),
    )


def _group(raw: Any) -> frozenset[str]:
    names = [read_id(item) for item in read_items(raw, MAX_GROUP)]
    if any(later <= earlier for earlier, later in pairwise(names)):
        raise WireError("malformed")
    return frozenset(names)
