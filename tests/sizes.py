"""How much the tests that play many seeds play: little by default, all with COFIX_THOROUGH=1."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Number = TypeVar("Number", int, float)

THOROUGH = bool(os.environ.get("COFIX_THOROUGH"))


def sized(usual: Number, thorough: Number) -> Number:
    return thorough if THOROUGH else usual


def every(nth: int, items: Iterable[Item]) -> Iterable[Item]:
    """Each nth of them; all of them if thorough."""
    return islice(items, 0, None, sized(nth, 1))
