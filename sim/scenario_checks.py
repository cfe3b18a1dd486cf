"""What no single key of a scenario can tell."""

from __future__ import annotations

from agent.config_file import (
    ConfigError,
)
from agent.config_parts import MAX_TEAM
from agent.estimation.motion import LAYOUTS
from agent.estimation.mounting import mount_of
from agent.estimation.observation import RELATIVE_ANGLES
from agent.fault_parts import AnyFaultPart, SensorDelayPart, SensorFaultPart, check_faults, named
from agent.joint_room import check_room
from agent.leader_parts import check_lateness
from agent.motion_parts import ControlPart
from agent.start_config import check_start
from sim.relative_checks import check_relative
from sim.scenario import (
    KINDS,
    MIN_STEP_S,
    SPATIAL_FORMATS,
    RobotPart,
    Scenario,
    SensorPart,
    TargetPart,
    sensor_kind,
    target_sensor,
)
from sim.vehicle_telemetry import VEHICLES, StandInSettings


def check(scenario: Scenario) -> None:
    """What no single key can tell. Raises `ConfigError`."""
    ids = [robot.id for robot in scenario.robots] + [target.id for target in scenario.targets]
    for name in ids:
        if ids.count(name) > 1:
            raise ConfigError(f"{scenario.name}: id '{name}' is used twice; ids must differ")
    names = [landmark.id for landmark in scenario.landmarks]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{scenario.name}: landmark id '{name}' is used twice; ids must differ")
    if scenario.step_s < MIN_STEP_S:
        raise ConfigError(f"{scenario.name}: step_s = {scenario.step_s:g} is below {MIN_STEP_S:g} s; enlarge it")
    if scenario.duration_s < scenario.step_s:
        raise ConfigError(
            f"{scenario.name}: duration_s = {scenario.duration_s:g} is shorter than one step; "
            f"make it at least step_s = {scenario.step_s:g}"
        )
    if not 0.0 <= scenario.window_s[0] < scenario.window_s[1]:
        raise ConfigError(f"{scenario.name}: window_s must be [from, to] with from < to")
    if scenario.window_s[0] >= scenario.duration_s:
        raise ConfigError(
            f"{scenario.name}: window_s starts at {scenario.window_s[0]:g} s, after the run's end at "
            f"{scenario.duration_s:g} s; shorten it with --set 'window_s=[0, {scenario.duration_s:g}]'"
        )
    recorded = scenario.world.kind == "recording"
    spatial = recorded and scenario.world.format in SPATIAL_FORMATS
    if recorded and scenario.world.path is None:
        raise ConfigError(f"{scenario.name}: world.path is missing; add --set world.path=FOLDER of the recording")
    placement = scenario.world.placement
    circling = [robot.id for robot in scenario.robots if robot.start.circle is not None]
    if placement is not None and placement.rule == "apart":
        if placement.apart_m is None:
            raise ConfigError(f"{scenario.name}: world.placement.apart_m is missing: rule = 'apart' needs it")
    elif placement is not None and (placement.contact_range_m is None or placement.reaches is None):
        key = "contact_range_m" if placement.contact_range_m is None else "reaches"
        raise ConfigError(f"{scenario.name}: world.placement.{key} is missing: rule = 'random_phases' needs it")
    elif placement is not None and placement.apart_m is not None:
        raise ConfigError(f"{scenario.name}: world.placement.apart_m is of rule = 'apart'; take that, or leave it out")
    elif placement is not None and circling and placement.reaches not in circling:
        raise ConfigError(
            f"{scenario.name}: world.placement.reaches = '{placement.reaches}' is no robot on a circle; "
            f"there are: {', '.join(circling)}"
        )
    try:
        scenario.links.settings(0)
    except ConfigError as error:
        raise ConfigError(f"{scenario.name}: {error}") from None
    _check_steering(scenario)
    _check_planning(scenario)
    _check_team(scenario)
    check_relative(scenario)
    check_schedule(scenario, scenario.faults)
    for robot in scenario.robots:
        _check_mover(f"{scenario.name}: robots.{robot.id}", robot)
        _check_autopilot(f"{scenario.name}: robots.{robot.id}", robot)
        if recorded and (LAYOUTS[robot.model].altitude is not None) != spatial:
            has, kind, other = ("no", "in space", "planar_altitude") if spatial else ("an", "planar", "unicycle")
            raise ConfigError(
                f"{scenario.name}: robots.{robot.id}.model = '{robot.model}' has {has} altitude, and recordings of "
                f"format '{scenario.world.format}' are {kind}; take '{other}'"
            )
        try:
            scenario.health.settings(scenario.localization_of(robot).form)
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: {error}") from None
        localization, tracking = scenario.localization_of(robot), scenario.tracking_of(robot)
        try:
            localization.settings()
            check_lateness(scenario.lateness_of(robot), localization, robot.model)
            tracking.check_kind(localization, [target.id for target in scenario.targets if not target.prior])
            tracking.check_targets([(target.id, target.model) for target in scenario.targets])
            if localization.form == "joint":
                followed = scenario.targets if tracking.kind != "none" else []
                check_room(LAYOUTS[robot.model], [(target.id, LAYOUTS[target.model]) for target in followed])
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: localization: {error}") from None
        try:
            kinds = {sensor_kind(name, sensor) for name, sensor in robot.sensors.items()}
            check_start(robot.start_source, localization, robot.motion(), kinds, ())
        except ConfigError as error:
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start_{error}") from None
        if not recorded and (robot.start.pose is None) == (robot.start.circle is None):
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start needs either 'pose' or 'circle'")
        _check_driven(f"{scenario.name}: robots.{robot.id}", robot, recorded or scenario.world.steering is not None)
        if robot.start.circle is not None and scenario.world.placement is None:
            raise ConfigError(f"{scenario.name}: robots.{robot.id}.start.circle needs a [world.placement]")
        for name, sensor in robot.sensors.items():
            where = f"{scenario.name}: robots.{robot.id}.sensors.{name}"
            check_sensor(where, name, sensor)
            if recorded:
                _check_recorded(where, sensor)
    for target in scenario.targets:
        _check_mover(f"{scenario.name}: targets.{target.id}", target)
        if target.recorded != recorded:
            raise ConfigError(
                f"{scenario.name}: targets.{target.id}.recorded = {str(recorded).lower()} is needed in a "
                f"{scenario.world.kind} world"
            )
        layout, axes = LAYOUTS[target.model], 3 if spatial else 2
        if recorded and (layout.heading is not None or len(layout.position) != axes or layout.dim != 2 * axes):
            suffix = "_3d" if spatial else ""
            raise ConfigError(
                f"{scenario.name}: targets.{target.id}.model = '{target.model}' needs what nobody knows of a "
                f"recorded target; take 'damped_velocity{suffix}' or 'constant_velocity{suffix}'"
            )
        if not recorded and target.start.pose is None:
            raise ConfigError(f"{scenario.name}: targets.{target.id}.start.pose is missing")
        _check_course(f"{scenario.name}: targets.{target.id}", target)


