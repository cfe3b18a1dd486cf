"""Absolute information from an autopilot, thinned and inflated: its positions are themselves filtered.

Positions become ENU at the fleet's origin, whatever the autopilot's own origin is; a local position is used only with
its origin known. The accuracy is the configured one, or the GPS's own figure where that is worse.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent import frames
from agent.events import Fix

Array = NDArray[np.float64]

GPS_FRESH_NS = 5_000_000_000
GPS_3D_FIX = 3
HDG_MAX_CDEG = 36000
HDG_UNKNOWN = 65535
ACC_UNKNOWN = (0, 2**32 - 1)
LAT_MAX, LON_MAX = 900_000_000, 1_800_000_000


@dataclass(frozen=True, slots=True)
class FixSettings:
    """Which fixes are used and how far they are trusted; see `agent.autopilot.AutopilotSettings`."""

    origin: frames.Origin
    position: bool
    heading: bool
    local: bool
    sigma_m: float
    sigma_rad: float
    interval_ns: int
    inflation: float
    max_distance_m: float
    altitude: bool = False
    sigma_altitude_m: float = 3.0


@dataclass(frozen=True, slots=True)
class GpsReport:
    """Last GPS_RAW_INT: when, fix type, horizontal and vertical accuracy [m] (None: unknown)."""

    t_ns: int
    fix_type: int
    accuracy_m: float | None
    vertical_m: float | None


class VehicleFixes:
    """Turns positions and headings of one autopilot, already stamped, into fixes."""

    def __init__(self, settings: FixSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._last_ns: dict[str, int] = {}
        self._gps: GpsReport | None = None
        self._local_origin: frames.Origin | None = None

    def restart(self) -> None:
        """The autopilot rebooted: its GPS and its origin are unknown again."""
        self._last_ns.clear()
        self._gps = None
        self._local_origin = None

    def gps(self, now_ns: int, fix_type: int, h_acc_mm: int, v_acc_mm: int = 0) -> None:
        """GPS_RAW_INT: the state and accuracy behind the next positions."""
        accuracy = None if h_acc_mm in ACC_UNKNOWN else h_acc_mm * 1e-3
        vertical = None if v_acc_mm in ACC_UNKNOWN else v_acc_mm * 1e-3
        self._gps = GpsReport(now_ns, fix_type, accuracy, vertical)

    def origin(self, lat: int, lon: int, alt_mm: int) -> None:
        """GPS_GLOBAL_ORIGIN (1e-7 deg, mm): where the autopilot's local frame lies."""
        origin = self._geodetic(lat, lon, alt_mm)
        if origin is None or origin == self._local_origin:
            return
        if self._local_origin is not None:
            self._counters["mavlink.origin_moved"] += 1
        self._local_origin = origin

    def heading(self, now_ns: int, t_ns: int, heading: float) -> list[Fix]:
        """A heading [rad] at fleet instant `t_ns`."""
        if not self._thinned("heading", t_ns):
            return []
        return [self._fix(now_ns, t_ns, "heading", [heading], [self._settings.sigma_rad])]

    def global_position(self, now_ns: int, t_ns: int, lat: int, lon: int, alt_mm: int, hdg_cdeg: int) -> list[Fix]:
        """GLOBAL_POSITION_INT (1e-7 deg, mm, 0.01 deg): a `pose`, or a `position` without a usable heading.

        With their altitude if that is wanted; an `altitude` if that alone is.
        """
        place = self._geodetic(lat, lon, alt_mm)
        if place is None:
            return []
        heading: float | None = None
        if self._settings.heading and self._settings.position:
            if hdg_cdeg <= HDG_MAX_CDEG:
                heading = frames.heading_from_yaw(math.radians(hdg_cdeg / 100.0))
            else:
                unknown = hdg_cdeg == HDG_UNKNOWN
                self._counters["mavlink.no_heading" if unknown else "mavlink.out_of_range"] += 1
        return self._position(now_ns, t_ns, frames.geodetic_to_enu(*place, self._settings.origin), heading)

    def local_position(self, now_ns: int, t_ns: int, position: Array) -> list[Fix]:
        """A position (3,) in ENU axes at the autopilot's own origin."""
        if self._local_origin is None:
            self._counters["mavlink.no_origin"] += 1
            return []
        if float(np.abs(position).max()) > self._settings.max_distance_m:
            self._counters["mavlink.far_away"] += 1
            return []
        shifted = frames.local_origin_shift(position, self._local_origin, self._settings.origin)
        return self._position(now_ns, t_ns, shifted, None)

    def _position(self, now_ns: int, t_ns: int, point: Array, heading: float | None) -> list[Fix]:
        settings = self._settings
        if float(np.linalg.norm(point)) > settings.max_distance_m:
            self._counters["mavlink.far_away"] += 1
            return []
        sigma_m, sigma_z_m = settings.sigma_m, settings.sigma_altitude_m
        if self._gps is not None and now_ns - self._gps.t_ns <= GPS_FRESH_NS:
            if self._gps.fix_type < GPS_3D_FIX:
                self._counters["mavlink.no_gps_fix"] += 1
                return []
            sigma_m = max(sigma_m, self._gps.accuracy_m or 0.0)
            sigma_z_m = max(sigma_z_m, self._gps.vertical_m or 0.0)
        if not self._thinned("position", t_ns):
            return []
        x, y, up = (float(value) for value in point)
        if not settings.position:
            return [self._fix(now_ns, t_ns, "altitude", [up], [sigma_z_m])]
        z, sigma = ([x, y, up], [sigma_m, sigma_m, sigma_z_m]) if settings.altitude else ([x, y], [sigma_m, sigma_m])
        if heading is None:
            return [self._fix(now_ns, t_ns, "position", z, sigma)]
        return [self._fix(now_ns, t_ns, "pose", [*z, heading], [*sigma, settings.sigma_rad])]

    def _geodetic(self, lat: int, lon: int, alt_mm: int) -> frames.Origin | None:
        """Degrees and metres; None, counted, for "not known yet" (zeros) and nonsense."""
        if lat == 0 and lon == 0:
            self._counters["mavlink.no_position"] += 1
            return None
        if abs(lat) > LAT_MAX or abs(lon) > LON_MAX:
            self._counters["mavlink.out_of_range"] += 1
            return None
        return lat * 1e-7, lon * 1e-7, alt_mm * 1e-3

    def _thinned(self, name: str, t_ns: int) -> bool:
        """True for the first datum of each interval; stamps increase strictly."""
        last = self._last_ns.get(name)
        if last is not None and t_ns < last + max(self._settings.interval_ns, 1):
            return False
        self._last_ns[name] = t_ns
        return True

    def _fix(self, now_ns: int, t_ns: int, kind: str, z: list[float], sigma: list[float]) -> Fix:
        R = np.diag(np.square(sigma)) * self._settings.inflation
        return Fix(now_ns, t_ns, kind, np.array(z), R, "autopilot")

    def reasons(self) -> list[str]:
        """Why there are no fixes."""
        if not (self._settings.position or self._settings.altitude):
            return []
        found = []
        if self._settings.local and self._local_origin is None:
            found.append("no GPS_GLOBAL_ORIGIN: a local position cannot be placed")
        if self._gps is not None and self._gps.fix_type < GPS_3D_FIX:
            found.append("the GPS has no 3-D fix: positions are not used")
        if "position" not in self._last_ns and self._counters["mavlink.far_away"]:
            found.append("positions are far from the fleet's origin: check origin")
        if "position" not in self._last_ns and self._counters["mavlink.no_position"]:
            found.append("the autopilot does not know its position yet")
        return found
