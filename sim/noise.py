"""Counter-based noise: a draw is named by (seed, robot, sensor, index), never by when it was made."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def generator(seed: int, *names: str) -> np.random.Generator:
    """A Philox stream keyed by the seed and a name; row k of any array drawn from it belongs to index k."""
    text = "\x1f".join((str(seed), *names)).encode()
    key = int.from_bytes(hashlib.blake2b(text, digest_size=16).digest(), "little")
    return np.random.Generator(np.random.Philox(key=key))


def uniform_rows(seed: int, count: int, size: int, *names: str) -> Array:
    """Numbers (count, size) drawn evenly from [0, 1); row k is the same for every `count` > k."""
    return generator(seed, *names).random((count, size))


def normal_rows(seed: int, count: int, size: int, *names: str) -> Array:
    """Standard normal numbers (count, size); row k is the same for every `count` > k."""
    return generator(seed, *names).standard_normal((count, size))