def _check_autopilot(where: str, robot: RobotPart) -> None:
    vehicle_type = VEHICLES[LAYOUTS[robot.model].altitude is not None]
    try:
        StandInSettings(flavour=robot.autopilot.flavour, vehicle_type=vehicle_type, mode=robot.autopilot.mode)
    except ValueError as error:
        raise ConfigError(f"{where}.autopilot.{error}") from None


def check_schedule(scenario: Scenario, faults: list[AnyFaultPart]) -> None:
    """Faults are of robots and sensors that are there, and begin before the end. Raises `ConfigError`."""
    robots = {robot.id: robot for robot in scenario.robots}
    try:
        check_faults(faults, robots)
    except ConfigError as error:
        raise ConfigError(f"{scenario.name}: {error}") from None
    for name, fault in named(faults).items():
        where = f"{scenario.name}: faults.{name}"
        if isinstance(fault, SensorFaultPart) and fault.sensor is not None:
            there = sorted(robots[fault.robot].sensors)
            if fault.sensor not in there:
                raise ConfigError(f"{where}: {fault.robot} has no sensor '{fault.sensor}'; it has: {', '.join(there)}")
        if isinstance(fault, SensorDelayPart) and not fault.delay_s + fault.tail_s > 0.0:
            raise ConfigError(f"{where}: nothing is late by it; state delay_s, tail_s or both")
        if fault.at_s >= scenario.duration_s:
            raise ConfigError(f"{where}: at_s = {fault.at_s:g} is after the run's end at {scenario.duration_s:g} s")


