"""Boundary recordings: what entered a core comes back out of the file, and makes it do the same again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.config import AgentConfig
from agent.config_file import validate
from agent.core import Agent
from agent.effects import Alarm, Broadcast, Effect, Estimate, Publish, RelativeEstimate, Send, Steer, TrackEstimate
from agent.events import (
    ControlReport,
    Event,
    Fix,
    LinkChange,
    Observation,
    Odometry,
    PlannerOverrun,
    Received,
    Tick,
)
from agent.recording import (
    RecordingError,
    RecordingWriter,
    merge,
    pack,
    read_agents,
    read_boundary,
    replay,
    unpack,
)
from network.life_messages import ClockEcho, Hello
from network.messages import (
    Belief,
    Channel,
    Epoch,
    Header,
    Line,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
    TargetBelief,
)
from tests.network.test_wire import example_hypotheses, example_motion, example_round

S = 1_000_000_000


def config(robot: str) -> AgentConfig:
    return validate(
        AgentConfig,
        {
            "version": 1,
            "identity": {"robot": robot},
            "initial": {
                "mean": [0.1 if robot == "r1" else 5.3, 0.2, 0.3],
                "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
            },
            "landmarks": [{"id": "L1", "position": [3.0, 4.0]}],
            "zenoh": {"listen": []},
            "state_dir": "state",
        },
        robot,
    )


def meet(paths: dict[str, Path], seconds: int = 12) -> None:
    """Two robots drive, see a landmark and range each other; each core is recorded."""
    rng = np.random.default_rng(3)
    agents = {robot: Agent(config(robot).settings(7)) for robot in ("r1", "r2")}
    writers: dict[Path, RecordingWriter] = {}
    for robot, path in paths.items():
        writers.setdefault(path, RecordingWriter(path) if path not in writers else writers[path])
        writers[path].add_robot(config(robot), 7)
    seq = 0

    def hand(robot: str, event: Event) -> None:
        nonlocal seq
        effects = agents[robot].handle(event)
        writers[paths[robot]].record(robot, event, effects)
        for effect in effects:
            if isinstance(effect, Send):
                seq += 1
                header = Header(robot, 1, 1, seq, effect.t_meas_ns, event.t_ns)
                hand(effect.peer, Received(event.t_ns, Message(header, effect.body)))

    for k in range(1, seconds + 1):
        now = k * S
        for robot in agents:
            delta = np.array([0.2, 0.0, 0.0, 0.01]) + rng.normal(0.0, 0.01, 4)
            hand(robot, Odometry(now, now - S, now, delta, np.diag([1e-4, 1e-6, 1e-4, 1e-5])))
        hand("r2", Observation(now, now, "range", "landmark:L1", rng.normal(4.0, 0.1, 1), np.eye(1) * 0.01))
        hand("r1", Observation(now, now, "range", "r2", rng.normal(5.0, 0.1, 1), np.eye(1) * 0.01))
        hand("r1", Tick(now + 1))
    for writer in writers.values():
        writer.close()


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "both.mcap"
    meet({"r1": path, "r2": path})
    return path


# --- replaying --------------------------------------------------------------------------------------------


def test_a_recording_replays_bit_for_bit(recorded: Path) -> None:
    for robot in ("r1", "r2"):
        events, effects, broken = replay(recorded, robot)
        assert broken is None
        assert events > 25
        assert effects > 20
    kinds = {type(event) for event, _ in read_boundary(recorded, "r1")}
    assert kinds == {Odometry, Observation, Tick, Received}


def test_a_recording_holds_the_configuration_and_the_start(recorded: Path) -> None:
    assert read_agents(recorded) == {"r1": (config("r1"), 7), "r2": (config("r2"), 7)}


def test_another_configuration_does_something_else(tmp_path: Path, recorded: Path) -> None:
    """The comparison can fail: the same events into a core that starts elsewhere."""
    other = tmp_path / "other.mcap"
    writer = RecordingWriter(other)
    changed = config("r1").model_copy(update={"lateness": config("r1").lateness.model_copy(update={"settle_s": 0.5})})
    writer.add_robot(changed, 7)
    for event, packed in read_boundary(recorded, "r1"):
        writer.record("r1", event, [unpack(data) for data in packed])
    writer.close()
    assert replay(other, "r1")[2] is not None


def test_a_changed_bit_of_an_effect_is_found(tmp_path: Path, recorded: Path) -> None:
    other = tmp_path / "other.mcap"
    writer = RecordingWriter(other)
    writer.add_robot(config("r1"), 7)
    changed = None
    for index, (event, packed) in enumerate(read_boundary(recorded, "r1")):
        effects: list[Effect] = [unpack(data) for data in packed]
        published = [effect for effect in effects if isinstance(effect, Publish)]
        if changed is None and index > 8 and published:
            changed, mean = index, published[0].estimate.mean
            mean[0] = np.nextafter(mean[0], np.inf)
        writer.record("r1", event, effects)
    writer.close()
    assert changed is not None
    assert replay(other, "r1")[2] == changed


# --- files that are not whole -----------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused_but_can_be_read_to_its_end(tmp_path: Path, share: float) -> None:
    path = tmp_path / "whole.mcap"
    meet({"r1": path, "r2": path}, seconds=120)
    whole = [pack(event) for event, _ in read_boundary(path, "r1")]
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(RecordingError, match=r"whole\.mcap: not a complete"):
        replay(path, "r1")
    part = [pack(event) for event, _ in read_boundary(path, "r1", unfinished=True)]
    assert part == whole[: len(part)]
    if share >= 0.3:
        assert 0 < len(part) <= len(whole)
        assert read_agents(path, unfinished=True).keys() == {"r1", "r2"}
    else:
        assert (part, read_agents(path, unfinished=True)) == ([], {})


def data_end(data: bytes) -> int:
    """Where the data of an MCAP file end: what follows is its summary, for other programs to find their way by."""
    place = 8
    while data[place] != 0x0F:
        place += 9 + int.from_bytes(data[place + 1 : place + 9], "little")
    return place


@pytest.mark.parametrize("bit", [0x01, 0x10])
def test_a_bit_that_flips_is_noticed_or_is_of_nothing_that_is_read(tmp_path: Path, bit: int) -> None:
    """Configuration, events and effects; and names and kinds of what holds them, which no chunk's checksum covers."""
    path = tmp_path / "both.mcap"
    meet({"r1": path, "r2": path}, seconds=2)
    whole, before = path.read_bytes(), everything(path)
    end = data_end(whole)
    assert 0.8 * len(whole) < end < len(whole)
    # Every byte of both configurations' heads, and a sample of everything else.
    heads = [whole.index(f"agent/{robot}".encode()) + offset for robot in ("r1", "r2") for offset in range(-13, 20)]
    for place in (*range(0, len(whole), 101), *heads):
        data = bytearray(whole)
        data[place] ^= bit
        path.write_bytes(data)
        try:
            found = everything(path)
        except RecordingError:
            continue
        assert place >= end and found == before, f"byte {place} of {len(whole)}"


