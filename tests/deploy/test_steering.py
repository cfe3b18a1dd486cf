"""A vehicle that is steered: by an agent's shell, by an independent program, by one that hangs, dies or is stopped."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from agent.config import AgentConfig
from agent.config_file import validate
from agent.core import Agent
from agent.effects import Effect, Steer
from agent.events import ControlReport, Event, Odometry, PlannerOverrun
from agent.fleet_clock import FleetClock
from agent.shell import AgentShell
from network.transport import free_port
from sim.autopilot import StandIn, StandInServer, StandInSettings
from tests.deploy.steersman import MOTION

pytestmark = pytest.mark.realtime

S = 1_000_000_000
HERE = Path(__file__).parent
STILL = ((0.0, 0.0, 0.0), 0.0)
PATIENCE_S = 20.0
SLACK_S = 0.5
"""What the scheduling of a busy computer may cost."""


class Scene:
    """A vehicle on a socket, and a process that speaks to it."""

    def __init__(self, server: StandInServer, clock: FleetClock, process: asyncio.subprocess.Process) -> None:
        self.control, self._clock, self.process = server.stand_in.control, clock, process

    @property
    def commanded(self) -> Any:
        return self.control.commanded(self._clock.now_ns())

    async def until(self, condition: Callable[[], bool]) -> float:
        """Seconds that it took."""
        begun = time.monotonic()
        async with asyncio.timeout(PATIENCE_S):
            while not condition():
                await asyncio.sleep(0.005)
        return time.monotonic() - begun

    async def said(self) -> dict[str, Any]:
        """What the process says next, once it has been told to go on."""
        assert self.process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            while not (line := await self.process.stdout.readline()).startswith(b"{"):
                assert line, "the process has ended"
        found: dict[str, Any] = json.loads(line)
        return found

    def go_on(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")


@contextlib.asynccontextmanager
async def scene(program: str, **vehicle: Any) -> AsyncIterator[Scene]:
    port, clock = free_port(), FleetClock()
    stand_in = StandIn(StandInSettings(boot_ns=clock.now_ns() - 60 * S, **vehicle))
    server = StandInServer(stand_in, f"udpout:127.0.0.1:{port}", clock)
    pipe = asyncio.subprocess.PIPE
    arguments = (sys.executable, "-P", str(HERE / program), str(port))
    process = await asyncio.create_subprocess_exec(*arguments, stdin=pipe, stdout=pipe)
    await server.start()
    try:
        yield Scene(server, clock, process)
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        await server.close()


@pytest.mark.parametrize(
    ("flavour", "word", "deadman_s"),
    [("ardupilot", signal.SIGSTOP, 3.0), ("ardupilot", signal.SIGTERM, 0.0), ("px4", signal.SIGKILL, 1.0)],
)
def test_a_vehicle_whose_agent_hangs_dies_or_is_stopped_stands_still(
    flavour: str, word: signal.Signals, deadman_s: float
) -> None:
    async def play() -> None:
        mode = "GUIDED" if flavour == "ardupilot" else "OFFBOARD"
        async with scene("steersman.py", flavour=flavour, armed=True, mode=mode) as found:
            await found.until(lambda: found.commanded not in (None, STILL))
            assert found.commanded == (pytest.approx(MOTION[0]), pytest.approx(MOTION[1]))
            # A while, through several set-points.
            await asyncio.sleep(0.5)
            assert found.commanded not in (None, STILL)
            found.process.send_signal(word)
            took_s = await found.until(lambda: found.commanded in (None, STILL))
            assert deadman_s - 0.2 - SLACK_S <= took_s <= deadman_s + SLACK_S
            if word == signal.SIGSTOP:
                found.process.send_signal(signal.SIGCONT)
                await found.until(lambda: found.commanded not in (None, STILL))
            if word == signal.SIGTERM:
                assert await found.process.wait() == 0

    asyncio.run(play())


@pytest.mark.parametrize("flavour", ["ardupilot", "px4"])
def test_mavsdk_arms_and_steers_the_vehicle(flavour: str) -> None:
    """An independent implementation: right, down and clockwise are its own words."""

    async def play() -> None:
        copter = dialect.MAV_TYPE_QUADROTOR
        async with scene("mavsdk_pilot.py", flavour=flavour, vehicle_type=copter) as found:
            assert await found.said() == {"armed": True}
            assert found.control.armed and found.commanded is None
            found.go_on()
            said = await found.said()
            assert said["body"] and (said["refused"] > 0) == (flavour == "px4")
            assert found.commanded == (pytest.approx((1.0, -0.5, 0.25)), pytest.approx(-0.2618, abs=1e-4))
            found.go_on()
            assert await found.said() == {"ned": True}
            # Its nose points to the east, where it takes its start to be.
            assert found.commanded == (pytest.approx((2.0, 1.0, 0.5)), pytest.approx(0.0, abs=1e-6))
            found.go_on()
            assert await found.said() == {"stopped": True}
            await found.until(lambda: found.commanded in (None, STILL))
            found.go_on()
            assert await found.said() == {"disarmed": True}
            assert not found.control.armed

    asyncio.run(play())


def config(folder: Path, port: int) -> AgentConfig:
    table = {
        "version": 1,
        "identity": {"robot": "r1"},
        "initial": {"mean": [0.0, 0.0, 0.0], "start_sigma": {"position_m": 0.5, "heading_rad": 0.1}},
        "zenoh": {"listen": [f"tcp/127.0.0.1:{free_port(exclude=[port])}"]},
        "mavlink": {"endpoint": f"udpin:127.0.0.1:{port}", "steer": True, "arm": True, "set_mode": True},
        "state_dir": str(folder),
    }
    return validate(AgentConfig, table, "r1.toml")


def test_what_an_agent_plans_reaches_the_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the core's effect to what the vehicle does, back to what the core is told; one plan takes too long."""
    told: list[Event] = []
    handle, slow = Agent.handle, [True]

    def planning(self: Agent, event: Event) -> list[Effect]:
        told.append(event)
        effects = handle(self, event)
        if isinstance(event, Odometry):
            if slow.pop() if slow else False:
                time.sleep(0.6)
            effects.append(Steer(*MOTION, event.t_ns + S))
        return effects

    async def play() -> None:
        port, clock = free_port(), FleetClock()
        server = StandInServer(
            StandIn(StandInSettings(boot_ns=clock.now_ns() - 60 * S)), f"udpout:127.0.0.1:{port}", clock
        )
        await server.start()
        shell = AgentShell(config(tmp_path, port))
        running = asyncio.create_task(shell.run())

        def drive() -> bool:
            server.stand_in.set_odometry(clock.now_ns(), np.array([0.01, 0.0, 0.0, 0.0]))
            server.push(clock.now_ns())
            return server.stand_in.control.commanded(clock.now_ns()) not in (None, STILL)

        try:
            async with asyncio.timeout(PATIENCE_S):
                while not (drive() and shell.status()["autopilot"]["steering"]["moving"]):
                    assert not running.done()
                    await asyncio.sleep(0.05)
            motion = server.stand_in.control.commanded(clock.now_ns())
            assert motion == (pytest.approx(MOTION[0]), pytest.approx(MOTION[1]))
            assert [event.refused for event in told if isinstance(event, ControlReport)][-1] is None
            assert sum(isinstance(event, PlannerOverrun) for event in told) == 1
            figures = shell.figures()
            assert figures["autopilot"]["steer.setpoints"] > 0
            assert max(figures["plan_us"]) >= 600_000 and min(figures["plan_us"]) < 500_000
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            await running
        await asyncio.sleep(0.05)
        assert server.stand_in.control.commanded(clock.now_ns()) == STILL, "told to stop with the agent's last words"
        await server.close()

    monkeypatch.setattr(Agent, "handle", planning)
    asyncio.run(play())
