"""What a robot knows, as bytes it can begin with again: written by the core, read with every limit.

Who keeps correlation factors (`safe`, `published`, `joint`) goes on with them. That needs bytes that are not older than
the last message of a contact: what peers have been told is in them as lines and bases then, and what was learnt since
is forgotten by one side only, as if a reply had been lost (`agent.pairing`). The shell writes before it sends.

Who keeps none (`split_joint`, `auto`, the kinds `jlatt`, `leader`, `relative`, `fixed`) begins with its belief, all of
which counts as shared, correlated with everybody's in an unknown way. That holds however old the bytes are and whatever
was said since.

Either way the state is of its instant, and the robot coasts from there: it does not know how it moved meanwhile.

Without usable bytes a robot begins a new life, and `begun_again` says with what belief. Kind `replica` always does: its
belief follows from raw data, which its team tells no more.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from agent.belief import BlockKey, CorrelationStack, PairRecord, Part, RobotState, TargetState
from agent.estimation.split_joint import Split
from agent.health import SavedVerdict
from agent.joint_layout import JointLayout
from agent.joint_tracks import JointState, RelayedTrack
from agent.settings import AgentSettings, LocalizationSettings
from agent.state_fields import (
    StateError,
    read_amount,
    read_by_id,
    read_cov,
    read_dim,
    read_flag,
    read_many,
    read_stamp,
    read_targets,
)
from network.messages import MAX_GROUP, MAX_JOINT_DIM, NEVER, Epoch
from network.wire_fields import (
    WireError,
    pack_epoch,
    read_array,
    read_contact,
    read_epoch,
    read_fields,
    read_id,
    read_integer,
    read_items,
    read_text,
)

Array = NDArray[np.float64]

FORMAT = 3
MAX_BYTES = 4_000_000
MAX_WINDOW = 1000
"""Contacts with a peer that a verdict on it may rest on."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedExchange:
    """Of the protocol with one peer: contacts opened so far, the last one, and until when the peer may receive it.

    `refused`: the latest of the peer's contacts that was answered as inconsistent.
    """

    counter: int
    opened: Epoch = NEVER
    until_ns: int = 0
    refused: Epoch = NEVER


@dataclass(frozen=True, slots=True, eq=False)
class SavedFactors:
    """A belief with correlation factors, and what the pair protocol must remember, by peer.

    `lives`: (incarnation, boot id). `inflated_ns`: when a peer has last begun anew. The rest is of the form `joint`.
    """

    state: RobotState
    exchanges: dict[str, SavedExchange] = field(default_factory=dict)
    lives: dict[str, tuple[int, int]] = field(default_factory=dict)
    inflated_ns: dict[str, int] = field(default_factory=dict)
    group: frozenset[str] | None = None
    nonlinearity: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class SavedSplit:
    """A belief all of which counts as shared, and the last contact used, by peer.

    `until_ns`: what peers have asked at instants up to then may be in the belief; None: it is not.
    `asked`: the latest instant on the peer's clock, and the highest number, of its requests that were answered.
    """

    state: JointState
    contacts: dict[str, Epoch] = field(default_factory=dict)
    until_ns: int | None = None
    asked: dict[str, tuple[int, int]] = field(default_factory=dict)


Saved = SavedFactors | SavedSplit


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """A state that fits its settings. `start_ns`: when the robot first started, which may be long ago.

    `verdicts`: what is known of peers, see `agent.health`.
    """

    start_ns: int
    saved: Saved
    verdicts: dict[str, SavedVerdict] = field(default_factory=dict)

    @property
    def t_ns(self) -> int:
        """The instant it is of."""
        return self.saved.state.t_ns

    def check_age(self, now_ns: int, max_age_ns: int, run_ns: int | None = None) -> None:
        """Raises `StateError` if it is not of the time before `now_ns`, or of before the run began at `run_ns`."""
        if run_ns is not None and self.t_ns < run_ns:
            raise StateError("earlier_run")
        if self.t_ns > now_ns:
            raise StateError("from_future")
        if now_ns - self.t_ns > max_age_ns:
            raise StateError("too_old")

    def settings(self, settings: AgentSettings) -> AgentSettings:
        """Those of a robot that knows where it is, and has for some time."""
        return replace(settings, source="survey", start_ns=self.start_ns, shared=None, found_out=True)


