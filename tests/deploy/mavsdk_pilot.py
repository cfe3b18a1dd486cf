"""A program of its own around MAVSDK: arms the vehicle on a UDP port, steers it in offboard mode, lets it go.

It says each thing it has done in a line of JSON, and goes on when it is sent a line.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from typing import Any

from mavsdk import ComponentType, Configuration
from mavsdk.asyncio import Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync, OffboardError
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.offboard import VelocityBodyYawspeed, VelocityNedYaw

TRIES = 40


async def say(**done: Any) -> None:
    print(json.dumps(done), flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.readline)


async def pilot(port: int) -> None:
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = await sdk.first_autopilot(timeout_s=10.0)
    assert system is not None, "no autopilot found"
    action, offboard, telemetry = ActionAsync(system), OffboardAsync(system), TelemetryAsync(system)
    await action.arm()
    async for armed in telemetry.subscribe_armed():
        if armed:
            break
    await say(armed=True)
    await offboard.set_velocity_body(VelocityBodyYawspeed(1.0, 0.5, -0.25, 15.0))
    refused = 0
    while True:
        try:
            await offboard.start()
            break
        except OffboardError:
            # It has to send set-points for a while first.
            refused += 1
            assert refused < TRIES
            await asyncio.sleep(0.1)
    await asyncio.sleep(0.2)
    await say(body=True, refused=refused)
    await offboard.set_velocity_ned(VelocityNedYaw(1.0, 2.0, -0.5, 90.0))
    await asyncio.sleep(0.2)
    await say(ned=True)
    await offboard.stop()
    await say(stopped=True)
    await action.disarm()
    await say(disarmed=True)


if __name__ == "__main__":
    asyncio.run(asyncio.wait_for(pilot(int(sys.argv[1])), 40.0))
    # The library's threads are not waited for.
    os._exit(0)
