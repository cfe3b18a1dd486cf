"""Sensor faults change what is told of the world, for whom and as long as stated, and never the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from agent.fault_parts import made
from sim.faulty_world import FaultyWorld
from sim.scenario_file import load
from sim.world import Output, SimulatedWorld

SCENARIO = load("fault-plan")


def world(*faults: dict[str, Any], drop_silenced: bool = True) -> FaultyWorld:
    found = FaultyWorld(SimulatedWorld(SCENARIO, 5), 5, {"r1": "position"}, drop_silenced)
    for index, fault in enumerate(faults):
        found.add(f"f{index}", made(**fault))  # type: ignore[arg-type]
    return found


def told(*faults: dict[str, Any], steps: range = range(1, 61), drop_silenced: bool = True) -> list[Output]:
    faulty = world(*faults, drop_silenced=drop_silenced)
    return [item for k in steps for item in faulty.outputs(k)]


def key(item: Output) -> tuple[int, str, str, str | None]:
    return item.t_ns, item.robot, item.sensor, item.of


CLEAN = {key(item): item for item in told()}


def test_a_fault_may_be_ended_while_the_world_is_played() -> None:
    faulty = world({"kind": "sensor_dropout", "robot": "r1"})
    assert faulty.end("f0", 5 * 10**9) and not faulty.end("f0", 5 * 10**9) and not faulty.end("f1", 0)
    heard = [item.t_ns for k in range(1, 61) for item in faulty.outputs(k) if item.robot == "r1" and item.of]
    assert min(heard) >= 5 * 10**9


def test_a_dropout_takes_one_sensor_of_one_robot_for_its_time() -> None:
    left = {
        key(item)
        for item in told({"kind": "sensor_dropout", "robot": "r2", "sensor": "range", "at_s": 5.0, "for_s": 5.0})
    }
    gone = [k for k in CLEAN if k not in left]
    assert gone and all(robot == "r2" and sensor == "range" for _, robot, sensor, _ in gone)
    assert all(5.0 <= t_ns * 1e-9 < 10.0 for t_ns, *_ in gone)


def test_a_dropout_of_one_subject_leaves_the_others() -> None:
    left = {key(item) for item in told({"kind": "sensor_dropout", "robot": "r1", "sensor": "range", "of": "r3"})}
    assert {of for _, _, _, of in CLEAN.keys() - left} == {"r3"}


def test_a_share_of_dropouts_is_that_share() -> None:
    left = told({"kind": "sensor_dropout", "robot": "r1", "share": 0.4})
    mine = [item for item in CLEAN.values() if item.robot == "r1" and item.kind != "odometry"]
    kept = [item for item in left if item.robot == "r1" and item.kind != "odometry"]
    assert len(kept) / len(mine) == pytest.approx(0.6, abs=0.1)


def test_a_bias_is_added_to_the_first_number_and_leaves_the_rest() -> None:
    for item in told({"kind": "sensor_bias", "robot": "r3", "sensor": "camera", "bias": 2.0}):
        clean = CLEAN[key(item)]
        np.testing.assert_array_equal(item.R, clean.R)
        if item.robot == "r3" and item.sensor == "camera":
            assert item.z[0] == pytest.approx(clean.z[0] + 2.0) and item.z[1] == clean.z[1]
        else:
            np.testing.assert_array_equal(item.z, clean.z)


def test_no_range_becomes_negative() -> None:
    ranges = [item for item in told({"kind": "sensor_bias", "robot": "r1", "bias": -500.0}) if item.kind == "range"]
    assert ranges and all(item.z[0] >= 0.0 for item in ranges)


def test_outliers_are_a_share_and_far_off() -> None:
    changed = total = 0
    for item in told({"kind": "sensor_outliers", "robot": "r1", "sensor": "range", "share": 0.3, "sigmas": 50.0}):
        if item.robot == "r1" and item.sensor == "range":
            total += 1
            off = abs(item.z[0] - CLEAN[key(item)].z[0]) / 0.1
            changed += off > 1e-9
            assert off <= 50.0 + 1e-9
    assert changed / total == pytest.approx(0.3, abs=0.1)


def test_delayed_data_are_those_of_the_world_and_come_in_another_order() -> None:
    late = told({"kind": "sensor_delay", "robot": "r1", "delay_s": 0.4, "tail_s": 1.0})
    mine = [item for item in late if item.robot == "r1" and item.kind != "odometry"]
    assert {key(item) for item in late} == CLEAN.keys()
    assert all(np.array_equal(item.z, CLEAN[key(item)].z) for item in late)
    assert all(item.late_ns == 0 for item in late if item not in mine)
    waits_s = np.array([item.late_ns * 1e-9 for item in mine])
    assert waits_s.min() >= 0.4 and waits_s.mean() == pytest.approx(1.4, abs=0.4)
    arrivals = [item.t_ns + item.late_ns for item in mine]
    assert arrivals != sorted(arrivals)


def test_delays_of_one_sensor_are_for_its_time_and_add_up() -> None:
    fault = {"kind": "sensor_delay", "robot": "r2", "sensor": "range", "delay_s": 0.5, "at_s": 5.0}
    for item in told({**fault, "for_s": 10.0}, {**fault, "of": "r3"}):
        mine = item.robot == "r2" and item.sensor == "range"
        first = 500_000_000 if mine and 5.0 <= item.t_ns * 1e-9 < 15.0 else 0
        second = 500_000_000 if mine and item.of == "r3" and item.t_ns * 1e-9 >= 5.0 else 0
        assert item.late_ns == first + second


def test_a_silent_autopilot_tells_neither_odometry_nor_fix() -> None:
    left = {key(item) for item in told({"kind": "autopilot_silence", "robot": "r1", "at_s": 3.0, "for_s": 4.0})}
    gone = CLEAN.keys() - left
    assert {sensor for _, _, sensor, _ in gone} == {"odometry", "position"}
    assert {robot for _, robot, _, _ in gone} == {"r1"}


def test_a_silenced_autopilot_may_be_left_to_who_plays_it() -> None:
    silence = {"kind": "autopilot_silence", "robot": "r1"}
    assert len(told(silence, drop_silenced=False)) == len(CLEAN)
    faulty = world({**silence, "at_s": 3.0, "for_s": 4.0})
    assert [faulty.silenced("r1", t * 10**9) for t in (2, 3, 6, 7)] == [False, True, True, False]
    assert not faulty.silenced("r2", 4 * 10**9)


@pytest.mark.parametrize(
    "fault",
    [
        {"kind": "sensor_outliers", "robot": "r1", "share": 0.5},
        {"kind": "sensor_delay", "robot": "r1", "tail_s": 0.5},
    ],
    ids=lambda fault: str(fault["kind"]),
)
def test_draws_do_not_depend_on_what_was_asked_before(fault: dict[str, Any]) -> None:
    whole = {key(item): item for item in told(fault)}
    for item in told(fault, steps=range(40, 45)):
        np.testing.assert_array_equal(item.z, whole[key(item)].z)
        assert item.late_ns == whole[key(item)].late_ns


def test_the_truth_stays() -> None:
    plain, faulty = SimulatedWorld(SCENARIO, 5), world({"kind": "sensor_bias", "robot": "r1", "bias": 1.0})
    np.testing.assert_array_equal(plain.truth("r1", 9), faulty.truth("r1", 9))
    np.testing.assert_array_equal(plain.start_belief("r1")[0], faulty.start_belief("r1")[0])
