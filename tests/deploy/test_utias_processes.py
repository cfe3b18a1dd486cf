"""The start of the recorded run with one process per robot over Zenoh: what holds in virtual time holds there too.

The whole run takes a quarter of an hour: `python -m benchmarks.utias FOLDER --processes`.
"""

from __future__ import annotations

import math
import os
from functools import partial

import pytest

from benchmarks.processes import RunFailed
from benchmarks.utias import IN_PROCESSES, Condition, Figures, conditions, delays, figures, figures_of_processes, run

pytestmark = pytest.mark.realtime

UTIAS7 = os.environ.get("COFIX_UTIAS7", "")
PART = ("duration_s=75.0", "window_s=[15.0, 75.0]")


@pytest.fixture(scope="module")
def in_processes() -> Figures:
    if not UTIAS7:
        pytest.skip("COFIX_UTIAS7 does not name the folder of MR.CLAM data set 7")
    return run(UTIAS7, 1, len(IN_PROCESSES), IN_PROCESSES, partial(figures_of_processes, more=PART))


@pytest.fixture(scope="module")
def in_virtual_time(in_processes: Figures) -> Figures:
    """Played after the processes, so as not to disturb them."""
    return run(UTIAS7, 1, os.cpu_count() or 1, IN_PROCESSES, partial(figures, more=PART))


def test_the_start_of_the_run_is_as_good_as_its_bound_allows(in_processes: Figures) -> None:
    """Lower limits are for the whole run: that near their start robots know more than they claim."""

    def told(item: Condition) -> str:
        return f"{item.what} = {item.value(in_processes):.3f}, not {item.limits()}"

    held = [item for item in conditions(in_processes) if item.high < math.inf]
    assert len(held) == 10
    assert [told(item) for item in held if item.value(in_processes) > item.high] == [], delays(in_processes)


@pytest.mark.parametrize("case", IN_PROCESSES)
@pytest.mark.parametrize(("key", "within"), [("position_m", 0.1), ("heading_rad", 0.1), ("anees", 0.1)])
def test_processes_come_to_the_figures_of_virtual_time(
    in_processes: Figures, in_virtual_time: Figures, case: str, key: str, within: float
) -> None:
    ratio = in_processes[case][key] / in_virtual_time[case][key]
    assert ratio == pytest.approx(1.0, abs=within), delays(in_processes)


def test_a_run_that_cannot_be_played_says_why() -> None:
    with pytest.raises(RunFailed, match="no such folder"):
        figures_of_processes("all", "/nowhere", 1)
