"""Trials kept on disk: bit for bit what was played, whatever happened to the end of the file."""

from __future__ import annotations

import copy
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.metrics import trial_figures
from sim.scenario_file import load
from sim.summary import reduce, summarize
from sim.trial import run_trial
from sim.trial_store import FILE, StoreBusy, TrialStore, pack, records

MADE = load("ut-clat", ["duration_s=20", "window_s=[0, 20]"])


def bits(value: Any) -> Any:
    """Something that is equal only if every float has the same bits."""
    if isinstance(value, dict):
        return {key: bits(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [bits(item) for item in value]
    if isinstance(value, np.ndarray):
        return ["array", value.shape, value.astype("<f8").tobytes()]
    return ["float", struct.pack("<d", value)] if isinstance(value, float) else value


def read(data: bytes) -> list[tuple[int, dict[str, Any]]]:
    return [(seed, reduced) for _, seed, reduced in records(data)]


def test_a_real_trial_comes_back_bit_for_bit(tmp_path: Path) -> None:
    played = reduce(MADE, run_trial(MADE, 3, with_bound=True))
    with TrialStore(tmp_path) as store:
        store.append(3, copy.deepcopy(played))
        (kept,) = store.trials().values()
    assert bits(kept) == bits(played)
    one, other = [
        json.dumps(summarize(MADE, "virtual", 3, [item], simulated_s=20.0, timing={})) for item in (played, kept)
    ]
    assert one == other
    assert trial_figures(kept["figures"]) == trial_figures(played["figures"])


VALUES = st.recursive(
    st.none() | st.integers(-(2**63), 2**63) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
TRIALS = st.dictionaries(
    st.text(max_size=5), VALUES | st.lists(st.floats(), max_size=5).map(lambda x: np.array(x, dtype=np.float64))
)


@given(st.lists(TRIALS, max_size=4))
def test_any_trial_comes_back_bit_for_bit(trials: list[dict[str, Any]]) -> None:
    data = b"".join(pack(seed, trial) for seed, trial in enumerate(trials))
    assert bits(read(data)) == bits(list(enumerate(trials)))


@given(st.data())
def test_a_cut_or_damaged_end_costs_no_record_before_it(data: st.DataObject) -> None:
    first = [pack(seed, {"x": np.array([1.5, math.nan, seed]), "y": 0.1 * seed}) for seed in range(3)]
    last = bytearray(pack(3, {"x": np.array([4.0]), "y": 7.0}))
    if data.draw(st.booleans()):
        last = last[: data.draw(st.integers(0, len(last) - 1))]
    else:
        last[data.draw(st.integers(0, len(last) - 1))] ^= data.draw(st.integers(1, 255))
    assert [seed for seed, _ in read(b"".join(first) + bytes(last))] == [0, 1, 2]


def test_what_is_written_after_a_cut_end_is_found_again(tmp_path: Path) -> None:
    with TrialStore(tmp_path) as store:
        store.append(8, {"x": 0.1})
        store.append(7, {"x": 0.2})
    whole = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(whole[:-3])
    with TrialStore(tmp_path) as store:
        assert store.trials() == {8: {"x": 0.1}}
        store.append(7, {"x": 0.2})
        store.append(6, {"x": 0.3})
    with TrialStore(tmp_path) as store:
        assert list(store.trials().items()) == [(6, {"x": 0.3}), (7, {"x": 0.2}), (8, {"x": 0.1})]
    assert (tmp_path / FILE).read_bytes().startswith(whole)


def test_two_runs_do_not_write_at_once(tmp_path: Path) -> None:
    with TrialStore(tmp_path), pytest.raises(StoreBusy):
        TrialStore(tmp_path)
    with TrialStore(tmp_path) as store:
        assert store.trials() == {}


def test_what_cannot_be_kept_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with TrialStore(tmp_path) as store:
        with pytest.raises(TypeError, match="complex"):
            store.append(1, {"x": 1j})
        assert store.trials() == {}