def everything(path: Path) -> list[Any]:
    """All that a replay is made from."""
    return [read_agents(path), *([(pack(e), made) for e, made in read_boundary(path, robot)] for robot in ("r1", "r2"))]


def test_a_recording_without_a_checksum_of_all_data_is_read_still(tmp_path: Path, recorded: Path) -> None:
    """As earlier versions wrote them."""
    data, old = bytearray(recorded.read_bytes()), tmp_path / "old.mcap"
    end = data_end(data) + 9
    data[end : end + 4] = bytes(4)
    old.write_bytes(data)
    assert replay(old, "r1") == replay(recorded, "r1")


def test_a_file_that_was_never_closed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "open.mcap"
    writer = RecordingWriter(path)
    writer.add_robot(config("r1"), 7)
    writer.record("r1", Tick(8), Agent(config("r1").settings(7)).handle(Tick(8)))
    with pytest.raises(RecordingError, match="not a complete"):
        read_agents(path)
    writer.close()
    assert replay(path, "r1") == (1, 1, None)


def test_what_is_not_there_or_not_ours_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"gone\.mcap: no such file"):
        read_agents(tmp_path / "gone.mcap")
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(RecordingError, match=r"text\.mcap: not a complete"):
        read_agents(tmp_path / "text.mcap")
    with pytest.raises(RecordingError):
        read_agents(tmp_path)
    foreign = RecordingWriter(tmp_path / "foreign.mcap")
    foreign.close()
    with pytest.raises(RecordingError, match="holds no agent"):
        read_agents(tmp_path / "foreign.mcap")


@pytest.mark.parametrize(
    "metadata",
    [{}, {"config": "{}", "start_ns": "1"}, {"config": "{", "start_ns": "1"}, {"config": "{}", "start_ns": "x"}],
)
def test_an_agent_of_another_version_is_refused_in_one_line(tmp_path: Path, metadata: dict[str, str]) -> None:
    path = tmp_path / "old.mcap"
    writer = RecordingWriter(path)
    writer._writer.add_metadata("agent/r1", metadata)
    writer.close()
    with pytest.raises(RecordingError, match=r"old\.mcap: .*r1"):
        read_agents(path)


@pytest.mark.parametrize("data", [b"\xc1", b"\x01", b"\x81\xa1@\xa5Thing", b"\x81\xa1@\xa4Tick"])
def test_an_event_that_makes_no_sense_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "odd.mcap"
    writer = RecordingWriter(path)
    writer.add_robot(config("r1"), 7)
    writer._add("r1/events", 1, data)
    writer.close()
    with pytest.raises(RecordingError, match=r"odd\.mcap"):
        replay(path, "r1")


def test_a_robot_that_is_not_in_it_is_named(recorded: Path) -> None:
    with pytest.raises(RecordingError, match="no robot 'r9'; it holds r1, r2"):
        replay(recorded, "r9")


# --- merging ----------------------------------------------------------------------------------------------