def begun_again(settings: AgentSettings) -> AgentSettings:
    """The settings of a new life that begins with the survey its last life began with too.

    The robot coasts from the survey's instant to now, it does not pretend to be there still. Peers may have learnt of
    the survey's error in the last life. Factors: they double their covariance when they see the new life (P_ab = 0 from
    then on, `agent.pairs`), and this side is doubled here: blk(2 P_a, 2 P_b) bounds the joint covariance. Otherwise the
    whole belief counts as shared. A fix, or a place that a peer tells, is new information, and needs nothing.
    """
    localization = settings.localization
    alone = settings.source != "survey" or localization.kind in ("replica", "jlatt", "leader", "relative", "fixed")
    if alone or settings.unsafe.trust_restarts:
        return settings
    if localization.form in ("auto", "split_joint"):
        return replace(settings, shared=settings.cov, found_out=True)
    if localization.form != "joint":
        return replace(settings, cov=2.0 * settings.cov)
    targets = tuple(replace(target, cov=2.0 * target.cov) for target in settings.targets)
    return replace(settings, cov=2.0 * settings.cov, targets=targets)


def given_up(settings: AgentSettings, payload: bytes) -> bytes | None:
    """A state to begin a new life with in which nothing is left that peers may rely on; None: there is none.

    As in `begun_again`: peers double their covariance when they see the new life, and this side is doubled here, which
    bounds the joint covariance whatever the correlation was. Without factors all of the belief counts as shared.
    Form `joint` begins with its survey again.
    """
    restored = decode(payload, settings)
    if isinstance(restored.saved, SavedSplit):
        return payload
    if settings.localization.form == "joint":
        return None
    state = restored.saved.state
    cov = state.cov if settings.unsafe.trust_restarts else 2.0 * state.cov
    stack = state.stack.changed({}, tuple(state.stack.blocks))
    alone = RobotState(state.t_ns, state.mean, cov, stack, {}, state.targets)
    return encode(restored.settings(settings), SavedFactors(alone), restored.verdicts)


# -- writing --------------------------------------------------------------------------------------------------


def encode(settings: AgentSettings, saved: Saved, verdicts: dict[str, SavedVerdict]) -> bytes:
    """The bytes of a state of a robot of these settings, and of its verdicts on peers."""
    form: str
    if isinstance(saved, SavedFactors):
        form, body = settings.localization.form, _factors(settings, saved)
    else:
        form, body = _form(settings.localization), _split(settings, saved)
    state = saved.state
    head = FORMAT, settings.robot, form, settings.layout.name, settings.start_ns, state.t_ns
    payload: bytes = msgpack.packb(
        [*head, _bytes(state.mean), _bytes(saved.state.cov), body, _verdicts(verdicts)]
    )
    return payload


def _form(localization: LocalizationSettings) -> str:
    """What a state that fits these settings calls itself."""
    if localization.kind != "clat":
        return localization.kind
    return "split_joint" if localization.form == "auto" else localization.form


def _bytes(array: Array) -> bytes:
    return np.ascontiguousarray(array, "<f8").tobytes()


def _verdicts(verdicts: dict[str, SavedVerdict]) -> list[Any]:
    return [
        [peer, list(item.recent), list(item.good), item.quarantined, item.since_ns, item.nis]
        for peer, item in verdicts.items()
    ]


def _factors(settings: AgentSettings, saved: SavedFactors) -> list[Any]:
    state = saved.state
    models = JointLayout(settings).models if settings.localization.form == "joint" else ()
    known = {target.id: target.motion.layout.name for target in settings.targets}
    targets = [
        [name, known[name], _bytes(item.mean), _bytes(item.cov), item.updated_ns, item.learnt_ns]
        for name, item in state.targets.items()
    ]
    blocks = [
        [int(part), peer, pack_epoch(epoch), end - begin, _bytes(state.stack.matrix[:, begin:end])]
        for (part, peer, epoch), (begin, end) in state.stack.blocks.items()
    ]
    exchanges = [
        [peer, item.counter, pack_epoch(item.opened), item.until_ns, pack_epoch(item.refused)]
        for peer, item in saved.exchanges.items()
    ]
    return [
        [list(item) for item in models],
        targets,
        blocks,
        [[peer, *_record(record)] for peer, record in state.pairs.items()],
        _record(state.stranger),
        exchanges,
        [[peer, *life] for peer, life in saved.lives.items()],
        [list(item) for item in saved.inflated_ns.items()],
        None if saved.group is None else sorted(saved.group),
        saved.nonlinearity,
    ]


