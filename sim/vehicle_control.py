"""How a stand-in obeys: arming, modes and velocity set-points, as ArduPilot (Copter, Rover) and PX4 do; no I/O.

Set-points are not acknowledged. What ends a motion that nobody renews: ArduPilot holds the last set-point for 3 s and
then stands still in GUIDED; PX4 leaves OFFBOARD after 1 s. ArduPilot also stands still on a set-point whose frame or
type mask it does not know, PX4 ignores that. Not modelled: take-off and landing, positions as set-points (it stands
still), how fast a vehicle gains and loses speed.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent import frames
from agent.effects import Steer
from agent.flight_modes import ROVERS, Controls

Array = NDArray[np.float64]
Motion = tuple[tuple[float, float, float], float]
"""Velocity FLU [m/s] and yaw rate [rad/s], counter-clockwise."""

NS = 1_000_000_000
GUIDED_TIMEOUT_NS = 3 * NS
OFFBOARD_LOSS_NS = NS
"""PX4's COM_OF_LOSS_T."""
OFFBOARD_PROOF_NS = NS
"""Set-points have to come for so long before OFFBOARD, none later than `OFFBOARD_GAP_NS` after the one before."""
OFFBOARD_GAP_NS = NS // 2
ARMABLE_AFTER_NS = 15 * NS
"""Since boot: until then sensors settle, and arming is refused."""
TURN_GAIN_PER_S, MAX_TURN_RADPS = 1.0, 1.0
MAX_COMMANDS = 1000
STILL: Motion = ((0.0, 0.0, 0.0), 0.0)

BODY = (dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_OFFSET_NED)
ARDUPILOT_FRAMES = (dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_LOCAL_OFFSET_NED, *BODY)
PX4_FRAMES = (dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_NED)
POSITION, VELOCITY, FORCE = 0x007, 0x038, dialect.POSITION_TARGET_TYPEMASK_FORCE_SET
NO_YAW, NO_YAW_RATE = (
    dialect.POSITION_TARGET_TYPEMASK_YAW_IGNORE,
    dialect.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
)

ACCEPTED, FAILED = int(dialect.MAV_RESULT_ACCEPTED), int(dialect.MAV_RESULT_FAILED)
NOT_NOW, DENIED = int(dialect.MAV_RESULT_TEMPORARILY_REJECTED), int(dialect.MAV_RESULT_DENIED)
UNSUPPORTED = int(dialect.MAV_RESULT_UNSUPPORTED)
COMMANDS = (dialect.MAV_CMD_COMPONENT_ARM_DISARM, dialect.MAV_CMD_DO_SET_MODE)


@dataclass(frozen=True, slots=True)
class _SetPoint:
    """`velocity` in ENU if `local`, else FLU; a `heading` to turn to, or a `yaw_rate`, or neither."""

    t_ns: int
    velocity: Array
    local: bool
    heading: float | None
    yaw_rate: float | None


