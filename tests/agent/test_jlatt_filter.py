"""Localization and tracking by rounds: honest, whatever is lost or late, in any order, over starts, in mixed teams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Broadcast
from agent.estimation.motion import SPATIAL, UNICYCLE, SpatialMotion, TargetMotion
from agent.events import Fix, LinkChange, Observation, Odometry, Received, Tick
from agent.jlatt_filter import JlattFilter
from agent.settings import AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings, UnsafeSettings
from network.messages import Header, Message, RoundReport, RoundStage
from tests.agent.round_team import JLATT, LATENESS, NS, ROUND, Team
from tests.sizes import sized

SEEDS = range(1, 1 + sized(2, 10))
STEPS = 60
SPLIT = replace(JLATT, weights="split_ci")


def assert_honest(*teams: Team, limit: float = 1.0) -> None:
    own, target = (float(np.mean([getattr(team, kind) for team in teams])) for kind in ("nees", "target_nees"))
    seeds = [team.seed for team in teams]
    assert own <= limit and target <= limit, f"ANEES {own:.2f}, of the target {target:.2f}; seeds {seeds}"


@pytest.mark.parametrize("weights", ["split_ci", "trace"])
def test_a_team_knows_where_it_and_the_target_are_and_does_not_claim_more(weights: str) -> None:
    teams = [Team(seed, replace(JLATT, weights=weights)).run(STEPS) for seed in SEEDS]  # type: ignore[arg-type]
    assert_honest(*teams)
    target, own = np.mean([team.rmse() for team in teams], axis=0)
    assert target < 1.5 and own < 0.6


def test_nobody_hearing_anybody_is_worse_and_honest() -> None:
    together = [Team(seed, SPLIT).run(STEPS) for seed in SEEDS]
    alone = [Team(seed, SPLIT, carry=lambda *_: None).run(STEPS) for seed in SEEDS]
    assert_honest(*alone, limit=1.7)
    assert np.mean([team.rmse()[1] for team in together]) < np.mean([team.rmse()[1] for team in alone])


@pytest.mark.parametrize("delay", [1, 3])
def test_what_is_late_is_carried_to_the_present(delay: int) -> None:
    teams = [Team(seed, SPLIT, carry=lambda *_: delay).run(STEPS) for seed in SEEDS]
    assert_honest(*teams, limit=1.15)
    assert all(team.rmse()[0] < 2.5 for team in teams)


def test_late_beliefs_taken_for_new_ones_claim_too_much() -> None:
    careful, naive = Team(5, SPLIT, carry=lambda *_: 3), Team(5, SPLIT, carry=lambda *_: 3)
    for agent in naive.agents.values():
        assert isinstance(agent.filter, JlattFilter)
        fusion = agent.filter._fusion
        fusion._settings = replace(fusion._settings, unsafe=UnsafeSettings(use_late_as_new=True))
    nees = [float(np.mean(team.run(STEPS).nees)) for team in (careful, naive)]
    assert nees[1] > 2.0 > 1.15 > nees[0], nees


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_loss_is_borne(share: float) -> None:
    rng = np.random.default_rng(7)
    team = Team(2, SPLIT, carry=lambda *_: None if rng.random() < share else 0).run(STEPS)
    assert_honest(team)
    assert team.rmse()[0] < 2.5, team.rmse()


def test_what_is_discarded_when_late_is_not_used() -> None:
    lateness = replace(LATENESS, kind="discard")
    late = Team(4, SPLIT, lateness=lateness, carry=lambda *_: 2).run(20)
    assert sum(agent.counters["round.unheard"] for agent in late.agents.values()) > 0
    assert not any(agent.counters["pair.gated"] for agent in late.agents.values())


def test_one_message_a_round_is_enough() -> None:
    sent = []
    team = Team(1, SPLIT, round=replace(ROUND, lean=True))
    before = team._broadcast
    team._broadcast = lambda k, name, t, effect: (sent.append(effect), before(k, name, t, effect))  # type: ignore[assignment, func-returns-value]
    team.run(STEPS)
    assert_honest(team)
    assert {effect.body.stage for effect in sent} == {RoundStage.PRIOR}
    assert len(sent) == len(team.names) * (STEPS + 1)


# -- one robot --------------------------------------------------------------------------------------------------


def settings_of(robot: str = "r1", **changes: object) -> AgentSettings:
    motion = TargetMotion(UNICYCLE, (0.25, 0.0), (0.005, 0.02))
    prior = TargetSettings("t1", motion, np.array([8.0, 1.0, 0.0]), np.diag([4.0, 4.0, 1.0]))
    found = AgentSettings(
        robot,
        0,
        np.zeros(3),
        np.diag([0.01, 0.01, 1e-4]),
        targets=(prior,),
        localization=SPLIT,
        round=ROUND,
        lateness=LatenessSettings(horizon_ns=10 * NS),
    )
    return replace(found, **changes)  # type: ignore[arg-type]


def told_by(agent: Agent, *events: object) -> list[RoundReport]:
    found = []
    for event in events:
        for effect in agent.handle(event):  # type: ignore[arg-type]
            if isinstance(effect, Broadcast) and isinstance(effect.body, RoundReport):
                found.append(effect.body)
    return found


def drive(k: int, speed: float = 0.5) -> Odometry:
    cov = np.diag([1e-4, 1e-6, 1e-6, 1e-4])
    return Odometry(k * NS, (k - 1) * NS, k * NS, np.array([speed, 0.0, 0.0, 0.0]), cov)


def heard(report: RoundReport, t_ns: int, source: str = "r2", seq: int = 0) -> Received:
    return Received(t_ns, Message(Header(source, 1, 1, seq, t_ns, t_ns), report))


def sight(k: int, of: str, z: tuple[float, float]) -> Observation:
    return Observation(k * NS, k * NS, "range_bearing", of, np.array(z), np.diag([0.04, 4e-4]), "camera")


def test_a_report_tells_the_belief_before_the_corrections_and_where_the_target_is_seen() -> None:
    agent = Agent(settings_of())
    told_by(agent, Tick(0))
    (report,) = told_by(agent, drive(1), sight(1, "target:t1", (6.0, 0.1)), Tick(NS))
    assert report.stage is RoundStage.PRIOR
    np.testing.assert_allclose(report.belief.mean, [0.5, 0.0, 0.0])
    np.testing.assert_allclose(report.velocity, [0.5, 0.0, 0.0])
    (seen,) = report.corrections
    np.testing.assert_allclose(seen.place, [0.5 + 6.0 * np.cos(0.1), 6.0 * np.sin(0.1)], atol=1e-9)
    assert np.trace(seen.sensor) == pytest.approx(0.04 + 36.0 * 4e-4)
    (target,) = report.targets
    assert target.age_ns == NS
    # Nobody else is there: the round ends when it has waited.
    assert agent.counters["round.closed"] == 1
    told_by(agent, Tick(NS + ROUND.wait_ns))
    assert agent.counters["round.closed"] == 2
    estimate = agent.estimate()
    assert estimate is not None and np.trace(estimate.tracks[0].cov[:2, :2]) < 0.5
    assert estimate.tracks[0].learnt_ns == NS


def test_a_sensor_s_noise_counts_as_new_once() -> None:
    """The same report, heard late and again, makes nobody surer than hearing it once."""
    sender = Agent(settings_of("r2", mean=np.array([0.0, 2.0, 0.0])))
    told_by(sender, Tick(0))
    (report,) = told_by(sender, drive(1, 0.0), sight(1, "target:t1", (8.0, -0.1)), Tick(NS))

    def after(rounds: int) -> float:
        agent = Agent(settings_of())
        told_by(agent, Tick(0), Tick(ROUND.wait_ns), LinkChange(0, "r2", True, 1, 1))
        told_by(agent, drive(1, 0.0), heard(report, NS), Tick(NS), Tick(NS + ROUND.wait_ns))
        first = agent.estimate()
        assert first is not None and agent.counters["round.used_corrections"] == 1
        for k in range(2, 2 + rounds):
            told_by(agent, drive(k, 0.0), Tick(k * NS), Tick(k * NS + ROUND.wait_ns))
        last = agent.estimate()
        assert last is not None
        sizes = [np.linalg.slogdet(item.tracks[0].cov[:2, :2])[1] for item in (first, last)]
        return float(sizes[1] - sizes[0])

    assert after(3) > 0.0


def test_who_is_quarantined_tells_nothing_of_targets_either() -> None:
    sender = Agent(settings_of("r2", mean=np.array([0.0, 2.0, 0.0])))
    told_by(sender, Tick(0))
    (report,) = told_by(sender, drive(1, 0.0), sight(1, "target:t1", (8.0, -0.1)), Tick(NS))
    agent = Agent(settings_of())
    told_by(agent, Tick(0), Tick(ROUND.wait_ns), LinkChange(0, "r2", True, 1, 1))
    for k in range(8):
        agent.health.usable("r2", k, 50.0, own_observed=True)
    assert not agent.health.trusts("r2") and agent.health.trusts("r3")
    told_by(agent, drive(1, 0.0), heard(report, NS), Tick(NS), Tick(NS + ROUND.wait_ns))
    assert agent.counters["round.closed"] == 2 and agent.counters["round.used_corrections"] == 0


@pytest.mark.parametrize("broken", ["robot_update", "target_update", "target_correction", "agree"])
def test_a_matrix_that_cannot_be_inverted_ends_no_round(monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError

    sender = Agent(settings_of("r2", mean=np.array([0.0, 2.0, 0.0])))
    told_by(sender, Tick(0))
    (report,) = told_by(sender, drive(1, 0.0), sight(1, "target:t1", (8.0, -0.1)), Tick(NS))
    monkeypatch.setattr(f"agent.round_fusion.{broken}", singular)
    agent = Agent(settings_of())
    told_by(agent, Tick(0), Tick(ROUND.wait_ns), LinkChange(0, "r2", True, 1, 1))
    events = (drive(1, 0.0), sight(1, "r2", (2.0, 1.57)), sight(1, "target:t1", (8.0, 0.1)), heard(report, NS))
    told_by(agent, *events, Tick(NS), Tick(NS + ROUND.wait_ns))
    assert agent.counters["update.failed"] >= 1
    assert agent.counters["round.closed"] == 2
    assert told_by(agent, drive(2), Tick(2 * NS)), "it goes on"


def test_a_detection_of_somebody_unheard_is_no_use_and_counted() -> None:
    agent = Agent(settings_of())
    told_by(agent, Tick(0), drive(1), sight(1, "r2", (5.0, 0.0)), Tick(NS), Tick(NS + ROUND.wait_ns))
    assert agent.counters["round.unheard"] == 1 and agent.counters["round.used_detections"] == 0


def test_a_fix_that_comes_late_counts_at_its_instant() -> None:
    def run(late: bool) -> np.ndarray:
        agent = Agent(settings_of())
        fix = Fix(NS, NS, "position", np.array([0.6, 0.1]), 0.01 * np.eye(2), "gps")
        events = [Tick(0), drive(1), drive(2)]
        events.insert(3 if late else 2, replace(fix, t_ns=2 * NS) if late else fix)  # type: ignore[arg-type]
        told_by(agent, *events, Tick(2 * NS), Tick(2 * NS + ROUND.wait_ns))
        estimate = agent.estimate()
        assert estimate is not None
        return np.concatenate([estimate.mean, estimate.cov.ravel()])

    np.testing.assert_allclose(run(late=True), run(late=False), atol=1e-6)


def test_odometry_that_is_silent_skips_rounds_and_does_not_spin() -> None:
    agent = Agent(settings_of())
    told_by(agent, Tick(0), Tick(ROUND.wait_ns))
    assert agent.next_deadline_ns() > 100 * NS
    assert not told_by(agent, *(Tick(k * NS) for k in range(1, 7)))
    (report,) = told_by(agent, replace(drive(7), t0_ns=0), Tick(7 * NS))
    assert report.stage is RoundStage.PRIOR
    assert agent.counters["round.skipped"] == 6


def test_who_begins_again_long_after_its_survey_does_not_spin() -> None:
    """Its belief is of long ago until odometry comes, and rounds of that time are over."""
    agent = Agent(settings_of())
    told_by(agent, Tick(10 * NS))
    assert agent.next_deadline_ns() > 10 * NS
    assert agent.counters["round.skipped"] == 10
    (report,) = told_by(agent, replace(drive(11), t0_ns=0), Tick(11 * NS))
    assert report.stage is RoundStage.PRIOR


def test_robots_of_other_models_see_each_other() -> None:
    ground = Agent(settings_of())
    cov = np.diag([0.01, 0.01, 0.04, 1e-4])
    flying = Agent(settings_of("r2", mean=np.array([4.0, 0.0, 3.0, np.pi]), cov=cov, motion=SpatialMotion()))
    pair = {"r1": ground, "r2": flying}
    seen = {"r1": sight(1, "r2", (5.0, 0.02)), "r2": sight(1, "r1", (4.6, 0.0))}
    for name, agent in pair.items():
        told_by(agent, Tick(0), LinkChange(0, "r2" if name == "r1" else "r1", True, 1, 1))
    reports = {
        name: told_by(agent, drive(1, 0.0), seen[name], Tick(NS))[-1] for name, agent in pair.items()
    }
    before = {name: agent.estimate() for name, agent in pair.items()}
    ground.handle(heard(reports["r2"], NS, "r2"))
    flying.handle(heard(reports["r1"], NS, "r1"))
    for name, agent in pair.items():
        told_by(agent, Tick(NS + ROUND.wait_ns))
        assert agent.counters["round.used_detections"] == 1, dict(agent.counters)
        now, then = agent.estimate(), before[name]
        assert now is not None and then is not None
        assert now.model == ("unicycle" if name == "r1" else SPATIAL.name)
        assert np.trace(now.cov) <= np.trace(then.cov)


def test_a_start_goes_on_with_what_was_known_and_takes_nothing_for_new() -> None:
    sender = Agent(settings_of("r2", mean=np.array([0.0, 2.0, 0.0])))
    told_by(sender, Tick(0))
    (report,) = told_by(sender, drive(1, 0.0), sight(1, "target:t1", (8.0, -0.1)), Tick(NS))
    agent = Agent(settings_of())
    told_by(agent, Tick(0), Tick(ROUND.wait_ns), LinkChange(0, "r2", True, 1, 1))
    told_by(agent, drive(1, 0.0), heard(report, NS), Tick(NS), Tick(NS + ROUND.wait_ns))
    known = agent.estimate()
    again = Agent(settings_of(), agent.saved())
    restored = again.estimate()
    assert known is not None and restored is not None
    np.testing.assert_array_equal(restored.cov, known.cov)
    np.testing.assert_array_equal(restored.tracks[0].mean, known.tracks[0].mean)
    told_by(again, LinkChange(2 * NS, "r2", True, 1, 1), drive(2, 0.0), heard(report, NS), Tick(2 * NS))
    told_by(again, Tick(2 * NS + ROUND.wait_ns))
    after = again.estimate()
    assert after is not None
    grown = [np.linalg.slogdet(item.tracks[0].cov[:2, :2])[1] for item in (known, after)]
    assert grown[1] > grown[0], "a correction that an earlier life used counted as new"


def test_a_state_of_another_kind_is_refused() -> None:
    from agent.state_fields import StateError

    payload = Agent(settings_of()).saved()
    with pytest.raises(StateError, match="other_form"):
        Agent(settings_of(localization=LocalizationSettings(form="split_joint")), payload)


def test_a_target_nobody_knew_of_is_taken_from_a_neighbour() -> None:
    sender = Agent(settings_of("r2", mean=np.array([0.0, 2.0, 0.0])))
    told_by(sender, Tick(0))
    (report,) = told_by(sender, drive(1, 0.0), Tick(NS))
    unknown = settings_of()
    unknown = replace(unknown, targets=(replace(unknown.targets[0], mean=None),))
    agent = Agent(unknown)
    told_by(agent, Tick(0), Tick(ROUND.wait_ns))
    estimate = agent.estimate()
    assert estimate is not None and not estimate.tracks
    told_by(agent, drive(1, 0.0), heard(report, NS), Tick(NS), Tick(NS + ROUND.wait_ns))
    estimate = agent.estimate()
    assert estimate is not None and estimate.tracks[0].target == "t1"
    assert estimate.tracks[0].learnt_ns == 0