def _record(record: PairRecord) -> list[Any]:
    return [pack_epoch(record.base), record.known, [pack_epoch(epoch) for epoch in record.lines], record.anew]


def _split(settings: AgentSettings, saved: SavedSplit) -> list[Any]:
    state = saved.state
    known = {target.id: target.motion.layout.name for target in settings.targets}
    relayed = [
        [name, known[name], _bytes(item.mean), _bytes(item.cov), item.learnt_ns, item.firm]
        for name, item in state.relayed.items()
    ]
    return [
        [[name, known[name], learnt_ns] for name, learnt_ns in zip(state.tracks, state.learnt_ns)],
        relayed,
        [list(item) for item in state.doubted.items()],
        [[peer, pack_epoch(epoch)] for peer, epoch in saved.contacts.items()],
        [[peer, *asked] for peer, asked in saved.asked.items()],
    ]


# -- reading --------------------------------------------------------------------------------------------------


def decode(payload: bytes, settings: AgentSettings) -> Restored:
    """The state for a robot of these settings. Raises `StateError`."""
    if len(payload) > MAX_BYTES:
        raise StateError("oversize")
    try:
        return _decoded(msgpack.unpackb(payload, use_list=False, max_map_len=0, max_ext_len=0), settings)
    except WireError as error:
        raise StateError(error.reason) from None
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise StateError(error.reason if isinstance(error, StateError) else "malformed") from None


def _decoded(raw: Any, settings: AgentSettings) -> Restored:
    if type(raw) is not tuple or not raw or type(raw[0]) is not int:
        raise StateError("malformed")
    if raw[0] != FORMAT:
        raise StateError("other_version")
    _, robot, form, model, start, instant, mean, cov, body, verdicts = read_fields(raw, 10)
    if read_id(robot) != settings.robot:
        raise StateError("other_robot")
    expected = _form(settings.localization)
    if expected == "replica" or read_text(form) != expected:
        raise StateError("other_form")
    if read_text(model) != settings.layout.name:
        raise StateError("other_model")
    start_ns, t_ns = read_stamp(start), read_stamp(instant)
    if start_ns > t_ns:
        raise StateError("inconsistent")
    read = _read_split if expected in ("split_joint", "jlatt", "leader", "relative", "fixed") else _read_factors
    return Restored(start_ns, read(settings, t_ns, mean, cov, body), read_by_id(verdicts, 5, _read_verdict))


def _read_verdict(fields: tuple[Any, ...]) -> SavedVerdict:
    recent, good, quarantined, since_ns, nis = fields
    return SavedVerdict(
        tuple(read_amount(item) for item in read_items(recent, MAX_WINDOW)),
        tuple(read_amount(item) for item in read_items(good, MAX_WINDOW)),
        read_flag(quarantined),
        None if since_ns is None else read_stamp(since_ns),
        read_amount(nis),
    )


def _read_factors(settings: AgentSettings, t_ns: int, mean: Any, cov: Any, body: Any) -> SavedFactors:
    models, targets, blocks, pairs, stranger, exchanges, lives, inflated, group, nonlinearity = read_fields(body, 10)
    joint = JointLayout(settings) if settings.localization.form == "joint" else None
    if models != (() if joint is None else joint.models):
        raise StateError("other_model")
    n = settings.layout.dim if joint is None else joint.state.dim
    c = n - settings.layout.dim
    state = RobotState(
        t_ns,
        read_array(mean, n).copy(),
        read_cov(cov, n),
        _read_stack(blocks, n),
        read_by_id(pairs, 4, lambda fields: _read_record(fields, settings.localization.max_lines)),
        read_targets(settings, targets, lambda x, P, f: TargetState(x, P, read_stamp(f[0]), read_stamp(f[1]))),
        _read_record(read_fields(stranger, 4), 0),
    )
    if state.targets and joint is not None:
        raise StateError("inconsistent")
    _check_stack(state, n, c, joint is not None)
    return SavedFactors(
        state,
        read_by_id(exchanges, 4, _read_exchange),
        read_by_id(lives, 2, lambda f: (read_integer(f[0]), read_integer(f[1]))),
        read_by_id(inflated, 1, lambda f: read_stamp(f[0])),
        None if group is None else frozenset(read_id(item) for item in read_items(group, MAX_GROUP)),
        read_amount(nonlinearity),
    )


