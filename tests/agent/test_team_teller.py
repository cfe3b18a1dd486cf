"""What a robot tells its team: everything twice, nothing that does not fit, and odometry that never leaves a hole."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.settings import NS
from agent.team_teller import ANCHOR_NS, REPEATS, Teller
from network.messages import MAX_MESSAGE_BYTES, Header, RawMeasurement, TeamReport
from network.wire import encode

Array = NDArray[np.float64]

PART = np.array([1.0, 0.0, 0.0, 0.1]), np.diag([0.01, 0.01, 0.0, 0.001])


def seen(t_ns: int, index: int = 0, of: str | None = "r2") -> RawMeasurement:
    mount = (0.1, 0.0, 0.2, 0.0, 0.0, 1.5)
    return RawMeasurement(t_ns, index, of, "range_bearing", np.array([4.0, 0.5]), np.eye(2) / 100, mount)


def names(report: TeamReport) -> list[tuple[int, int]]:
    return [(item.t_ns // NS, item.index) for item in report.measurements]


def stamps(report: TeamReport) -> list[int]:
    return [item.t_ns // NS for item in report.reckonings]


def told(teller: Teller, until_s: int) -> Iterator[TeamReport]:
    """Reports up to an instant, as valid messages."""
    for report in teller.reports(until_s * NS):
        t_ns = max(item.t_ns for item in (*report.reckonings, *report.measurements))
        assert len(encode(Header("r1", 1, 1, 1, t_ns, t_ns), report)) <= MAX_MESSAGE_BYTES
        yield report


def test_a_measurement_is_told_in_two_reports_and_odometry_in_three() -> None:
    teller = Teller(0)
    reports = []
    for k in range(1, 6):
        teller.moved(k * NS, *PART)
        teller.measured(seen(k * NS))
        reports += told(teller, k)
    assert names(reports[0]) == [(1, 0)]
    assert [names(report) for report in reports[1:]] == [[(k, 0), (k - 1, 0)] for k in range(2, 6)]
    assert [stamps(report) for report in reports] == [[1], [1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5]]
    assert REPEATS == 2


def test_nothing_is_told_before_its_instant_is_settled() -> None:
    teller = Teller(0)
    assert teller.due_ns() is None
    teller.moved(2 * NS, *PART)
    teller.measured(seen(NS))
    assert teller.due_ns() == NS
    assert [names(report) for report in told(teller, 1)] == [[(1, 0)]]
    assert teller.due_ns() == 2 * NS
    assert [stamps(report) for report in told(teller, 2)] == [[2]]
    assert (teller.due_ns(), teller.reports(9 * NS)) == (None, [])


def test_what_is_measured_late_is_told_with_the_next_instant() -> None:
    teller = Teller(0)
    teller.moved(5 * NS, *PART)
    list(told(teller, 5))
    teller.measured(seen(3 * NS))
    teller.moved(6 * NS, *PART)
    (report,) = told(teller, 6)
    assert (names(report), stamps(report)) == ([(3, 0)], [5, 6])


def test_several_instants_at_once_are_told_one_by_one() -> None:
    teller = Teller(0)
    for k in (1, 2, 3):
        teller.moved(k * NS, *PART)
        teller.measured(seen(k * NS))
    assert [(stamps(report)[-1], names(report)[0]) for report in told(teller, 3)] == [
        (1, (1, 0)),
        (2, (2, 0)),
        (3, (3, 0)),
    ]


@pytest.mark.parametrize("count", [3, 9, 30])
def test_more_than_fits_is_told_in_several_reports_and_repeats_come_last(count: int) -> None:
    teller = Teller(0)
    teller.moved(NS, *PART)
    for index in range(count):
        teller.measured(seen(NS, index, of="target:a-target-of-a-long-name"))
    first = list(told(teller, 1))
    assert [name for report in first for name in names(report)] == [(1, index) for index in range(count)]
    teller.moved(2 * NS, *PART)
    teller.measured(seen(2 * NS))
    (second,) = told(teller, 2)
    assert names(second)[0] == (2, 0)
    again = [index for t_s, index in names(second) if t_s == 1]
    # The newest are repeated, as many as there is room for.
    assert again == list(range(count))[-len(again) :]
    assert len(again) == count if count < 6 else len(again) >= 3


def test_measurements_of_one_instant_are_numbered() -> None:
    teller = Teller(0)
    assert [teller.index(NS, 0) for _ in range(3)] == [0, 1, 2]
    assert teller.index(2 * NS, 0) == 0
    assert teller.index(NS, 0) == 3
    for k in range(3, 200):
        teller.index(k * NS, (k - 5) * NS)
    assert len(teller._counts) < 100


def test_the_end_of_a_renewed_sum_is_in_every_report() -> None:
    teller = Teller(7 * NS)
    step_ns = ANCHOR_NS // 4
    reports = []
    for k in range(1, 11):
        teller.moved(7 * NS + k * step_ns, *PART)
        reports += told(teller, 10**6)
    anchors = [report.reckonings[-1].anchor_ns for report in reports]
    assert sorted(set(anchors)) == [7 * NS, 7 * NS + ANCHOR_NS, 7 * NS + 2 * ANCHOR_NS]
    for report in reports:
        ends = {item.anchor_ns: item.t_ns for item in report.reckonings}
        newest = report.reckonings[-1].anchor_ns
        assert newest == 7 * NS or newest in [item.t_ns for item in report.reckonings if item.anchor_ns < newest], ends
        assert report.born_ns == 7 * NS
