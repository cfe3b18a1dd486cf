"""A fleet whose own sensors are late by a fault: what it knows once the data are there, against data in time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.fault_parts import made
from sim.engine import TrialResult
from sim.metrics import StateTrace
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import sized

ROBOTS = ("r1", "r2", "r3", "r4")
LATE_S = 25.0
THERE_S = 36.0
"""By now the last of the late data has come, for it is within the horizon of 10 s."""

SEEN = [f"robots.{robot}.sensors.target_range.max_range_m=100" for robot in ROBOTS]

ALONE = [f'robots.{robot}.sensors.range.of=["landmarks"]' for robot in ROBOTS]
"""Nobody measures a peer, so that no pair exchanges anything; a fix and the target are left."""


def played(kind: str, form: str, seed: int, late: bool) -> TrialResult:
    how = [f"lateness.kind={kind}", f"localization.form={form}", "duration_s=40", "window_s=[0, 40]"]
    faults = [
        made(kind="sensor_delay", robot=robot, delay_s=0.7, tail_s=1.0, for_s=LATE_S, id=f"late-{robot}")
        for robot in ROBOTS
        if late
    ]
    return run_trial(load("ut-clat", [*how, *SEEN, *ALONE]).model_copy(update={"faults": faults}), seed)


def states(result: TrialResult) -> dict[tuple[str, str], StateTrace]:
    """What each robot says of itself and of the target."""
    own = {(robot, robot): trace for robot, trace in result.trace.robots.items()}
    return own | {(robot, "t1"): trace for robot, trace in result.trace.targets["t1"].items()}


def difference(one: TrialResult, two: TrialResult, rows: np.ndarray[Any, np.dtype[np.bool_]]) -> float:
    """The largest difference in any number of any belief at these instants."""
    found, other = states(one), states(two)
    return max(
        float(np.abs(getattr(found[key], name)[rows] - getattr(other[key], name)[rows]).max())
        for key in found
        for name in ("mean", "cov")
    )


@pytest.mark.parametrize("form", ["auto", "safe"])
@pytest.mark.parametrize("seed", range(1, sized(2, 10) + 1))
def test_without_pair_exchange_late_data_give_the_result_of_data_in_time(form: str, seed: int) -> None:
    in_time, late = (played("replay", form, seed, late) for late in (False, True))
    t_s, counted = in_time.trace.t_s, [late.counters[robot] for robot in ROBOTS]
    assert all(own.get("late.replayed", 0) > 10 and not own.get("late.too_old") for own in counted), (seed, counted)
    assert not any(own.get("pair.started") for own in counted), seed
    assert difference(in_time, late, t_s < LATE_S) > 1e-3, seed
    assert difference(in_time, late, t_s >= THERE_S) < 1e-9, seed


@pytest.mark.parametrize("kind", ["compensate", "discard"])
def test_other_kinds_use_late_data_otherwise_or_not_at_all(kind: str) -> None:
    in_time, late = (played(kind, "auto", 1, late) for late in (False, True))
    assert difference(in_time, late, in_time.trace.t_s >= THERE_S) > 1e-6
    names = ("late.compensated", "late.target_compensated", "late.dropped", "late.target_dropped")
    found = {name.partition("_")[2] or name for name in names if late.counters["r1"].get(name)}
    assert all(("dropped" if kind == "discard" else "compensated") in name for name in found) and found


def test_late_data_repeat_bit_for_bit() -> None:
    one, two = played("replay", "auto", 3, True), played("replay", "auto", 3, True)
    assert one.counters == two.counters
    assert difference(one, two, one.trace.t_s >= 0.0) == 0.0
