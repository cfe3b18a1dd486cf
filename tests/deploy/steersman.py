"""A program that steers the vehicle on a UDP port in real time, by an agent's link and no more of an agent."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys

from agent.autopilot import AutopilotReader
from agent.autopilot_settings import AutopilotSettings
from agent.effects import Steer
from agent.fleet_clock import FleetClock
from agent.mavlink import MavlinkLink
from agent.steering_link import SteeringSettings

MOTION = ((0.5, 0.0, 0.0), 0.2)
PERIOD_S, HELD_NS = 0.2, 1_000_000_000


async def steer(port: int) -> None:
    clock, stop = FleetClock(), asyncio.Event()
    reader = AutopilotReader(AutopilotSettings(odometry_source="none", steering=SteeringSettings()))
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", reader, clock, lambda event: None)
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    await link.start()
    while not stop.is_set():
        link.steer(Steer(*MOTION, clock.now_ns() + HELD_NS))
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), PERIOD_S)
    await link.close()


if __name__ == "__main__":
    asyncio.run(steer(int(sys.argv[1])))
