"""`cofix sitl`: an autopilot stand-in that drives a circle in real time, to try an agent's MAVLink link on a desk.

Armed and in its mode for it, it obeys set-points instead.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import sys
import time

import numpy as np

from agent import frames
from agent.config_file import ConfigError
from agent.estimation.motion import compose
from agent.fleet_clock import FleetClock
from agent.mavlink_endpoint import MavlinkError
from sim.autopilot import StandIn, StandInServer
from sim.vehicle_telemetry import StandInSettings

RATE_HZ = 20.0
ORIGIN = (47.397742, 8.545594, 488.0)


def drive_circle(options: argparse.Namespace) -> int:
    """Run until interrupted; exit status."""
    if options.system_id > 255:
        raise ConfigError(f"--system-id must be from 1 to 255, not {options.system_id}")
    sends = ("odometry", "attitude", "local_position") + (("global_position",) if options.gps else ())
    settings = StandInSettings(
        system_id=options.system_id,
        flavour=options.flavour,
        sends=sends,
        origin=ORIGIN,
        boot_ns=time.time_ns(),
    )
    try:
        asyncio.run(_drive(settings, options))
    except (MavlinkError, ValueError) as error:
        raise ConfigError(f"--endpoint {options.endpoint}: {error}") from None
    return 0


async def _drive(settings: StandInSettings, options: argparse.Namespace) -> None:
    clock = FleetClock()
    server = StandInServer(StandIn(settings), options.endpoint, clock)
    await server.start()
    print(f"cofix: vehicle {settings.system_id} speaks to {options.endpoint}; stop it with Ctrl-C", file=sys.stderr)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    step_s, speed = 1.0 / RATE_HZ, options.vehicle_speed
    circle = ((speed, 0.0, 0.0), speed / options.radius)
    pose, z = np.array([options.radius, 0.0, np.pi / 2.0]), 0.0
    try:
        while not stop.is_set():
            now_ns = clock.now_ns()
            (forward, left, up), turn = server.stand_in.control.commanded(now_ns) or circle
            delta = step_s * np.array([forward, left, up, turn])
            server.stand_in.set_odometry(now_ns, delta)
            x, y, heading = (float(value) for value in pose)
            vx, vy, vz = frames.from_level_body(np.array([forward, left, up]), heading).tolist()
            server.stand_in.set_state(now_ns, x, y, z, heading, vx, vy, vz, turn)
            server.push(now_ns)
            pose, z = compose(pose, delta[[0, 1, 3]]), z + float(delta[2])
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(stop.wait(), step_s)
    finally:
        await server.close()
