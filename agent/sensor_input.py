"""The one documented way in for sensor data: a msgpack map per datagram, turned into core events.

    {"t_ns": int, "kind": "range", "of": "r2" | "landmark:L3" | "target:t1" | None, "z": [4.21], "R": [[0.0025]]}

kinds `range`, `bearing` (azimuth), `bearing3` (azimuth, elevation), `range_bearing`, `vector` (x, y in the sensor's
frame), `pixel` (u, v in the image), `position` (x, y[, z]), `pose` (x, y[, z], heading), `heading`, `altitude`, and
`odometry` (z = dx, dy, dz, dyaw over [t0_ns, t_ns]). Optional: "sensor" (its name in the config), "t0_ns" (odometry
only), "attitude" (roll, pitch of the body at the instant). SI and radians, frames as in `agent.events`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from agent.calibration import NO_CALIBRATION, Calibration, Form, corrected, formed
from agent.estimation.gaussian import is_positive_definite
from agent.estimation.observation import Intrinsics
from agent.events import LEVEL, Event, Fix, Observation, Odometry
from network.messages import NO_MOUNT, Mount

Array = NDArray[np.float64]

MAX_DATAGRAM_BYTES = 2048
MAX_VALUE = 1e9
MAX_TILT = 1.5707963267948966
FLOOR = 1e-12
FLOORS = FLOOR * np.eye(4)

SIZES: dict[str, tuple[int, ...]] = {
    "range": (1,),
    "bearing": (1,),
    "bearing3": (2,),
    "range_bearing": (2,),
    "vector": (2,),
    "pixel": (2,),
    "position": (2, 3),
    "pose": (3, 4),
    "heading": (1,),
    "altitude": (1,),
    "odometry": (4,),
}
"""How many numbers a measurement of a kind may have."""

ABSOLUTE_KINDS = ("position", "pose", "heading", "altitude")

_SUBJECT = re.compile(r"(?:landmark:[A-Za-z0-9_.-]{1,32}|target:[a-z0-9-]{1,24}|[a-z0-9-]{1,24})\Z")
_SENSOR = re.compile(r"[A-Za-z0-9_.-]{1,32}\Z")
_KEYS = frozenset({"t_ns", "t0_ns", "kind", "of", "z", "R", "sensor", "attitude"})


class SensorError(Exception):
    """A datagram that is not a measurement; `reason` is the name of its counter."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class SensorConfig:
    """What the robot knows of one of its sensors.

    mount         where it sits on the body: x, y, z [m, FLU], roll, pitch, yaw [rad]
    calibration   its systematic errors
    lag_ns        how much later than the instant of a measurement its stamp is
    form          how a range with a bearing is used
    intrinsics    a camera's; without them its pixels are not used
    """

    mount: Mount = NO_MOUNT
    calibration: Calibration = NO_CALIBRATION
    lag_ns: int = 0
    form: Form = "polar"
    intrinsics: Intrinsics | None = None

    def reading(self, kind: str, of: str | None, z: Array, R: Array) -> tuple[str, Array, Array]:
        """(kind, z, R) of a measurement as it is used; a pixel is taken to the image plane at unit distance."""
        if kind == "pixel" and self.intrinsics is not None:
            return kind, *self.intrinsics.normalized(z, R)
        return formed(kind, corrected(kind, of, z, self.calibration), R, self.form)


PLAIN = SensorConfig()
"""A sensor of which nothing is known."""


def encode(
    t_ns: int,
    kind: str,
    z: Array,
    R: Array,
    *,
    of: str | None = None,
    sensor: str = "",
    t0_ns: int | None = None,
    attitude: tuple[float, float] | None = None,
) -> bytes:
    """The datagram a driver sends; z (m,), R (m, m), `attitude` the body's roll and pitch [rad] if it is not level."""
    data: dict[str, Any] = {"t_ns": t_ns, "kind": kind, "of": of, "z": z.tolist(), "R": R.tolist()}
    if sensor:
        data["sensor"] = sensor
    if t0_ns is not None:
        data["t0_ns"] = t0_ns
    if attitude is not None:
        data["attitude"] = list(attitude)
    packed: bytes = msgpack.packb(data)
    return packed


