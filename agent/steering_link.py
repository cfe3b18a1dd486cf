"""Steering a vehicle by MAVLink: the newest `Steer` and what the autopilot says of itself in, messages out; no I/O.

Velocity set-points are never acknowledged: nothing but its HEARTBEAT tells that an autopilot obeys them. So they are
sent only while that shows it armed and in its mode for them (ArduPilot GUIDED, PX4 OFFBOARD), again and again until
the `Steer` ends, then to stand still for `STOP_NS`, then no more: the autopilot's own time-out is the last resort.

A vehicle that is steered stays a person's: whoever changes its mode or disarms it has it, and it is not asked back. The
mode is asked for only while it is disarmed, arming only in that mode, each only if the settings allow it. PX4 enters
OFFBOARD only with set-points coming in: while it is in another mode, it is told to stand still.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.effects import Steer
from agent.events import ControlReport
from agent.flight_modes import Controls, controls
from agent.requests import command_long

MS = 1_000_000
NS = 1_000_000_000
UNKNOWN_INTERVAL_NS = NS // 10
"""Of a vehicle that is not known yet it is looked so often whether it may be steered."""
STOP_NS = NS
STREAM_FIRST_NS = 3 * NS // 2
"""PX4 enters OFFBOARD after a second of set-points."""
ASK_INTERVAL_NS = 2 * NS
SILENT_AFTER_NS = 3 * NS
SAID_NEAR_NS = NS
PARTING_SETPOINTS = 3
FOREVER_NS = 2**63 - 1

FRAME = dialect.MAV_FRAME_BODY_NED
"""The one body frame that both obey: forward, right, down of the vehicle. BODY_FRD stops ArduPilot, PX4 ignores it."""
TYPE_MASK = (
    dialect.POSITION_TARGET_TYPEMASK_X_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_Z_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_AZ_IGNORE
    | dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE
)
"""Velocity and yaw rate are meant, nothing else."""
RESULTS = {
    dialect.MAV_RESULT_TEMPORARILY_REJECTED: "not now",
    dialect.MAV_RESULT_DENIED: "denied",
    dialect.MAV_RESULT_UNSUPPORTED: "not supported",
    dialect.MAV_RESULT_FAILED: "failed",
}
STILL = ((0.0, 0.0, 0.0), 0.0)
MODE, ARM = dialect.MAV_CMD_DO_SET_MODE, dialect.MAV_CMD_COMPONENT_ARM_DISARM


@dataclass(frozen=True, slots=True)
class SteeringSettings:
    """What may be asked of the autopilot besides motion: to be armed, and to change its mode while it is disarmed."""

    arm: bool = False
    set_mode: bool = False


@dataclass(slots=True)
class _Asked:
    """A state of the vehicle that may be asked for, until it is reached or somebody else decides."""

    allowed: bool
    reached: bool = False
    tried: bool = False
    next_ns: int = 0
    refused: str | None = None
    refused_ns: int = 0

    def due(self, now_ns: int) -> bool:
        return self.allowed and not self.reached and now_ns >= self.next_ns


class SteeringLink:
    """One vehicle; without settings it says nothing. Times in ns of the own clock."""

    def __init__(self, settings: SteeringSettings | None, counters: Counter[str]) -> None:
        self._enabled, self._counters = settings is not None, counters
        allowed = settings or SteeringSettings()
        self._mode_asked, self._arm_asked = _Asked(allowed.set_mode), _Asked(allowed.arm)
        self._steer: Steer | None = None
        self._heartbeat_ns: int | None = None
        self._kind = (0, 0)
        self._controls: Controls | None = None
        self._mode, self._armed = -1, False
        self._said, self._said_ns = "", -FOREVER_NS
        self._streaming_since_ns: int | None = None
        self._stop_until_ns: int | None = None
        self._moving = False
        self._next_ns = 0
        self._told: str | None = ""

    # -- what is wanted -------------------------------------------------------------------------------------

    def steer(self, steer: Steer) -> None:
        """The newest one counts; one that is not finite stands for standing still."""
        if not all(math.isfinite(value) for value in (*steer.velocity_mps, steer.yaw_rate_radps)):
            self._counters["steer.not_finite"] += 1
            steer = Steer(*STILL, steer.until_ns)
        self._steer, self._next_ns = steer, 0

    def restart(self) -> None:
        """The own clock was set back: what was due at its old time is due now, and what was wanted has ended."""
        self._steer = self._streaming_since_ns = self._stop_until_ns = None
        self._moving = False
        self._next_ns = self._mode_asked.next_ns = self._arm_asked.next_ns = 0
        self._heartbeat_ns = None

    # -- what the autopilot says ----------------------------------------------------------------------------

    def heartbeat(self, now_ns: int, message: Any) -> None:
        """HEARTBEAT of the vehicle."""
        self._heartbeat_ns, self._kind = now_ns, (int(message.autopilot), int(message.type))
        self._controls = controls(*self._kind)
        armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        if self._controls is None:
            return
        changed = message.custom_mode != self._mode
        self._mode, self._armed = int(message.custom_mode), armed
        if self._in_mode:
            self._mode_asked.reached = True
        elif changed and self._mode_asked.tried:
            # Somebody else has chosen.
            self._mode_asked.reached = True
        self._arm_asked.reached |= armed

    def acknowledged(self, now_ns: int, message: Any) -> None:
        """COMMAND_ACK of a command of ours."""
        asked = {MODE: self._mode_asked, ARM: self._arm_asked}.get(message.command)
        if asked is None or not asked.tried or message.result == dialect.MAV_RESULT_IN_PROGRESS:
            return
        asked.refused, asked.refused_ns = None, now_ns
        if message.result != dialect.MAV_RESULT_ACCEPTED:
            asked.refused = RESULTS.get(message.result, f"result {message.result}")
            self._counters["steer.refused"] += 1

    def text(self, now_ns: int, message: Any) -> None:
        """STATUSTEXT: the only place where an autopilot says why it refuses."""
        if message.severity <= dialect.MAV_SEVERITY_WARNING:
            text = message.text if isinstance(message.text, str) else ""
            self._said = "".join(letter for letter in text if letter.isascii() and letter.isprintable())
            self._said_ns = now_ns

    # -- what it is told ------------------------------------------------------------------------------------

    def due(self, now_ns: int, vehicle: tuple[int, int]) -> list[Any]:
        """Messages due by now for `vehicle` (system, component)."""
        out = []
        interval_ns = UNKNOWN_INTERVAL_NS if self._controls is None else self._controls.setpoint_ns
        # A clock that was set back a little must not make a gap.
        early = self._next_ns - now_ns > interval_ns
        if self._steer is not None and (early or now_ns >= self._setpoint_ns()):
            motion = self._motion(now_ns, self._steer)
            self._next_ns = now_ns + interval_ns
            if motion is not None:
                self._streaming_since_ns = now_ns if self._streaming_since_ns is None else self._streaming_since_ns
                out.append(self._setpoint(now_ns, vehicle, *motion))
            else:
                self._streaming_since_ns = None
                if now_ns >= self._steer.until_ns:
                    self._steer = None
        return out + self._requests(now_ns, vehicle)

    def next_deadline_ns(self) -> int:
        """When the next set-point is due; what is asked for may come up to a second later."""
        return self._setpoint_ns()

    def parting(self, now_ns: int, vehicle: tuple[int, int]) -> list[Any]:
        """The last words to a vehicle that may be moving: stand still, more than once for they may be lost."""
        if not self._obeys or self._stop_until_ns is None:
            return []
        return [self._setpoint(now_ns, vehicle, *STILL)] * PARTING_SETPOINTS

    def _setpoint_ns(self) -> int:
        """At its interval, and at once when the motion that was asked for ends."""
        if self._steer is None:
            return FOREVER_NS
        return min(self._next_ns, self._steer.until_ns) if self._moving else self._next_ns

    def _motion(self, now_ns: int, steer: Steer) -> tuple[tuple[float, float, float], float] | None:
        """Velocity FLU and yaw rate to ask for now, None: nothing."""
        wanted, heard = now_ns < steer.until_ns, self._heard(now_ns)
        self._moving = wanted and heard and self._obeys
        if self._moving:
            self._stop_until_ns = steer.until_ns + STOP_NS
            return steer.velocity_mps, steer.yaw_rate_radps
        if heard and not self._obeys:
            # It is not ours: no last word either, for it would not be obeyed.
            self._stop_until_ns = None
            return STILL if wanted and self._controls is not None and self._controls.stream_first else None
        if self._stop_until_ns is None:
            return None
        # From now on, if it ends early because the autopilot has fallen silent.
        self._stop_until_ns = min(self._stop_until_ns, now_ns + STOP_NS)
        if now_ns < self._stop_until_ns:
            return STILL
        self._stop_until_ns = None
        return None

    def _setpoint(
        self, now_ns: int, vehicle: tuple[int, int], velocity: tuple[float, float, float], yaw_rate: float
    ) -> Any:
        self._counters["steer.setpoints"] += 1
        linear = frames.flu_to_frd(np.array(velocity))
        angular = frames.flu_to_frd(np.array([0.0, 0.0, yaw_rate]))
        return dialect.MAVLink_set_position_target_local_ned_message(
            max(now_ns, 0) // MS % 2**32, *vehicle, FRAME, TYPE_MASK, 0, 0, 0, *linear, 0, 0, 0, 0, angular[2]
        )

    def _requests(self, now_ns: int, vehicle: tuple[int, int]) -> list[Any]:
        """What the vehicle needs before it obeys, as far as it may be asked for."""
        wanted = self._steer is not None and now_ns < self._steer.until_ns
        if not wanted or self._controls is None or not self._heard(now_ns) or self._armed:
            return []
        if not self._in_mode:
            asked, number, parameters = self._mode_asked, MODE, self._controls.parameters(self._controls.steered)
            since_ns = self._streaming_since_ns
            if self._controls.stream_first and (since_ns is None or now_ns < since_ns + STREAM_FIRST_NS):
                return []
        else:
            asked, number, parameters = self._arm_asked, ARM, (1.0, 0.0, 0.0)
        if not asked.due(now_ns):
            return []
        asked.tried, asked.next_ns = True, now_ns + ASK_INTERVAL_NS
        return [command_long(vehicle, number, *parameters)]

    # -- how it stands --------------------------------------------------------------------------------------

    @property
    def _in_mode(self) -> bool:
        return self._controls is not None and self._mode == self._controls.modes[self._controls.steered]

    @property
    def _obeys(self) -> bool:
        return self._in_mode and self._armed

    def _heard(self, now_ns: int) -> bool:
        return self._heartbeat_ns is not None and now_ns - self._heartbeat_ns <= SILENT_AFTER_NS

    def reports(self, now_ns: int) -> list[ControlReport]:
        """Whether the vehicle obeys, and else why not: as soon as it is heard, and whenever that changes."""
        if not self._enabled or self._heartbeat_ns is None:
            return []
        missing = self._missing(now_ns)
        if missing == self._told:
            return []
        self._told = missing
        return [ControlReport(now_ns, missing)]

    def status(self, now_ns: int) -> dict[str, Any] | None:
        """Plain values: mode, armed, what is missing, and whether motion is asked for; None if not switched on."""
        if not self._enabled:
            return None
        return {
            "mode": self._controls.name(self._mode) if self._controls is not None else None,
            "armed": self._armed if self._controls is not None else None,
            "missing": self._missing(now_ns),
            "moving": self._moving,
        }

    def _missing(self, now_ns: int) -> str | None:
        if not self._heard(now_ns):
            return "the autopilot is silent: it is not steered"
        if self._controls is None:
            return (
                f"nobody knows how to steer autopilot {self._kind[0]} of vehicle type {self._kind[1]}: "
                "ArduPilot Copter and Rover and PX4 are steered; set mavlink.steer = false"
            )
        steered, mode = self._controls.steered, self._controls.name(self._mode)
        if not self._in_mode:
            asked, what = self._mode_asked, f"{steered} refused"
            if asked.reached:
                return f"taken over: the mode is {mode}; switch it to {steered} to hand the vehicle over"
            hint = f"the mode is {mode}: switch it to {steered}"
            if not self._armed:
                hint += ", or set mavlink.set_mode = true"
        elif not self._armed:
            asked, what, hint = self._arm_asked, "arming refused", "not armed: arm it, or set mavlink.arm = true"
            if asked.reached:
                return "disarmed: arm it to go on"
        else:
            return None
        if asked.refused is not None:
            near = abs(self._said_ns - asked.refused_ns) <= SAID_NEAR_NS
            return f"{what}: {self._said if near and self._said else asked.refused}"
        if asked.allowed and not (asked is self._mode_asked and self._armed):
            return f"waiting for {steered}" if asked is self._mode_asked else "waiting to be armed"
        return hint