def test_recordings_of_robots_become_one(tmp_path: Path) -> None:
    paths = {robot: tmp_path / f"{robot}.mcap" for robot in ("r1", "r2")}
    meet(paths)
    merge({robot: [path] for robot, path in paths.items()}, tmp_path / "both.mcap")
    assert read_agents(tmp_path / "both.mcap") == {"r1": (config("r1"), 7), "r2": (config("r2"), 7)}
    for robot, path in paths.items():
        assert replay(tmp_path / "both.mcap", robot) == replay(path, robot)
        assert replay(path, robot)[2] is None


def test_what_a_killed_robot_left_is_merged_too(tmp_path: Path) -> None:
    paths = {robot: tmp_path / f"{robot}.mcap" for robot in ("r1", "r2", "r3")}
    meet({robot: paths[robot] for robot in ("r1", "r2")}, seconds=120)
    whole = replay(paths["r2"], "r2")[0]
    data = paths["r2"].read_bytes()
    paths["r2"].write_bytes(data[: len(data) * 2 // 3])
    paths["r3"].write_bytes(b"")
    merge({robot: [path] for robot, path in paths.items()}, tmp_path / "all.mcap")
    assert read_agents(tmp_path / "all.mcap").keys() == {"r1", "r2"}
    events, _, broken = replay(tmp_path / "all.mcap", "r2")
    assert 0 < events < whole
    # The last event of a killed robot may have lost its effects.
    assert broken is None or broken == events


# --- values -----------------------------------------------------------------------------------------------

BELIEF = Belief("unicycle", np.array([1.0, 2.0, -0.0]), np.eye(3) * 0.1)
SNAPSHOT = Snapshot(
    BELIEF,
    Epoch(4, "r1", 2),
    np.arange(9.0).reshape(3, 3),
    np.eye(3),
    (Line(Epoch(5, "r2", 1), np.ones((3, 3))),),
    (TargetBelief("t1", BELIEF),),
    False,
)
RANGE = Measurement("range", np.array([4.2]), np.eye(1), (0.1, 0.2, 0.0, 0.0, 0.0, 0.3))
REQUEST = PairRequest(Epoch(9, "r2", 3), (RANGE,), SNAPSHOT)
HEADER = Header("r2", 2**60, 3, 17, 5, 6)
SEEN = RelativeEstimate("p1", 4, np.arange(4.0), np.eye(4), 0.75, 0.25, 2, True)
VALUES: list[Any] = [
    Tick(2**62),
    Odometry(3, 1, 2, np.array([1.0, np.pi, 0.0, 1e-300]), np.eye(4)),
    Fix(3, 2, "pose", np.zeros(3), np.eye(3), "gps"),
    Observation(3, 2, "range", None, np.array([1.0]), np.eye(1), "uwb", (0.1, 0.0, 0.0)),
    Received(3, Message(HEADER, REQUEST), -5, None),
    Received(3, Message(HEADER, PairReply(Epoch(9, "r2", 3), ReplyStatus.BUSY)), 5, 7),
    Received(3, Message(HEADER, Hello("v", (ClockEcho("r1", 1, 2),)))),
    LinkChange(3, "r2", False, 4, 2**60),
    Send("r2", 5, PairReply(Epoch(9, "r2", 3), ReplyStatus.OK, SNAPSHOT)),
    Broadcast(Channel.BELIEF, 5, Hello("v")),
    Publish(Estimate(5, "unicycle", np.zeros(3), np.eye(3), (TrackEstimate("t1", "unicycle", np.ones(3), np.eye(3)),))),
    Publish(Estimate(5, "spatial", np.zeros(4), np.eye(4), (), (SEEN,))),
    Received(3, Message(HEADER, example_motion())),
    Received(3, Message(HEADER, example_hypotheses())),
    Alarm("lost", "r2"),
    Received(3, Message(HEADER, example_round())),
    Steer((0.5, 0.0, -0.0), 0.25, 7),
    ControlReport(3, None),
    PlannerOverrun(3),
]


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_every_event_and_effect_keeps_every_bit(value: Any) -> None:
    copy = unpack(pack(value))
    assert type(copy) is type(value)
    assert pack(copy) == pack(value)
    same(copy, value)


def same(copy: Any, value: Any) -> None:
    """Field by field, types and array bits included."""
    assert type(copy) is type(value)
    if isinstance(value, np.ndarray):
        assert (copy.dtype, copy.shape, copy.tobytes()) == (value.dtype, value.shape, value.tobytes())
        assert copy.flags.writeable
    elif isinstance(value, tuple):
        assert len(copy) == len(value)
        for left, right in zip(copy, value, strict=True):
            same(left, right)
    elif hasattr(value, "__dataclass_fields__"):
        for name in value.__dataclass_fields__:
            same(getattr(copy, name), getattr(value, name))
    else:
        assert copy == value


@given(st.lists(st.floats(width=64), min_size=4, max_size=4))
def test_numbers_of_any_kind_keep_every_bit(numbers: list[float]) -> None:
    event = Odometry(3, 1, 2, np.array(numbers), np.diag(numbers))
    copy = unpack(pack(event))
    assert copy.delta.tobytes() == event.delta.tobytes()
    assert copy.cov.tobytes() == event.cov.tobytes()