class VehicleControl:
    """Armed, mode and what was last commanded; `heading` is what the vehicle takes its heading to be."""

    def __init__(
        self,
        controls: Controls,
        vehicle_type: int,
        boot_ns: int,
        heading: Callable[[], float],
        mode: str | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.armed = False
        self.mode = controls.modes[mode or controls.by_hand]
        self._controls, self._boot_ns, self._heading = controls, boot_ns, heading
        self._turns_to_go = vehicle_type in ROVERS
        self._setpoint: _SetPoint | None = None
        self._stream_ns: tuple[int, int] | None = None
        self._changes: deque[tuple[int, Steer]] = deque(maxlen=MAX_COMMANDS)
        self._asked_ns = boot_ns

    # -- what it is told ------------------------------------------------------------------------------------

    def command(self, now_ns: int, message: Any) -> tuple[int, str | None]:
        """COMMAND_LONG or COMMAND_INT, one of `COMMANDS`: the MAV_RESULT, and a reason that STATUSTEXT tells."""
        self.advance(now_ns)
        # Parameters that are not meant come as NaN too.
        first, second, third = (
            0.0 if math.isnan(value) else value for value in (message.param1, message.param2, message.param3)
        )
        if not all(0.0 <= value < 2**32 for value in (first, second, third)):
            return DENIED, None
        if message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            result, reason = self._arm(now_ns, first)
        else:
            number = int(second)
            if self._controls.stream_first:
                number = int(second) << 16 | int(third) << 24
            result, reason = self.change_mode(now_ns, int(first), number)
        self._note(now_ns)
        return result, reason

    def _arm(self, now_ns: int, value: float) -> tuple[int, str | None]:
        if value not in (0.0, 1.0):
            return UNSUPPORTED, None
        if value == 1.0 and not self.armed:
            refused = NOT_NOW if self._controls.stream_first else FAILED
            if now_ns - self._boot_ns < ARMABLE_AFTER_NS:
                return refused, "Arm: Gyros inconsistent"
            if self._controls.stream_first and self._steered and not self._streamed(now_ns):
                return refused, "Arming denied: no offboard signal"
        self.armed = value == 1.0
        self._setpoint = None
        return ACCEPTED, None

    def change_mode(self, now_ns: int, base_mode: int, custom_mode: int) -> tuple[int, str | None]:
        """SET_MODE, or the command of that name."""
        if not base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return DENIED, None
        if custom_mode not in self._controls.modes.values():
            return FAILED, None
        offboard = self._controls.stream_first and custom_mode == self._controls.modes[self._controls.steered]
        if offboard and not self._streamed(now_ns):
            return NOT_NOW, "Switching to mode 'Offboard' is currently not available"
        self._switch(now_ns, custom_mode)
        return ACCEPTED, None

    def by_hand(self, now_ns: int, mode: str) -> None:
        """A person changes the mode at the remote control."""
        self.advance(now_ns)
        self._switch(now_ns, self._controls.modes[mode])

    def _switch(self, now_ns: int, custom_mode: int) -> None:
        if custom_mode != self.mode:
            self.mode, self._setpoint = custom_mode, None
            self._note(now_ns)

    def setpoint(self, now_ns: int, message: Any) -> None:
        """SET_POSITION_TARGET_LOCAL_NED."""
        self.advance(now_ns)
        values = (message.vx, message.vy, message.vz)
        mask, frame = message.type_mask, message.coordinate_frame
        if self._controls.stream_first and frame not in PX4_FRAMES:
            self.counters["setpoint.frame"] += 1
            return
        if self._controls.stream_first:
            began_ns, last_ns = self._stream_ns or (now_ns, now_ns)
            self._stream_ns = (now_ns if now_ns - last_ns > OFFBOARD_GAP_NS else began_ns, now_ns)
        if not (self.armed and self._steered):
            self.counters["setpoint.ignored"] += 1
            return
        wrong = "frame" if frame not in ARDUPILOT_FRAMES else ""
        if mask & POSITION != POSITION or mask & VELOCITY or mask & FORCE:
            wrong = "type_mask"
        elif not all(math.isfinite(value) for value in values):
            wrong = "not_finite"
        if wrong:
            self.counters[f"setpoint.{wrong}"] += 1
            self._setpoint = _SetPoint(now_ns, np.zeros(3), False, None, 0.0)
        else:
            self._setpoint = self._meant(now_ns, message, np.array(values), frame not in BODY)
        self._note(now_ns)

    def _meant(self, now_ns: int, message: Any, velocity: Array, local: bool) -> _SetPoint:
        mask, here = message.type_mask, self._heading()
        flu = frames.frd_to_flu(velocity)
        yaw_rate = heading = None
        if not mask & NO_YAW_RATE and math.isfinite(message.yaw_rate):
            yaw_rate = float(frames.frd_to_flu(np.array([0.0, 0.0, message.yaw_rate]))[2])
        elif not mask & NO_YAW and math.isfinite(message.yaw):
            # In a body frame it is relative to the nose: clockwise.
            heading = frames.heading_from_yaw(message.yaw) if local else frames.wrap(here - message.yaw)
        if self._turns_to_go and yaw_rate is None and not local:
            local, flu = True, frames.from_level_body(flu, here)
        elif local:
            flu = frames.ned_to_enu(velocity)
        return _SetPoint(now_ns, flu, local, heading, yaw_rate)

    # -- what it does ---------------------------------------------------------------------------------------

    @property
    def _steered(self) -> bool:
        return self.mode == self._controls.modes[self._controls.steered]

    def _streamed(self, now_ns: int) -> bool:
        """Whether PX4 takes somebody to be there who sends set-points."""
        if self._stream_ns is None:
            return False
        began_ns, last_ns = self._stream_ns
        return last_ns - began_ns >= OFFBOARD_PROOF_NS and now_ns - last_ns <= OFFBOARD_LOSS_NS

    def advance(self, now_ns: int) -> None:
        """Time goes on: PX4 leaves OFFBOARD when nobody sends set-points any more."""
        if self._controls.stream_first and self._steered and self._stream_ns is not None:
            lost_ns = self._stream_ns[1] + OFFBOARD_LOSS_NS
            if now_ns > lost_ns:
                self.counters["offboard_lost"] += 1
                self._switch(lost_ns, self._controls.modes[self._controls.by_hand])

    def commanded(self, t_ns: int) -> Motion | None:
        """How the vehicle moves at `t_ns`; None: it does not obey set-points, unarmed or in another mode."""
        self.advance(t_ns)
        if not (self.armed and self._steered):
            return None
        found = self._setpoint
        if found is None or t_ns >= self._until_ns(found):
            return STILL
        here = self._heading()
        ahead = frames.level_body(found.velocity, here) if found.local else found.velocity
        course = found.heading
        if self._turns_to_go:
            # A rover goes where its nose points.
            speed = float(ahead[0])
            if found.yaw_rate is None:
                if course is None and np.any(ahead[:2]):
                    course = here + math.atan2(ahead[1], ahead[0])
                off = 0.0 if course is None else frames.wrap(course - here)
                speed = math.hypot(*ahead[:2]) * max(math.cos(off), 0.0)
            ahead = np.array([speed, 0.0, 0.0])
        rate = found.yaw_rate
        if rate is None:
            turn = 0.0 if course is None else TURN_GAIN_PER_S * frames.wrap(course - here)
            rate = min(max(turn, -MAX_TURN_RADPS), MAX_TURN_RADPS)
        return (float(ahead[0]), float(ahead[1]), float(ahead[2])), rate

    def _until_ns(self, found: _SetPoint) -> int:
        return found.t_ns + (OFFBOARD_LOSS_NS if self._controls.stream_first else GUIDED_TIMEOUT_NS)

    def _note(self, t_ns: int) -> None:
        """Remember what is commanded from `t_ns` on."""
        motion = self.commanded(t_ns)
        if motion is None or self._setpoint is None:
            self._changes.append((t_ns, Steer(*STILL, t_ns)))
        else:
            self._changes.append((t_ns, Steer(*motion, self._until_ns(self._setpoint))))

    def commands(self, t_ns: int) -> list[tuple[int, Steer]]:
        """What was commanded since the last call, up to `t_ns`, each from its instant on until it ends or another does.

        A motion in a local frame, or towards a heading, is told anew at each call, as the vehicle has turned meanwhile.
        """
        self.advance(t_ns)
        found, began_ns = self._setpoint, self._asked_ns
        turning = found is not None and (found.local or found.heading is not None)
        if turning and found is not None and found.t_ns < began_ns:
            self._note(began_ns)
        self._asked_ns = t_ns
        told = sorted((item for item in self._changes if item[0] <= t_ns), key=lambda item: item[0])
        self._changes = deque((item for item in self._changes if item[0] > t_ns), maxlen=MAX_COMMANDS)
        return told
