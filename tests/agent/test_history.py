"""The past of a robot: its states and left factors, and late data used at the instant they belong to."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.belief import CorrelationStack, Part, RobotState
from agent.core import Agent
from agent.estimation.colocalization import Update
from agent.estimation.motion import compose
from agent.events import Event, Fix, Observation, Odometry, Tick
from agent.factor_model import SeparateModel
from agent.history import MAX_ENTRIES, History
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings
from network.messages import Epoch
from tests.agent.courier import FIRST, SECOND, TINY, Pair

Array = NDArray[np.float64]

STEP = NS // 10
KNOWN_HEADING = np.diag([0.3, 0.2, 1e-12])
NOISE = np.diag([0.02, 0.01, 0.0, 0.0])
R = np.diag([0.04, 0.05])


def plain(cov: Array = KNOWN_HEADING, horizon_ns: int = 60 * NS) -> AgentSettings:
    return AgentSettings(
        robot="r1",
        start_ns=0,
        mean=np.array([1.0, 2.0, 0.4]),
        cov=cov,
        localization=LocalizationSettings(form="safe", transform="jacobian"),
        lateness=LatenessSettings(horizon_ns=horizon_ns, tolerance_ns=0),
    )


def drive(k: int) -> Odometry:
    return Odometry((k + 1) * STEP, k * STEP, (k + 1) * STEP, np.array([0.1, 0.01, 0.0, 0.0]), NOISE)


def fix(t_ns: int, now_ns: int) -> Fix:
    z = np.array([1.0 + 0.5 * np.sin(t_ns), 2.0 + 0.5 * np.cos(t_ns)])
    return Fix(now_ns, t_ns, "position", z, R, "gps")


def played(subject: Agent, events: list[Event]) -> Agent:
    for event in sorted(events, key=lambda event: event.t_ns):
        subject.handle(event)
    return subject


def assert_same(one: RobotState, other: RobotState, tolerance: float) -> None:
    assert one.t_ns == other.t_ns
    assert np.abs(one.mean - other.mean).max() < tolerance
    assert np.abs(one.cov - other.cov).max() < tolerance


@settings(max_examples=50, deadline=None)
@given(st.sets(st.integers(0, 19 * 4), max_size=20), st.integers(0, 20))
def test_data_late_in_their_order_give_the_timely_result(quarters: set[int], wait: int) -> None:
    """Fixes at and between the ends of increments, all late by 0 to 2 s, many under way: as if all had come in time."""
    drives: list[Event] = [drive(k) for k in range(42)]
    stamps = [(quarter + 1) * STEP // 4 for quarter in sorted(quarters)]
    late = played(Agent(plain()), drives + [fix(t_ns, -(-t_ns // STEP) * STEP + wait * STEP) for t_ns in stamps])
    settling = LatenessSettings(settle_ns=2 * STEP, tolerance_ns=0)
    timely = played(Agent(replace(plain(), lateness=settling)), drives + [fix(t_ns, t_ns) for t_ns in stamps])
    timely.handle(Tick(50 * STEP))
    assert late.counters["used.position"] == timely.counters["used.position"] == len(stamps)
    assert_same(late.filter.state, timely.filter.state, 1e-9)


ARRIVALS = st.lists(st.tuples(st.integers(1, 5), st.integers(0, 5)), min_size=1, max_size=4)


@settings(max_examples=15, deadline=None)
@given(ARRIVALS)
@example([(4, 1), (1, 5)])
@example([(3, 1), (2, 3), (5, 0)])
def test_the_covariance_is_that_of_the_errors_whatever_the_order(arrivals: list[tuple[int, int]]) -> None:
    """The estimate is linear in what it is told: its response to every unit noise gives its true covariance.

    Out of order the gains are not the best ones; what is claimed is honest nevertheless, and never less than in order.
    """

    def run(late: bool, noisy: int, column: int, size: float) -> Agent:
        start = plain()
        root = size * np.linalg.cholesky(KNOWN_HEADING)[:, column] if noisy == 0 else np.zeros(3)
        subject = Agent(replace(start, mean=start.mean + root))
        events: list[Event] = []
        for k in range(6):
            delta = np.array([0.1, 0.01, 0.0, 0.0])
            if noisy == k + 1:
                delta[column] += size * np.sqrt(NOISE[column, column])
            events.append(Odometry((k + 1) * STEP, k * STEP, (k + 1) * STEP, delta, NOISE))
        for index, (k, wait) in enumerate(arrivals):
            z = np.array([1.0, 2.0])
            if noisy == 7 + index:
                z = z + size * np.linalg.cholesky(R)[:, column]
            events.append(Fix(min(k + wait * late, 6) * STEP, k * STEP, "position", z, R, f"gps{index}"))
        return played(subject, events)

    still = run(True, -1, 0, 0.0)
    response = [
        run(True, noisy, column, 1e3).estimate().mean[:2] - run(True, noisy, column, -1e3).estimate().mean[:2]
        for noisy in range(7 + len(arrivals))
        for column in (0, 1)
    ]
    errors = np.stack(response, axis=1) / 2e3
    assert np.abs(still.filter.state.cov[:2, :2] - errors @ errors.T).max() < 1e-7
    timely = run(False, -1, 0, 0.0).filter.state.cov
    assert np.linalg.eigvalsh(still.filter.state.cov - timely).min() > -1e-12


@pytest.mark.parametrize("late_steps", [0, 3, 10, 20])
def test_a_stream_of_late_fixes_stays_honest(late_steps: int) -> None:
    """Ten fixes per second, all late by up to two seconds: many are under way at once, and the errors are as claimed.

    Seeds 0 to 5. Correcting the present by each fix as if it were the only one diverges here by kilometres.
    """
    nees, used = 0.0, 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = [np.array([1.0, 2.0, 0.4]) + rng.multivariate_normal(np.zeros(3), np.diag([0.3, 0.2, 0.01]))]
        base = plain(np.diag([0.3, 0.2, 0.01]))
        subject = Agent(replace(base, localization=LocalizationSettings(form="safe")))
        sigma = np.array([0.05, 0.05, 0.002])
        noise = np.diag([sigma[0], sigma[1], 0.0, sigma[2]]) ** 2
        for k in range(200):
            step = np.array([0.05, 0.0, 0.01])
            truth.append(compose(truth[-1], step + rng.normal(size=3) * sigma))
            delta = np.array([step[0], step[1], 0.0, step[2]])
            subject.handle(Odometry((k + 1) * STEP, k * STEP, (k + 1) * STEP, delta, noise))
            then = k + 1 - late_steps
            if then > 0:
                z = truth[then][:2] + rng.normal(size=2) * 0.1
                subject.handle(Fix((k + 1) * STEP, then * STEP, "position", z, 0.01 * np.eye(2), "gps"))
            if k >= 50 and k % 10 == 0:
                error = subject.filter.state.mean[:2] - truth[-1][:2]
                nees += float(error @ np.linalg.solve(subject.filter.state.cov[:2, :2], error)) / 2.0
                used += 1
        assert subject.counters["late.compensated"] == (200 - late_steps if late_steps else 0)
    assert 0.6 < nees / used < 1.4


def known_pair() -> Pair:
    starts = {
        FIRST: (np.array([0.0, 0.0, 0.0]), np.diag([0.3, 0.2, TINY])),
        SECOND: (np.array([6.0, 2.0, 0.5]), np.diag([0.4, 0.5, TINY])),
    }
    return Pair(starts, timeout_s=1000.0)


def story(late: bool) -> Pair:
    """A contact at 1 s, three fixes of the first robot that are late or not, a second contact at 8 s."""
    pair = known_pair()
    for k in range(8):
        for name in (FIRST, SECOND):
            pair.odometry(name, k * NS, (k + 1) * NS, np.array([0.3, 0.1, 0.0, 0.0]), NOISE)
        if k == 0:
            pair.converse(pair.measure(FIRST, NS, "range", np.array([6.4]), np.array([[0.01]])))
        due = {2: [3], 3: [4], 4: [5]} if not late else {5: [3, 4], 6: [5]}
        for second in due.get(k, []):
            pair.agents[FIRST].handle(fix(second * NS, pair.now_ns))
    pair.converse(pair.measure(FIRST, 8 * NS, "range", np.array([6.2]), np.array([[0.01]])))
    return pair


def test_late_data_between_contacts_leave_the_correlation_exact() -> None:
    timely, late = story(late=False), story(late=True)
    assert late.agents[FIRST].counters["late.compensated"] == 3
    for name in (FIRST, SECOND):
        assert_same(late.agents[name].filter.state, timely.agents[name].filter.state, 1e-9)
    cross, reference = late.cross(), timely.cross()
    assert cross is not None
    assert reference is not None
    assert np.abs(reference).max() > 1e-3
    assert np.abs(cross - reference).max() < 1e-9


def test_data_older_than_a_contact_move_its_line_as_the_own_error() -> None:
    """A fix from before a contact that is still under way: the line becomes P+ P^-1 at the contact's instant."""
    pair = known_pair()
    for k in range(3):
        for name in (FIRST, SECOND):
            pair.odometry(name, k * NS, (k + 1) * NS, np.array([0.3, 0.1, 0.0, 0.0]), NOISE)
    (request,) = pair.measure(FIRST, 3 * NS, "range", np.array([6.4]), np.array([[0.01]]))
    before = pair.agents[FIRST].filter.state.cov
    pair.odometry(FIRST, 3 * NS, 4 * NS, np.array([0.3, 0.1, 0.0, 0.0]), NOISE)
    pair.agents[FIRST].handle(fix(NS, pair.now_ns))
    then, psi = since(pair.agents[FIRST].filter.history, 3 * NS)
    (line,) = pair.agents[FIRST].filter.snapshot(SECOND).lines
    assert line.epoch == request.body.epoch
    assert np.abs(line.matrix - psi @ then.cov @ np.linalg.inv(before)).max() < 1e-6
    assert np.trace(then.cov) < np.trace(before)


