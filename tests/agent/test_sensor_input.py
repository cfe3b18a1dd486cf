"""The sensor datagram: what a driver may say, and that nothing else gets in."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agent.estimation.mounting import planar_mount
from agent.estimation.observation import RELATIVE_ANGLES, Intrinsics
from agent.events import LEVEL, Fix, Observation, Odometry
from agent.sensor_input import (
    ABSOLUTE_KINDS,
    MAX_DATAGRAM_BYTES,
    SIZES,
    SensorConfig,
    SensorError,
    decode,
    encode,
)
from network.messages import NO_MOUNT

NOW = 5_000_000_000
SENSORS = {
    "uwb": SensorConfig(planar_mount(0.3, -0.1, 1.5)),
    "camera": SensorConfig((0.1, 0.0, -0.05, 0.0, 1.57, 0.0), intrinsics=Intrinsics(400.0, (300.0, 200.0))),
}


def measurement(kind: str, **change: Any) -> dict[str, Any]:
    """A valid datagram of a kind as a plain map, with changes."""
    size = SIZES[kind][0]
    data: dict[str, Any] = {
        "t_ns": 1_000,
        "kind": kind,
        "of": "r2" if kind in RELATIVE_ANGLES else None,
        "z": [0.5 + index for index in range(size)],
        "R": [[0.25 if row == column else 0.0 for column in range(size)] for row in range(size)],
    }
    if kind == "odometry":
        data["t0_ns"] = 500
    if kind == "pixel":
        data["sensor"] = "camera"
    return data | change


def reason(payload: bytes) -> str:
    with pytest.raises(SensorError) as caught:
        decode(payload, NOW, SENSORS)
    return caught.value.reason


def reason_of(kind: str = "range", **change: Any) -> str:
    return reason(msgpack.packb(measurement(kind, **change)))


# --- what may be said -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "size"), [(kind, size) for kind in SIZES if kind != "pixel" for size in SIZES[kind]])
def test_every_kind_arrives_as_it_was_sent(kind: str, size: int) -> None:
    z = np.linspace(0.1, 0.7, size)
    root = np.tril(np.linspace(0.1, 1.0, size * size).reshape(size, size))
    R = root @ root.T
    R = (R + R.T) / 2.0
    relative = kind in RELATIVE_ANGLES
    of = "landmark:L-3.b" if relative else None
    t0_ns = 600 if kind == "odometry" else None
    attitude = (0.1, -0.2) if relative else None
    event = decode(encode(1_000, kind, z, R, of=of, sensor="uwb", t0_ns=t0_ns, attitude=attitude), NOW, SENSORS)
    assert event.t_ns == NOW
    if isinstance(event, Odometry):
        assert (kind, event.t0_ns, event.t_meas_ns) == ("odometry", 600, 1_000)
        got, noise = event.delta, event.cov
    else:
        assert isinstance(event, Observation if relative else Fix)
        assert (event.kind, event.t_meas_ns, event.sensor) == (kind, 1_000, "uwb")
        got, noise = event.z, event.R
    if isinstance(event, Observation):
        assert (event.of, event.mount, event.attitude) == (of, planar_mount(0.3, -0.1, 1.5), attitude)
    np.testing.assert_array_equal(got, z)
    np.testing.assert_array_equal(noise, R)
    assert got.dtype == noise.dtype == np.float64


def test_a_pixel_is_taken_to_the_image_plane_at_unit_distance() -> None:
    payload = encode(1_000, "pixel", np.array([340.0, 180.0]), np.diag([4.0, 16.0]), of="target:t1", sensor="camera")
    event = decode(payload, NOW, SENSORS)
    assert isinstance(event, Observation)
    assert np.allclose(event.z, [0.1, -0.05])
    assert np.allclose(event.R, np.diag([4.0, 16.0]) / 400.0**2)
    assert (event.mount, event.attitude) == (SENSORS["camera"].mount, LEVEL)


@pytest.mark.parametrize("sensor", ["", "uwb", "nobody"])
def test_a_pixel_of_a_sensor_that_is_no_camera_means_nothing(sensor: str) -> None:
    assert reason_of("pixel", sensor=sensor) == "no_intrinsics"


@pytest.mark.parametrize(
    ("attitude", "why"),
    [
        ([], "wrong_length"),
        ([0.1], "wrong_length"),
        ([0.1, 0.2, 0.3], "wrong_length"),
        (None, "wrong_length"),
        ([True, 0.1], "wrong_type"),
        ([0.1, "0"], "wrong_type"),
        ([float("nan"), 0.0], "out_of_range"),
        ([0.0, 1.6], "out_of_range"),
        ([-1.6, 0.0], "out_of_range"),
    ],
)
def test_an_attitude_is_a_roll_and_a_pitch_below_a_quarter_turn(attitude: Any, why: str) -> None:
    assert reason_of(attitude=attitude) == why


@pytest.mark.parametrize("kind", [*ABSOLUTE_KINDS, "odometry"])
def test_what_speaks_of_the_robot_itself_has_no_attitude(kind: str) -> None:
    assert reason_of(kind, attitude=[0.0, 0.0]) == "malformed"


def test_a_sensor_nobody_configured_sits_at_the_body_centre() -> None:
    event = decode(encode(1, "range", np.array([2.0]), np.eye(1), of="r2", sensor="other"), NOW, SENSORS)
    assert isinstance(event, Observation)
    assert event.mount == NO_MOUNT


@pytest.mark.parametrize("of", ["r2", "robot-24-characters-long", "landmark:L3", "target:t1", None])
def test_a_subject_is_a_robot_a_landmark_a_target_or_unknown(of: str | None) -> None:
    event = decode(msgpack.packb(measurement("range", of=of)), NOW, SENSORS)
    assert isinstance(event, Observation)
    assert event.of == of


def test_whole_numbers_are_numbers() -> None:
    event = decode(msgpack.packb(measurement("range", z=[4], R=[[1]])), NOW, SENSORS)
    assert isinstance(event, Observation)
    assert event.z[0] == 4.0


def test_odometry_may_be_exact_in_some_directions() -> None:
    cov = np.diag([0.01, 0.0, 0.0, 0.0])
    event = decode(encode(2, "odometry", np.zeros(4), cov, t0_ns=1), NOW, SENSORS)
    assert isinstance(event, Odometry)
    np.testing.assert_array_equal(event.cov, cov)


# --- what is refused, and under which name ----------------------------------------------------------------


def test_an_oversize_datagram_is_not_even_looked_at() -> None:
    assert reason(b"\xc0" * (MAX_DATAGRAM_BYTES + 1)) == "oversize"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        msgpack.packb([1, 2]),
        msgpack.packb(None),
        msgpack.packb({}) + b"\x00",
        msgpack.packb(measurement("range"))[:-1],
        msgpack.packb(measurement("range") | {"extra": 1}),
        msgpack.packb(measurement("range") | {7: 1}),
        msgpack.packb({b"t_ns": 1}),
        msgpack.packb(measurement("range", sensor="no spaces")),
        msgpack.packb(measurement("range", sensor=3)),
        msgpack.packb(measurement("range", sensor="x" * 65)),
        msgpack.packb(measurement("range", z=[0.0] * 17)),
        msgpack.packb(measurement("range", z=b"\x00")),
        msgpack.packb(measurement("range", of=msgpack.ExtType(4, b"abc"))),
        msgpack.packb(measurement("range", of=msgpack.Timestamp(1, 2))),
        b"\x91" * 2_000,
    ],
)
def test_what_is_not_a_map_of_the_known_keys_is_malformed(payload: bytes) -> None:
    assert reason(payload) == "malformed"


@pytest.mark.parametrize("kind", ["sonar", "", None, 3, ["range"], "Range"])
def test_a_kind_that_does_not_exist(kind: Any) -> None:
    assert reason(msgpack.packb(measurement("range") | {"kind": kind})) == "unknown_kind"


def test_a_missing_kind() -> None:
    data = measurement("range")
    del data["kind"]
    assert reason(msgpack.packb(data)) == "unknown_kind"


@pytest.mark.parametrize("stamp", [-1, 2**63, 1.0, True, None, "1", [1]])
def test_a_stamp_is_a_whole_number_of_nanoseconds(stamp: Any) -> None:
    assert reason_of(t_ns=stamp) == "bad_stamp"
    assert reason_of("odometry", t0_ns=stamp) == "bad_stamp"


@pytest.mark.parametrize("t0_ns", [1_000, 1_001])
def test_odometry_covers_a_span(t0_ns: int) -> None:
    assert reason_of("odometry", t0_ns=t0_ns) == "bad_interval"


def test_odometry_needs_its_start() -> None:
    data = measurement("odometry")
    del data["t0_ns"]
    assert reason(msgpack.packb(data)) == "bad_stamp"


@pytest.mark.parametrize("kind", SIZES)
def test_lengths_follow_from_the_kind(kind: str) -> None:
    size = SIZES[kind][-1]
    good = measurement(kind)
    assert reason_of(kind, z=[]) == "wrong_length"
    assert reason_of(kind, z=[0.1] * (size + 1)) == "wrong_length"
    assert reason_of(kind, z=0.1) == "wrong_length"
    assert reason_of(kind, R=good["R"][:-1]) == "wrong_length"
    assert reason_of(kind, R=[[0.1] * (size + 1)] * SIZES[kind][0]) == "wrong_length"
    assert reason_of(kind, R=[0.1] * SIZES[kind][0]) == "wrong_length"
    assert reason_of(kind, R={"0": 1}) == "wrong_length"


@pytest.mark.parametrize("number", [True, "1", None, [1.0], {"a": 1}, msgpack.ExtType(4, b"")])
def test_numbers_are_numbers(number: Any) -> None:
    assert reason_of(z=[number]) == "wrong_type"
    assert reason_of(R=[[number]]) == "wrong_type"


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), 1.1e9, 2**64 - 1, -0.1])
def test_numbers_are_finite_and_sensible(number: float) -> None:
    assert reason_of(z=[number]) == "out_of_range"


def test_a_bearing_may_be_negative_but_a_distance_may_not() -> None:
    assert isinstance(decode(msgpack.packb(measurement("bearing", z=[-1.0])), NOW, SENSORS), Observation)
    assert isinstance(decode(msgpack.packb(measurement("range_bearing", z=[1.0, -1.0])), NOW, SENSORS), Observation)
    assert reason_of("range_bearing", z=[-1.0, 1.0]) == "out_of_range"


@pytest.mark.parametrize("kind", [kind for kind in SIZES if SIZES[kind][0] > 1])
def test_a_covariance_is_symmetric_and_positive(kind: str) -> None:
    size = SIZES[kind][0]
    asymmetric = np.eye(size)
    asymmetric[0, 1] = 0.5
    indefinite = np.eye(size)
    indefinite[0, 1] = indefinite[1, 0] = 2.0
    negative = np.eye(size)
    negative[-1, -1] = -1e-3
    for R in (asymmetric, asymmetric.T, indefinite, negative):
        assert reason_of(kind, R=R.tolist()) == "not_positive_definite"


@pytest.mark.parametrize("kind", [kind for kind in SIZES if kind != "odometry"])
@pytest.mark.parametrize("variance", [0.0, 1e-13, -1.0])
def test_no_sensor_is_exact(kind: str, variance: float) -> None:
    R = np.eye(SIZES[kind][0])
    R[0, 0] = variance
    assert reason_of(kind, R=R.tolist()) == "not_positive_definite"


@pytest.mark.parametrize("of", ["R2", "", "landmark:", "target:T1", "r2\n", "a" * 25, "peer:r2", 3, True, ["r2"]])
def test_a_subject_has_a_well_formed_name(of: Any) -> None:
    assert reason_of(of=of) == "bad_subject"


@pytest.mark.parametrize("kind", [*ABSOLUTE_KINDS, "odometry"])
@pytest.mark.parametrize("of", ["r2", 3, {"a": 1}])
def test_what_speaks_of_the_robot_itself_has_no_subject(kind: str, of: Any) -> None:
    assert reason_of(kind, of=of) == "bad_subject"


# --- anything at all --------------------------------------------------------------------------------------

SCALARS = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8)
NESTED = st.recursive(SCALARS | st.binary(max_size=8), lambda inner: st.lists(inner, max_size=4), max_leaves=12)


def survives(payload: bytes) -> None:
    """Either an event with finite numbers or a named refusal."""
    try:
        event = decode(payload, NOW, SENSORS)
    except SensorError:
        return
    z = event.delta if isinstance(event, Odometry) else event.z  # type: ignore[union-attr]
    assert np.all(np.isfinite(z))


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_refused_by_name(payload: bytes) -> None:
    survives(payload)


@given(st.sampled_from(sorted(SIZES)), st.data())
def test_a_damaged_datagram_is_refused_by_name_or_still_makes_sense(kind: str, data: st.DataObject) -> None:
    payload = bytearray(msgpack.packb(measurement(kind)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    survives(bytes(payload))
    survives(bytes(payload[: data.draw(st.integers(0, len(payload)))]))


@given(
    st.sampled_from(sorted(SIZES)),
    st.dictionaries(
        st.sampled_from(["t_ns", "t0_ns", "kind", "of", "z", "R", "sensor", "attitude"]), NESTED, min_size=1
    ),
)
def test_any_value_under_a_known_key_is_refused_by_name_or_makes_sense(kind: str, change: dict[str, Any]) -> None:
    survives(msgpack.packb(measurement(kind) | change))
