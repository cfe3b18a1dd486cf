"""The recorded hall against the centralized filter: what must hold on real data; `make check-data` runs it."""

from __future__ import annotations

import copy
import os

import pytest

from benchmarks.utias import (
    CASES,
    CONDITIONS,
    IN_PROCESSES,
    Condition,
    Figures,
    conditions,
    delays,
    main,
    run,
    table,
    verdicts,
)

UTIAS7 = os.environ.get("COFIX_UTIAS7", "")


@pytest.fixture(scope="session")
def measured() -> Figures:
    if not UTIAS7:
        pytest.skip("COFIX_UTIAS7 does not name the folder of MR.CLAM data set 7")
    return run(UTIAS7, 1, os.cpu_count() or 1)


@pytest.mark.parametrize("condition", CONDITIONS, ids=[item.what for item in CONDITIONS])
def test_the_recorded_run_is_as_good_as_its_bound_allows(measured: Figures, condition: Condition) -> None:
    assert condition.holds(measured), f"{condition.what} = {condition.value(measured):.3f}, not {condition.limits()}"


def made_up() -> Figures:
    """Figures that meet every condition."""
    one = {
        "position_m": 0.1,
        "heading_rad": 0.1,
        "anees": 1.0,
        "anees_max": 1.5,
        "inside_3sigma": 0.99,
        "bytes_per_robot_s": 500.0,
        "track_2s_m": 0.1,
        "track_max_2s_m": 0.3,
        "track_anees": 0.5,
        "bound": {"position_m": 0.1, "heading_rad": 0.1, "anees": 1.0, "track_2s_m": 0.1},
    }
    found = {name: copy.deepcopy(one) for name in CASES}
    found["anchor-alone"]["position_m"] = 2.0
    found["anchor-naive"]["anees"] = 4.0
    found["anchor-every"]["anees"] = 1.7
    return found


def test_every_condition_can_fail() -> None:
    good = made_up()
    assert all(item.holds(good) for item in CONDITIONS)
    assert "FAILS" not in verdicts(good)
    for item in CONDITIONS:
        reached = set()
        for factor in (0.01, 100.0):
            for case in CASES:
                bad = made_up()
                for key in ("position_m", "heading_rad", "anees", "anees_max", "inside_3sigma"):
                    bad[case][key] *= factor
                for key in ("track_2s_m", "track_max_2s_m"):
                    bad[case][key] *= factor
                reached.add(item.holds(bad))
        assert reached == {True, False}, item.what


def test_the_table_has_a_row_per_case_and_the_bound_beside_it() -> None:
    rows = table(made_up()).splitlines()
    assert sum(row.startswith("| A") for row in rows) == 2
    assert all(len(row.split("|")) == 10 for row in rows)


def test_of_some_cases_only_their_conditions_are_told() -> None:
    some = {name: made_up()[name] for name in IN_PROCESSES}
    told = [item.what for item in conditions(some)]
    assert len(told) == 12
    assert {what[:2] for what in told} == {"A ", "B "}
    assert "B position / alone" not in told
    assert verdicts(some).count("holds") == len(told)
    assert conditions(made_up()) == list(CONDITIONS)


def test_of_processes_it_is_told_how_late_they_were() -> None:
    late = {
        "contacts": {"started": 12, "completed": 11, "one_sided": 0},
        "lag_p99_s": 0.012,
        "lag_max_s": 0.054,
        "load": 3.25,
    }
    some = {name: made_up()[name] | late for name in IN_PROCESSES}
    rows = delays(some).splitlines()
    assert [row.split(" | ")[1:5] for row in rows[2:]] == [["11 of 12", "0", "12", "54"]] * 2


def test_virtual_time_has_no_speed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["folder", "--speed", "5"])
    assert "--processes" in capsys.readouterr().err