def test_a_correction_that_would_leave_a_covariance_indefinite_changes_nothing() -> None:
    subject = played(Agent(plain()), [drive(k) for k in range(4)])
    then = subject.filter.history.cut(2 * STEP)
    assert then is not None
    state = subject.filter.state
    impossible = Update(then.mean, -3.0 * then.cov, np.eye(3), 1.0)
    assert subject.filter.history.corrected(then.t_ns, impossible) is None
    assert subject.filter.history.cut(2 * STEP) is then
    assert subject.filter.state is state


def since(history: History, t_ns: int) -> tuple[RobotState, Array]:
    """The state at `t_ns`, and the left factors of its error since, as a contact's identity line has them."""
    then = history.cut(t_ns)
    assert then is not None
    probe = Epoch(t_ns, "probe", 1)
    psi = history.opened(then.t_ns, "probe", probe).stack.block((Part.LINE, "probe", probe))
    assert psi is not None
    return then, psi


def filled(count: int, horizon_ns: int = 60 * NS) -> tuple[History, RobotState]:
    base = plain(horizon_ns=horizon_ns)
    state = RobotState(0, base.mean, base.cov, CorrelationStack(np.zeros((3, 0))))
    history = History(base, SeparateModel(base, Counter()), state)
    for k in range(count):
        event = drive(k)
        state = history.advance(state, event.t_meas_ns, event.delta, event.cov)
    return history, state


