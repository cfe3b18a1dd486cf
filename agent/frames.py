"""Frames and axes: the one place where NED/FRD becomes ENU/FLU.

Inside the fleet: local tangent plane ENU (x east, y north, z up) at an origin, heading counter-clockwise from
east, body FLU (x forward, y left, z up). Autopilots speak NED (x north, y east, z down), yaw clockwise from north,
body FRD. A local FRD frame (x along an arbitrary forward axis) is a NED frame whose north is unknown, and is
treated as one.

Geodesy on the WGS-84 ellipsoid by pymap3d.
"""

from __future__ import annotations

import math

import numpy as np
import pymap3d
from numpy.typing import NDArray

Array = NDArray[np.float64]
Origin = tuple[float, float, float]
"""Latitude and longitude [deg] and ellipsoidal height [m] of a tangent plane's point of contact."""


def wrap(angle: float) -> float:
    """An angle [rad] mapped to (-pi, pi]."""
    wrapped = math.remainder(angle, math.tau)
    return math.pi if wrapped <= -math.pi else wrapped


def ned_to_enu(vector: Array) -> Array:
    """(..., 3) north-east-down to east-north-up."""
    return np.stack([vector[..., 1], vector[..., 0], -vector[..., 2]], axis=-1)


def enu_to_ned(vector: Array) -> Array:
    """(..., 3) east-north-up to north-east-down."""
    return ned_to_enu(vector)


def frd_to_flu(vector: Array) -> Array:
    """(..., 3) forward-right-down to forward-left-up."""
    return np.stack([vector[..., 0], -vector[..., 1], -vector[..., 2]], axis=-1)


def flu_to_frd(vector: Array) -> Array:
    """(..., 3) forward-left-up to forward-right-down."""
    return frd_to_flu(vector)


def heading_from_yaw(yaw_ned: float) -> float:
    """Heading [rad] counter-clockwise from east of a yaw clockwise from north, in (-pi, pi]."""
    return wrap(0.5 * math.pi - yaw_ned)


def yaw_from_heading(heading: float) -> float:
    """Yaw [rad] clockwise from north of a heading counter-clockwise from east, in (-pi, pi]."""
    return wrap(0.5 * math.pi - heading)


def heading_from_quaternion(w: float, x: float, y: float, z: float) -> float:
    """Heading [rad] of a quaternion that rotates body FRD into local NED; its length does not matter."""
    yaw = math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return heading_from_yaw(yaw)


def quaternion_from_heading(heading: float) -> tuple[float, float, float, float]:
    """(w, x, y, z) of a level body, rotating body FRD into local NED."""
    half = 0.5 * yaw_from_heading(heading)
    return (math.cos(half), 0.0, 0.0, math.sin(half))


def level_body(vector: Array, heading: float) -> Array:
    """An ENU vector (3,) in the levelled body frame of `heading`: forward, left, up."""
    cos, sin = math.cos(heading), math.sin(heading)
    x, y, z = float(vector[0]), float(vector[1]), float(vector[2])
    return np.array([cos * x + sin * y, -sin * x + cos * y, z])


def from_level_body(vector: Array, heading: float) -> Array:
    """A levelled body vector (3,) - forward, left, up - in ENU."""
    return level_body(vector, -heading)


def geodetic_to_enu(lat_deg: float, lon_deg: float, alt_m: float, origin: Origin) -> Array:
    """A point in the tangent plane at `origin`: (3,) [m]."""
    return np.array(pymap3d.geodetic2enu(lat_deg, lon_deg, alt_m, *origin), dtype=np.float64)


def enu_to_geodetic(point: Array, origin: Origin) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of a point (3,) [m] of the tangent plane at `origin`."""
    lat, lon, alt = pymap3d.enu2geodetic(float(point[0]), float(point[1]), float(point[2]), *origin)
    return float(lat), float(lon), float(alt)


def local_origin_shift(point: Array, local_origin: Origin, fleet_origin: Origin) -> Array:
    """A point (3,) of the tangent plane at `local_origin`, in the one at `fleet_origin`.

    Exact: the planes' axes are not parallel, which a mere addition of the distance would ignore.
    """
    return geodetic_to_enu(*enu_to_geodetic(point, local_origin), fleet_origin)
