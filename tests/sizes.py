"""How much the tests that play many seeds play: little by default, all with COFIX_THOROUGH=1."""

from __future__ import annotations

import os

THOROUGH = bool(os.environ.get("COFIX_THOROUGH"))


def sized(usual: int, thorough: int) -> int:
    return thorough if THOROUGH else usual