def test_the_past_is_told_with_the_factors_since() -> None:
    """Psi maps the error at any instant, also within an increment, to the error now."""
    base = plain(np.diag([0.3, 0.2, 0.05]))
    subject = played(Agent(base), [drive(0), fix(STEP, STEP), drive(1), fix(2 * STEP, 2 * STEP), drive(2)])
    for t_ns in (0, STEP // 2, STEP, 3 * STEP // 2, 2 * STEP, 3 * STEP):
        then, psi = since(subject.filter.history, t_ns)
        assert then.t_ns == t_ns
        # What is left of P is noise since then: P - Psi P_k Psi^T >= 0, and zero at the present.
        assert np.linalg.eigvalsh(subject.filter.state.cov - psi @ then.cov @ psi.T).min() > -1e-12
    assert np.array_equal(psi, np.eye(3))
    assert subject.filter.history.cut(-1) is None
    assert subject.filter.history.cut(3 * STEP + 1) is None


def test_a_cut_past_is_the_same_past() -> None:
    for t_ns in (STEP // 3, STEP, 7 * STEP // 2):
        whole, newest = filled(5)
        _, psi = since(whole, 0)
        history, _ = filled(5)
        then, rest = since(history, t_ns)
        assert history.cut(t_ns) is not None
        assert np.abs(since(history, 0)[1] - psi).max() < 1e-12
        # Noise divides with time: what was there, and what has come since, is the whole.
        grown = (newest.cov - rest @ then.cov @ rest.T)[0, 0] + (then.cov - KNOWN_HEADING)[0, 0]
        assert grown == pytest.approx((newest.cov - psi @ KNOWN_HEADING @ psi.T)[0, 0])
        last = history.cut(newest.t_ns)
        assert last is not None
        assert_same(last, newest, 1e-15)
    assert history.cut(-1) is None
    assert history.cut(6 * STEP) is None


def test_the_ring_is_bounded_in_time_and_number() -> None:
    history, _ = filled(100, horizon_ns=NS)
    assert len(history) <= 12
    assert history.oldest_ns <= 9 * NS
    assert history.cut(9 * NS) is not None
    assert history.cut(8 * NS) is None
    many, newest = filled(MAX_ENTRIES + 50, horizon_ns=10**6 * NS)
    assert len(many) == MAX_ENTRIES
    for k in range(20):
        assert many.cut(newest.t_ns - k * STEP - STEP // 2) is not None
    assert len(many) == MAX_ENTRIES


def test_a_late_landmark_is_used_like_a_late_fix() -> None:
    base = replace(plain(), landmarks={"L1": (5.0, 1.0)})
    seen = [Observation(now, 2 * STEP, "range", "landmark:L1", np.array([4.0]), np.eye(1) * 0.01) for now in (2, 6)]
    timely = played(Agent(base), [*(drive(k) for k in range(6)), replace(seen[0], t_ns=2 * STEP)])
    late = played(Agent(base), [*(drive(k) for k in range(6)), replace(seen[1], t_ns=6 * STEP)])
    assert late.counters["late.compensated"] == 1
    assert_same(late.filter.state, timely.filter.state, 1e-9)
