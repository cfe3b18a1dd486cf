"""A program of its own around MAVSDK: finds the vehicle on a UDP port, sets rates, prints what it reads as JSON."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import AsyncGenerator, Callable
from typing import Any

from mavsdk import ComponentType, Configuration
from mavsdk.asyncio import Mavsdk
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync


async def first(stream: AsyncGenerator[Any, None], good: Callable[[Any], bool] = lambda value: True) -> Any:
    async for value in stream:
        if good(value):
            return value
    raise AssertionError("the stream ended")


async def judge(port: int) -> dict[str, Any]:
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = await sdk.first_autopilot(timeout_s=10.0)
    assert system is not None, "no autopilot found"
    telemetry = TelemetryAsync(system)
    for name in (
        "position",
        "attitude_euler",
        "home",
        "gps_info",
        "landed_state",
        "position_velocity_ned",
        "odometry",
        "health",
    ):
        await getattr(telemetry, f"set_rate_{name}")(10.0)
    position = await first(telemetry.subscribe_position())
    euler = await first(telemetry.subscribe_attitude_euler())
    local = await first(telemetry.subscribe_position_velocity_ned())
    home = await first(telemetry.subscribe_home())
    health = await first(
        telemetry.subscribe_health(), lambda value: value.is_global_position_ok and value.is_home_position_ok
    )
    return {
        "system": await system.get_system_id(),
        "lat": position.latitude_deg,
        "lon": position.longitude_deg,
        "alt": position.absolute_altitude_m,
        "yaw_deg": euler.yaw_deg,
        "yaw_time_us": euler.timestamp_us,
        "north_m": local.position.north_m,
        "east_m": local.position.east_m,
        "north_mps": local.velocity.north_m_s,
        "home_lat": home.latitude_deg,
        "health": {key: bool(value) for key, value in vars(health).items()},
    }


if __name__ == "__main__":
    print(json.dumps(asyncio.run(asyncio.wait_for(judge(int(sys.argv[1])), 25.0))), flush=True)
    # The library's threads are not waited for.
    os._exit(0)
