"""One robot's file: read strictly, and every mistake gets one line with the key and the remedy."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from agent.config import AgentConfig, MavlinkPart, load_agent_config
from agent.config_file import ConfigError, validate
from agent.config_parts import LocalizationPart, SigmaPart
from agent.estimation.motion import SPATIAL, HeldAltitude, SpatialMotion
from agent.estimation.mounting import planar_mount
from agent.estimation.observation import Intrinsics
from agent.motion_parts import ControlNoisePart, ControlPart, OdometryPart
from agent.settings import AgentSettings, CoastSettings, UnsafeSettings
from agent.steering_link import SteeringSettings
from agent.target_parts import target_motion
from agent.unsafe_parts import UnsafePart


def example(**change: Any) -> dict[str, Any]:
    """A complete file of one robot."""
    return {
        "version": 1,
        "identity": {"fleet": "test", "robot": "r1", "incarnation": 1},
        "origin": [47.4, 8.5, 488.0],
        "initial": {"mean": [1.0, 2.0, 0.5], "start_sigma": {"position_m": 0.5, "heading_rad": 0.1}},
        "sensors": {
            "uwb": {"kind": "range", "mount": [0.1, 0.0, 0.0]},
            "camera": {"kind": "range", "two_way": False},
        },
        "targets": [
            {
                "id": "t1",
                "model": "constant_velocity",
                "mean": [0.0, 0.0, 1.0, 1.0],
                "start_sigma": {"position_m": 1.0, "velocity_mps": 0.5},
                "noise": {"acceleration_mps2": 0.2},
            }
        ],
        "landmarks": [{"id": "L3", "position": [4.0, 5.0]}],
        "zenoh": {"listen": ["udp/127.0.0.1:20001"], "peers": [{"id": "r2", "endpoints": ["udp/127.0.0.1:20002"]}]},
        "mavlink": {"endpoint": "udpin:127.0.0.1:14550", "simulated": True},
        "state_dir": "state",
    } | change


def write(folder: Path, data: dict[str, Any]) -> Path:
    path = folder / "r1.toml"
    path.write_text(tomli_w.dumps(data))
    return path


def complaint(folder: Path, data: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        load_agent_config(write(folder, data))
    line = str(caught.value)
    assert len(line.splitlines()) == 1
    assert "r1.toml" in line
    return line


# --- what a file means ------------------------------------------------------------------------------------


def test_a_file_becomes_what_the_core_is_given(tmp_path: Path) -> None:
    config = load_agent_config(write(tmp_path, example(lateness={"horizon_s": 7.5, "settle_s": 0.25})))
    settings = config.settings(start_ns=123)
    assert (settings.robot, settings.start_ns, settings.track) == ("r1", 123, True)
    np.testing.assert_array_equal(settings.mean, [1.0, 2.0, 0.5])
    np.testing.assert_allclose(settings.cov, np.diag([0.25, 0.25, 0.01]))
    assert settings.landmarks == {"L3": (4.0, 5.0)}
    assert settings.one_way_sensors == ("camera",)
    assert (settings.lateness.horizon_ns, settings.lateness.settle_ns) == (7_500_000_000, 250_000_000)
    (target,) = settings.targets
    np.testing.assert_allclose(target.cov, np.diag([1.0, 1.0, 0.25, 0.25]))
    assert target.motion.noise_sigma == (0.2, 0.2)
    assert config.sensor_configs()["uwb"].mount == planar_mount(0.1, 0.0, 0.0)


def test_without_tracking_no_target_is_tracked() -> None:
    config = validate(AgentConfig, example(tracking={"kind": "none"}), "r1")
    assert config.settings(0).track is False


def test_the_forms_stand_for_their_parts() -> None:
    auto, split, safe, published, joint = (
        LocalizationPart(form=form).settings() for form in ("auto", "split_joint", "safe", "published", "joint")
    )
    assert (auto.pair_interval_ns, auto.innovation_cap) == (0, 9.0)
    assert (joint.pair_interval_ns, joint.innovation_cap) == (0, 9.0)
    assert LocalizationPart().settings() == auto
    assert (split.pair_interval_ns, split.innovation_cap) == (0, 9.0)
    assert (safe.innovation_cap, published.innovation_cap) == (0.0, 0.0)
    assert LocalizationPart(innovation_cap=0.0).settings().innovation_cap == 0.0
    assert (safe.pair_interval_ns, safe.sighting_weight) == (3_000_000_000, "trace")
    assert (published.pair_interval_ns, published.sighting_weight) == (0, "logdet")
    assert LocalizationPart(pair_interval_s=0.5).settings().pair_interval_ns == 500_000_000
    assert LocalizationPart(form="published", pair_interval_s=2.0).settings().pair_interval_ns == 2_000_000_000


def test_a_team_is_told_of_each_others_starts(tmp_path: Path) -> None:
    """Stated defaults of what pairs have are not refused: resolved files state everything."""
    localization = LocalizationPart(kind="replica").model_dump(exclude_none=True)
    team = [{"id": "r2", "mean": [3.0, 4.0, 1.0], "start_sigma": {"position_m": 0.5, "heading_rad": 0.1}}]
    made = load_agent_config(write(tmp_path, example(localization=localization, team=team))).settings(0)
    assert (made.localization.kind, made.localization.innovation_cap) == ("replica", 0.0)
    (mate,) = made.team
    assert mate.id == "r2"
    np.testing.assert_array_equal(mate.mean, [3.0, 4.0, 1.0])
    np.testing.assert_allclose(mate.cov, np.diag([0.25, 0.25, 0.01]))
    assert LocalizationPart(kind="replica", innovation_cap=4.0).settings().innovation_cap == 4.0


def test_the_horizon_of_the_history_is_the_age_limit_of_messages() -> None:
    config = validate(AgentConfig, example(), "r1")
    network = config.network.settings(config.lateness, config.unsafe.settings())
    assert network.horizon_ns == round(config.lateness.horizon_s * 1e9)


def test_odometry_noise_is_handed_over_completely() -> None:
    part = OdometryPart(along_m_per_sqrt_m=0.12, scale_turn=0.9)
    noise = part.noise()
    for name, value in part.model_dump().items():
        assert getattr(noise, name) == value


def test_a_configuration_survives_json() -> None:
    """Recordings keep it that way."""
    config = validate(AgentConfig, example(), "r1")
    assert AgentConfig.model_validate(json.loads(json.dumps(config.model_dump()))) == config


def test_a_belief_needs_the_deviation_its_model_asks_for() -> None:
    with pytest.raises(ConfigError, match="heading_rad is missing"):
        SigmaPart(position_m=1.0).covariance("unicycle")
    with pytest.raises(ConfigError, match="velocity_mps is missing"):
        SigmaPart(position_m=1.0, heading_rad=1.0).covariance("damped_velocity")


def test_a_file_of_a_drone(tmp_path: Path) -> None:
    data = example(
        motion={"model": "quadrotor", "altitude_m": 15.0, "altitude_sigma_m": 0.1},
        initial={
            "mean": [1.0, 2.0, 14.0, 0.5],
            "start_sigma": {"position_m": 0.5, "altitude_m": 0.2, "heading_rad": 0.1},
        },
        landmarks=[{"id": "L3", "position": [4.0, 5.0, 2.5]}],
        sensors={
            "camera": {
                "kind": "pixel",
                "mount": [0.1, 0.0, -0.05, 0.0, 1.5, 0.2],
                "intrinsics": {"focal_px": 400.0, "size_px": [800.0, 600.0]},
            }
        },
        mavlink={"endpoint": "udpin:127.0.0.1:14550", "fixes": ["position", "altitude"], "fix_sigma_altitude_m": 0.7},
    )
    config = load_agent_config(write(tmp_path, data))
    settings = config.settings(0)
    assert settings.motion == SpatialMotion(held=HeldAltitude(15.0, 0.1))
    assert settings.layout is SPATIAL
    np.testing.assert_array_equal(settings.mean, [1.0, 2.0, 14.0, 0.5])
    np.testing.assert_allclose(settings.cov, np.diag([0.25, 0.25, 0.04, 0.01]))
    assert settings.landmarks == {"L3": (4.0, 5.0, 2.5)}
    camera = config.sensor_configs()["camera"]
    assert camera.mount == (0.1, 0.0, -0.05, 0.0, 1.5, 0.2)
    assert camera.intrinsics == Intrinsics(400.0, (400.0, 300.0), (800.0, 600.0))
    assert config.mavlink is not None
    assert config.mavlink.settings([0.0, 0.0, 0.0]).fix_sigma_altitude_m == 0.7


@pytest.mark.parametrize(
    ("model", "variances"),
    [
        ("unicycle", [1.0, 1.0, 9.0]),
        ("unicycle_gains", [1.0, 1.0, 9.0, 36.0, 49.0]),
        ("quadrotor", [1.0, 1.0, 4.0, 9.0]),
        ("planar_altitude", [1.0, 1.0, 4.0, 9.0]),
        ("damped_velocity", [1.0, 1.0, 16.0, 16.0]),
        ("constant_velocity_3d", [1.0, 1.0, 4.0, 16.0, 16.0, 16.0]),
        ("constant_acceleration", [1.0, 1.0, 16.0, 16.0, 25.0, 25.0]),
    ],
)
def test_a_belief_has_the_deviations_of_its_model(model: str, variances: list[float]) -> None:
    part = SigmaPart(
        position_m=1.0,
        altitude_m=2.0,
        heading_rad=3.0,
        velocity_mps=4.0,
        acceleration_mps2=5.0,
        gain_along=6.0,
        gain_turn=7.0,
    )
    np.testing.assert_allclose(part.covariance(model), np.diag(variances))


def test_a_targets_noise_is_that_which_drives_its_model() -> None:
    control = ControlPart(speed_mps=0.2, altitude_m=1.5)
    noise = ControlNoisePart(speed_mps=0.1, yaw_rate_radps=0.2, altitude_m=0.3, acceleration_mps2=0.4, jerk_mps3=0.5)

    def sigma(model: str) -> tuple[float, ...]:
        return target_motion(model, control, noise, 1.0, 2.0).noise_sigma

    assert sigma("unicycle") == sigma("quadrotor") == (0.1, 0.2)
    assert sigma("damped_velocity") == (0.4, 0.4)
    assert sigma("damped_velocity_3d") == (0.4, 0.4, 0.4)
    assert sigma("constant_acceleration") == (0.5, 0.5)
    assert target_motion("quadrotor", control, noise, 1.0, 2.0).held == HeldAltitude(1.5, 0.3)
    assert target_motion("unicycle", control, noise, 1.0, 2.0).held is None


# --- mistakes ---------------------------------------------------------------------------------------------

INITIAL = {"mean": [1.0, 2.0, 0.5], "start_sigma": {"position_m": 0.5, "heading_rad": 0.1}}
TARGET = example()["targets"][0]
MATE = {"id": "r2"} | INITIAL
MISTAKES: list[tuple[dict[str, Any], list[str]]] = [
    ({"identty": {}}, ["'identty'", "did you mean 'identity'"]),
    ({"sensors": {"uwb": {"kind": "range", "munt": [0.0, 0.0, 0.0]}}}, ["'sensors.uwb.munt'", "did you mean 'mount'"]),
    ({"mavlink": {"endpoint": "x", "simulate": True}}, ["'mavlink.simulate'", "did you mean 'simulated'"]),
    (
        {"mavlink": {"endpoint": "x", "odometry": {"scale_trun": 1.0}}},
        ["'mavlink.odometry.scale_trun'", "did you mean 'scale_turn'"],
    ),
    (
        {"targets": [TARGET | {"start_sigma": {"position": 1.0}}]},
        ["'targets.t1.start_sigma.position'", "did you mean 'position_m'"],
    ),
    (
        {"sensors": {"uwb": {"kind": "range", "mount": [0.1, 0.2, 0.3, 0.4]}}},
        ["'sensors.uwb.mount'", "x, y, yaw or x, y, z, roll, pitch, yaw"],
    ),
    ({"sensors": {"eye": {"kind": "pixel"}}}, ["sensors.eye.intrinsics is missing", "focal_px"]),
    ({"motion": {"model": "quadrotor"}}, ["motion.altitude_sigma_m", "above 0"]),
    ({"motion": {"model": "planar_altitude"}}, ["initial.mean needs 4 numbers", "'planar_altitude'"]),
    (
        {"motion": {"model": "planar_altitude"}, "initial": INITIAL | {"mean": [1.0, 2.0, 3.0, 0.5]}},
        ["initial.start_sigma.altitude_m is missing"],
    ),
    ({"landmarks": [{"id": "L3", "position": [4.0]}]}, ["'landmarks.L3.position'", "at least 2"]),
    (
        {"targets": [TARGET | {"model": "quadrotor", "start_sigma": INITIAL["start_sigma"] | {"altitude_m": 1.0}}]},
        ["altitude_m above 0"],
    ),
    ({"initial": INITIAL | {"mean": [1.0, 2.0]}}, ["'initial.mean'", "at least 3"]),
    ({"initial": INITIAL | {"mean": [1.0, 2.0, float("nan")]}}, ["'initial.mean.2' = nan"]),
    ({"initial": INITIAL | {"start_sigma": {"position_m": 0.5}}}, ["initial.start_sigma.heading_rad is missing"]),
    ({"identity": {"robot": "R1"}}, ["'identity.robot' = 'R1'", "pattern"]),
    ({"identity": {"robot": "a" * 25}}, ["'identity.robot'", "pattern"]),
    ({"identity": {"robot": "r1", "incarnation": 0}}, ["'identity.incarnation' = 0", "greater than or equal to 1"]),
    ({"identity": {}}, ["'identity.robot' is missing"]),
    ({"zenoh": {"listen": "udp/127.0.0.1:1"}}, ["'zenoh.listen'", "list"]),
    ({"zenoh": {"listen": [], "lease_ms": 1}}, ["'zenoh.lease_ms' = 1", "100"]),
    ({"lateness": {"horizon_s": -1.0}}, ["'lateness.horizon_s' = -1.0", "greater than 0"]),
    ({"lateness": {"kind": "hope"}}, ["'lateness.kind' = 'hope'", "'compensate', 'replay', 'discard'"]),
    ({"state_dir": 3}, ["'state_dir' = 3", "string"]),
    ({"version": 9}, ["'version' = 9"]),
    ({"targets": [TARGET | {"mean": [0.0, 0.0]}]}, ["targets.t1.mean needs 4 numbers"]),
    ({"targets": [TARGET, TARGET]}, ["'t1' is used twice"]),
    ({"landmarks": [{"id": "L", "position": [0.0, 0.0]}] * 2}, ["'L' is used twice"]),
    (
        {"mavlink": {"endpoint": "udpin:127.0.0.1:14550"}, "clock": {"source": "run"}},
        ["clock.source", "mavlink.simulated = true"],
    ),
    ({"mavlink": {"endpoint": "udpin:127.0.0.1:14550"}, "injection": {"seed": 1}}, ["[injection]", "remove it"]),
    (
        {"mavlink": {"endpoint": "udpin:127.0.0.1:14550", "steer": True}},
        ["mavlink.steer = true needs a planner", "set planning.kind"],
    ),
    ({"mavlink": {"endpoint": "udpin:127.0.0.1:14550", "arm": True}}, ["mavlink.arm = true", "mavlink.steer = true"]),
    (
        {"mavlink": {"endpoint": "udpin:127.0.0.1:14550", "set_mode": True}},
        ["mavlink.set_mode = true", "mavlink.steer = true"],
    ),
    ({"localization": {"correlation": "ignored"}}, ["localization: correlation = 'ignored'", "add form ="]),
    ({"localization": {"kind": "replica"}}, ["key 'team' is missing", "every other robot"]),
    (
        {"localization": {"kind": "replica", "form": "safe"}, "team": [MATE]},
        ["localization: form = 'safe'", "leave form out"],
    ),
    (
        {"localization": {"kind": "replica", "correlation": "ignored"}, "team": [MATE]},
        ["localization: correlation = 'ignored'", "leave correlation out"],
    ),
    (
        {"localization": {"kind": "replica", "pair_interval_s": 2.0}, "team": [MATE]},
        ["localization: pair_interval_s = 2.0", "leave pair_interval_s out"],
    ),
    ({"team": [MATE | {"id": "r1"}]}, ["team.r1 is this robot itself", "list the others only"]),
    ({"team": [MATE, MATE]}, ["'r2' is used twice"]),
    ({"team": [MATE | {"mean": [1.0]}]}, ["'team.r2.mean'", "at least 3"]),
    ({"team": [MATE | {"motion": {"model": "planar_altitude"}}]}, ["team.r2: mean needs 4 numbers"]),
    ({"team": [MATE | {"start_sigma": {"position_m": 1.0}}]}, ["team.r2: start_sigma.heading_rad is missing"]),
    ({"team": [MATE | {"id": f"r{k}"} for k in range(2, 18)]}, ["'team'", "at most 15"]),
]


@pytest.mark.parametrize(("change", "words"), MISTAKES, ids=[words[0] for _, words in MISTAKES])
def test_a_mistake_is_answered_with_the_key_and_the_remedy(
    tmp_path: Path, change: dict[str, Any], words: list[str]
) -> None:
    line = complaint(tmp_path, example(**change))
    for word in words:
        assert word in line


def test_a_file_that_is_not_there_or_not_toml(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.toml: no such file"):
        load_agent_config(tmp_path / "gone.toml")
    with pytest.raises(ConfigError, match="a TOML file is needed"):
        load_agent_config(tmp_path)
    (tmp_path / "broken.toml").write_text("= 1")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_agent_config(tmp_path / "broken.toml")


def test_a_message_is_always_one_line() -> None:
    assert str(ConfigError("a\n  b\r\nc")) == "a b c"


def test_open_links_must_be_asked_for_by_name(tmp_path: Path) -> None:
    """Without encryption a robot listens on loopback alone, unless told that the network is trusted."""
    open_link = {"listen": ["udp/0.0.0.0:20001?rel=0"], "peers": []}
    assert "zenoh.insecure_lan" in complaint(tmp_path, example(zenoh=open_link))
    trusted = load_agent_config(write(tmp_path, example(zenoh=open_link | {"insecure_lan": True})))
    assert trusted.zenoh.insecure_lan


@pytest.mark.parametrize("endpoint", ["udpin:192.168.1.4:14550", "tcp:10.0.0.2:5760", "serial:/dev/ttyS0:57600"])
def test_an_autopilot_beyond_loopback_counts_as_real(tmp_path: Path, endpoint: str) -> None:
    """Whatever it is declared to be: nothing is injected, and time is real."""
    mavlink = {"endpoint": endpoint, "simulated": True}
    assert "[injection]" in complaint(tmp_path, example(mavlink=mavlink, injection={"seed": 1}))
    faults = [{"kind": "clock_step", "robot": "r1", "offset_s": 1.0}]
    assert "[injection]" in complaint(tmp_path, example(mavlink=mavlink, injection={"seed": 1, "faults": faults}))
    assert "clock.source" in complaint(tmp_path, example(mavlink=mavlink, clock={"source": "run"}))
    assert load_agent_config(write(tmp_path, example(mavlink=mavlink))).mavlink is not None


def test_a_wrong_mavlink_endpoint_is_told_before_anything_starts(tmp_path: Path) -> None:
    assert "mavlink.endpoint" in complaint(tmp_path, example(mavlink={"endpoint": "udp:14550"}))


def test_protections_are_not_switched_off_on_a_robot_that_may_be_real(tmp_path: Path) -> None:
    unsafe = {"accept_stale": True, "trust_liars": False}
    real = {"endpoint": "udpin:127.0.0.1:14550"}
    for mavlink in (real, {"endpoint": "udpin:0.0.0.0:14550", "simulated": True}):
        assert "unsafe.accept_stale" in complaint(tmp_path, example(mavlink=mavlink, unsafe=unsafe))
        load_agent_config(write(tmp_path, example(mavlink=mavlink, unsafe={"accept_stale": False})))
    # Without an autopilot nobody knows what the robot is, unless it is part of a run.
    bare = {key: value for key, value in example(unsafe=unsafe).items() if key != "mavlink"}
    assert "unsafe.accept_stale" in complaint(tmp_path, bare)
    load_agent_config(write(tmp_path, bare | {"clock": {"source": "run"}}))
    found = load_agent_config(write(tmp_path, example(unsafe=unsafe)))
    assert found.settings(0).unsafe.named() == ["accept_stale"]
    assert "unsafe.accept_everything" in complaint(tmp_path, example(unsafe={"accept_everything": True}))


def test_switches_change_what_they_name(tmp_path: Path) -> None:
    def settings(*switches: str) -> AgentSettings:
        changed = example(unsafe=dict.fromkeys(switches, True), lateness={"clock_sigma_s": 1.0})
        return load_agent_config(write(tmp_path, changed)).settings(0)

    plain = settings()
    assert plain.health.enabled and plain.unsafe == UnsafeSettings()
    assert not settings("trust_liars").health.enabled
    assert settings("trust_clocks").lateness.clock_sigma_ns == 0 < plain.lateness.clock_sigma_ns
    assert settings("ignore_gaps").coast == CoastSettings(0.0, 0.0) != plain.coast
    assert settings("ignore_correlation").localization.correlation == "ignored" != plain.localization.correlation
    assert len(UnsafeSettings().named()) == 0
    assert {item.name for item in fields(UnsafeSettings)} == set(UnsafePart.model_fields)


def test_health_that_judges_nobody_is_refused(tmp_path: Path) -> None:
    assert "health.gate_nis" in complaint(tmp_path, example(health={"gate_nis": 5.0}))


def test_a_vehicle_is_steered_only_if_that_is_switched_on() -> None:
    plain = MavlinkPart(endpoint="udpin:127.0.0.1:14550")
    plain.check_steering("none")
    assert plain.settings([0.0, 0.0, 0.0]).steering is None
    steered = MavlinkPart(endpoint="udpin:127.0.0.1:14550", steer=True)
    steered.check_steering("potential")
    assert steered.settings([0.0, 0.0, 0.0]).steering == SteeringSettings(arm=False, set_mode=False)
    told = MavlinkPart(endpoint="udpin:127.0.0.1:14550", steer=True, arm=True)
    assert told.settings([0.0, 0.0, 0.0]).steering == SteeringSettings(arm=True, set_mode=False)


def test_what_is_planned_may_be_steered_by(tmp_path: Path) -> None:
    mavlink = {"endpoint": "serial:/dev/ttyAMA0:921600", "steer": True}
    planning = {"kind": "potential", "overrun_s": 0.25}
    planned = load_agent_config(write(tmp_path, example(mavlink=mavlink, planning=planning)))
    assert planned.settings(0).planning.overrun_ns == 250_000_000
    assert planned.mavlink is not None and planned.mavlink.steer and not planned.mavlink.arm
