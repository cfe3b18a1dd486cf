"""The part of files about who is who: what is refused, and what the core is given."""

from __future__ import annotations

import pytest

from agent.config_file import ConfigError
from agent.config_parts import LocalizationPart
from agent.relative_parts import AgentCorrespondencePart, CorrespondencePart, check_altitude, check_leader
from sim.agents import agent_config
from sim.scenario_file import load
from sim.trial import open_world

RELATIVE = LocalizationPart(kind="relative")
ANONYMOUS = "robots.l1.sensors.camera.anonymous"


def test_names_are_known_unless_said_otherwise() -> None:
    settings = AgentCorrespondencePart(peers=["p2", "p1"]).settings(["p2", "p1"], leads=True)
    assert settings.known and settings.leads and settings.peers == ("p1", "p2")
    assert settings.correspondence.kind == "gaussian_sum" and settings.correspondence.clutter == 0.0
    nearest = CorrespondencePart(kind="nearest", clutter=2.0).settings([], leads=False)
    assert not nearest.known and nearest.correspondence.kind == "nearest" and nearest.correspondence.clutter == 2.0


@pytest.mark.parametrize(
    ("part", "localization", "model", "words"),
    [
        (CorrespondencePart(kind="nearest"), LocalizationPart(), "unicycle", "needs localization.kind = 'relative'"),
        (CorrespondencePart(detection=0.5), LocalizationPart(), "unicycle", "correspondence.detection = 0.5"),
        (CorrespondencePart(), RELATIVE, "unicycle", "planar_altitude"),
        (CorrespondencePart(clutter=3.0), RELATIVE, "planar_altitude", "gaussian_sum"),
        (CorrespondencePart(kind="nearest", form="published"), RELATIVE, "planar_altitude", "leave it out"),
        (CorrespondencePart(kind="gaussian_sum"), LocalizationPart(), "unicycle", "planar_altitude"),
        (CorrespondencePart(kind="gaussian_sum", form="published"), LocalizationPart(), "planar_altitude", "leave it"),
        (CorrespondencePart(kind="gaussian_sum"), LocalizationPart(kind="jlatt"), "unicycle", "not 'jlatt'"),
        (CorrespondencePart(clutter=3.0), LocalizationPart(), "planar_altitude", "or correspondence.kind"),
    ],
)
def test_what_does_not_go_together_is_refused_with_a_remedy(
    part: CorrespondencePart, localization: LocalizationPart, model: str, words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        part.check(localization, model)


@pytest.mark.parametrize(
    ("peers", "kind", "words"),
    [
        (["p1"], "clat", "needs localization.kind"),
        ([], "relative", "is missing"),
        (["p1", "l1"], "relative", "this robot itself"),
        (["p1", "p1"], "relative", "twice"),
    ],
)
def test_the_others_are_named_once(peers: list[str], kind: str, words: str) -> None:
    part, localization = AgentCorrespondencePart(peers=peers), LocalizationPart(kind=kind)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=words):
        part.check_peers("l1", localization)


def test_who_finds_out_names_needs_the_others() -> None:
    with pytest.raises(ConfigError, match="'gaussian_sum' needs the ids"):
        AgentCorrespondencePart(kind="gaussian_sum").check_peers("r1", LocalizationPart())
    AgentCorrespondencePart(kind="gaussian_sum", peers=["r2"]).check_peers("r1", LocalizationPart())


def test_a_camera_needs_ranges_and_everybody_an_altitude() -> None:
    check_leader({"camera": "bearing3", "uwb": "range"})
    check_leader({"altitude": "altitude"})
    with pytest.raises(ConfigError, match="'range'"):
        check_leader({"camera": "bearing3"})
    check_altitude({}, ("altitude",))
    with pytest.raises(ConfigError, match="'altitude'"):
        check_altitude({"uwb": "range"})


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["correspondence.kind=known", "correspondence.clutter=1.0"], "correspondence.kind = 'known'; take"),
        (["localization.kind=fixed", "correspondence={}"], "localization.kind = 'fixed'"),
        (["localization.kind=fixed"], "needs localization.kind = 'relative'"),
        (["robots.p1.localization={kind=\"fixed\"}"], "give all robots one kind"),
        (["robots.l1.model=unicycle", "robots.l1.start.pose=[0, 0, 0]"], "planar_altitude"),
        (["robots.l1.sensors.camera.mount=[0.1, 0, 0]"], "body's origin"),
        (["robots.l1.sensors.camera.of=[\"targets\"]"], "sees other robots only"),
        (["robots.l1.sensors.range.anonymous=true"], "anonymous is of kind bearing3"),
        ([f"{ANONYMOUS}=false"], "clutter is of a camera"),
        (["robots.p1.sensors={}"], "'altitude'"),
        (["robots.p1.control.speed_mps=1.0"], "not used with arc"),
        (["robots.p1.arc.as_of=p9"], "is no robot"),
        (["world.placement.rule=random_phases"], "contact_range_m is missing"),
        (["world.placement={rule=\"apart\"}"], "apart_m is missing"),
        (["correspondence.kind=other"], "correspondence.kind"),
    ],
)
def test_a_scenario_says_what_is_wrong_with_it(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load("correspondence", overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["robots.r2.correspondence.kind=known"], "give all robots one kind"),
        (["correspondence.kind=nearest"], "needs localization.kind = 'relative'"),
        (["correspondence.form=published"], "leave it out"),
        (["correspondence.kind=known", "correspondence.clutter=2.0"], "correspondence.kind = 'gaussian_sum'"),
        (["robots.r2.sensors.camera.mount=[0.1, 0, 0]"], "gaussian_sum' takes a camera to sit at the body's origin"),
        (["robots.r2.sensors.range={kind=\"altitude\", of=[]}"], "gaussian_sum': a robot with a camera"),
        (["localization.kind=replica", "correspondence.kind=known"], "is of no use to localization.kind = 'replica'"),
    ],
)
def test_a_fleet_that_finds_out_names_says_what_is_wrong(overrides: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load("anonymous-clat", overrides)


def test_a_fleet_of_contacts_is_told_whom_to_tell_apart() -> None:
    scenario = load("anonymous-clat", ["duration_s=1", "window_s=[0, 1]"])
    settings = agent_config(scenario, open_world(scenario, 1), scenario.robots[0]).settings(0)
    assert settings.relative.leads and settings.relative.peers == ("r2", "r3", "r4") and not settings.relative.known
    named = load("anonymous-clat", ["duration_s=1", "window_s=[0, 1]", "correspondence.kind=known"])
    assert agent_config(named, open_world(named, 1), named.robots[0]).settings(0).relative.peers == ()


def test_each_robot_is_told_of_all_others() -> None:
    scenario = load("correspondence", ["duration_s=1", "window_s=[0, 1]", "robots.l2.correspondence={detection=0.5}"])
    world = open_world(scenario, 1)
    leader, pod = (agent_config(scenario, world, scenario.robots[index]).settings(0) for index in (1, 2))
    assert leader.relative.leads and leader.relative.peers == ("l1", "p1", "p2", "p3")
    assert leader.relative.correspondence.detection == 0.5
    assert not pod.relative.leads and pod.relative.peers == ("l1", "l2", "p2", "p3")