def _check_team(scenario: Scenario) -> None:
    """All robots of a fleet tell each other raw data, or rounds, or neither; who tell raw data are few."""
    kinds = {robot.id: scenario.localization_of(robot).kind for robot in scenario.robots}
    for kind, why in UNMIXED.items():
        other = next((name for name, own in kinds.items() if own != kind), None)
        if kind in kinds.values() and other is not None:
            raise ConfigError(
                f"{scenario.name}: robots.{other}.localization.kind = '{kinds[other]}' beside '{kind}': {why}; "
                "give all robots one kind"
            )
    for robot in scenario.robots:
        leader = scenario.localization_of(robot).leader
        if kinds[robot.id] == "leader" and leader is not None and kinds.get(leader) != "leader":
            there = f"is of kind '{kinds[leader]}', and answers nobody" if leader in kinds else "is not there"
            raise ConfigError(
                f"{scenario.name}: robots.{robot.id}.localization.leader = '{leader}' {there}; take a robot of "
                "kind 'leader'"
            )
    tracked = {scenario.tracking_of(robot).kind for robot in scenario.robots} - {"none"}
    if len(tracked) > 1:
        raise ConfigError(
            f"{scenario.name}: tracking.kind is {' and '.join(map(repr, sorted(tracked)))}: robots do not understand "
            "what another kind tells; give all robots one kind, or 'none'"
        )
    if "replica" in kinds.values() and len(kinds) > MAX_TEAM + 1:
        raise ConfigError(
            f"{scenario.name}: localization.kind = 'replica' takes {MAX_TEAM + 1} robots at most, there are "
            f"{len(kinds)}; take 'clat'"
        )


UNMIXED = {
    "replica": "who does not tell its raw data is nowhere in the belief of the others",
    "jlatt": "who takes no part in rounds is not heard by those who do",
    "relative": "who does not tell how it moves is nowhere for the others",
}
"""Kinds that all robots of a fleet have, or none, and why."""


def _check_planning(scenario: Scenario) -> None:
    """Robots that choose their motion do so in a simulated world, and are not driven by anything else."""
    source = ""
    try:
        scenario.round.settings()
        for robot in scenario.robots:
            planning, source = scenario.planning_of(robot), ""
            if planning.radio_range_m is None and scenario.links.range_m is not None:
                planning = planning.model_copy(update={"radio_range_m": scenario.links.range_m})
                source = "; planning.radio_range_m is not stated, which is links.range_m then"
            planning.settings()
            planning.check_model(robot.model, [(target.id, target.model) for target in scenario.targets])
            if planning.kind == "encircle" and not robot.vehicle.flies:
                raise ConfigError(
                    f"robots.{robot.id}: planning.kind = 'encircle' is of vehicles that fly; set vehicle.flies = true"
                )
    except ConfigError as error:
        raise ConfigError(f"{scenario.name}: {error}{source}") from None
    for robot in scenario.robots:
        vehicle, where = robot.vehicle, f"{scenario.name}: robots.{robot.id}"
        if vehicle.min_speed_mps > vehicle.max_speed_mps:
            raise ConfigError(
                f"{where}.vehicle.min_speed_mps = {vehicle.min_speed_mps:g} is above max_speed_mps = "
                f"{vehicle.max_speed_mps:g}; lower it"
            )
        if vehicle.flies and robot.model != "planar_altitude":
            raise ConfigError(f"{where}.vehicle.flies needs model = 'planar_altitude', not '{robot.model}'; change one")
        if vehicle.max_climb_mps is not None and not vehicle.flies:
            raise ConfigError(f"{where}.vehicle.max_climb_mps is of a vehicle that flies; set vehicle.flies = true")
        if vehicle.flies and (vehicle.min_speed_mps != 0.0 or vehicle.turns != "along"):
            raise ConfigError(
                f"{where}.vehicle: one that flies stands still in the air and turns as it likes; leave min_speed_mps "
                "and turns out"
            )
    for robot in scenario.planners():
        where, kind = f"{scenario.name}: robots.{robot.id}", scenario.planning_of(robot).kind
        if scenario.world.kind == "recording":
            raise ConfigError(
                f"{where}: planning.kind = '{kind}' does not go with a recording, whose robots have moved already; "
                "take planning.kind = 'none'"
            )
        if scenario.world.steering is not None:
            raise ConfigError(
                f"{where}: planning.kind = '{kind}' does not go with world.steering, which steers all robots on their "
                "true places; leave one of them out"
            )
        if robot.control.speed_mps or robot.control.yaw_rate_radps:
            raise ConfigError(f"{where}.control is not used with planning.kind = '{kind}'; leave it out")
        if kind == "optimal" and scenario.planning_of(robot).sensing is None and target_sensor(robot) is None:
            raise ConfigError(
                f"{where}: planning.kind = 'optimal' predicts what is seen, and no sensor of kind 'range_bearing' "
                "sees targets; add one, or state planning.sensing"
            )


def _check_steering(scenario: Scenario) -> None:
    """Steered robots move in the plane around a target, and by nothing else."""
    if scenario.world.steering is None:
        return
    where = f"{scenario.name}: world.steering"
    if scenario.world.kind == "recording":
        raise ConfigError(f"{where} does not go with a recording; leave it out")
    if not scenario.targets:
        raise ConfigError(f"{where} needs one of [[targets]] to keep around")
    for robot in scenario.robots:
        if robot.model != "unicycle":
            raise ConfigError(f"{where}: robots.{robot.id}.model = '{robot.model}' is not steered; take 'unicycle'")
        if robot.control != ControlPart():
            raise ConfigError(f"{where}: robots.{robot.id}.control is not used with it; leave it out")


