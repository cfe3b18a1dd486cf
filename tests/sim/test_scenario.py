"""Scenario files: bundled ones load, overrides land where they should, and wrong input gets one helpful line."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest

from agent.config_file import ConfigError
from sim.scenario import Scenario
from sim.scenario_file import apply_override, bundled, load, locate


def complaint(*overrides: str, name: str = "ut-clat") -> str:
    """The one line a user gets."""
    with pytest.raises(ConfigError) as caught:
        load(name, list(overrides))
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert line.strip() == line != ""
    return line


def robot(scenario: Scenario, name: str) -> Any:
    return next(part for part in scenario.robots if part.id == name)


# --- what is there ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", bundled())
def test_every_bundled_scenario_loads(name: str) -> None:
    scenario = load(name, ["world.path=/somewhere"] if name.startswith(("utias", "tiers", "drone")) else [])
    assert scenario.name == name
    assert scenario.window_s[1] <= scenario.duration_s


def test_the_bundled_names() -> None:
    assert {"demo", "ut-clat", "utias-all", "utias-anchor"} <= set(bundled())


def test_a_scenario_is_found_by_path_too(tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    copy.write_bytes(locate("ut-clat").read_bytes())
    assert load(str(copy)) == load("ut-clat")


# --- overrides --------------------------------------------------------------------------------------------


def test_an_override_goes_to_one_robot_by_its_id() -> None:
    scenario = load("ut-clat", ["robots.r2.sensors.range.sigma_m=0.2"])
    assert robot(scenario, "r2").sensors["range"].sigma_m == 0.2
    assert robot(scenario, "r3").sensors["range"].sigma_m == 0.05


def test_a_star_means_every_robot() -> None:
    scenario = load("ut-clat", ["robots.*.sensors.range.sigma_m=0.2"])
    assert [part.sensors["range"].sigma_m for part in scenario.robots] == [0.2] * 4


def test_later_overrides_win() -> None:
    assert load("ut-clat", ["links.loss=0.1", "links.loss=0.3"]).links.loss == 0.3


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("3", 3),
        ("0.5", 0.5),
        ("[1, 2]", [1, 2]),
        ('"a"', "a"),
        ("a", "a"),
        ("true", True),
        (" a = b ", "a = b"),
        ("", ""),
    ],
)
def test_values_are_toml_and_anything_else_is_a_string(text: str, value: Any) -> None:
    data: dict[str, Any] = {}
    apply_override(data, f"part.key={text}")
    assert data == {"part": {"key": value}}


def test_a_robot_may_localize_in_its_own_way() -> None:
    scenario = load("ut-clat", ["robots.r2.localization.form=published", "localization.pair_timeout_s=7"])
    assert scenario.localization_of(robot(scenario, "r2")).form == "published"
    assert scenario.localization_of(robot(scenario, "r2")).pair_timeout_s == 7.0
    assert scenario.localization_of(robot(scenario, "r1")).form == "auto"
    assert scenario.localization_of(robot(scenario, "r2")).settings().pair_interval_ns == 0


def test_lateness_and_tracking_have_overrides_per_robot_too() -> None:
    scenario = load("ut-clat", ["robots.r3.lateness.kind=discard", "robots.r3.tracking.kind=none"])
    assert scenario.lateness_of(robot(scenario, "r3")).kind == "discard"
    assert scenario.lateness_of(robot(scenario, "r3")).horizon_s == 10.0
    assert scenario.tracking_of(robot(scenario, "r3")).kind == "none"
    assert scenario.tracking_of(robot(scenario, "r1")).kind == "clat"


# --- wrong input: the line names the key and the remedy ---------------------------------------------------

MISTAKES: list[tuple[str, list[str]]] = [
    ("links.los=0.3", ["'links.los'", "did you mean 'loss'"]),
    ("robots.r2.sensors.range.sigma_cm=5", ["'robots.r2.sensors.range.sigma_cm'", "did you mean 'sigma_m'"]),
    ("robots.r1.start.circle.radius=5", ["'robots.r1.start.circle.radius'", "did you mean 'radius_m'"]),
    ("world.placement.contact=5", ["'world.placement.contact'", "did you mean 'contact_range_m'"]),
    ("localisation.kind=clat", ["'localisation'", "did you mean 'localization'"]),
    ("zzzzzz=1", ["'zzzzzz'", "valid keys: ", "duration_s"]),
    ("robots.r2.localization.frm=safe", ["robots.r2.localization", "'frm'", "did you mean 'form'"]),
    ("robots.r2.localization.form=bad", ["robots.r2.localization", "'form' = 'bad'", "'published' or 'joint'"]),
    ("localization={form='joint',correlation='ignored'}", ["'ignored'", "add form = 'published' or 'safe'"]),
    ("localization={form='split_joint',correlation='ignored'}", ["'ignored'", "add form ="]),
    ("robots.r2.start_source=fix", ["robots.r2.start_source = 'fix'", "a position fix", "nor a heading fix"]),
    ("robots.r2.start_source=peer", ["robots.r2.start_source = 'peer'", "or a sensor of peers (bearing"]),
    ("links.loss=abc", ["'links.loss' = 'abc'", "number"]),
    ("links.loss=true", ["'links.loss' = True", "number"]),
    ("links.loss=1.5", ["'links.loss' = 1.5", "less than or equal to 1"]),
    ("links=3", ["'links' = 3", "a table is needed"]),
    ("links.delay_s=-0.1", ["'links.delay_s' = -0.1", "greater than or equal to 0"]),
    ("robots.r4.sensors.range.sigma_m=-1", ["'robots.r4.sensors.range.sigma_m' = -1", "greater than 0"]),
    ("step_s=nan", ["'step_s' = nan"]),
    ("step_s=inf", ["'step_s' = inf", "finite"]),
    ("step_s=1e-9", ["step_s = 1e-09", "enlarge"]),
    ("step_s=1000", ["duration_s = 800", "at least step_s = 1000"]),
    ("version=2", ["'version' = 2", "1"]),
    ("robots=[]", ["'robots'", "at least 1"]),
    ('robots.r1.id="Robot 1"', ["id' = 'Robot 1'", "pattern"]),
    ("robots.r2.id=r1", ["'r1' is used twice", "must differ"]),
    ("targets.t1.id=r1", ["'r1' is used twice", "must differ"]),
    ("landmarks=[{id='A',position=[0,0]},{id='A',position=[0,1]}]", ["'A' is used twice", "must differ"]),
    ("window_s=[900, 1000]", ["window_s starts at 900 s", "--set 'window_s=[0, 800]'"]),
    ("window_s=[5, 1]", ["window_s must be [from, to]"]),
    ("window_s=[-1, 5]", ["window_s must be [from, to]"]),
    ("window_s=[1]", ["'window_s'", "at least 2"]),
    ("robots.r9.id=r5", ["--set robots.r9.id=r5", "no 'r9' in robots", "r1, r2, r3, r4"]),
    ("robots.r2=1", ["--set robots.r2=1", "name a key of robots.r2"]),
    ("name.x=3", ["--set name.x=3", "'name' is a value"]),
    ("links.loss", ["--set links.loss", "KEY=VALUE"]),
    ("=3", ["--set =3", "KEY=VALUE"]),
    ("robots.r1.start.pose=[1,2,3]", ["robots.r1.start", "'pose' or 'circle'"]),
    ("targets.t1.start.pose=[1,2]", ["'targets.t1.start.pose'", "at least 3"]),
    ("targets.t1.model=constant_velocity", ["targets.t1.start_sigma.velocity_mps is missing", "'constant_velocity'"]),
    ("robots.r2.sensors.range.of=[]", ["robots.r2.sensors.range", 'of = ["peers"]']),
    ('robots.r2.sensors.range.of=["friends"]', ["robots.r2.sensors.range.of", "'friends'", "'peers'"]),
    ("robots.r2.sensors.eye={of=['peers']}", ["robots.r2.sensors.eye", "state its kind", "range_bearing"]),
    ("robots.r2.sensors.eye={kind='range_bearing',of=['peers'],sigma_m=1.0}", ["sensors.eye", "sigma_rad is missing"]),
    ("robots.r2.sensors.eye={kind='range',of=['peers']}", ["sensors.eye", "sigma_m is missing"]),
    ("robots.r2.sensors.eye={kind='pixel',of=['targets']}", ["sensors.eye", "sigma_px is missing"]),
    ("robots.r2.sensors.baro={kind='altitude'}", ["sensors.baro", "sigma_z_m is missing"]),
    ("robots.r2.sensors.range.mount=[1,2]", ["robots.r2.sensors.range.mount", "x, y, yaw or x, y, z"]),
    ("robots.r2.model=planar_altitude", ["robots.r2.start_sigma.altitude_m is missing", "'planar_altitude'"]),
    (
        "targets=[{id='t1',model='quadrotor',start_sigma={position_m=1.0,altitude_m=1.0,heading_rad=1.0}}]",
        ["targets.t1.noise", "altitude_m above 0"],
    ),
    ("robots.r1.autopilot.mode=OFFBOARD", ["robots.r1.autopilot.mode: 'OFFBOARD'", "GUIDED"]),
    ("robots.r1.autopilot={flavour='px4',mode='GUIDED'}", ["robots.r1.autopilot.mode: 'GUIDED'", "OFFBOARD"]),
    ("links={nearest=2,rewire=2}", ["links.nearest and links.rewire", "state one, as links = { rewire = 2 }"]),
    ("links.nearest=0", ["'links.nearest' = 0", "greater than or equal to 1"]),
    ("robots.r2.sensors.range.noise=isotropic", ["sensors.range.noise", "bearing3", "leave it out"]),
    ("robots.r2.sensors.range.false_share=0.1", ["sensors.range.false_share", "bearing3", "leave it out"]),
    ("robots.r1.sensors.pose.detects=0.5", ["sensors.pose.detects", "not of 'pose'"]),
    ("targets.t1.course={kind='circle'}", ["targets.t1.course", "'unicycle'", "take 'constant_velocity_3d'"]),
    ("world.placement.reaches=r9", ["world.placement.reaches = 'r9'", "r1, r2, r3, r4"]),
    ('world={kind="recording"}', ["world.path is missing", "--set world.path="]),
    ('world={kind="simulated"}', ["robots.r1.start.circle", "[world.placement]"]),
]


TEAM_MISTAKES: list[tuple[list[str], list[str]]] = [
    (["localization.form=safe"], ["form = 'safe' is of kind 'clat'", "leave form out"]),
    (["localization.correlation=ignored"], ["correlation = 'ignored'", "leave correlation out"]),
    (["localization.pair_interval_s=1"], ["pair_interval_s = 1.0", "leave pair_interval_s out"]),
    (["robots.r3.localization.kind=clat"], ["robots.r3.localization.kind = 'clat'", "give all robots one kind"]),
]


@pytest.mark.parametrize(("overrides", "words"), TEAM_MISTAKES, ids=[words[0] for _, words in TEAM_MISTAKES])
def test_what_does_not_go_with_a_replica_is_refused(overrides: list[str], words: list[str]) -> None:
    line = complaint("localization.kind=replica", *overrides)
    for word in words:
        assert word in line


def test_a_team_too_large_for_a_joint_belief_is_refused(tmp_path: Path) -> None:
    source = locate("dense-10").read_text()
    first = source[source.index("[[robots]]") : source.index("[[robots]]", source.index("[[robots]]") + 1)]
    more = "".join(first.replace('"r01"', f'"x{k}"') for k in range(7))
    (tmp_path / "crowd.toml").write_text(source + more)
    crowd = str(tmp_path / "crowd.toml")
    assert len(load(crowd, []).robots) == 17
    line = complaint("localization.kind=replica", name=crowd)
    assert "16 robots at most, there are 17; take 'clat'" in line


@pytest.mark.parametrize(("override", "words"), MISTAKES, ids=[override for override, _ in MISTAKES])
def test_a_mistake_is_answered_with_the_key_and_the_remedy(override: str, words: list[str]) -> None:
    line = complaint(override)
    for word in words:
        assert word in line


def test_the_joint_form_has_the_same_tracks_all_the_time() -> None:
    joint = "localization.form=joint"
    for override in ("targets.t1.prior=false", "tracking.end_above_m=5.0", "robots.r1.start_source=fix"):
        with pytest.raises(ConfigError, match="form = 'joint'"):
            load("ut-clat", [joint, override])
    load("ut-clat", [joint, "targets.t1.prior=false", "tracking.kind=none"])
    load("ut-clat", ["targets.t1.prior=false", "tracking.end_above_m=5.0", "robots.r1.start_source=fix"])


def test_an_unknown_scenario_is_answered_with_the_nearest_name() -> None:
    assert "did you mean 'ut-clat'?" in complaint(name="ut_clat")
    assert "bundled: ajlatt, ajlatt-ablation, ajlatt-c," in complaint(name="zzz")


def test_a_recording_needs_its_path_and_has_no_more_than_it_holds() -> None:
    assert "world.path" in complaint(name="utias-all")
    path = "world.path=/somewhere"
    target = 'targets=[{id="t1",start={pose=[0,0,0]},start_sigma={position_m=1.0,heading_rad=1.0}}]'
    assert "targets.t1.recorded = true is needed" in complaint(path, target, name="utias-all")
    recorded = target.replace('"t1",', '"t1",recorded=true,')
    assert "nobody knows of" in complaint(path, recorded, name="utias-all")
    assert "recorded = false is needed in a simulated world" in complaint(recorded)
    moving = recorded.replace("{position_m=1.0,heading_rad=1.0}", "{position_m=1.0,velocity_mps=1.0}")
    moving = moving.replace("recorded=true,", "recorded=true,model='constant_velocity',course={kind='circle'},")
    assert "targets.t1.course does not go with a recording" in complaint(path, moving, name="utias-all")
    missing = "robots.*.sensors.mates.detects=0.5"
    assert "sensors.mates.detects does not go with a recording" in complaint(path, missing, name="utias-all")


def test_a_file_that_is_not_there_not_a_file_or_not_toml(tmp_path: Path) -> None:
    assert complaint(name=str(tmp_path / "gone.toml")).endswith("gone.toml: no such file")
    assert "a TOML file is needed" in complaint(name=str(tmp_path))
    broken = tmp_path / "broken.toml"
    broken.write_text("name = \n")
    assert "not valid TOML" in complaint(name=str(broken))
    broken.write_bytes(b"\xff\xfe")
    assert "cannot be read" in complaint(name=str(broken))


def test_a_key_that_is_missing_is_named(tmp_path: Path) -> None:
    text = locate("ut-clat").read_text()
    short = tmp_path / "short.toml"
    short.write_text(text.replace("duration_s = 800.0", ""))
    assert "key 'duration_s' is missing" in complaint(name=str(short))
    short.write_text(text.replace(", radius_m = 8.0", "", 1))
    assert "key 'robots.r1.start.circle.radius_m' is missing" in complaint(name=str(short))


def test_a_name_with_a_line_break_still_gives_one_line(tmp_path: Path) -> None:
    odd = tmp_path / "odd.toml"
    odd.write_text('"a\\nb" = 1\n' + locate("ut-clat").read_text())
    assert "unknown key 'a b'" in complaint(name=str(odd))


def test_the_normative_example_states_what_the_defaults_are() -> None:
    """Keys of the commented example that repeat a default must not drift from it."""
    data = tomllib.loads(locate("ut-clat").read_text())
    defaults = Scenario.model_fields
    assert data["lost_above_m"] == defaults["lost_above_m"].default
    assert data["origin"] == defaults["origin"].default
    localization = defaults["localization"].default
    for key in ("kind", "form", "correlation", "pair_timeout_s"):
        assert data["localization"][key] == getattr(localization, key)
    assert data["localization"]["transform"] == localization.settings().transform
    assert math.isclose(data["robots"][0]["start_sigma"]["heading_rad"], math.radians(2.0), rel_tol=1e-6)


def test_a_part_of_the_robots_may_take_part() -> None:
    few = load("ut-clat", ["world.robots=['r1', 'r3']"])
    assert [robot.id for robot in few.robots] == ["r1", "r3"]
    assert "no robot 'r9'; there are: r1, r2" in complaint("world.robots=['r1', 'r9']")
    assert "no robot ''" in complaint("world.robots=[]")