def _read_exchange(fields: tuple[Any, ...]) -> SavedExchange:
    counter, opened, until, refused = fields
    return SavedExchange(read_integer(counter), read_epoch(opened), read_stamp(until), read_epoch(refused))


def _read_stack(raw: Any, n: int) -> CorrelationStack:
    found: dict[BlockKey, tuple[int, int]] = {}
    parts, column = [np.zeros((n, 0))], 0
    for item in read_many(raw):
        part, peer, epoch, width, data = read_fields(item, 5)
        key = Part(read_integer(part, max(Part))), read_text(peer) and read_id(peer), read_epoch(epoch)
        if key in found:
            raise StateError("inconsistent")
        columns = read_integer(width, 2 * MAX_JOINT_DIM)
        parts.append(read_array(data, n * columns).reshape(n, columns))
        found[key] = (column, column + columns)
        column += columns
    return CorrelationStack(np.concatenate(parts, axis=1), found)


def _check_stack(state: RobotState, n: int, c: int, joint: bool) -> None:
    """Raises `StateError` unless there are exactly the blocks that the pairs' records speak of, of the right sizes."""
    due: dict[BlockKey, range] = {}
    line = range(n + c, n + c + 1)
    if joint:
        due[Part.COMMON, "", NEVER] = range(2 * c, 2 * c + 1)
    for peer, record in state.pairs.items():
        if record.base.met:
            due[Part.FACTOR, peer, NEVER] = range(1, MAX_JOINT_DIM + 1)
            due[Part.BASE_LINE, peer, NEVER] = line
        due |= {(Part.LINE, peer, epoch): line for epoch in record.lines}
    blocks = state.stack.blocks
    if due.keys() != blocks.keys() or any(end - begin not in due[key] for key, (begin, end) in blocks.items()):
        raise StateError("inconsistent")


def _read_record(fields: tuple[Any, ...], most: int) -> PairRecord:
    base, known, lines, anew = fields
    epochs = tuple(read_contact(epoch) for epoch in read_items(lines, most))
    if list(epochs) != sorted(set(epochs)):
        raise StateError("inconsistent")
    return PairRecord(read_epoch(base), read_flag(known), epochs, read_flag(anew))


def _read_split(settings: AgentSettings, t_ns: int, mean: Any, cov: Any, body: Any) -> SavedSplit:
    raw_tracks, relayed, doubted, contacts, asked = read_fields(body, 5)
    followed, n = {}, settings.layout.dim
    for item in read_many(raw_tracks):
        target, model, learnt = read_fields(item, 3)
        n += read_dim(settings, target, model)
        followed[target] = read_stamp(learnt)
    if len(followed) != len(raw_tracks):
        raise StateError("inconsistent")
    P = read_cov(cov, n)
    state = JointState(
        t_ns,
        read_array(mean, n).copy(),
        Split(np.zeros((n, n)), P),
        tuple(followed),
        tuple(followed.values()),
        read_targets(settings, relayed, lambda x, P, f: RelayedTrack(x, P, read_stamp(f[0]), read_flag(f[1]))),
        read_by_id(doubted, 1, lambda f: read_integer(f[0], 2**31)),
    )
    if followed.keys() & state.relayed.keys():
        raise StateError("inconsistent")
    return SavedSplit(
        state,
        read_by_id(contacts, 1, lambda f: read_contact(f[0])),
        t_ns,
        read_by_id(asked, 2, lambda f: (read_stamp(f[0]), read_integer(f[1]))),
    )