def decode(payload: bytes, now_ns: int, sensors: dict[str, SensorConfig]) -> Event:
    """The event a datagram stands for, handed in at `now_ns`. Raises `SensorError` on anything foreign."""
    if len(payload) > MAX_DATAGRAM_BYTES:
        raise SensorError("oversize")
    try:
        data = msgpack.unpackb(
            payload,
            strict_map_key=True,
            max_str_len=64,
            max_bin_len=0,
            max_array_len=16,
            max_map_len=8,
            max_ext_len=0,
        )
    except Exception:
        raise SensorError("malformed") from None
    if type(data) is not dict or not _KEYS.issuperset(data):
        raise SensorError("malformed")
    kind = data.get("kind")
    if type(kind) is not str or kind not in SIZES:
        raise SensorError("unknown_kind")
    t_ns = _stamp(data.get("t_ns"))
    sensor = data.get("sensor", "")
    if type(sensor) is not str or (sensor and not _SENSOR.match(sensor)):
        raise SensorError("malformed")
    config = sensors.get(sensor, PLAIN)
    t_ns -= config.lag_ns
    z = _array(data.get("z"), SIZES[kind])
    size = len(z)
    R = _matrix(data.get("R"), size)
    of = data.get("of")
    about_itself = kind == "odometry" or kind in ABSOLUTE_KINDS
    if about_itself and "attitude" in data:
        raise SensorError("malformed")
    roll, pitch = _array(data["attitude"], (2,)).tolist() if "attitude" in data else LEVEL
    if max(abs(roll), abs(pitch)) >= MAX_TILT:
        raise SensorError("out_of_range")
    if of is not None and (about_itself or type(of) is not str or not _SUBJECT.match(of)):
        raise SensorError("bad_subject")
    if kind == "odometry":
        t0_ns = _stamp(data.get("t0_ns")) - config.lag_ns
        if t0_ns >= t_ns:
            raise SensorError("bad_interval")
        if R.diagonal().min() < 0.0 or not is_positive_definite(R + FLOORS):
            raise SensorError("not_positive_definite")
        return Odometry(now_ns, t0_ns, t_ns, z, R)
    if not _is_covariance(R):
        raise SensorError("not_positive_definite")
    if kind in ABSOLUTE_KINDS:
        return Fix(now_ns, t_ns, kind, z, R, sensor)
    if kind in ("range", "range_bearing") and z[0] < 0.0:
        raise SensorError("out_of_range")
    if kind == "pixel" and config.intrinsics is None:
        raise SensorError("no_intrinsics")
    kind, z, R = config.reading(kind, of, z, R)
    return Observation(now_ns, t_ns, kind, of, z, R, sensor, config.mount, (roll, pitch))


def _stamp(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise SensorError("bad_stamp")
    return value


def _matrix(value: Any, size: int) -> Array:
    """(size, size) finite numbers, symmetric."""
    if type(value) is not list or len(value) != size:
        raise SensorError("wrong_length")
    for row in value:
        _check_numbers(row, (size,))
    matrix = np.array(value, dtype=np.float64)
    if size > 1 and (matrix != matrix.T).any():
        raise SensorError("not_positive_definite")
    return matrix


def _is_covariance(R: Array) -> bool:
    """Whether noise (n, n) of finite numbers is positive definite, with variances that are not below the floor."""
    if len(R) == 1:
        return bool(R.item(0) >= FLOOR)
    return bool(R.diagonal().min() >= FLOOR) and is_positive_definite(R)


def _array(value: Any, sizes: tuple[int, ...]) -> Array:
    """Finite numbers, as many as one of `sizes`."""
    _check_numbers(value, sizes)
    return np.array(value, dtype=np.float64)


def _check_numbers(value: Any, sizes: tuple[int, ...]) -> None:
    if type(value) is not list or len(value) not in sizes:
        raise SensorError("wrong_length")
    for number in value:
        if type(number) is not float and type(number) is not int:
            raise SensorError("wrong_type")
        # Not a number fails the comparison too.
        if not -MAX_VALUE <= number <= MAX_VALUE:
            raise SensorError("out_of_range")
