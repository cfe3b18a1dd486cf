"""The process of one robot in virtual time: it may crash, come back and pause, and its clock may be wrong."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from agent.clock_faults import FaultyClock
from agent.config import AgentConfig
from agent.effects import Persist
from agent.figures import NisSum
from agent.node import Node, Recorder, rejected
from agent.settings import nanoseconds
from agent.state_file import Found
from agent.state_keeper import Start, start, succeed

SOFTWARE = "cofix-0.1.0"

LifeSink = Callable[[str, int, bytes | None], None]
"""(robot, own time, the state it begins with) of every start after the first."""

MAX_KEPT = 64
"""Packets, and sensor data, that wait for a process that is paused: its sockets keep no more."""


@dataclass(slots=True)
class Waiting:
    """What came for a paused process."""

    packets: list[Any] = field(default_factory=list)
    data: list[Any] = field(default_factory=list)


class Process:
    """One robot's process. `node` is None while it is down."""

    def __init__(
        self,
        robot: str,
        config: AgentConfig,
        seed: int,
        recorder: Recorder | None,
        clock: FaultyClock,
        life_sink: LifeSink | None = None,
    ) -> None:
        self.robot, self.clock = robot, clock
        self._config, self._seed, self._recorder, self._life_sink = config, seed, recorder, life_sink
        self._lives = 0
        self._file = Found()
        self._past: list[Node] = []
        self._waiting: Waiting | None = None
        self.node: Node | None = None
        self.start(0)

    # -- lives ----------------------------------------------------------------------------------------------

    def start(self, t_ns: int, keep_state: bool = True) -> None:
        """Begin a life at `t_ns`, as a process does that is started with the same configuration again."""
        if self.node is not None:
            return
        if not keep_state:
            self._file = Found(self._file.incarnation)
        now_ns, max_age_ns = self.clock.local_ns(t_ns), nanoseconds(self._config.state.max_age_s)
        begin, refused = start(self._file, self._config.settings(0), now_ns, max_age_ns, 0, 0, 1)
        self._live(begin, now_ns)
        if refused is not None and self.node is not None:
            self.node.counters[f"state.refused_{refused}"] += 1

    def succeed(self, t_ns: int, incarnation: int) -> None:
        """Go on in a new life of this incarnation, see `network.own_life`."""
        if self.node is not None:
            self._past.append(self.node)
            begin = succeed(self._config.settings(0), self.node.agent.saved(), incarnation)
            self._live(begin, self.clock.local_ns(t_ns))

    def _live(self, begin: Start, now_ns: int) -> None:
        self._file = Found(begin.incarnation, begin.state)
        if self._lives and self._life_sink is not None:
            self._life_sink(self.robot, now_ns, begin.state)
        self._lives += 1
        name = f"{self._seed}/{self.robot}" + (f"/{self._lives}" if self._lives > 1 else "")
        boot = hashlib.blake2b(name.encode(), digest_size=7).digest()
        self.node = Node(
            begin.settings,
            self._config.network.settings(self._config.lateness, self._config.unsafe.settings()),
            boot_id=int.from_bytes(boot, "little"),
            incarnation=begin.incarnation,
            software=SOFTWARE,
            sensors=self._config.sensor_configs(),
            recorder=self._recorder,
            state=begin.state,
        )

    def keep(self, persist: Persist) -> None:
        """Write the state file."""
        self._file = Found(self._file.incarnation, persist.payload)

    def stop(self, in_order: bool = False) -> None:
        """End the life: all that was in memory is gone, unless it ends in good order."""
        if self.node is not None:
            state = self.node.agent.saved() if in_order else None
            if state is not None:
                self._file = Found(self._file.incarnation, state)
            self._past.append(self.node)
        self.node = self._waiting = None

    def pause(self) -> None:
        if self.node is not None:
            self._waiting = Waiting()

    def resume(self) -> Waiting:
        """Go on; what came meanwhile, as far as it was kept."""
        waiting, self._waiting = self._waiting, None
        return waiting if waiting is not None else Waiting()

    @property
    def runs(self) -> bool:
        """Whether it takes events now."""
        return self.node is not None and self._waiting is None

    def keep_packet(self, packet: Any) -> None:
        """A packet came while the process does not run."""
        if self._waiting is not None and len(self._waiting.packets) < MAX_KEPT:
            self._waiting.packets.append(packet)

    def keep_datum(self, datum: Any) -> None:
        """A sensor datum came while the process does not run."""
        if self._waiting is not None and len(self._waiting.data) < MAX_KEPT:
            self._waiting.data.append(datum)

    # -- figures --------------------------------------------------------------------------------------------

    def nodes(self) -> Iterator[Node]:
        """Of all lives."""
        yield from self._past
        if self.node is not None:
            yield self.node

    def counters(self) -> dict[str, int]:
        """What was counted, over all lives."""
        total: Counter[str] = Counter()
        for node in self.nodes():
            total.update(node.agent.counters)
        return dict(sorted(total.items()))

    def rejected(self) -> Counter[str]:
        """What was refused, over all lives."""
        total: Counter[str] = Counter()
        for node in self.nodes():
            total.update(rejected(node))
        return total

    def nis(self) -> dict[str, tuple[float, int]]:
        """Sums and numbers of the NIS by kind, over all lives."""
        total: dict[str, NisSum] = {}
        for node in self.nodes():
            for kind, entry in node.agent.nis.items():
                mine = total.setdefault(kind, NisSum())
                mine.total += entry.total
                mine.count += entry.count
        return {kind: (entry.total, entry.count) for kind, entry in sorted(total.items())}