def _check_driven(where: str, robot: RobotPart, led: bool) -> None:
    """Who follows a course drives on the ground, and is moved by nothing else. Raises `ConfigError`."""
    if robot.course is None:
        return
    if led or robot.model != "unicycle" or robot.planning.get("kind", "none") != "none":
        raise ConfigError(f"{where}.course is of a 'unicycle' in a simulated world, moved by nothing else; leave it")
    if not robot.course.pieces:
        raise ConfigError(f"{where}.course.pieces is empty; state at least one, for instance {{ for_s = 5.0 }}")
    if robot.control.yaw_rate_radps:
        raise ConfigError(f"{where}.control.yaw_rate_radps is not used with a course; leave it out")


def _check_course(where: str, target: TargetPart) -> None:
    """A course is of a target that moves by its velocity, in a simulated world."""
    if target.course is None:
        return
    try:
        target.course.check(target.model, target.start.pose)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from None
    if target.recorded:
        raise ConfigError(f"{where}.course does not go with a recording, where it went its way already; leave it out")
    if target.course.kind == "wander" and target.start.spread:
        raise ConfigError(f"{where}.start.spread does not go with a course of kind 'wander'; leave it out")


def _check_recorded(where: str, sensor: SensorPart) -> None:
    """What a recorded sensor said is not made worse."""
    for key in ("noise", "detects", "false_share", "gimbal", "anonymous", "clutter"):
        if getattr(sensor, key) != getattr(SensorPart(), key):
            raise ConfigError(f"{where}.{key} does not go with a recording, which is as it is; leave it out")


def _check_mover(where: str, part: RobotPart | TargetPart) -> None:
    """Deviations of the start, altitude noise and size of the pose are those the model needs."""
    try:
        part.start_sigma.covariance(part.model, isinstance(part, RobotPart) or part.prior)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from None
    size = LAYOUTS[part.model].dim - 2 * (part.model == "unicycle_gains")
    if part.start.error is not None and len(part.start.error) != size:
        raise ConfigError(f"{where}.start.error has {len(part.start.error)} numbers, not the {size} of '{part.model}'")
    try:
        if isinstance(part, RobotPart):
            part.motion().settings()
        else:
            part.motion(1.0)
    except ConfigError as error:
        raise ConfigError(f"{where}.noise: {error}") from None


def check_sensor(where: str, name: str, sensor: SensorPart) -> None:
    """Raises `ConfigError` if the sensor lacks a kind, a subject or a standard deviation."""
    kind = sensor_kind(name, sensor)
    if kind not in KINDS:
        raise ConfigError(f"{where}: state its kind, one of {', '.join(KINDS)}")
    needs_m = kind in ("range", "range_bearing", "vector", "position", "pose")
    needs_rad = kind in ("bearing", "bearing3", "range_bearing", "pose", "heading")
    grows = sensor.sigma_m_per_m > 0.0 and sensor.min_range_m > 0.0 and kind in RELATIVE_ANGLES
    if needs_m and sensor.sigma_m is None and not grows:
        raise ConfigError(f"{where}: sigma_m is missing")
    if needs_rad and sensor.sigma_rad is None:
        raise ConfigError(f"{where}: sigma_rad is missing")
    if kind == "altitude" and sensor.sigma_m is None and sensor.sigma_z_m is None:
        raise ConfigError(f"{where}: sigma_z_m is missing")
    if kind == "pixel" and sensor.sigma_px is None:
        raise ConfigError(f"{where}: sigma_px is missing")
    if kind in RELATIVE_ANGLES and not sensor.of:
        raise ConfigError(f'{where}: of is missing, for instance of = ["peers"]')
    if sensor.gimbal and (sensor.fov_rad is None or sensor.of != ["targets"] or any(mount_of(sensor.mount)[3:])):
        raise ConfigError(
            f"{where}.gimbal is of a camera that turns to targets within its field of view; state fov_rad and "
            'of = ["targets"], and no angles in mount'
        )
    for key, kinds in (
        ("gimbal", ("bearing3",)),
        ("noise", ("bearing3",)),
        ("detects", tuple(RELATIVE_ANGLES)),
        ("false_share", ("bearing", "bearing3")),
        ("anonymous", ("bearing3",)),
        ("clutter", ("bearing3",)),
    ):
        if getattr(sensor, key) != getattr(SensorPart(), key) and kind not in kinds:
            raise ConfigError(f"{where}.{key} is of kind {' and '.join(kinds)}, not of '{kind}'; leave it out")
