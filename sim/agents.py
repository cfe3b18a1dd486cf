"""From a scenario to the configuration of each agent: the same tables whatever the runtime."""

from __future__ import annotations

import math
from typing import Any

from agent.config import AgentConfig
from agent.config_file import validate
from sim.scenario import RobotPart, Scenario, sensor_kind, target_sensor
from sim.sensor_noise import control_odometry
from sim.world import World

FLEET = "sim"


def table(part: Any) -> dict[str, Any]:
    """A part as a plain table without absent keys."""
    return dict(part.model_dump(exclude_none=True))


def agent_tables(scenario: Scenario, world: World, robot: RobotPart) -> dict[str, Any]:
    """The part of an agent's file that does not depend on the runtime."""
    mean, _ = world.start_belief(robot.id)
    targets = []
    for target in scenario.targets:
        control, noise = target.assumed()
        prior = {"mean": [float(value) for value in world.start_belief(target.id)[0]]} if target.prior else {}
        targets.append(
            {
                "id": target.id,
                "model": target.model,
                **prior,
                "start_sigma": table(target.start_sigma),
                "control": table(control),
                "noise": table(noise),
                "noise_step_s": scenario.step_s,
                "damping_s": target.damping_s,
            }
        )
    return {
        "version": 1,
        "identity": {"fleet": FLEET, "robot": robot.id, "incarnation": 1},
        "origin": list(scenario.origin),
        "initial": {
            "source": robot.start_source,
            **({"mean": [float(value) for value in mean]} if robot.start_source == "survey" else {}),
            "start_sigma": table(robot.start_sigma),
        },
        "motion": table(robot.motion()),
        "localization": table(scenario.localization_of(robot)),
        "tracking": table(scenario.tracking_of(robot)),
        "correspondence": correspondence_table(scenario, robot),
        "lateness": table(scenario.lateness_of(robot)),
        "coast": table(scenario.coast),
        "health": table(scenario.health),
        "round": table(scenario.round),
        "planning": planning_table(scenario, world.seed, robot),
        "unsafe": table(scenario.unsafe),
        "network": table(scenario.network),
        "state": table(scenario.state),
        "sensors": {
            name: {
                "kind": sensor_kind(name, sensor),
                "mount": list(sensor.mount),
                "two_way": sensor.two_way,
                "calibration": table(sensor.calibration),
                "lag_s": sensor.lag_s,
                "form": sensor.form,
                **({"intrinsics": table(sensor.intrinsics)} if sensor_kind(name, sensor) == "pixel" else {}),
            }
            for name, sensor in world.sensors(robot.id).items()
        },
        "targets": targets,
        "landmarks": [{"id": name, "position": [float(x) for x in place]} for name, place in world.landmarks.items()],
        **({"team": team_tables(scenario, world, robot)} if scenario.localization_of(robot).kind == "replica" else {}),
        "zenoh": {"listen": [], "peers": []},
        "state_dir": "state",
    }


def correspondence_table(scenario: Scenario, robot: RobotPart) -> dict[str, Any]:
    """How a robot tells the others apart, and who they are."""
    found = table(scenario.correspondence_of(robot))
    localization = scenario.localization_of(robot)
    if localization.kind == "relative" or scenario.correspondence_of(robot).names(localization):
        found["peers"] = [other.id for other in scenario.robots if other.id != robot.id]
    return found


def team_tables(scenario: Scenario, world: World, robot: RobotPart) -> list[dict[str, Any]]:
    """What a robot is told of all others."""
    return [
        {
            "id": other.id,
            "mean": [float(value) for value in world.start_belief(other.id)[0]],
            "start_sigma": table(other.start_sigma),
            "motion": table(other.motion()),
        }
        for other in scenario.robots
        if other.id != robot.id
    ]


FAR_M = 1000.0
"""How far a planner takes a sensor without a largest range to see."""


def planning_table(scenario: Scenario, seed: int, robot: RobotPart) -> dict[str, Any]:
    """How a robot chooses its motion; what is not stated is as vehicle, noise, sensors, links and seed are."""
    odometry, camera = control_odometry(robot, scenario.step_s), target_sensor(robot)
    derived: dict[str, Any] = {
        "max_speed_mps": robot.vehicle.max_speed_mps,
        "max_turn_radps": robot.vehicle.max_turn_radps,
        "max_climb_mps": robot.vehicle.climb_mps,
        "speed_share": odometry.along_share,
        "heading_rad_per_m": odometry.heading_rad_per_m,
        "seed": seed,
    }
    if scenario.links.range_m is not None:
        derived["radio_range_m"] = scenario.links.range_m
    if camera is not None:
        derived["sensing"] = {
            "min_range_m": camera.min_range_m,
            "max_range_m": camera.max_range_m or FAR_M,
            "fov_rad": camera.fov_rad or 2.0 * math.pi,
            "sigma_m": camera.sigma_m or 0.0,
            "sigma_m_per_m": camera.sigma_m_per_m,
            "sigma_rad": camera.sigma_rad,
        }
    return derived | table(scenario.planning_of(robot))


def autopilot_fix(robot: RobotPart) -> str | None:
    """The sensor whose fixes come from the autopilot: a pose, or else a position; None if it has no global position."""
    kinds = {name: sensor_kind(name, sensor) for name, sensor in robot.sensors.items()}
    if "global_position" not in robot.autopilot.sends:
        return None
    return next((name for kind in ("pose", "position") for name, found in kinds.items() if found == kind), None)


def agent_config(scenario: Scenario, world: World, robot: RobotPart) -> AgentConfig:
    """The validated configuration used in virtual time."""
    return validate(AgentConfig, agent_tables(scenario, world, robot), robot.id)


def odometry_table(scenario: Scenario, robot: RobotPart) -> dict[str, float]:
    """The odometry noise an agent assumes for increments it reads from its autopilot.

    Gains are left at one and the lag at zero: the stand-in reports increments that are calibrated already.
    """
    noise = control_odometry(robot, scenario.step_s)
    return {
        "along_m_per_sqrt_s": noise.along_m_per_sqrt_s,
        "along_m_per_sqrt_m": noise.along_m_per_sqrt_m,
        "along_share": noise.along_share,
        "across_m_per_sqrt_s": noise.across_m_per_sqrt_s,
        "vertical_m_per_sqrt_s": noise.vertical_m_per_sqrt_s,
        "heading_rad_per_sqrt_s": noise.heading_rad_per_sqrt_s,
        "heading_rad_per_sqrt_rad": noise.heading_rad_per_sqrt_rad,
        "heading_rad_per_m": noise.heading_rad_per_m,
    }
