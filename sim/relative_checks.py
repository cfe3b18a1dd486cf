"""What no single key of a scenario can tell of robots that locate each other relative to their own bodies."""

from __future__ import annotations

from agent.config_file import ConfigError
from agent.estimation.mounting import mount_of
from agent.motion_parts import ControlNoisePart, ControlPart
from agent.relative_parts import CAMERAS, MAX_RELATIVE, check_altitude, check_leader
from sim.scenario import RobotPart, Scenario, SensorPart, sensor_kind


def check_relative(scenario: Scenario) -> None:
    """Raises `ConfigError` for a fleet that finds out who is who and lacks something, and for keys only it uses."""
    leaders, fleet, naming = 0, [], []
    for robot in scenario.robots:
        where = f"{scenario.name}: robots.{robot.id}"
        localization, correspondence = scenario.localization_of(robot), scenario.correspondence_of(robot)
        relative, names = localization.kind == "relative", correspondence.names(localization)
        what = "localization.kind = 'relative'" if relative else "correspondence.kind = 'gaussian_sum'"
        cameras = {name: sensor for name, sensor in robot.sensors.items() if sensor_kind(name, sensor) in CAMERAS}
        for name, sensor in cameras.items():
            _check_camera(f"{where}.sensors.{name}", sensor)
        try:
            correspondence.check(localization, robot.model)
            _check_arc(scenario, robot)
            kinds = {name: sensor_kind(name, sensor) for name, sensor in robot.sensors.items()}
            if relative:
                check_altitude(kinds)
            if relative or names:
                check_leader(kinds, what)
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: robots.{robot.id}: {error}") from None
        for name, sensor in cameras.items():
            if sensor.anonymous:
                _check_anonymous(f"{where}.sensors.{name}.anonymous", localization.kind, correspondence.kind)
            if (relative or names) and any(mount_of(sensor.mount)[:3]):
                raise ConfigError(
                    f"{where}.sensors.{name}.mount: {what} takes a camera to sit at the body's origin; state angles "
                    "only"
                )
        fleet += [robot.id] * (relative or names)
        naming += [names] * (localization.kind == "clat")
        leaders += (relative or names) and bool(cameras)
    if any(naming) and not all(naming):
        raise ConfigError(
            f"{scenario.name}: correspondence.kind is 'gaussian_sum' for some robots of localization.kind = 'clat' "
            "only: who does not tell how it moves is nowhere for the cameras of the others; give all robots one kind"
        )
    what = "correspondence.kind = 'gaussian_sum'" if any(naming) else "localization.kind = 'relative'"
    if fleet and not leaders:
        raise ConfigError(
            f"{scenario.name}: {what} needs a robot with a camera; give one a sensor of kind 'bearing3' of peers, and "
            "a 'range'"
        )
    if len(fleet) > MAX_RELATIVE + 1:
        raise ConfigError(
            f"{scenario.name}: {what} takes {MAX_RELATIVE + 1} robots at most, there are {len(fleet)}; take fewer"
        )


def _check_anonymous(where: str, localization: str, correspondence: str) -> None:
    """A camera that does not tell whom it sees is of use to those who find out. Robots of the kind `clat` may be told
    in a simulated world, to compare."""
    if localization == "clat" or (localization == "relative" and correspondence != "known"):
        return
    relative = localization == "relative"
    key, value = ("correspondence.kind", correspondence) if relative else ("localization.kind", localization)
    remedy = "correspondence.kind = 'gaussian_sum'" if relative else "localization.kind = 'relative'"
    raise ConfigError(
        f"{where}: a camera that does not tell whom it sees is of no use to {key} = '{value}'; take {remedy}, or leave "
        "it out"
    )


def _check_camera(where: str, sensor: SensorPart) -> None:
    if sensor.anonymous and sensor.of != ["peers"]:
        raise ConfigError(f'{where}.anonymous is of a camera that sees other robots only; state of = ["peers"]')
    if sensor.clutter > 0.0 and not sensor.anonymous:
        raise ConfigError(
            f"{where}.clutter is of a camera that does not tell whom it sees; set anonymous = true, or take false_share"
        )


def _check_arc(scenario: Scenario, robot: RobotPart) -> None:
    """A course in space is of a simulated robot that nothing else drives."""
    if robot.arc is None:
        return
    robot.arc.check()
    if robot.model != "planar_altitude" or scenario.world.kind != "simulated":
        raise ConfigError("arc is of simulated robots of the model 'planar_altitude'; take that, or leave it out")
    if robot.control != ControlPart() or robot.noise != ControlNoisePart():
        raise ConfigError("control and noise are not used with arc; state odometry for what it reports")
    if scenario.planning_of(robot).kind != "none" or scenario.world.steering is not None:
        raise ConfigError("arc does not go with a planner or world.steering; leave it out")
    if robot.odometry is None:
        raise ConfigError("arc needs odometry: how far what it reports of the true motion is off")
    ids = [other.id for other in scenario.robots]
    if robot.arc.as_of is not None and robot.arc.as_of not in ids:
        raise ConfigError(f"arc.as_of = '{robot.arc.as_of}' is no robot; there are: {', '.join(ids)}")
