"""What a process tells of itself: that it is alive, what it heard when, and that another one sends under its id."""

from __future__ import annotations

from dataclasses import dataclass

MAX_ECHOES = 16


@dataclass(frozen=True, slots=True)
class ClockEcho:
    """First half of a four-stamp exchange: `t1_ns` peer's send stamp (its clock), `t2_ns` our receive stamp."""

    peer: str
    t1_ns: int
    t2_ns: int


@dataclass(frozen=True, slots=True)
class Hello:
    """Periodic sign of life (2 Hz) with clock echoes for the neighbours heard."""

    software: str
    echoes: tuple[ClockEcho, ...] = ()


@dataclass(frozen=True, slots=True)
class LifeNotice:
    """To one of two processes that send under one id; it is directed to that robot, so both are told.

    boot_id      of the process that is meant
    incarnation  of the life that the sender goes on with
    over         the life of the process that is meant is refused, and the one the sender goes on with is silent
    """

    boot_id: int
    incarnation: int
    over: bool
