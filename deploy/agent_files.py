"""The files of the agents of a run: what each is started with, and what each of its lives leaves behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.estimation.motion import LAYOUTS
from network.zenoh_session import link_pair
from sim.agents import agent_tables, autopilot_fix, odometry_table, table
from sim.fault_plan import trial_faults
from sim.host import HostPlan
from sim.scenario import RobotPart, Scenario, sensor_kind
from sim.world import World

# What the scheduling of one computer costs, in wall time: data of an instant are waited for so long, stamps that
# passed through TIMESYNC are off by so much, a robot's report of a round comes so late, and its odometry at the latest.
SETTLE_WALL_S = 0.015
STAMP_WALL_S = 0.0015
ROUND_WALL_S = 0.03
ODOMETRY_WALL_S = 0.3
ROUND_SHARE = 0.45
"""Of a round's period it waits no longer, twice: after that the next one begins."""
LEASE_MS, LEASE_PER_ROBOT_MS = 1_000, 250
"""Many processes that start on one computer are slow at first: links that are given up too soon are opened again and
again, and with forty of them that takes all the time there is."""


@dataclass(frozen=True, slots=True)
class Host:
    """A network namespace that stands for a robot's computer, and the address its peers reach it at.

    The autopilot stand-in stays on the loopback of the same namespace, as an autopilot beside its companion does.
    """

    namespace: str
    address: str


def agent_file(
    scenario: Scenario,
    world: World,
    robot: RobotPart,
    seed: int,
    speed: float,
    plan: HostPlan,
    run_dir: Path,
    state_dir: Path,
    ports: dict[str, int],
    hosts: Mapping[str, Host],
) -> dict[str, Any]:
    """The file of one agent: what is common to all runtimes, plus endpoints, clock and injection."""
    tables = agent_tables(scenario, world, robot)
    places = {name: hosts[name].address if name in hosts else "127.0.0.1" for name in ports}
    endpoints = {name: list(link_pair(places[name], port)) for name, port in ports.items()}
    lateness = tables["lateness"]
    lateness["settle_s"] = max(lateness["settle_s"], SETTLE_WALL_S * speed)
    lateness["tolerance_s"] = max(lateness["tolerance_s"], STAMP_WALL_S * speed)
    lateness["odometry_wait_s"] = max(lateness["odometry_wait_s"], ODOMETRY_WALL_S * speed)
    rounds = tables["round"]
    longest_s = max(rounds["wait_s"], ROUND_SHARE * rounds["period_s"])
    rounds["wait_s"] = min(max(rounds["wait_s"], lateness["settle_s"] + ROUND_WALL_S * speed), longest_s)
    fix = autopilot_fix(robot)
    mavlink: dict[str, Any] = {
        "endpoint": f"udpin:127.0.0.1:{plan.mavlink_ports[robot.id]}",
        "simulated": True,
        "odometry_source": "odometry",
        "odometry": odometry_table(scenario, robot),
        "rate_hz": 1.0 / scenario.step_s,
    }
    if scenario.planning_of(robot).kind != "none":
        mavlink |= {"steer": True, "arm": True, "set_mode": True}
    if fix is not None:
        sensor = robot.sensors[fix]
        mavlink |= {"fixes": ["position"], "fix_sigma_m": sensor.sigma_m, "fix_interval_s": 0.0}
        if sensor_kind(fix, sensor) == "pose":
            mavlink |= {"fixes": [*mavlink["fixes"], "heading"], "fix_sigma_rad": sensor.sigma_rad}
        if LAYOUTS[robot.model].altitude is not None:
            sigma_m = sensor.sigma_z_m or sensor.sigma_m
            mavlink |= {"fixes": [*mavlink["fixes"], "altitude"], "fix_sigma_altitude_m": sigma_m}
    return tables | {
        "clock": {"source": "run", "speed": speed},
        "lateness": lateness,
        "round": rounds,
        "zenoh": {
            "listen": endpoints[robot.id],
            "peers": [{"id": name, "endpoints": value} for name, value in endpoints.items() if name != robot.id],
            "insecure_lan": robot.id in hosts,
            "lease_ms": max(LEASE_MS, LEASE_PER_ROBOT_MS * len(endpoints)),
        },
        "mavlink": mavlink,
        "injection": {
            "seed": seed,
            "links": table(scenario.links),
            "faults": [
                table(fault.model_copy(update={"id": name}))
                for name, fault in trial_faults(scenario, seed).items()
                if fault.level in ("link", "forgery", "clock")
            ],
            **({} if hosts else {"table": plan.link_endpoint}),
            "fate_log": str(life_file(run_dir, robot.id, 1, "fates.csv")),
        },
        "state_dir": str(state_dir / robot.id),
        "recording": str(life_file(run_dir, robot.id, 1, "mcap")),
        "control_socket": plan.control_socket,
    }


def life_file(run_dir: Path, robot: str, life: int, ending: str) -> Path:
    """What a life of an agent leaves: the recording or the fate log of its first one, or of a later one."""
    number = "" if life == 1 else f".{life}"
    return run_dir / "agents" / f"{robot}{number}.{ending}"


def life_files(run_dir: Path, robot: str, ending: str) -> list[Path]:
    """Of all its lives, in order."""
    found, life = [], 1
    while (path := life_file(run_dir, robot, life, ending)).exists():
        found.append(path)
        life += 1
    return found
