"""When a robot tells what it believes for others' plans, and when it plans itself, with what there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.core import Agent
from agent.effects import Broadcast, Effect, Steer
from agent.events import ControlReport, Event, LinkChange, PlannerOverrun, Received, Tick
from agent.pilot import FALLBACK_ROUNDS
from agent.settings import AgentSettings, LocalizationSettings, PlanningSettings
from network.messages import Belief, Header, Message, RoundReport, RoundStage, TargetBelief
from tests.agent.round_team import NS, ROUND
from tests.agent.test_jlatt_filter import drive, heard, settings_of, sight

WAIT = ROUND.wait_ns
POTENTIAL = PlanningSettings(kind="potential")


def planning(**changes: object) -> AgentSettings:
    return replace(settings_of(), planning=POTENTIAL, **changes)  # type: ignore[arg-type]


def made(agent: Agent, *events: Event) -> list[Effect]:
    return [effect for event in events for effect in agent.handle(event)]


def steers(effects: list[Effect]) -> list[Steer]:
    return [effect for effect in effects if isinstance(effect, Steer)]


def stages(effects: list[Effect]) -> list[RoundStage]:
    return [
        effect.body.stage
        for effect in effects
        if isinstance(effect, Broadcast) and isinstance(effect.body, RoundReport)
    ]


def report(stage: RoundStage, place: tuple[float, float], model: str = "unicycle") -> RoundReport:
    mean = np.array([*place, 0.0] if model == "unicycle" else [*place, 0.0, 0.0])
    return RoundReport(stage, Belief(model, mean, 0.01 * np.eye(len(mean))), np.zeros(3), 0.0)


def test_nobody_is_waited_for_in_vain_and_the_command_ends_by_itself() -> None:
    agent = Agent(planning())
    first = made(agent, Tick(0), Tick(WAIT))
    assert stages(first) == [RoundStage.PRIOR, RoundStage.POSTERIOR] and not steers(first)
    assert agent.next_deadline_ns() <= 2 * WAIT
    (command,) = steers(made(agent, Tick(2 * WAIT)))
    assert command.until_ns == 2 * (NS + WAIT)
    assert not steers(made(agent, Tick(2 * WAIT + 1)))


def test_with_all_neighbours_heard_a_round_takes_no_time() -> None:
    agent = Agent(planning())
    made(agent, LinkChange(0, "r2", True, 1, 1), Tick(0), Tick(2 * WAIT))
    for k in (1, 2):
        made(agent, heard(report(RoundStage.PRIOR, (-8.0, 0.0)), k * NS, seq=2 * k))
        found = made(agent, drive(k, 0.1), Tick(k * NS))
        found += made(agent, heard(report(RoundStage.POSTERIOR, (-8.0, 0.0)), k * NS, seq=2 * k + 1))
        assert stages(found) == [RoundStage.PRIOR, RoundStage.POSTERIOR]
        assert len(steers(found)) == 1, "it has waited, though everybody had told"


def test_a_neighbour_is_kept_off() -> None:
    commands = []
    for place in ((-20.0, 0.0), (3.0, 0.0)):
        agent = Agent(planning())
        made(agent, LinkChange(0, "r2", True, 1, 1), Tick(0), heard(report(RoundStage.POSTERIOR, place), 0))
        (command,) = steers(made(agent, Tick(WAIT), Tick(2 * WAIT)))
        commands.append(command)
    assert commands[0].velocity_mps[0] > commands[1].velocity_mps[0], commands


def test_what_has_no_heading_is_nobody_to_plan_with_and_does_no_harm() -> None:
    agent = Agent(planning())
    strange = report(RoundStage.POSTERIOR, (3.0, 0.0), "constant_velocity")
    strange = replace(strange, targets=(TargetBelief("t1", Belief("constant_velocity", np.zeros(4), np.eye(4))),))
    made(agent, LinkChange(0, "r2", True, 1, 1), Tick(0), heard(strange, 0))
    assert len(steers(made(agent, Tick(WAIT), Tick(2 * WAIT)))) == 1


def test_after_a_plan_that_took_too_long_simple_ones_follow_for_some_rounds() -> None:
    agent = Agent(replace(planning(), planning=PlanningSettings(kind="optimal")))
    made(agent, Tick(0), Tick(WAIT), Tick(2 * WAIT), PlannerOverrun(2 * WAIT))
    assert agent.counters["plan.made"] == 1
    for k in range(1, FALLBACK_ROUNDS + 3):
        made(agent, drive(k, 0.1), Tick(k * NS), Tick(k * NS + WAIT), Tick(k * NS + 2 * WAIT))
    assert agent.counters["plan.overrun"] == 1
    assert agent.counters["plan.simple"] == FALLBACK_ROUNDS
    assert agent.counters["plan.made"] == 3


def test_the_status_says_whether_the_vehicle_obeys() -> None:
    agent = Agent(planning())
    made(agent, ControlReport(0, "not armed"))
    assert agent.status()["steering"]["refused"] == "not armed"  # type: ignore[index]
    made(agent, ControlReport(1, None))
    assert agent.status()["steering"]["refused"] is None  # type: ignore[index]
    assert "steering" not in Agent(settings_of()).status()


def test_robots_of_other_kinds_plan_too() -> None:
    agent = Agent(planning(localization=LocalizationSettings(form="split_joint")))
    found = made(agent, Tick(0), Tick(2 * WAIT))
    assert stages(found) == [RoundStage.POSTERIOR] and len(steers(found)) == 1
    found = made(agent, drive(1, 0.1), Tick(NS), Tick(NS + 2 * WAIT))
    assert stages(found) == [RoundStage.POSTERIOR] and len(steers(found)) == 1


def test_a_robot_that_was_held_up_plans_once_and_for_the_present() -> None:
    agent = Agent(planning())
    made(agent, Tick(0), Tick(2 * WAIT))
    late = [replace(drive(k, 0.1), t_ns=9 * NS) for k in range(1, 10)]
    found = made(agent, *late, Tick(9 * NS), Tick(9 * NS + WAIT), Tick(9 * NS + 2 * WAIT))
    # The last instant ends with a tick; the one before it is over.
    assert stages(found) == 2 * [RoundStage.PRIOR, RoundStage.POSTERIOR]
    assert steers(found)[-1].until_ns == 9 * NS + 2 * (NS + WAIT)
    assert agent.counters["round.skipped"] == agent.counters["plan.skipped"] == 7


def test_a_plan_is_made_though_the_next_round_begins_while_neighbours_are_waited_for() -> None:
    """Of quick rounds over slow links what neighbours told after their corrections may always come too late."""
    agent = Agent(planning(round=replace(ROUND, wait_ns=55 * NS // 100)))
    made(agent, LinkChange(0, "r2", True, 1, 1))
    for k in range(4):
        made(agent, *([drive(k, 0.1)] if k else []), heard(report(RoundStage.PRIOR, (-8.0, 0.0)), k * NS, seq=k))
        agent.handle(Tick(k * NS))
    assert agent.counters["plan.made"] == 3
    assert agent.counters["plan.skipped"] == 0


def test_who_flies_keeps_off_the_place_where_another_one_fell_silent() -> None:
    """It may hover there: for a minute, then it is forgotten."""
    agent = Agent(replace(planning(), planning=PlanningSettings(kind="encircle", closest_m=6.0)))
    made(agent, LinkChange(0, "r2", True, 1, 1), Tick(0), heard(report(RoundStage.POSTERIOR, (3.0, 0.0)), 0))
    speeds = {}
    for k in (20, 59, 62):
        made(agent, *(drive(j, 0.0) for j in range(max(speeds, default=0) + 1, k + 1)))
        found = made(agent, Tick(k * NS), Tick(k * NS + WAIT), Tick(k * NS + 2 * WAIT))
        speeds[k] = steers(found)[-1].velocity_mps[0]
    assert speeds[20] < -0.1 and speeds[59] < -0.1
    assert speeds[62] == 0.0


def test_a_report_from_the_future_is_not_waited_by() -> None:
    agent = Agent(planning())
    far = Message(Header("r2", 1, 1, 0, 100 * NS, 0), report(RoundStage.POSTERIOR, (3.0, 0.0)))
    made(agent, LinkChange(0, "r2", True, 1, 1), Tick(0), Received(0, far))
    assert agent.status()["steering"]["neighbours"] == []  # type: ignore[index]


def test_who_is_seen_and_not_heard_is_kept_clear_of() -> None:
    """It stands 3 m ahead, and the target behind it draws the robot on."""

    def speed(*seen: Event) -> float:
        agent = Agent(planning())
        made(agent, Tick(0), Tick(2 * WAIT), drive(1), *seen, Tick(NS))
        (command,) = steers(made(agent, Tick(NS + 2 * WAIT)))
        return command.velocity_mps[0]

    assert speed(sight(1, "r2", (3.0, 0.0))) < 0.5 * speed()
    assert speed(sight(1, "r2", (30.0, 0.0))) == speed()
