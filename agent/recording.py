"""Boundary recording: every event that enters a core and every effect that leaves it, in one MCAP file.

A recording holds the agent's configuration too, so it can be played back into a core anywhere; on one machine
the effects come out bit for bit the same. Topics: `<robot>/events`, `<robot>/effects`, and `<robot>/lives` for starts
of a robot that has lived before; message encoding msgpack.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import numpy as np
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from agent import effects as effect_types
from agent import events as event_types
from agent.config import AgentConfig
from agent.core import Agent
from agent.effects import Effect, Persist
from agent.events import Event
from agent.saved_state import begun_again
from network import bearing_messages, leader_messages, life_messages, relative_messages
from network import messages as message_types

_TYPES: dict[str, type] = {
    name: value
    for module in (
        message_types,
        life_messages,
        bearing_messages,
        leader_messages,
        relative_messages,
        event_types,
        effect_types,
    )
    for name, value in vars(module).items()
    if isinstance(value, type) and is_dataclass(value)
}
_ENUMS = {kind.__name__: kind for kind in (message_types.ReplyStatus, message_types.RoundStage)}


class RecordingError(ValueError):
    """A recording that cannot be read; the message names the file and what is wrong."""


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {"@": "array", "shape": list(value.shape), "data": np.ascontiguousarray(value, "<f8").tobytes()}
    if isinstance(value, IntEnum):
        return {"@": type(value).__name__, "value": int(value)}
    if is_dataclass(value) and not isinstance(value, type):
        return {"@": type(value).__name__, **{f.name: _plain(getattr(value, f.name)) for f in fields(value)}}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, frozenset):
        return {"@": "frozenset", "items": sorted(value)}
    return value


def _object(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(_object(item) for item in value)
    if not isinstance(value, dict):
        return value
    name = value.get("@")
    if name == "array":
        return np.frombuffer(value["data"], "<f8").reshape(value["shape"]).copy()
    if name in _ENUMS:
        return _ENUMS[name](value["value"])
    if name == "frozenset":
        return frozenset(value["items"])
    if name is None:
        return {key: _object(item) for key, item in value.items()}
    return _TYPES[name](**{key: _object(item) for key, item in value.items() if key != "@"})


def _recorded(effects: list[Effect]) -> list[Effect]:
    """Effects but the states to be kept: they are large, and a replay makes them again."""
    return [effect for effect in effects if not isinstance(effect, Persist)]


def pack(value: Event | Effect) -> bytes:
    """An event or effect as bytes; arrays keep every bit."""
    data: bytes = msgpack.packb(_plain(value))
    return data


def unpack(data: bytes) -> Any:
    """The event or effect that `pack` was given."""
    return _object(msgpack.unpackb(data))


class RecordingWriter:
    """Writes the boundary of one or several cores to a file."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("wb")
        # Small chunks: a writer that is killed loses only the last one. Chunks have checksums anyway; that of all data
        # covers what is between them too, configurations above all.
        self._writer = Writer(
            self._file, chunk_size=1 << 14, compression=CompressionType.NONE, enable_data_crcs=True
        )
        self._writer.start(profile="cofix", library="cofix")
        self._channels: dict[str, int] = {}
        self._sequence = 0

    def add_robot(self, config: AgentConfig, start_ns: int) -> None:
        """Announce a robot: its configuration and the instant its core started at."""
        robot = config.identity.robot
        self._writer.add_metadata(
            f"agent/{robot}", {"config": json.dumps(config.model_dump()), "start_ns": str(start_ns)}
        )

    def begin_life(self, robot: str, t_ns: int, state: bytes | None) -> None:
        """A robot that has lived before begins, with the state it has kept or with none."""
        self._add(f"{robot}/lives", t_ns, msgpack.packb(state))

    def record(self, robot: str, event: Event, effects: list[Effect]) -> None:
        """One call of a core."""
        self._add(f"{robot}/events", event.t_ns, pack(event))
        for effect in _recorded(effects):
            self._add(f"{robot}/effects", event.t_ns, pack(effect))

    def _add(self, topic: str, t_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", 0)
        self._sequence += 1
        stamp = max(t_ns, 0)
        self._writer.add_message(self._channels[topic], stamp, data, stamp, self._sequence)

    def flush(self) -> None:
        """Hand what was recorded to the operating system: it stays if this process is killed."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Finish the file; a file that was not closed is refused by readers."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def abandon(self) -> None:
        """Give an unfinished file up. Raises OSError."""
        self._file.close()


def _records(path: Path, unfinished: bool) -> Iterator[Any]:
    """Raw records of a file in order. Raises `RecordingError`; an unfinished file may be read up to its end."""
    try:
        with path.open("rb") as file:
            yield from StreamReader(file, validate_crcs=True).records
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except Exception:
        if not unfinished:
            raise RecordingError(f"{path}: not a complete MCAP recording; record it again") from None


def read_agents(path: Path, unfinished: bool = False) -> dict[str, tuple[AgentConfig, int]]:
    """Configuration and start instant of every robot in a recording. Raises `RecordingError`."""
    agents = {}
    for record in _records(path, unfinished):
        if isinstance(record, Metadata) and record.name.startswith("agent/"):
            robot = record.name.removeprefix("agent/")
            try:
                config = AgentConfig.model_validate(json.loads(record.metadata["config"]))
                agents[robot] = (config, int(record.metadata["start_ns"]))
            except (KeyError, ValueError):
                raise RecordingError(
                    f"{path}: the configuration of '{robot}' is of another version; replay it with the one it is from"
                ) from None
    if not agents and not unfinished:
        raise RecordingError(f"{path}: holds no agent; it was not written by cofix")
    return agents


def read_boundary(path: Path, robot: str, unfinished: bool = False) -> Iterator[tuple[Event, list[bytes]]]:
    """Events of a robot in order, over all its lives, each with the packed effects that followed it.

    `unfinished` accepts a file whose writer was killed and yields what is in it. Raises `RecordingError`.
    """
    for what in read_lives(path, robot, unfinished):
        if isinstance(what, tuple):
            yield what


@dataclass(frozen=True, slots=True)
class Life:
    """The start of a robot that has lived before, and the state it has kept."""

    t_ns: int
    state: bytes | None


def read_lives(path: Path, robot: str, unfinished: bool = False) -> Iterator[Life | tuple[Event, list[bytes]]]:
    """What `read_boundary` tells, and between that the starts of a robot that has lived before."""
    topics: dict[int, str] = {}
    event: Event | None = None
    followed: list[bytes] = []
    for record in _records(path, unfinished):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics.get(record.channel_id)
            if topic == f"{robot}/effects":
                followed.append(record.data)
            elif topic in (f"{robot}/events", f"{robot}/lives"):
                if event is not None:
                    yield event, followed
                event, followed = None, []
                if topic == f"{robot}/events":
                    event = _event(path, record.data)
                else:
                    yield Life(record.log_time, msgpack.unpackb(record.data))
    if event is not None:
        yield event, followed


def _event(path: Path, data: bytes) -> Event:
    try:
        event = unpack(data)
    except Exception:
        event = None
    if not isinstance(event, Event):
        raise RecordingError(f"{path}: holds an event of another version; replay it with the one it is from")
    return event


def replay(path: Path, robot: str) -> tuple[int, int, int | None]:
    """Play a robot's events into a fresh core.

    Returns (events, effects, index of the first event whose effects differ or None). Raises `RecordingError`.
    """
    agents = read_agents(path)
    if robot not in agents:
        raise RecordingError(f"{path}: no robot '{robot}'; it holds {', '.join(sorted(agents))}")
    config, start_ns = agents[robot]
    agent = Agent(config.settings(start_ns))
    events = effects = 0
    cut: int | None = None
    for what in read_lives(path, robot):
        if isinstance(what, Life):
            # A life that was killed may end before the effects of its last event are written.
            cut = None
            settings = config.settings(start_ns)
            agent = Agent(settings if what.state is not None else begun_again(settings), what.state)
            continue
        if cut is not None:
            return cut, effects, cut
        event, recorded = what
        made = [pack(effect) for effect in _recorded(agent.handle(event))]
        if made != recorded:
            if made[: len(recorded)] != recorded:
                return events, effects, events
            cut = events
        events += 1
        effects += len(recorded)
    return (events, effects, None) if cut is None else (cut, effects, cut)


def merge(paths: dict[str, list[Path]], target: Path) -> None:
    """Write the recordings of several robots, one for each of their lives, into one file."""
    writer = RecordingWriter(target)
    for robot, lives in paths.items():
        known = next((found for path in lives if (found := read_agents(path, unfinished=True).get(robot))), None)
        if known is None:
            continue
        writer.add_robot(*known)
        for path in lives:
            for what in read_lives(path, robot, unfinished=True):
                if isinstance(what, Life):
                    writer.begin_life(robot, what.t_ns, what.state)
                else:
                    writer.record(robot, what[0], [unpack(data) for data in what[1]])
    writer.close()
